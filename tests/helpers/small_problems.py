"""Small adjustment problems from simulated observations, and a slow dense reference to compare the solver with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mrasfm_engine.bundle_adjustment.priors import IntrinsicsPrior, Term
from mrasfm_engine.bundle_adjustment.problem import INTRINSICS, Layout, Observations
from mrasfm_engine.bundle_adjustment.reduced_camera_system import Extra
from mrasfm_engine.bundle_adjustment.solver import Problem, SolverOptions
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import (
    FISHEYE,
    OMNIDIRECTIONAL,
    PERSPECTIVE,
    RADIAL,
    RATIONAL,
    packed,
    project_points,
)
from mrasfm_engine.scene.state import State
from mrasfm_engine.synthetic.simulate import SimulatedObservations, simulate_observations

DISTORTION = {
    PERSPECTIVE: [0.0, 0.0, 0.0, 0.0],
    RADIAL: [-0.05, 0.01, 0.0006, -0.0004],
    FISHEYE: [0.02, -0.008, 0.002, -0.0005],
    RATIONAL: [-0.2, 0.05, 0.0006, -0.0004],
    OMNIDIRECTIONAL: [-0.05, 0.01, 0.0006, -0.0004],
}
REST = {RATIONAL: [0.01, -0.1, 0.02, 0.003], OMNIDIRECTIONAL: [1.8]}


@dataclass(frozen=True, kw_only=True)
class Case:
    """A problem at the truth, and what it was made from."""

    truth: State
    problem: Problem
    simulation: SimulatedObservations


def make_case(
    *,
    units: int = 5,
    cameras: int = 3,
    points: int = 300,
    noise_px: float = 0.5,
    outlier_fraction: float = 0.0,
    straight: bool = False,
    kinds: Sequence[int] | None = None,
    free_units: Sequence[bool] | None = None,
    free_cameras: Sequence[bool] | None = None,
    free_focal: bool = False,
    free_intrinsics: bool = False,
    seed: int = 0,
    options: SolverOptions | None = None,
) -> Case:
    """By default the first unit and all cameras are fixed. With `kinds` the observations are exact."""
    rng = np.random.default_rng(seed)
    sim = simulate_observations(
        units=units,
        cameras=cameras,
        points=points,
        noise_px=noise_px,
        outlier_fraction=outlier_fraction,
        straight=straight,
        rng=rng,
    )
    kind = np.zeros(cameras, dtype=np.int64) if kinds is None else np.array(kinds, dtype=np.int64)
    truth = State(
        unit_rotation=np.ascontiguousarray(sim.world_from_rig[:, :3, :3]),
        unit_position_m=np.ascontiguousarray(sim.world_from_rig[:, :3, 3]),
        camera_rotation=np.ascontiguousarray(sim.rig_from_cam[:, :3, :3]),
        camera_position_m=np.ascontiguousarray(sim.rig_from_cam[:, :3, 3]),
        camera_params=np.stack(
            [
                packed(k, [*of_camera, *DISTORTION[k]], REST.get(k, ()))[1]
                for k, of_camera in zip(kind.tolist(), sim.camera_params, strict=True)
            ]
        ),
        camera_time_offset_s=np.zeros(cameras),
        points_m=sim.points_m.copy(),
    )
    order = np.argsort(sim.point, kind="stable")
    unit, camera, point = (a[order].astype(np.int64) for a in (sim.unit, sim.camera, sim.point))
    xy = sim.xy_px[order] if kinds is None else project(truth, kind, unit, camera, point)
    first_fixed = [u > 0 for u in range(units)]
    problem = Problem(
        state=truth,
        camera_kind=kind,
        observations=Observations(unit=unit, camera=camera, point=point, xy_px=xy, num_points=len(sim.points_m)),
        layout=Layout.from_free(
            np.array(first_fixed if free_units is None else free_units, dtype=np.bool_),
            np.array([False] * cameras if free_cameras is None else free_cameras, dtype=np.bool_),
            free_intrinsics=intrinsics_mask(cameras, focal=free_focal, every=free_intrinsics),
        ),
        options=options or SolverOptions(),
    )
    return Case(truth=truth, problem=problem, simulation=sim)


def intrinsics_mask(cameras: int, *, focal: bool, every: bool = False) -> np.ndarray:
    """Which intrinsics (cameras, INTRINSICS) vary: focal lengths, all or none."""
    mask = np.full((cameras, INTRINSICS), every)
    mask[:, 0] |= focal
    return mask


def with_focal(layout: Layout, free: bool) -> Layout:
    """The layout with the focal lengths of its cameras, and no other intrinsics, free or held."""
    return replace(layout, free_intrinsics=intrinsics_mask(layout.num_cameras, focal=free))


def focal_prior(params: np.ndarray, sigma: np.ndarray) -> IntrinsicsPrior:
    """A prior of focal lengths, with sigmas (cameras,) relative to them, and of no other intrinsics."""
    every = np.full((len(params), INTRINSICS), np.inf)
    every[:, 0] = sigma
    return IntrinsicsPrior(params=params.copy(), sigma=every)


def project(state: State, kind: Any, unit: Any, camera: Any, point: Any, band: Any = None) -> np.ndarray:
    """Pixels (n, 2) of points in images, one at a time: slow and plain."""
    world_from_rig = state.world_from_rig[unit]
    if band is not None:
        world_from_rig = world_from_rig @ state.unit_from_band[band]
    cam_from_world = se3.inverse(world_from_rig @ state.rig_from_cam[camera])
    in_camera = se3.apply(cam_from_world, state.points_m[point][:, None, :])[:, 0]
    pixels = np.empty((len(unit), 2))
    for c in range(len(kind)):
        rows = camera == c
        pixels[rows] = project_points(int(kind[c]), state.camera_params[c], in_camera[rows])
    return pixels


def perturbed(
    state: State,
    rng: np.random.Generator,
    *,
    units: Sequence[int] = (),
    cameras: Sequence[int] = (),
    unit_deg: float = 0.5,
    unit_m: float = 0.1,
    camera_deg: float = 0.3,
    camera_m: float = 0.01,
    point_m: float = 0.1,
    focal: float = 0.0,
) -> State:
    """The state with some units and cameras, and all points, moved at random."""
    u, c = np.array(units, dtype=int), np.array(cameras, dtype=int)
    unit_rotation, unit_position = state.unit_rotation.copy(), state.unit_position_m.copy()
    camera_rotation, camera_position = state.camera_rotation.copy(), state.camera_position_m.copy()
    params = state.camera_params.copy()
    unit_rotation[u] = se3.exp_so3(rng.normal(size=(len(u), 3)) * np.radians(unit_deg)) @ unit_rotation[u]
    unit_position[u] += rng.normal(size=(len(u), 3)) * unit_m
    camera_rotation[c] = se3.exp_so3(rng.normal(size=(len(c), 3)) * np.radians(camera_deg)) @ camera_rotation[c]
    camera_position[c] += rng.normal(size=(len(c), 3)) * camera_m
    params[c, :2] *= np.exp(rng.normal(size=(len(c), 1)) * focal)
    return replace(
        state,
        unit_rotation=unit_rotation,
        unit_position_m=unit_position,
        camera_rotation=camera_rotation,
        camera_position_m=camera_position,
        camera_params=params,
        points_m=state.points_m + rng.normal(size=state.points_m.shape) * point_m,
    )


def moved(problem: Problem, state: State, step: np.ndarray) -> State:
    """The state after a step of the full vector: units and cameras as in the layout, then points."""
    n = problem.layout.size
    return problem.retract(state, step[:n], state.points_m + step[n:].reshape(-1, 3))


def weighted_residuals(problem: Problem, state: State) -> np.ndarray:
    """Residuals (2 n,) over sigma, without the loss."""
    o = problem.observations
    pixels = project(state, problem.camera_kind, o.unit, o.camera, o.point, o.band)
    return ((pixels - o.xy_px) / problem.options.sigma_px).ravel()


def dense_normal_equations(problem: Problem, state: State) -> tuple[np.ndarray, np.ndarray]:
    """J'WJ and J'Wr over units, cameras and points by numeric differentiation of the projections, terms included."""
    n = problem.layout.size + state.points_m.size
    jacobian = np.empty((2 * len(problem.observations.unit), n))
    for k in range(n):
        step = np.zeros(n)
        step[k] = 1e-5
        after, before = (weighted_residuals(problem, moved(problem, state, s)) for s in (step, -step))
        jacobian[:, k] = (after - before) / 2e-5
    r = weighted_residuals(problem, state)
    squared = (r.reshape(-1, 2) ** 2).sum(1)
    weight = np.repeat(1.0 / (1.0 + squared / problem.options.loss_scale**2), 2)
    h, g = jacobian.T @ (weight[:, None] * jacobian), jacobian.T @ (weight * r)
    add_terms(problem.terms, problem, state, h, g)
    return h, g


def add_terms(terms: Sequence[Term], problem: Problem, state: State, h: np.ndarray, g: np.ndarray) -> None:
    """Add the terms to the part of units and cameras."""
    n = problem.layout.size
    for term in terms:
        extra = Extra.none(problem.layout)
        term.add_to(state, problem.layout, extra)
        h[:n, :n] += extra.matrix
        g[:n] += extra.gradient


def numeric_gradient(problem: Problem, state: State, coordinates: Sequence[int], cost: Any = None) -> np.ndarray:
    """Derivatives of the cost (by default the problem's) in some coordinates of the full vector."""
    cost = cost or problem.cost
    n = problem.layout.size + state.points_m.size
    result = []
    for k in coordinates:
        step = np.zeros(n)
        step[k] = 1e-6
        result.append((cost(moved(problem, state, step)) - cost(moved(problem, state, -step))) / 2e-6)
    return np.array(result)


def position_errors_m(state: State, truth: State) -> np.ndarray:
    """Distances (units,) between units and where they are in truth."""
    return np.linalg.norm(state.unit_position_m - truth.unit_position_m, axis=1)


def rotation_errors_deg(rotation: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Angles (n,) between rotations."""
    return se3.rotation_angle_deg(rotation @ np.swapaxes(truth, 1, 2))
