from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.bundle_adjustment.kernels import BEHIND_PX
from mrasfm_engine.bundle_adjustment.priors import (
    CalibrationPrior,
    IntrinsicsPrior,
    PositionPrior,
    TimePrior,
    UprightPrior,
)
from mrasfm_engine.bundle_adjustment.problem import (
    CAMERA_DOF,
    FOCAL,
    LENS,
    READOUT,
    TIME,
    UNIT_DOF,
    Layout,
    Observations,
    RowBandMotion,
)
from mrasfm_engine.bundle_adjustment.solver import Problem, SolverOptions, Termination, solve
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import FISHEYE, OMNIDIRECTIONAL, PERSPECTIVE, RADIAL, RATIONAL, packed
from mrasfm_engine.geometry.local_motion import local_motion
from mrasfm_engine.scene.state import State
from tests.helpers.small_problems import (
    Case,
    dense_normal_equations,
    focal_prior,
    intrinsics_mask,
    make_case,
    moved,
    numeric_gradient,
    perturbed,
    project,
)


def case_of_all_kinds(seed: int = 0, *, free_intrinsics: bool = False) -> tuple[Case, State]:
    """Cameras of all kinds, everything free but the first unit, away from the optimum.

    Of a perspective one no distortion varies, so there is none where all intrinsics do.
    """
    case = make_case(
        units=3,
        cameras=5,
        points=90,
        kinds=[RADIAL if free_intrinsics else PERSPECTIVE, RADIAL, FISHEYE, RATIONAL, OMNIDIRECTIONAL],
        free_units=[False, True, True],
        free_cameras=[True] * 5,
        free_focal=True,
        free_intrinsics=free_intrinsics,
        seed=seed,
        options=SolverOptions(sigma_px=0.7, loss_scale=2.0),
    )
    rng = np.random.default_rng(seed)
    state = perturbed(
        case.truth,
        rng,
        units=[1, 2],
        cameras=range(5),
        unit_deg=0.05,
        unit_m=0.01,
        camera_deg=0.05,
        camera_m=0.005,
        point_m=0.02,
        focal=0.002,
    )
    return case, state


def with_bands(case: Case, state: State, seed: int = 0) -> tuple[Problem, State]:
    """Every image of the case at a time of its own, the rig somewhere else for each; observed is what follows."""
    rng, cameras = np.random.default_rng(seed), len(case.problem.camera_kind)
    count = len(state.unit_rotation) * cameras
    motion = {
        "band_rotation": se3.exp_so3(0.05 * rng.normal(size=(count, 3))),
        "band_position_m": 0.4 * rng.normal(size=(count, 3)),
    }
    o, truth = case.problem.observations, replace(case.truth, **motion)
    band = o.unit * cameras + o.camera
    seen = project(truth, case.problem.camera_kind, o.unit, o.camera, o.point, band)
    observations = replace(o, xy_px=np.where(np.isfinite(seen), seen, o.xy_px), band=band)
    held = RowBandMotion.held(np.repeat(np.arange(len(state.unit_rotation)), cameras), np.ones((cameras, 3)))
    return replace(case.problem, observations=observations, motion=held), replace(state, **motion)


def all_terms(case: Case) -> list[CalibrationPrior | PositionPrior | UprightPrior | IntrinsicsPrior]:
    truth, units = case.truth, np.arange(len(case.truth.unit_rotation))
    return [
        CalibrationPrior(
            rotation=truth.camera_rotation,
            position_m=truth.camera_position_m,
            sigma_rotation_rad=np.full(len(truth.camera_rotation), np.radians(2.0)),
            sigma_translation_m=np.full(len(truth.camera_rotation), 0.05),
        ),
        focal_prior(truth.camera_params, np.full(len(truth.camera_params), 0.002)),
        PositionPrior(
            unit=units,
            position_m=truth.unit_position_m + np.array([0.1, -0.2, 0.3]),
            sigma_m=np.tile([0.05, 0.06, 0.1], (len(units), 1)),
            lever_arm_m=np.array([-0.5, 0.3, 1.8]),
        ),
        UprightPrior(unit=units, sigma_roll_rad=0.03, sigma_pitch_rad=0.08),
    ]


def schur(h: np.ndarray, g: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """The reduced system of a dense one of which n unknowns are not points."""
    structure = h[:n, n:] @ np.linalg.inv(h[n:, n:])
    return h[:n, :n] - structure @ h[n:, :n], g[:n] - structure @ g[n:]


@pytest.mark.parametrize("free_intrinsics", [False, True])
def test_the_cost_has_the_gradient_of_all_camera_kinds_and_terms(free_intrinsics: bool) -> None:
    case, state = case_of_all_kinds(free_intrinsics=free_intrinsics)
    problem = replace(case.problem, terms=all_terms(case)[1:])  # the gauge's weights are held in a step: tested apart
    _, g = dense_normal_equations(problem, state)
    numeric = numeric_gradient(problem, state, range(len(g)))
    np.testing.assert_allclose(g, numeric, rtol=1e-4, atol=1e-4 * np.abs(g).max())
    # The points' part and, after elimination, the rest, as the compiled code has them.
    system = problem.normal_equations(state, 0.0)
    np.testing.assert_allclose(system.v_gradient.ravel(), numeric[problem.layout.size :], rtol=1e-4, atol=0.05)


@pytest.mark.parametrize("with_terms", [False, True])
@pytest.mark.parametrize("free_intrinsics", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_the_reduced_system_is_the_schur_complement_of_the_full_one(
    seed: int, free_intrinsics: bool, with_terms: bool
) -> None:
    case, state = case_of_all_kinds(seed, free_intrinsics=free_intrinsics)
    problem = replace(case.problem, terms=all_terms(case) if with_terms else ())
    h, g = dense_normal_equations(problem, state)
    n = problem.layout.size
    matrix, gradient = schur(h, g, n)
    system = problem.normal_equations(state, 0.0)
    scale = np.sqrt(np.diagonal(h)[:n]) + 1e-9
    np.testing.assert_allclose(system.matrix / np.outer(scale, scale), matrix / np.outer(scale, scale), atol=1e-5)
    np.testing.assert_allclose(system.gradient / scale, gradient / scale, atol=1e-4 * np.abs(gradient / scale).max())
    np.testing.assert_allclose(system.diagonal, np.diagonal(h)[:n], rtol=1e-5)
    np.testing.assert_array_equal(system.matrix, system.matrix.T)


@pytest.mark.parametrize("free_intrinsics", [False, True])
def test_the_step_equals_that_of_the_dense_full_system(free_intrinsics: bool) -> None:
    case, state = case_of_all_kinds(free_intrinsics=free_intrinsics)
    problem = replace(case.problem, terms=all_terms(case))
    damping, n = 1e-3, problem.layout.size
    h, g = dense_normal_equations(problem, state)
    h[np.diag_indices(len(h))] *= 1 + damping
    held = problem.layout.held()
    h[held, held] += 1.0
    expected = -np.linalg.solve(h, g)
    system = problem.normal_equations(state, damping)
    step = system.step(damping)
    assert step is not None
    np.testing.assert_allclose(step, expected[:n], atol=1e-5 * np.abs(expected[:n]).max())
    points = problem.points_after(state, system, step)
    np.testing.assert_allclose(points, moved(problem, state, expected).points_m, atol=1e-5)
    assert np.abs(points - state.points_m).max() > 1e-3


def test_derivatives_are_right_where_images_are_not_simultaneous() -> None:
    problem, state = with_bands(*case_of_all_kinds())
    n = problem.layout.size
    system = problem.normal_equations(state, 0.0)
    numeric = numeric_gradient(problem, state, range(n + state.points_m.size))
    h, g = dense_normal_equations(problem, state)
    np.testing.assert_allclose(g, numeric, rtol=1e-4, atol=1e-4 * np.abs(g).max())
    np.testing.assert_allclose(system.v_gradient.ravel(), numeric[n:], rtol=1e-4, atol=0.05)
    matrix, gradient = schur(h, g, n)
    scale = np.sqrt(np.diagonal(h)[:n]) + 1e-9
    np.testing.assert_allclose(system.matrix / np.outer(scale, scale), matrix / np.outer(scale, scale), atol=1e-5)
    np.testing.assert_allclose(system.gradient / scale, gradient / scale, atol=1e-4 * np.abs(gradient / scale).max())
    still = replace(problem, observations=replace(problem.observations, band=None))
    alone = replace(state, band_rotation=np.zeros((0, 3, 3)), band_position_m=np.zeros((0, 3)))
    assert problem.cost(state) < 0.5 * still.cost(alone)


def following(case: Case) -> tuple[Problem, State]:
    """A drive whose cameras take their images at different times, and the rig moves as its poses say."""
    units, cameras = len(case.truth.unit_rotation), len(case.problem.camera_kind)
    time_s, offset_s = 0.1 * np.arange(units), np.tile(np.linspace(-0.05, 0.04, cameras), units)
    unit = np.repeat(np.arange(units), cameras)

    def follow(state: State) -> State:
        motion = local_motion(state.world_from_rig, time_s, np.ones(units, dtype=np.bool_))
        moved = motion.at(unit, offset_s + np.tile(state.camera_time_offset_s, units))
        return replace(state, band_rotation=moved[:, :3, :3].copy(), band_position_m=moved[:, :3, 3].copy())

    motion = local_motion(case.truth.world_from_rig, time_s, np.ones(units, dtype=np.bool_))
    o, truth = case.problem.observations, follow(case.truth)
    band = o.unit * cameras + o.camera
    seen = project(truth, case.problem.camera_kind, o.unit, o.camera, o.point, band)
    problem = replace(
        case.problem,
        observations=replace(o, xy_px=np.where(np.isfinite(seen), seen, o.xy_px), band=band),
        motion=RowBandMotion(
            support=motion.support[unit],
            weight=motion.weights(unit, offset_s),
            velocity=motion.velocity_at(unit, offset_s),
            readout=np.tile([0.0, 1 / 720.0, 0.0], (cameras, 1)),
            place_bands=follow,
        ),
        state=truth,
    )
    return problem, follow(perturbed(truth, np.random.default_rng(0), units=range(1, units), unit_m=0.02, point_m=0.05))


def test_derivatives_follow_the_trajectory_that_moves_the_bands() -> None:
    free = {"free_units": [False] + [True] * 4, "free_cameras": [True] * 3}
    problem, state = following(make_case(units=5, cameras=3, points=120, **free))
    n = problem.layout.size
    system = problem.normal_equations(state, 0.0)
    h, g = dense_normal_equations(problem, state)
    matrix, gradient = schur(h, g, n)
    # That a unit's rotation bends the way to its neighbours is left out: some percent of a rotation's effect.
    scale = np.sqrt(np.diagonal(h)[:n]) + 1e-9
    np.testing.assert_allclose(system.matrix / np.outer(scale, scale), matrix / np.outer(scale, scale), atol=0.1)
    held = replace(problem, motion=RowBandMotion.held(np.repeat(np.arange(5), 3), np.ones((3, 3)))).normal_equations(
        state, 0.0
    )
    error, if_held = (np.abs((r.gradient - gradient) / scale).max() for r in (system, held))
    assert 0 < error < 0.1 * np.abs(gradient / scale).max()
    assert if_held > 2 * error


def test_a_time_offset_moves_its_camera_along_the_trajectory() -> None:
    free = {"free_units": [False] * 5, "free_cameras": [True] * 3}
    problem, state = following(make_case(units=5, cameras=3, points=120, **free))
    state = replace(problem.state, points_m=state.points_m)  # velocities are those of the true trajectory
    problem = replace(problem, layout=replace(problem.layout, free_times=np.array([False, True, True])))
    n = problem.layout.size
    assert n == 3 * LENS
    held = {FOCAL, TIME, READOUT} | {k * LENS + place for k in (1, 2) for place in (FOCAL, READOUT)}
    assert set(problem.layout.held()) == held
    system = problem.normal_equations(state, 0.0)
    matrix, gradient = schur(*dense_normal_equations(problem, state), n)
    free = np.setdiff1d(np.arange(n), [place for place in held if place % LENS == READOUT])  # the state has no readout
    scale = np.sqrt(np.diagonal(matrix)[free])
    found, expected = (m[np.ix_(free, free)] / np.outer(scale, scale) for m in (system.matrix, matrix))
    np.testing.assert_allclose(found, expected, atol=1e-3)
    found, expected = (g[free] / scale for g in (system.gradient, gradient))
    np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(expected).max())


@pytest.mark.parametrize(("axis", "side_px"), [(1, 720.0), (0, 1280.0)])
def test_a_readout_moves_rows_by_where_they_are_from_the_middle(axis: int, side_px: float) -> None:
    """And columns, where these are read one after the other."""
    free = {"free_units": [False] * 5, "free_cameras": [True] * 3}
    problem, state = following(make_case(units=5, cameras=3, points=120, **free))
    every = np.ones(3, dtype=np.bool_)
    layout = replace(problem.layout, free_times=every, free_readouts=every)
    # Where all keypoints are at 3/4 of the side, a readout of 4 ms is an offset of 1 ms.
    at = 0.75
    xy_px, readout = problem.observations.xy_px.copy(), np.zeros((3, 3))
    xy_px[:, axis], readout[:, axis] = at * side_px, 1.0 / side_px
    assert problem.motion is not None
    rows, motion = replace(problem.observations, xy_px=xy_px), replace(problem.motion, readout=readout)
    problem = replace(problem, layout=layout, observations=rows, motion=motion)
    cameras = problem.normal_equations(state, 0.0).cameras
    for c in range(3):
        square = cameras[c * LENS : (c + 1) * LENS, c * LENS : (c + 1) * LENS]
        assert square[TIME, TIME] > 0.0
        assert square[READOUT, TIME] == pytest.approx((at - 0.5) * square[TIME, TIME])
        assert square[READOUT, READOUT] == pytest.approx((at - 0.5) ** 2 * square[TIME, TIME])


@pytest.mark.parametrize("mean_is_held", [False, True])
def test_time_offsets_of_cameras_are_found(mean_is_held: bool) -> None:
    problem, _ = following(make_case(units=5, cameras=3, points=300, noise_px=0.0, free_cameras=[True] * 3))
    calibration = all_terms(make_case(units=5, cameras=3))[0]
    firm = replace(calibration, sigma_rotation_rad=np.full(3, 1e-5), sigma_translation_m=np.full(3, 1e-4))
    problem = replace(
        problem,
        layout=replace(problem.layout, free_times=np.ones(3, dtype=np.bool_)),
        terms=[
            firm,
            TimePrior(
                sigma_s=np.full(3, 0.005),
                held=np.zeros(3, dtype=np.bool_),
                gauge_weights=np.ones(3) if mean_is_held else None,
            ),
        ],
    )
    off_s = np.array([0.004, -0.006, 0.003])
    begin = problem.motion.place_bands(replace(problem.state, camera_time_offset_s=off_s))
    assert problem.cost(begin) > 100.0
    solution, report = solve(replace(problem, state=begin))
    assert report.termination is Termination.CONVERGED
    np.testing.assert_allclose(solution.camera_time_offset_s, 0.0, atol=1e-5)


def test_a_drive_that_is_not_simultaneous_is_solved_in_few_steps() -> None:
    case = make_case(units=5, cameras=3, points=200, noise_px=0.0)
    problem, state = following(case)
    solution, report = solve(replace(problem, state=state))
    assert report.termination is Termination.CONVERGED
    assert 2 < report.iterations < 15
    assert report.final_cost < 1e-4
    error_m = np.linalg.norm(solution.unit_position_m - case.truth.unit_position_m, axis=1).max()
    assert 0 < error_m < 1e-3


def test_bands_that_stand_at_their_unit_change_nothing() -> None:
    case, state = case_of_all_kinds()
    problem, moving = with_bands(case, state)
    problem = replace(problem, observations=replace(case.problem.observations, band=problem.observations.band))
    count = len(moving.band_rotation)
    identity = replace(moving, band_rotation=np.tile(np.eye(3), (count, 1, 1)), band_position_m=np.zeros((count, 3)))
    np.testing.assert_allclose(problem.errors_px2(identity), case.problem.errors_px2(state), rtol=1e-9, atol=1e-12)
    a, b = problem.normal_equations(identity, 1e-3), case.problem.normal_equations(state, 1e-3)
    np.testing.assert_allclose(a.matrix, b.matrix, rtol=1e-9, atol=1e-9 * np.abs(b.matrix).max())
    np.testing.assert_allclose(a.gradient, b.gradient, rtol=1e-9, atol=1e-9 * np.abs(b.gradient).max())


def test_threads_share_the_work_without_changing_it() -> None:
    case = make_case(units=6, cameras=6, points=2500, free_cameras=[True] * 6)
    alone = case.problem.normal_equations(case.truth, 1e-4)
    together = replace(case.problem, options=SolverOptions(threads=3)).normal_equations(case.truth, 1e-4)
    assert case.problem.observations.num_points > 1024
    for name in ("matrix", "diagonal", "gradient", "v_inverse", "v_gradient"):
        a, b = getattr(alone, name), getattr(together, name)
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.abs(a).max())


def test_fixed_units_and_cameras_have_no_place_in_the_system() -> None:
    layout = Layout.from_free(np.array([False, True, False, True]), np.array([True, False]))
    assert layout.size == 2 * UNIT_DOF + 7
    assert layout.unit_slot.tolist() == [-1, 0, -1, 1]
    assert layout.held().tolist() == [18]
    one = np.array([True])
    assert not len(Layout.from_free(one, one, free_intrinsics=intrinsics_mask(1, focal=True)).held())
    assert Layout.from_free(one, one, free_intrinsics=intrinsics_mask(1, focal=True, every=True)).size == 6 + CAMERA_DOF


def test_an_observation_behind_its_camera_costs_and_pulls_nothing() -> None:
    case = make_case(units=2, cameras=1, points=40, noise_px=0.0)
    state = replace(case.truth, points_m=case.truth.points_m.copy())
    camera_at = (case.truth.world_from_rig[0] @ case.truth.rig_from_cam[0])[:3, 3]
    state.points_m[0] = camera_at - 10 * case.truth.unit_rotation[0][:, 0]
    rows = case.problem.observations.point == 0
    np.testing.assert_array_equal(case.problem.errors_px2(state)[rows], BEHIND_PX**2)
    assert case.problem.cost(state) > case.problem.cost(case.truth) + 1
    system = case.problem.normal_equations(state, 1e-4)
    assert not system.v_gradient[0].any()
    assert np.isfinite(system.matrix).all()
    step = np.zeros(case.problem.layout.size)
    np.testing.assert_array_equal(case.problem.points_after(state, system, step)[0], state.points_m[0])


def test_a_point_without_depth_stays_where_it_is() -> None:
    # One observation says nothing about depth: its 3x3 block is singular.
    case = make_case(units=1, cameras=1, points=1)
    truth, problem = case.truth, case.problem
    state = replace(truth, points_m=np.array([[20.0, 9.0, 1.0]]))
    single = Problem(
        state=state,
        camera_kind=problem.camera_kind,
        observations=Observations(
            unit=np.zeros(1, np.int64),
            camera=np.zeros(1, np.int64),
            point=np.zeros(1, np.int64),
            xy_px=np.array([[100.0, 100.0]]),
            num_points=1,
        ),
        layout=problem.layout,
    )
    system = single.normal_equations(state, 0.0)
    after = single.points_after(state, system, np.zeros(single.layout.size))
    assert np.isfinite(after).all()
    np.testing.assert_allclose(after, state.points_m, atol=1e-9)


def test_a_point_of_very_many_units_is_still_right() -> None:
    """More free blocks than one point may couple: the rest counts for itself, nothing is written out of bounds."""
    units = 520
    rotation, position = np.tile(np.eye(3), (units, 1, 1)), np.zeros((units, 3))
    position[:, 0] = np.linspace(0, 5, units)
    camera_rotation = np.array([[[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]])
    state = State(
        unit_rotation=rotation,
        unit_position_m=position,
        camera_rotation=camera_rotation,
        camera_position_m=np.zeros((1, 3)),
        camera_params=packed(PERSPECTIVE, [500.0, 500, 480, 270])[1][None],
        camera_time_offset_s=np.zeros(1),
        points_m=np.array([[20.0, 3.0, 1.0]]),
    )
    index = np.arange(units, dtype=np.int64)
    problem = Problem(
        state=state,
        camera_kind=np.zeros(1, np.int64),
        observations=Observations(
            unit=index, camera=index * 0, point=index * 0, xy_px=np.full((units, 2), 300.0), num_points=1
        ),
        layout=Layout.from_free(np.ones(units, np.bool_), np.zeros(1, np.bool_)),
    )
    system = problem.normal_equations(state, 1e-3)
    assert np.isfinite(system.matrix).all()
    assert (system.diagonal > 0).all()
    assert np.abs(system.gradient[-6:]).max() > 0


def test_retract_turns_about_the_axes_of_the_fixed_frame() -> None:
    case = make_case(units=2, cameras=2, points=30, free_cameras=[False, True], free_focal=True)
    step = np.zeros(13)
    step[:6] = [0, 0, 0.1, 1, 2, 3]
    step[6:] = [0.2, 0, 0, 4, 5, 6, 0.01]
    after = moved(case.problem, case.truth, np.concatenate([step, np.zeros(case.truth.points_m.size)]))
    truth = case.truth
    np.testing.assert_allclose(after.unit_rotation[1], se3.exp_so3([0, 0, 0.1]) @ truth.unit_rotation[1])
    np.testing.assert_allclose(after.unit_position_m[1], truth.unit_position_m[1] + [1, 2, 3])
    np.testing.assert_allclose(after.camera_rotation[1], se3.exp_so3([0.2, 0, 0]) @ truth.camera_rotation[1])
    np.testing.assert_allclose(after.camera_position_m[1], truth.camera_position_m[1] + [4, 5, 6])
    np.testing.assert_allclose(after.camera_params[1, :2], truth.camera_params[1, :2] * np.exp(0.01))
    np.testing.assert_array_equal(after.camera_params[1, 2:], truth.camera_params[1, 2:])
    for name in ("unit_rotation", "unit_position_m", "camera_rotation", "camera_position_m", "camera_params"):
        np.testing.assert_array_equal(getattr(after, name)[0], getattr(truth, name)[0])
