"""Sparsity of the Schur complement: the units and cameras that points couple, found once for all iterations.

A point that is eliminated couples all blocks (free units and cameras) that observe it. Points with the same blocks make
a group, whose places in the reduced system are looked up once. Groups are in the order of their first unit, so that
neighbours in time are neighbours in memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from mrasfm_engine.bundle_adjustment.block_cholesky import BlockPattern, Elimination
from mrasfm_engine.bundle_adjustment.problem import Layout, Observations, RowBandMotion
from mrasfm_engine.jit import njit
from mrasfm_engine.types import Ints


class Groups(NamedTuple):
    """Groups of points that couple the same blocks, see `SchurStructure`."""

    order: Ints
    first_point: Ints
    blocks: Ints
    first_block: Ints
    places: Ints
    first_place: Ints


@dataclass(frozen=True, kw_only=True)
class SchurStructure:
    """Groups of points that couple the same blocks, and where these couplings are in the reduced system."""

    points: Ints  # (p,) group by group
    first_point: Ints  # (groups + 1,) points of group i: points[first_point[i]:first_point[i + 1]]
    observations_before: Ints  # (p + 1,) of the points in this order, to share them out
    blocks: Ints  # of all groups: slots of units, ascending, then number of units + slots of cameras, ascending
    first_block: Ints  # (groups + 1,)
    places: Ints  # of all groups: block of the pattern for units i >= j of the group, at i (i + 1) / 2 + j
    first_place: Ints  # (groups + 1,)
    image: Ints  # (n,) of each observation, among those that were observed
    image_unit: Ints  # (images,)
    image_camera: Ints  # (images,)
    image_band: Ints  # (images,) 0 where there are no row bands
    pattern: BlockPattern  # of the units
    elimination: Elimination

    @staticmethod
    def from_observations(observations: Observations, layout: Layout, motion: RowBandMotion | None) -> SchurStructure:
        """The coupling of a problem's free units and cameras by its points."""
        o = observations
        support, weight = (None, None) if motion is None else (motion.support, motion.weight)
        blocks, first_block, signature = _blocks_of_points(
            o.unit, o.band, o.camera, o.first_of_point, o.fixed, support, weight,
            layout.unit_slot, layout.camera_slot, layout.num_units,
        )  # fmt: skip
        leading = np.full(o.num_points, layout.num_units + layout.num_cameras)
        some = first_block[1:] > first_block[:-1]
        leading[some] = blocks[first_block[:-1][some]]
        points = np.lexsort((signature, leading))
        first_point = _group_starts(points, blocks, first_block)
        blocks, first_block = _blocks_of_groups(points, first_point, blocks, first_block)
        first, row, places, first_place = _pattern(layout.num_units, blocks, first_block)
        pattern = BlockPattern(first=first, row=row)
        image, image_unit, image_camera, image_band = _images(o, layout)
        return SchurStructure(
            image=image,
            image_unit=image_unit,
            image_camera=image_camera,
            image_band=image_band,
            points=points,
            first_point=first_point,
            observations_before=np.concatenate([[0], np.cumsum(np.diff(o.first_of_point)[points])]),
            blocks=blocks,
            first_block=first_block,
            places=places,
            first_place=first_place,
            pattern=pattern,
            elimination=Elimination.from_pattern(pattern),
        )

    @property
    def groups(self) -> Groups:
        """Groups as the compiled loops take them."""
        return Groups(
            self.points, self.first_point, self.blocks, self.first_block, self.places, self.first_place
        )  # fmt: skip

    def shares(self, parts: int) -> Ints:
        """Bounds (parts + 1,) in `points` of parts with about the same number of observations."""
        wanted = np.linspace(0, self.observations_before[-1], parts + 1)
        bounds = np.searchsorted(self.observations_before, wanted).astype(np.int64)
        bounds[0], bounds[-1] = 0, len(self.points)
        return bounds


def _images(o: Observations, layout: Layout) -> tuple[Ints, Ints, Ints, Ints]:
    """Observed images (or row bands), numbered: of each observation, and their units, cameras and row bands."""
    name = o.unit * len(layout.camera_slot) + o.camera if o.band is None else o.band
    row = np.full(int(name.max(initial=-1)) + 1, -1, dtype=np.int64)
    row[name] = np.arange(len(name))  # an observation of each
    row = row[row >= 0]
    number = np.zeros(int(name.max(initial=-1)) + 1, dtype=np.int64)
    number[name[row]] = np.arange(len(row))
    band = np.zeros(len(row), dtype=np.int64) if o.band is None else o.band[row]
    return number[name], o.unit[row], o.camera[row], band


@njit(cache=True, forceinline=True, error_model="numpy")
def _insert(out: Any, begin: int, end: int, block: int) -> int:
    """Put a block into the ascending list out[begin:end], unless it is there; the new end."""
    at = end
    while at > begin and out[at - 1] > block:
        at -= 1
    if at > begin and out[at - 1] == block:
        return end
    for i in range(end, at, -1):
        out[i] = out[i - 1]
    out[at] = block
    return end + 1


@njit(cache=True, nogil=True)
def _blocks_of_points(
    obs_unit: Any, obs_band: Any, obs_camera: Any, first: Any, fixed: Any, support: Any, weight: Any, unit_slot: Any,
    camera_slot: Any, num_units: int,
) -> Any:  # fmt: skip
    """Blocks of every point, ascending, where each point's begin, and a hash (p,) of them; a fixed point has none."""
    count = len(first) - 1
    out = np.empty((2 if weight is None else 4) * len(obs_unit), np.int64)
    starts = np.zeros(count + 1, np.int64)
    signature = np.empty(count, np.uint64)
    end = 0
    for p in range(count):
        begin = end
        last = first[p] if fixed[p] else first[p + 1]
        for n in range(first[p], last):
            if weight is None:
                if unit_slot[obs_unit[n]] >= 0:
                    end = _insert(out, begin, end, unit_slot[obs_unit[n]])
            else:
                band = obs_band[n]
                for a in range(3):
                    if weight[band, a] != 0.0 and unit_slot[support[band, a]] >= 0:
                        end = _insert(out, begin, end, unit_slot[support[band, a]])
        for n in range(first[p], last):
            if camera_slot[obs_camera[n]] >= 0:
                end = _insert(out, begin, end, num_units + camera_slot[obs_camera[n]])
        starts[p + 1] = end
        code = np.uint64(14695981039346656037)
        for i in range(begin, end):
            code = (code ^ np.uint64(out[i])) * np.uint64(1099511628211)
        signature[p] = code
    return out[:end].copy(), starts, signature


@njit(cache=True)
def _group_starts(points: Any, blocks: Any, first_block: Any) -> Any:
    """Find the points, in their order, at which a group begins: those whose blocks differ from the point's before."""
    starts = np.empty(len(points) + 1, np.int64)
    count = 0
    for i in range(len(points)):
        begin, end = first_block[points[i]], first_block[points[i] + 1]
        same = i > 0 and first_block[points[i - 1] + 1] - first_block[points[i - 1]] == end - begin
        if same:
            other = first_block[points[i - 1]]
            for b in range(end - begin):
                if blocks[begin + b] != blocks[other + b]:
                    same = False
                    break
        if not same:
            starts[count] = i
            count += 1
    starts[count] = len(points)
    return starts[: count + 1].copy()


def _blocks_of_groups(points: Ints, first_point: Ints, blocks: Ints, first_block: Ints) -> tuple[Ints, Ints]:
    """Blocks of each group's first point: its other points have the same."""
    leader = points[first_point[:-1]]
    lengths = (first_block[1:] - first_block[:-1])[leader]
    starts = np.concatenate([[0], np.cumsum(lengths)])
    rows = np.repeat(first_block[leader] - starts[:-1], lengths) + np.arange(starts[-1])
    return blocks[rows], starts


@njit(cache=True)
def _pattern(num_units: int, blocks: Any, first_block: Any) -> Any:
    """The units' pattern (first, row) and the groups' places in it (places, first_place)."""
    groups = len(first_block) - 1
    counts, starts = np.zeros(groups, np.int64), np.zeros(num_units + 1, np.int64)
    for i in range(groups):
        for b in range(first_block[i], first_block[i + 1]):
            if blocks[b] < num_units:
                counts[i] += 1
                starts[blocks[b] + 1] += 1
    first_place = np.zeros(groups + 1, np.int64)
    for i in range(groups):
        first_place[i + 1] = first_place[i] + counts[i] * (counts[i] + 1) // 2
    for u in range(num_units):
        starts[u + 1] += starts[u]
    group_of, number_in = np.empty(starts[-1], np.int64), np.empty(starts[-1], np.int64)
    fill = starts[:-1].copy()
    for i in range(groups):
        for k in range(counts[i]):
            u = blocks[first_block[i] + k]
            group_of[fill[u]], number_in[fill[u]] = i, k
            fill[u] += 1
    places = np.empty(first_place[-1], np.int64)
    first = np.zeros(num_units + 1, np.int64)
    row = np.empty(16 * num_units + 16, np.int64)
    place = np.full(num_units, -1, np.int64)  # of a row in the current column
    found = np.iinfo(np.int64).max  # in the current column: its place follows
    end = 0
    for j in range(num_units):
        begin = end
        if end + num_units - j > len(row):
            grown = np.empty(2 * len(row) + num_units, np.int64)
            grown[:end] = row[:end]
            row = grown
        row[end], place[j] = j, found
        end += 1
        for s in range(starts[j], starts[j + 1]):
            i = group_of[s]
            for k in range(number_in[s], counts[i]):
                u = blocks[first_block[i] + k]
                if place[u] < begin:
                    place[u] = found
                    row[end] = u
                    end += 1
        row[begin + 1 : end].sort()
        for b in range(begin, end):
            place[row[b]] = b
        for s in range(starts[j], starts[j + 1]):
            i, low = group_of[s], number_in[s]
            for k in range(low, counts[i]):
                places[first_place[i] + k * (k + 1) // 2 + low] = place[blocks[first_block[i] + k]]
        first[j + 1] = end
        for b in range(begin, end):
            place[row[b]] = -1
    return first, row[:end].copy(), places, first_place
