"""Relative poses of cameras from images that are taken at once: how far they contradict the given calibration.

Matches between images of one instant obey one epipolar geometry in all units of the drive. Pooled, they say much more
of the cameras' relative poses than the images of one unit, and they say it before any unit has a pose: a camera that is
a degree off its given rotation is found before its matches are thrown away for that.

Corrections x of the cameras' rotations and places minimise

    sum of rho(e^2 / variance) + x' P^-1 x

with the Sampson distances e of `sampson`, the prior P and the variance of the keypoints. Of the result only what the
images demand of the rotations is used, whatever the places are: along the principal directions of their information
against the prior, those corrections that are significant. A rig that is given well enough stays exactly as given, and
places always do: matches say little of them.

Matches that are all wrong by hundreds of pixels hardly pull, so that a camera that is many sigmas off is looked for
from where they lead with next to no prior. A correction has to make matches fit: those of every pair of cameras no
worse than before, and far turns most of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mrasfm_engine.config import BundleAdjustmentConfig, MatchConfig
from mrasfm_engine.errors import CancelledError
from mrasfm_engine.even_choice import even_choice
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_cameras
from mrasfm_engine.matching.relative_pose import UncertainRig
from mrasfm_engine.matching.robust_correction import Correction, Errors, most_likely_correction
from mrasfm_engine.matching.sampson import epipolar_derivatives
from mrasfm_engine.matching.verification import essential_inliers
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import PairMatches
from mrasfm_engine.types import Bools, Cancel, Floats
from schemas.findings import Finding, warning

SIMULTANEOUS_US = 2_000  # cameras less apart than this are one rig: a fast car goes 6 cm
SIGNIFICANT_SIGMAS = 3.0
MAX_MATCHES = 2_000  # of a pair of cameras, spread over its units
# Lens models are off by the same in all images, in about as many patterns as they have parameters. So matches of two
# cameras, however many, say no more than these many independent ones.
INDEPENDENT_MATCHES = 10
MIN_SIGMA_PX = 0.5  # of a coordinate: keypoints are not better
CLEARLY_GIVEN = 0.5  # share of the matches: one that most contradict is not the rig's calibration
WEAK_PRIOR = 1e-3  # of the prior's weight: corrections of 30 sigmas cost what one does
MIN_UNITS = 3  # whose matches lead far and count in full: wrong ones of one unit all agree with some relative pose
# Shares of matches that fit, by which a correction stands: it makes nearly all fit or clearly more, and of no pair of
# cameras fewer. A far one, by many sigmas between two cameras, has to make most of their own matches fit.
WELL_FITTED, GAIN, FITTED_FAR = 0.9, 0.05, 0.75
FAR_SIGMAS = 3.0
# A turn of more is no matter of calibration: see `contradicted_rig`.
LARGEST_TURN_DEG, LARGEST_TURN_SIGMAS = 20.0, 5.0


@dataclass(frozen=True, kw_only=True)
class SimultaneousMatches:
    """Viewing rays (n, 3), in camera axes, of matches between simultaneous images of two cameras in some units."""

    camera_a: int
    camera_b: int
    rays_a: Floats
    rays_b: Floats
    units: int


@dataclass(frozen=True, kw_only=True)
class RigEstimate(UncertainRig):
    """The cameras' poses with the corrections that simultaneous images demand, and what is left uncertain.

    Attributes
    ----------
    matches
        How many took part.
    fitted_as_given, fitted
        Shares of them that lie near their epipolar lines under the given calibration, and under the estimate.
    is_far
        Whether two cameras are turned against one another by many sigmas.
    """

    matches: int
    fitted_as_given: float
    fitted: float
    is_far: bool = False


def contradiction(names: Sequence[str], given: Floats, rig: RigEstimate) -> Finding | None:
    """Finding on a calibration (c, 4, 4) that simultaneous images contradict: by most matches, or by a far turn."""
    is_contradicted = rig.matches and rig.fitted_as_given < CLEARLY_GIVEN <= rig.fitted
    if not (is_contradicted or rig.is_far):
        return None
    between_deg = np.degrees(turned_between(given, rig.rig_from_cam))
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
    simultaneous = [pair for pair in pairs if are_simultaneous(drive, pair.image_a, pair.image_b)]
    found = _pooled(drive, simultaneous if calibration.refine_calibration else (), rays_of)
    sigma_rotation_rad, sigma_translation_m = calibration_sigmas(drive, calibration)
    return estimate_rig(
        drive.rig_from_cam,
        found,
        sigma_rotation_rad=sigma_rotation_rad,
        sigma_translation_m=sigma_translation_m,
        focal_px=pack_cameras(drive.cameras)[1][:, :2].mean(1),
        max_error_px=match_config.max_error_px,
    )


def verified_again(
    drive: Drive,
    pairs: Sequence[PairMatches],
    rays_of: Callable[[PairMatches], tuple[Floats, Floats]],
    rig: UncertainRig,
    *,
    focal_px: Floats,
    config: MatchConfig,
    cancel: Cancel | None = None,
) -> list[PairMatches]:
    """The pairs, those of simultaneous images with the inliers that follow from another rig than the one so far.

    All matches of a pair are judged, by the essential matrix and by the rig: those come back that an earlier rig threw
    away. Pairs with too few inliers have none, and stay, to be judged again.

    Parameters
    ----------
    rays_of
        Viewing rays (n, 3) of all of a pair's matches in image_a and image_b, through the cameras' lenses as of now.
    rig
        Poses of the cameras as of now, and their covariance.
    focal_px
        Of the cameras (c,).
    """
    result = []
    for pair in pairs:
        if cancel is not None and cancel():
            raise CancelledError
        if are_simultaneous(drive, pair.image_a, pair.image_b):
            rays = rays_of(pair)
            max_error = max_error_rad(drive, pair.image_a, pair.image_b, focal_px, config)
            essential = replace(pair, inliers=essential_inliers(*rays, max_error=max_error))
            result.append(verified_in_rig(drive, essential, rays, rig, max_error=max_error, config=config))
        else:
            result.append(pair)
    return result


def verified_in_rig(
    drive: Drive,
    pair: PairMatches,
    rays: tuple[Floats, Floats],
    rig: UncertainRig,
    *,
    max_error: float,
    config: MatchConfig,
) -> PairMatches:
    """A pair of simultaneous images with those inliers that agree with the rig; with none where these are too few."""
    a, b = (drive.images[image].camera for image in (pair.image_a, pair.image_b))
    inliers = pair.inliers & rig.relative_pose(a, b).fits(*rays, max_error=max_error)
    enough = int(inliers.sum()) >= config.min_matches
    return replace(pair, inliers=inliers if enough else np.zeros_like(inliers))


def max_error_rad(drive: Drive, image_a: int, image_b: int, focal_px: Floats, config: MatchConfig) -> float:
    """Epipolar distance (rad) that matches of two images may have, by the camera with the coarser pixels."""
    return float(config.max_error_px / focal_px[[drive.images[i].camera for i in (image_a, image_b)]].min())


def calibration_sigmas(drive: Drive, settings: BundleAdjustmentConfig) -> tuple[Floats, Floats]:
    """Standard deviations (c,) of each axis of the given rotations (rad) and translations (m), or the usual ones."""
    return (
        np.radians([c.sigma_rotation_deg or settings.sigma_rotation_deg for c in drive.cameras]),
        np.array([c.sigma_translation_m or settings.sigma_translation_m for c in drive.cameras]),
    )


def _pooled(
    drive: Drive, pairs: Sequence[PairMatches], rays_of: Callable[[PairMatches], tuple[Floats, Floats]]
) -> list[SimultaneousMatches]:
    """All inliers of each pair of cameras together, at most `MAX_MATCHES` of each, evenly chosen before rays exist."""
    by_cameras: dict[tuple[int, int], list[PairMatches]] = {}
    for pair in pairs:
        a, b = (drive.images[image].camera for image in (pair.image_a, pair.image_b))
        by_cameras.setdefault((a, b), []).append(pair)
    result = []
    for (a, b), parts in sorted(by_cameras.items()):
        stops = np.cumsum([int(part.inliers.sum()) for part in parts])
        keep = even_choice(int(stops[-1]), MAX_MATCHES)
        rays: tuple[list[Floats], list[Floats]] = ([np.zeros((0, 3))], [np.zeros((0, 3))])
        for part, first, stop in zip(parts, [0, *stops[:-1]], stops, strict=True):
            rows = keep[slice(*np.searchsorted(keep, [first, stop]))] - first
            if len(rows):
                for kept, of_part in zip(rays, rays_of(part), strict=True):
                    kept.append(of_part[rows])
        rays_a, rays_b = map(np.concatenate, rays)
        units = sum(bool(part.inliers.any()) for part in parts)
        result.append(SimultaneousMatches(camera_a=a, camera_b=b, rays_a=rays_a, rays_b=rays_b, units=units))
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
    problem = _RigProblem(
        rig_from_cam=rig_from_cam,
        found=[one for one in found if len(one.rays_a)],
        sigma_rad=np.repeat(sigma_rotation_rad, 3),
        sigma_m=np.repeat(sigma_translation_m, 3),
        focal_px=focal_px,
    )
    for start in _starts(problem):
        correction = most_likely_correction(problem.errors, start, least_spread=problem.least_spread)
        demanded, posterior = _demanded(correction)
        refined = problem.turned(demanded)
        # Cameras may be so near one another that the way between them is as uncertain as it is long.
        is_turned = not np.array_equal(refined, rig_from_cam)
        moved = problem.moved(refined, correction.x[len(demanded) :]) if is_turned else refined
        if _stands(problem, refined, moved, max_error_px):
            break
    else:
        refined, moved, posterior = rig_from_cam, rig_from_cam, np.eye(3 * len(rig_from_cam))
    spread = posterior * problem.sigma_rad[:, None]
    return RigEstimate(
        rig_from_cam=refined,
        covariance=_of_poses(spread @ spread.T, sigma_translation_m**2),
        matches=sum(len(one.rays_a) for one in problem.found),
        fitted_as_given=problem.share_that_fits(rig_from_cam, max_error_px),
        fitted=problem.share_that_fits(moved, max_error_px),
        is_far=bool(problem.are_far(refined).any()),
    )


def largest_turn_rad(sigma_a_rad: float, sigma_b_rad: float) -> float:
    """Angle by which two cameras may be turned against one another to be a matter of calibration, by their sigmas."""
    return max(float(np.radians(LARGEST_TURN_DEG)), LARGEST_TURN_SIGMAS * float(np.hypot(sigma_a_rad, sigma_b_rad)))


def _starts(problem: _RigProblem) -> Iterator[Floats]:
    """Corrections to begin from: where matches lead with next to no prior, and none."""
    none = np.zeros(2 * len(problem.sigma_rad))
    steady = replace(problem, found=[one for one in problem.found if one.units >= MIN_UNITS])
    if steady.found:
        yield most_likely_correction(steady.errors, none, least_spread=steady.least_spread, prior=WEAK_PRIOR).x
    yield none


def _demanded(correction: Correction) -> tuple[Floats, Floats]:
    """The turns (3 c,) of a correction that are significant, and the root (3 c, 3 c) of the turns' covariance."""
    turns = slice(0, len(correction.x) // 2)
    covariance = np.linalg.inv(np.eye(len(correction.x)) + correction.information)[turns, turns]
    variance, directions = np.linalg.eigh(covariance)
    posterior = np.sqrt(np.maximum(variance, 0.0))
    along = directions.T @ correction.x[turns]
    demanded = np.abs(along) > SIGNIFICANT_SIGMAS * posterior
    return directions[:, demanded] @ along[demanded], directions * posterior


def _stands(problem: _RigProblem, refined: Floats, moved: Floats, max_error_px: float) -> bool:
    """Return whether refined poses (c, 4, 4) correct the given ones: more matches fit, and nowhere fewer.

    Matches are judged with the places that they demand, `moved` (c, 4, 4).
    """
    if not problem.found or np.array_equal(refined, problem.rig_from_cam):
        return True
    counts = np.array([len(one.rays_a) for one in problem.found])
    before, after = (problem.shares_that_fit(rig, max_error_px) for rig in (problem.rig_from_cam, moved))
    given, fitted = (counts @ shares / counts.sum() for shares in (before, after))
    if (after < before - np.maximum(GAIN, 1.0 / counts)).any():
        return False
    if fitted < WELL_FITTED and (fitted < CLEARLY_GIVEN or fitted < given + GAIN):
        return False
    turned = turned_between(problem.rig_from_cam, refined)
    for one, far, share in zip(problem.found, problem.are_far(refined), after, strict=True):
        a, b = one.camera_a, one.camera_b
        if far and (share < FITTED_FAR or turned[a, b] > largest_turn_rad(*problem.sigma_rad[[3 * a, 3 * b]])):
            return False
    return True


def turned_between(given: Floats, rig_from_cam: Floats) -> Floats:
    """Angles (c, c) in rad by which two cameras are turned against one another from where they were given."""
    turned = rig_from_cam[:, :3, :3] @ np.swapaxes(given[:, :3, :3], 1, 2)
    result: Floats = np.linalg.norm(se3.log_so3(np.swapaxes(turned, 1, 2)[:, None] @ turned[None]), axis=-1)
    return result


def _of_poses(covariance_rad2: Floats, variance_translation_m2: Floats) -> Floats:
    """Covariance (6 c, 6 c) of poses from that of rotations (3 c, 3 c), and each axis' variance of positions (c,)."""
    c = len(variance_translation_m2)
    result = np.zeros((c, 6, c, 6))
    result[:, :3, :, :3] = covariance_rad2.reshape(c, 3, c, 3)
    result[:, 3:, :, 3:] = np.einsum("a,ab,ij->aibj", variance_translation_m2, np.eye(c), np.eye(3))
    return result.reshape(6 * c, 6 * c)


@dataclass(frozen=True, kw_only=True)
class _RigProblem:
    """Corrections of the cameras' rotations x (3 c,) and of their places after them, in the prior's standard
    deviations, from matches of pairs.
    """

    rig_from_cam: Floats  # (c, 4, 4) given
    found: Sequence[SimultaneousMatches]
    sigma_rad: Floats  # (3 c,) prior
    sigma_m: Floats  # (3 c,) prior
    focal_px: Floats  # (c,)

    def turned(self, x: Floats) -> Floats:
        """Poses (c, 4, 4) with the rotations corrected by x (3 c,)."""
        turned = se3.exp_so3((x * self.sigma_rad).reshape(-1, 3)) @ self.rig_from_cam[:, :3, :3]
        return se3.transform(turned, self.rig_from_cam[:, :3, 3])

    def moved(self, rig_from_cam: Floats, x: Floats) -> Floats:
        """Poses (c, 4, 4) with the places corrected by x (3 c,)."""
        moved_m = rig_from_cam[:, :3, 3] + (x * self.sigma_m).reshape(-1, 3)
        return se3.transform(rig_from_cam[:, :3, :3], moved_m)

    def errors(self, x: Floats) -> list[Errors]:
        """Errors of each pair of cameras, with no more information than of `INDEPENDENT_MATCHES`."""
        turns, shifts = np.split(x, 2)
        rig, result = self.moved(self.turned(turns), shifts), []
        for one in self.found:
            a, b = one.camera_a, one.camera_b
            error, derivatives, _ = epipolar_derivatives(rig[a], rig[b], one.rays_a, one.rays_b)
            rows = np.concatenate([3 * a + np.arange(3), 3 * b + np.arange(3)])
            by_turns, by_place = derivatives[:, :6] * self.sigma_rad[rows], np.tile(derivatives[:, 6:], 2)
            by_place *= self.sigma_m[rows] * np.repeat([1.0, -1.0], 3)
            result.append(
                Errors(
                    rows=np.concatenate([rows, len(turns) + rows]),
                    error=error,
                    jacobian=np.concatenate([by_turns, by_place], axis=1),
                    weight=min(1.0, INDEPENDENT_MATCHES * min(1.0, one.units / MIN_UNITS) / len(error)),
                )
            )
        return result

    @property
    def least_spread(self) -> Floats:
        """Standard deviations (pairs,) in rad that errors have at least."""
        return MIN_SIGMA_PX * np.array([self.pixel_rad(one) for one in self.found])

    def are_far(self, rig_from_cam: Floats) -> Bools:
        """Pairs of cameras (pairs,) that are turned against one another by many sigmas."""
        turned = turned_between(self.rig_from_cam, rig_from_cam)
        sigma = self.sigma_rad[::3]
        return np.array(
            [
                turned[one.camera_a, one.camera_b] > FAR_SIGMAS * np.hypot(*sigma[[one.camera_a, one.camera_b]])
                for one in self.found
            ],
            dtype=np.bool_,
        )

    def shares_that_fit(self, rig_from_cam: Floats, max_error_px: float) -> Floats:
        """Shares (pairs,) of the matches of each pair of cameras that lie near their epipolar lines."""
        return np.array(
            [(_errors(rig_from_cam, one) < max_error_px * self.pixel_rad(one)).mean() for one in self.found]
        )

    def share_that_fits(self, rig_from_cam: Floats, max_error_px: float) -> float:
        """Share of all matches that lie near their epipolar lines."""
        counts = np.array([len(one.rays_a) for one in self.found])
        return float(counts @ self.shares_that_fit(rig_from_cam, max_error_px) / counts.sum()) if len(counts) else 0.0

    def pixel_rad(self, one: SimultaneousMatches) -> float:
        """Angle of a pixel of the coarser of two cameras."""
        return float(1.0 / self.focal_px[[one.camera_a, one.camera_b]].min())


def _errors(rig_from_cam: Floats, one: SimultaneousMatches) -> Floats:
    poses = rig_from_cam[one.camera_a], rig_from_cam[one.camera_b]
    result: Floats = np.abs(epipolar_derivatives(*poses, one.rays_a, one.rays_b)[0])
    return result
