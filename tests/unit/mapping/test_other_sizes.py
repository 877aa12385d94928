from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.bundle_adjustment.marginal_covariances import Covariances, covariances
from mrasfm_engine.bundle_adjustment.priors import Term
from mrasfm_engine.bundle_adjustment.solver import Report, SolverOptions
from mrasfm_engine.errors import CancelledError
from mrasfm_engine.geometry import se3
from mrasfm_engine.mapping.calibration import calibration_prior, scale_scene
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.other_sizes import (
    CLEAR_SIGMAS,
    FACTORS,
    UNSURE,
    Cost,
    SizedScenes,
    cost_as_found,
    scenes_of_other_sizes,
    scenes_of_sizes,
    size_m,
    with_other_sizes,
)
from mrasfm_engine.mapping.pose_adjustment import adjust_poses
from tests.unit.mapping.test_calibration import UNITS, true_model

FREE = np.arange(UNITS) > 0
OPTIONS = SolverOptions(sigma_px=0.5)


def assessed(mapper: Mapper, sigma_scale: float) -> tuple[Covariances, int]:
    """The certainty of a scene, with another curvature along its scale, and how often the scene was adjusted."""
    problem, _ = mapper.problem(
        FREE, free_cameras=np.ones(2, dtype=np.bool_), terms=[calibration_prior(mapper)], options=OPTIONS
    )
    certainty = covariances(problem, problem.state, shared_errors=False)
    unknown = np.full_like(certainty.scale_with_calibration, np.nan)
    certainty = replace(certainty, sigma_scale=sigma_scale, scale_with_calibration=unknown)

    adjustments: list[Report] = []

    def adjust(terms: Sequence[Term]) -> None:
        adjustments.append(
            adjust_poses(mapper, FREE, free_cameras=np.ones(2, dtype=np.bool_), terms=terms, options=OPTIONS)
        )

    scenes = scenes_of_other_sizes(mapper, certainty, adjust, lambda: [calibration_prior(mapper)], OPTIONS)
    if scenes is not None:
        certainty = with_other_sizes(mapper, certainty, scenes)
    return certainty, len(adjustments)


def test_a_scene_that_costs_the_same_at_other_sizes_is_as_uncertain_as_these_are_apart() -> None:
    """One of two cameras sees nothing: images of the other say nothing of how large the scene is."""
    mapper = true_model(cameras=2)
    mapper.missing[mapper.image_camera == 1] = True
    mapper.complete()
    state, motion, before = mapper.state, mapper.motion, mapper.state.unit_position_m.copy()
    found, _ = assessed(mapper, sigma_scale=0.1)
    assert found.sigma_scale == pytest.approx(np.log(max(FACTORS)), rel=0.2)
    assert mapper.state is state
    assert mapper.motion is motion
    np.testing.assert_array_equal(mapper.state.unit_position_m, before)


def test_a_scene_that_comes_back_from_other_sizes_is_as_certain_as_it_was() -> None:
    found, adjusted = assessed(true_model(cameras=2), sigma_scale=0.1)
    assert adjusted == 2 + 2  # from its own size until that changes nothing, and from two others that come to it
    assert found.sigma_scale == pytest.approx(0.1, rel=0.01)


@pytest.mark.parametrize("factor", [0.5, 3.0])
def test_observations_that_a_wrong_size_has_lost_count_against_it(factor: float) -> None:
    """Those that are left fit as well as those of the true scene: a pair compares them with its baseline."""
    mapper = true_model(cameras=2)
    found_m, observations = size_m(mapper), int(mapper.is_inlier.sum())
    scale_scene(mapper, factor)
    mapper.complete()
    assert mapper.is_inlier.sum() < 0.9 * observations
    inlier = mapper.is_inlier.copy()
    scenes = scenes_of_sizes(mapper, (1.0, 1.0 / factor), lambda terms: None, list, OPTIONS)
    np.testing.assert_array_equal(mapper.is_inlier, inlier)
    np.testing.assert_allclose(scenes.size_m, [factor * found_m, found_m], rtol=0.01)
    assert scenes.cost[1] < 0.9 * scenes.cost[0]
    assert scenes.sigma_of_scale(size_m(mapper)) == pytest.approx(abs(np.log(factor)), rel=0.01)
    assert scenes.sigma_of_scale(found_m) < 0.1
    scenes.take(scenes.best, mapper)
    assert size_m(mapper) == pytest.approx(found_m, rel=0.01)
    assert mapper.is_inlier.sum() == pytest.approx(observations, rel=0.01)


def test_tracks_that_were_dropped_for_what_they_show_come_back_at_no_size() -> None:
    mapper = true_model(cameras=2)
    tracks = np.flatnonzero(mapper.triangulated)[::3]
    mapper.drop(tracks)
    scenes = scenes_of_sizes(mapper, (1.0, 2.0), lambda terms: None, list, OPTIONS)
    scenes.take(scenes.best, mapper)
    assert mapper.rejected[tracks].all()
    assert not mapper.is_inlier[np.isin(mapper.tracks.of_keypoint, tracks)].any()


def test_the_cost_as_found_is_that_of_all_observations_that_fit_without_tracks_that_were_dropped() -> None:
    mapper = true_model(cameras=2)
    tracks = np.flatnonzero(mapper.triangulated)[::3]
    mapper.drop(tracks)
    complete = cost_as_found(mapper, OPTIONS)
    mapper.is_inlier[np.flatnonzero(mapper.is_inlier)[::5]] = False
    mapper.filter(mapper.config.mapping.filter_error_px)
    state, inlier, rejected = mapper.state, mapper.is_inlier.copy(), mapper.rejected.copy()
    found = cost_as_found(mapper, OPTIONS)
    assert found.of_terms == 0.0
    assert found.total == pytest.approx(complete.total, rel=0.01)
    assert not found.of_tracks[tracks].any()
    assert (found.of_tracks > 0.0).sum() > 0.5 * len(mapper.tracks)
    assert mapper.state is state
    np.testing.assert_array_equal(mapper.is_inlier, inlier)
    np.testing.assert_array_equal(mapper.rejected, rejected)


@pytest.mark.parametrize("sigma_scale", [0.5 * UNSURE, np.inf])
def test_other_sizes_are_tried_only_where_images_know_the_scale_badly(sigma_scale: float) -> None:
    mapper = true_model(cameras=2)
    mapper.missing[mapper.image_camera == 1] = True
    mapper.complete()
    found, adjusted = assessed(mapper, sigma_scale=sigma_scale)
    assert (found.sigma_scale, adjusted) == (sigma_scale, 0)


def test_images_with_poses_of_their_own_keep_them() -> None:
    """As what is adjusted on the way, the poses are scaled with the scene."""
    mapper = true_model(cameras=2)
    mapper.set_image_pose(3, se3.transform(np.eye(3), [0.5, 0.0, 0.0]))
    before = mapper.motion.own_poses[1].copy()
    _, adjusted = assessed(mapper, sigma_scale=0.1)
    assert adjusted
    np.testing.assert_array_equal(mapper.motion.own_poses[1], before)


def test_a_cancelled_trial_leaves_the_scene_as_it_was() -> None:
    mapper = true_model(cameras=2)
    state, motion = mapper.state, mapper.motion

    def cancelled(terms: Sequence[Term]) -> None:
        raise CancelledError

    certainty, _ = assessed(mapper, sigma_scale=np.inf)
    with pytest.raises(CancelledError):
        scenes_of_other_sizes(mapper, replace(certainty, sigma_scale=0.1), cancelled, list, OPTIONS)
    assert mapper.state is state
    assert mapper.motion is motion


def test_what_few_points_decide_is_not_clear() -> None:
    """A scene whose cost is lower by much, all of it that of one point, may owe that to an outlier."""
    cost = Cost(of_terms=1.0, of_tracks=np.full(100, 2.0))
    of_one, of_half = cost.of_tracks.copy(), cost.of_tracks.copy()
    of_one[3] += 15.0
    of_half[::2] += 0.3
    assert cost.sigmas_above(cost) == 0.0
    assert 0.5 < Cost(of_terms=1.0, of_tracks=of_one).sigmas_above(cost) < 1.5
    assert cost.sigmas_above(Cost(of_terms=1.0, of_tracks=of_half)) == 0.0
    assert cost.is_clearly_below(Cost(of_terms=1.0, of_tracks=of_half))
    assert cost.is_clearly_below(Cost(of_terms=1.01 + 0.5 * CLEAR_SIGMAS**2, of_tracks=cost.of_tracks))
    assert not cost.is_clearly_below(Cost(of_terms=0.99 + 0.5 * CLEAR_SIGMAS**2, of_tracks=cost.of_tracks))


def test_a_scene_stays_at_its_own_size_beside_one_that_is_not_clearly_more_likely() -> None:
    """By 20 it is, by 2 it is not; of both, the sigma holds the other one."""
    for below, likely in ((20.0, 1), (2.0, 0)):
        costs = [Cost(of_terms=0.0, of_tracks=np.array([100.0, 100.0 - part])) for part in (0.0, below)]
        even = [Cost(of_terms=cost.total, of_tracks=np.zeros(2)) for cost in costs]
        scenes = SizedScenes(size_m=np.array([1.0, 2.0]), costs=even, _parts=[{}, {}])
        assert (scenes.best, scenes.likely) == (1, likely)
        assert scenes.sigma_of_scale(1.0) == pytest.approx(np.log(2.0))
        assert scenes.sigma_of_scale(2.0) == pytest.approx(np.log(2.0) / np.sqrt(2.0 * below))


def test_sizes_beyond_one_that_is_clearly_less_likely_are_not_tried() -> None:
    mapper = true_model(cameras=2)
    tried: list[float] = []

    def adjust(terms: Sequence[Term]) -> None:
        tried.append(size_m(mapper))

    scenes = scenes_of_sizes(mapper, (1.0, *FACTORS), adjust, list, OPTIONS)
    assert scenes.costs[0].is_clearly_below(scenes.costs[1])
    assert {round(size / size_m(mapper), 2) for size in tried} == {1.0, 0.5, 2.0}
