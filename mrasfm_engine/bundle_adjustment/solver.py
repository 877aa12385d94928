"""Levenberg-Marquardt over the reduced system of camera set bundle adjustment."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property

import numpy as np
from threadpoolctl import ThreadpoolController

from mrasfm_engine.bundle_adjustment.anderson_acceleration import AndersonAcceleration
from mrasfm_engine.bundle_adjustment.back_substitution import add_scores, substitute
from mrasfm_engine.bundle_adjustment.image_sums import add_images, num_image_sums
from mrasfm_engine.bundle_adjustment.kernels import Bands, Loss, Motion, Observed, Slots, Views, squared_errors
from mrasfm_engine.bundle_adjustment.point_elimination import Sums, accumulate
from mrasfm_engine.bundle_adjustment.point_refinement import point_costs, refine_points
from mrasfm_engine.bundle_adjustment.priors import Term
from mrasfm_engine.bundle_adjustment.problem import DISTORTION, UNIT_DOF, Layout, Observations, RowBandMotion, retract
from mrasfm_engine.bundle_adjustment.reduced_camera_system import Extra, ReducedCameraSystem
from mrasfm_engine.bundle_adjustment.rigid_groups import RigidGroups
from mrasfm_engine.bundle_adjustment.schur_structure import SchurStructure
from mrasfm_engine.geometry.camera_model import with_limit
from mrasfm_engine.parallel import even_bounds, in_parts, in_ranges
from mrasfm_engine.scene.state import State
from mrasfm_engine.types import Bools, Cancel, Floats, Ints

POINT_STEPS = 2  # steps of points whose poses have moved
MAX_DAMPING_OF_DECREMENT = 1e-3  # under more, the decrement of a step says little about where the minimum is


class Termination(StrEnum):
    """Reason for which the solver stopped."""

    CONVERGED = "converged"
    ITERATIONS = "iteration limit"
    NO_PROGRESS = "no step lowers the cost"
    NOTHING_FREE = "nothing to adjust"


@dataclass(frozen=True, kw_only=True)
class SolverOptions:
    """Options of one solve."""

    max_iterations: int = 50
    function_tolerance: float = 1e-6  # relative decrease of the cost below which it has converged
    # Newton decrement below which poses and calibration have converged, in squared standard deviations: no combination
    # of them is farther than sqrt(2 decrement) of its sigmas from the minimum. What is left is points that move
    # between their robust weights, which moves no pose.
    decrement_tolerance: float = 5e-3
    # Whether what two steps that were applied as they are let expect of all further ones may be as small, instead of
    # the last step itself. Along a flat direction it goes on for longer than these show: only where further adjustments
    # follow, and of many units.
    expects_rest: bool = False
    initial_damping: float = 1e-4  # less where the start is good: weak directions, as scale, are damped most
    loss_scale: float = 2.0  # of the Cauchy loss, in sigmas
    sigma_px: float = 1.0  # standard deviation of an observation
    is_curved: bool = False  # see `kernels.Loss`
    threads: int = 1

    @property
    def loss(self) -> Loss:
        """The loss as compiled functions take it."""
        return Loss(self.sigma_px, self.loss_scale**2, self.is_curved)


@dataclass(frozen=True, kw_only=True)
class Report:
    """Course of a solve."""

    initial_cost: float
    final_cost: float
    iterations: int
    termination: Termination
    observations: int
    parameters: int  # all unknowns
    pose_parameters: int  # those of units and cameras: the size of the reduced system


@dataclass(kw_only=True)
class Problem:
    """One adjustment: what is observed, what is free and what else is known."""

    state: State
    camera_kind: Ints
    observations: Observations
    layout: Layout
    terms: Sequence[Term] = ()
    options: SolverOptions = field(default_factory=SolverOptions)
    motion: RowBandMotion | None = None  # needed where the state has row bands
    sets: RigidGroups | None = None  # free units that move as one; then calibration is fixed

    def errors_px2(self, state: State) -> Floats:
        """Squared reprojection errors (n,) of all observations."""
        views, out = self._views(state), np.empty(len(self.observations.unit))
        in_ranges(
            self.options.threads,
            len(out),
            lambda lo, hi: squared_errors(*views, state.points_m, self._observed, lo, hi, out),
        )
        return out

    def _views(self, state: State) -> tuple[Views, Bands | None]:
        views = Views(
            state.unit_rotation,
            state.unit_position_m,
            state.camera_rotation,
            state.camera_position_m,
            self.camera_kind,
            state.camera_params,
        )
        if state.simultaneous:
            return views, None
        assert self.observations.band is not None, "a state with row bands has observations in them"
        held, cameras = np.zeros((len(state.band_rotation), 6)), np.zeros((len(self.camera_kind), 3))
        velocity, readout = (held, cameras) if self.motion is None else (self.motion.velocity, self.motion.readout)
        return views, Bands(state.band_rotation, state.band_position_m, self.observations.band, velocity, readout)

    @property
    def _motion(self) -> Motion | None:
        return None if self.motion is None else Motion(self.motion.support, self.motion.weight)

    @property
    def _observed(self) -> Observed:
        o = self.observations
        assert o.fixed is not None, "set when observations are made"
        return Observed(o.unit, o.camera, o.point, o.xy_px, o.first_of_point, o.fixed)

    @property
    def _slots(self) -> Slots:
        layout = self.layout
        return Slots(layout.unit_slot, layout.camera_slot, layout.num_units, (0,) * (layout.camera_dof - 6))

    def retract(self, state: State, step: Floats, points_m: Floats) -> State:
        """The state after a step of the reduced vector, with new points."""
        move = retract if self.sets is None else self.sets.retract
        after = move(state, self.layout, step, points_m)
        return after if self.motion is None else self.motion.place_bands(after)

    def cost(self, state: State) -> float:
        """Half the robust sum of squares."""
        return self._sum(state, self.point_costs(state))

    def _sum(self, state: State, costs: Floats) -> float:
        images = 0.5 * self.options.loss_scale**2 * costs.sum()
        return float(images + sum(term.cost(state) for term in self.terms))

    def point_costs(self, state: State) -> Floats:
        """Sums (p,) of log(1 + r^2 / s^2) over the observations of every point."""
        views, observed, out = self._views(state), self._observed, np.empty(self.observations.num_points)
        scale2 = (self.options.loss_scale * self.options.sigma_px) ** 2
        in_ranges(
            self.options.threads,
            len(out),
            lambda lo, hi: point_costs(*views, state.points_m, observed, scale2, lo, hi, out),
        )
        return out

    def of_points(self, chosen: Bools) -> Problem:
        """The problem of some of the points (p,) and what observes them."""
        o = self.observations
        rows = chosen[o.point]
        number = np.cumsum(chosen) - 1
        return replace(
            self,
            state=replace(self.state, points_m=self.state.points_m[chosen]),
            observations=Observations(
                unit=o.unit[rows],
                camera=o.camera[rows],
                point=number[o.point[rows]],
                xy_px=o.xy_px[rows],
                num_points=int(chosen.sum()),
                band=None if o.band is None else o.band[rows],
                fixed=None if o.fixed is None else o.fixed[chosen],
            ),
        )

    def with_points_refined(self, state: State) -> State:
        """The state with every point moved to where poses and calibration want it; only those that gain move."""
        result = replace(state, points_m=state.points_m.copy())
        self.refine_points(result, state, np.full(len(state.points_m), np.inf), steps=POINT_STEPS)
        return result

    def refine_points(
        self, state: State, before: State, costs_before: Floats, *, steps: int = 1
    ) -> tuple[Floats, float]:
        """Let points, in place, follow a step of poses and calibration by themselves; their costs, and that of all."""
        views, observed, options = self._views(state), self._observed, self.options
        costs = np.empty(self.observations.num_points)
        in_ranges(
            options.threads,
            len(costs),
            lambda lo, hi: refine_points(
                *views, state.points_m, observed, options.loss,
                before.points_m, costs_before, steps, lo, hi, costs,
            ),
        )  # fmt: skip
        return costs, self._sum(state, costs)

    @cached_property
    def structure(self) -> SchurStructure:
        """Blocks that the points couple; the same for every state."""
        return SchurStructure.from_observations(self.observations, self.layout, self.motion)

    def with_curvature(self) -> Problem:
        """The problem with the curvature of its loss; both have one structure."""
        result = copy.copy(self)
        result.options = replace(self.options, is_curved=True)
        return result

    def normal_equations(self, state: State, damping: float) -> ReducedCameraSystem:
        """The reduced system at a state."""
        o, layout, options, structure = self.observations, self.layout, self.options, self.structure
        units, cameras, dof, p = layout.num_units, layout.num_cameras, layout.camera_dof, o.num_points
        parts = min(options.threads, max(1, p // 256))
        images = np.zeros((parts, len(structure.image_unit), num_image_sums(dof - 6)))
        blocks = (
            np.zeros((parts, len(structure.pattern.row), UNIT_DOF * UNIT_DOF)),
            np.zeros((parts, cameras, units, dof * UNIT_DOF)),
            np.zeros((parts, cameras, cameras, dof * dof)),
        )
        gradient = np.zeros((parts, layout.size))
        v_inverse, v_gradient = np.empty((p, 6)), np.empty((p, 3))
        views, motion, observed, free_slots, groups = (
            self._views(state), self._motion, self._observed, self._slots, structure.groups
        )  # fmt: skip
        in_parts(
            structure.shares(parts),
            lambda lo, hi, t: accumulate(
                *views, motion, state.points_m, observed, structure.image, free_slots, groups, options.loss, damping,
                lo, hi,
                Sums(images[t], blocks[0][t], blocks[1][t], blocks[2][t], gradient[t], v_inverse, v_gradient),
            ),
        )  # fmt: skip
        sums = tuple(part[0] if parts == 1 else part.sum(0) for part in (*blocks, np.zeros_like(gradient), gradient))
        add_images(
            *views, motion, structure.image_unit, structure.image_camera, structure.image_band, free_slots,
            structure.pattern.first, structure.pattern.row,
            images.sum(0), *sums,
        )  # fmt: skip
        extra = Extra.none(layout)
        for term in self.terms:
            term.add_to(state, layout, extra)
        return ReducedCameraSystem.from_sums(layout, structure, sums, (v_inverse, v_gradient), extra)

    def step(self, state: State, system: ReducedCameraSystem, damping: float) -> Floats | None:
        """The damped step (n,) of the reduced vector; None where there is none."""
        return system.step(damping) if self.sets is None else self.sets.step(system, state, damping)

    def accelerated(
        self, state: State, acceleration: AndersonAcceleration, step: Floats, system: ReducedCameraSystem
    ) -> Floats:
        """The update (n,) for a step (n,) by the iterations before; the step itself where these tell nothing of it."""
        update = acceleration.update_for(step, system.gradient)
        if self.sets is None or update is step:
            return update
        update = self.sets.mean_step(state, self.layout, update)
        return update if float(update @ system.gradient) < 0.0 else step

    @property
    def unknowns(self) -> int:
        """Number of unknowns of the reduced vector."""
        return self.layout.size - len(self.layout.held()) if self.sets is None else self.sets.size

    def points_after(self, state: State, system: ReducedCameraSystem, step: Floats) -> Floats:
        """Points (p, 3) that go with a step of the reduced vector."""
        views, motion, observed, free_slots = self._views(state), self._motion, self._observed, self._slots
        options, out = self.options, np.empty_like(state.points_m)
        in_ranges(
            options.threads,
            len(out),
            lambda lo, hi: substitute(
                *views, motion, state.points_m, observed, free_slots, options.loss,
                step, system.v_inverse, system.v_gradient, lo, hi, out,
            ),
        )  # fmt: skip
        return out

    def after(
        self, state: State, costs: Floats, system: ReducedCameraSystem, step: Floats
    ) -> tuple[State, Floats, float]:
        """The state after a step (n,) of the reduced vector, with its points' costs (p,) and that of all."""
        result = self.retract(state, step, self.points_after(state, system, step))
        return result, *self.refine_points(result, state, costs)

    def scores(
        self, state: State, system: ReducedCameraSystem, columns: Floats, group: Ints, point_groups: int
    ) -> tuple[Floats, Floats]:
        """Sums (groups, k) of J' w r over the observations of each group, along k steps of everything but points.

        And over those of points (point_groups, k), dealt out to so many groups in turn.

        Parameters
        ----------
        columns
            (n, k) steps of the reduced vector; the points follow them.
        group
            Of each observation.
        """
        o, count = self.observations, columns.shape[1]
        parts = np.zeros((self.options.threads, int(group.max(initial=-1)) + 1, count))
        point_parts = np.zeros((self.options.threads, point_groups, count))
        views, motion, observed, free_slots = self._views(state), self._motion, self._observed, self._slots
        most, along = int(np.diff(o.first_of_point).max(initial=0)), np.ascontiguousarray(columns)
        in_parts(
            even_bounds(o.num_points, self.options.threads),
            lambda lo, hi, part: add_scores(
                *views, motion, state.points_m, observed, free_slots, self.options.loss,
                along, system.v_inverse, group, most, lo, hi, parts[part], point_parts[part],
            ),
        )  # fmt: skip
        return parts.sum(0), point_parts.sum(0)


_THREADS = ThreadpoolController()
SMALL_SYSTEM = 1500  # unknowns; on smaller ones BLAS threads cost more than they bring


def solve(problem: Problem, *, cancel: Cancel | None = None) -> tuple[State, Report]:
    """Minimise the problem's cost.

    Parameters
    ----------
    problem
        What to adjust; its state is where the search starts.
    cancel
        Asked between iterations; where it answers True the best state so far is returned.

    Returns
    -------
    state, report
        The state of lowest cost that was found, and how it went.

    Notes
    -----
    Damping follows Madsen, Nielsen and Tingleff, "Methods for Non-Linear Least Squares Problems" (2004), section 3.2.

    Updates are accelerated, see `anderson_acceleration`; instead of one that costs more, the step is applied as it is.
    """
    if problem.layout.size < SMALL_SYSTEM:
        with _THREADS.limit(limits=1, user_api="blas"):
            state, report = _minimise(problem, cancel)
    else:
        state, report = _minimise(problem, cancel)
    if problem.layout.free_intrinsics[:, DISTORTION:].any():
        # Not at every step: what a camera shows must not change while costs are compared.
        limited = [
            with_limit(int(kind), own) for kind, own in zip(problem.camera_kind, state.camera_params, strict=True)
        ]
        state = replace(state, camera_params=np.stack(limited))
    return state, report


def _decrement_left(before: float, decrement: float) -> float:
    """Decrement that is left after a step, from those of the step before and of itself.

    The steps that follow go on shrinking as these two do. It is at most that of the step itself, as a rule by which
    more slowly shrinking ones end as well.
    """
    if not 0.0 < decrement < before:
        return decrement
    rate = math.sqrt(decrement / before)
    return decrement * min(rate / (1.0 - rate), 1.0) ** 2


def _minimise(problem: Problem, cancel: Cancel | None) -> tuple[State, Report]:
    options, state = problem.options, problem.state
    costs = problem.point_costs(state)
    cost = initial = problem._sum(state, costs)
    damping, raise_by, iterations = options.initial_damping, 2.0, 0
    termination = Termination.ITERATIONS
    free = problem.unknowns
    if not free and not problem.observations.num_free_points:
        termination = Termination.NOTHING_FREE
    acceleration, is_flat = AndersonAcceleration(), False
    as_it_is = 0.0  # decrement of the step before, where neither acceleration nor damping changed it
    while iterations < options.max_iterations and termination is Termination.ITERATIONS:
        if cancel is not None and cancel():
            break
        iterations += 1
        system = problem.normal_equations(state, damping)
        step = problem.step(state, system, damping)
        decrement = 0.0 if step is None else -float(step @ system.gradient)
        left = _decrement_left(as_it_is, decrement) if options.expects_rest else decrement
        # A step that damping holds back is short wherever the minimum is, and its length tells nothing of others.
        is_held_back = damping > MAX_DAMPING_OF_DECREMENT
        if step is not None:
            update = step if is_held_back or is_flat else problem.accelerated(state, acceleration, step, system)
            trial, trial_costs, trial_cost = problem.after(state, costs, system, update)
            if update is not step and not trial_cost < cost:
                acceleration.clear()
                update = step
                trial, trial_costs, trial_cost = problem.after(state, costs, system, step)
            if not is_held_back:
                acceleration.record(step, system.gradient, update)
        if step is None or not trial_cost < cost:
            acceleration.clear()
            as_it_is, is_flat = 0.0, False
            if damping > 1e8:
                termination = Termination.NO_PROGRESS
            elif step is not None and trial_cost - cost <= options.function_tolerance * cost * 1e-3:
                termination = Termination.CONVERGED  # at the bottom, rounding decides about up or down
            damping, raise_by = damping * raise_by, raise_by * 2.0
            continue
        as_it_is = decrement if update is step and not is_held_back else 0.0
        is_flat = cost - trial_cost <= options.function_tolerance * cost
        # An accelerated update may end as high on the other side of the minimum: the next step is applied as it is.
        if (is_flat and update is step) or (free and not is_held_back and left <= options.decrement_tolerance):
            termination = Termination.CONVERGED
        state, cost, costs = trial, trial_cost, trial_costs
        damping, raise_by = max(damping / 5.0, 1e-10), 2.0
    return state, Report(
        initial_cost=initial,
        final_cost=cost,
        iterations=iterations,
        termination=termination,
        observations=len(problem.observations.unit),
        parameters=free + 3 * problem.observations.num_free_points,
        pose_parameters=free,
    )
