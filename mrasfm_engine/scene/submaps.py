"""The cut of a drive along its path into sub-maps, each a drive of its own that shares units with its neighbours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.types import Bools, Ints

# Memory of mapping for a keypoint: its place and ray, its matches with some ten images, its track and its share of a
# point and of the adjustment. As measured on simulated drives of 900 and 3,600 images, and a third more.
KEYPOINT_BYTES = 100
# A sub-map is at least so many times as long as what it shares with a neighbour: less would be done twice too often.
LEAST_OVERLAPS = 4
# And it has so many images at least: to hand a sub-map to a worker and to join it takes ten to twenty seconds, as long
# as some fifty images take.
LEAST_IMAGES = 250


@dataclass(frozen=True, kw_only=True)
class Span:
    """The units of a sub-map, both ends inclusive.

    Attributes
    ----------
    number
        Counts from 1 along the path.
    shared_before, shared_after
        Number of its units that the one before has as well, and the one after.
    """

    number: int
    first: int
    last: int
    shared_before: int = 0
    shared_after: int = 0

    @property
    def units(self) -> Ints:
        """The units (n,)."""
        return np.arange(self.first, self.last + 1)

    @property
    def is_shared(self) -> Bools:
        """True for those of its units (n,) that a neighbour has as well."""
        result = np.zeros(self.last - self.first + 1, dtype=np.bool_)
        result[: self.shared_before] = True
        result[len(result) - self.shared_after :] = True
        return result

    def images_of(self, drive: Drive) -> Ints:
        """Images (n,) of the drive that are of its units."""
        unit = np.array([image.unit for image in drive.images], dtype=np.int64)
        return np.flatnonzero((unit >= self.first) & (unit <= self.last))


@dataclass(frozen=True, kw_only=True)
class Submap:
    """A sub-map as it is handed out.

    Attributes
    ----------
    number
        Counts from 1 along the path.
    first_unit, last_unit
        Of the drive's frames, both inclusive, whose images and masks it needs; units of a standing car between them
        take no part.
    is_finished
        Whether its result is there already.
    """

    number: int
    first_unit: int
    last_unit: int
    is_finished: bool


def count_for_memory(drive: Drive, *, keypoints_per_image: int, memory_bytes: float) -> int:
    """Number of sub-maps of which each is expected to need no more than some memory."""
    return math.ceil(len(drive.images) * keypoints_per_image * KEYPOINT_BYTES / memory_bytes)


def count_for_workers(drive: Drive, workers: int, overlap: int) -> int:
    """Number of sub-maps that keep some workers busy without doing much twice."""
    by_length = (len(drive.manifest.frames) - overlap) // ((LEAST_OVERLAPS - 1) * overlap)
    return max(1, min(workers, by_length, len(drive.images) // LEAST_IMAGES))


def count_in_rounds(for_memory: int, for_workers: int) -> int:
    """Number of sub-maps that are no fewer than memory asks for, and as many for each worker.

    With one more than there are workers, all but one would wait for as long again.
    """
    return math.ceil(for_memory / for_workers) * for_workers


def cut(units: int, count: int, overlap: int) -> list[Span]:
    """Cut a drive into sub-maps of nearly equal length, of which neighbours share some units.

    There are fewer than asked for where a unit would else be in more than two of them.
    """
    count = max(1, min(count, (units - overlap) // overlap))
    ends = np.linspace(0, units - overlap, count + 1).round().astype(int).tolist()
    return spans_between([(first, last + overlap - 1) for first, last in pairwise(ends)])


def spans_between(ends: Sequence[tuple[int, int]]) -> list[Span]:
    """Sub-maps by their first and last units, along the path."""
    shared = [0, *(max(0, before[1] - after[0] + 1) for before, after in pairwise(ends)), 0]
    return [
        Span(number=k + 1, first=first, last=last, shared_before=shared[k], shared_after=shared[k + 1])
        for k, (first, last) in enumerate(ends)
    ]


def share_a_submap(spans: Sequence[Span], unit_a: Ints, unit_b: Ints) -> Bools:
    """Pairs of units (n,), (n,) that are both in one sub-map."""
    low, high = np.minimum(unit_a, unit_b), np.maximum(unit_a, unit_b)
    result = np.zeros(len(low), dtype=np.bool_)
    for span in spans:
        result |= (low >= span.first) & (high <= span.last)
    return result
