"""Points that a scene gives up: those that their track contradicts, and those that poses have left behind."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.mapping.mapper import Mapper
from tests.helpers.simulated_drive import make_model, make_simulated_drive, true_matches, with_true_poses


def mapped(posed: int) -> Mapper:
    """A drive of six units with so many at their true poses, and all points that these see."""
    simulated = make_simulated_drive(units=6, points=400)
    return with_true_poses(make_model(simulated, true_matches(simulated)), simulated, range(posed))


def tracks_of_length(mapper: Mapper, length: int) -> np.ndarray:
    """Triangulated tracks of so many keypoints, all of them observations."""
    observed = np.bincount(mapper.tracks.of_keypoint[mapper.is_inlier], minlength=len(mapper.tracks))
    found = np.flatnonzero(mapper.triangulated & (np.diff(mapper.tracks.first) == length) & (observed == length))
    assert len(found) > 5
    return found


def test_two_observations_that_a_third_contradicts_are_no_point() -> None:
    mapper = mapped(6)
    two, three, four = (tracks_of_length(mapper, length) for length in (2, 3, 4))
    contradicted, agreeing = three[::2], three[1::2]
    mapper.is_inlier[mapper.tracks.keypoints[mapper.tracks.first[contradicted]]] = False
    mapper.is_inlier[mapper.tracks.keypoints[mapper.tracks.first[four]]] = False  # three are left
    before = mapper.triangulated.sum()
    assert mapper.drop_contradicted() == len(contradicted)
    assert mapper.triangulated.sum() == before - len(contradicted)
    assert not mapper.triangulated[contradicted].any()
    assert mapper.triangulated[np.concatenate([two, agreeing, four])].all()
    assert not np.isin(mapper.tracks.of_keypoint[mapper.is_inlier], contradicted).any()


def test_what_an_image_without_a_pose_shows_contradicts_nothing() -> None:
    mapper = mapped(2)
    observed = np.bincount(mapper.tracks.of_keypoint[mapper.is_inlier], minlength=len(mapper.tracks))
    longer = mapper.triangulated & (observed == 2) & (np.diff(mapper.tracks.first) > 2)
    assert longer.sum() > 5
    assert mapper.drop_contradicted() == 0


def test_points_that_poses_have_left_behind_are_sought_anew_where_that_is_asked() -> None:
    mapper = mapped(6)
    mapper.complete()
    every, left_behind = np.flatnonzero(mapper.triangulated), np.flatnonzero(mapper.triangulated)[::4]
    places_m = mapper.state.points_m.copy()
    mapper.state.points_m[left_behind, 2] += 20.0
    mapper.complete(anew=True)
    np.testing.assert_array_equal(np.flatnonzero(mapper.triangulated), every)
    np.testing.assert_allclose(mapper.state.points_m[left_behind], places_m[left_behind], atol=0.5)
    mapper.state.points_m[left_behind, 2] += 20.0
    mapper.complete()
    assert not mapper.triangulated[left_behind].any()
