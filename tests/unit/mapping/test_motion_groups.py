from __future__ import annotations

import numpy as np

from mrasfm_engine.mapping.motion_groups import ALONE, BESIDE, SHARED, MotionGroups, group
from mrasfm_engine.triangulation.track_motion import SPEED_M_S, TrackMotion
from mrasfm_engine.triangulation.tracks import Keypoints, Tracks

HARDLY_TELLS, IN_THE_MIDDLE = -1.0, 4


def grouped(
    log_evidence: np.ndarray,
    known: np.ndarray | None = None,
    velocity_m_s: np.ndarray | None = None,
    sigma_m_s: np.ndarray | float = SPEED_M_S,
) -> MotionGroups:
    """Groups of nine tracks side by side in an image, a square of 40 px 10 m away at a focal length of 500 px.

    NaN has no evidence, and gets none when it is asked for, as tracks that one unit alone observes.
    """
    count = len(log_evidence)
    xy = np.stack(np.meshgrid(np.arange(3.0), np.arange(3.0)), -1).reshape(-1, 2)
    zeros = np.zeros(count, dtype=np.int64)
    keypoints = Keypoints(
        first=np.array([0, count]), number=np.arange(count), image=zeros, unit=zeros, camera=zeros, band=zeros,
        xy_px=100.0 + 20.0 * xy, rays=np.tile([0.0, 0.0, 1.0], (count, 1)),
    )  # fmt: skip
    motion = TrackMotion(
        log_evidence=log_evidence.copy(),
        log_prior=np.zeros(count),
        velocity_m_s=np.zeros((count, 2)) if velocity_m_s is None else velocity_m_s,
        covariance=np.broadcast_to(sigma_m_s, count)[:, None] ** 2 * np.array([1.0, 0.0, 1.0]),
        distance_m=np.full(count, 10.0),
        misfit=np.zeros(count),
        observations=np.full(count, 2),
        reference=np.arange(count),
    )
    known = np.zeros(count) if known is None else known
    suspects = np.flatnonzero((log_evidence > 0.0) | (known > 0.0))
    tracks = Tracks.from_labels(np.arange(count))
    return group(motion, suspects, known, keypoints, tracks, np.array([500.0]), lambda _: None)


def test_a_track_that_hardly_tells_moves_as_its_neighbours_are_known_to() -> None:
    evidence = np.full(9, np.nan)
    evidence[IN_THE_MIDDLE] = HARDLY_TELLS
    known = np.full(9, 3.0)
    known[IN_THE_MIDDLE] = 0.0
    found = grouped(evidence, known)
    assert found.tracks.tolist() == list(range(9))
    assert found.reason[IN_THE_MIDDLE] == BESIDE
    assert set(np.delete(found.reason, IN_THE_MIDDLE)) == {ALONE}
    assert not len(grouped(evidence).tracks)


def test_one_neighbour_that_moves_is_not_enough() -> None:
    known = np.zeros(9)
    known[0] = 3.0
    found = grouped(np.full(9, HARDLY_TELLS), known)
    assert IN_THE_MIDDLE not in found.tracks


def test_what_is_sure_to_stand_stays_among_those_that_move() -> None:
    evidence = np.full(9, np.nan)
    evidence[IN_THE_MIDDLE] = -30.0
    known = np.full(9, 3.0)
    known[IN_THE_MIDDLE] = 0.0
    assert IN_THE_MIDDLE not in grouped(evidence, known).tracks


def test_a_velocity_that_neighbours_share_is_no_motion_where_it_is_that_of_what_stands() -> None:
    """Eight tracks with a velocity of 5 m/s, or of some centimetres a second as errors of poses make it."""
    evidence = np.full(9, 2.0)
    evidence[IN_THE_MIDDLE] = -4.0
    moves, stands = np.tile([5.0, 0.0], (9, 1)), np.tile([0.05, 0.0], (9, 1))
    assert grouped(evidence, velocity_m_s=moves, sigma_m_s=0.1).reason[IN_THE_MIDDLE] == SHARED
    found = grouped(evidence, velocity_m_s=stands, sigma_m_s=0.1)
    assert IN_THE_MIDDLE not in found.tracks or found.reason[found.tracks == IN_THE_MIDDLE] != SHARED


def test_what_has_another_velocity_than_its_neighbours_does_not_go_with_them() -> None:
    velocity, sigma = np.tile([5.0, 0.0], (9, 1)), np.full(9, 0.1)
    evidence = np.full(9, 2.0)
    evidence[IN_THE_MIDDLE], velocity[IN_THE_MIDDLE] = -4.0, 0.0
    assert IN_THE_MIDDLE not in grouped(evidence, velocity_m_s=velocity, sigma_m_s=sigma).tracks
    sigma[IN_THE_MIDDLE] = SPEED_M_S
    assert IN_THE_MIDDLE in grouped(evidence, velocity_m_s=velocity, sigma_m_s=sigma).tracks
