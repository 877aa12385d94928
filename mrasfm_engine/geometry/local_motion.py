"""How a vehicle moves around each of its known poses, from the poses before and after."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.geometry import se3

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

MAX_GAP_S = 2.5  # a pose farther away in time says nothing of how the vehicle moves now
MIN_GAP_S = 0.02  # poses closer in time than this would turn their noise into speed
# Of vehicles on roads. A neighbour whose pose is wrong would ask for more.
MAX_ACCELERATION_MPS2 = 12.0
MAX_TURN_ACCELERATION_RADPS2 = 3.0


@dataclass(frozen=True, kw_only=True)
class LocalMotion:
    """For each unit, twists in its own frame: its pose at `offset` seconds from its timestamp is

        unit_from_then = exp(velocity * offset + bend * offset^2)

    which is exact for constant twists (circles and screws driven at constant speed).
    """

    velocity: Floats  # (u, 6) rotation (rad/s), translation (m/s)
    bend: Floats  # (u, 6) half an acceleration, 1/s^2
    earliest_s: Floats  # (u,) as far back, and
    latest_s: Floats  # (u,) as far forward, as anything is known: beyond, the vehicle is taken to stand
    known: Bools  # (u,) whether any other pose says something

    def at(self, unit: Ints, offset_s: Floats) -> Floats:
        """`unit_from_then` (n, 4, 4) of units (n,) at seconds (n,) from their timestamps."""
        t = np.clip(offset_s, self.earliest_s[unit], self.latest_s[unit])[:, None]
        return se3.exp_se3(t * (self.velocity[unit] + t * self.bend[unit]))


def local_motion(world_from_rig: Floats, time_s: Floats, known: Bools) -> LocalMotion:
    """The motion around poses (u, 4, 4) at ascending times (u,), from those that are known (u,).

    With a known pose on both sides the twist is the parabola through both; with one, it goes there and changes as it
    does there. A pose that is itself not known, or has no other within `MAX_GAP_S`, does not move.
    """
    count = len(time_s)
    before, after = _neighbours(time_s, known)
    has_before, has_after = before >= 0, after >= 0
    own = se3.inverse(world_from_rig)
    back = np.where(has_before, time_s[before] - time_s, -1.0)[:, None]
    ahead = np.where(has_after, time_s[after] - time_s, 1.0)[:, None]
    rate_back, rate_ahead = np.zeros((count, 6)), np.zeros((count, 6))
    rate_back[has_before] = se3.log_se3(own[has_before] @ world_from_rig[before[has_before]]) / back[has_before]
    rate_ahead[has_after] = se3.log_se3(own[has_after] @ world_from_rig[after[has_after]]) / ahead[has_after]
    both = has_before & has_after
    bend = np.where(both[:, None], (rate_ahead - rate_back) / (ahead - back), 0.0)
    velocity = np.where(both[:, None], rate_ahead - bend * ahead, rate_back + rate_ahead)
    for axes, limit in ((slice(0, 3), MAX_TURN_ACCELERATION_RADPS2), (slice(3, 6), MAX_ACCELERATION_MPS2)):
        norm = 2.0 * np.linalg.norm(bend[:, axes], axis=1, keepdims=True)
        bend[:, axes] *= np.minimum(1.0, limit / np.maximum(norm, 1e-12))
    # At an end of the drive, speed changes as it does at the next unit.
    for end, inner, gap in ((has_after & ~has_before, after, ahead), (has_before & ~has_after, before, back)):
        bend[end] = bend[inner[end]]
        velocity[end] -= bend[end] * gap[end]
    back, ahead = back[:, 0], ahead[:, 0]
    return LocalMotion(
        velocity=velocity,
        bend=bend,
        earliest_s=np.where(has_before, back, np.where(has_after, -ahead, 0.0)),
        latest_s=np.where(has_after, ahead, np.where(has_before, -back, 0.0)),
        known=has_before | has_after,
    )


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
    """Velocities (u, 6) as in `LocalMotion` from noisy poses (u, 4, 4), NaN where unknown; zero where nothing is known.

    Positions are fitted by a line over the poses within `window_s` before and after, and the turn rate is that
    between the first and the last of them: noise of 0.3 m at 10 Hz leaves 0.1 m/s of a window of 1 s.
    """
    known = np.flatnonzero(np.isfinite(world_from_rig[:, 0, 3]))
    result = np.zeros((len(time_s), 6))
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
