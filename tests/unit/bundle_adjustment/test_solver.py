from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.bundle_adjustment import solver
from mrasfm_engine.bundle_adjustment.anderson_acceleration import MAX_FACTOR, AndersonAcceleration
from mrasfm_engine.bundle_adjustment.priors import CalibrationPrior
from mrasfm_engine.bundle_adjustment.problem import Layout, Observations
from mrasfm_engine.bundle_adjustment.solver import Problem, SolverOptions, Termination, solve
from mrasfm_engine.scene.state import State
from tests.helpers.small_problems import (
    Case,
    focal_prior,
    make_case,
    perturbed,
    position_errors_m,
    rotation_errors_deg,
    with_focal,
)

FIRST_FIXED = [False] + [True] * 7


def rms(v: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(v))))


def calibration_prior(state: State, *, rotation_deg: float = 2.0, translation_m: float = 0.05) -> CalibrationPrior:
    cameras = len(state.camera_rotation)
    return CalibrationPrior(
        rotation=state.camera_rotation,
        position_m=state.camera_position_m,
        sigma_rotation_rad=np.full(cameras, np.radians(rotation_deg)),
        sigma_translation_m=np.full(cameras, translation_m),
    )


def drive(**kwargs: object) -> Case:
    return make_case(**{"units": 8, "cameras": 6, "points": 800, "free_units": FIRST_FIXED, **kwargs})


def test_exact_observations_are_recovered_exactly() -> None:
    case = drive(noise_px=0.0)
    start = perturbed(case.truth, np.random.default_rng(1), units=range(1, 8))
    assert position_errors_m(start, case.truth).max() > 0.1
    options = SolverOptions(function_tolerance=1e-12, decrement_tolerance=0.0)
    solution, report = solve(replace(case.problem, state=start, options=options))
    assert position_errors_m(solution, case.truth).max() < 1e-5
    assert rotation_errors_deg(solution.unit_rotation, case.truth.unit_rotation).max() < 1e-5
    assert report.final_cost < 1e-6 < report.initial_cost


def test_a_step_that_is_short_for_its_damping_is_no_convergence() -> None:
    case = drive(noise_px=0.5)
    start = perturbed(case.truth, np.random.default_rng(1), units=range(1, 8))
    options = SolverOptions(function_tolerance=0.0, max_iterations=100)
    best, _ = solve(replace(case.problem, state=start, options=options))
    slow = replace(options, initial_damping=1e7)
    solution, report = solve(replace(case.problem, state=start, options=slow))
    assert report.termination is Termination.CONVERGED
    assert 0 < position_errors_m(solution, best).max() < 1e-3


def test_extrapolated_steps_come_to_the_same_minimum_sooner(monkeypatch: pytest.MonkeyPatch) -> None:
    # Errors beyond the scale of the loss, as in real images: there it is far less steep than its weights say.
    case = drive(noise_px=2.0)
    start = perturbed(case.truth, np.random.default_rng(1), units=range(1, 8), unit_m=0.05, unit_deg=0.2)
    options = SolverOptions(function_tolerance=0.0, decrement_tolerance=1e-4, max_iterations=100)
    problem = replace(case.problem, state=start, options=options)
    solution, report = solve(problem)
    monkeypatch.setattr(AndersonAcceleration, "update_for", lambda self, step, gradient: step)
    as_they_are, slower = solve(problem)
    assert report.termination is slower.termination is Termination.CONVERGED
    assert report.iterations <= 0.8 * slower.iterations
    np.testing.assert_allclose(report.final_cost, slower.final_cost, rtol=1e-4)  # points are between their weights
    assert 0 < position_errors_m(solution, as_they_are).max() < 0.05 * position_errors_m(solution, case.truth).max()


def test_steps_that_shrink_by_their_own_factors_are_extrapolated_to_where_they_end() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    taken_for = root @ root.T  # the normal equations, which take the cost for steeper than it is
    values, vectors = np.linalg.eigh(taken_for)
    half = vectors @ np.diag(np.sqrt(values))
    turn = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    information = half @ turn @ np.diag([1.0, 1.0, 0.9, 0.9, 0.3, 0.3]) @ turn.T @ half.T
    start = rng.normal(size=6)

    def off(acceleration: AndersonAcceleration | None, steps: int) -> float:
        at = start
        for _ in range(steps):
            gradient = information @ at
            step = -np.linalg.solve(taken_for, gradient)
            update = step if acceleration is None else acceleration.update_for(step, gradient)
            if acceleration is not None:
                acceleration.record(step, gradient, update)
            at = at + update
        return float(at @ information @ at)

    # The first step leaves nothing of one direction in three; the factors of the others are known after two more.
    assert off(AndersonAcceleration(), 4) < 1e-12 * off(None, 0)
    assert off(None, 4) > 0.01 * off(None, 0)


@pytest.mark.parametrize("rate", [-0.5, 0.6, 0.95, 1.0, 1.3])
def test_a_step_is_extrapolated_where_its_series_ends(rate: float) -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    information, first = root @ root.T, rng.normal(size=6)
    acceleration = AndersonAcceleration()
    gradient = -information @ first
    assert acceleration.update_for(first, gradient) is first
    acceleration.record(first, gradient, first)
    update = acceleration.update_for(rate * first, rate * gradient)
    # 1 + rate + rate^2 + ... of steps that shrink; of others two tell little.
    np.testing.assert_allclose(update, rate * first / (1.0 - rate) if rate < 0.9 else rate * first)


def test_updates_do_not_grow_beyond_a_few_steps() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    information, step = root @ root.T, rng.normal(size=6)
    acceleration, factors = AndersonAcceleration(), list[float]()
    for _ in range(8):  # of steps that shrink whatever is applied
        gradient = -information @ step
        update = acceleration.update_for(step, gradient)
        acceleration.record(step, gradient, update)
        factors.append(float(update @ step) / float(step @ step))
        step = 0.86 * step
    assert factors[0] == 1.0
    assert 5.0 < max(factors) <= MAX_FACTOR


def test_steps_that_damping_holds_back_are_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    case = drive(noise_px=0.5)
    start = perturbed(case.truth, np.random.default_rng(1), units=range(1, 8))
    kept = list[np.ndarray]()
    monkeypatch.setattr(AndersonAcceleration, "record", lambda self, step, gradient, update: kept.append(step))
    options = SolverOptions(initial_damping=4.0 * solver.MAX_DAMPING_OF_DECREMENT)
    _, report = solve(replace(case.problem, state=start, options=options))
    assert len(kept) == report.iterations - 1 > 1


def test_an_extrapolated_step_that_costs_more_is_taken_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    case = drive(noise_px=0.5)
    start = perturbed(case.truth, np.random.default_rng(1), units=range(1, 8))
    factors = iter([100.0])
    monkeypatch.setattr(AndersonAcceleration, "update_for", lambda self, step, gradient: step)
    plain, of_plain = solve(replace(case.problem, state=start))

    def too_far(self: AndersonAcceleration, step: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        factor = next(factors, None)
        return step if factor is None else factor * step

    monkeypatch.setattr(AndersonAcceleration, "update_for", too_far)
    solution, report = solve(replace(case.problem, state=start))
    assert next(factors, None) is None
    # No damping was raised for it, and no step taken back.
    assert report == of_plain
    np.testing.assert_array_equal(solution.unit_position_m, plain.unit_position_m)


@pytest.mark.parametrize("rate", [0.1, 0.45])
def test_what_is_left_after_a_step_is_the_rest_of_its_series(rate: float) -> None:
    steps = rate ** np.arange(60)
    np.testing.assert_allclose(solver._decrement_left(1.0, rate**2), steps[2:].sum() ** 2)
    # Steps that hardly shrink end by their own length.
    assert solver._decrement_left(1.0, 0.9) == solver._decrement_left(0.0, 0.9) == 0.9


@pytest.mark.parametrize("seed", range(4))
def test_an_adjustment_ends_as_soon_as_little_is_left(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    # An extrapolated step tells nothing of the next one.
    monkeypatch.setattr(AndersonAcceleration, "update_for", lambda self, step, gradient: step)
    case = drive(noise_px=0.5, seed=seed)
    start = perturbed(case.truth, np.random.default_rng(seed), units=range(1, 8), unit_m=0.05, unit_deg=0.2)
    options = SolverOptions(function_tolerance=0.0, decrement_tolerance=0.1, expects_rest=True, sigma_px=0.5)
    problem = replace(case.problem, state=start, options=options)
    solution, report = solve(problem)
    assert report.termination is Termination.CONVERGED
    system = problem.normal_equations(solution, 0.0)
    further = problem.step(solution, system, 0.0)
    assert further is not None
    assert 0.0 < -float(further @ system.gradient) < options.decrement_tolerance
    monkeypatch.setattr(solver, "_decrement_left", lambda before, decrement: decrement)
    _, by_the_last_step = solve(problem)
    assert report.iterations < by_the_last_step.iterations


@pytest.mark.parametrize("outlier_fraction", [0.0, 0.1])
@pytest.mark.parametrize("seed", range(2))
def test_poses_and_points_are_recovered_from_noise_and_outliers(seed: int, outlier_fraction: float) -> None:
    case = drive(noise_px=0.5, outlier_fraction=outlier_fraction, seed=seed)
    start = perturbed(case.truth, np.random.default_rng(seed), units=range(1, 8), unit_m=0.05, unit_deg=0.2)
    solution, report = solve(
        replace(case.problem, state=start, options=SolverOptions(sigma_px=0.5, max_iterations=100))
    )
    assert report.termination is Termination.CONVERGED
    position, rotation = (
        position_errors_m(solution, case.truth)[1:],
        rotation_errors_deg(solution.unit_rotation, case.truth.unit_rotation)[1:],
    )
    assert 2e-4 < rms(position) < 0.01
    assert 1e-3 < rms(rotation) < 0.03
    # Outliers are still outliers: the fit did not bend to them.
    errors = np.sqrt(case.problem.errors_px2(solution))
    assert 0.3 < np.median(errors) < 1.2
    if outlier_fraction:
        assert 0.8 * outlier_fraction < (errors > 10).mean() < 1.1 * outlier_fraction


def test_calibration_is_recovered_where_the_drive_turns() -> None:
    case = make_case(
        units=14, cameras=4, points=1500, noise_px=0.3, free_units=[False] + [True] * 13, free_cameras=[True] * 4
    )
    rng = np.random.default_rng(3)
    given = perturbed(case.truth, rng, cameras=range(4), camera_deg=0.5, camera_m=0.0, point_m=0.0)
    prior = calibration_prior(given, rotation_deg=0.5, translation_m=0.01)
    solution, _ = solve(replace(case.problem, state=given, terms=[prior]))

    def between_cameras(state: State) -> np.ndarray:
        return np.swapaxes(state.camera_rotation[[0]], 1, 2) @ state.camera_rotation

    before = rotation_errors_deg(between_cameras(given), between_cameras(case.truth))[1:]
    after = rotation_errors_deg(between_cameras(solution), between_cameras(case.truth))[1:]
    assert before.max() > 0.4
    assert 1e-3 < after.max() < 0.1


def test_a_focal_length_is_recovered_where_free_and_kept_where_held() -> None:
    free = [False] + [True] * 9
    case = make_case(
        units=10, cameras=2, points=1500, noise_px=0.2, free_units=free, free_cameras=[True] * 2, free_focal=True
    )
    given = case.truth.camera_params.copy()
    given[0, :2] *= 1.002
    start = replace(case.truth, camera_params=given)
    terms = [
        calibration_prior(case.truth, rotation_deg=0.05, translation_m=0.002),
        focal_prior(given, np.full(2, 0.01)),
    ]
    solution, _ = solve(replace(case.problem, state=start, terms=terms))
    left = np.abs(solution.camera_params[:, 0] / case.truth.camera_params[:, 0] - 1)
    assert 1e-7 < left.max() < 0.0012
    np.testing.assert_allclose(solution.camera_params[:, 1] / solution.camera_params[:, 0], given[:, 1] / given[:, 0])
    np.testing.assert_array_equal(solution.camera_params[:, 2:], given[:, 2:])
    held, _ = solve(replace(case.problem, state=start, layout=with_focal(case.problem.layout, False), terms=terms))
    np.testing.assert_array_equal(held.camera_params, given)
    assert not np.array_equal(held.camera_rotation, start.camera_rotation)


def test_the_cost_never_increases() -> None:
    case = drive(noise_px=1.0, outlier_fraction=0.1, free_cameras=[True] * 6)
    start = perturbed(
        case.truth, np.random.default_rng(5), units=range(1, 8), cameras=range(6), unit_deg=2.0, unit_m=0.5, point_m=1.0
    )
    costs = []
    for iterations in range(12):
        problem = replace(
            case.problem,
            state=start,
            terms=[calibration_prior(case.truth)],
            options=SolverOptions(max_iterations=iterations),
        )
        solution, report = solve(problem)
        assert problem.cost(solution) == pytest.approx(report.final_cost, rel=1e-12)
        assert report.iterations <= iterations
        costs.append(report.final_cost)
    assert costs[0] == case.problem.cost(start) + calibration_prior(case.truth).cost(start)
    assert (np.diff(costs) <= 0).all()
    assert costs[-1] < 0.5 * costs[0]


def test_what_is_fixed_does_not_move_at_all() -> None:
    free_units = [False, True, True, False, True, True, False, True]
    case = drive(free_units=free_units, free_cameras=[True, False, True, False, False, True])
    start = perturbed(case.truth, np.random.default_rng(6), units=range(8), cameras=range(6))
    solution, _ = solve(replace(case.problem, state=start, terms=[calibration_prior(case.truth)]))
    units, cameras = np.array(free_units), np.array([True, False, True, False, False, True])
    for name, free in (
        ("unit_rotation", units),
        ("unit_position_m", units),
        ("camera_rotation", cameras),
        ("camera_position_m", cameras),
    ):
        before, after = getattr(start, name), getattr(solution, name)
        np.testing.assert_array_equal(after[~free], before[~free])
        assert (np.abs(after[free] - before[free]).reshape(int(free.sum()), -1).max(1) > 1e-9).all()
    np.testing.assert_array_equal(solution.camera_params, start.camera_params)


def test_the_state_that_was_given_is_not_written_to() -> None:
    case = drive()
    start = perturbed(case.truth, np.random.default_rng(7), units=range(1, 8))
    copies = {name: getattr(start, name).copy() for name in State.__dataclass_fields__}
    solve(replace(case.problem, state=start))
    for name, copy in copies.items():
        np.testing.assert_array_equal(getattr(start, name), copy)


def test_points_alone_can_be_adjusted() -> None:
    case = make_case(units=4, cameras=3, noise_px=0.0, free_units=[False] * 4)
    start = perturbed(case.truth, np.random.default_rng(8), point_m=0.05)
    solution, report = solve(replace(case.problem, state=start))
    assert report.parameters == start.points_m.size
    seen_often = np.bincount(case.problem.observations.point) >= 4
    off = np.linalg.norm(solution.points_m - case.truth.points_m, axis=1)[seen_often]
    assert np.median(np.linalg.norm(start.points_m - case.truth.points_m, axis=1)) > 0.05
    assert np.median(off) < 1e-4


def test_nothing_free_is_said() -> None:
    case = make_case(units=2, cameras=1, points=30)
    empty = np.zeros(0, dtype=np.int64)
    problem = Problem(
        state=replace(case.truth, points_m=np.zeros((0, 3))),
        camera_kind=case.problem.camera_kind,
        observations=Observations(unit=empty, camera=empty, point=empty, xy_px=np.zeros((0, 2)), num_points=0),
        layout=Layout.from_free(np.zeros(2, np.bool_), np.zeros(1, np.bool_)),
    )
    _, report = solve(problem)
    assert report.termination is Termination.NOTHING_FREE
    assert report.iterations == 0


def test_cancelling_returns_the_best_state_so_far() -> None:
    case = drive()
    start = perturbed(case.truth, np.random.default_rng(9), units=range(1, 8))
    problem = replace(case.problem, state=start)
    answers = iter([False, False, True])
    solution, report = solve(problem, cancel=lambda: next(answers))
    assert report.iterations == 2
    assert problem.cost(solution) == pytest.approx(report.final_cost)
    assert report.final_cost < report.initial_cost
    at_once, report = solve(problem, cancel=lambda: True)
    assert report.iterations == 0
    np.testing.assert_array_equal(at_once.unit_position_m, start.unit_position_m)


def test_repeating_a_solve_gives_the_same_bits() -> None:
    case = drive(outlier_fraction=0.05)
    start = perturbed(case.truth, np.random.default_rng(10), units=range(1, 8))
    a, b = (solve(replace(case.problem, state=start))[0] for _ in range(2))
    np.testing.assert_array_equal(a.unit_position_m, b.unit_position_m)
    np.testing.assert_array_equal(a.points_m, b.points_m)


def test_scale_comes_from_the_rig() -> None:
    """The same images with baselines twice as long are the same scene twice as large."""
    case = make_case(units=6, cameras=2, points=600, noise_px=0.0, free_units=[False] + [True] * 5)
    doubled = replace(
        case.truth,
        camera_position_m=2.0 * case.truth.camera_position_m,
        unit_position_m=2.0 * case.truth.unit_position_m,
        points_m=2.0 * case.truth.points_m,
    )
    assert case.problem.cost(doubled) < 1e-9
    # From the single-size scene with the doubled rig, the solver gets there on its own.
    start = replace(case.truth, camera_position_m=2.0 * case.truth.camera_position_m)
    start = replace(start, unit_position_m=1.7 * start.unit_position_m, points_m=1.7 * start.points_m)
    solution, _ = solve(
        replace(
            case.problem,
            state=start,
            options=SolverOptions(max_iterations=200, function_tolerance=1e-12, decrement_tolerance=0.0),
        )
    )
    way = np.linalg.norm(solution.unit_position_m[-1] - solution.unit_position_m[0])
    true_way = np.linalg.norm(case.truth.unit_position_m[-1] - case.truth.unit_position_m[0])
    assert way / true_way == pytest.approx(2.0, rel=1e-3)


def test_fixed_points_stay_and_hold_the_poses() -> None:
    case = drive()
    o = replace(case.problem.observations, fixed=np.ones(case.problem.observations.num_points, dtype=np.bool_))
    start = perturbed(case.truth, np.random.default_rng(4), units=range(8), unit_m=0.1, unit_deg=0.5, point_m=0.0)
    layout = Layout.from_free(np.ones(8, dtype=np.bool_), np.zeros(6, dtype=np.bool_))
    solution, report = solve(replace(case.problem, state=start, observations=o, layout=layout))
    np.testing.assert_array_equal(solution.points_m, case.truth.points_m)
    assert report.parameters == report.pose_parameters == 48
    assert 1e-6 < position_errors_m(solution, case.truth).max() < 5e-3


def test_points_follow_a_step_by_themselves_and_never_for_the_worse() -> None:
    case = drive()
    problem = case.problem
    before = perturbed(case.truth, np.random.default_rng(2), point_m=0.0)
    moved = perturbed(case.truth, np.random.default_rng(3), units=range(1, 5), unit_m=0.02, unit_deg=0.1, point_m=0.3)
    there = problem.point_costs(replace(moved, points_m=before.points_m))
    thrown = problem.point_costs(moved)
    costs, total = problem.refine_points(moved, before, np.zeros_like(there))
    assert (costs <= np.minimum(there, thrown) + 1e-9).all()
    assert costs.sum() < 0.97 * np.minimum(there, thrown).sum()
    np.testing.assert_allclose(costs, problem.point_costs(moved), rtol=1e-9, atol=1e-12)
    assert total == pytest.approx(problem.cost(moved))
