from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.bundle_adjustment import priors
from mrasfm_engine.bundle_adjustment.priors import (
    CalibrationPrior,
    CameraPosePrior,
    PositionPrior,
    RotationPrior,
    ScalePrior,
    Term,
    UprightPrior,
    robust_gauge_weights,
)
from mrasfm_engine.bundle_adjustment.problem import UNIT_DOF, Layout
from mrasfm_engine.bundle_adjustment.reduced_camera_system import Extra
from mrasfm_engine.bundle_adjustment.solver import Report, Termination, solve
from mrasfm_engine.geometry import se3
from mrasfm_engine.scene.state import State
from tests.helpers.small_problems import (
    Case,
    focal_prior,
    make_case,
    moved,
    numeric_gradient,
    perturbed,
    rotation_errors_deg,
    with_focal,
)

UNITS, CAMERAS = 4, 5


def free_case(seed: int = 0, *, cameras: int = CAMERAS) -> tuple[Case, State]:
    case = make_case(
        units=UNITS,
        cameras=cameras,
        points=120,
        free_units=[False, True, True, True],
        free_cameras=[True] * (cameras - 1) + [False],
        free_focal=True,
        seed=seed,
    )
    rng = np.random.default_rng(seed + 10)
    return case, perturbed(
        case.truth, rng, units=range(UNITS), cameras=range(cameras), camera_deg=0.2, camera_m=0.01, focal=0.003
    )


def calibration_prior(truth: State, **kwargs: float) -> CalibrationPrior:
    cameras = len(truth.camera_rotation)
    return CalibrationPrior(
        rotation=truth.camera_rotation,
        position_m=truth.camera_position_m,
        sigma_rotation_rad=np.full(cameras, np.radians(2.0)),
        sigma_translation_m=np.full(cameras, 0.05),
        **kwargs,
    )


def added(term: Term, state: State, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Matrix and gradient that a term adds."""
    extra = Extra.none(layout)
    term.add_to(state, layout, extra)
    return extra.matrix, extra.gradient


def camera_offsets(layout: Layout, cameras: np.ndarray) -> np.ndarray:
    """First index of each (free) camera's step."""
    return UNIT_DOF * layout.num_units + layout.camera_dof * layout.camera_slot[cameras]


def check_gradient(term: Term, case: Case, state: State, *, rtol: float = 1e-5) -> np.ndarray:
    """The term's gradient against differences of its cost; returns its Gauss-Newton matrix."""
    n = case.problem.layout.size
    h, g = added(term, state, case.problem.layout)
    numeric = numeric_gradient(case.problem, state, range(n), term.cost)
    assert np.abs(g).max() > 1e-3  # there is something to compare
    np.testing.assert_allclose(g, numeric, rtol=rtol, atol=rtol * np.abs(g).max())
    np.testing.assert_allclose(h, h.T)
    assert np.linalg.eigvalsh(h).min() > -1e-9 * max(1.0, np.abs(h).max())
    return h


def check_curvature(residuals: np.ndarray, h: np.ndarray, rtol: float = 1e-4) -> None:
    """The Gauss-Newton matrix against J'J of numeric residual derivatives (rows, n)."""
    np.testing.assert_allclose(h, residuals.T @ residuals, rtol=rtol, atol=rtol * np.abs(h).max())


def test_camera_pose_prior_holds_each_direction_by_its_own_sigma_and_the_gauge_by_their_mean() -> None:
    """Camera 1 is of another rig, and the last does not vary."""
    case, state = free_case()
    chosen = np.array([0, 2, 3, 4])
    rng = np.random.default_rng(3)
    sigma = np.column_stack([np.radians(rng.uniform(0.02, 2.0, (4, 3))), rng.uniform(0.001, 0.05, (4, 3))])
    prior = CameraPosePrior(
        camera=chosen,
        rotation=case.truth.camera_rotation[chosen],
        position_m=case.truth.camera_position_m[chosen],
        sigma=sigma,
        held=np.zeros((4, 6), dtype=np.bool_),
    )
    check_gradient(replace(prior, held=rng.random((4, 6)) < 0.4), case, state)
    h = check_gradient(prior, case, state)
    other = int(camera_offsets(case.problem.layout, np.array([1]))[0])
    assert np.abs(h[other : other + 7]).max() == 0
    assert prior.cost(case.truth) < 1e-20
    at_truth = added(prior, case.truth, case.problem.layout)[0]
    rows = camera_offsets(case.problem.layout, chosen[:3])[:, None] + np.arange(6)
    stiff = 1.0 / sigma[:3] ** 2 + priors.GAUGE_STIFFNESS / 4 / sigma.max(0) ** 2
    np.testing.assert_allclose(np.diag(at_truth)[rows], stiff)
    # Corrections that cancel cost what they are, the same correction of all is held.
    step, turn = np.zeros(case.problem.layout.size), sigma[:2].max(0)
    step[rows[0]], step[rows[1]] = turn, -turn
    assert step @ at_truth @ step == pytest.approx(((turn / sigma[:2]) ** 2).sum())
    step[rows[1]] = turn
    assert step @ at_truth @ step > 1e5


@pytest.mark.parametrize("lever_arm_m", [[0.0, 0.0, 0.0], [-0.8, 0.3, 1.9]])
def test_position_prior_differentiates_its_lever_arm(lever_arm_m: list[float]) -> None:
    case, state = free_case()
    arm = np.array(lever_arm_m)
    prior = PositionPrior(
        unit=np.array([0, 1, 3]),
        position_m=(case.truth.unit_position_m + case.truth.unit_rotation @ arm)[[0, 1, 3]] + [0.3, -0.2, 0.1],
        sigma_m=np.array([[0.1, 0.1, 0.2], [0.5, 0.4, 0.8], [0.05, 0.1, 0.1]]),
        lever_arm_m=arm,
    )
    check_gradient(prior, case, state)
    # The unit without a measurement and the fixed one feel nothing.
    h, g = added(prior, state, case.problem.layout)
    assert not g[6:12].any()
    assert not g[18:].any()
    assert h[:6, :6].any()
    assert bool(h[:3, :3].any()) == bool(arm.any())


def test_position_prior_is_zero_where_the_antenna_was_measured() -> None:
    case, _ = free_case()
    arm = np.array([-0.5, 0.1, 2.0])
    prior = PositionPrior(
        unit=np.arange(UNITS),
        position_m=case.truth.unit_position_m + case.truth.unit_rotation @ arm,
        sigma_m=np.full((UNITS, 3), 0.1),
        lever_arm_m=arm,
    )
    assert prior.cost(case.truth) == pytest.approx(0.0, abs=1e-20)
    without_arm = replace(prior, lever_arm_m=np.zeros(3))
    assert without_arm.cost(case.truth) > 10


def test_one_wrong_position_loses_its_pull() -> None:
    case, _ = free_case()

    def pull(off_m: float) -> float:
        prior = PositionPrior(
            unit=np.array([1]),
            position_m=case.truth.unit_position_m[[1]] + [off_m, 0, 0],
            sigma_m=np.full((1, 3), 0.1),
            lever_arm_m=np.zeros(3),
        )
        _, g = added(prior, case.truth, case.problem.layout)
        return float(np.abs(g[3]))

    assert 5 < pull(0.1) < 10
    assert 0 < pull(50.0) < 0.1 * pull(0.1)


def test_scale_prior_asks_for_one_combination_of_rotations() -> None:
    case, state = free_case()
    rng = np.random.default_rng(0)
    cameras = len(case.truth.camera_rotation)
    prior = ScalePrior(
        rotation=case.truth.camera_rotation, scale_by_rotation=rng.normal(size=(cameras, 3)), log_scale=0.0, sigma=0.01,
        sigma_scale=0.01, sigma_of_corrections=0.0, share=0.0,
    )  # fmt: skip
    h = check_gradient(prior, case, state)
    assert np.linalg.matrix_rank(h) == 1
    assert prior.cost(state) > 0.01
    assert prior.cost(case.truth) == pytest.approx(0.0, abs=1e-20)
    there = replace(prior, log_scale=prior.log_scale_of(state))
    check_gradient(there, case, case.truth)
    assert there.cost(state) == pytest.approx(0.0, abs=1e-20)
    assert there.cost(case.truth) == pytest.approx(prior.cost(state))


def test_rotation_prior() -> None:
    case, state = free_case()
    measured = se3.exp_so3(0.05 * np.random.default_rng(0).normal(size=(3, 3))) @ case.truth.unit_rotation[[0, 1, 3]]
    prior = RotationPrior(unit=np.array([0, 1, 3]), rotation=measured, sigma_rad=np.array([0.01, 0.03, 0.02]))
    h = check_gradient(prior, case, state)
    assert h[:3, :3].any()
    assert not h[3:6, 3:6].any()
    assert prior.cost(replace(case.truth, unit_rotation=case.truth.unit_rotation)) > 1
    exact = replace(prior, rotation=case.truth.unit_rotation[[0, 1, 3]])
    assert exact.cost(case.truth) == pytest.approx(0.0, abs=1e-20)


def test_upright_prior() -> None:
    case, state = free_case()
    prior = UprightPrior(unit=np.array([0, 1, 2]), sigma_roll_rad=0.03, sigma_pitch_rad=0.08)
    h = check_gradient(prior, case, state)

    def residuals(at: State) -> np.ndarray:
        left_and_forward = at.unit_rotation[[0, 1, 2]][:, 2, [1, 0]]
        return (left_and_forward / [0.03, 0.08] / np.sqrt(3)).ravel()

    check_curvature(numeric_jacobian(residuals, case, state), h)
    assert not h[12:18, 12:18].any()  # unit 3 is not concerned
    level = replace(case.truth, unit_rotation=se3.exp_so3(np.arange(4.0)[:, None] * [0, 0, 1]))
    assert prior.cost(level) == pytest.approx(0.0, abs=1e-20)  # headings cost nothing
    rolled = replace(case.truth, unit_rotation=np.tile(se3.exp_so3([0.03, 0, 0]), (4, 1, 1)))
    assert prior.cost(rolled) == pytest.approx(0.5, rel=0.01)  # one measurement, however many units


def numeric_jacobian(residuals, case: Case, state: State) -> np.ndarray:  # type: ignore[no-untyped-def]
    n = case.problem.layout.size
    columns = []
    for k in range(n):
        step = np.zeros(n + state.points_m.size)
        step[k] = 1e-6
        after, before = (residuals(moved(case.problem, state, s)) for s in (step, -step))
        columns.append((after - before) / 2e-6)
    return np.stack(columns, 1)


def test_focal_prior() -> None:
    case, state = free_case()
    prior = focal_prior(case.truth.camera_params, np.full(CAMERAS, 0.002))
    h = check_gradient(prior, case, state)
    free = 6 * 3 + 7 * np.arange(CAMERAS - 1) + 6
    np.testing.assert_allclose(np.diagonal(h)[free], 1 / 0.002**2)
    assert np.count_nonzero(h) == CAMERAS - 1
    assert prior.cost(case.truth) == 0.0
    longer = case.truth.camera_params.copy()
    longer[0, :2] *= np.exp(0.002)
    assert prior.cost(replace(case.truth, camera_params=longer)) == pytest.approx(0.5)


def test_focal_prior_adds_nothing_where_focal_lengths_are_held() -> None:
    case, state = free_case()
    layout = with_focal(case.problem.layout, False)
    prior = focal_prior(case.truth.camera_params, np.full(CAMERAS, 0.002))
    h, g = added(prior, state, layout)
    assert not h.any()
    assert not g.any()


def test_calibration_prior_without_its_gauge(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(priors, "GAUGE_STIFFNESS", 0.0)
    case, state = free_case()
    prior = calibration_prior(case.truth)
    h = check_gradient(prior, case, state)
    offsets = 18 + 7 * np.arange(CAMERAS - 1)
    assert 0.9 / np.radians(2.0) ** 2 < h[offsets[0], offsets[0]] <= 1 / np.radians(2.0) ** 2
    assert 0.9 / 0.05**2 < h[offsets[0] + 3, offsets[0] + 3] <= 1 / 0.05**2
    assert not h[:18].any()
    assert prior.cost(case.truth) == 0.0


def test_calibration_prior_of_held_directions(monkeypatch: pytest.MonkeyPatch) -> None:
    """They pull harder than the others: then it matters how a step turns the rotation vector of a correction."""
    monkeypatch.setattr(priors, "GAUGE_STIFFNESS", 0.0)
    case, state = free_case()
    held = np.random.default_rng(2).random((CAMERAS, 6)) < 0.3
    h = check_gradient(replace(calibration_prior(case.truth), held=held), case, state)
    pull = np.diagonal(h)[18:24]
    assert held[0, 3:].tolist() == [True, False, False]
    assert 0.9 / 0.02**2 < pull[3] / pull[4] < 1.1 / 0.02**2


def test_what_is_held_comes_back_from_wherever_it_has_got() -> None:
    """A camera that images of a short drive have made slide 0.3 m ahead is no outlier that its prior gives up."""
    case = make_case(
        units=UNITS, cameras=CAMERAS, points=120, free_units=[False] * UNITS, free_cameras=[True] * CAMERAS
    )
    given = case.truth.camera_position_m.copy()
    given[2, 0] -= 0.3
    prior = replace(calibration_prior(case.truth), position_m=given).with_weights(case.truth)
    doubtful = replace(case.problem.options, sigma_px=2.0)
    loose, _ = solve(replace(case.problem, terms=[prior], options=doubtful))
    assert loose.camera_position_m[2, 0] > given[2, 0] + 0.2
    held = np.repeat([[False, True]], 3, axis=1).repeat(CAMERAS, axis=0)
    solution, _ = solve(replace(case.problem, state=loose, terms=[replace(prior, held=held)], options=doubtful))
    assert np.abs(solution.camera_position_m - given).max() < 0.01


def test_calibration_priors_gauge() -> None:
    case, state = free_case()
    prior = calibration_prior(case.truth)
    h = check_gradient(prior, case, state)
    together = np.zeros(case.problem.layout.size)
    together[18 + 7 * np.arange(CAMERAS - 1) + 3] = 1.0  # all (free) cameras along x
    apart = np.zeros_like(together)
    apart[18 + 7 * np.arange(CAMERAS - 1) + 3] = [1.0, -1.0, 1.0, -1.0]
    stiffness = (together @ h @ together) / (apart @ h @ apart)
    assert stiffness > 1e4


def test_usual_cameras_weigh_alike() -> None:
    rng = np.random.default_rng(4)
    corrections = rng.normal(size=(6, 6))
    weights = robust_gauge_weights(corrections)
    assert weights.min() > 0.9
    corrections[3] += 8.0
    weights = robust_gauge_weights(corrections)
    assert weights[3] < 0.01
    assert np.delete(weights, 3).min() > 0.9


def test_calibration_weights_single_out_the_bad_camera() -> None:
    case, _ = free_case()
    turned = case.truth.camera_rotation.copy()
    turned[2] = se3.exp_so3(np.radians([0.0, 0.0, 30.0])) @ turned[2]
    weights = calibration_prior(case.truth).with_weights(replace(case.truth, camera_rotation=turned)).gauge_weights
    assert weights is not None
    assert weights[2] < 0.1
    assert (np.delete(weights, 2) > 0.9).all()


def test_a_camera_that_is_turned_keeps_its_place() -> None:
    truth = free_case()[0].truth
    term = calibration_prior(truth)
    turned, moved_m = truth.camera_rotation.copy(), truth.camera_position_m.copy()
    turned[1] = se3.exp_so3(np.array([0.0, 30.0 * term.sigma_rotation_rad[1], 0.0])) @ turned[1]
    moved_m[2, 0] += 30.0 * term.sigma_translation_m[2]
    state = replace(truth, camera_rotation=turned, camera_position_m=moved_m)
    np.testing.assert_allclose(term.weights_of_places(state)[[1, 2]], [1.0, 0.01], atol=1e-3)
    # Of the prior ten times the sigma is left of what is thirty sigmas off, and of all else what was declared.
    declared = np.repeat(np.stack([term.sigma_rotation_rad, term.sigma_translation_m], 1), 3, axis=1)
    expected = np.ones((len(declared), 6))
    expected[1, :3] = expected[2, 3:] = 10.0
    np.testing.assert_allclose(term.sigmas_left(state) / declared, expected, rtol=0.01)
    # A step of the turned camera costs what it costs one that is as given.
    step_m = np.zeros_like(moved_m)
    step_m[[0, 1], 0] = np.array([-1.0, 1.0]) * term.sigma_translation_m[:2]  # the mean is held
    dearer = [
        term.cost(replace(one, camera_position_m=one.camera_position_m + step_m)) - term.cost(one)
        for one in (truth, state)
    ]
    assert dearer[1] == pytest.approx(dearer[0], rel=0.01)


def test_corrections_are_in_rig_axes() -> None:
    case, _ = free_case()
    step = se3.exp_so3(np.radians([0.1, 0.2, -0.3]))
    state = replace(
        case.truth,
        camera_rotation=step @ case.truth.camera_rotation,
        camera_position_m=case.truth.camera_position_m + np.array([0.01, 0.02, 0.03]),
    )
    expected = np.concatenate([np.radians([0.1, 0.2, -0.3]), [0.01, 0.02, 0.03]])
    corrections = calibration_prior(case.truth).corrections(state)
    np.testing.assert_allclose(corrections, np.tile(expected, (CAMERAS, 1)), atol=1e-12)


def gauge_case(seed: int = 0) -> Case:
    return make_case(
        units=8,
        cameras=6,
        points=900,
        noise_px=0.3,
        free_units=[False] + [True] * 7,
        free_cameras=[True] * 6,
        seed=seed,
    )


def test_moving_all_cameras_together_changes_no_image_and_is_held() -> None:
    case = gauge_case()
    # Every rig_from_cam moves by one transform, every unit by its inverse.
    shift = se3.transform(se3.exp_so3(np.radians([0.3, -0.5, 0.8])), [0.03, -0.02, 0.04])
    cameras, units = shift @ case.truth.rig_from_cam, case.truth.world_from_rig @ se3.inverse(shift)
    other = replace(
        case.truth,
        unit_rotation=np.ascontiguousarray(units[:, :3, :3]),
        unit_position_m=np.ascontiguousarray(units[:, :3, 3]),
        camera_rotation=np.ascontiguousarray(cameras[:, :3, :3]),
        camera_position_m=np.ascontiguousarray(cameras[:, :3, 3]),
    )
    bare = case.problem
    assert bare.cost(other) == pytest.approx(bare.cost(case.truth), rel=1e-9)
    prior = calibration_prior(case.truth)
    solution, report = solve(replace(bare, terms=[prior]))
    assert report.final_cost < report.initial_cost
    corrections = prior.corrections(solution)
    mean = corrections.mean(0)
    assert np.abs(corrections[:, :3]).max() > 1e-6  # cameras did move, one by one
    assert np.degrees(np.abs(mean[:3]).max()) < 1e-3
    assert np.abs(mean[3:]).max() < 1e-4


def solve_with_bad_camera(axis: int, error_deg: float) -> tuple[Case, CalibrationPrior, State, Report]:
    """Camera 3 was written down wrong in the manifest; the search starts from there."""
    case = gauge_case(seed=axis)
    given = case.truth.camera_rotation.copy()
    given[3] = se3.exp_so3(np.radians(error_deg) * np.eye(3)[axis]) @ given[3]
    prior = replace(calibration_prior(case.truth), rotation=given)
    problem = replace(case.problem, state=replace(case.truth, camera_rotation=given), terms=[prior])
    solution, report = solve(problem)
    for _ in range(2):  # as the engine does: the gauge's weights are renewed between solves
        prior = prior.with_weights(solution)
        solution, report = solve(replace(problem, state=solution, terms=[prior]))
    return case, prior, solution, report


@pytest.mark.parametrize("axis", range(3))
def test_one_bad_camera_is_found_and_the_others_keep_their_places_to_each_other(axis: int) -> None:
    case, prior, solution, _ = solve_with_bad_camera(axis, 3.0)
    relative = np.swapaxes(solution.camera_rotation[[0]], 1, 2) @ solution.camera_rotation
    true_relative = np.swapaxes(case.truth.camera_rotation[[0]], 1, 2) @ case.truth.camera_rotation
    assert 1e-4 < rotation_errors_deg(relative, true_relative).max() < 0.15
    corrections = np.degrees(np.linalg.norm(prior.corrections(solution)[:, :3], axis=1))
    assert 2.5 < corrections[3] < 3.3
    assert np.delete(corrections, 3).max() < 0.6


@pytest.mark.parametrize("axis", range(3))
def test_one_bad_camera_does_not_pull_the_others(axis: int) -> None:
    case, _, solution, _ = solve_with_bad_camera(axis, 3.0)
    errors = rotation_errors_deg(solution.camera_rotation, case.truth.camera_rotation)
    assert 1e-4 < errors.max() < 0.1


def test_a_very_bad_camera_does_not_keep_the_solver_from_converging() -> None:
    case, _, solution, report = solve_with_bad_camera(2, 10.0)
    assert report.termination is Termination.CONVERGED
    assert rotation_errors_deg(solution.camera_rotation, case.truth.camera_rotation)[3] < 1.0


def test_a_covariance_without_the_gauge_has_no_common_motion() -> None:
    truth = free_case()[0].truth
    weights = np.array([1.0, 2.0, 1.0, 0.5, 0.0])
    sigma_m = np.linspace(0.01, 0.05, CAMERAS)
    prior = replace(calibration_prior(truth), gauge_weights=weights, sigma_translation_m=sigma_m)
    sigma = np.repeat(np.stack([prior.sigma_rotation_rad, prior.sigma_translation_m], 1), 3, axis=1).ravel()
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6 * CAMERAS, 6 * CAMERAS))
    common = np.tile(np.eye(6), (CAMERAS, 1)) * sigma[:, None]
    left = prior.without_gauge(root @ root.T)
    np.testing.assert_allclose(prior.without_gauge(root @ root.T + 100.0 * common @ common.T), left)
    mean = np.kron(weights / weights.sum(), np.eye(6)) / sigma
    np.testing.assert_allclose(mean @ left @ mean.T, 0.0, atol=1e-9)
    assert (np.diagonal(left) > 0).all()
