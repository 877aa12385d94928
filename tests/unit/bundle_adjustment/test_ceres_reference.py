"""Our solver and Ceres, held to the same optimum on random problems of every kind that the adjustment is used for."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.aggregation.positions import DrivePositions, with_bias
from mrasfm_engine.bundle_adjustment.priors import (
    CalibrationPrior,
    CameraPosePrior,
    IntrinsicsPrior,
    PositionPrior,
    Term,
    UprightPrior,
)
from mrasfm_engine.bundle_adjustment.problem import Layout, RowBandMotion
from mrasfm_engine.bundle_adjustment.receiver_positions import ReceiverPositions
from mrasfm_engine.bundle_adjustment.rigid_groups import RigidGroups
from mrasfm_engine.bundle_adjustment.solver import Problem, SolverOptions, solve
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import ADJUSTED, FISHEYE, PERSPECTIVE, RADIAL
from mrasfm_engine.scene.state import State
from tests.helpers.ceres_reference import CeresProblem, solve_with_ceres
from tests.helpers.slow import slow
from tests.helpers.small_problems import focal_prior, make_case, perturbed, project

UNITS, CAMERAS, POINTS = 6, 3, 150
MODELS = ([PERSPECTIVE] * 3, [RADIAL, PERSPECTIVE, RADIAL], [FISHEYE] * 3)
TIGHT = SolverOptions(max_iterations=300, function_tolerance=1e-13, decrement_tolerance=0.0, sigma_px=0.7)

Rng = np.random.Generator
Flags = Sequence[bool]


def problem_at_truth(
    rng: Rng, *, units: Flags, cameras: Flags, free_focal: bool = False, outliers: float = 0.0
) -> Problem:
    """Noisy observations by cameras of random models; the state is the truth."""
    kinds = MODELS[int(rng.integers(3))]
    case = make_case(
        units=UNITS, cameras=CAMERAS, points=POINTS, kinds=kinds, free_units=units, free_cameras=cameras,
        free_focal=free_focal, seed=int(rng.integers(1000)), options=TIGHT,
    )  # fmt: skip
    o, kind = case.problem.observations, case.problem.camera_kind
    if free_focal:  # what COLMAP has models for: fx = fy, two terms of radial distortion
        case.truth.camera_params[:, 1] = case.truth.camera_params[:, 0]
        case.truth.camera_params[:, 6:ADJUSTED] = 0.0
    xy_px = project(case.truth, kind, o.unit, o.camera, o.point)
    xy_px += rng.normal(scale=TIGHT.sigma_px, size=xy_px.shape)
    wrong = rng.random(len(xy_px)) < outliers
    xy_px[wrong] += rng.uniform(-40, 40, (int(wrong.sum()), 2))
    return replace(case.problem, observations=replace(o, xy_px=xy_px))


def started(problem: Problem, rng: Rng, *, terms: Sequence[Term] = (), by: float = 1.0) -> Problem:
    """The problem with terms, and with all that is free moved away."""
    layout, fixed = problem.layout, problem.observations.fixed
    state = perturbed(
        problem.state, rng,
        units=np.flatnonzero(layout.unit_slot >= 0).tolist(), cameras=np.flatnonzero(layout.camera_slot >= 0).tolist(),
        unit_m=0.03 * by, unit_deg=0.1 * by, camera_m=0.01 * by, camera_deg=0.1 * by, point_m=0.05 * by,
        focal=0.002 * by if layout.free_intrinsics[:, 0].any() else 0.0,
    )  # fmt: skip
    state.points_m[fixed] = problem.state.points_m[fixed]
    return replace(problem, state=state, terms=terms)


def calibration_prior(truth: State, rng: Rng, *, off_deg: float = 0.3, off_m: float = 0.02) -> CalibrationPrior:
    """Of a calibration that is off, with sigmas to match."""
    given = perturbed(truth, rng, cameras=range(CAMERAS), camera_deg=off_deg, camera_m=off_m, point_m=0.0)
    return CalibrationPrior(
        rotation=given.camera_rotation,
        position_m=given.camera_position_m,
        sigma_rotation_rad=np.radians(off_deg) * rng.uniform(0.2, 0.5, CAMERAS),
        sigma_translation_m=off_m * rng.uniform(0.2, 0.5, CAMERAS),
        loss_scale=float(rng.uniform(1.0, 4.0)),
    )


def position_prior(
    truth: State, rng: Rng, *, units: Sequence[int] = range(UNITS), off_m: Sequence[float] = (0.0, 0.0, 0.0)
) -> PositionPrior:
    """By an antenna that is not at the rig's origin; each axis of each position has its own sigma, and one is wrong."""
    lever_arm_m, which = rng.uniform([-2, -1, 1], [0, 1, 2]), np.array(units)
    sigma_m = rng.uniform(0.003, 0.01, (len(which), 3))
    measured_m = (truth.unit_position_m + truth.unit_rotation @ lever_arm_m)[which]
    measured_m += rng.normal(size=sigma_m.shape) * sigma_m
    measured_m[rng.integers(len(which))] += rng.normal(size=3)
    return PositionPrior(unit=which, position_m=measured_m + off_m, sigma_m=sigma_m, lever_arm_m=lever_arm_m)


def any_focal_prior(truth: State, rng: Rng) -> IntrinsicsPrior:
    """Of focal lengths that are off by some sigmas."""
    off = rng.choice([-0.003, 0.003], CAMERAS)
    given = truth.camera_params.copy()
    given[:, :2] *= np.exp(off)[:, None]
    return focal_prior(given, rng.uniform(3e-4, 1e-3, CAMERAS))


def upright_prior() -> UprightPrior:
    """Up is not quite the world's z axis."""
    up = se3.exp_so3([0.01, -0.02, 0.0])[:, 2]
    return UprightPrior(unit=np.arange(UNITS), sigma_roll_rad=0.001, sigma_pitch_rad=0.003, up=up)


def images_alone(rng: Rng) -> Problem:
    units, cameras = [u > 0 and rng.random() < 0.8 for u in range(UNITS)], [False, *(rng.random(2) < 0.5).tolist()]
    problem = problem_at_truth(rng, units=units, cameras=cameras, outliers=0.03)
    fixed = rng.random(problem.observations.num_points) < 0.2
    return started(replace(problem, observations=replace(problem.observations, fixed=fixed)), rng)


def calibration(rng: Rng) -> Problem:
    """All cameras are free: the gauge between them and the units is the prior's."""
    problem = problem_at_truth(rng, units=[False] + [True] * 5, cameras=[True] * 3)
    return started(problem, rng, terms=[calibration_prior(problem.state, rng)])


def calibration_with_held_directions(rng: Rng) -> Problem:
    problem = problem_at_truth(rng, units=[False] + [True] * 5, cameras=[True] * 3)
    prior = calibration_prior(problem.state, rng)
    return started(problem, rng, terms=[replace(prior, held=rng.random((CAMERAS, 6)) < 0.3)])


def one_wrong_camera(rng: Rng) -> Problem:
    """The gauge's weights are renewed, as between two solves."""
    problem = problem_at_truth(rng, units=[False] + [True] * 5, cameras=[True] * 3)
    prior = calibration_prior(problem.state, rng, off_deg=0.1)
    given = prior.rotation.copy()
    given[1] = se3.exp_so3(np.radians(5.0) * rng.normal(size=3)) @ given[1]
    prior = replace(prior, rotation=given).with_weights(problem.state)
    assert prior.gauge_weights is not None
    assert prior.gauge_weights[1] < 0.5
    return started(problem, rng, terms=[prior])


def fixed_cameras_share_the_gauge(rng: Rng) -> Problem:
    """One camera stays, not quite where its prior has it."""
    problem = problem_at_truth(rng, units=[False] + [True] * 5, cameras=[False, True, True])
    prior = calibration_prior(problem.state, rng, off_deg=0.02, off_m=0.002)
    return started(problem, rng, terms=[replace(prior, gauge_weights=np.array([1.0, 0.7, 0.4]))])


def poses_of_cameras(rng: Rng) -> Problem:
    """Two of three vary, held direction by direction, and all together, by what was found before."""
    problem = problem_at_truth(rng, units=[False] + [True] * 5, cameras=[True, False, True])
    found = perturbed(problem.state, rng, cameras=range(CAMERAS), camera_deg=0.02, camera_m=0.002, point_m=0.0)
    prior = CameraPosePrior(
        camera=np.arange(CAMERAS),
        rotation=found.camera_rotation,
        position_m=found.camera_position_m,
        sigma=np.column_stack(
            [np.radians(rng.uniform(0.01, 0.1, (CAMERAS, 3))), rng.uniform(1e-3, 1e-2, (CAMERAS, 3))]
        ),
        held=rng.random((CAMERAS, 6)) < 0.3,
    )
    return started(problem, rng, terms=[prior])


def focal_lengths(rng: Rng) -> Problem:
    """Two units are fixed, and give the scale where cameras are free."""
    cameras = [False, True, bool(rng.random() < 0.5)]
    problem = problem_at_truth(rng, units=[False, False] + [True] * 4, cameras=cameras, free_focal=True)
    prior = any_focal_prior(problem.state, rng)
    return started(problem, rng, terms=[prior])


def positions(rng: Rng) -> Problem:
    """No unit is fixed: positions and gravity are the gauge."""
    problem = problem_at_truth(rng, units=[True] * 6, cameras=[False] * 3)
    return started(problem, rng, terms=[position_prior(problem.state, rng), upright_prior()])


def receiver_positions(truth: State, rng: Rng) -> ReceiverPositions:
    """A receiver whose error wanders, with one position that is wrong; knots lie between its samples."""
    prior = position_prior(truth, rng)
    return ReceiverPositions.from_samples(
        unit=prior.unit,
        time_s=np.sort(rng.uniform(0.0, 10.0, UNITS)),
        position_m=prior.position_m + rng.normal(size=3) * 0.05,
        white_m=prior.sigma_m,
        wander_m=rng.uniform(0.005, 0.015, (UNITS, 3)),
        lever_arm_m=prior.lever_arm_m,
        wander_time_s=20.0,
        least_spacing_s=4.0,
    )


def wandering_receiver(rng: Rng) -> Problem:
    """No unit is fixed; the receiver's error is an unknown as well."""
    problem = problem_at_truth(rng, units=[True] * 6, cameras=[False] * 3)
    return started(problem, rng, terms=[receiver_positions(problem.state, rng), upright_prior()])


def wandering_receiver_and_calibration(rng: Rng) -> Problem:
    problem = problem_at_truth(rng, units=[True] * 6, cameras=[True] * 3)
    terms = [calibration_prior(problem.state, rng), receiver_positions(problem.state, rng), upright_prior()]
    return started(problem, rng, terms=terms)


def sets_of_units_with_a_wandering_receiver(rng: Rng) -> Problem:
    problem = sets_of_units_with_positions(rng)
    return replace(problem, terms=[receiver_positions(problem.state, rng), upright_prior()])


def two_receivers(rng: Rng) -> Problem:
    """Two drives whose receivers are off by a constant error each, which is taken off."""
    problem = problem_at_truth(rng, units=[True] * 6, cameras=[False] * 3)
    terms: list[Term] = [upright_prior()]
    for units, off_m in ((range(3), [2.0, -1.0, 0.5]), (range(3, 6), [-1.0, 1.0, 3.0])):
        prior = position_prior(problem.state, rng, units=units, off_m=off_m)
        known = DrivePositions(measured=prior, prior=prior, bias_m=np.zeros(3), up=np.array([0.0, 0.0, 1.0]))
        positions = with_bias(known, problem.state)
        assert 0 < np.linalg.norm(positions.bias_m - off_m) < 0.1
        terms.append(positions.prior)
    return started(problem, rng, terms=terms)


def sets_of_units(rng: Rng) -> Problem:
    problem = problem_at_truth(rng, units=[False] * 2 + [True] * 4, cameras=[False] * 3)
    sets = RigidGroups(of_unit=np.array([-1, -1, 0, 0, 1, 1]), count=2)
    return replace(problem, state=with_sets_moved(problem.state, sets, rng), sets=sets)


def sets_of_units_with_positions(rng: Rng) -> Problem:
    """All units belong to sets: nothing but positions and gravity is the gauge."""
    problem = problem_at_truth(rng, units=[True] * 6, cameras=[False] * 3)
    sets = RigidGroups(of_unit=np.array([0, 0, 0, 1, 1, 1]), count=2)
    terms = [position_prior(problem.state, rng), upright_prior()]
    return replace(problem, state=with_sets_moved(problem.state, sets, rng), sets=sets, terms=terms)


def with_sets_moved(state: State, sets: RigidGroups, rng: Rng) -> State:
    """Each set as a rigid body, and all points."""
    poses = state.world_from_rig
    for k in range(sets.count):
        by = se3.exp_se3(rng.normal(size=6) * [0.002, 0.002, 0.002, 0.05, 0.05, 0.05])
        poses[sets.of_unit == k] = by @ poses[sets.of_unit == k]
    return replace(
        perturbed(state, rng, point_m=0.05),
        unit_rotation=np.ascontiguousarray(poses[:, :3, :3]),
        unit_position_m=np.ascontiguousarray(poses[:, :3, 3]),
    )


def everything(rng: Rng) -> Problem:
    problem = problem_at_truth(rng, units=[True] * 6, cameras=[True] * 3, free_focal=True, outliers=0.03)
    terms = [
        calibration_prior(problem.state, rng),
        any_focal_prior(problem.state, rng),
        position_prior(problem.state, rng),
        upright_prior(),
    ]
    return started(problem, rng, terms=terms)


KINDS: tuple[Callable[[Rng], Problem], ...] = (
    images_alone,
    calibration,
    calibration_with_held_directions,
    one_wrong_camera,
    fixed_cameras_share_the_gauge,
    poses_of_cameras,
    focal_lengths,
    positions,
    wandering_receiver,
    wandering_receiver_and_calibration,
    two_receivers,
    sets_of_units,
    sets_of_units_with_positions,
    sets_of_units_with_a_wandering_receiver,
    everything,
)


WITH_OUTLIERS = (images_alone, everything)
# Ceres begins with states that are zero, where ours are at their best from the first.
WITH_STATES = (wandering_receiver, wandering_receiver_and_calibration, sets_of_units_with_a_wandering_receiver)
AGREEMENT = np.array([1e-5, 1e-5, 1e-8])


def apart(a: State, b: State) -> tuple[float, float, float]:
    """How far units and cameras are apart at most: metres, degrees, and log of focal lengths."""
    turned = [getattr(a, n) @ np.swapaxes(getattr(b, n), 1, 2) for n in ("unit_rotation", "camera_rotation")]
    shifted = [getattr(a, n) - getattr(b, n) for n in ("unit_position_m", "camera_position_m")]
    return (
        float(np.linalg.norm(np.concatenate(shifted), axis=1).max()),
        float(se3.rotation_angle_deg(np.concatenate(turned)).max()),
        float(np.abs(np.log(a.camera_params[:, 0] / b.camera_params[:, 0])).max()),
    )


@pytest.mark.parametrize("seed", [0, *slow(1, 2)])
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_the_optimum_is_that_of_ceres(kind: Callable[[Rng], Problem], seed: int) -> None:
    rng = np.random.default_rng(seed)
    problem = kind(rng)
    solution, report = solve(problem)
    theirs, their_report = solve_with_ceres(problem)
    assert report.final_cost < 0.9 * report.initial_cost
    assert report.parameters == their_report.parameters
    if kind in WITH_OUTLIERS:
        # From afar either may leave a point on the wrong side of an outlier. Ceres finds no place that is clearly
        # better, and from beside ours comes back to it.
        assert report.final_cost <= their_report.final_cost * (1 + 1e-3)
        beside = started(replace(problem, state=solution), rng, terms=problem.terms, by=0.1)
        assert problem.cost(beside.state) > 1.01 * report.final_cost
        theirs, their_report = solve_with_ceres(beside)
    assert their_report.final_cost == pytest.approx(report.final_cost, rel=1e-9)
    assert (np.array(apart(solution, theirs)) < AGREEMENT).all()
    assert (np.array(apart(solution, problem.state)) > 1e3 * AGREEMENT).any()
    if problem.terms:
        without, _ = solve(replace(problem, state=solution, terms=()))
        assert problem.cost(without) > report.final_cost + 0.1
        assert (np.array(apart(solution, without)) > 1e2 * AGREEMENT).any()


@pytest.mark.parametrize("kind", [k for k in KINDS if k not in WITH_STATES], ids=lambda kind: kind.__name__)
def test_ceres_has_the_same_cost_far_from_the_optimum(kind: Callable[[Rng], Problem]) -> None:
    problem = kind(np.random.default_rng(7))
    handed = CeresProblem.of(replace(problem, options=replace(TIGHT, max_iterations=2)))
    summary = handed.adjuster().solve().ceres_summary
    # Ceres leaves out what is constant, and counts in pixels.
    drop = (summary.initial_cost - summary.final_cost) / TIGHT.sigma_px**2
    assert drop > 1
    assert drop == pytest.approx(problem.cost(problem.state) - problem.cost(handed.state()), rel=1e-7)


def test_what_is_fixed_is_as_it_was_given() -> None:
    problem = images_alone(np.random.default_rng(1))
    theirs, _ = solve_with_ceres(problem)
    for name, slot in (("unit", problem.layout.unit_slot), ("camera", problem.layout.camera_slot)):
        for what in (f"{name}_rotation", f"{name}_position_m"):
            before, after = getattr(problem.state, what), getattr(theirs, what)
            np.testing.assert_array_equal(after[slot < 0], before[slot < 0])
            assert (after[slot >= 0] != before[slot >= 0]).any()
    np.testing.assert_array_equal(theirs.camera_params, problem.state.camera_params)


def test_what_colmap_cannot_say_is_refused() -> None:
    problem = everything(np.random.default_rng(0))
    with pytest.raises(ValueError, match="unit's timestamp"):
        CeresProblem.of(replace(problem, motion=RowBandMotion.held(np.zeros(1, dtype=np.int64), np.ones(1))))
    with pytest.raises(ValueError, match="fixed calibration"):
        CeresProblem.of(replace(problem, sets=RigidGroups(of_unit=np.zeros(UNITS, dtype=np.int64), count=1)))
    params = problem.state.camera_params.copy()
    params[1, 1] *= 1.001
    with pytest.raises(ValueError, match=r"camera 1: .*fx = fy"):
        CeresProblem.of(replace(problem, state=replace(problem.state, camera_params=params)))
    params = problem.state.camera_params.copy()
    params[2, 7] = 1e-3
    with pytest.raises(ValueError, match=r"camera 2: .*radial distortion"):
        CeresProblem.of(
            replace(problem, state=replace(problem.state, camera_params=params), camera_kind=np.full(3, RADIAL))
        )
    # Held, they are as good as any.
    held = Layout.from_free(np.ones(UNITS, dtype=np.bool_), np.ones(CAMERAS, dtype=np.bool_))
    CeresProblem.of(replace(problem, state=replace(problem.state, camera_params=params), layout=held))


def test_a_term_that_ceres_cannot_have_is_refused() -> None:
    problem = positions(np.random.default_rng(0))

    class Another:
        pass

    with pytest.raises(ValueError, match="Another"):
        solve_with_ceres(replace(problem, terms=[Another()]))
    o = problem.observations
    with pytest.raises(ValueError, match="no image observes"):
        solve_with_ceres(replace(problem, observations=replace(o, unit=np.minimum(o.unit, UNITS - 2))))


def test_a_free_camera_that_observes_nothing_is_refused() -> None:
    problem = calibration(np.random.default_rng(0))
    o = problem.observations
    with pytest.raises(ValueError, match="camera 2 observes"):
        solve_with_ceres(replace(problem, observations=replace(o, camera=np.minimum(o.camera, 1))))


def test_terms_are_left_to_one_thread() -> None:
    """Ceres' other threads would wait for ever for the interpreter's lock."""
    problem = positions(np.random.default_rng(0))
    problem = replace(problem, options=replace(TIGHT, threads=2))
    alone = replace(problem, terms=())
    threads = [CeresProblem.of(p)._options().ceres.solver_options.num_threads for p in (problem, alone)]
    assert threads == [1, 2]


def test_without_pyceres_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyceres", None)
    monkeypatch.delitem(sys.modules, "tests.helpers.ceres_terms", raising=False)  # another test may have imported it
    monkeypatch.delattr("tests.helpers.ceres_terms", raising=False)
    with pytest.raises(ImportError, match="pyceres: install it"):
        solve_with_ceres(positions(np.random.default_rng(0)))
    _, report = solve_with_ceres(images_alone(np.random.default_rng(0)))
    assert report.final_cost < report.initial_cost
