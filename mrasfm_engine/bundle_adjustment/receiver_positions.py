"""Positions of a receiver whose error wanders: the error is a state of the adjustment, eliminated within the term.

A receiver's error has a part that differs from sample to sample, and a part that stays for about a minute (orbits,
troposphere, multipath, the receiver's own filter). The second is a Gauss-Markov process: over a drive much shorter than
its correlation time it is a constant error with a random walk. With d its value at knots in time, in units of its
standard deviation, the term costs

    min over d of  sum of rho(|e|^2) + d' P d        e = (t + R lever - measured - wander A d) / sigma

where A interpolates linearly between knots and P is the precision of the process, which is tridiagonal. Where the
error jumps, the process begins anew: samples after a jump are later by a time in which it forgets everything. Its
derivatives in the poses are those of e at the best d. Its Gauss-Newton matrix is J'WJ - G M^-1 G' with G = -J'W D,
M = P + D'WD and D = wander A / sigma: the Schur complement of d, which `Extra.add_auxiliary` takes as G and M.

A clock that is off moves all positions along the way, by speed times its offset; an antenna that is elsewhere on the
vehicle turns with it. Where one may be, its error is one more state, or three, in standard deviations of what is known
of it: D has columns C, as velocity sigma_clock / sigma, and P ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg

from mrasfm_engine.bundle_adjustment.cauchy_loss import cauchy_cost
from mrasfm_engine.bundle_adjustment.priors import add_to_units, antenna_jacobian, antenna_residuals
from mrasfm_engine.bundle_adjustment.problem import UNIT_DOF, Layout
from mrasfm_engine.bundle_adjustment.reduced_camera_system import Extra
from mrasfm_engine.geometry.small_cholesky import factorise, solve
from mrasfm_engine.jit import njit
from mrasfm_engine.scene.state import State
from mrasfm_engine.types import Floats, Ints

AXES = 3
MAX_KNOTS = 64  # of a drive: the width that they add to the reduced system is three times that
MAX_REWEIGHTINGS = 60  # of the loss for one value of the poses
SAME_WEIGHTS = 1e-7
FORGOTTEN = 50.0  # correlation times, after which nothing is left: exp(-50)


@dataclass(frozen=True, kw_only=True)
class ReceiverPositions:
    """Measured positions of a point of the vehicle (antenna, or the rig's origin), with a Cauchy loss.

    Use `from_samples`: between knots the process is not what is interpolated, which sigmas have to cover.
    """

    unit: Ints  # (n,) units that have a measurement, each at most once
    position_m: Floats  # (n, 3) in the world frame
    sigma_m: Floats  # (n, 3) of the independent part of their errors
    wander_m: Floats  # (n, 3) standard deviations of the wandering part; 0 where there is none
    lever_arm_m: Floats  # (3,) in the rig frame
    time_s: Floats  # (n,)
    knots_s: Floats  # (k,) ascending, of the process, see `time_of_process_s`
    wander_time_s: float  # correlation time of the wandering part
    segment: Ints | None = None  # (n,) numbers of the parts between which the error jumps; None for one
    clock_m: Floats | None = None  # (n, 3) by which a clock that is ahead by a sigma moves them; None if it is right
    lever_m: Floats | None = None  # (n, 3, 3) likewise by an antenna that is off along an axis; None if it is not
    loss_scale: float = 3.0

    def bounded(self, largest_m: float) -> tuple[ReceiverPositions, Floats]:
        """The term with standard deviations of at most so much, and the common error (3,) that is left out of them."""
        sigma_m, wander_m = np.minimum(self.sigma_m, largest_m), np.minimum(self.wander_m, largest_m)
        left_out_m2 = (self.sigma_m**2 - sigma_m**2) + (self.wander_m**2 - wander_m**2)
        result: Floats = np.sqrt(np.median(left_out_m2, axis=0))
        return replace(self, sigma_m=sigma_m, wander_m=wander_m), result

    @staticmethod
    def from_samples(
        *,
        unit: Ints,
        time_s: Floats,
        position_m: Floats,
        white_m: Floats,
        wander_m: Floats,
        lever_arm_m: Floats,
        wander_time_s: float,
        least_spacing_s: float,
        segment: Ints | None = None,
        clock_m: Floats | None = None,
        lever_m: Floats | None = None,
    ) -> ReceiverPositions:
        """The term of samples (n,), in the order of time, with knots where they are needed.

        `segment` (n,) numbers the parts between which the error jumps. See the class for `clock_m` and `lever_m`.

        Their errors (n, 3) have an independent and a wandering part. Knots are `least_spacing_s` apart, farther on
        drives that would need more than `MAX_KNOTS`. What the process does between two of them counts as an error that
        the samples between them share.
        """
        of_process_s = time_of_process_s(time_s, segment, wander_time_s)
        jumps = 1 + np.flatnonzero(np.diff(np.zeros(len(unit)) if segment is None else segment))
        parts = np.split(of_process_s, jumps) if len(unit) else [np.zeros(1)]
        spacing_s = max(least_spacing_s, float(sum(np.ptp(part) for part in parts)) / (MAX_KNOTS - 1))
        knots_s: Floats = np.concatenate(
            [
                part.min() + spacing_s * np.arange(1 + int(np.ceil(np.ptp(part) / spacing_s - 1e-9)), dtype=np.float64)
                for part in parts
            ]
        )
        # Variance half way between knots of unit variance, given both; samples share it while they are alike.
        half = np.exp(-0.5 * spacing_s / wander_time_s)
        between = max(0.0, 1.0 + 0.5 * (1.0 + half**2) - 2.0 * half) if len(knots_s) > len(parts) else 0.0
        step_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
        sharing = max(1.0, min(spacing_s, 2.0 * wander_time_s) / step_s) if step_s > 0 else 1.0
        return ReceiverPositions(
            unit=unit,
            position_m=position_m,
            sigma_m=np.sqrt(white_m**2 + sharing * between * wander_m**2),
            wander_m=wander_m,
            lever_arm_m=lever_arm_m,
            time_s=time_s,
            knots_s=knots_s,
            wander_time_s=wander_time_s,
            segment=segment,
            clock_m=clock_m,
            lever_m=lever_m,
        )

    def of_rows(self, rows: Ints, unit: Ints, share: Floats) -> ReceiverPositions:
        """Some samples (m,), on other units (m,), with sigmas of their independent part times `share` (m,)."""
        return replace(
            self,
            unit=unit,
            position_m=self.position_m[rows],
            sigma_m=self.sigma_m[rows] * share[:, None],
            wander_m=self.wander_m[rows],
            time_s=self.time_s[rows],
            segment=None if self.segment is None else self.segment[rows],
            clock_m=None if self.clock_m is None else self.clock_m[rows],
            lever_m=None if self.lever_m is None else self.lever_m[rows],
        )

    @cached_property
    def _places(self) -> tuple[Ints, Ints, Floats]:
        """Knots (n,) before and after every sample, and the second's share (n,)."""
        last = len(self.knots_s) - 1
        time_s = time_of_process_s(self.time_s, self.segment, self.wander_time_s)
        before = np.clip(np.searchsorted(self.knots_s, time_s, side="right") - 1, 0, max(last - 1, 0))
        after = np.minimum(before + 1, last)
        length = np.where(after > before, self.knots_s[after] - self.knots_s[before], 1.0)
        share = np.clip((time_s - self.knots_s[before]) / length, 0.0, 1.0) * (after > before)
        return before, after, share

    @cached_property
    def shares(self) -> Floats:
        """A (n, k): shares of knots in every sample."""
        before, after, share = self._places
        rows, result = np.arange(len(before)), np.zeros((len(before), len(self.knots_s)))
        result[rows, before] = 1.0 - share
        result[rows, after] += share
        return result

    @cached_property
    def precision(self) -> Floats:
        """The process' precision (2, k): its superdiagonal, whose first entry is unused, and its diagonal."""
        alike = np.exp(-np.diff(self.knots_s) / self.wander_time_s)
        lost = np.maximum(1.0 - alike**2, 1e-12)
        diagonal = np.concatenate([[1.0], 1.0 / lost]) + np.concatenate([alike**2 / lost, [0.0]])
        return np.stack([np.concatenate([[0.0], -alike / lost]), diagonal])

    @cached_property
    def _gain(self) -> Floats:
        """Wandering part over the independent one (n, 3)."""
        return self.wander_m / self.sigma_m

    @cached_property
    def common_m(self) -> Floats:
        """Ways (n, 3, c) in which errors that all positions have in common move them, by a sigma each."""
        ways = [np.zeros((len(self.unit), AXES, 0))]
        if self.clock_m is not None:
            ways.append(self.clock_m[:, :, None])
        if self.lever_m is not None:
            ways.append(self.lever_m)
        return np.ascontiguousarray(np.concatenate(ways, axis=2))

    @cached_property
    def _common(self) -> Floats:
        """The columns C (n, 3, c) of these errors."""
        result: Floats = self.common_m / self.sigma_m[:, :, None]
        return result

    def _by_knots(self, weights: Floats, axis: int) -> Floats:
        """M (2, k) of one axis, as `precision` has it."""
        before, after, share = self._places
        weighted, count = weights * self._gain[:, axis] ** 2, len(self.knots_s)
        diagonal = np.bincount(before, weighted * (1.0 - share) ** 2, minlength=count)
        diagonal += np.bincount(after, weighted * share**2, minlength=count)
        off = np.bincount(after, weighted * share * (1.0 - share), minlength=count)
        result: Floats = self.precision + np.stack([off, diagonal])
        return result

    def _at_knots(self, values: Floats, axis: int) -> Floats:
        """D' v (k, m) of values (n, m) of one axis."""
        result: Floats = self.shares.T @ (values * self._gain[:, axis, None])
        return result

    def _at_samples(self, states: Floats, common: Floats) -> Floats:
        """D d (n, 3) of states (k, 3) and those of common errors (c,)."""
        before, after, share = self._places
        blend = states[before] + share[:, None] * (states[after] - states[before])
        result: Floats = self._gain * blend + self._common @ common
        return result

    def _whitened(self, state: State) -> tuple[Floats, Floats]:
        return antenna_residuals(state, self.unit, self.lever_arm_m, self.position_m, self.sigma_m)

    def _best(self, whitened: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """The states (k, 3) and (c,) that cost least, with residuals (n, 3) and robust weights (n,)."""
        states, common = np.empty((len(self.knots_s), AXES)), np.zeros(self._common.shape[2])
        residuals, weights = np.empty_like(whitened), np.ones(len(whitened))
        _find_best_states(
            whitened, self._gain, self._common, *self._places, self.precision, self.loss_scale,
            states, common, residuals, weights,
        )  # fmt: skip
        return states, common, residuals, weights

    def errors_m(self, state: State) -> Floats:
        """The part (n, 3) of positions' errors that wanders or is common to all, as the poses of a state show it."""
        states, common, _, _ = self._best(self._whitened(state)[1])
        result: Floats = -self._at_samples(states, common) * self.sigma_m
        return result

    def cost(self, state: State) -> float:
        """See `Term`."""
        states, common, residuals, _ = self._best(self._whitened(state)[1])
        off, diagonal = self.precision
        prior = (diagonal[:, None] * states**2).sum() + 2.0 * (off[1:, None] * states[1:] * states[:-1]).sum()
        return cauchy_cost(residuals, self.loss_scale) + 0.5 * float(prior + (common**2).sum())

    def add_to(self, state: State, layout: Layout, extra: Extra) -> None:
        """See `Term`."""
        arm, whitened = self._whitened(state)
        _, _, r, w = self._best(whitened)
        free, j_w, slots = add_to_units(layout, extra, self.unit, antenna_jacobian(arm, self.sigma_m), r, w)
        more = self._common.shape[2]
        if not (len(free) and (self.wander_m.any() or more)):
            return
        count, (before, after, share) = len(self.knots_s), self._places
        with_units = np.zeros((layout.num_units, count, UNIT_DOF, AXES))
        for knot, part in ((before, 1.0 - share), (after, share)):  # each unit has one measurement
            with_units[slots, knot[free]] -= j_w * (self._gain * part[:, None])[free, None, :]
        with_process = np.moveaxis(with_units, 1, 3).reshape(-1, AXES * count)
        with_common = np.zeros((layout.num_units, UNIT_DOF, more))
        with_common[slots] = -(j_w @ self._common[free])
        square, last = np.eye(AXES * count + more), slice(AXES * count, AXES * count + more)
        for axis in range(AXES):
            own = slice(axis * count, (axis + 1) * count)
            off, diagonal = self._by_knots(w, axis)
            square[own, own] = np.diag(diagonal) + np.diag(off[1:], 1) + np.diag(off[1:], -1)
            square[own, last] = self._at_knots(w[:, None] * self._common[:, axis], axis)
            square[last, own] = square[own, last].T
        square[last, last] += np.einsum("nac,n,nad->cd", self._common, w, self._common)
        extra.add_auxiliary(
            np.column_stack([with_process, with_common.reshape(UNIT_DOF * layout.num_units, more)]), square
        )

    def information(self, columns: Floats) -> Floats:
        """Information X' C^-1 X (m, m) on m ways (n, 3, m) in which the antenna may be moved in metres.

        C is the covariance of the positions' errors, with all of them at full weight.
        """
        count = columns.shape[2]
        known = self._information_by_process(np.concatenate([columns, self.common_m], axis=2))
        return without_common_errors(known, count)[0]

    def _information_by_process(self, columns: Floats) -> Floats:
        """The same where positions have no error in common."""
        scaled = columns / self.sigma_m[:, :, None]
        flat = scaled.reshape(-1, scaled.shape[2])
        result: Floats = flat.T @ flat
        for axis in range(AXES):
            at_knots = self._at_knots(scaled[:, axis], axis)
            result = result - at_knots.T @ _solved(self._by_knots(np.ones(len(scaled)), axis), at_knots)
        return result

    def information_given(self, way: Floats, others: Floats) -> float:
        """Information on one way (n, 3) in which the antenna may be moved, if others (n, 3, m) are not known."""
        known = self.information(np.concatenate([way[:, :, None], others], axis=2))
        lost = known[0, 1:] @ np.linalg.pinv(known[1:, 1:], rcond=1e-12, hermitian=True) @ known[1:, 0]
        return max(0.0, float(known[0, 0] - lost))


def without_common_errors(known: Floats, count: int) -> tuple[Floats, Floats]:
    """Information (m, m) of `known` (m + c, m + c) on the first `count` of its ways, without what errors in common
    explain of it, and I + K' C^-1 K (c, c) of the ways K in which these move positions, C without them.
    """
    of_common = np.eye(len(known) - count) + known[count:, count:]
    result: Floats = known[:count, :count] - known[:count, count:] @ np.linalg.solve(of_common, known[count:, :count])
    return result, of_common


def time_of_process_s(time_s: Floats, segment: Ints | None, wander_time_s: float) -> Floats:
    """Times (n,) of the process that wanders, in which parts between jumps (n,) are long after one another."""
    if segment is None:
        return time_s
    result: Floats = time_s + FORGOTTEN * wander_time_s * segment
    return result


@njit(cache=True, nogil=True, error_model="numpy")
def _find_best_states(
    whitened: Any, gain: Any, columns: Any, before: Any, after: Any, share: Any, precision: Any, loss_scale: float,
    states: Any, common: Any, residuals: Any, weights: Any,
) -> None:  # fmt: skip
    """Find the states (k, 3), k > 0, by iteratively reweighted least squares, with their residuals and weights.

    M and D'Wv, as `_by_knots` and `_at_knots` have them, are formed and solved without an array in between. The states
    (c,) of common errors, by their `columns` (n, 3, c), are eliminated last: `moved` is what the process makes of them.
    """
    count, more = len(states), len(common)
    diagonal, off = np.empty(count), np.empty(count)  # of M, and its superdiagonal, whose first entry is unused
    moved = np.zeros((more, count, AXES))
    known, factor_of_known, wanted = np.empty((more, more)), np.zeros((more, more)), np.empty(more)
    left = np.empty(more)
    for _ in range(MAX_REWEIGHTINGS):
        for axis in range(AXES):
            diagonal[:], off[:], states[:, axis], moved[:, :, axis] = precision[1], precision[0], 0.0, 0.0
            for i in range(len(whitened)):
                a, b, later = before[i], after[i], share[i]
                own = gain[i, axis]
                weight, right = weights[i] * own * own, weights[i] * own * whitened[i, axis]
                diagonal[a] += weight * (1.0 - later) ** 2
                states[a, axis] += right * (1.0 - later)
                for c in range(more):
                    moved[c, a, axis] += weights[i] * own * columns[i, axis, c] * (1.0 - later)
                if b > a:
                    diagonal[b] += weight * later**2
                    off[b] += weight * later * (1.0 - later)
                    states[b, axis] += right * later
                    for c in range(more):
                        moved[c, b, axis] += weights[i] * own * columns[i, axis, c] * later
            for k in range(1, count):
                factor = off[k] / diagonal[k - 1]
                diagonal[k] -= factor * off[k]
                states[k, axis] -= factor * states[k - 1, axis]
                for c in range(more):
                    moved[c, k, axis] -= factor * moved[c, k - 1, axis]
            states[count - 1, axis] /= diagonal[count - 1]
            for c in range(more):
                moved[c, count - 1, axis] /= diagonal[count - 1]
            for k in range(count - 2, -1, -1):
                states[k, axis] = (states[k, axis] - off[k + 1] * states[k + 1, axis]) / diagonal[k]
                for c in range(more):
                    moved[c, k, axis] = (moved[c, k, axis] - off[k + 1] * moved[c, k + 1, axis]) / diagonal[k]
        if more:
            known[:], wanted[:] = 0.0, 0.0
            for c in range(more):
                known[c, c] = 1.0
            for i in range(len(whitened)):
                a, b, later = before[i], after[i], share[i]
                for axis in range(AXES):
                    for c in range(more):
                        process = moved[c, a, axis] + later * (moved[c, b, axis] - moved[c, a, axis])
                        left[c] = columns[i, axis, c] - gain[i, axis] * process
                        wanted[c] += weights[i] * left[c] * whitened[i, axis]
                        for d in range(c + 1):
                            known[c, d] += weights[i] * left[c] * columns[i, axis, d]
            if factorise(known, more, factor_of_known):  # always: its least eigenvalue is 1
                solve(factor_of_known, wanted, more, common)
            for c in range(more):
                for k in range(count):
                    for axis in range(AXES):
                        states[k, axis] -= common[c] * moved[c, k, axis]
        change = 0.0
        for i in range(len(whitened)):
            squared = 0.0
            for axis in range(AXES):
                own = states[before[i], axis] + share[i] * (states[after[i], axis] - states[before[i], axis])
                residuals[i, axis] = whitened[i, axis] - gain[i, axis] * own
                for c in range(more):
                    residuals[i, axis] -= columns[i, axis, c] * common[c]
                squared += residuals[i, axis] ** 2
            renewed = 1.0 / (1.0 + squared / loss_scale**2)
            change = max(change, abs(renewed - weights[i]))
            weights[i] = renewed
        if change < SAME_WEIGHTS:
            break


def _solved(tridiagonal: Floats, right: Floats) -> Floats:
    """Solution (k, m) of a symmetric system, given by its superdiagonal and its diagonal (2, k)."""
    bands = tridiagonal if tridiagonal.shape[1] > 1 else tridiagonal[1:]
    return np.asarray(scipy.linalg.solveh_banded(bands, right, check_finite=False))
