"""Simultaneous images that contradict the calibration by more than a correction explains: images of another time, or a
camera that is turned.

Both are usual mistakes of recordings: the files of a camera begin a frame late, or an image is turned by a right angle
and its camera in the rig is not. Where cameras have a common view, their matches show it. A drive of this kind is
refused with what was found: whatever is made of it hangs on a rig that the car does not have.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from threadpoolctl import threadpool_limits

from mrasfm_engine.config import BundleAdjustmentConfig, MatchConfig
from mrasfm_engine.errors import CancelledError, InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_cameras, unproject_pixels
from mrasfm_engine.geometry.neighbours import nearest
from mrasfm_engine.matching.calibration_check import (
    CLEARLY_BETTER,
    CLEARLY_WORSE,
    MIN_INLIERS,
    PAIR_ERROR_PX,
    share_explained,
)
from mrasfm_engine.matching.prepared_images import Matcher
from mrasfm_engine.matching.simultaneous import are_simultaneous, calibration_sigmas
from mrasfm_engine.matching.verification import essential_inliers
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures, PairMatches
from mrasfm_engine.types import Bools, Cancel, Floats, Ints

MIN_UNITS = 3  # in which two cameras contradict the calibration
SAMPLED_UNITS = 8
MAX_LAG = 5  # frames that images may be late
LEFT_SHARE = 0.33  # of the matches that contradict the calibration, at most so many still do in the right frames
STEADY_TURN_DEG = 1.0
# A turn of less is left to the calibration's own estimate, whose prior is some degrees.
MIN_TURN_DEG, TURN_SIGMAS = 20.0, 5.0
# What is drawn into all images of a camera, as the time of day, is at one place in most of them.
DRAWN_PX, DRAWN_SHARE = 1.5, 0.5


@dataclass(frozen=True, kw_only=True)
class _Comparison:
    """Some units of two cameras, and the share of their matches that fits the calibration in most of these."""

    units: list[int]
    share: float


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


def require_images_as_listed(
    drive: Drive,
    features: Sequence[ImageFeatures],
    pairs: Sequence[PairMatches],
    matcher: Matcher,
    config: MatchConfig,
    calibration: BundleAdjustmentConfig,
    *,
    rig_from_cam: Floats | None = None,
    cancel: Cancel | None = None,
) -> None:
    """Refuse a drive one of whose cameras is late by whole frames, or turned by far more than it could be by chance.

    Cameras whose simultaneous images mostly fit the calibration as given, or as corrected by all of them, cost next to
    nothing. Of others some units are matched anew, each image of one camera with those of the other that were taken up
    to `MAX_LAG` frames before and after it.

    Parameters
    ----------
    features
        Of all images of the drive.
    pairs
        Verified pairs of images.
    rig_from_cam
        Poses (c, 4, 4) of the cameras as their simultaneous images correct them.

    Raises
    ------
    InputError
        Where a camera's images fit the calibration in other frames, or as those of a camera that is turned.
    """
    rigs = [drive.rig_from_cam, *([] if rig_from_cam is None else [rig_from_cam])]
    compared = _compared(drive, features, pairs, rigs, config)
    contradicted = {cameras: found for cameras, found in compared.items() if found.share < CLEARLY_BETTER}
    if not contradicted:
        return
    search = _Search(drive=drive, features=features, matcher=matcher, config=config, cancel=cancel)
    with threadpool_limits(1, "blas"):
        turns_deg = {cameras: search.turn_deg(cameras, found.units) for cameras, found in contradicted.items()}
        # In a steady turn, a camera that is late looks like one that is turned, and by less than a calibration errs.
        lags = {
            cameras: lag
            for cameras, found in contradicted.items()
            if turns_deg[cameras] < STEADY_TURN_DEG and (lag := search.lag(cameras, found))
        }
        if lags:
            agree = {camera for cameras in compared.keys() - contradicted.keys() for camera in cameras}
            raise _late(drive, lags, agree)
        sigma_deg = np.degrees(calibration_sigmas(drive, calibration)[0])
        for cameras, found in contradicted.items():
            least_deg = max(MIN_TURN_DEG, TURN_SIGMAS * float(np.hypot(*sigma_deg[list(cameras)])))
            if found.share < CLEARLY_WORSE and turns_deg[cameras] > least_deg:
                raise _turned(drive, cameras, turns_deg[cameras])


def _compared(
    drive: Drive,
    features: Sequence[ImageFeatures],
    pairs: Sequence[PairMatches],
    rigs: Sequence[Floats],
    config: MatchConfig,
) -> dict[tuple[int, int], _Comparison]:
    """Shares of their matches by which pairs of cameras with a common view fit the rig that explains them best."""
    kinds, params = pack_cameras(drive.cameras)
    by_cameras: dict[tuple[int, int], list[PairMatches]] = {}
    for pair in pairs:
        if are_simultaneous(drive, pair.image_a, pair.image_b) and len(pair.matches) >= MIN_INLIERS:
            cameras = drive.images[pair.image_a].camera, drive.images[pair.image_b].camera
            by_cameras.setdefault(cameras, []).append(pair)
    result = {}
    for (a, b), found in sorted(by_cameras.items()):
        focal_px, shares, units = float(params[[a, b], 0].min()), [], []
        for pair in _evenly(found):
            rays_a, rays_b = (
                unproject_pixels(int(kinds[camera]), params[camera], features[image].xy_px[rows])
                for camera, image, rows in zip((a, b), (pair.image_a, pair.image_b), pair.matches.T, strict=True)
            )
            kept = pair.inliers
            if kept.sum() < MIN_INLIERS:  # the calibration left none of them
                kept = essential_inliers(rays_a, rays_b, max_error=config.max_error_px / focal_px)
            if kept.sum() >= MIN_INLIERS:
                gate = PAIR_ERROR_PX / focal_px
                shares.append([share_explained(rig[a], rig[b], rays_a[kept], rays_b[kept], gate) for rig in rigs])
                units.append(drive.images[pair.image_a].unit)
        if len(shares) >= MIN_UNITS:
            result[a, b] = _Comparison(units=units, share=float(np.median(shares, axis=0).max()))
    return result


def _evenly(found: Sequence[PairMatches]) -> list[PairMatches]:
    chosen = np.linspace(0, len(found) - 1, min(SAMPLED_UNITS, len(found))).round().astype(int)
    return [found[k] for k in chosen]


@dataclass(kw_only=True)
class _Search:
    """Matches of images that are listed in different frames, or as those of differently turned cameras."""

    drive: Drive
    features: Sequence[ImageFeatures]
    matcher: Matcher
    config: MatchConfig
    cancel: Cancel | None

    def lag(self, cameras: tuple[int, int], listed: _Comparison) -> int:
        """Frames by which the second camera's images come after those of the first that they fit; 0 for none.

        They have to fit well there, and far better than as they are `listed`.
        """
        a, b = cameras
        where = {(image.unit, image.camera): i for i, image in enumerate(self.drive.images)}
        shares = {}
        for lag in (lag for size in range(1, MAX_LAG + 1) for lag in (size, -size)):
            found = [
                share_explained(
                    self.drive.rig_from_cam[a], self.drive.rig_from_cam[b], rays.a, rays.b, self._gate(cameras)
                )
                for u in listed.units
                if (u, a) in where
                and (u + lag, b) in where
                and (rays := self._verified(where[u, a], where[u + lag, b])) is not None
            ]
            if len(found) >= MIN_UNITS:
                shares[lag] = float(np.median(found))
        best = max(shares, key=lambda lag: shares[lag], default=0)
        if not best or shares[best] < CLEARLY_BETTER or 1.0 - shares[best] > LEFT_SHARE * (1.0 - listed.share):
            return 0
        return best

    def turn_deg(self, cameras: tuple[int, int], units: Sequence[int]) -> float:
        """Angle by which images show two cameras turned against each other from where they are given; 0 for none."""
        a, b = cameras
        where = {(image.unit, image.camera): i for i, image in enumerate(self.drive.images)}
        found = [self._verified(where[u, a], where[u, b]) for u in units]
        rays = _without_drawn([one for one in found if one is not None])
        if len(rays) < MIN_UNITS:
            return 0.0
        max_error = self.config.max_error_px / float(self._lenses[1][list(cameras), 0].min())
        b_from_a = _common_rotation([one.a for one in rays], [one.b for one in rays], max_error)
        if b_from_a is None:
            return 0.0
        given = self.drive.rig_from_cam[b, :3, :3].T @ self.drive.rig_from_cam[a, :3, :3]
        return float(se3.rotation_angle_deg(given.T @ b_from_a))

    def _gate(self, cameras: tuple[int, int]) -> float:
        return PAIR_ERROR_PX / float(self._lenses[1][list(cameras), 0].min())

    @cached_property
    def _lenses(self) -> tuple[Ints, Floats]:
        return pack_cameras(self.drive.cameras)

    @cached_property
    def _prepared(self) -> dict[int, Any]:
        return {}

    def _for_matcher(self, image: int) -> Any:
        """The image prepared for the matcher, once: some units of a few cameras."""
        if image not in self._prepared:
            lens = self.drive.cameras[self.drive.images[image].camera]
            prepared = self.matcher.prepare(self.features[image], width=lens.width, height=lens.height)
            self._prepared[image] = prepared
        return self._prepared[image]

    def _verified(self, image_a: int, image_b: int) -> _Rays | None:
        """Rays of the matches that agree with an essential matrix; None where they are few."""
        if self.cancel is not None and self.cancel():
            raise CancelledError
        kinds, params = self._lenses
        cameras = [self.drive.images[image].camera for image in (image_a, image_b)]
        matches = self.matcher.match(self._for_matcher(image_a), self._for_matcher(image_b))
        xy = [self.features[image].xy_px[rows] for image, rows in zip((image_a, image_b), matches.T, strict=True)]
        rays = [unproject_pixels(int(kinds[c]), params[c], of_image) for c, of_image in zip(cameras, xy, strict=True)]
        max_error = self.config.max_error_px / float(params[cameras, 0].min())
        good = essential_inliers(rays[0], rays[1], max_error=max_error)
        found = _Rays(a=rays[0], b=rays[1], xy_a_px=xy[0], xy_b_px=xy[1]).at(good)
        return found if len(found.a) >= MIN_INLIERS else None


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


def _common_rotation(rays_a: Sequence[Floats], rays_b: Sequence[Floats], max_error: float) -> Floats | None:
    """The rotation b_from_a (3, 3) of one essential matrix that nearly all matches of all units agree with."""
    a, b = np.concatenate(rays_a), np.concatenate(rays_b)
    good = essential_inliers(a, b, max_error=max_error)
    # The matches of each unit have a matrix that they agree with; one of all shows that the cameras are fixed.
    if good.mean() < CLEARLY_BETTER:
        return None
    ahead = good & (a[:, 2] > 0.1) & (b[:, 2] > 0.1)
    plane_a, plane_b = a[ahead, :2] / a[ahead, 2:], b[ahead, :2] / b[ahead, 2:]
    if len(plane_a) < MIN_INLIERS:
        return None
    essential, mask = cv2.findEssentialMat(plane_a, plane_b, np.eye(3), cv2.USAC_ACCURATE, 0.9999, max_error)
    if essential is None or essential.shape != (3, 3):
        return None
    _, rotation, _, _ = cv2.recoverPose(essential, plane_a, plane_b, np.eye(3), mask=mask)
    return np.asarray(rotation, dtype=np.float64)


def _late(drive: Drive, lags: dict[tuple[int, int], int], agree: set[int]) -> InputError:
    """The error, with those cameras that may be late: the ones that agree with none."""
    names = [camera.name for camera in drive.cameras]
    late = sorted({camera for cameras in lags for camera in cameras} - agree)
    if len(lags) > 1 and not agree:
        counts = Counter(camera for cameras in lags for camera in cameras)
        late = sorted(camera for camera in late if counts[camera] == max(counts.values()))
    late = late or sorted({camera for cameras in lags for camera in cameras})
    (a, b), lag = next(((pair, lag) for pair, lag in lags.items() if set(pair) & set(late)), next(iter(lags.items())))
    frames = "1 frame" if abs(lag) == 1 else f"{abs(lag)} frames"
    when = "before" if lag > 0 else "after"
    return InputError(
        f"frames: images of {names[b]} fit rig.cameras with those of {names[a]} that are listed {frames} {when} them, "
        "and not with those of their own frame",
        remedy=f"Move the images of {' or '.join(names[camera] for camera in late)} by {frames}, so that every frame "
        "has images of one time. If they are of one time, check rig_from_cam of these cameras.",
        code="camera-late",
    )


def _turned(drive: Drive, cameras: tuple[int, int], turn_deg: float) -> InputError:
    a, b = (drive.cameras[camera].name for camera in cameras)
    return InputError(
        f"rig.cameras: images show cameras {a} and {b} turned by {turn_deg:.0f} deg against each other from where "
        "rig_from_cam says",
        remedy="Correct the rotation of the one that is wrong, or turn its images; camera axes are x right, y down, z "
        "forward in the image as it is stored.",
        code="camera-turned",
    )
