"""Units that move as one: derivatives against differences of the cost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.bundle_adjustment.rigid_groups import RigidGroups
from mrasfm_engine.bundle_adjustment.solver import Problem, SolverOptions, solve
from mrasfm_engine.geometry import se3
from mrasfm_engine.scene.state import State
from tests.helpers.small_problems import Case, make_case, perturbed, position_errors_m, rotation_errors_deg

OF_UNIT = np.array([-1, -1, -1, 0, 0, 0, 1, 1])


@pytest.fixture
def case() -> Case:
    return make_case(units=8, free_units=(OF_UNIT >= 0).tolist(), noise_px=0.3)


def with_sets(case: Case, **changes: object) -> Problem:
    return replace(case.problem, sets=RigidGroups(of_unit=OF_UNIT, count=2), **changes)


def by_unit(problem: Problem, state: State, step: np.ndarray) -> np.ndarray:
    """Steps (6 units,) that go with a step (12,) of both sets."""
    assert problem.sets is not None
    of, maps = problem.sets.unit_from_set_steps(state, problem.layout)
    result: np.ndarray = np.einsum("nij,nj->ni", maps, step.reshape(2, 6)[of]).ravel()
    return result


def moved(problem: Problem, state: State, step: np.ndarray) -> State:
    """The state after a step (12,) of both sets."""
    return problem.retract(state, by_unit(problem, state, step), state.points_m)


def whole_map(of: np.ndarray, maps: np.ndarray) -> np.ndarray:
    """The map (6 units, 12) from the steps of both sets to those of their units."""
    whole = np.zeros((6 * len(of), 12))
    for k, (s, m) in enumerate(zip(of, maps, strict=True)):
        whole[6 * k : 6 * k + 6, 6 * s : 6 * s + 6] = m
    return whole


def test_gradient_is_that_of_the_cost(case: Case) -> None:
    # Fixed points add nothing to the reduced gradient, so that it can be compared with the cost's own differences.
    observations = case.problem.observations
    fixed = replace(observations, fixed=np.ones(observations.num_points, dtype=np.bool_))
    problem = with_sets(case, observations=fixed)
    state = moved(problem, case.truth, np.random.default_rng(0).normal(size=12) * 0.01)
    assert problem.sets is not None
    matrix, gradient, diagonal = problem.sets.condense(problem.normal_equations(state, 0.0), state)
    steps = 1e-6 * np.eye(12)
    numeric = [(problem.cost(moved(problem, state, s)) - problem.cost(moved(problem, state, -s))) / 2e-6 for s in steps]
    assert 0 < np.abs(np.array(numeric) - gradient).max() < 1e-5 * np.abs(gradient).max()
    assert np.allclose(matrix, matrix.T)
    assert np.linalg.eigvalsh(matrix).min() > 0
    assert (diagonal > 0).all()


def test_condensed_matrix_is_the_units_matrix_between_the_maps(case: Case) -> None:
    problem = with_sets(case)
    system = problem.normal_equations(case.truth, 0.0)
    assert problem.sets is not None
    of, maps = problem.sets.unit_from_set_steps(case.truth, problem.layout)
    whole = whole_map(of, maps)
    matrix, _, _ = problem.sets.condense(system, case.truth)
    assert np.allclose(matrix, whole.T @ system.matrix @ whole, rtol=1e-9, atol=1e-6)


def test_the_block_with_cameras_is_the_units_between_the_maps() -> None:
    case = make_case(units=8, free_units=(OF_UNIT >= 0).tolist(), free_cameras=[True] * 3, noise_px=0.3)
    sets, layout = RigidGroups(of_unit=OF_UNIT, count=2), case.problem.layout
    system = case.problem.normal_equations(case.truth, 0.0)
    of, maps = sets.unit_from_set_steps(case.truth, layout)
    whole = whole_map(of, maps)
    expected = whole.T @ system.matrix[: len(whole), len(whole) :]
    assert np.abs(expected).max() > 0
    assert np.allclose(sets.with_cameras(system, case.truth), expected, rtol=1e-9, atol=1e-6)


def test_sets_find_back_and_stay_rigid(case: Case) -> None:
    problem = with_sets(case)
    start = moved(problem, case.truth, np.array([0.02, -0.01, 0.04, 0.4, -0.3, 0.2, 0.01, 0.03, -0.02, -0.3, 0.2, 0.1]))
    start = perturbed(start, np.random.default_rng(1), point_m=0.05)
    assert position_errors_m(start, case.truth)[3:].min() > 0.1
    solution, report = solve(replace(problem, state=start))
    assert report.pose_parameters == 12
    assert 0 < position_errors_m(solution, case.truth).max() < 0.02
    assert 0 < rotation_errors_deg(solution.unit_rotation, case.truth.unit_rotation).max() < 0.02
    for a, b in ((3, 4), (3, 5), (6, 7)):
        before, after = (se3.inverse(s.world_from_rig[a]) @ s.world_from_rig[b] for s in (case.truth, solution))
        assert np.abs(before - after).max() < 1e-12


def test_covariance_grows_with_the_noise(case: Case) -> None:
    problem = with_sets(case)
    assert problem.sets is not None
    fine, coarse = (
        problem.sets.covariances(
            replace(problem, options=SolverOptions(sigma_px=s)).normal_equations(case.truth, 0.0), case.truth
        )
        for s in (0.5, 1.0)
    )
    assert (np.diagonal(fine, axis1=1, axis2=2) > 0).all()
    assert (np.diagonal(fine, axis1=1, axis2=2) < np.diagonal(coarse, axis1=1, axis2=2)).all()


def test_a_sum_of_steps_is_made_a_step_of_rigid_sets(case: Case) -> None:
    problem, rng = with_sets(case), np.random.default_rng(0)
    assert problem.sets is not None

    first, second = rng.normal(size=(2, 12)) * 0.01
    own = by_unit(problem, case.truth, first)
    np.testing.assert_allclose(problem.sets.mean_step(case.truth, problem.layout, own), own, atol=1e-12)
    later = moved(problem, case.truth, first)
    together = own + by_unit(problem, later, second)
    rigid = problem.sets.mean_step(later, problem.layout, together)
    assert 0.0 < np.abs(rigid - together).max() < 0.05 * np.abs(together).max()
    after = problem.retract(later, rigid, later.points_m)
    for units in (OF_UNIT == 0, OF_UNIT == 1):
        before_m, after_m = (np.linalg.norm(np.diff(s.unit_position_m[units], axis=0), axis=1) for s in (later, after))
        np.testing.assert_allclose(after_m, before_m, atol=1e-12)
