from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.bundle_adjustment import shared_errors
from mrasfm_engine.bundle_adjustment.marginal_covariances import (
    Covariances,
    covariances,
    sigma_factor_of_shared_errors,
)
from mrasfm_engine.bundle_adjustment.priors import CalibrationPrior
from mrasfm_engine.bundle_adjustment.solver import Problem, SolverOptions, solve
from mrasfm_engine.geometry import se3
from mrasfm_engine.scene.state import State
from tests.helpers.slow import slow
from tests.helpers.small_problems import make_case

UNITS, CAMERAS, NOISE_PX, SHARED_PX = 24, 3, 0.5, 1.5
NO_LOSS = 1e3  # of residuals of any size
PRIOR_RAD, PRIOR_M = np.radians(0.02), 0.004  # better than what images tell whose errors are shared


def adjusted(
    seed: int, *, shared_px: float, units: int = UNITS, of_points: bool = False, loss_scale: float = NO_LOSS
) -> tuple[State, Problem, State]:
    """Truth, problem and solution of a drive whose images are shifted, each by an error of its own.

    With `of_points` keypoints are, by an error that those of a point share.
    """
    case = make_case(
        units=units,
        cameras=CAMERAS,
        points=1500,
        noise_px=NOISE_PX,
        free_units=[False] + [True] * (units - 1),
        free_cameras=[True] * CAMERAS,
        seed=seed,
        options=SolverOptions(sigma_px=NOISE_PX, loss_scale=loss_scale, decrement_tolerance=1e-6),
    )
    truth, o = case.truth, case.problem.observations
    rows, columns = (o.point, np.zeros_like(o.point)) if of_points else (o.unit, o.camera)
    shift_px = np.random.default_rng(seed).normal(scale=shared_px, size=(rows.max() + 1, columns.max() + 1, 2))
    prior = CalibrationPrior(
        rotation=truth.camera_rotation,
        position_m=truth.camera_position_m,
        sigma_rotation_rad=np.full(CAMERAS, np.radians(2.0)),
        sigma_translation_m=np.full(CAMERAS, 0.05),
    )
    shifted = replace(o, xy_px=o.xy_px + shift_px[rows, columns])
    problem = replace(case.problem, observations=shifted, terms=[prior])
    return truth, problem, solve(problem)[0]


def rotation_in_sigmas(truth: State, problem: Problem, solution: State, found: Covariances) -> np.ndarray:
    prior = problem.terms[0]
    assert isinstance(prior, CalibrationPrior)
    sigma = np.sqrt(np.diagonal(prior.without_gauge(found.calibration))).reshape(CAMERAS, 6)
    error = replace(prior, rotation=truth.camera_rotation, position_m=truth.camera_position_m).corrections(solution)
    result: np.ndarray = ((error - error.mean(0)) / sigma)[:, :3]
    return result


@pytest.mark.parametrize(("of_points", "sigmas_without"), [(False, 3.0), (True, 2.0)])
def test_errors_that_observations_share_are_covered(
    of_points: bool, sigmas_without: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    covered, without = [], []
    for seed in range(8):
        case = adjusted(seed, shared_px=SHARED_PX, of_points=of_points)
        covered.append(rotation_in_sigmas(*case, covariances(*case[1:])))
        with monkeypatch.context() as patch:
            patch.setattr(shared_errors, "MIN_UNITS", 1_000)
            without.append(rotation_in_sigmas(*case, covariances(*case[1:])))
    assert 0.5 < np.sqrt(np.mean(np.square(covered))) < 1.5
    assert np.sqrt(np.mean(np.square(without))) > sigmas_without


def test_independent_errors_change_little(monkeypatch: pytest.MonkeyPatch) -> None:
    _, problem, solution = adjusted(0, shared_px=0.0)
    found = covariances(problem, solution)
    monkeypatch.setattr(shared_errors, "MIN_UNITS", 1_000)
    independent = covariances(problem, solution)
    ratio = found.sigma_camera[:, :6] / independent.sigma_camera[:, :6]
    assert (ratio > 0.75).all()
    assert (ratio < 1.25).all()
    assert 0.9 < found.sigma_scale / independent.sigma_scale < 1.1


@pytest.mark.slow
def test_sigmas_are_true_under_a_robust_loss() -> None:
    """Weights that fall where residuals rise let a solution give way further than the normal equations say."""
    found = []
    for seed in range(12):
        truth, problem, solution = adjusted(seed, shared_px=2 * NOISE_PX, loss_scale=2.0)
        found.append(rotation_in_sigmas(truth, problem, solution, covariances(problem, solution)))
    assert 0.8 < np.sqrt(np.mean(np.square(found))) < 1.25


@pytest.mark.parametrize("units", [4, *slow(6, 9)])
def test_errors_that_few_observations_share_are_covered(units: int) -> None:
    """Few units hardly tell how far they scatter: three standard deviations are wider for it, and hold as much."""
    shared, independent = [], []
    for seed in range(8):
        case = adjusted(seed, shared_px=SHARED_PX, units=units)
        shared.append(rotation_in_sigmas(*case, covariances(*case[1:])))
        case = adjusted(seed, shared_px=0.0, units=units)
        independent.append(rotation_in_sigmas(*case, covariances(*case[1:])))
    assert 0.25 < np.sqrt(np.mean(np.square(shared))) < 1.2
    assert np.abs(shared).max() < 3.5
    assert 0.7 < np.sqrt(np.mean(np.square(independent))) < 1.4


def test_priors_that_know_more_are_not_overruled() -> None:
    """Weighed as independent, errors that images share would turn cameras by more than their priors are off."""
    before, after = [], []
    for seed in range(6):
        truth, problem, _ = adjusted(seed, shared_px=SHARED_PX)
        problem = replace(problem, terms=[drawn_prior(truth, seed)])
        solution = solve(problem)[0]
        before.append(rotation_error(truth, problem, solution))
        factor = covariances(problem, solution).sigma_factor
        assert factor == sigma_factor_of_shared_errors(problem, solution) > 2.0
        lighter = replace(problem.options, sigma_px=factor * NOISE_PX, loss_scale=NO_LOSS / factor)
        after.append(rotation_error(truth, problem, solve(replace(problem, options=lighter))[0]))
    assert np.sqrt(np.mean(np.square(after))) < 0.8 * np.sqrt(np.mean(np.square(before)))


def test_independent_errors_keep_their_weight() -> None:
    truth, problem, _ = adjusted(0, shared_px=0.0)
    problem = replace(problem, terms=[drawn_prior(truth, 0)])
    assert 1.0 <= covariances(problem, solve(problem)[0]).sigma_factor < 1.05


def test_information_that_the_loss_takes_from_priors_is_no_error_of_images() -> None:
    """Where large residuals bend a robust loss the other way, priors know more than the sum, and images err no more."""
    of_priors = np.diag([1.5, 0.3])
    covariance = of_priors + np.diag([0.9, 0.7])
    assert shared_errors._best_sigma_factor(covariance, np.eye(2), of_priors) == 1.0
    more = of_priors + np.diag([0.9, 7.0])
    assert 2.0 < shared_errors._best_sigma_factor(more, np.eye(2), of_priors) < 4.0


def test_rounding_chooses_no_factor_where_none_changes_anything() -> None:
    """Images alone tell one direction, priors alone the others, and one of these is nearly a sum of the rest."""
    axes = np.linalg.qr(np.random.default_rng(0).normal(size=(4, 4)))[0] * np.sqrt([1.0, 1.0, 1.0, 1e-6])
    independent, priors = axes @ axes.T, axes[:, 1:] @ axes[:, 1:].T
    covariance = priors + 9.0 * np.outer(axes[:, 0], axes[:, 0])
    for seed in range(10):
        rounding = 1e-11 * np.random.default_rng(seed).normal(size=(2, 4, 4))
        found, known = (m + r + r.T for m, r in zip((covariance, priors), rounding, strict=True))
        assert shared_errors._best_sigma_factor(found, independent, known) == pytest.approx(1.0, abs=0.01)


def drawn_prior(truth: State, seed: int) -> CalibrationPrior:
    """A prior that is off by what it states."""
    off = np.random.default_rng(100 + seed).normal(size=(CAMERAS, 6))
    return CalibrationPrior(
        rotation=se3.exp_so3(PRIOR_RAD * off[:, :3]) @ truth.camera_rotation,
        position_m=truth.camera_position_m + PRIOR_M * off[:, 3:],
        sigma_rotation_rad=np.full(CAMERAS, PRIOR_RAD),
        sigma_translation_m=np.full(CAMERAS, PRIOR_M),
    )


def rotation_error(truth: State, problem: Problem, solution: State) -> np.ndarray:
    prior = problem.terms[0]
    assert isinstance(prior, CalibrationPrior)
    error = replace(prior, rotation=truth.camera_rotation, position_m=truth.camera_position_m).corrections(solution)
    result: np.ndarray = (error - error.mean(0))[:, :3]
    return result


def test_three_units_tell_no_covariance_of_their_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    _, problem, solution = adjusted(0, shared_px=SHARED_PX, units=3)
    found = covariances(problem, solution)
    monkeypatch.setattr(shared_errors, "MIN_UNITS", 1_000)
    np.testing.assert_array_equal(found.calibration, covariances(problem, solution).calibration)


def test_what_the_adjustment_weighs_has_no_shared_errors() -> None:
    """Directions are held by it: shared errors make one uncertain that the adjustment is sure of all the same."""
    _, problem, solution = adjusted(0, shared_px=SHARED_PX)
    found, independent = covariances(problem, solution), covariances(problem, solution, shared_errors=False)
    np.testing.assert_array_equal(found.calibration_of_independent_errors, independent.calibration)
    np.testing.assert_array_equal(independent.calibration_of_independent_errors, independent.calibration)
    assert (np.diagonal(found.calibration) > 1.5**2 * np.diagonal(independent.calibration)).any()


def test_scores_of_all_images_cancel_with_those_of_the_priors() -> None:
    """At a solution the gradient is zero along every step, also with the points following."""
    _, problem, solution = adjusted(1, shared_px=SHARED_PX)
    system = problem.normal_equations(solution, 0.0)
    rng = np.random.default_rng(0)
    steps = rng.normal(size=(problem.layout.size, 3))
    scores, of_points = problem.scores(solution, system, steps, problem.observations.unit, 7)
    assert scores.shape == (UNITS, 3)
    np.testing.assert_allclose(of_points.sum(0), scores.sum(0), atol=1e-9 * np.abs(scores).max())
    one_by_one, _ = problem.scores(solution, system, steps, problem.observations.point % 7, 7)
    np.testing.assert_allclose(of_points, one_by_one, atol=1e-9 * np.abs(one_by_one).max())
    # The system's gradient has that of the terms, and of points that could still move: they have moved.
    from_terms = system.gradient - replace(problem, terms=[]).normal_equations(solution, 0.0).gradient
    np.testing.assert_allclose(scores.sum(0), (system.gradient - from_terms) @ steps, atol=1e-6 * np.abs(scores).max())
