"""Interpolation of the motion around each known pose from the poses before and after it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.types import Bools, Floats, Ints

MAX_GAP_S = 2.5  # a pose farther away in time says nothing of how the vehicle moves now
MIN_GAP_S = 0.02  # poses closer in time than this would turn their noise into speed
# Of the intervals to the neighbours before and after. A camera whose clock is an interval late takes its images beyond
# them; there a parabola still holds, to 5 mm at 5 m/s^3 of jerk and 0.1 s between units.
REACH = 2.0
# Of vehicles on roads. A neighbour whose pose is wrong would ask for more.
MAX_ACCELERATION_MPS2 = 12.0
MAX_TURN_ACCELERATION_RADPS2 = 3.0


@dataclass(frozen=True, kw_only=True)
class LocalMotion:
    """Rates of each unit in its own frame: at `offset` seconds t from its timestamp it is

        turned by exp(velocity t + bend t^2),        moved by velocity t + bend t^2

    Places are interpolated apart from rotations: so the place at t is a weighted sum of the units' places, and follows
    any motion and scaling of the whole trajectory exactly. In a turn it cuts the arc by |t (t - a) (t - b)| v w^2 / 6
    with the others at times a and b: 1 mm at 10 m/s, half a radian a second, 0.2 s between units and 50 ms off.
    """

    velocity: Floats  # (u, 6) rotation (rad/s), translation (m/s)
    bend: Floats  # (u, 6) half an acceleration, 1/s^2
    earliest_s: Floats  # (u,) as far back, and
    latest_s: Floats  # (u,) as far forward, as the motion reaches: beyond, the vehicle is taken to stand
    support: Ints  # (u, 3) the units that determine the motion: itself, and one or two others; -1 where there is none
    support_s: Floats  # (u, 2) times of the others, from the unit's own on

    @property
    def known(self) -> Bools:
        """Mask (u,) of poses that have another known pose near them."""
        result: Bools = self.support[:, 1] >= 0
        return result

    def at(self, unit: Ints, offset_s: Floats) -> Floats:
        """`unit_from_then` (n, 4, 4) of units (n,) at seconds (n,) from their timestamps."""
        t = self._clipped(unit, offset_s)[:, None]
        return moved(t * (self.velocity[unit] + t * self.bend[unit]))

    def velocity_at(self, unit: Ints, offset_s: Floats) -> Floats:
        """Velocities (n, 6) at such times, in the axes that the vehicle has then; zero where it is taken to stand."""
        t = self._clipped(unit, offset_s)
        rates = self.velocity[unit] + 2.0 * t[:, None] * self.bend[unit]
        rates[t != offset_s] = 0.0
        then_from_unit = np.swapaxes(self.at(unit, offset_s)[:, :3, :3], 1, 2)
        result: Floats = np.concatenate([(then_from_unit @ rates[:, k : k + 3, None])[..., 0] for k in (0, 3)], axis=1)
        return result

    def weights(self, unit: Ints, offset_s: Floats) -> Floats:
        """Derivatives (n, 3) of interpolated poses by those of the `support` units: Lagrange's polynomials."""
        t, (a, b) = self._clipped(unit, offset_s), self.support_s[unit].T
        result = np.zeros((len(unit), 3))
        one, two = self.support[unit, 1] >= 0, self.support[unit, 2] >= 0
        line, bow = one & ~two, one & two
        result[line, 1] = t[line] / a[line]
        result[bow, 1] = (t * (t - b))[bow] / (a * (a - b))[bow]
        result[bow, 2] = (t * (t - a))[bow] / (b * (b - a))[bow]
        result[:, 0] = 1.0 - result.sum(1)
        return result

    def _clipped(self, unit: Ints, offset_s: Floats) -> Floats:
        return np.clip(offset_s, self.earliest_s[unit], self.latest_s[unit])


def moved(steps: Floats) -> Floats:
    """Transforms (n, 4, 4) of rotation vectors (rad) and translations (m) (n, 6)."""
    return se3.transform(se3.exp_so3(steps[:, :3]), steps[:, 3:])


def local_motion(world_from_rig: Floats, time_s: Floats, known: Bools) -> LocalMotion:
    """The motion around poses (u, 4, 4) at ascending times (u,), from those that are known (u,).

    It is the parabola of places, and of rotation vectors, through a pose and those before and after it; at the ends of
    the drive the next two; with one other pose a line. A pose that is itself not known, or has no other within
    `MAX_GAP_S`, does not move.
    """
    before, after = _neighbours(time_s, known)
    middle = (before >= 0) & (after >= 0)
    first = np.where(before >= 0, before, after)
    # At an end of the drive, that neighbour's neighbour on its other side.
    beyond = np.where(before >= 0, before[np.maximum(before, 0)], after[np.maximum(after, 0)])
    support = np.stack([np.arange(len(time_s)), first, np.where(middle, after, beyond)], axis=1)
    support[first < 0, 2] = -1
    rates, gaps = [], []
    for other in support[:, 1:].T:
        there = other >= 0
        gap = np.where(there, time_s[other] - time_s, np.nan)
        rate = np.zeros((len(time_s), 6))
        unit_from_other = se3.inverse(world_from_rig[there]) @ world_from_rig[other[there]]
        rate[there, :3] = se3.log_so3(unit_from_other[:, :3, :3])
        rate[there, 3:] = unit_from_other[:, :3, 3]
        rate[there] /= gap[there, None]
        rates.append(rate)
        gaps.append(gap)
    both = support[:, 2] >= 0
    bend = np.zeros((len(time_s), 6))
    bend[both] = (rates[1] - rates[0])[both] / (gaps[1] - gaps[0])[both, None]
    velocity = rates[0].copy()
    velocity[both] -= bend[both] * gaps[0][both, None]
    for axes, limit in ((slice(0, 3), MAX_TURN_ACCELERATION_RADPS2), (slice(3, 6), MAX_ACCELERATION_MPS2)):
        norm = 2.0 * np.linalg.norm(bend[:, axes], axis=1, keepdims=True)
        bend[:, axes] *= np.minimum(1.0, limit / np.maximum(norm, 1e-12))
    ends = both & ~middle
    velocity[ends] = rates[0][ends] - bend[ends] * gaps[0][ends, None]
    reach = np.where(first >= 0, np.abs(gaps[0]), 0.0)
    beyond_s = np.where(both, gaps[1], 0.0)
    return LocalMotion(
        velocity=velocity,
        bend=bend,
        earliest_s=np.where(middle, -REACH * reach, np.minimum(-reach, beyond_s)),
        latest_s=np.where(middle, REACH * beyond_s, np.maximum(reach, beyond_s)),
        support=support,
        support_s=np.stack(gaps, axis=1),
    )


def third_differences(world_from_rig: Floats, time_s: Floats, motion: LocalMotion) -> Floats:
    """Remainder (u, 6) that a parabola leaves: the vehicle is t (t - a) (t - b) times that from where `motion` says.

    It is the mean of the divided differences with the units beyond the neighbours at a and b; zero at the drive's ends.
    """
    result, count = np.zeros((len(time_s), 6)), np.zeros(len(time_s))
    units, (_, before, after) = np.arange(len(time_s)), motion.support.T
    inside = np.flatnonzero((before >= 0) & (before < units) & (after > units))
    for beside, side in ((before, 1), (after, 2)):
        beyond = motion.support[beside[inside], side]
        there = (beyond >= 0) & ((beyond < before[inside]) | (beyond > after[inside]))
        unit, beyond = inside[there], beyond[there]
        unit_from_beyond = se3.inverse(world_from_rig[unit]) @ world_from_rig[beyond]
        t, (a, b) = time_s[beyond] - time_s[unit], motion.support_s[unit].T
        parabola = t[:, None] * (motion.velocity[unit] + t[:, None] * motion.bend[unit])
        moved = np.concatenate([se3.log_so3(unit_from_beyond[:, :3, :3]), unit_from_beyond[:, :3, 3]], axis=1)
        result[unit] += (moved - parabola) / (t * (t - a) * (t - b))[:, None]
        count[unit] += 1.0
    return result / np.maximum(count, 1.0)[:, None]


def _neighbours(time_s: Floats, known: Bools) -> tuple[Ints, Ints]:
    """The nearest known pose before and after each, not too near and not too far; -1 where there is none."""
    index = np.flatnonzero(known)
    times = time_s[index]
    low = np.searchsorted(times, time_s - MIN_GAP_S, side="right") - 1
    high = np.searchsorted(times, time_s + MIN_GAP_S, side="left")
    before = np.full(len(time_s), -1, dtype=np.int64)
    after = before.copy()
    if len(index):
        left, right = index[np.maximum(low, 0)], index[np.minimum(high, len(index) - 1)]
        near_left = known & (low >= 0) & (time_s - time_s[left] <= MAX_GAP_S)
        near_right = known & (high < len(index)) & (time_s[right] - time_s <= MAX_GAP_S)
        before[near_left], after[near_right] = left[near_left], right[near_right]
    return before, after


def smoothed_velocity(world_from_rig: Floats, time_s: Floats, *, window_s: float) -> Floats:
    """Velocities (u, 6) as in `LocalMotion` from noisy poses (u, 4, 4), both NaN where unknown.

    Positions are fitted by a line over the poses within `window_s` before and after, and the turn rate is that
    between the first and the last of them: noise of 0.3 m at 10 Hz leaves 0.1 m/s of a window of 1 s.
    """
    known = np.flatnonzero(np.isfinite(world_from_rig[:, 0, 3]))
    result = np.full((len(time_s), 6), np.nan)
    for u in known:
        near = known[np.abs(time_s[known] - time_s[u]) <= window_s]
        t = time_s[near] - time_s[near].mean()
        spread = float((t**2).sum())
        if len(near) < 3 or spread <= 0.0:
            continue
        rotation = world_from_rig[u, :3, :3]
        result[u, 3:] = rotation.T @ (t @ world_from_rig[near, :3, 3]) / spread
        first, last = world_from_rig[near[0], :3, :3], world_from_rig[near[-1], :3, :3]
        result[u, :3] = rotation.T @ first @ se3.log_so3(first.T @ last) / (t[-1] - t[0])
    return result
