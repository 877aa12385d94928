from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.mapping.motion_groups import ALONE, BESIDE, MotionGroups, Neighbours, group
from mrasfm_engine.triangulation.track_motion import SPEED_M_S, TrackMotion
from mrasfm_engine.triangulation.tracks import Keypoints, Tracks

HARDLY_TELLS, IN_THE_MIDDLE = -1.0, 4


def grouped(
    log_evidence: np.ndarray,
    known: np.ndarray | None = None,
    velocity_m_s: np.ndarray | None = None,
    sigma_m_s: np.ndarray | float = SPEED_M_S,
    distance_m: np.ndarray | float = 10.0,
) -> MotionGroups:
    """Groups of nine tracks side by side in an image, a square of 40 px 10 m away at a focal length of 500 px.

    NaN has no evidence, and gets none when it is asked for, as tracks that one unit alone observes.
    """
    count = len(log_evidence)
    motion = TrackMotion(
        log_evidence=log_evidence.copy(),
        log_prior=np.zeros(count),
        velocity_m_s=np.zeros((count, 2)) if velocity_m_s is None else velocity_m_s,
        covariance=np.broadcast_to(sigma_m_s, count)[:, None] ** 2 * np.array([1.0, 0.0, 1.0]),
        distance_m=np.full(count, 10.0),
        inverse_distance=1.0 / np.broadcast_to(distance_m, count)[:, None] * [1.0, 0.0, 1.0, 0.0]
        + [0.0, 1e-6, 0.0, 1e-6],
        misfit=np.zeros(count),
        observations=np.full(count, 2),
        reference=np.arange(count),
    )
    known = np.full(count, np.nan) if known is None else known
    suspects = np.flatnonzero((log_evidence > 0.0) | (known > 0.0))
    return group(motion, suspects, known, neighbours_of(motion), weigh=lambda _: None)


def neighbours_of(motion: TrackMotion) -> Neighbours:
    """Of nine tracks, of which each has one keypoint."""
    xy = np.stack(np.meshgrid(np.arange(3.0), np.arange(3.0)), -1).reshape(-1, 2)
    count, zeros = len(xy), np.zeros(len(xy), dtype=np.int64)
    keypoints = Keypoints(
        first=np.array([0, count]), number=np.arange(count), image=zeros, unit=zeros, camera=zeros, band=zeros,
        xy_px=100.0 + 20.0 * xy, rays=np.tile([0.0, 0.0, 1.0], (count, 1)),
    )  # fmt: skip
    return Neighbours(motion, keypoints, Tracks.from_labels(np.arange(count)), np.array([500.0]))


def around(value: float, middle: float) -> np.ndarray:
    """One value for all tracks but that in the middle."""
    result = np.full(9, value)
    result[IN_THE_MIDDLE] = middle
    return result


def test_a_track_that_hardly_tells_moves_as_its_neighbours_are_known_to() -> None:
    found = grouped(around(np.nan, HARDLY_TELLS), known=around(3.0, np.nan))
    assert found.tracks.tolist() == list(range(9))
    assert found.reason[IN_THE_MIDDLE] == BESIDE
    assert set(np.delete(found.reason, IN_THE_MIDDLE)) == {ALONE}


def test_neighbours_are_the_same_whatever_was_asked_for_before() -> None:
    motion = replace(TrackMotion.empty(9), distance_m=np.full(9, 25.0), reference=np.arange(9))
    asked, every = neighbours_of(motion), neighbours_of(motion).beside(np.arange(9))
    assert set(every[IN_THE_MIDDLE]) - {-1} == {1, 3, 5, 7}
    for which in ([4, 2], [], [2, 8, 4, 0], [0, 1, 2, 3, 4, 5, 6, 7, 8]):
        np.testing.assert_array_equal(asked.beside(np.array(which, dtype=np.int64)), every[which])


def test_what_is_known_to_stand_does_not_move_with_its_neighbours() -> None:
    evidence = around(np.nan, 0.0)
    assert IN_THE_MIDDLE in grouped(evidence, known=around(3.0, np.nan)).tracks
    assert IN_THE_MIDDLE not in grouped(evidence, known=around(3.0, -9.0)).tracks


def test_one_neighbour_that_moves_is_not_enough() -> None:
    known = np.full(9, np.nan)
    known[0] = 3.0
    found = grouped(np.full(9, HARDLY_TELLS), known)
    assert IN_THE_MIDDLE not in found.tracks


@pytest.mark.parametrize(("behind_m", "moves"), [(0.0, False), (2.0, False), (30.0, True)])
def test_what_stands_far_behind_says_nothing_of_a_track_that_is_known_to_move(behind_m: float, moves: bool) -> None:
    found = grouped(around(-4.0, HARDLY_TELLS), known=around(np.nan, 3.0), distance_m=around(10.0 + behind_m, 10.0))
    assert (IN_THE_MIDDLE in found.tracks) == moves


def test_what_is_sure_to_stand_stays_among_those_that_move() -> None:
    assert IN_THE_MIDDLE not in grouped(around(np.nan, -30.0), known=around(3.0, np.nan)).tracks


@pytest.mark.parametrize(("speed_m_s", "moves"), [(5.0, True), (0.05, False)])
def test_a_velocity_that_errors_of_poses_explain_is_no_motion(speed_m_s: float, moves: bool) -> None:
    """Neighbours with some evidence for a velocity; a track that has it as well, and is fairly sure to stand."""
    velocity = np.tile([speed_m_s, 0.0], (9, 1))
    found = grouped(around(1.5, -10.0), velocity_m_s=velocity, sigma_m_s=0.1)
    assert (IN_THE_MIDDLE in found.tracks) == moves


def test_what_has_another_velocity_than_its_neighbours_does_not_go_with_them() -> None:
    velocity = np.column_stack([around(5.0, 0.0), np.zeros(9)])
    evidence = around(2.0, -4.0)
    assert IN_THE_MIDDLE not in grouped(evidence, velocity_m_s=velocity, sigma_m_s=0.1).tracks
    assert IN_THE_MIDDLE in grouped(evidence, velocity_m_s=velocity, sigma_m_s=around(0.1, SPEED_M_S)).tracks


def test_neighbours_whose_velocity_nothing_tells_go_with_any_velocity() -> None:
    velocity = np.column_stack([around(0.0, 14.0), np.zeros(9)])
    found = grouped(
        around(np.nan, HARDLY_TELLS),
        known=around(3.0, np.nan),
        velocity_m_s=velocity,
        sigma_m_s=around(SPEED_M_S, 0.3),
    )
    assert IN_THE_MIDDLE in found.tracks
