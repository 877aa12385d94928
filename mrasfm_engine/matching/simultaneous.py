"""Relative poses of cameras from images that are taken at once: how far they contradict the given calibration.

Matches between images of one instant obey one epipolar geometry in all units of the drive. Pooled, they say much more
of the cameras' relative poses than the images of one unit, and they say it before any unit has a pose: a camera that is
a degree off its given rotation is found before its matches are thrown away for that.

Corrections x of the cameras' rotations minimise

    sum of rho(e^2 / variance) + x' P^-1 x      e = t . (g_a x g_b) / sqrt(|t x g_a|^2 + |t x g_b|^2)

with rays g in rig axes, t from camera b to camera a, and P the prior. e is the Sampson distance in radians [Hartley and
Zisserman, Multiple View Geometry, 11.4.3]; its variance is the keypoints' and what the prior of t adds: cameras of
different places say little of t. Of the result only what the images demand is used: along the principal directions of
their information against the prior, those corrections that are significant. A rig that is given well enough stays
exactly as given.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from mrasfm_engine.config import BundleAdjustmentConfig, MatchConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_cameras
from mrasfm_engine.matching.verification import signed_parallax
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import PairMatches
from mrasfm_engine.types import Bools, Floats
from schemas.findings import Finding, warning

SIMULTANEOUS_US = 2_000  # cameras less apart than this are one rig: a fast car goes 6 cm
GATE_SIGMAS = 3.0
SIGNIFICANT_SIGMAS = 3.0
MAX_MATCHES = 2_000  # of a pair of cameras, spread over its units
# Lens models are off by the same in all images, in about as many patterns as they have parameters. So matches of two
# cameras, however many, say no more than these many independent ones.
INDEPENDENT_MATCHES = 10
MIN_SIGMA_PX = 0.5  # of a coordinate: keypoints are not better
ITERATIONS = 40
INITIAL_DAMPING = 1e-3
CONVERGED = 1e-3  # of a prior's standard deviation
SETTLED = 0.99  # of the spread that errors had before
CLEARLY_GIVEN = 0.5  # share of the matches: one that most contradict is not the rig's calibration


@dataclass(frozen=True, kw_only=True)
class SimultaneousMatches:
    """Viewing rays (n, 3), in camera axes, of matches between simultaneous images of two cameras."""

    camera_a: int
    camera_b: int
    rays_a: Floats
    rays_b: Floats


@dataclass(frozen=True, kw_only=True)
class RigEstimate:
    """The cameras' poses with the corrections that simultaneous images demand, and what is left uncertain.

    Attributes
    ----------
    rig_from_cam
        (c, 4, 4)
    covariance_rad2
        (3 c, 3 c) of rotations in rig axes, camera by camera.
    variance_translation_m2
        (c,) of each axis, by the prior.
    matches
        How many took part.
    fitted_as_given, fitted
        Shares of them that lie near their epipolar lines under the given calibration, and under the estimate.
    """

    rig_from_cam: Floats
    covariance_rad2: Floats
    variance_translation_m2: Floats
    matches: int
    fitted_as_given: float
    fitted: float

    def fits(self, found: SimultaneousMatches, *, max_error: float) -> Bools:
        """Mask (n,) of the matches that meet in front of both cameras, near their epipolar lines.

        `max_error` (rad) is what keypoints may be off; to it comes what the poses are uncertain by.
        """
        a, b = found.camera_a, found.camera_b
        rig_from_a, rig_from_b = self.rig_from_cam[a], self.rig_from_cam[b]
        error, by_rotation, by_shift, normal = epipolar_derivatives(rig_from_a, rig_from_b, found.rays_a, found.rays_b)
        rows = np.concatenate([3 * a + np.arange(3), 3 * b + np.arange(3)])
        covariance = self.covariance_rad2[np.ix_(rows, rows)]
        shift_m2 = self.variance_translation_m2[[a, b]].sum()
        variance = _forms(covariance, np.concatenate(by_rotation, axis=1)) + shift_m2 * (by_shift**2).sum(1)
        near = error**2 < max_error**2 + GATE_SIGMAS**2 * variance
        # A turn about the epipolar plane's normal lets rays cross nearer or farther, or behind.
        slack = max_error**2 + GATE_SIGMAS**2 * _forms(covariance, np.concatenate([normal, -normal], axis=1))
        b_from_a = se3.inverse(rig_from_b) @ rig_from_a
        result: Bools = near & (signed_parallax(b_from_a, found.rays_a, found.rays_b) > -np.sqrt(slack))
        return result


def _forms(covariance: Floats, rows: Floats) -> Floats:
    """Variances (n,) of linear functions, given by rows (n, k), of what has a covariance (k, k)."""
    result: Floats = ((rows @ covariance) * rows).sum(1)
    return result


def contradiction(names: Sequence[str], given: Floats, rig: RigEstimate) -> Finding | None:
    """Finding on a calibration (c, 4, 4) under which most matches between simultaneous images would be wrong."""
    if not rig.matches or rig.fitted_as_given >= CLEARLY_GIVEN or rig.fitted < CLEARLY_GIVEN:
        return None
    turned = rig.rig_from_cam[:, :3, :3] @ np.swapaxes(given[:, :3, :3], 1, 2)
    between_deg = np.degrees(np.linalg.norm(se3.log_so3(np.swapaxes(turned, 1, 2)[:, None] @ turned[None]), axis=-1))
    a, b = sorted(int(k) for k in np.unravel_index(int(between_deg.argmax()), between_deg.shape))
    return warning(
        "calibration-contradicted",
        f"simultaneous images show cameras {names[a]} and {names[b]} turned by "
        f"{between_deg[a, b]:.2f} deg against each other from where rig.cameras says: of {rig.matches} matches "
        f"{rig.fitted_as_given:.0%} fit the calibration as given, {rig.fitted:.0%} as corrected",
        "Mapping begins with the corrected rotations; take the result from calibration.json, and check the mounting.",
    )


def are_simultaneous(drive: Drive, image_a: int, image_b: int) -> bool:
    """True for images of one unit and one instant; else the vehicle's motion lies between them, unknown yet."""
    a, b = drive.images[image_a], drive.images[image_b]
    return a.unit == b.unit and abs(a.timestamp_us - b.timestamp_us) <= SIMULTANEOUS_US


def rig_of_drive(
    drive: Drive,
    pairs: Sequence[PairMatches],
    rays_of: Callable[[PairMatches], tuple[Floats, Floats]],
    match_config: MatchConfig,
    calibration: BundleAdjustmentConfig,
) -> RigEstimate:
    """The drive's rig from the inliers of its simultaneous pairs; where settings hold the calibration, as it is given.

    `rays_of` tells the viewing rays (n, 3) of a pair's inliers in image_a and image_b.
    """
    found = []
    for pair in pairs if calibration.refine_calibration else ():
        if are_simultaneous(drive, pair.image_a, pair.image_b):
            a, b = (drive.images[image].camera for image in (pair.image_a, pair.image_b))
            rays_a, rays_b = rays_of(pair)
            found.append(SimultaneousMatches(camera_a=a, camera_b=b, rays_a=rays_a, rays_b=rays_b))
    sigma_rotation_rad, sigma_translation_m = calibration_sigmas(drive, calibration)
    return estimate_rig(
        drive.rig_from_cam,
        _pooled(found),
        sigma_rotation_rad=sigma_rotation_rad,
        sigma_translation_m=sigma_translation_m,
        focal_px=pack_cameras(drive.cameras)[1][:, :2].mean(1),
        max_error_px=match_config.max_error_px,
    )


def calibration_sigmas(drive: Drive, settings: BundleAdjustmentConfig) -> tuple[Floats, Floats]:
    """Standard deviations (c,) of each axis of the given rotations (rad) and translations (m), or the usual ones."""
    return (
        np.radians([c.sigma_rotation_deg or settings.sigma_rotation_deg for c in drive.cameras]),
        np.array([c.sigma_translation_m or settings.sigma_translation_m for c in drive.cameras]),
    )


def _pooled(found: Iterable[SimultaneousMatches]) -> list[SimultaneousMatches]:
    """All matches of each pair of cameras together, at most `MAX_MATCHES` of each."""
    by_pair: dict[tuple[int, int], list[SimultaneousMatches]] = {}
    for one in found:
        by_pair.setdefault((one.camera_a, one.camera_b), []).append(one)
    result = []
    for (a, b), parts in sorted(by_pair.items()):
        rays_a, rays_b = (np.concatenate([getattr(part, name) for part in parts]) for name in ("rays_a", "rays_b"))
        keep = np.unique(np.linspace(0, len(rays_a) - 1, min(len(rays_a), MAX_MATCHES)).astype(np.int64))
        result.append(SimultaneousMatches(camera_a=a, camera_b=b, rays_a=rays_a[keep], rays_b=rays_b[keep]))
    return result


def estimate_rig(
    rig_from_cam: Floats,
    found: Sequence[SimultaneousMatches],
    *,
    sigma_rotation_rad: Floats,
    sigma_translation_m: Floats,
    focal_px: Floats,
    max_error_px: float,
) -> RigEstimate:
    """The cameras' poses from matches between simultaneous images and the given ones.

    Parameters
    ----------
    rig_from_cam
        Given poses (c, 4, 4).
    found
        Matches that may be right, by pair of cameras.
    sigma_rotation_rad, sigma_translation_m
        Prior of the given poses (c,), each axis.
    focal_px
        Of the cameras (c,): noise is in pixels.
    max_error_px
        Distance from its epipolar line at which a match counts as right.
    """
    problem = _RotationProblem(
        rig_from_cam=rig_from_cam,
        found=[one for one in found if len(one.rays_a)],
        sigma_rad=np.repeat(sigma_rotation_rad, 3),
        variance_translation_m2=sigma_translation_m**2,
        focal_px=focal_px,
    )
    x, spread_px, damping = np.zeros(3 * len(rig_from_cam)), problem.spread_px(rig_from_cam), INITIAL_DAMPING
    for _ in range(ITERATIONS):
        information, gradient, cost = problem.linearise(x, spread_px)
        damped = information + np.diag(1.0 + damping * np.diag(information))
        step = -np.linalg.solve(damped, gradient + x)
        if problem.linearise(x + step, spread_px)[2] > cost:
            damping *= 10.0
            continue
        x, damping = x + step, 0.1 * damping
        narrower = np.minimum(spread_px, problem.spread_px(problem.corrected(x)))
        settled = bool((narrower > SETTLED * spread_px).all())
        spread_px = narrower
        if settled and np.abs(step).max(initial=0.0) < CONVERGED:
            break
    known, directions = np.linalg.eigh(problem.linearise(x, spread_px)[0])
    posterior = 1.0 / np.sqrt(1.0 + np.maximum(known, 0.0))
    along = directions.T @ x
    demanded = np.abs(along) > SIGNIFICANT_SIGMAS * posterior
    refined = problem.corrected(directions[:, demanded] @ along[demanded])
    spread = (directions * posterior) * problem.sigma_rad[:, None]
    return RigEstimate(
        rig_from_cam=refined,
        covariance_rad2=spread @ spread.T,
        variance_translation_m2=sigma_translation_m**2,
        matches=sum(len(one.rays_a) for one in problem.found),
        fitted_as_given=problem.share_that_fits(rig_from_cam, max_error_px),
        fitted=problem.share_that_fits(refined, max_error_px),
    )


@dataclass(frozen=True, kw_only=True)
class _RotationProblem:
    """Corrections x (3 c,) of the cameras' rotations, in the prior's standard deviations, from matches of pairs."""

    rig_from_cam: Floats  # (c, 4, 4) given
    found: Sequence[SimultaneousMatches]
    sigma_rad: Floats  # (3 c,) prior
    variance_translation_m2: Floats  # (c,) prior
    focal_px: Floats  # (c,)

    def corrected(self, x: Floats) -> Floats:
        """Poses (c, 4, 4) with the rotations corrected."""
        turned = se3.exp_so3((x * self.sigma_rad).reshape(-1, 3)) @ self.rig_from_cam[:, :3, :3]
        return se3.transform(turned, self.rig_from_cam[:, :3, 3])

    def linearise(self, x: Floats, spread_px: Floats) -> tuple[Floats, Floats, float]:
        """J' W J and J' W r of the matches, and half the cost with the prior's.

        There is a Cauchy loss, and no more information than of `INDEPENDENT_MATCHES` of each pair of cameras.
        """
        rig, size = self.corrected(x), len(x)
        information, gradient, cost = np.zeros((size, size)), np.zeros(size), 0.5 * float(x @ x)
        for one, spread in zip(self.found, spread_px, strict=True):
            a, b = one.camera_a, one.camera_b
            error, by_rotation, by_shift, _ = epipolar_derivatives(rig[a], rig[b], one.rays_a, one.rays_b)
            shift_m2 = self.variance_translation_m2[[a, b]].sum()
            variance = (spread * self._pixel_rad(one)) ** 2 + shift_m2 * (by_shift**2).sum(1)
            count = min(1.0, INDEPENDENT_MATCHES / len(error))
            weight = count / (variance + error**2)
            rows = np.concatenate([3 * a + np.arange(3), 3 * b + np.arange(3)])
            jacobian = np.concatenate([by_rotation[0], by_rotation[1]], axis=1) * self.sigma_rad[rows]
            information[np.ix_(rows, rows)] += jacobian.T @ (weight[:, None] * jacobian)
            gradient[rows] += jacobian.T @ (weight * error)
            cost += 0.5 * count * float(np.log1p(error**2 / variance).sum())
        return information, gradient, cost

    def spread_px(self, rig_from_cam: Floats) -> Floats:
        """Standard deviation of the errors of each pair of cameras (p,), from their median."""
        medians = [np.median(_errors(rig_from_cam, one)) / self._pixel_rad(one) for one in self.found]
        return np.maximum(MIN_SIGMA_PX, np.array(medians) / 0.6745)

    def share_that_fits(self, rig_from_cam: Floats, max_error_px: float) -> float:
        """Share of all matches that lie near their epipolar lines."""
        fits = [(_errors(rig_from_cam, one) < max_error_px * self._pixel_rad(one)).sum() for one in self.found]
        return float(sum(fits) / max(sum(len(one.rays_a) for one in self.found), 1))

    def _pixel_rad(self, one: SimultaneousMatches) -> float:
        return float(1.0 / self.focal_px[[one.camera_a, one.camera_b]].min())


def _errors(rig_from_cam: Floats, one: SimultaneousMatches) -> Floats:
    poses = rig_from_cam[one.camera_a], rig_from_cam[one.camera_b]
    result: Floats = np.abs(epipolar_derivatives(*poses, one.rays_a, one.rays_b)[0])
    return result


def epipolar_derivatives(
    rig_from_a: Floats, rig_from_b: Floats, rays_a: Floats, rays_b: Floats
) -> tuple[Floats, tuple[Floats, Floats], Floats, Floats]:
    """Sampson distances (n,) in rad of rays (n, 3) of two cameras, and their derivatives.

    These are (n, 3) each, in the rotations of a and b and in the place of a against b, all in rig axes; the last are
    the unit normals (n, 3) of the epipolar planes.
    """
    a, b = rays_a @ rig_from_a[:3, :3].T, rays_b @ rig_from_b[:3, :3].T
    t = rig_from_a[:3, 3] - rig_from_b[:3, 3]
    across, ta, tb = np.cross(a, b), np.cross(t, a), np.cross(t, b)
    length = np.maximum(np.sqrt((ta**2).sum(1) + (tb**2).sum(1)), 1e-12)[:, None]
    normal = ta / np.maximum(np.linalg.norm(ta, axis=1), 1e-12)[:, None]
    by_rotation = -np.cross(a, tb) / length, np.cross(b, ta) / length
    return across @ t / length[:, 0], by_rotation, across / length, normal
