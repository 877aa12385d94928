from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.bundle_adjustment.marginal_covariances import covariances
from mrasfm_engine.bundle_adjustment.priors import PositionPrior
from mrasfm_engine.bundle_adjustment.solver import SolverOptions
from mrasfm_engine.errors import CancelledError, ReconstructionError
from mrasfm_engine.geometry import se3
from mrasfm_engine.mapping.calibration import (
    assess_calibration,
    calibration_prior,
    hold_baselines,
    is_straight,
    of_cameras_alone,
    resolve_scale,
    scale_of_baselines,
    scale_scene,
    scale_with_baselines,
    sigma_scale_of_images,
)
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.pose_adjustment import adjust_poses
from mrasfm_engine.mapping.refinement import refine
from mrasfm_engine.mapping.rough_placement import place_by_rough_poses
from mrasfm_engine.matching.verification import parallax_rad
from tests.helpers.simulated_drive import make_model, make_simulated_drive, with_true_poses

UNITS = 10


def true_model(*, cameras: int = 6, straight: bool = False, units: int = UNITS) -> Mapper:
    simulated = make_simulated_drive(units=units, cameras=cameras, points=900, straight=straight)
    return with_true_poses(make_model(simulated), simulated, range(units))


def errors_px(mapper: Mapper) -> np.ndarray:
    rows = mapper.observation_rows()
    return mapper.triangulator.errors_px(mapper.state, rows, mapper.state.points_m, mapper.tracks.of_keypoint[rows])


@pytest.mark.parametrize("cameras", [1, 2, 6])
def test_scaling_with_the_baselines_changes_no_image(cameras: int) -> None:
    mapper = true_model(cameras=cameras)
    before, mean = errors_px(mapper), mapper.state.camera_position_m.mean(0)
    way = np.linalg.norm(mapper.state.unit_position_m[0] - mapper.state.unit_position_m[-1])
    scale_with_baselines(mapper, 1.3)
    np.testing.assert_allclose(errors_px(mapper), before, atol=1e-6)
    np.testing.assert_allclose(mapper.state.camera_position_m.mean(0), mean, atol=1e-12)
    longer = np.linalg.norm(mapper.state.unit_position_m[0] - mapper.state.unit_position_m[-1]) / way
    assert 1.25 < longer < 1.35


def test_the_baselines_tell_by_how_much_they_were_scaled() -> None:
    mapper = true_model()
    assert scale_of_baselines(mapper)[0] == pytest.approx(1.0)
    scale_with_baselines(mapper, 1.25)
    factor, sigma = scale_of_baselines(mapper)
    assert factor == pytest.approx(1 / 1.25)
    assert 0.01 < sigma < 0.1  # 5 cm on some metres of baselines


def test_a_camera_far_from_where_it_was_given_does_not_tell_the_scale() -> None:
    mapper = true_model()
    mapper.state.camera_position_m[2] += [1.5, 0.4, 0.0]  # 5 cm is the prior's sigma
    assert scale_of_baselines(mapper)[0] == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("turn_deg", [30.0, 89.0, 91.0, 180.0])
def test_baselines_that_images_have_turned_neither_shrink_nor_mirror_a_scene(turn_deg: float) -> None:
    mapper = true_model(cameras=2)
    camera_m = mapper.state.camera_position_m
    camera_m[:] = 0.8 * camera_m @ se3.exp_so3([0.0, 0.0, np.radians(turn_deg)]).T
    assert scale_of_baselines(mapper)[0] == pytest.approx(1.25)


@pytest.mark.parametrize("factor", [0.97, 1.03])
def test_a_scene_that_is_scaled_without_its_cameras_moves_points_by_their_parallax_alone(factor: float) -> None:
    mapper = true_model(cameras=2)
    before = errors_px(mapper)
    scale_scene(mapper, factor)
    moved_px = np.abs(errors_px(mapper) - before)
    # 3 % of half of the baseline of 0.5 m, seen from 15 m; the cameras are 2 m from the rig's origin.
    assert 0.05 < np.median(moved_px) < 0.35


def test_cameras_in_one_place_have_no_scale() -> None:
    mapper = true_model(cameras=1)
    assert scale_of_baselines(mapper) == (1.0, np.inf)


def test_a_single_cameras_scale_is_infinitely_uncertain() -> None:
    mapper = true_model(cameras=1)
    free = mapper.registered.copy()
    free[0] = False
    problem, _ = mapper.problem(free, options=SolverOptions())
    assert covariances(problem, problem.state).sigma_scale == np.inf


def judge(mapper: Mapper, *, georeferenced: bool = False) -> str:
    free = mapper.registered.copy()
    free[0] = False
    verdict = assess_calibration(
        mapper, free_units=free, terms=(), georeferenced=georeferenced, options=SolverOptions()
    )
    return ("free: " if verdict.free else "held: ") + verdict.reason


def test_calibration_varies_where_there_is_one() -> None:
    assert judge(true_model(straight=True)).startswith("free")
    assert judge(true_model(units=40)).startswith("free")
    assert "single camera" in judge(true_model(cameras=1))


def test_without_priors_nothing_bounds_the_calibration_on_a_straight_street() -> None:
    mapper = true_model(straight=True)
    without = mapper.config.bundle_adjustment.model_copy(update={"priors": False})
    mapper.config = mapper.config.model_copy(update={"bundle_adjustment": without})
    assert judge(mapper).startswith("held")
    assert judge(mapper, georeferenced=True).startswith("free")


def test_a_curve_is_not_straight() -> None:
    assert is_straight(true_model(straight=True))
    assert not is_straight(true_model(units=40))


def test_a_cancelled_adjustment_is_no_result() -> None:
    mapper = true_model()
    with pytest.raises(CancelledError):
        adjust_poses(mapper, mapper.registered, options=SolverOptions(), cancel=lambda: True)


def test_a_unit_that_lost_its_points_loses_its_pose() -> None:
    mapper = true_model()
    mapper.is_inlier[mapper.keypoints.unit == 4] = False
    assert mapper.drop_unsupported(20).tolist() == [4]
    assert mapper.registered.sum() == UNITS - 1


def test_parallax_is_what_rotation_does_not_explain() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([-5, -3, 6], [5, 3, 20], (200, 3))
    turn = se3.exp_so3([0.02, 0.1, -0.05])
    a = points / np.linalg.norm(points, axis=1, keepdims=True)
    still, moved = points @ turn.T, (points - [0.3, 0, 0.5]) @ turn.T
    assert parallax_rad(a, still / np.linalg.norm(still, axis=1, keepdims=True)) < 1e-7
    assert 0.005 < parallax_rad(a, moved / np.linalg.norm(moved, axis=1, keepdims=True)) < 0.1


@pytest.mark.parametrize(
    ("registered", "words"), [(2, "images link only 2 of 10 units"), (UNITS, "the drive has none that are usable")]
)
def test_one_camera_without_a_scale_says_what_is_missing(registered: int, words: str) -> None:
    mapper = true_model(cameras=1)
    mapper.forget(np.arange(registered, UNITS))
    with pytest.raises(ReconstructionError, match=words):
        refine(mapper)


def test_rough_poses_place_the_model_and_a_single_one_does_not() -> None:
    mapper = true_model()
    rough_from_model = se3.transform(se3.exp_so3([0.0, 0.0, 1.0]), [50.0, -20.0, 3.0])
    rough = rough_from_model @ mapper.state.world_from_rig
    one = np.full_like(rough, np.nan)
    one[3] = rough[3]
    assert not place_by_rough_poses(mapper, one, 0.5)
    assert place_by_rough_poses(mapper, rough, 0.5)
    np.testing.assert_allclose(mapper.state.world_from_rig, rough, atol=1e-6)


def test_one_cameras_scale_comes_from_rough_poses_that_reach_far_enough() -> None:
    mapper = true_model(cameras=1)
    rough = mapper.state.world_from_rig.copy()
    scale_with_baselines(mapper, 0.4)
    assert not place_by_rough_poses(mapper, rough, 100.0)
    assert place_by_rough_poses(mapper, rough, 0.1)
    off = np.linalg.norm(mapper.state.unit_position_m - rough[:, :3, 3], axis=1)
    assert 0.0 < off.max() < 0.5


def test_points_without_an_angle_are_told_from_those_with_one() -> None:
    mapper = true_model()
    solved = np.flatnonzero(mapper.triangulated)
    expected = []
    for track in solved:
        keypoints = mapper.tracks.keypoints[mapper.tracks.first[track] : mapper.tracks.first[track + 1]]
        keypoints = keypoints[mapper.is_inlier[keypoints]]
        turn = mapper.state.unit_rotation[mapper.keypoints.unit[keypoints]]
        camera = mapper.state.camera_rotation[mapper.keypoints.camera[keypoints]]
        rays = (turn @ camera @ mapper.keypoints.rays[keypoints][..., None])[..., 0]
        expected.append(np.degrees(np.arccos(np.clip(rays @ rays.T, -1, 1).min())))
    expected = np.array(expected)
    clear = np.abs(expected - 1.0) > 1e-6
    found = mapper.triangulator.has_angle(mapper.state, mapper.tracks, mapper.is_inlier, solved)
    np.testing.assert_array_equal(found[clear], expected[clear] > 1.0)
    # Every point has one; with fewer observations some have not.
    assert found.all()
    mapper.is_inlier[mapper.keypoints.unit > 1] = False
    fewer = mapper.triangulator.has_angle(mapper.state, mapper.tracks, mapper.is_inlier, solved)
    assert 0 < fewer.sum() < len(fewer)


def test_the_scale_comes_to_where_the_terms_cost_least() -> None:
    mapper = true_model(units=6)
    terms = [calibration_prior(mapper)]
    scale_with_baselines(mapper, 1.15)
    assert terms[0].cost(mapper.state) > 0.1
    before = mapper.state.points_m.copy()
    resolve_scale(mapper, terms)
    assert scale_of_baselines(mapper)[0] == pytest.approx(1.0, abs=1e-4)
    assert np.abs(mapper.state.points_m - before).max() > 0.1


@pytest.mark.parametrize("sigma_m", [1e-4, 10.0])
def test_baselines_are_held_where_the_scene_follows_them(sigma_m: float) -> None:
    """Where positions know its scale it does not: of baselines that are held, images would want another scene."""
    mapper = true_model(cameras=2)
    way_m = np.linalg.norm(np.ptp(mapper.state.unit_position_m, axis=0))
    free = np.arange(UNITS) > 0
    positions = PositionPrior(
        unit=np.arange(UNITS),
        position_m=mapper.state.unit_position_m.copy(),
        sigma_m=np.full((UNITS, 3), sigma_m),
        lever_arm_m=np.zeros(3),
    )
    terms = [calibration_prior(mapper), positions]
    problem, _ = mapper.problem(
        free, free_cameras=np.ones(2, dtype=np.bool_), terms=terms, options=SolverOptions(sigma_px=30.0)
    )
    certainty = covariances(problem, problem.state, shared_errors=False)
    camera_m = mapper.state.camera_position_m
    camera_m[:] = camera_m.mean(0) + 1.1 * (camera_m - camera_m.mean(0))
    before_px = errors_px(mapper)
    hold_baselines(mapper, certainty, most_behind_px=0.3)
    longer = np.linalg.norm(np.ptp(mapper.state.unit_position_m, axis=0)) / way_m
    assert np.abs(errors_px(mapper) - before_px).max() < 2.0
    if sigma_m < 1.0:
        assert longer == pytest.approx(1.0)
        assert scale_of_baselines(mapper)[0] == pytest.approx(1.0 / 1.1)
    else:
        assert 1.0 / 1.1 - 0.01 < longer < 1.0 / 1.1 + 0.03
        assert scale_of_baselines(mapper)[0] == pytest.approx(1.0)


def test_a_camera_that_observes_nothing_leaves_the_others_as_certain_as_they_are() -> None:
    mapper = true_model(cameras=4)
    mapper.is_inlier &= mapper.keypoints.camera != 3
    problem, _ = mapper.problem(
        np.arange(UNITS) > 0,
        free_cameras=np.ones(4, dtype=np.bool_),
        terms=[calibration_prior(mapper)],
        options=SolverOptions(sigma_px=0.5),
    )
    certainty = of_cameras_alone(mapper, covariances(problem, problem.state, shared_errors=False))
    sigma_deg = np.degrees(certainty.sigma_camera[:, :3])
    assert (sigma_deg[:3] < 0.03).all()  # beside a mean of all four, 0.05 to 0.06
    assert (sigma_deg[3] > 0.05).all()


def test_images_of_a_stereo_pair_know_the_scale_but_for_its_baseline() -> None:
    mapper = true_model(cameras=2)
    problem, _ = mapper.problem(
        np.arange(UNITS) > 0,
        free_cameras=np.ones(2, dtype=np.bool_),
        terms=[calibration_prior(mapper)],
        options=SolverOptions(sigma_px=0.5),
    )
    certainty = covariances(problem, problem.state, shared_errors=False)
    held, _ = mapper.problem(np.arange(UNITS) > 0, options=SolverOptions(sigma_px=0.5))
    of_held = covariances(held, held.state).sigma_scale
    assert certainty.sigma_scale > 0.1
    assert of_held < sigma_scale_of_images(mapper, certainty) < 0.03
