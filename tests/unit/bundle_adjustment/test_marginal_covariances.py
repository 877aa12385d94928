from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.bundle_adjustment.marginal_covariances import covariances
from mrasfm_engine.bundle_adjustment.observability_analysis import assess_directions
from mrasfm_engine.bundle_adjustment.priors import CalibrationPrior, PositionPrior
from mrasfm_engine.bundle_adjustment.problem import Layout, Observations
from mrasfm_engine.bundle_adjustment.solver import SolverOptions, solve
from mrasfm_engine.geometry.alignment import align_similarity
from mrasfm_engine.scene.state import State
from tests.helpers.small_problems import (
    Case,
    dense_normal_equations,
    focal_prior,
    make_case,
    perturbed,
    project,
    with_focal,
)


def prior_of(state: State, *, rotation_deg: float = 0.5, translation_m: float = 0.01) -> CalibrationPrior:
    cameras = len(state.camera_rotation)
    return CalibrationPrior(
        rotation=state.camera_rotation,
        position_m=state.camera_position_m,
        sigma_rotation_rad=np.full(cameras, np.radians(rotation_deg)),
        sigma_translation_m=np.full(cameras, translation_m),
    )


def stereo(seed: int, *, units: int = 5, points: int = 200) -> Case:
    return make_case(
        units=units,
        cameras=2,
        points=points,
        noise_px=0.5,
        free_units=[False] + [True] * (units - 1),
        free_cameras=[True, True],
        seed=seed,
        options=SolverOptions(sigma_px=0.5),
    )


def test_points_that_very_many_units_see_are_not_taken_for_known() -> None:
    """Every pair of the units that see a point is coupled: one that were not would be tied to a known point."""
    units, points = 150, 12
    case = make_case(units=units, cameras=1, points=points, options=SolverOptions(sigma_px=0.5))
    truth = case.truth
    ahead_m = truth.unit_position_m[-1] - truth.unit_position_m[0]
    beside = np.random.default_rng(0).normal(size=(points, 3)) * 0.2 * np.linalg.norm(ahead_m)
    truth = replace(truth, points_m=truth.unit_position_m[-1] + ahead_m + beside)
    unit, point = np.tile(np.arange(units), points), np.repeat(np.arange(points), units)
    camera = np.zeros_like(unit)
    pixels = project(truth, case.problem.camera_kind, unit, camera, point)
    problem = replace(
        case.problem,
        state=truth,
        observations=Observations(unit=unit, camera=camera, point=point, xy_px=pixels, num_points=points),
        layout=Layout.from_free(~np.isin(np.arange(units), [0, units - 1]), np.zeros(1, dtype=np.bool_)),
    )
    found = covariances(problem, truth, shared_errors=False).sigma_unit_position_m[1:-1]
    h, _ = dense_normal_equations(problem, truth)
    sigma = np.sqrt(np.diagonal(np.linalg.inv(h)))[: 6 * (units - 2)].reshape(-1, 6)[:, 3:]
    np.testing.assert_allclose(found, sigma, rtol=1e-3)


@pytest.mark.parametrize("free_focal", [False, True])
def test_covariances_are_the_inverse_of_the_full_hessian(free_focal: bool) -> None:
    case = stereo(0, units=3, points=120)
    problem = replace(
        case.problem,
        layout=with_focal(case.problem.layout, free_focal),
        terms=[
            prior_of(case.truth),
            focal_prior(case.truth.camera_params, np.full(2, 0.002)),
        ],
    )
    found = covariances(problem, case.truth, shared_errors=False)
    h, _ = dense_normal_equations(problem, case.truth)
    free = np.setdiff1d(np.arange(len(h)), problem.layout.held())
    scale = 1 / np.sqrt(np.diagonal(h)[free])
    covariance = np.zeros_like(h)
    covariance[np.ix_(free, free)] = np.linalg.inv(h[np.ix_(free, free)] * np.outer(scale, scale)) * np.outer(
        scale, scale
    )
    sigma = np.sqrt(np.maximum(np.diagonal(covariance), 0))
    np.testing.assert_allclose(found.sigma_unit_position_m[1:], sigma[:12].reshape(2, 6)[:, 3:], rtol=1e-3)
    np.testing.assert_allclose(found.sigma_camera[:, :7], sigma[12:26].reshape(2, 7), rtol=1e-3, atol=1e-12)
    assert np.isnan(found.sigma_unit_position_m[0]).all()
    assert (found.sigma_camera[:, 6] > 0).all() == free_focal
    centred = case.truth.unit_position_m[1:] - case.truth.unit_position_m[1:].mean(0)
    functional = np.zeros(12)
    functional.reshape(2, 6)[:, 3:] = centred / (centred**2).sum()
    assert found.sigma_scale == pytest.approx(np.sqrt(functional @ covariance[:12, :12] @ functional), rel=1e-3)
    dof = problem.layout.camera_dof
    with_poses = (functional @ covariance[:12, 12 : 12 + 2 * dof]).reshape(2, dof)[:, :6].ravel()
    np.testing.assert_allclose(found.scale_with_calibration, with_poses, rtol=1e-3, atol=1e-12)


def test_the_sigma_of_scale_is_that_of_the_baseline() -> None:
    found = covariances(replace(stereo(1).problem, terms=[prior_of(stereo(1).truth)]), stereo(1).truth)
    # The baseline of 0.5 m is the difference of two positions with 0.01 m each: 2.8 %, and the images add little.
    assert 0.02 < found.sigma_scale < 0.04
    looser = covariances(
        replace(stereo(1).problem, terms=[prior_of(stereo(1).truth, translation_m=0.02)]), stereo(1).truth
    )
    assert 1.7 < looser.sigma_scale / found.sigma_scale < 2.1


def test_the_sigma_of_scale_is_honest() -> None:
    normalised = []
    for seed in range(20):
        case = stereo(seed)
        rng = np.random.default_rng(100 + seed)
        given = perturbed(case.truth, rng, cameras=[0, 1], camera_deg=0.5, camera_m=0.01, point_m=0.02)
        problem = replace(case.problem, state=given, terms=[prior_of(given)])
        solution, _ = solve(problem)
        scale = align_similarity(solution.unit_position_m[1:], case.truth.unit_position_m[1:]).scale
        normalised.append(np.log(scale) / covariances(problem, solution).sigma_scale)
    assert 0.5 < np.std(normalised) < 2.0
    assert abs(np.mean(normalised)) < 1.0


def test_positions_are_as_uncertain_as_said_where_calibration_is_held() -> None:
    normalised = []
    for seed in range(15):
        case = make_case(units=4, cameras=3, points=250, noise_px=0.5, seed=seed, options=SolverOptions(sigma_px=0.5))
        solution, _ = solve(case.problem)
        sigma = covariances(case.problem, solution).sigma_unit_position_m[1:]
        normalised.append((solution.unit_position_m - case.truth.unit_position_m)[1:] / sigma)
    assert 0.6 < np.std(normalised) < 1.6


def test_held_calibration_leaves_nothing_to_say_of_cameras() -> None:
    case = make_case(units=4, cameras=2, points=200)
    found = covariances(case.problem, case.truth)
    assert np.isnan(found.sigma_camera).all()
    assert (found.sigma_unit_position_m[1:] > 0).all()


def test_one_free_unit_has_no_scale() -> None:
    case = make_case(units=2, cameras=2, points=200)
    assert np.isnan(covariances(case.problem, case.truth).sigma_scale)


def test_the_common_motion_and_the_scale_of_the_cameras_are_not_observed() -> None:
    """On a straight flat drive the images tell the cameras from one another, and neither their mean nor their scale."""
    case = make_case(
        units=8,
        cameras=4,
        points=700,
        straight=True,
        free_units=[False] + [True] * 7,
        free_cameras=[True] * 4,
        options=SolverOptions(sigma_px=0.5),
    )
    prior = prior_of(case.truth, rotation_deg=2.0, translation_m=0.05)
    found = covariances(replace(case.problem, terms=[prior]), case.truth, shared_errors=False)
    assert found.calibration.shape == (24, 24)
    np.testing.assert_allclose(np.sqrt(np.diagonal(found.calibration)).reshape(4, 6), found.sigma_camera[:, :6])
    verdict = assess_directions(
        found.calibration,
        position_m=case.truth.camera_position_m,
        sigma_rotation_rad=prior.sigma_rotation_rad,
        sigma_translation_m=prior.sigma_translation_m,
        placed=False,
    )
    assert verdict.observed[:, :3].all()
    assert not verdict.scale_observed
    assert verdict.sigma_scale == pytest.approx(verdict.prior_sigma_scale, rel=0.05)
    mean = np.kron(np.ones((1, 4)) / 4, np.eye(6))
    assert np.sqrt(np.diagonal(mean @ found.calibration @ mean.T))[3:].max() < 1e-3 * 0.05  # it is held


def test_positions_are_no_more_certain_than_the_scale() -> None:
    """Errors that observations share, and those of lens models, change the scene's size: all places move with it."""
    case = stereo(0, units=12)
    alone = covariances(replace(case.problem, terms=[prior_of(case.truth)]), case.truth, shared_errors=False)
    away_m = np.linalg.norm(case.truth.unit_position_m - case.truth.unit_position_m[0], axis=1)  # the first is held
    np.testing.assert_allclose(np.linalg.norm(alone.by_scale_m, axis=1), away_m, rtol=0.1)
    more = alone.with_scale_error(0.1)
    assert more.sigma_scale == pytest.approx(np.hypot(alone.sigma_scale, 0.1))
    sigma_m = np.linalg.norm(more.sigma_unit_position_m[1:], axis=1)
    assert (sigma_m > 0.9 * more.sigma_scale * away_m[1:]).all()


def test_an_error_of_one_combination_of_rotations_moves_all_cameras_as_it_lets_them() -> None:
    case = stereo(0, units=12)
    alone = covariances(replace(case.problem, terms=[prior_of(case.truth)]), case.truth, shared_errors=False)
    functional = np.zeros(12)
    functional[[2, 8]] = 1.0, -1.0  # yaw of one camera against the other
    more = alone.with_calibration_error(functional, 0.01)
    left = functional @ alone.calibration @ functional
    assert functional @ more.calibration @ functional == pytest.approx(left + 0.01**2)
    np.testing.assert_allclose(np.sqrt(np.diagonal(more.calibration)).reshape(2, 6), more.sigma_camera[:, :6])
    assert (more.sigma_camera[:, 2] > 0.004).all()
    # What the combination says nothing of is as certain as before.
    other = np.zeros(12)
    other[3] = 1.0
    other = other - functional * (functional @ alone.calibration @ other) / left
    assert other @ more.calibration @ other == pytest.approx(other @ alone.calibration @ other)
    assert alone.with_calibration_error(0.0 * functional, 0.01) is alone


def test_an_error_of_the_scale_moves_what_positions_leave_open() -> None:
    """Positions at the beginning hold it, and all behind goes farther away."""
    case = stereo(0, units=12)
    few = np.arange(4)
    known = PositionPrior(
        unit=few,
        position_m=case.truth.unit_position_m[few],
        sigma_m=np.full((4, 3), 0.01),
        lever_arm_m=np.zeros(3),
    )
    layout = replace(case.problem.layout, unit_slot=np.arange(12), num_units=12)
    problem = replace(case.problem, layout=layout, terms=[prior_of(case.truth), known])
    moved_m = np.linalg.norm(covariances(problem, case.truth, shared_errors=False).by_scale_m, axis=1)
    way_m = np.linalg.norm(case.truth.unit_position_m[-1] - case.truth.unit_position_m[0])
    assert moved_m[:4].max() < 0.35 * way_m
    assert moved_m[-1] > 0.75 * way_m
    assert (np.diff(moved_m[4:]) > 0.0).all()
