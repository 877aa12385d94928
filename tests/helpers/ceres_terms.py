"""The adjustment's terms as residuals of Ceres', for the reference.

They are written from what the terms are defined to be, and share no line of `priors`. COLMAP's own priors would not do:
its prior of a position knows no lever arm, and its prior of a pose holds the sensor's axes where ours holds the rig's.
Ceres evaluates them in Python, so that this is for a few hundred terms. Without pyceres this module cannot be imported.

Poses here are those that Ceres varies: `rig_from_world`, as a quaternion (x y z w) and a translation. Derivatives are
written for a turn omega of that pose, R <- exp(omega) R, and its translation.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pyceres
from numpy.typing import NDArray

from mrasfm_engine.bundle_adjustment import priors
from mrasfm_engine.bundle_adjustment.receiver_positions import ReceiverPositions
from mrasfm_engine.geometry import se3

if TYPE_CHECKING:
    from tests.helpers.ceres_reference import CeresProblem

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

# Residuals (n,) of some blocks, and their derivatives in each of them: (n, 6) of poses, (n, size) of all else.
Function = Callable[[list[Floats]], tuple[Floats, list[Floats]]]
POSE = 7  # numbers


@dataclass(frozen=True, kw_only=True)
class Residuals:
    """Residuals that are added to a problem as one block."""

    function: Function
    count: int
    blocks: list[Floats] = field(default_factory=list)  # what Ceres varies
    loss_scale: float | None = None  # of a Cauchy loss of them as a whole; squares without
    states: list[Floats] = field(default_factory=list)  # blocks of the terms themselves, after those of the problem


def add_terms(handed: CeresProblem, problem: pyceres.Problem) -> list[object]:
    """Add the terms of a problem that was handed over; what is returned must live as long as Ceres works.

    Raises
    ------
    ValueError
        Where a term is of a kind that is not known here, or on something that no image observes.
    """
    sigma_px = handed.problem.options.sigma_px  # Ceres' cost is in pixels, ours in standard deviations of one
    kept: list[object] = []
    for residuals in (r for term in handed.problem.terms for r in _residuals(term, handed)):
        if not all(problem.has_parameter_block(block) for block in residuals.blocks):
            raise ValueError("a term is on a unit or camera that no image observes: COLMAP does not vary it")
        cost = _Cost(residuals, sigma_px)
        loss = None if residuals.loss_scale is None else pyceres.CauchyLoss(residuals.loss_scale * sigma_px)
        problem.add_residual_block(cost, loss, residuals.blocks + residuals.states)
        kept += [cost, loss, *residuals.states]
    return kept


class _Cost(pyceres.CostFunction):
    """Residuals in units of a pixel."""

    def __init__(self, residuals: Residuals, scale: float) -> None:
        super().__init__()
        self.set_num_residuals(residuals.count)
        self.set_parameter_block_sizes([len(block) for block in residuals.blocks + residuals.states])
        self.function, self.scale = residuals.function, scale

    def Evaluate(self, blocks: list[Floats], residuals: Floats, jacobians: list[Floats] | None) -> bool:
        """As Ceres wants it: derivatives by rows, in all numbers of a block."""
        values, derivatives = self.function(blocks)
        residuals[:] = self.scale * values
        for block, out, derivative in zip(blocks, jacobians or [], derivatives, strict=False):
            by_number = _by_quaternion(block, derivative) if len(block) == POSE else derivative
            out[:] = (self.scale * by_number).ravel()
        return True


def _by_quaternion(pose: Floats, by_step: Floats) -> Floats:
    """Derivatives (n, 7) in a pose's numbers, from those (n, 6) in its turn and translation.

    For a unit quaternion q = (v, w), dq = omega q / 2 gives omega = 2 vec(dq q*).
    """
    v, w = pose[:3], pose[3]
    omega = 2.0 * np.column_stack([w * np.eye(3) + se3.skew(v), -v])
    return np.column_stack([by_step[:, :3] @ omega, by_step[:, 3:]])


def _residuals(term: priors.Term, handed: CeresProblem) -> Iterator[Residuals]:
    match term:
        case priors.CalibrationPrior():
            return _calibration(term, handed)
        case priors.CameraPosePrior():
            return _camera_poses(term, handed)
        case priors.IntrinsicsPrior():
            return _focal_lengths(term, handed)
        case priors.PositionPrior():
            return _positions(term, handed)
        case priors.UprightPrior():
            return _upright(term, handed)
        case ReceiverPositions():
            return _receiver(term, handed)
    raise ValueError(f"no residuals of Ceres' are known for a {type(term).__name__}")


def _matrix(pose: Floats) -> tuple[Floats, Floats]:
    return se3.rotation_from_quaternion(pose[:4]), pose[4:]


def _positions(term: priors.PositionPrior, handed: CeresProblem) -> Iterator[Residuals]:
    """(antenna - measured) / sigma, by axes of the world."""
    for u, measured, sigma in zip(term.unit.tolist(), term.position_m, term.sigma_m, strict=True):
        if handed.problem.layout.unit_slot[u] >= 0:
            antenna = se3.apply(handed.reference_from_unit[u], term.lever_arm_m[None])[0]
            yield Residuals(
                function=partial(_position, antenna=antenna, measured=measured, sigma=sigma),
                count=3,
                blocks=[handed.unit_pose(u)],
                loss_scale=term.loss_scale,
            )


def _position(blocks: list[Floats], *, antenna: Floats, measured: Floats, sigma: Floats) -> tuple[Floats, list[Floats]]:
    rotation, translation = _matrix(blocks[0])
    off = rotation.T @ (antenna - translation) - measured
    derivative = np.column_stack([rotation.T @ se3.skew(antenna - translation), -rotation.T])
    return off / sigma, [derivative / sigma[:, None]]


def _receiver(term: ReceiverPositions, handed: CeresProblem) -> Iterator[Residuals]:
    """(antenna - measured - wander d) / sigma, and the steps of the Gauss-Markov process d from knot to knot."""
    states = [np.zeros(3) for _ in term.knots_s]
    yield Residuals(function=lambda blocks: (blocks[0], [np.eye(3)]), count=3, states=[states[0]])
    for k, (before, after) in enumerate(itertools.pairwise(term.knots_s.tolist())):
        kept = float(np.exp((before - after) / term.wander_time_s))
        yield Residuals(function=partial(_process_step, kept=kept), count=3, states=[states[k], states[k + 1]])
    for n, u in enumerate(term.unit.tolist()):
        k = min(int(np.searchsorted(term.knots_s, term.time_s[n], side="right")) - 1, len(states) - 2)
        share = (term.time_s[n] - term.knots_s[k]) / (term.knots_s[k + 1] - term.knots_s[k])
        antenna = se3.apply(handed.reference_from_unit[u], term.lever_arm_m[None])[0]
        yield Residuals(
            function=partial(
                _received,
                position=partial(_position, antenna=antenna, measured=term.position_m[n], sigma=term.sigma_m[n]),
                gain=term.wander_m[n] / term.sigma_m[n],
                share=float(share),
            ),
            count=3,
            blocks=[handed.unit_pose(u)],
            states=[states[k], states[k + 1]],
            loss_scale=term.loss_scale,
        )


def _process_step(blocks: list[Floats], *, kept: float) -> tuple[Floats, list[Floats]]:
    lost = np.sqrt(1.0 - kept**2)
    return (blocks[1] - kept * blocks[0]) / lost, [-kept / lost * np.eye(3), np.eye(3) / lost]


def _received(blocks: list[Floats], *, position: Function, gain: Floats, share: float) -> tuple[Floats, list[Floats]]:
    off, by_pose = position(blocks[:1])
    wander = gain * ((1.0 - share) * blocks[1] + share * blocks[2])
    return off - wander, [*by_pose, -np.diag((1.0 - share) * gain), -np.diag(share * gain)]


def _upright(term: priors.UprightPrior, handed: CeresProblem) -> Iterator[Residuals]:
    """Heights of the rig's left and forward axis, over sigma; all units together count as one measurement."""
    sigma = np.array([term.sigma_roll_rad, term.sigma_pitch_rad]) * np.sqrt(len(term.unit))
    for u in term.unit.tolist():
        if handed.problem.layout.unit_slot[u] >= 0:
            axes = handed.reference_from_unit[u][:3, [1, 0]].T
            yield Residuals(
                function=partial(_heights, axes=axes, up=term.up, sigma=sigma), count=2, blocks=[handed.unit_pose(u)]
            )


def _heights(blocks: list[Floats], *, axes: Floats, up: Floats, sigma: Floats) -> tuple[Floats, list[Floats]]:
    turned = _matrix(blocks[0])[0] @ up
    derivative = np.column_stack([np.cross(turned, axes), np.zeros((2, 3))])  # d (axis . R up) = omega . (R up x axis)
    return axes @ turned / sigma, [derivative / sigma[:, None]]


def _focal_lengths(term: priors.IntrinsicsPrior, handed: CeresProblem) -> Iterator[Residuals]:
    """log(f / given) / sigma."""
    layout = handed.problem.layout
    for c in np.flatnonzero(layout.camera_slot >= 0).tolist() if layout.free_intrinsics[:, 0].any() else ():
        function = partial(_focal_length, given=float(term.params[c, 0]), sigma=float(term.sigma[c, 0]))
        yield Residuals(function=function, count=1, blocks=[handed.intrinsics(c)])


def _focal_length(blocks: list[Floats], *, given: float, sigma: float) -> tuple[Floats, list[Floats]]:
    derivative = np.zeros((1, len(blocks[0])))
    derivative[0, 0] = 1.0 / (blocks[0][0] * sigma)
    return np.array([np.log(blocks[0][0] / given) / sigma]), [derivative]


def _calibration(term: priors.CalibrationPrior, handed: CeresProblem) -> Iterator[Residuals]:
    """Every free camera's correction over its sigmas, and the weighted mean of all cameras' as the gauge."""
    sigma = np.repeat(np.column_stack([term.sigma_rotation_rad, term.sigma_translation_m]), 3, axis=1)
    held = np.zeros(sigma.shape, dtype=np.bool_) if term.held is None else term.held
    count = len(sigma)
    share = np.ones(count) if term.gauge_weights is None else term.gauge_weights
    return _rig(
        handed,
        cameras=np.arange(count),
        given=se3.transform(term.rotation, term.position_m),
        sigma=sigma,
        held=held,
        gauge_weight=np.sqrt(priors.GAUGE_STIFFNESS * count) * (share / share.sum())[:, None] / sigma,
        loss_scale=term.loss_scale,
    )


def _camera_poses(term: priors.CameraPosePrior, handed: CeresProblem) -> Iterator[Residuals]:
    """The same of one rig's cameras, with sigmas of their own for every direction."""
    return _rig(
        handed,
        cameras=term.camera,
        given=se3.transform(term.rotation, term.position_m),
        sigma=term.sigma,
        held=term.held,
        gauge_weight=np.tile(
            np.sqrt(priors.GAUGE_STIFFNESS / len(term.camera)) / term.sigma.max(0), (len(term.camera), 1)
        ),
        loss_scale=term.loss_scale,
    )


def _rig(
    handed: CeresProblem,
    *,
    cameras: Ints,
    given: Floats,
    sigma: Floats,
    held: Bools,
    gauge_weight: Floats,
    loss_scale: float,
) -> Iterator[Residuals]:
    """Corrections of a rig's free cameras by themselves, over their sigmas (n, 6), and their sum with all others'."""
    slot = handed.problem.layout.camera_slot[cameras]
    correction = partial(_correction, rig_from_reference=handed.rig_from_reference)
    free, blocks, offset = np.flatnonzero(slot >= 0), [], np.zeros(6)
    for k in np.flatnonzero(slot < 0).tolist():
        offset += gauge_weight[k] * _difference(handed.problem.state.rig_from_cam[cameras[k]], given[k])
    for k in free.tolist():
        blocks.append(handed.camera_pose(int(cameras[k])))
        turns = np.arange(6) < 3
        for directions, share, loss in (
            (~held[k] & turns, 1.0, loss_scale),
            (~held[k] & ~turns, 1.0, loss_scale),
            (held[k], priors.HELD_SHARE, None),
        ):
            weight = np.where(directions, 1.0 / (share * sigma[k]), 0.0)[None]
            function = partial(_weighted_sum, given=given[[k]], weight=weight, correction=correction)
            yield Residuals(function=function, count=6, blocks=[blocks[-1]], loss_scale=loss)
    if len(free):
        function = partial(
            _weighted_sum, given=given[free], weight=gauge_weight[free], correction=correction, offset=offset
        )
        yield Residuals(function=function, count=6, blocks=blocks)


def _weighted_sum(
    blocks: list[Floats],
    *,
    given: Floats,
    weight: Floats,
    correction: Callable[[Floats, Floats], tuple[Floats, Floats]],
    offset: Floats | None = None,
) -> tuple[Floats, list[Floats]]:
    total, derivatives = np.zeros(6) if offset is None else offset.copy(), []
    for pose, rig_from_given, w in zip(blocks, given, weight, strict=True):
        value, derivative = correction(pose, rig_from_given)
        total += w * value
        derivatives.append(w[:, None] * derivative)
    return total, derivatives


def _difference(rig_from_cam: Floats, rig_from_given: Floats) -> Floats:
    """Rotation vector (rad) and translation (m) from what was given to what is, in the rig's axes (6,)."""
    turn = se3.log_so3(rig_from_cam[:3, :3] @ rig_from_given[:3, :3].T)
    return np.concatenate([turn, rig_from_cam[:3, 3] - rig_from_given[:3, 3]])


def _correction(pose: Floats, rig_from_given: Floats, *, rig_from_reference: Floats) -> tuple[Floats, Floats]:
    """A camera's correction (6,) and its derivative (6, 6) in `cam_from_reference`."""
    rotation, translation = _matrix(pose)
    rig_from_cam = rig_from_reference @ se3.inverse(se3.transform(rotation, translation))
    value, turned = _difference(rig_from_cam, rig_from_given), rig_from_cam[:3, :3]
    derivative = np.zeros((6, 6))
    # exp(omega) of the pose turns rig_from_cam by -rig_from_cam omega from the left.
    derivative[:3, :3] = -se3.inverse_left_jacobian(value[:3]) @ turned
    derivative[3:, :3] = -turned @ se3.skew(translation)
    derivative[3:, 3:] = -turned
    return value, derivative
