"""Simultaneous images that contradict the calibration by more than a correction explains: images of another time, or a
camera that is turned.

Both are usual mistakes of recordings: the files of a camera begin a frame late, or lack one from somewhere on, or an
image is turned by a right angle and its camera in the rig is not. Where cameras have a common view, their matches show
it. A drive of this kind is refused with what was found: whatever is made of it hangs on a rig that the car does not
have.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

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
from mrasfm_engine.matching.prepared_images import Matcher, PreparedImages
from mrasfm_engine.matching.simultaneous import (
    are_simultaneous,
    calibration_sigmas,
    largest_turn_rad,
    max_error_rad,
)
from mrasfm_engine.matching.verification import epipolar_errors, essential_inliers, relative_pose
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures, PairMatches
from mrasfm_engine.types import Bools, Cancel, Floats, Ints

MIN_UNITS = 3  # that follow one another: fewer neither contradict the calibration nor part others that do
SEARCHED_UNITS = 8
MAX_LAG = 5  # frames that images may be late
LEFT_SHARE = 0.33  # of the matches that contradict the calibration, at most so many still do in the right frames
STEADY_TURN_DEG = 1.0
# What is drawn into all images of a camera, as the time of day, is at one place in most of them.
DRAWN_PX, DRAWN_SHARE = 1.5, 0.5


@dataclass(frozen=True, kw_only=True)
class _Comparison:
    """Units (n,) of two cameras, and the share (n,) of their matches that fits the rig as given or as corrected."""

    units: Ints
    shares: Floats

    @property
    def share(self) -> float:
        """Median share."""
        return float(np.median(self.shares))

    def contradicting(self) -> _Comparison | None:
        """Units that contradict the rig: the longest run with some that do so clearly, else all if most do."""
        run = self._run()
        if run is not None:
            return run
        return self if self.share < CLEARLY_BETTER else None

    def evenly(self, count: int) -> _Comparison:
        """Units all along, not more than `count`."""
        return self._at(np.linspace(0, len(self.units) - 1, min(count, len(self.units))).round().astype(np.int64))

    def _run(self) -> _Comparison | None:
        """The longest run of units below `CLEARLY_BETTER`, of which `MIN_UNITS` are below `CLEARLY_WORSE`.

        Fewer than `MIN_UNITS` that agree, as in a stop, neither part a run nor bound it.
        """
        low, count = np.flatnonzero(self.shares < CLEARLY_BETTER), len(self.units)
        parts = np.split(low, np.flatnonzero(np.diff(low) > MIN_UNITS) + 1)
        parts = [part for part in parts if (self.shares[part] < CLEARLY_WORSE).sum() >= MIN_UNITS]
        if not parts:
            return None
        longest = max(parts, key=lambda part: int(part[-1] - part[0]))
        first, end = int(longest[0]), int(longest[-1]) + 1
        return self._at(np.arange(first if first >= MIN_UNITS else 0, end if count - end >= MIN_UNITS else count))

    def _at(self, rows: Ints) -> _Comparison:
        return _Comparison(units=self.units[rows], shares=self.shares[rows])


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

    Cameras whose simultaneous images fit the calibration as given, or as corrected by all of them, cost next to
    nothing. Where they do not, all along or in units that follow one another, some of these units are matched anew,
    each image of one camera with those of the other that were taken up to `MAX_LAG` frames before and after it.

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
    contradicted = {cameras: run for cameras, found in compared.items() if (run := found.contradicting()) is not None}
    if not contradicted:
        return
    searches = {
        cameras: _Search(drive, features, matcher, config, cameras, run.evenly(SEARCHED_UNITS), cancel)
        for cameras, run in contradicted.items()
    }
    with threadpool_limits(1, "blas"):
        turns_deg = {cameras: search.turn_deg() for cameras, search in searches.items()}
        # In a steady turn, a camera that is late looks like one that is turned, and by less than a calibration errs.
        lags = {
            cameras: lag
            for cameras, search in searches.items()
            if turns_deg[cameras] < STEADY_TURN_DEG and (lag := search.lag())
        }
        if lags:
            fit = {cameras for cameras, found in compared.items() if found.share >= CLEARLY_BETTER}
            agree = {camera for cameras in fit - lags.keys() for camera in cameras}
            spans = {cameras: _span(drive, compared[cameras], contradicted[cameras]) for cameras in lags}
            raise _late(drive, lags, agree, spans)
        sigma_rad = calibration_sigmas(drive, calibration)[0]
        for cameras in contradicted:
            # A turn of less is left to the calibration's own estimate, whose prior is some degrees.
            least_deg = np.degrees(largest_turn_rad(*sigma_rad[list(cameras)]))
            if compared[cameras].share < CLEARLY_WORSE and turns_deg[cameras] > least_deg:
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
    focal_px = params[:, :2].mean(1)
    by_cameras: dict[tuple[int, int], list[PairMatches]] = {}
    for pair in pairs:
        if are_simultaneous(drive, pair.image_a, pair.image_b) and len(pair.matches) >= MIN_INLIERS:
            cameras = drive.images[pair.image_a].camera, drive.images[pair.image_b].camera
            by_cameras.setdefault(cameras, []).append(pair)
    result = {}
    for (a, b), found in sorted(by_cameras.items()):
        shares, units, gate = [], [], PAIR_ERROR_PX / float(focal_px[[a, b]].min())
        for pair in sorted(found, key=lambda pair: drive.images[pair.image_a].unit):
            rays_a, rays_b = (
                unproject_pixels(int(kinds[camera]), params[camera], features[image].xy_px[rows])
                for camera, image, rows in zip((a, b), (pair.image_a, pair.image_b), pair.matches.T, strict=True)
            )
            kept = pair.inliers
            if kept.sum() < MIN_INLIERS:  # the calibration left none of them
                max_error = max_error_rad(drive, pair.image_a, pair.image_b, focal_px, config)
                kept = essential_inliers(rays_a, rays_b, max_error=max_error)
            if kept.sum() >= MIN_INLIERS:
                shares.append([share_explained(rig[a], rig[b], rays_a[kept], rays_b[kept], gate) for rig in rigs])
                units.append(drive.images[pair.image_a].unit)
        if len(shares) >= MIN_UNITS:
            of_rig = np.array(shares).T
            best = int(np.argmax(np.median(of_rig, axis=1)))
            result[a, b] = _Comparison(units=np.array(units, dtype=np.int64), shares=of_rig[best])
    return result


def _span(drive: Drive, compared: _Comparison, run: _Comparison) -> str:
    """Time of a run among all units that were compared, in words; nothing where it is all of it."""
    first_us, last_us = drive.timestamps_us[run.units[[0, -1]]]
    begins, ends = run.units[[0, -1]] != compared.units[[0, -1]]
    if begins:
        return f" from {first_us} us {f'to {last_us} us' if ends else 'on'}"
    return f" until {last_us} us" if ends else ""


class _Search:
    """Matches of two cameras' images that are listed in different frames, or as those of differently turned cameras."""

    def __init__(
        self,
        drive: Drive,
        features: Sequence[ImageFeatures],
        matcher: Matcher,
        config: MatchConfig,
        cameras: tuple[int, int],
        listed: _Comparison,
        cancel: Cancel | None,
    ) -> None:
        self._drive, self._matcher, self._config, self._cancel = drive, matcher, config, cancel
        self._rig = drive.rig_from_cam[list(cameras)]
        self._focal_px = pack_cameras(drive.cameras)[1][:, :2].mean(1)
        self._gate = PAIR_ERROR_PX / float(self._focal_px[list(cameras)].min())
        self._listed = listed
        where = {(image.unit, image.camera): i for i, image in enumerate(drive.images)}
        # By unit: an image is prepared once.
        self._pairs = [
            (lag, where[u, cameras[0]], where[u + lag, cameras[1]])
            for u in listed.units.tolist()
            for lag in range(-MAX_LAG, MAX_LAG + 1)
            if (u, cameras[0]) in where and (u + lag, cameras[1]) in where
        ]
        pairs = np.array([(a, b) for _, a, b in self._pairs], dtype=np.int64)
        self._images = PreparedImages(drive, features, matcher, pairs, threads=1)
        self._keypoints = features

    def lag(self) -> int:
        """Frames by which the second camera's images come after those of the first that they fit; 0 for none.

        They have to fit well there, and far better than as they are listed. Epipolar lines alone tell: of far points,
        noise decides whether they are before the cameras.
        """
        found: dict[int, list[float]] = {}
        b_from_a = se3.inverse(self._rig[1]) @ self._rig[0]
        for lag, a, b in self._pairs:
            rays = self._verified(a, b)
            if rays is not None:
                near = epipolar_errors(b_from_a, rays.a, rays.b) < self._gate
                found.setdefault(lag, []).append(float(near.mean()))
        shares = {lag: float(np.median(some)) for lag, some in found.items() if len(some) >= MIN_UNITS}
        listed = shares.pop(0, self._listed.share)
        if listed >= CLEARLY_BETTER:
            return 0
        best = max(shares, key=lambda lag: (shares[lag], -abs(lag), lag), default=0)
        left = 1.0 - shares.get(best, 0.0)
        return best if left <= min(1.0 - CLEARLY_BETTER, LEFT_SHARE * (1.0 - listed)) else 0

    def turn_deg(self) -> float:
        """Angle by which images show two cameras turned against each other from where they are given; 0 for none."""
        pairs = [(a, b) for lag, a, b in self._pairs if lag == 0]
        rays = _without_drawn([one for a, b in pairs if (one := self._verified(a, b)) is not None])
        if len(rays) < MIN_UNITS:
            return 0.0
        max_error = max_error_rad(self._drive, pairs[0][0], pairs[0][1], self._focal_px, self._config)
        b_from_a = _common_rotation([one.a for one in rays], [one.b for one in rays], max_error)
        if b_from_a is None:
            return 0.0
        given = self._rig[1, :3, :3].T @ self._rig[0, :3, :3]
        return float(se3.rotation_angle_deg(given.T @ b_from_a))

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
    pose = relative_pose(a[good], b[good], max_error=max_error) if good.mean() >= CLEARLY_BETTER else None
    return None if pose is None else pose[0]


def _late(
    drive: Drive, lags: dict[tuple[int, int], int], agree: set[int], spans: dict[tuple[int, int], str]
) -> InputError:
    """The error, with those cameras that may be late: the ones that agree with none."""
    names = [camera.name for camera in drive.cameras]
    late = sorted({camera for cameras in lags for camera in cameras} - agree)
    if len(lags) > 1 and not agree:
        counts = Counter(camera for cameras in lags for camera in cameras)
        late = sorted(camera for camera in late if counts[camera] == max(counts.values()))
    late = late or sorted({camera for cameras in lags for camera in cameras})
    (a, b), lag = next(((pair, lag) for pair, lag in lags.items() if set(pair) & set(late)), next(iter(lags.items())))
    span = spans[a, b]
    frames = "1 frame" if abs(lag) == 1 else f"{abs(lag)} frames"
    when = "before" if lag > 0 else "after"
    return InputError(
        f"frames: images of {names[b]} fit rig.cameras with those of {names[a]} that are listed {frames} {when} them"
        f"{span}, and not with those of their own frame",
        remedy=f"Move the images of {' or '.join(names[camera] for camera in late)} by {frames}{span}, so that every "
        "frame has images of one time. If they are of one time, check rig_from_cam of these cameras.",
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
