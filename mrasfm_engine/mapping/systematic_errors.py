"""Errors of a calibration that all images share: those of lens models, and what no unknown of the adjustment explains.

Lens models are off by tenths of a pixel, and by the same in all images: cameras turn and move by what makes up for it,
and no drive with the same intrinsics shows that. What is left shows along the parameters that are held as given. At a
solution the cost has derivatives h by the parameters of all lenses. In axes in which the information D on these
parameters is diagonal, each in units of its usual error,

    h ~ N(0, n^2 m D + s^2 D^2)

with s the size of lens errors in those units, m the squared residuals under the loss for one unit of information, and n
the factor by which other errors that images share exceed independent ones. Axes that images tell badly show n, those
that they tell well show s. Whatever is probable by that, weighed by how probable it is, gives the lens errors' second
moments, which cameras follow as an adjustment lets them [a consider covariance: Bierman, Factorization Methods for
Discrete Sequential Estimation, 1977]. Errors that n stands for move cameras as independent ones do, n times as far;
errors that units and points share are among them.

Rotations take nearly all that a principal point is off by, so that little of it shows; it may be off by more than the
rest of a lens, which is as improbable as it is more unless images show it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mrasfm_engine.bundle_adjustment.priors import IntrinsicsPrior, ScalePrior, Term
from mrasfm_engine.bundle_adjustment.problem import INTRINSICS, PLACES_OF_INTRINSICS, TIME, UNIT_DOF
from mrasfm_engine.bundle_adjustment.shared_errors import information_of_terms
from mrasfm_engine.bundle_adjustment.solver import Problem, SolverOptions
from mrasfm_engine.geometry.camera_model import unproject_pixels
from mrasfm_engine.mapping.calibration import prior_among_observing_cameras
from mrasfm_engine.mapping.intrinsics import problem_of_all_intrinsics
from mrasfm_engine.mapping.lens_errors import LENS_SIGMA_PX, lens_sigmas
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.types import Bools, Floats, Ints

PRINCIPAL_POINT = (2, 3)  # places among the intrinsics
STEPS_ACROSS = 24  # of the grid of pixels over an image
NO_NOISE = 1e-12
SEEN = 1e-9  # information below this share of the largest is rounding
# Sizes that are as probable as one another before images say anything: of lens errors in units of the usual one, and
# the factor on independent errors. Beyond, no drive sees lens errors, or images no longer match.
LENS_SIZES = np.geomspace(3e-5, 3.0, 51)
FACTORS = np.geomspace(1.0, 1000.0, 31)
# Sizes of errors of principal points, in those of other parameters' errors, and how probable each is before images say
# anything.
RATIOS = 4.0 ** np.arange(5)
PRIOR_OF_RATIOS = RATIOS**-1.5


@dataclass(frozen=True, kw_only=True)
class SystematicErrors:
    """Variances (c, 7) of the cameras' rotations (rad), translations (m) and time offsets (s) by errors of all images.

    Those of poses are among one another.
    """

    by_lenses: Floats
    by_others: Floats  # with what priors err by
    lens_px: float  # RMS over an image of what each parameter but the principal point is off by, as images show
    factor: float  # of other errors on independent ones

    def sigma_camera(self, sigma: Floats) -> Floats:
        """Sigmas (c, 6) of the cameras' poses with these errors, of those without."""
        return self._with(sigma, slice(6))

    def sigma_time_s(self, sigma_s: Floats) -> Floats:
        """Sigmas (c,) of time offsets, likewise."""
        return self._with(sigma_s, 6)

    def _with(self, sigma: Floats, places: slice | int) -> Floats:
        result: Floats = np.sqrt(np.maximum(sigma**2, self.by_others[:, places]) + self.by_lenses[:, places])
        return result


def systematic_errors(
    mapper: Mapper,
    *,
    free_units: Bools,
    free_times: Bools | None,
    terms: Sequence[Term],
    given_scale: ScalePrior | None,
    options: SolverOptions,
) -> SystematicErrors | None:
    """Errors of the calibration of a solution by what the parameters of lens models show, that are held as given.

    None where images tell nothing of these.

    Parameters
    ----------
    free_units, free_times, terms, options
        Of the adjustment that led there, in which all cameras vary, with the calibration's prior.
    given_scale
        What given rotations had to say in it, which is none of the `terms`.
    """
    cameras = len(mapper.camera_kind)
    usual = _over_images(mapper)
    problem = problem_of_all_intrinsics(
        mapper,
        IntrinsicsPrior(params=mapper.state.camera_params, sigma=usual),
        free_units=free_units,
        free_times=free_times,
        terms=terms,
        options=options,
    ).with_curvature()
    lenses, noise2 = _Lenses.reduce(problem, usual), _noise2(problem)
    told = None if lenses is None else _told_by(lenses, noise2)
    if lenses is None or told is None:
        return None
    by_lenses = lenses.moved @ told.moments @ lenses.moved.T
    by_others = lenses.of_terms + told.factor2 * noise2 * lenses.of_images
    dof = problem.layout.camera_dof
    if given_scale is not None:
        of_cameras = np.zeros((cameras, dof))
        of_cameras[:, :3] = given_scale.by_steps(mapper.state)
        functional = of_cameras.ravel()[lenses.place]
        response = _held_back(lenses.of_terms + lenses.of_images, functional, given_scale.share)
        by_lenses, by_others = (response @ moments @ response.T for moments in (by_lenses, by_others))
    return SystematicErrors(
        by_lenses=_by_camera(mapper, by_lenses, lenses.place, dof),
        by_others=_by_camera(mapper, by_others, lenses.place, dof),
        lens_px=LENS_SIGMA_PX * float(np.sqrt(told.size2)),
        factor=float(np.sqrt(told.factor2)),
    )


def _by_camera(mapper: Mapper, moments: Floats, place: Ints, dof: int) -> Floats:
    """Variances (c, 7) of poses among one another and of time offsets, of all unknowns (f, f) at their places."""
    of_all = np.zeros((dof * len(mapper.camera_kind),) * 2)
    of_all[np.ix_(place, place)] = moments
    first = dof * np.arange(len(mapper.camera_kind))
    poses = prior_among_observing_cameras(mapper).without_gauge(
        of_all[np.ix_(*[(first[:, None] + np.arange(6)).ravel()] * 2)]
    )
    times_s2 = np.diagonal(of_all)[first + TIME] if dof > TIME else np.zeros(len(first))
    return np.maximum(np.column_stack([np.diagonal(poses).reshape(-1, 6), times_s2]), 0.0)


def _noise2(problem: Problem) -> float:
    """Squared derivatives by observations for one unit of information, of a problem with the curvature of its loss."""
    options = problem.options
    squared = problem.errors_px2(problem.state) / options.sigma_px**2
    weight2 = (1.0 + squared / options.loss_scale**2) ** -2.0
    return max(float((weight2 * squared).sum() / (2.0 * weight2.sum())), NO_NOISE)


@dataclass(frozen=True, kw_only=True)
class _Lenses:
    """Normal equations that are reduced to l parameters of lenses that are held, in units of their usual errors.

    Attributes
    ----------
    information, derivatives
        (l, l) and (l,) of the cost, without a prior of these.
    is_principal_point
        (l,)
    place
        (f,) of the cameras' other unknowns among all of theirs.
    moved
        (f, l) by how much these follow errors of the lenses.
    of_images, of_terms
        (f, f) shares of independent errors of images, and of those of terms, in the covariance of these, lenses being
        right.
    """

    information: Floats
    derivatives: Floats
    is_principal_point: Bools
    place: Ints
    moved: Floats
    of_images: Floats
    of_terms: Floats

    @staticmethod
    def reduce(problem: Problem, usual: Floats) -> _Lenses | None:
        """None where something besides single unknowns is not determined.

        Parameters
        ----------
        problem
            At a solution for lenses that are held; here they vary under a prior of the `usual` sigmas (c, INTRINSICS).
        """
        system = problem.normal_equations(problem.state, 0.0)
        eliminated = system.eliminate((~(system.matrix_diagonal() > 0.0)).astype(np.float64))
        if eliminated is None or eliminated.cameras is None:
            return None
        free, dof, split = eliminated.free, problem.layout.camera_dof, UNIT_DOF * problem.layout.num_units
        known, gradient = eliminated.equations_of_border(system)
        camera, parameter = free // dof, np.searchsorted(PLACES_OF_INTRINSICS, free % dof)
        is_lens = np.isin(free % dof, PLACES_OF_INTRINSICS)
        lens, rest = np.flatnonzero(is_lens), np.setdiff1d(np.arange(len(known)), np.flatnonzero(is_lens))
        between, inverse = known[np.ix_(rest, lens)], np.linalg.inv(known[np.ix_(rest, rest)])
        follow = -inverse @ between
        unit = usual[camera[lens], parameter[lens]]
        reduced = unit[:, None] * (known[np.ix_(lens, lens)] + between.T @ follow) * unit
        place = free[~is_lens]
        f = len(place)
        columns = np.zeros((problem.layout.size, f))
        columns[:split], columns[split + place] = -eliminated.coupled[:, rest] @ inverse[:, :f], inverse[:f, :f]
        of_terms = information_of_terms(problem, problem.state, columns)
        return _Lenses(
            information=reduced - np.eye(len(lens)),
            derivatives=unit * (gradient[lens] + follow.T @ gradient[rest]),
            is_principal_point=np.isin(parameter[lens], PRINCIPAL_POINT),
            place=place,
            moved=follow[:f] * unit,
            of_images=inverse[:f, :f] - of_terms,
            of_terms=of_terms,
        )


def _held_back(covariance: Floats, functional: Floats, share: float) -> Floats:
    """Response (f, f) of unknowns to errors, of which a functional (f,) follows these by one less a share only.

    The others follow that by their regression on it.
    """
    along, response = covariance @ functional, np.eye(len(functional))
    variance = float(functional @ along)
    if variance > 0.0:
        response -= share / variance * np.outer(along, functional)
    return response


@dataclass(frozen=True, kw_only=True)
class _Told:
    """Expectations by what the lenses' parameters show."""

    moments: Floats  # (l, l) second moments of lens errors
    size2: float  # squared size of lens errors but for principal points, in units of the usual ones
    factor2: float  # squared factor of other errors on independent ones, geometric mean: it cannot be below one


def _told_by(lenses: _Lenses, noise2: float) -> _Told | None:
    """Expectations by derivatives along lens parameters, see the module; None where images see nothing of lens errors.

    Parameters
    ----------
    noise2
        m of the module.
    """
    if not len(lenses.information):
        return None
    size2, others2 = LENS_SIZES[:, None, None] ** 2, noise2 * FACTORS[None, :, None] ** 2
    likely, found = [], []
    for ratio, prior in zip(RATIOS, PRIOR_OF_RATIOS, strict=True):
        scale = np.where(lenses.is_principal_point, ratio, 1.0)
        information, axes = np.linalg.eigh(scale[:, None] * lenses.information * scale)
        axes = scale[:, None] * axes
        derivatives = axes.T @ lenses.derivatives
        seen = information > SEEN * max(float(information[-1]), 1.0)
        if not seen.any():
            return None
        known, shown = np.where(seen, information, 0.0), np.where(seen, derivatives, 0.0)
        spread = others2 + size2 * known
        squared = shown**2 / (np.where(seen, known, 1.0) * spread)
        likely.append(np.log(prior) - 0.5 * (np.log(spread / others2) + squared + seen * np.log(others2)).sum(axis=2))
        found.append((axes, -size2 * shown / spread, size2 * others2 / spread))
    weight = np.exp(np.array(likely) - np.max(likely))
    weight /= weight.sum()
    moments = np.zeros_like(lenses.information)
    for own, (axes, error, left) in zip(weight, found, strict=True):
        flat, by_axis = error.reshape(-1, error.shape[2]), (own[..., None] * left).sum(axis=(0, 1))
        moments += axes @ (flat.T @ (own.reshape(-1, 1) * flat) + np.diag(by_axis)) @ axes.T
    of_size, of_factor = weight.sum(axis=(0, 2)), weight.sum(axis=(0, 1))
    return _Told(
        moments=moments,
        size2=float((of_size * LENS_SIZES**2).sum()),
        factor2=float(np.exp((of_factor * np.log(FACTORS**2)).sum())),
    )


def _over_images(mapper: Mapper) -> Floats:
    """Usual sigmas (c, INTRINSICS) of lens parameters by the whole images, as calibrations see all of these."""
    result = np.empty((len(mapper.camera_kind), INTRINSICS))
    steps = (np.arange(STEPS_ACROSS) + 0.5) / STEPS_ACROSS
    for c, (kind, params) in enumerate(zip(mapper.camera_kind.tolist(), mapper.state.camera_params, strict=True)):
        columns_px, rows_px = steps * mapper.image_size_px[c, :, None]
        pixels = np.stack(np.meshgrid(columns_px, rows_px), axis=-1).reshape(-1, 2)
        result[c] = lens_sigmas(kind, params, pixels, unproject_pixels(kind, params, pixels))
    return result
