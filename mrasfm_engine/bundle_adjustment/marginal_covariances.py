"""Marginal covariances of the adjusted poses and calibration, and the uncertainty of scale."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from mrasfm_engine.bundle_adjustment.problem import CAMERA_DOF, READOUT, TIME, UNIT_DOF
from mrasfm_engine.bundle_adjustment.reduced_camera_system import Eliminated, ReducedCameraSystem
from mrasfm_engine.bundle_adjustment.shared_errors import SharedErrors, find_shared_errors
from mrasfm_engine.bundle_adjustment.solver import Problem
from mrasfm_engine.scene.state import State
from mrasfm_engine.types import Bools, Floats, Ints

LARGEST_DENSE = 4000  # unknowns
MAX_UNKNOWNS_FOR_COVARIANCE = 200_000  # of units and cameras: 33,000 units; above, it takes minutes
SINGULAR = 1e-11  # pivots and eigenvalues of the scaled matrix below this are rounding
UNKNOWN_SCALE = 1e3  # sigma of the scale, relative: no image knows it so badly, and rounding no better


@dataclass(frozen=True, kw_only=True)
class Covariances:
    """Marginal standard deviations; infinite where nothing determines an unknown."""

    sigma_unit_position_m: Floats  # (u, 3), NaN for fixed units
    sigma_camera: Floats  # (c, CAMERA_DOF) in the order of `problem`; NaN for fixed cameras, 0 for what is held
    sigma_scale: float  # relative, of the trajectory's size
    by_scale_m: Floats  # (u, 3) by how much units move when the scene's size changes, as what is known lets them
    calibration: Floats  # (6 c, 6 c) joint covariance of the free cameras' rotations and translations, camera by camera
    calibration_of_independent_errors: Floats  # (6 c, 6 c) the same as the adjustment weighs it: without shared errors
    # (6 c,) covariance of the scale with these, as the adjustment weighs errors; NaN where it is not known
    scale_with_calibration: Floats
    times_s2: Floats  # (c, c) of the free cameras' time offsets, (0, 0) where none has a place
    times_of_independent_errors_s2: Floats  # (c, c) the same as the adjustment weighs them
    sigma_factor: float  # on standard deviations of observations beside priors, see `SharedErrors`

    def with_scale_error(self, sigma: float) -> Covariances:
        """The same with an error more of the scale, relative, and with that of all positions."""
        return replace(
            self,
            sigma_scale=float(np.hypot(self.sigma_scale, sigma)),
            sigma_unit_position_m=np.hypot(self.sigma_unit_position_m, sigma * self.by_scale_m),
        )

    def with_calibration_error(self, functional: Floats, sigma: float) -> Covariances:
        """The same with an error more of a functional (6 c,) of the cameras' poses, all of which move as it lets them.

        That is by their regression on it, as the adjustment weighs errors.
        """
        moved = self.calibration_of_independent_errors @ functional
        variance = float(functional @ moved)
        if not (np.isfinite(variance) and variance > 0.0):
            return self
        moved = moved * (sigma / variance)
        sigma_camera = self.sigma_camera.copy()
        sigma_camera[:, :6] = np.hypot(sigma_camera[:, :6], moved.reshape(-1, 6))
        return replace(self, calibration=self.calibration + np.outer(moved, moved), sigma_camera=sigma_camera)


def covariances(problem: Problem, state: State, *, shared_errors: bool = True) -> Covariances:
    """Marginals at a solution, from the inverse of the reduced normal equations (Gauss-Newton, robust weights).

    With `shared_errors` those of the cameras and of the scale have what errors add that the observations of a unit
    share, see the module of that name. Positions have what the scale's adds.

    Scale is the functional sum (p_i - mean)' dp_i / sum |p_i - mean|^2 of the free units' positions: it does not change
    when the scene is moved or turned. What nothing determines has an infinite sigma; which unknowns share in that is
    told up to `LARGEST_DENSE` unknowns, beyond that all have one.
    """
    layout = problem.layout
    system = problem.normal_equations(state, 0.0)
    found = _regular_marginals(problem, state, system, shared_errors)
    if found is None:
        found = _dense_marginals(system, state.unit_position_m[layout.unit_slot >= 0])
    per_unit = np.full((len(layout.unit_slot), UNIT_DOF), np.nan)
    per_unit[layout.unit_slot >= 0] = np.sqrt(found.units)
    dof = layout.camera_dof
    per_camera = np.full((len(layout.camera_slot), CAMERA_DOF), np.nan)
    per_camera[layout.camera_slot >= 0] = 0.0
    per_camera[layout.camera_slot >= 0, :dof] = np.sqrt(np.diagonal(found.cameras)).reshape(-1, dof)
    places = dof * np.arange(layout.num_cameras)
    poses = np.ix_(*[(places[:, None] + np.arange(6)).ravel()] * 2)
    times = np.ix_(*[places[: len(places) if dof > TIME else 0] + TIME] * 2)
    by_scale = np.zeros((len(layout.unit_slot), 3))
    by_scale[layout.unit_slot >= 0] = found.by_scale_m
    result = Covariances(
        sigma_unit_position_m=per_unit[:, 3:],
        sigma_camera=per_camera,
        sigma_scale=found.sigma_scale_of_independent_errors,
        by_scale_m=by_scale,
        calibration=found.cameras[poses],
        calibration_of_independent_errors=found.cameras_of_independent_errors[poses],
        scale_with_calibration=found.scale_with_cameras[poses[0].ravel()],
        times_s2=found.cameras[times],
        times_of_independent_errors_s2=found.cameras_of_independent_errors[times],
        sigma_factor=found.sigma_factor,
    )
    if not np.isfinite(found.sigma_scale):
        return replace(result, sigma_scale=found.sigma_scale)
    more = found.sigma_scale**2 - found.sigma_scale_of_independent_errors**2
    return replace(result.with_scale_error(np.sqrt(max(more, 0.0))), sigma_scale=found.sigma_scale)


def sigma_factor_of_shared_errors(problem: Problem, state: State) -> float:
    """The `sigma_factor` of `covariances` alone, for half of its time; one where there is too little to tell."""
    curved = _CurvedInverse.at(problem, state)
    found = None if curved is None else curved.shared_errors()
    return 1.0 if found is None else found.sigma_factor


@dataclass(frozen=True, kw_only=True)
class _Marginals:
    units: Floats  # (free units, 6) variances
    cameras: Floats  # (d c, d c) covariance of the free cameras; zero where held
    cameras_of_independent_errors: Floats  # (d c, d c)
    scale_with_cameras: Floats  # (d c,) as the adjustment weighs errors
    sigma_scale: float
    sigma_scale_of_independent_errors: float
    by_scale_m: Floats  # (free units, 3)
    sigma_factor: float = 1.0


def _regular_marginals(
    problem: Problem, state: State, system: ReducedCameraSystem, shared_errors: bool
) -> _Marginals | None:
    """Marginals by eliminating units and cameras; None where something besides single unknowns is not determined."""
    layout = problem.layout
    split = UNIT_DOF * layout.num_units
    unseen = ~(system.matrix_diagonal() > 0.0)
    eliminated = system.eliminate(unseen.astype(np.float64))
    if eliminated is None or eliminated.smallest_pivot(system, unseen) < SINGULAR:
        return None
    units, border = eliminated.inverse()
    variance = np.diagonal(units, axis1=1, axis2=2).copy()
    variance[unseen[:split].reshape(-1, UNIT_DOF)] = np.inf
    columns, joint = _with_scale(problem, state, eliminated, border)
    readouts = _places_of_readouts(problem, eliminated.free)
    readout_steps, readout_covariance = -columns[:, readouts].T @ system.gradient, joint[np.ix_(readouts, readouts)]
    columns, joint, by_readouts = _with_readouts_as_declared(columns, joint, readouts)
    cameras, scale_with_cameras = joint[:-1, :-1], np.zeros(layout.camera_dof * layout.num_cameras)
    scale_with_cameras[eliminated.free] = joint[-1, :-1]
    of_independent = joint[-1, -1]
    curved = _CurvedInverse.at(problem, state) if shared_errors else None
    of_shared = None if curved is None else curved.shared_errors()
    of_readouts = None if curved is None else curved.shared_errors_of_readouts()
    joint = joint if of_shared is None else of_shared.covariance
    if of_readouts is not None:
        readout_covariance = of_readouts.covariance
    joint = joint + by_readouts @ (np.outer(readout_steps, readout_steps) + readout_covariance) @ by_readouts.T
    loose = eliminated.free[unseen[split:][eliminated.free]]
    covariances_of_cameras = np.zeros((2, *(layout.camera_dof * layout.num_cameras,) * 2))
    for covariance, own in zip(covariances_of_cameras, (joint[:-1, :-1], cameras), strict=True):
        covariance[np.ix_(eliminated.free, eliminated.free)] = own
        covariance[loose, loose] = np.inf
    scale = scale_of_independent = float("nan")
    if np.isinf(variance[:, 3:]).any():
        scale = scale_of_independent = np.inf
    elif layout.num_units >= 2:
        scale, scale_of_independent = _sigma_scale(joint[-1, -1]), _sigma_scale(of_independent)
    return _Marginals(
        units=np.maximum(variance, 0.0),
        cameras=covariances_of_cameras[0],
        cameras_of_independent_errors=covariances_of_cameras[1],
        scale_with_cameras=scale_with_cameras,
        sigma_scale=scale,
        sigma_scale_of_independent_errors=scale_of_independent,
        by_scale_m=columns[:split, -1].reshape(-1, UNIT_DOF)[:, 3:] / max(of_independent, 1e-30),
        sigma_factor=1.0 if of_shared is None else of_shared.sigma_factor,
    )


@dataclass(frozen=True, kw_only=True)
class _CurvedInverse:
    """Columns of the inverse with the curvature of the loss, from which shared errors follow."""

    problem: Problem
    state: State
    system: ReducedCameraSystem
    columns: Floats  # (n, f + 1) for the cameras' unknowns and the scale
    covariance: Floats  # (f + 1, f + 1) of these
    readouts: Ints  # (r,) among them

    @staticmethod
    def at(problem: Problem, state: State) -> _CurvedInverse | None:
        """None where the loss' curvature does not determine all."""
        curved = problem.with_curvature()
        system = curved.normal_equations(state, 0.0)
        unseen = system.matrix_diagonal() == 0.0  # below zero, the loss bends the other way: there is no factor
        eliminated = system.eliminate(unseen.astype(np.float64))
        if eliminated is None or eliminated.smallest_pivot(system, unseen) < SINGULAR:
            return None
        columns, joint = _with_scale(curved, state, eliminated, eliminated.inverse_of_border())
        readouts = _places_of_readouts(curved, eliminated.free)
        return _CurvedInverse(
            problem=curved, state=state, system=system, columns=columns, covariance=joint, readouts=readouts
        )

    def shared_errors(self) -> SharedErrors | None:
        """Errors of the cameras' unknowns and the scale, for readouts that stay; None of too few observations."""
        columns, covariance, _ = _with_readouts_as_declared(self.columns, self.covariance, self.readouts)
        return find_shared_errors(self.problem, self.state, self.system, columns, covariance)

    def shared_errors_of_readouts(self) -> SharedErrors | None:
        """Errors (r, r) of the readouts that vary."""
        if not len(self.readouts):
            return None
        own = self.covariance[np.ix_(self.readouts, self.readouts)]
        return find_shared_errors(self.problem, self.state, self.system, self.columns[:, self.readouts], own)


def _places_of_readouts(problem: Problem, free: Ints) -> Ints:
    """Places of the readouts that vary among the unknowns (f,) of the cameras that do."""
    at = np.flatnonzero(free % problem.layout.camera_dof == READOUT)
    return at if problem.layout.free_readouts.any() else at[:0]


def _with_scale(problem: Problem, state: State, eliminated: Eliminated, border: Floats) -> tuple[Floats, Floats]:
    """Columns (n, f + 1) of the inverse for the cameras' unknowns that vary and the scale, and their covariance.

    `border` is the inverse's part of these unknowns, and after them of those of the terms.
    """
    split, free = UNIT_DOF * problem.layout.num_units, UNIT_DOF * problem.layout.num_units + eliminated.free
    functional = scale_functional(state.unit_position_m[problem.layout.unit_slot >= 0])
    along, f = border @ (eliminated.coupled.T @ functional), len(free)
    columns = np.zeros((problem.layout.size, f + 1))  # of the inverse
    columns[:split, :-1], columns[free, :-1] = -eliminated.coupled @ border[:, :f], border[:f, :f]
    columns[:split, -1], columns[free, -1] = eliminated.units_of(functional) + eliminated.coupled @ along, -along[:f]
    joint = np.block([[border[:f, :f], -along[:f, None]], [-along[:f], functional @ columns[:split, -1]]])
    return columns, joint


def _with_readouts_as_declared(columns: Floats, covariance: Floats, readouts: Ints) -> tuple[Floats, Floats, Floats]:
    """Columns and covariance as `_with_scale` has them where readouts vary, for readouts that stay as they are.

    And by how much (f + 1, r) the unknowns err for each that is not what was declared: rows of another time pass for a
    time offset, and turn and move cameras. What their squares come to follows from what the drive says of readouts: the
    step that it would take there, and the covariance of that [a consider covariance: Bierman, Factorization Methods for
    Discrete Sequential Estimation, 1977].
    """
    if not len(readouts):
        return columns, covariance, np.zeros((len(covariance), 0))
    gain = covariance[:, readouts] @ np.linalg.inv(covariance[np.ix_(readouts, readouts)])
    columns, covariance = columns - columns[:, readouts] @ gain.T, covariance - gain @ covariance[readouts]
    columns[:, readouts] = covariance[readouts] = covariance[:, readouts] = gain[readouts] = 0.0
    return columns, covariance, gain


def _dense_marginals(system: ReducedCameraSystem, position: Floats) -> _Marginals:
    """Marginals by the inverse without its null space."""
    layout = system.layout
    size, split = layout.size, UNIT_DOF * layout.num_units
    if size > LARGEST_DENSE:
        cameras = np.diag(np.full(size - split, np.inf))
        units = np.full((layout.num_units, UNIT_DOF), np.inf)
        return _Marginals(
            units=units,
            cameras=cameras,
            cameras_of_independent_errors=cameras,
            scale_with_cameras=np.full(size - split, np.nan),
            sigma_scale=np.inf,
            sigma_scale_of_independent_errors=np.inf,
            by_scale_m=np.zeros((layout.num_units, 3)),
        )
    matrix = system.matrix
    free = np.setdiff1d(np.arange(size), layout.held())
    free = free[np.diagonal(matrix)[free] > 0.0]
    inverse, loose = _inverse(matrix[np.ix_(free, free)])
    variance = np.full(size, np.inf)
    variance[layout.held()] = 0.0
    variance[free] = np.where(loose, np.inf, np.maximum(np.diagonal(inverse), 0.0))
    covariance = np.zeros((size, size))
    covariance[np.ix_(free, free)] = inverse
    covariance[np.diag_indices(size)] = variance
    units = variance[:split].reshape(-1, UNIT_DOF)
    scale, scale_with_cameras = float("nan"), np.full(size - split, np.nan)
    by_scale = np.zeros((layout.num_units, 3))
    if np.isinf(units[:, 3:]).any():
        scale = np.inf
    elif len(position) >= 2:
        functional = scale_functional(position)
        of_scale = covariance[:split, :split] @ functional
        scale = _sigma_scale(float(functional @ of_scale))
        by_scale = of_scale.reshape(-1, UNIT_DOF)[:, 3:] / max(float(functional @ of_scale), 1e-30)
        scale_with_cameras = functional @ covariance[:split, split:]
    cameras = covariance[split:, split:]
    return _Marginals(
        units=units,
        cameras=cameras,
        cameras_of_independent_errors=cameras,
        scale_with_cameras=scale_with_cameras,
        sigma_scale=scale,
        sigma_scale_of_independent_errors=scale,
        by_scale_m=by_scale,
    )


def _inverse(matrix: Floats) -> tuple[Floats, Bools]:
    """Inverse (n, n) of a symmetric matrix without its null space, and which unknowns (n,) take part in that."""
    n = len(matrix)
    if n == 0:
        return matrix, np.zeros(0, dtype=np.bool_)
    # Scaled to a unit diagonal first: metres and radians differ by orders of magnitude.
    d = 1.0 / np.sqrt(np.diagonal(matrix))
    scaled = matrix * d[:, None] * d[None, :]
    loose = np.zeros(n, dtype=np.bool_)
    try:
        factor = scipy.linalg.cho_factor(scaled, lower=True)
        regular = float((np.diagonal(factor[0]) ** 2).min()) > SINGULAR
    except np.linalg.LinAlgError:
        regular = False
    if regular:
        inverse = np.asarray(scipy.linalg.cho_solve(factor, np.eye(n)))
    else:
        values, vectors = scipy.linalg.eigh(scaled)
        null = values < SINGULAR * values[-1]
        loose = (vectors[:, null] ** 2).sum(1) > 1e-9
        inverse = (vectors[:, ~null] / values[~null]) @ vectors[:, ~null].T
    result: Floats = inverse * d[:, None] * d[None, :]
    return result, loose


def _sigma_scale(variance: float) -> float:
    """Standard deviation of the scale; infinite where its information is what rounding leaves of none."""
    sigma = float(np.sqrt(max(variance, 0.0)))
    return sigma if sigma < UNKNOWN_SCALE else np.inf


def scale_functional(position: Floats) -> Floats:
    """Derivative of the trajectory's size by a step (6 units,) of the units, relative to the size."""
    centred = position - position.mean(0)
    functional = np.zeros((len(position), UNIT_DOF))
    functional[:, 3:] = centred / max(float((centred**2).sum()), 1e-12)
    return functional.ravel()
