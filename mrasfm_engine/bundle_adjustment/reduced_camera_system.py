"""The reduced system of an adjustment, in which points are eliminated, and its solution.

With units u and cameras c,

    [ A  B' ] [ du ]     [ gu ]
    [ B  C  ] [ dc ] = - [ gc ]

A couples units that share points: sparse, factorised by blocks into L L'. B and C are a border that is as wide as there
are cameras. With Y = L^-1 B' and y = L^-1 gu

    (C - Y' Y) dc = Y' y - gc          du = -L^-T (y + Y dc)

and in the inverse, with Z = L^-T Y, the units' part is A^-1 + Z (C - Y' Y)^-1 Z', the cameras' part (C - Y' Y)^-1. Y
is sparse where cameras are those of many scenes, Z is not: a step goes without it.

Terms may have unknowns of their own that are at their best for every value of the others (a receiver's wandering
error). These widen the border: they are solved for, have no gradient, and are no part of the reduced vector.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg

from mrasfm_engine.bundle_adjustment.block_cholesky import BlockFactor
from mrasfm_engine.bundle_adjustment.problem import UNIT_DOF, Layout
from mrasfm_engine.bundle_adjustment.schur_structure import SchurStructure
from mrasfm_engine.types import Bools, Floats, Ints

TINY = 1e-12  # damps what nothing observes


@dataclass(frozen=True, kw_only=True)
class Auxiliary:
    """Unknowns of the terms themselves, which are at their best."""

    with_units: Floats  # (6 units, x) with the units
    square: Floats  # (x, x) of their own

    @staticmethod
    def none(layout: Layout) -> Auxiliary:
        """No unknowns."""
        return Auxiliary(with_units=np.zeros((UNIT_DOF * layout.num_units, 0)), square=np.zeros((0, 0)))

    def eliminated(self, with_units: Floats) -> Floats:
        """Loss of information (m, m) on others that have blocks (m, x) with them."""
        if not len(self.square):
            return np.zeros((len(with_units), len(with_units)))
        factor = scipy.linalg.cho_factor(self.square, lower=True, check_finite=False)
        result: Floats = with_units @ scipy.linalg.cho_solve(factor, with_units.T, check_finite=False)
        return result


@dataclass(kw_only=True)
class Extra:
    """Sums of the terms that are not image observations: one block per unit, and the cameras' square."""

    units: Floats  # (units, 6, 6)
    cameras: Floats  # (d cameras, d cameras), d the layout's camera_dof
    gradient: Floats  # (n,)
    auxiliary: Auxiliary

    def add_auxiliary(self, with_units: Floats, square: Floats) -> None:
        """Add unknowns (x,) of a term, with their block `with_units` (6 units, x) and their own matrix (x, x)."""
        self.auxiliary = Auxiliary(
            with_units=np.concatenate([self.auxiliary.with_units, with_units], axis=1),
            square=scipy.linalg.block_diag(self.auxiliary.square, square),
        )

    @property
    def unit_gradient(self) -> Floats:
        """View (units, 6) of the units' gradient."""
        return self.gradient[: UNIT_DOF * len(self.units)].reshape(-1, UNIT_DOF)

    @property
    def camera_gradient(self) -> Floats:
        """View (d cameras,) of the cameras' gradient."""
        return self.gradient[UNIT_DOF * len(self.units) :]

    @property
    def matrix(self) -> Floats:
        """All of it (n, n), for small problems."""
        result: Floats = scipy.linalg.block_diag(*self.units, self.cameras)
        split = UNIT_DOF * len(self.units)
        result[:split, :split] -= self.auxiliary.eliminated(self.auxiliary.with_units)
        return result

    @staticmethod
    def none(layout: Layout) -> Extra:
        """Zeros to add to."""
        return Extra(
            units=np.zeros((layout.num_units, UNIT_DOF, UNIT_DOF)),
            cameras=np.zeros((layout.camera_dof * layout.num_cameras,) * 2),
            gradient=np.zeros(layout.size),
            auxiliary=Auxiliary.none(layout),
        )


@dataclass(frozen=True, kw_only=True)
class ReducedCameraSystem:
    """Normal equations with the points eliminated."""

    layout: Layout
    structure: SchurStructure
    units: Floats  # (blocks of the units' pattern, 6, 6); diagonal ones are symmetric
    border: Floats  # (cameras, units, d, 6)
    cameras: Floats  # (d cameras, d cameras), d the layout's camera_dof
    diagonal: Floats  # (n,) of the matrix before points were eliminated: what Marquardt's damping scales
    gradient: Floats  # (n,)
    v_inverse: Floats  # (p, 6)
    v_gradient: Floats  # (p, 3)
    auxiliary: Auxiliary

    @staticmethod
    def from_sums(
        layout: Layout,
        structure: SchurStructure,
        sums: tuple[Floats, ...],
        points: tuple[Floats, Floats],
        extra: Extra,
    ) -> ReducedCameraSystem:
        """The system from what `accumulate` summed (units, border, cameras, diagonal, gradient) and other terms."""
        c, dof = layout.num_cameras, layout.camera_dof
        units = sums[0].reshape(-1, UNIT_DOF, UNIT_DOF)
        border = sums[1].reshape(c, layout.num_units, dof, UNIT_DOF)
        squares = sums[2].reshape(c, c, dof, dof)
        diagonal, gradient = sums[3:]
        # Diagonal blocks come by their lower triangle.
        on = structure.pattern.first[:-1]
        lower = np.tril(units[on])
        units[on] = lower + np.swapaxes(np.tril(lower, -1), 1, 2) + extra.units
        size = dof * c
        cameras = np.tril(np.swapaxes(squares, 1, 2).reshape(size, size))
        cameras = cameras + np.tril(cameras, -1).T + extra.cameras
        unit_diagonal = np.diagonal(extra.units, axis1=1, axis2=2).ravel()
        return ReducedCameraSystem(
            layout=layout,
            structure=structure,
            units=units,
            border=border,
            cameras=cameras,
            diagonal=diagonal + np.concatenate([unit_diagonal, np.diagonal(extra.cameras)]),
            gradient=gradient + extra.gradient,
            v_inverse=points[0],
            v_gradient=points[1],
            auxiliary=extra.auxiliary,
        )

    @property
    def matrix(self) -> Floats:
        """All of it (n, n), for small problems."""
        n, split = self.layout.size, UNIT_DOF * self.layout.num_units
        result = np.zeros((n, n))
        steps = np.arange(UNIT_DOF)
        rows = (UNIT_DOF * self.structure.pattern.row)[:, None, None] + steps[:, None]
        columns = (UNIT_DOF * self.structure.pattern.column_of_block())[:, None, None] + steps[None, :]
        result[rows, columns] = self.units
        result[columns, rows] = self.units
        result[:split, :split] -= self.auxiliary.eliminated(self.auxiliary.with_units)
        result[split:, :split] = self._border_rows()
        result[:split, split:] = result[split:, :split].T
        result[split:, split:] = self.cameras
        return result

    def _border_rows(self) -> Floats:
        """B (d cameras, 6 units)."""
        size = self.layout.camera_dof * self.layout.num_cameras
        return np.swapaxes(self.border, 1, 2).reshape(size, UNIT_DOF * self.layout.num_units)

    def matrix_diagonal(self) -> Floats:
        """The diagonal (n,) of the matrix."""
        units = np.diagonal(self.units[self.structure.pattern.first[:-1]], axis1=1, axis2=2)
        return np.concatenate([units.ravel(), np.diagonal(self.cameras)])

    def step(self, damping: float) -> Floats | None:
        """The damped step (n,), zero where held; None where the damped matrix is not positive definite."""
        split = UNIT_DOF * self.layout.num_units
        damped = damping * np.maximum(self.diagonal, TINY)
        solved = self.eliminate(damped)
        if solved is None:
            return None
        step = np.zeros(len(self.gradient))
        half = -solved.factor.forward(self.gradient[:split])
        if solved.cameras is not None:
            right = np.zeros(solved.half_coupled.shape[1])
            right[: len(solved.free)] = -self.gradient[split:][solved.free]
            right -= solved.half_coupled.T @ half
            border = scipy.linalg.cho_solve(solved.cameras, right, check_finite=False)
            step[split:][solved.free] = border[: len(solved.free)]
            half -= solved.half_coupled @ border
        step[:split] = solved.factor.backward(half)
        return step if np.isfinite(step).all() else None

    def eliminate(self, damped: Floats) -> Eliminated | None:
        """Eliminate the units, with something (n,) added to the diagonal; None where not positive definite."""
        layout = self.layout
        split = UNIT_DOF * layout.num_units
        units = self.units.copy()
        on = self.structure.pattern.first[:-1]
        axis = np.arange(UNIT_DOF)
        units[on[:, None], axis, axis] += damped[:split].reshape(-1, UNIT_DOF)
        factor = BlockFactor.from_blocks(self.structure.elimination, units)
        if factor is None:
            return None
        free = np.setdiff1d(np.arange(layout.camera_dof * layout.num_cameras), layout.held() - split)
        border = np.concatenate([self._border_rows()[free].T, self.auxiliary.with_units], axis=1)
        half_coupled = factor.forward(border)
        own = self.cameras[np.ix_(free, free)] + np.diag(damped[split:][free])
        square = scipy.linalg.block_diag(own, self.auxiliary.square) - half_coupled.T @ half_coupled
        try:
            cameras = scipy.linalg.cho_factor(square, lower=True, check_finite=False) if len(square) else None
        except np.linalg.LinAlgError:
            return None
        return Eliminated(factor=factor, free=free, half_coupled=half_coupled, cameras=cameras)


@dataclass(frozen=True, kw_only=True)
class Eliminated:
    """A reduced system whose units are eliminated too."""

    factor: BlockFactor
    free: Ints  # (f,) of the cameras' unknowns; after them, the border has those x of the terms
    half_coupled: Floats  # (6 units, f + x) Y, in the order in which units are eliminated
    cameras: tuple[Floats, bool] | None  # Cholesky factor of C - Y' Y, where the border has unknowns

    @cached_property
    def coupled(self) -> Floats:
        """A^-1 B' (6 units, f + x): Z."""
        return self.factor.backward(self.half_coupled)

    def equations_of_border(self, system: ReducedCameraSystem) -> tuple[Floats, Floats]:
        """Matrix (f + x, f + x) and gradient (f + x,) of the border, which has unknowns, without the units.

        Terms' own unknowns are where they cost least.
        """
        assert self.cameras is not None
        factor, split = np.tril(self.cameras[0]), len(self.half_coupled)
        gradient = -self.coupled.T @ system.gradient[:split]
        gradient[: len(self.free)] += system.gradient[split + self.free]
        return factor @ factor.T, gradient

    def units_of(self, right: Floats) -> Floats:
        """A^-1 (6 units,) of a right-hand side."""
        return self.factor.solve(right)

    def smallest_pivot(self, system: ReducedCameraSystem, replaced: Bools) -> float:
        """The smallest pivot relative to the diagonal that it came from, where that was not `replaced` (n,)."""
        split = UNIT_DOF * system.layout.num_units
        diagonal = system.matrix_diagonal()
        pivots = self.factor.pivots().ravel() / np.where(replaced, 1.0, diagonal)[:split]
        smallest = float(pivots.min(initial=np.inf))
        if self.cameras is not None:
            own = np.where(replaced, 1.0, diagonal)[split:][self.free]
            own = np.concatenate([own, np.diagonal(system.auxiliary.square)])
            smallest = min(smallest, float((np.diagonal(self.cameras[0]) ** 2 / own).min()))
        return smallest

    def inverse_of_border(self) -> Floats:
        """The border's part (f + x, f + x) of the matrix's inverse, without the long work for the units'."""
        if self.cameras is None:
            return np.zeros((0, 0))
        return np.asarray(scipy.linalg.cho_solve(self.cameras, np.eye(self.half_coupled.shape[1])), dtype=np.float64)

    def inverse(self) -> tuple[Floats, Floats]:
        """Diagonal blocks (units, 6, 6) of the units and the border's part (f + x, f + x) of the matrix's inverse."""
        units, border = self.factor.inverse_diagonal(), self.inverse_of_border()
        if self.cameras is None:
            return units, border
        coupled = self.coupled.reshape(-1, UNIT_DOF, len(border))
        return units + coupled @ border @ np.swapaxes(coupled, 1, 2), border
