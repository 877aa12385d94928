"""Units that move as one: the variable of transformation-based bundle adjustment.

The units of a finished scene are a rigid body: `world_from_rig = world_from_scene * scene_from_rig` with one unknown,
`world_from_scene`, for all of them (MRASfM, section on aggregation). A step (omega, v) of a set turns it about a pivot
c, the mean place of its units, and moves it:

    R_u <- exp(omega) R_u        t_u <- exp(omega) (t_u - c) + c + v

so that the steps of its units, as `problem` defines them, are a constant linear map of it,

    omega_u = omega              tau_u = v - [t_u - c]x omega

and the reduced system over units becomes one over sets by that map from both sides: P' A P. Points are eliminated as
ever, and the relative poses within a set do not change, not even by rounding of a penalty.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from mrasfm_engine.bundle_adjustment.problem import UNIT_DOF, Layout
from mrasfm_engine.bundle_adjustment.reduced_camera_system import TINY, ReducedCameraSystem
from mrasfm_engine.geometry import se3
from mrasfm_engine.scene.state import State
from mrasfm_engine.types import Floats, Ints


@dataclass(frozen=True, kw_only=True)
class RigidGroups:
    """Units that move together. Every free unit belongs to a set; a set's units are all free."""

    of_unit: Ints  # (u,) -1 for fixed units
    count: int

    @property
    def size(self) -> int:
        """Number of unknowns of all sets."""
        return UNIT_DOF * self.count

    def pivots(self, state: State) -> Floats:
        """Mean places (sets, 3) of the sets' units, about which they turn."""
        members = np.flatnonzero(self.of_unit >= 0)
        sums = np.zeros((self.count, 3))
        np.add.at(sums, self.of_unit[members], state.unit_position_m[members])
        counts = np.bincount(self.of_unit[members], minlength=self.count).clip(1)
        result: Floats = sums / counts[:, None]
        return result

    def unit_from_set_steps(self, state: State, layout: Layout) -> tuple[Ints, Floats]:
        """The set (n,) of every free unit in the layout's order, and the map (n, 6, 6) from its step to the unit's."""
        units = np.flatnonzero(layout.unit_slot >= 0)
        of = self.of_unit[units]
        arm = state.unit_position_m[units] - self.pivots(state)[of]
        maps = np.tile(np.eye(UNIT_DOF), (len(units), 1, 1))
        maps[:, 3:, :3] = -se3.skew(arm)
        return of, maps

    def condense(self, system: ReducedCameraSystem, state: State) -> tuple[Floats, Floats, Floats]:
        """Matrix (6 s, 6 s), gradient (6 s,) and undamped diagonal (6 s,) over the sets."""
        layout = system.layout
        of, maps = self.unit_from_set_steps(state, layout)
        pattern = system.structure.pattern
        row, column = pattern.row, pattern.column_of_block()
        blocks = np.swapaxes(maps[row], 1, 2) @ system.units @ maps[column]
        square = np.zeros((self.count, self.count, UNIT_DOF, UNIT_DOF))
        np.add.at(square, (of[row], of[column]), blocks)
        # Of two different units only one block is stored.
        off = row != column
        np.add.at(square, (of[column[off]], of[row[off]]), np.swapaxes(blocks[off], 1, 2))
        gradient, diagonal = np.zeros((self.count, UNIT_DOF)), np.zeros((self.count, UNIT_DOF))
        split = UNIT_DOF * layout.num_units
        by_unit = system.gradient[:split].reshape(-1, UNIT_DOF)
        np.add.at(gradient, of, np.einsum("nji,nj->ni", maps, by_unit))
        np.add.at(diagonal, of, np.einsum("nji,nj->ni", maps**2, system.diagonal[:split].reshape(-1, UNIT_DOF)))
        matrix = np.swapaxes(square, 1, 2).reshape(self.size, self.size)
        states = len(system.auxiliary.square)
        with_units = np.zeros((self.count, UNIT_DOF, states))
        of_units = system.auxiliary.with_units.reshape(layout.num_units, UNIT_DOF, states)
        np.add.at(with_units, of, np.swapaxes(maps, 1, 2) @ of_units)
        matrix = matrix - system.auxiliary.eliminated(with_units.reshape(self.size, states))
        return matrix, gradient.ravel(), diagonal.ravel()

    def with_cameras(self, system: ReducedCameraSystem, state: State) -> Floats:
        """Block (6 s, d c) of the matrix between the sets and the free cameras."""
        of, maps = self.unit_from_set_steps(state, system.layout)
        by_unit = np.einsum("nji,cndj->nicd", maps, system.border)
        square = np.zeros((self.count, *by_unit.shape[1:]))
        np.add.at(square, of, by_unit)
        return square.reshape(self.size, -1)

    def step(self, system: ReducedCameraSystem, state: State, damping: float) -> Floats | None:
        """The damped step of the sets, as steps (6 units,) of the units; None where not positive definite."""
        matrix, gradient, diagonal = self.condense(system, state)
        matrix[np.diag_indices(self.size)] += damping * np.maximum(diagonal, TINY)
        try:
            step = -scipy.linalg.cho_solve(scipy.linalg.cho_factor(matrix, lower=True), gradient)
        except (np.linalg.LinAlgError, ValueError):
            return None
        of, maps = self.unit_from_set_steps(state, system.layout)
        result = _of_units(of, maps, step.reshape(-1, UNIT_DOF))
        return result if np.isfinite(result).all() else None

    def mean_step(self, state: State, layout: Layout, step: Floats) -> Floats:
        """The step (6 units,) of the sets that is the mean of what units want whose turns are those of their sets.

        A sum of steps from several states is such a step: the arms of its shifts are of other states than its own.
        """
        of, maps = self.unit_from_set_steps(state, layout)
        back = np.linalg.inv(maps) @ step.reshape(-1, UNIT_DOF, 1)
        mean = np.zeros((self.count, UNIT_DOF))
        np.add.at(mean, of, back[..., 0] / np.bincount(of, minlength=self.count)[of, None])
        return _of_units(of, maps, mean)

    def retract(self, state: State, layout: Layout, step: Floats, points_m: Floats) -> State:
        """The state after a step (6 units,) that `step` made: every set moved as the rigid body that it is."""
        units = np.flatnonzero(layout.unit_slot >= 0)
        d_unit = step[: UNIT_DOF * layout.num_units].reshape(-1, UNIT_DOF)
        pivot = self.pivots(state)[self.of_unit[units]]
        arm = state.unit_position_m[units] - pivot
        turn = se3.exp_so3(d_unit[:, :3])
        # The unit's step holds the set's translation and, to first order, what the turn does at the end of its arm.
        shift = d_unit[:, 3:] - np.cross(d_unit[:, :3], arm)
        rotation, position = state.unit_rotation.copy(), state.unit_position_m.copy()
        rotation[units] = turn @ rotation[units]
        position[units] = np.einsum("nij,nj->ni", turn, arm) + pivot + shift
        return replace(state, unit_rotation=rotation, unit_position_m=position, points_m=points_m)

    def covariances(self, system: ReducedCameraSystem, state: State) -> Floats:
        """Marginal covariances (sets, 6, 6) of the sets' steps [omega, v] from an undamped system.

        Infinite where the system determines nothing.
        """
        matrix, _, _ = self.condense(system, state)
        scale = 1.0 / np.sqrt(np.maximum(np.diagonal(matrix), TINY))
        try:
            factor = scipy.linalg.cho_factor(matrix * scale[:, None] * scale, lower=True)
        except (np.linalg.LinAlgError, ValueError):
            return np.full((self.count, UNIT_DOF, UNIT_DOF), np.inf)
        inverse = scipy.linalg.cho_solve(factor, np.eye(self.size)) * scale[:, None] * scale
        on = np.arange(self.count)
        blocks = inverse.reshape(self.count, UNIT_DOF, self.count, UNIT_DOF)
        result: Floats = np.ascontiguousarray(np.swapaxes(blocks, 1, 2)[on, on])
        return result


def _of_units(set_of_unit: Ints, maps: Floats, steps: Floats) -> Floats:
    """Steps (6 n,) of units by those of their sets (sets, 6), see `RigidGroups.unit_from_set_steps`."""
    result: Floats = np.einsum("nij,nj->ni", maps, steps[set_of_unit]).ravel()
    return result
