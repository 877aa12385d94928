from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg

from mrasfm_engine.bundle_adjustment.problem import Layout
from mrasfm_engine.bundle_adjustment.receiver_likelihood import restricted_log_likelihood
from mrasfm_engine.bundle_adjustment.receiver_positions import MAX_KNOTS, ReceiverPositions, time_of_process_s
from mrasfm_engine.bundle_adjustment.reduced_camera_system import Extra
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import PARAMETERS
from mrasfm_engine.scene.state import State

UNITS, WANDER_TIME_S = 12, 30.0
ARM_M = np.array([-0.5, 0.3, 1.8])


def free_units(fixed: int | None = None) -> Layout:
    free = np.ones(UNITS, dtype=np.bool_)
    if fixed is not None:
        free[fixed] = False
    return Layout.from_free(free, np.zeros(1, dtype=np.bool_))


def moving(rng: np.random.Generator) -> State:
    return State(
        unit_rotation=se3.exp_so3(0.2 * rng.normal(size=(UNITS, 3))),
        unit_position_m=np.cumsum(np.array([2.0, 0.0, 0.0]) + rng.normal(size=(UNITS, 3)), axis=0),
        camera_rotation=np.eye(3)[None],
        camera_position_m=np.zeros((1, 3)),
        camera_params=np.ones((1, PARAMETERS)),
        points_m=np.zeros((0, 3)),
        camera_time_offset_s=np.zeros(1),
    )


def received(state: State, rng: np.random.Generator, **changes: object) -> ReceiverPositions:
    """Positions with errors; a knot at every sample, so that the process is interpolated exactly."""
    time_s = 2.0 * np.arange(UNITS)
    term = ReceiverPositions(
        unit=np.arange(UNITS),
        position_m=state.unit_position_m + state.unit_rotation @ ARM_M + 0.4 * rng.normal(size=(UNITS, 3)) + 1.0,
        sigma_m=rng.uniform(0.1, 0.3, (UNITS, 3)),
        wander_m=rng.uniform(0.5, 1.0, (UNITS, 3)),
        lever_arm_m=ARM_M,
        time_s=time_s,
        knots_s=time_s,
        wander_time_s=WANDER_TIME_S,
    )
    return replace(term, **changes)


def jumping(term: ReceiverPositions, first: int) -> ReceiverPositions:
    """The term with an error that jumps at a sample."""
    segment = (np.arange(UNITS) >= first).astype(np.int64)
    return replace(term, segment=segment, knots_s=time_of_process_s(term.time_s, segment, WANDER_TIME_S))


COMMON = [(), ("clock",), ("lever",), ("clock", "lever")]


def with_common(term: ReceiverPositions, state: State, common: tuple[str, ...] = ("clock",)) -> ReceiverPositions:
    """The term of a receiver whose clock is known to 0.3 s, or whose antenna's place is to a metre."""
    if "clock" in common:
        term = replace(term, clock_m=0.3 * np.gradient(state.unit_position_m, term.time_s, axis=0))
    return replace(term, lever_m=state.unit_rotation.copy()) if "lever" in common else term


def whole_covariance(term: ReceiverPositions) -> np.ndarray:
    """Covariance (3 n, 3 n) of the errors along x, then y, then z, with those that all have in common."""
    result: np.ndarray = scipy.linalg.block_diag(*covariances(term))
    if term.clock_m is not None:
        result = result + np.outer(term.clock_m.T.ravel(), term.clock_m.T.ravel())
    if term.lever_m is not None:
        ways = np.swapaxes(term.lever_m, 0, 1).reshape(-1, 3)
        result = result + ways @ ways.T
    return result


def covariances(term: ReceiverPositions) -> list[np.ndarray]:
    """Covariance (n, n) of the errors along each axis, as it is defined."""
    alike = np.exp(-np.abs(term.time_s[:, None] - term.time_s) / WANDER_TIME_S)
    if term.segment is not None:
        alike = np.where(term.segment[:, None] == term.segment, alike, 0.0)
    return [
        np.diag(term.sigma_m[:, a] ** 2) + np.outer(term.wander_m[:, a], term.wander_m[:, a]) * alike for a in range(3)
    ]


def test_without_outliers_it_costs_what_correlated_errors_do() -> None:
    rng = np.random.default_rng(0)
    state = moving(rng)
    term = received(state, rng, loss_scale=1e6)
    off_m = state.unit_position_m + state.unit_rotation @ ARM_M - term.position_m
    expected = 0.5 * sum(off_m[:, a] @ np.linalg.solve(c, off_m[:, a]) for a, c in enumerate(covariances(term)))
    assert term.cost(state) == pytest.approx(expected, rel=1e-9)
    # A constant error of some sigmas costs little beside independent ones of the same size.
    assert term.cost(state) < 0.3 * replace(term, wander_m=0 * term.wander_m).cost(state)


def test_bounded_sigmas_leave_out_what_is_beyond_and_nothing_else() -> None:
    rng = np.random.default_rng(0)
    term = received(moving(rng), rng)
    same, left_out_m = term.bounded(2.0)
    np.testing.assert_array_equal(same.sigma_m, term.sigma_m)
    np.testing.assert_array_equal(same.wander_m, term.wander_m)
    np.testing.assert_array_equal(left_out_m, np.zeros(3))
    heights = np.array([1.0, 1.0, 1e4])
    bounded, left_out_m = replace(term, sigma_m=term.sigma_m * heights).bounded(2.0)
    np.testing.assert_array_equal(bounded.sigma_m[:, :2], term.sigma_m[:, :2])
    np.testing.assert_array_equal(bounded.sigma_m[:, 2], np.full(UNITS, 2.0))
    np.testing.assert_allclose(left_out_m, [0.0, 0.0, 1e4 * np.median(term.sigma_m[:, 2])], rtol=0.05)


def test_errors_before_and_after_a_jump_are_independent() -> None:
    rng = np.random.default_rng(0)
    state = moving(rng)
    term = jumping(received(state, rng, loss_scale=1e6), 7)
    off_m = state.unit_position_m + state.unit_rotation @ ARM_M - term.position_m
    off_m[7:] -= [3.0, -2.0, 0.0]
    expected = 0.5 * sum(off_m[:, a] @ np.linalg.solve(c, off_m[:, a]) for a, c in enumerate(covariances(term)))
    term = replace(term, position_m=term.position_m + (np.arange(UNITS) >= 7)[:, None] * np.array([3.0, -2.0, 0.0]))
    assert term.cost(state) == pytest.approx(expected, rel=1e-9)
    assert term.cost(state) < 0.7 * replace(term, segment=None, knots_s=term.time_s).cost(state)


def test_knots_of_samples_begin_anew_at_a_jump() -> None:
    rng = np.random.default_rng(0)
    state = moving(rng)
    known = received(state, rng)
    segment = (np.arange(UNITS) >= 7).astype(np.int64)
    term = ReceiverPositions.from_samples(
        unit=known.unit,
        time_s=known.time_s,
        position_m=known.position_m,
        white_m=known.sigma_m,
        wander_m=known.wander_m,
        lever_arm_m=ARM_M,
        wander_time_s=WANDER_TIME_S,
        least_spacing_s=4.0,
        segment=segment,
    )
    first = time_of_process_s(known.time_s, segment, WANDER_TIME_S)[[0, 7]]
    # Samples every 2 s: 0 to 12 s and 14 to 22 s.
    np.testing.assert_allclose(term.knots_s, [*(first[0] + [0, 4, 8, 12]), *(first[1] + [0, 4, 8])])
    # Some of them, as in a local adjustment, are in the same parts.
    some = term.of_rows(np.arange(5, 10), np.arange(5, 10), np.ones(5))
    assert some.segment is not None
    assert some.segment.tolist() == [0, 0, 1, 1, 1]


def test_a_clock_costs_what_the_error_costs_that_it_makes_of_all_positions() -> None:
    rng = np.random.default_rng(0)
    state = moving(rng)
    term = with_common(received(state, rng, loss_scale=1e6), state)
    for late_s in (0.0, 0.6):
        late = replace(term, position_m=term.position_m - late_s / 0.3 * term.clock_m)
        off_m = (state.unit_position_m + state.unit_rotation @ ARM_M - late.position_m).T.ravel()
        expected = 0.5 * off_m @ np.linalg.solve(whole_covariance(late), off_m)
        assert late.cost(state) == pytest.approx(expected, rel=1e-9)
    assert late.cost(state) < replace(late, clock_m=None).cost(state) - 1.0
    shared = whole_covariance(late) - np.diag(late.sigma_m.T.ravel() ** 2)
    seen_m = -(shared @ np.linalg.solve(whole_covariance(late), off_m)).reshape(3, -1).T
    np.testing.assert_allclose(late.errors_m(state), seen_m, atol=1e-6)


def test_an_antenna_elsewhere_costs_what_the_error_costs_that_it_makes_of_all_positions() -> None:
    rng = np.random.default_rng(0)
    state = moving(rng)
    term = with_common(received(state, rng, loss_scale=1e6), state, ("lever",))
    off_by_m = np.array([0.8, -1.5, 0.2])
    for wrong in (term, replace(term, position_m=term.position_m + state.unit_rotation @ off_by_m)):
        off_m = (state.unit_position_m + state.unit_rotation @ ARM_M - wrong.position_m).T.ravel()
        expected = 0.5 * off_m @ np.linalg.solve(whole_covariance(wrong), off_m)
        assert wrong.cost(state) == pytest.approx(expected, rel=1e-9)
    assert wrong.cost(state) < replace(wrong, lever_m=None).cost(state) - 1.0
    seen_m = (wrong.errors_m(state) - term.errors_m(state)) / (state.unit_rotation @ off_by_m)
    assert np.median(seen_m) > 0.9


@pytest.mark.parametrize("common", COMMON)
@pytest.mark.parametrize("jump", [False, True])
def test_likelihood_with_common_errors_is_that_of_their_covariance(common: tuple[str, ...], jump: bool) -> None:
    rng = np.random.default_rng(6)
    state = moving(rng)
    term = received(state, rng)
    term = with_common(jumping(term, 5) if jump else term, state, common)
    declared = replace(term, wander_m=term.sigma_m)
    off_m = state.unit_position_m + state.unit_rotation @ ARM_M - term.position_m
    moves = np.tile(np.eye(3), (UNITS, 1, 1))

    def log_likelihood(of: ReceiverPositions) -> float:
        inverse, x = np.linalg.inv(whole_covariance(of)), np.swapaxes(moves, 0, 1).reshape(-1, 3)
        known = x.T @ inverse @ x
        left = inverse - inverse @ x @ np.linalg.solve(known, x.T @ inverse)
        flat = off_m.T.ravel()
        return -0.5 * float(flat @ left @ flat - np.linalg.slogdet(inverse)[1] + np.linalg.slogdet(known)[1])

    found, as_declared = restricted_log_likelihood(declared, off_m, moves), log_likelihood(declared)
    for white, wander in ((2.0, 0.5), (0.01, 3.0), (0.7, 0.0)):
        other = replace(declared, sigma_m=white * declared.sigma_m, wander_m=wander * declared.wander_m)
        expected = log_likelihood(other) - as_declared
        assert found(white, wander) - found(1.0, 1.0) == pytest.approx(expected, rel=1e-7)
    known = np.linalg.inv(whole_covariance(term))
    x = np.swapaxes(moves, 0, 1).reshape(-1, 3)
    np.testing.assert_allclose(term.information(moves), x.T @ known @ x, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("jump", [False, True])
@pytest.mark.parametrize("common", COMMON)
@pytest.mark.parametrize("fixed", [None, 4])
def test_matrix_is_the_information_of_correlated_errors(fixed: int | None, common: tuple[str, ...], jump: bool) -> None:
    rng = np.random.default_rng(1)
    state, layout = moving(rng), free_units(fixed)
    term = received(state, rng, loss_scale=1e6)
    term = jumping(term, 5) if jump else term
    term = with_common(term, state, common)
    extra = Extra.none(layout)
    term.add_to(state, layout, extra)
    units = np.flatnonzero(layout.unit_slot >= 0)
    jacobian = np.zeros((3, UNITS, layout.size))
    for a in range(3):
        rows = [np.concatenate([-se3.skew(state.unit_rotation[u] @ ARM_M), np.eye(3)], 1)[a] for u in units]
        jacobian[a, units] = scipy.linalg.block_diag(*rows)
    jacobian = jacobian.reshape(-1, layout.size)
    expected = jacobian.T @ np.linalg.solve(whole_covariance(term), jacobian)
    np.testing.assert_allclose(extra.matrix, expected, atol=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize("common", COMMON)
def test_gradient_is_that_of_the_cost(common: tuple[str, ...]) -> None:
    rng = np.random.default_rng(2)
    state, layout = moving(rng), free_units()
    term = received(state, rng)
    term = with_common(term, state, common)
    term.position_m[3] += [5.0, -3.0, 2.0]
    extra = Extra.none(layout)
    term.add_to(state, layout, extra)
    step = 1e-6
    for place in range(0, layout.size, 5):
        costs = []
        for sign in (-1.0, 1.0):
            d = np.zeros(layout.size)
            d[place] = sign * step
            turn, shift = d.reshape(-1, 6)[:, :3], d.reshape(-1, 6)[:, 3:]
            moved = replace(
                state,
                unit_rotation=se3.exp_so3(turn) @ state.unit_rotation,
                unit_position_m=state.unit_position_m + shift,
            )
            costs.append(term.cost(moved))
        assert extra.gradient[place] == pytest.approx((costs[1] - costs[0]) / (2 * step), rel=1e-4, abs=1e-4)


def test_wrong_position_loses_its_pull_and_does_not_move_the_error() -> None:
    rng = np.random.default_rng(3)
    state = moving(rng)
    term = received(state, rng, sigma_m=np.full((UNITS, 3), 0.3))
    before_m = term.errors_m(state)
    term.position_m[5] += [30.0, 0.0, 0.0]
    changed_m = np.abs(term.errors_m(state) - before_m).max(axis=1)
    assert changed_m[5] < 0.8  # where its neighbours alone tell now
    assert np.delete(changed_m, 5).max() < 0.2
    assert 0.5 < before_m[:, 0].mean() < 1.3  # a metre, which all positions are off by


def test_information_on_a_shift_is_that_of_the_error_they_share() -> None:
    rng = np.random.default_rng(4)
    state = moving(rng)
    term = received(state, rng)
    shift = np.tile(np.eye(3), (UNITS, 1, 1))
    expected = [np.ones(UNITS) @ np.linalg.solve(c, np.ones(UNITS)) for c in covariances(term)]
    np.testing.assert_allclose(term.information(shift), np.diag(expected), rtol=1e-8)


@pytest.mark.parametrize(("units", "step_s"), [(40, 0.1), (400, 0.1), (600, 1.0)])
def test_knots_leave_the_information_on_shape_and_place_as_it_is(units: int, step_s: float) -> None:
    time_s = step_s * np.arange(units)
    white_m, wander_m = np.full((units, 3), 0.3), np.full((units, 3), 0.5)
    term = ReceiverPositions.from_samples(
        unit=np.arange(units), time_s=time_s, position_m=np.zeros((units, 3)), white_m=white_m, wander_m=wander_m,
        lever_arm_m=np.zeros(3), wander_time_s=60.0, least_spacing_s=1.0,
    )  # fmt: skip
    assert 1 <= len(term.knots_s) <= MAX_KNOTS
    assert term.knots_s[-1] >= time_s[-1]
    covariance = 0.09 * np.eye(units) + 0.25 * np.exp(-np.abs(time_s[:, None] - time_s) / 60.0)
    ways = np.stack([np.ones(units), time_s - time_s.mean(), (time_s - time_s.mean()) ** 2], axis=1)
    columns = np.zeros((units, 3, 3))
    columns[:, 0] = ways
    exact = np.linalg.inv(ways.T @ np.linalg.solve(covariance, ways))
    stated = np.linalg.inv(term.information(columns))
    ratio = np.sqrt(np.diagonal(stated) / np.diagonal(exact))
    assert (ratio > 0.97).all()  # never more certain than the samples are
    assert (ratio < 1.3).all()


def test_single_sample_is_a_position_with_both_errors() -> None:
    state = moving(np.random.default_rng(5))
    term = ReceiverPositions.from_samples(
        unit=np.array([2]), time_s=np.array([7.0]), position_m=state.unit_position_m[[2]] + [0.5, 0.0, 0.0],
        white_m=np.full((1, 3), 0.3), wander_m=np.full((1, 3), 0.4), lever_arm_m=np.zeros(3), wander_time_s=60.0,
        least_spacing_s=1.0,
    )  # fmt: skip
    term = replace(term, loss_scale=1e6)
    assert term.cost(state) == pytest.approx(0.5, rel=1e-6)  # half a metre of a sigma of half a metre


def test_clusters_of_samples_share_what_knots_leave_out() -> None:
    """Two short visits, long apart: knots are as far apart as on a long drive, samples as near as on a short one."""
    time_s = np.concatenate([0.1 * np.arange(25), 1000.0 + 0.1 * np.arange(25)])
    term = ReceiverPositions.from_samples(
        unit=np.arange(50), time_s=time_s, position_m=np.zeros((50, 3)), white_m=np.full((50, 3), 0.01),
        wander_m=np.ones((50, 3)), lever_arm_m=np.zeros(3), wander_time_s=60.0, least_spacing_s=1.0,
    )  # fmt: skip
    alike = np.exp(-np.abs(time_s[:, None] - time_s) / 60.0)
    covariance = 1e-4 * np.eye(50) + alike
    between = np.where(np.arange(50) < 25, -1.0, 1.0)  # from one visit to the other
    columns = np.zeros((50, 3, 1))
    columns[:, 0, 0] = between
    exact = 1.0 / (between @ np.linalg.solve(covariance, between))
    assert 0.97 < (1.0 / float(term.information(columns)[0, 0])) / exact < 30.0


@pytest.mark.parametrize("common", COMMON)
@pytest.mark.parametrize("knots", [1, 5, UNITS])
def test_the_best_states_solve_the_system_of_their_weights(knots: int, common: tuple[str, ...]) -> None:
    rng = np.random.default_rng(7)
    state = moving(rng)
    term = received(state, rng, knots_s=np.linspace(0.0, 2.0 * (UNITS - 1), knots), loss_scale=2.0)
    term = with_common(term, state, common)
    whitened = term._whitened(state)[1]
    states, of_common, residuals, weights = term._best(whitened)
    assert len(of_common) == term.common_m.shape[2] == ("clock" in common) + 3 * ("lever" in common)
    assert (np.abs(of_common) > 1e-3).all()
    assert 0.0 < weights.min() < 0.9
    np.testing.assert_allclose(residuals, whitened - term._at_samples(states, of_common), atol=1e-12)
    np.testing.assert_allclose(weights, 1.0 / (1.0 + (residuals**2).sum(1) / 4.0), atol=1e-6)
    without = whitened - term._common @ of_common
    for axis in range(3):
        off, diagonal = term._by_knots(weights, axis)
        matrix = np.diag(diagonal) + np.diag(off[1:], 1) + np.diag(off[1:], -1)
        right = term._at_knots((weights * without[:, axis])[:, None], axis)[:, 0]
        np.testing.assert_allclose(matrix @ states[:, axis], right, rtol=1e-5, atol=1e-5)
    pulled = np.einsum("nac,n,na->c", term._common, weights, residuals)
    np.testing.assert_allclose(of_common, pulled, rtol=1e-4, atol=1e-6)
