"""Terms of the adjustment that are not image observations: calibration, focal lengths, positions, gauges.

Every term adds its cost, and the gradient and Gauss-Newton matrix of its residuals in the reduced vector. There are a
few rows a unit or camera, so plain numpy does.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from mrasfm_engine.bundle_adjustment.cauchy_loss import (
    cauchy_cost,
    cauchy_loss,
    cauchy_weights,
    relative_cauchy_losses,
)
from mrasfm_engine.bundle_adjustment.problem import INTRINSICS, PLACES_OF_INTRINSICS, READOUT, TIME, Layout
from mrasfm_engine.bundle_adjustment.reduced_camera_system import Extra
from mrasfm_engine.geometry import se3
from mrasfm_engine.scene.state import State
from mrasfm_engine.types import Bools, Floats, Ints

# How firmly a gauge is held, relative to the priors: firm enough to hold, soft enough not to hurt the conditioning.
GAUGE_STIFFNESS = 1e6
HELD_SHARE = 0.02  # of a prior's sigma that is left in a direction that is held
CONTRADICTED_SIGMAS = 5.0  # of the prior: a camera farther off than that was not given as well as was declared
GAUGE_USUAL = 3.0  # cameras farther off than this many usual distances hardly count in the gauge, nearer ones alike


class Term(Protocol):
    """Part of the cost over units and cameras."""

    def cost(self, state: State) -> float:
        """Half the (robust) sum of squared residuals."""
        ...

    def add_to(self, state: State, layout: Layout, extra: Extra) -> None:
        """Add J'J (both triangles) and J'r."""
        ...


@dataclass(frozen=True, kw_only=True)
class CalibrationPrior:
    """Keeps `rig_from_cam` near what was given, and holds the gauge between cameras and units.

    Residuals of a camera: rotation vector of R R_given' over sigma, and t - t_given over sigma, in rig axes, with a
    Cauchy loss each over those that are not held: what is held comes back from wherever it has got, and a camera that
    was knocked is turned but still where it was mounted. Moving all cameras by one transform and all units by its
    inverse changes no image: the weighted mean correction of all cameras is held at zero. The weights stay fixed during
    a solve, so that the gauge is linear; they are renewed from the corrections between solves, see
    `robust_gauge_weights`.
    """

    rotation: Floats  # (c, 3, 3) given
    position_m: Floats  # (c, 3) given
    sigma_rotation_rad: Floats  # (c,)
    sigma_translation_m: Floats  # (c,)
    gauge_weights: Floats | None = None  # (c,) equal if None
    loss_scale: float = 3.0  # in sigmas, of one camera's rotation or translation as a whole
    held: Bools | None = None  # (c, 6) directions that stay as given, as the drive does not observe them

    def corrections(self, state: State) -> Floats:
        """Rotation vectors (rad) and translations (m) of all cameras (c, 6) from given to current, in rig axes."""
        return _corrections(state.camera_rotation, state.camera_position_m, self.rotation, self.position_m)

    @property
    def sigma(self) -> Floats:
        """Declared standard deviations (c, 6) of rotations (rad), then of places (m)."""
        return np.repeat(np.stack([self.sigma_rotation_rad, self.sigma_translation_m], 1), 3, axis=1)

    def with_weights(self, state: State, observing: Bools | None = None) -> CalibrationPrior:
        """This prior with the gauge's weights renewed from the corrections of a state.

        Cameras that are not among the `observing` (c,), if there are any of these, have no weight.
        """
        counts = np.ones(len(self.rotation), dtype=np.bool_)
        if observing is not None and observing.any():
            counts = observing
        weights = np.zeros(len(counts))
        weights[counts] = robust_gauge_weights(self._whitened(state)[0][counts])
        return replace(self, gauge_weights=weights)

    def weights_of_places(self, state: State) -> Floats:
        """Weights (c,) of the loss on each camera's place: 1 for one as given, near 0 for one far from there."""
        result: Floats = _loss_weights(self._whitened(state)[0], self.loss_scale)[:, 3]
        return result

    def sigmas_left(self, state: State) -> Floats:
        """Standard deviations (c, 6), rad and m, that the prior has left of rotations, then places.

        Those that were declared, but larger of a rotation or place that is more than `CONTRADICTED_SIGMAS` from what
        was given: as the loss leaves them.
        """
        whitened, sigma = self._whitened(state)
        is_contradicted = np.repeat(_squared(whitened) > CONTRADICTED_SIGMAS**2, 3, axis=1)
        return np.where(is_contradicted, sigma / np.sqrt(_loss_weights(whitened, self.loss_scale)), sigma)

    def _whitened(self, state: State) -> tuple[Floats, Floats]:
        sigma = self.sigma
        return self.corrections(state) / sigma, sigma

    def _held(self) -> Bools:
        return np.zeros((len(self.rotation), 6), dtype=np.bool_) if self.held is None else self.held

    def _gauge(self) -> Floats:
        w = np.ones(len(self.rotation)) if self.gauge_weights is None else self.gauge_weights
        return np.repeat((w / w.sum() * np.sqrt(len(w)))[:, None], 6, axis=1)

    def without_gauge(self, covariance: Floats) -> Floats:
        """A covariance of all cameras' poses (6 c, 6 c), or theirs with something else (6 c,), without what the gauge
        leaves of a common motion.
        """
        cameras = len(self.rotation)
        weights = np.full(cameras, 1.0 / cameras) if self.gauge_weights is None else self.gauge_weights
        sigma = self.sigma.ravel()
        mean = np.kron(np.tile(weights / weights.sum(), (cameras, 1)), np.eye(6))
        own = np.eye(6 * cameras) - mean * sigma[:, None] / sigma
        result: Floats = own @ covariance if covariance.ndim == 1 else own @ covariance @ own.T
        return result

    def cost(self, state: State) -> float:
        """See `Term`."""
        return _cost_of_rig(self._whitened(state)[0], self._held(), self._gauge(), self.loss_scale)

    def add_to(self, state: State, layout: Layout, extra: Extra) -> None:
        """See `Term`."""
        r, sigma = self._whitened(state)
        cameras = np.arange(len(r))
        _add_rig(layout, extra, cameras, r, sigma=sigma, held=self._held(), gauge=self._gauge(), loss=self.loss_scale)


def _corrections(rotation: Floats, position_m: Floats, from_rotation: Floats, from_position_m: Floats) -> Floats:
    """Rotation vectors (rad) and translations (m) of cameras (n, 6) to poses in the rig, in its axes."""
    turn = se3.log_so3(rotation @ np.swapaxes(from_rotation, 1, 2))
    return np.concatenate([turn, position_m - from_position_m], axis=1)


def _cost_of_rig(r: Floats, held: Bools, gauge: Floats, loss_scale: float) -> float:
    """Cost of a rig's corrections over their sigmas (n, 6), and of their weighted mean over gauge (n, 6).

    Of a camera's own there is a Cauchy loss each over rotation and translation, of those that are not held, and squares
    of the rest.
    """
    own = cauchy_loss(_squared(np.where(held, 0.0, r)), loss_scale) + (r[held] ** 2).sum() / HELD_SHARE**2
    return float(0.5 * own + 0.5 * GAUGE_STIFFNESS * ((gauge * r).sum(0) ** 2).sum())


def _squared(r: Floats) -> Floats:
    """Squared lengths (n, 2) of rotations and of translations of r (n, 6)."""
    result: Floats = (r.reshape(-1, 2, 3) ** 2).sum(axis=2)
    return result


def _loss_weights(loose: Floats, loss_scale: float) -> Floats:
    """Weights (n, 6) that the loss gives rotations and translations of corrections over their sigmas (n, 6)."""
    return np.repeat(1.0 / (1.0 + _squared(loose) / loss_scale**2), 3, axis=1)


def _add_rig(
    layout: Layout, extra: Extra, cameras: Ints, r: Floats, *, sigma: Floats, held: Bools, gauge: Floats, loss: float
) -> None:
    """Add what belongs to `_cost_of_rig`, of cameras (n,) with corrections r over sigma (n, 6) each."""
    step = np.tile(np.eye(6), (len(r), 1, 1))  # derivatives of corrections by steps of their cameras
    step[:, :3, :3] = se3.inverse_left_jacobian((r * sigma)[:, :3])
    free = np.flatnonzero(layout.camera_slot[cameras] >= 0)
    rows = (layout.camera_dof * layout.camera_slot[cameras[free]])[:, None] + np.arange(6)
    j = (step / sigma[:, :, None])[free]

    weights = np.where(held, HELD_SHARE**-2, _loss_weights(np.where(held, 0.0, r), loss))[free]
    j_w = np.swapaxes(weights[:, :, None] * j, 1, 2)
    extra.cameras[rows[:, :, None], rows[:, None, :]] += j_w @ j
    extra.camera_gradient[rows] += (j_w @ r[free, :, None])[:, :, 0]

    if not len(free):
        return
    together = np.concatenate(np.sqrt(GAUGE_STIFFNESS) * gauge[free, :, None] * j, axis=1)  # (6, 6 free)
    extra.cameras[np.ix_(rows.ravel(), rows.ravel())] += together.T @ together
    extra.camera_gradient[rows.ravel()] += np.sqrt(GAUGE_STIFFNESS) * together.T @ (gauge * r).sum(0)


def robust_gauge_weights(whitened: Floats) -> Floats:
    """Weights (c,) of cameras in the gauge from their corrections in sigmas (c, 6).

    A camera is compared with how far cameras are from their common correction as a rule, not with the prior's sigma:
    one that is 3 deg off would pass for usual under a prior of 2 deg, and turn the whole vehicle with it. Usual ones
    weigh the same: of errors that are all of one kind the plain mean is nearest to zero. With fewer than three cameras
    there is no majority, and all weigh the same.
    """
    if len(whitened) < 3:
        return np.ones(len(whitened))
    distance = np.linalg.norm(whitened - np.median(whitened, axis=0), axis=1)
    usual = max(float(np.median(distance)), 1e-3)
    result: Floats = 1.0 / (1.0 + (distance / (GAUGE_USUAL * usual)) ** 8)
    return result


@dataclass(frozen=True, kw_only=True)
class CameraPosePrior:
    """Keeps the cameras of one rig near where an earlier adjustment found them, direction by direction.

    Residuals of a camera: rotation vector of R R_found' and t - t_found over their sigmas, in rig axes, with a Cauchy
    loss each over those that are not held. The gauge between cameras and units: the cameras' mean correction is held at
    zero. It is a plain mean, in which no camera stands for the rig because more is known of it.
    """

    camera: Ints  # (n,) all cameras of the rig
    rotation: Floats  # (n, 3, 3)
    position_m: Floats  # (n, 3)
    sigma: Floats  # (n, 6) rotation (rad), translation (m)
    held: Bools  # (n, 6) directions that hardly vary: their residuals are multiplied
    loss_scale: float = 3.0

    def _whitened(self, state: State) -> Floats:
        found = state.camera_rotation[self.camera], state.camera_position_m[self.camera]
        return _corrections(*found, self.rotation, self.position_m) / self.sigma

    def _gauge(self) -> Floats:
        """Weights (n, 6) of whitened corrections in their mean, which is in parts of the largest sigma."""
        result: Floats = self.sigma / self.sigma.max(0) / np.sqrt(len(self.camera))
        return result

    def cost(self, state: State) -> float:
        """See `Term`."""
        return _cost_of_rig(self._whitened(state), self.held, self._gauge(), self.loss_scale)

    def add_to(self, state: State, layout: Layout, extra: Extra) -> None:
        """See `Term`."""
        r = self._whitened(state)
        gauge, loss = self._gauge(), self.loss_scale
        _add_rig(layout, extra, self.camera, r, sigma=self.sigma, held=self.held, gauge=gauge, loss=loss)


@dataclass(frozen=True, kw_only=True)
class IntrinsicsPrior:
    """Keeps intrinsics near what was given: residuals [phi, alpha, cx, cy, d0, d1, d2, d3] - given over sigma.

    phi is the logarithm of fx over what was given, alpha that of fy over fx; see `problem`.
    """

    params: Floats  # (c, PARAMETERS) given
    sigma: Floats  # (c, INTRINSICS); infinite for those of which nothing is known

    def _residuals(self, state: State) -> Floats:
        now, given = state.camera_params, self.params
        off = now[:, :INTRINSICS] - given[:, :INTRINSICS]
        off[:, 0] = np.log(now[:, 0] / given[:, 0])
        off[:, 1] = np.log(now[:, 1] / given[:, 1]) - off[:, 0]
        result: Floats = off / self.sigma
        return result

    def cost(self, state: State) -> float:
        """See `Term`."""
        return float(0.5 * (self._residuals(state) ** 2).sum())

    def add_to(self, state: State, layout: Layout, extra: Extra) -> None:
        """See `Term`."""
        dof = layout.camera_dof
        for camera in np.flatnonzero(layout.camera_slot >= 0).tolist():
            slot = layout.camera_slot[camera]
            varies = np.flatnonzero(layout.free_intrinsics[slot])
            rows = dof * slot + PLACES_OF_INTRINSICS[varies]
            extra.cameras[rows, rows] += 1.0 / self.sigma[camera, varies] ** 2
            extra.camera_gradient[rows] += self._residuals(state)[camera, varies] / self.sigma[camera, varies]


@dataclass(frozen=True, kw_only=True)
class TimePrior:
    """Keeps the cameras' time offsets near zero: residuals are these over sigma, with a Cauchy loss.

    Unless positions tell when they were taken, images later by the same time are a trajectory with other timestamps:
    the weighted mean of all offsets is then held at zero.
    """

    sigma_s: Floats  # (c,)
    held: Bools  # (c,) offsets that stay at zero, as the drive does not observe them
    gauge_weights: Floats | None  # (c,) of the mean; None where it is not held
    loss_scale: float = 3.0

    def without_gauge(self, covariance_s2: Floats) -> Floats:
        """A covariance of all offsets (c, c) without what the gauge leaves of their mean."""
        if self.gauge_weights is None:
            return covariance_s2
        own = np.eye(len(self.sigma_s)) - self.gauge_weights / self.gauge_weights.sum()
        result: Floats = own @ covariance_s2 @ own.T
        return result

    def _gauge(self) -> Floats:
        """Derivative (c,) of the mean's residual by the offsets."""
        weights = np.zeros(len(self.sigma_s)) if self.gauge_weights is None else self.gauge_weights
        shares = weights / max(float(weights.sum()), 1e-12)
        result: Floats = shares * np.sqrt(GAUGE_STIFFNESS * len(shares)) / self.sigma_s.mean()
        return result

    def cost(self, state: State) -> float:
        """See `Term`."""
        r2, s2 = (state.camera_time_offset_s / self.sigma_s) ** 2, self.loss_scale**2
        own = np.where(self.held, r2 / HELD_SHARE**2, s2 * relative_cauchy_losses(r2, self.loss_scale)).sum()
        return float(0.5 * own + 0.5 * (self._gauge() @ state.camera_time_offset_s) ** 2)

    def add_to(self, state: State, layout: Layout, extra: Extra) -> None:
        """See `Term`."""
        cameras = np.flatnonzero(layout.camera_slot >= 0)
        cameras = cameras[layout.free_times[layout.camera_slot[cameras]]]
        rows = layout.camera_dof * layout.camera_slot[cameras] + TIME
        r, gauge = state.camera_time_offset_s / self.sigma_s, self._gauge()
        weights = np.where(self.held, HELD_SHARE**-2, 1.0 / (1.0 + r**2 / self.loss_scale**2))
        extra.cameras[rows, rows] += (weights / self.sigma_s**2)[cameras]
        extra.camera_gradient[rows] += (weights * r / self.sigma_s)[cameras]
        extra.cameras[np.ix_(rows, rows)] += np.outer(gauge[cameras], gauge[cameras])
        extra.camera_gradient[rows] += gauge[cameras] * (gauge @ state.camera_time_offset_s)


@dataclass(frozen=True, kw_only=True)
class ScalePrior:
    """Keeps the scale where it is best known, by what the cameras' corrections from given rotations do to it.

    All else about the rotations is left to other terms.
    """

    rotation: Floats  # (c, 3, 3) rig_from_cam, given
    scale_by_rotation: Floats  # (c, 3) derivative of the logarithm of the scale by their corrections, in rig axes
    log_scale: float  # that they should come to: 0 with the rotations as given
    sigma: float
    sigma_scale: float  # of the scale, by both these rotations and lens models
    sigma_of_corrections: float  # of what the corrections come to, by these rotations alone
    share: float  # of the rotations as given in that; the rest follows images

    def log_scale_of(self, state: State) -> float:
        """Logarithm of the scale that the corrections come to."""
        return self._log_scale_and_turns(state)[0]

    def by_steps(self, state: State) -> Floats:
        """Derivatives (c, 3) of that by steps of the cameras' rotations."""
        turn = self._log_scale_and_turns(state)[1]
        result: Floats = (self.scale_by_rotation[:, None] @ se3.inverse_left_jacobian(turn))[:, 0]
        return result

    def _log_scale_and_turns(self, state: State) -> tuple[float, Floats]:
        turn = se3.log_so3(state.camera_rotation @ np.swapaxes(self.rotation, 1, 2))
        return float((self.scale_by_rotation * turn).sum()), turn

    def cost(self, state: State) -> float:
        """See `Term`."""
        return 0.5 * ((self.log_scale_of(state) - self.log_scale) / self.sigma) ** 2

    def add_to(self, state: State, layout: Layout, extra: Extra) -> None:
        """See `Term`."""
        jacobian = self.by_steps(state) / self.sigma
        free = np.flatnonzero(layout.camera_slot >= 0)
        rows = ((layout.camera_dof * layout.camera_slot[free])[:, None] + np.arange(3)).ravel()
        row = jacobian[free].ravel()
        extra.cameras[np.ix_(rows, rows)] += np.outer(row, row)
        extra.camera_gradient[rows] += (self.log_scale_of(state) - self.log_scale) / self.sigma * row


@dataclass(frozen=True, kw_only=True)
class ReadoutPrior:
    """Knowledge of readouts that are not declared. As these are not estimated, it costs nothing."""

    sigma_s: float

    def cost(self, state: State) -> float:
        """See `Term`."""
        return 0.0

    def add_to(self, state: State, layout: Layout, extra: Extra) -> None:
        """See `Term`."""
        rows = layout.camera_dof * np.flatnonzero(layout.free_readouts) + READOUT
        extra.cameras[rows, rows] += self.sigma_s**-2


@dataclass(frozen=True, kw_only=True)
class PositionPrior:
    """Measured positions of a point of the vehicle (antenna, or the rig's origin), with a Cauchy loss.

    Residual: (t + R lever - measured) / sigma by axis of the world frame.
    """

    unit: Ints  # (n,) units that have a measurement
    position_m: Floats  # (n, 3) in the world frame
    sigma_m: Floats  # (n, 3)
    lever_arm_m: Floats  # (3,) in the rig frame
    loss_scale: float = 3.0

    def _residuals(self, state: State) -> tuple[Floats, Floats]:
        return antenna_residuals(state, self.unit, self.lever_arm_m, self.position_m, self.sigma_m)

    def cost(self, state: State) -> float:
        """See `Term`."""
        return cauchy_cost(self._residuals(state)[1], self.loss_scale)

    def add_to(self, state: State, layout: Layout, extra: Extra) -> None:
        """See `Term`."""
        arm, r = self._residuals(state)
        add_to_units(
            layout, extra, self.unit, antenna_jacobian(arm, self.sigma_m), r, cauchy_weights(r, self.loss_scale)
        )


def antenna_residuals(
    state: State, unit: Ints, lever_arm_m: Floats, position_m: Floats, sigma_m: Floats
) -> tuple[Floats, Floats]:
    """Lever arms (n, 3) of an antenna in world axes, and its distances (n, 3) from positions over sigma."""
    arm = state.unit_rotation[unit] @ lever_arm_m
    return arm, (state.unit_position_m[unit] + arm - position_m) / sigma_m


def antenna_jacobian(arm: Floats, sigma_m: Floats) -> Floats:
    """Derivatives (n, 3, 6) of `antenna_residuals` by steps of the units: d (R arm) / d omega = -[R arm]x."""
    j = np.concatenate([-se3.skew(arm), np.broadcast_to(np.eye(3), (len(arm), 3, 3))], axis=2)
    result: Floats = j / sigma_m[:, :, None]
    return result


def add_to_units(
    layout: Layout, extra: Extra, unit: Ints, jacobian: Floats, residuals: Floats, weights: Floats | None = None
) -> tuple[Ints, Floats, Ints]:
    """Add J'WJ and J'Wr of residuals (n, k) on units (n,), by the first (n, k, d) places of these units' steps.

    Returns the rows (f,) whose unit is free, their J'W (f, d, k), and the units' slots (f,).
    """
    free = np.flatnonzero(layout.unit_slot[unit] >= 0)
    weighted = jacobian[free] if weights is None else weights[free, None, None] * jacobian[free]
    slots, j_w, d = layout.unit_slot[unit[free]], np.swapaxes(weighted, 1, 2), jacobian.shape[2]
    np.add.at(extra.units[:, :d, :d], slots, j_w @ jacobian[free])
    np.add.at(extra.unit_gradient[:, :d], slots, (j_w @ residuals[free, :, None])[:, :, 0])
    return free, j_w, slots


@dataclass(frozen=True, kw_only=True)
class RotationPrior:
    """Measured rotations of units, as of rough poses, with a Cauchy loss over rotation vectors of R R_measured'."""

    unit: Ints  # (n,)
    rotation: Floats  # (n, 3, 3) world_from_rig
    sigma_rad: Floats  # (n,) about each axis
    loss_scale: float = 3.0

    def _residuals(self, state: State) -> Floats:
        turn: Floats = se3.log_so3(state.unit_rotation[self.unit] @ np.swapaxes(self.rotation, 1, 2))
        return turn / self.sigma_rad[:, None]

    def cost(self, state: State) -> float:
        """See `Term`."""
        return cauchy_cost(self._residuals(state), self.loss_scale)

    def add_to(self, state: State, layout: Layout, extra: Extra) -> None:
        """See `Term`."""
        r = self._residuals(state)
        j = se3.inverse_left_jacobian(r * self.sigma_rad[:, None]) / self.sigma_rad[:, None, None]
        add_to_units(layout, extra, self.unit, j, r, cauchy_weights(r, self.loss_scale))


@dataclass(frozen=True, kw_only=True)
class UprightPrior:
    """Vehicles are upright on average: roll and pitch are zero within a road's cross fall and grade.

    A road's slope is common to the units of a drive, so together they count as one measurement. On a straight way this
    alone says how the scene is turned about that line.
    """

    unit: Ints  # (n,)
    sigma_roll_rad: float
    sigma_pitch_rad: float
    up: Floats = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))  # (3,) unit vector of the world frame

    def _axes(self, state: State) -> Floats:
        """Axes (n, 2, 3): the rig's y axis (left) tells roll, its x axis (forward) pitch.

        They are divided by the sigmas, with which all units together count as one measurement.
        """
        scale = np.array([self.sigma_roll_rad, self.sigma_pitch_rad]) * np.sqrt(len(self.unit))
        axes: Floats = np.swapaxes(state.unit_rotation[self.unit][:, :, [1, 0]] / scale, 1, 2)
        return axes

    def cost(self, state: State) -> float:
        """See `Term`."""
        return float(0.5 * ((self._axes(state) @ self.up) ** 2).sum())

    def add_to(self, state: State, layout: Layout, extra: Extra) -> None:
        """See `Term`."""
        axes = self._axes(state)
        add_to_units(layout, extra, self.unit, np.cross(axes, self.up), axes @ self.up)
