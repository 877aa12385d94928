"""Images of two cameras, matched in other frames than those that list them, or as those of cameras turned otherwise."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mrasfm_engine.config import MatchConfig
from mrasfm_engine.errors import CancelledError
from mrasfm_engine.even_choice import nearest_even_choice
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_cameras
from mrasfm_engine.geometry.neighbours import nearest
from mrasfm_engine.matching.calibration_check import (
    CLEARLY_BETTER,
    CLEARLY_WORSE,
    MIN_INLIERS,
    PAIR_ERROR_PX,
    share_explained,
)
from mrasfm_engine.matching.prepared_images import Matcher, PreparedImages
from mrasfm_engine.matching.simultaneous import max_error_rad
from mrasfm_engine.matching.verification import epipolar_errors, essential_inliers, relative_pose
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.types import Bools, Cancel, Floats, Ints

MIN_UNITS = 3  # that follow one another: fewer neither contradict the calibration nor part others that do
MAX_LAG = 5  # frames that images are late as a rule: all of these are looked at
# Images may be late by seconds as well, as where a recorder began later. Where most does not fit, every third frame
# is looked at in some units: images that are a frame apart or two show much the same.
FARTHEST_LAG, LAG_STEP, SCANNED_UNITS = 60, 3, 4
LEFT_SHARE = 0.33  # of the matches that contradict the calibration, at most so many still do in the right frames
BASELINE_SIGMAS = 3.0  # of the given places, by which the baseline of two cameras may point elsewhere than given
BASELINE_ROUNDS = 10  # of least squares with weights by residuals, of three unknowns
MAX_BASELINE_ERROR = 0.5  # sine of 30 deg: a baseline that is farther from the given one is that of other frames
# What is drawn into all images of a camera, as the time of day, is at one place in most of them.
DRAWN_PX, DRAWN_SHARE = 1.5, 0.5


@dataclass(frozen=True, kw_only=True)
class _Rays:
    """Rays (n, 3) of matches of two images, in each camera's axes, and their keypoints (n, 2)."""

    a: Floats
    b: Floats
    xy_a_px: Floats
    xy_b_px: Floats

    def at(self, rows: Bools) -> _Rays:
        """Some of them."""
        return _Rays(a=self.a[rows], b=self.b[rows], xy_a_px=self.xy_a_px[rows], xy_b_px=self.xy_b_px[rows])


class RelistedImages:
    """Matches of two cameras' images whatever frames list them.

    Parameters
    ----------
    features
        Of all images of the drive.
    cameras
        Indices of both.
    units
        Some units (n,) in which the images contradict the calibration.
    listed_share
        Share of the matches there that fits it.
    sigma_translation_m
        Standard deviations (2,) of each axis of both cameras' places.
    """

    def __init__(
        self,
        drive: Drive,
        features: Sequence[ImageFeatures],
        matcher: Matcher,
        config: MatchConfig,
        *,
        cameras: tuple[int, int],
        units: Ints,
        listed_share: float,
        sigma_translation_m: Floats,
        cancel: Cancel | None = None,
    ) -> None:
        self._drive, self._matcher, self._config, self._cancel = drive, matcher, config, cancel
        self._cameras, self._units, self._listed_share = cameras, units, listed_share
        rig_from_a, rig_from_b = drive.rig_from_cam[list(cameras)]
        self._given = se3.inverse(rig_from_b) @ rig_from_a  # b_from_a
        baseline_m = float(np.linalg.norm(self._given[:3, 3]))
        error_m = BASELINE_SIGMAS * float(np.linalg.norm(sigma_translation_m))
        self._baseline_error = min(error_m / max(baseline_m, 1e-9), MAX_BASELINE_ERROR)
        self._focal_px = pack_cameras(drive.cameras)[1][:, :2].mean(1)
        self._gate = PAIR_ERROR_PX / float(self._focal_px[list(cameras)].min())
        self._where = {(image.unit, image.camera): i for i, image in enumerate(drive.images)}
        near = [(a, b) for _, a, b in self._pairs(units, range(-MAX_LAG, MAX_LAG + 1))]
        self._images = PreparedImages(drive, features, matcher, np.array(near, dtype=np.int64), threads=1)
        self._keypoints = features

    def lag(self) -> int:
        """Frames by which the second camera's images come after those of the first that they fit; 0 for none.

        They have to fit well there, and far better than as they are listed. Where a camera comes to the place that
        another one had some frames before, their images have next to no parallax and fit any baseline. So matches as
        they are listed have to contradict each baseline that the places' uncertainty allows.
        """
        shares = self._shares(range(-MAX_LAG, MAX_LAG + 1))
        listed_share = shares.pop(0, self._listed_share)
        if listed_share >= CLEARLY_BETTER or self.places_explain:
            return 0
        lag = _best(shares, listed_share)
        if lag == 0 and listed_share < CLEARLY_WORSE and (far := self._scan()):
            lag = _best(self._shares(range(far - LAG_STEP, far + LAG_STEP + 1)), listed_share)
        return lag

    def turn_deg(self) -> float:
        """Angle by which images show two cameras turned against each other from where they are given; 0 for none."""
        rays = self._listed
        if len(rays) < MIN_UNITS:
            return 0.0
        _, a, b = self._pairs(self._units, (0,))[0]
        max_error = max_error_rad(self._drive, a, b, self._focal_px, self._config)
        b_from_a = _common_rotation([one.a for one in rays], [one.b for one in rays], max_error)
        if b_from_a is None:
            return 0.0
        return float(se3.rotation_angle_deg(self._given[:3, :3].T @ b_from_a))

    def share_as_given(self) -> float:
        """Median share of the matches of frames that list them that fits the calibration as given; 0 without any."""
        return float(np.median([self._near(rays).mean() for rays in self._listed])) if self._listed else 0.0

    @cached_property
    def places_explain(self) -> bool:
        """True where one baseline near the given one explains the matches of the frames that list them."""
        if not self._listed:
            return False
        given, shown = self._given, self._given.copy()
        a, b = (np.concatenate(rays) for rays in zip(*((one.a, one.b) for one in self._listed), strict=True))
        shown[:3, 3] = _common_baseline(given, a, b, self._gate)
        across_m, along_m = (float(np.linalg.norm(v)) for v in (np.cross(shown[:3, 3], given[:3, 3]), given[:3, 3]))
        shares = [share_explained(shown, np.eye(4), one.a, one.b, self._gate) for one in self._listed]
        return bool(across_m <= self._baseline_error * along_m and np.median(shares) >= CLEARLY_BETTER)

    def see_the_same(self) -> bool:
        """True where images of the frames that list them have matches besides those of what is drawn into them."""
        return len(self._listed) >= MIN_UNITS

    @cached_property
    def _listed(self) -> list[_Rays]:
        """Matches of images of the frames that list them, without what is drawn into them."""
        pairs = [(a, b) for _, a, b in self._pairs(self._units, (0,))]
        return _without_drawn([one for a, b in pairs if (one := self._verified(a, b)) is not None])

    def _pairs(self, units: Ints, lags: Iterable[int]) -> list[tuple[int, int, int]]:
        """Lag and images, by unit: an image is prepared once."""
        lags, (first, second) = tuple(lags), self._cameras
        return [
            (lag, self._where[u, first], self._where[u + lag, second])
            for u in units.tolist()
            for lag in lags
            if (u, first) in self._where and (u + lag, second) in self._where
        ]

    def _shares(self, lags: Iterable[int]) -> dict[int, float]:
        """Median share of the matches that fits the calibration, by lag.

        Epipolar lines alone tell: of far points, noise decides whether they are before the cameras.
        """
        found: dict[int, list[float]] = {}
        for lag, a, b in self._pairs(self._units, lags):
            rays = self._verified(a, b)
            if rays is not None:
                found.setdefault(lag, []).append(float(self._near(rays).mean()))
        return {lag: float(np.median(some)) for lag, some in found.items() if len(some) >= MIN_UNITS}

    def _scan(self) -> int:
        """The lag, by steps, at which most matches of some units fit the calibration; 0 where none do."""
        units = self._units[nearest_even_choice(len(self._units), SCANNED_UNITS)]
        beyond = range(MAX_LAG + 1, FARTHEST_LAG + 1, LAG_STEP)
        fit: dict[int, list[int]] = {}
        for lag, a, b in self._pairs(units, [*beyond, *(-lag for lag in beyond)]):
            rays = self._verified(a, b)
            fit.setdefault(lag, []).append(0 if rays is None else int(self._near(rays).sum()))
        mean = {lag: float(np.mean(some)) for lag, some in fit.items()}
        best = max(mean, key=lambda lag: (mean[lag], -abs(lag), lag), default=0)
        return best if mean.get(best) else 0

    def _near(self, rays: _Rays) -> Bools:
        """Matches (n,) that lie near their epipolar lines."""
        near: Bools = epipolar_errors(self._given, rays.a, rays.b) < self._gate
        return near

    def _verified(self, image_a: int, image_b: int) -> _Rays | None:
        """Rays of the matches that agree with an essential matrix; None where they are few."""
        if self._cancel is not None and self._cancel():
            raise CancelledError
        of_a, of_b = (self._images.prepared(image).for_matcher for image in (image_a, image_b))
        matches = self._matcher.match(of_a, of_b)
        parts = [
            (self._images.rays(image)[rows], self._keypoints[image].xy_px[rows])
            for image, rows in zip((image_a, image_b), matches.T, strict=True)
        ]
        found = _Rays(a=parts[0][0], b=parts[1][0], xy_a_px=parts[0][1], xy_b_px=parts[1][1])
        max_error = max_error_rad(self._drive, image_a, image_b, self._focal_px, self._config)
        good = essential_inliers(found.a, found.b, max_error=max_error)
        return found.at(good) if good.sum() >= MIN_INLIERS else None


def _best(shares: dict[int, float], listed_share: float) -> int:
    """The lag at which nearly all matches fit, and few of those that contradict the calibration; 0 for none."""
    best = max(shares, key=lambda lag: (shares[lag], -abs(lag), lag), default=0)
    left = 1.0 - shares.get(best, 0.0)
    return best if left <= min(1.0 - CLEARLY_BETTER, LEFT_SHARE * (1.0 - listed_share)) else 0


def _without_drawn(units: Sequence[_Rays]) -> list[_Rays]:
    """Units with enough matches besides those of what is at one place in most images of either camera.

    A vehicle that stands shows nothing else.
    """
    result = []
    for k, one in enumerate(units):
        moves = np.ones(len(one.a), dtype=np.bool_)
        for of, others in (
            (one.xy_a_px, [other.xy_a_px for j, other in enumerate(units) if j != k]),
            (one.xy_b_px, [other.xy_b_px for j, other in enumerate(units) if j != k]),
        ):
            there = [np.isfinite(nearest(other, of, within_m=DRAWN_PX)[0][:, 0]) for other in others]
            moves &= np.mean([np.zeros(len(of)), *there], axis=0) < DRAWN_SHARE
        if moves.sum() >= MIN_INLIERS:
            result.append(one.at(moves))
    return result


def _common_baseline(b_from_a: Floats, rays_a: Floats, rays_b: Floats, gate: float) -> Floats:
    """Direction (3,) of the baseline that most matches agree with under the given rotation.

    It is perpendicular to the normals of the planes that both rays of a match span. It begins at the given one, and is
    turned around where it would be opposite to it.
    """
    in_b = rays_a @ b_from_a[:3, :3].T
    normals = np.cross(in_b, rays_b)
    pose = b_from_a.copy()
    for _ in range(BASELINE_ROUNDS):
        sine = np.linalg.norm(np.cross(pose[:3, 3], in_b), axis=1) / max(float(np.linalg.norm(pose[:3, 3])), 1e-9)
        weights = 1.0 / np.maximum(sine, 1e-3) ** 2 / (1.0 + (epipolar_errors(pose, rays_a, rays_b) / gate) ** 2)
        pose[:3, 3] = np.linalg.eigh((normals * weights[:, None]).T @ normals)[1][:, 0]
    result: Floats = pose[:3, 3] * (1.0 if pose[:3, 3] @ b_from_a[:3, 3] >= 0 else -1.0)
    return result


def _common_rotation(rays_a: Sequence[Floats], rays_b: Sequence[Floats], max_error: float) -> Floats | None:
    """The rotation b_from_a (3, 3) of one essential matrix that nearly all matches of all units agree with."""
    a, b = np.concatenate(rays_a), np.concatenate(rays_b)
    good = essential_inliers(a, b, max_error=max_error)
    # The matches of each unit have a matrix that they agree with; one of all shows that the cameras are fixed.
    pose = relative_pose(a[good], b[good], max_error=max_error) if good.mean() >= CLEARLY_BETTER else None
    if pose is None:
        return None
    # Of cameras close to one another, noise decides whether points are before both: the other rotation of the essential
    # matrix, half a turn about the baseline away, may win. Rays of one point differ by its parallax alone.
    rotation, baseline = pose
    twisted = (2.0 * np.outer(baseline, baseline) - np.eye(3)) @ rotation
    along = [float(np.median((a[good] @ one.T * b[good]).sum(1))) for one in (rotation, twisted)]
    return rotation if along[0] >= along[1] else twisted
