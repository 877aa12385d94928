"""Loop closure: find revisits, verify them, and distribute the drift.

Mapping first uses the matches of neighbouring units alone, so that no wrong revisit bends the reconstruction. Then
every pair of units that matches across a larger gap is tried: the later unit is registered against points that the
earlier one observes. The difference to its current pose is the drift since, as this pair measures it. Drift changes
slowly: a revisit is accepted if several pairs of neighbouring units measure the same drift, and if that drift is
plausible for the trajectory in between. A pose graph then distributes it over the loop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.pose_graph import Edges, optimise_pose_graph
from mrasfm_engine.mapping.unit_registration import Correspondences2D3D, register_from_correspondences
from mrasfm_engine.scene.scene import PairMatches
from mrasfm_engine.types import Floats

MIN_INLIERS = 30
MIN_SUPPORT = 3  # pairs of units that report one drift
NEIGHBOUR_UNITS = 6  # how far apart two pairs of units may be to support one another
SAME_DRIFT_M, SAME_DRIFT_DEG = 0.3, 1.0
MAX_DRIFT_M, MAX_DRIFT_PER_M, MAX_DRIFT_DEG = 1.0, 0.03, 10.0  # what a drive of some length may have gone off
SIGMA_STEP_ROTATION_RAD, SIGMA_STEP_TRANSLATION_M = np.radians(0.05), 0.01  # from one unit to the next
SIGMA_LOOP_ROTATION_RAD, SIGMA_LOOP_TRANSLATION_M = np.radians(0.1), 0.03


@dataclass(frozen=True, kw_only=True)
class Revisit:
    """Two units that see the same place."""

    earlier: int
    later: int
    world_from_rig: Floats  # pose of the later unit from points that the earlier one sees
    drift: Floats  # (4, 4) that moves the later unit's current pose there: world_from_rig @ inverse(current)


def split_pairs(pairs: Sequence[PairMatches]) -> tuple[list[PairMatches], list[PairMatches]]:
    """Pairs of units that follow one another, and pairs that may be revisits."""
    return [pair for pair in pairs if not pair.is_revisit], [pair for pair in pairs if pair.is_revisit]


def find_revisits(mapper: Mapper, far_pairs: Sequence[PairMatches]) -> tuple[list[Revisit], int]:
    """Believed revisits, and how many pairs of units were tried."""
    by_units: dict[tuple[int, int], list[PairMatches]] = {}
    for pair in far_pairs:
        units = sorted((int(mapper.image_unit[pair.image_a]), int(mapper.image_unit[pair.image_b])))
        if mapper.registered[units].all():
            by_units.setdefault((units[0], units[1]), []).append(pair)
    found = [r for (i, j), own in sorted(by_units.items()) if (r := _try(mapper, i, j, own)) is not None]
    known = np.flatnonzero(mapper.registered)
    steps = np.linalg.norm(np.diff(mapper.state.unit_position_m[known], axis=0), axis=1)
    way = dict(zip(known.tolist(), np.concatenate([[0.0], np.cumsum(steps)]), strict=True))
    plausible = [r for r in found if _plausible(r, mapper, float(way[r.later] - way[r.earlier]))]
    return _supported(plausible, mapper), len(by_units)


def _try(mapper: Mapper, earlier: int, later: int, pairs: Sequence[PairMatches]) -> Revisit | None:
    """Register the later unit against points that the earlier one observes."""
    rows_later, tracks = [], []
    for pair in pairs:
        a, b = mapper.matched_keypoints(pair, earlier)
        observed = mapper.is_inlier[a]
        rows_later.append(b[observed])
        tracks.append(mapper.tracks.of_keypoint[a[observed]])
    rows, track = np.concatenate(rows_later), np.concatenate(tracks)
    matched = Correspondences2D3D(
        xy_px=mapper.keypoints.xy_px[rows],
        points_m=mapper.state.points_m[track],
        camera=mapper.keypoints.camera[rows],
        band=mapper.keypoints.band[rows],
    )
    current = mapper.state.world_from_rig_of(np.array([later]))[0]
    registration = register_from_correspondences(
        mapper, later, matched, min_inliers=MIN_INLIERS, by_vote=False, expected=current
    )
    if registration.world_from_rig is None:
        return None
    return Revisit(
        earlier=earlier,
        later=later,
        world_from_rig=registration.world_from_rig,
        drift=registration.world_from_rig @ se3.inverse(current),
    )


def _plausible(revisit: Revisit, mapper: Mapper, travelled_m: float) -> bool:
    at = mapper.state.unit_position_m[revisit.later]
    shift = np.linalg.norm(revisit.drift[:3, :3] @ at + revisit.drift[:3, 3] - at)
    turn = float(se3.rotation_angle_deg(revisit.drift[:3, :3]))
    return bool(shift <= MAX_DRIFT_M + MAX_DRIFT_PER_M * travelled_m and turn <= MAX_DRIFT_DEG)


def _supported(revisits: Sequence[Revisit], mapper: Mapper) -> list[Revisit]:
    """The revisits that several neighbours, themselves among them, agree with: they report the same drift."""
    if not revisits:
        return []
    units = np.array([(r.earlier, r.later) for r in revisits])
    drifts = np.stack([r.drift for r in revisits])
    at = mapper.state.unit_position_m[units[:, 1]]
    result = []
    for i, revisit in enumerate(revisits):
        # Revisits are in the order of their earlier units.
        low, high = np.searchsorted(units[:, 0], [units[i, 0] - NEIGHBOUR_UNITS, units[i, 0] + NEIGHBOUR_UNITS + 1])
        near = low + np.flatnonzero(np.abs(units[low:high, 1] - units[i, 1]) <= NEIGHBOUR_UNITS)
        moved = drifts[near, :3, :3] @ at[i] + drifts[near, :3, 3]
        shift = np.linalg.norm(moved - (drifts[i, :3, :3] @ at[i] + drifts[i, :3, 3]), axis=1)
        turn = se3.rotation_angle_deg(drifts[i, :3, :3] @ drifts[near, :3, :3].swapaxes(1, 2))
        if np.count_nonzero((shift <= SAME_DRIFT_M) & (turn <= SAME_DRIFT_DEG)) >= MIN_SUPPORT:
            result.append(revisit)
    return result


def close_loops(mapper: Mapper, revisits: Sequence[Revisit]) -> float:
    """Move the units by a pose graph of the drive's own steps and the revisits; by how much at most, in metres.

    Points stay where they are: they have to be triangulated anew.
    """
    poses = mapper.state.world_from_rig
    units = np.flatnonzero(mapper.registered)
    chain = np.stack([units[:-1], units[1:]], axis=1)
    loops = np.array([(r.earlier, r.later) for r in revisits], dtype=np.int64).reshape(-1, 2)
    measured = [
        se3.inverse(poses[chain[:, 0]]) @ poses[chain[:, 1]],
        se3.inverse(poses[loops[:, 0]]) @ np.stack([r.world_from_rig for r in revisits]),
    ]
    # A step over missing units is as uncertain as the units' number says.
    steps = np.sqrt(np.diff(units).astype(np.float64))
    edges = Edges(
        units=np.concatenate([chain, loops]),
        a_from_b=np.concatenate(measured),
        sigma_rotation_rad=np.concatenate(
            [SIGMA_STEP_ROTATION_RAD * steps, np.full(len(loops), SIGMA_LOOP_ROTATION_RAD)]
        ),
        sigma_translation_m=np.concatenate(
            [SIGMA_STEP_TRANSLATION_M * steps, np.full(len(loops), SIGMA_LOOP_TRANSLATION_M)]
        ),
        robust=np.arange(len(chain) + len(loops)) >= len(chain),
    )
    closed = optimise_pose_graph(poses, edges)
    moved = float(np.linalg.norm(closed[units, :3, 3] - poses[units, :3, 3], axis=1).max())
    for unit in units:
        mapper.set_pose(int(unit), closed[unit])
    return moved
