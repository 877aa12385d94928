"""Simultaneous images that contradict the calibration by more than a correction explains: images of another time, or a
camera that is turned.

Both are usual mistakes of recordings: the files of a camera begin a frame late, or lack one from somewhere on, or an
image is turned by a right angle and its camera in the rig is not. Where cameras have a common view, their matches show
it, or that there are none although either camera matches its own images of other times. A drive of this kind is refused
with what was found: whatever is made of it hangs on a rig that the car does not have. What neither another time nor a
turn explains is a finding: as a lens that is given wrong, or images that are mirrored.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from threadpoolctl import threadpool_limits

from mrasfm_engine.config import BundleAdjustmentConfig, MatchConfig
from mrasfm_engine.errors import InputError
from mrasfm_engine.even_choice import nearest_even_choice
from mrasfm_engine.geometry.camera_model import pack_cameras, unproject_pixels
from mrasfm_engine.geometry.frustum import view_overlap
from mrasfm_engine.matching.calibration_check import (
    CLEARLY_BETTER,
    CLEARLY_WORSE,
    MIN_INLIERS,
    PAIR_ERROR_PX,
    share_explained,
)
from mrasfm_engine.matching.prepared_images import Matcher
from mrasfm_engine.matching.relisted_images import MIN_UNITS, RelistedImages
from mrasfm_engine.matching.simultaneous import (
    CLEARLY_GIVEN,
    are_simultaneous,
    calibration_sigmas,
    largest_turn_rad,
    max_error_rad,
)
from mrasfm_engine.matching.verification import essential_inliers
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures, PairMatches
from mrasfm_engine.types import Cancel, Floats, Ints
from schemas.findings import Finding, warning

SEARCHED_UNITS = 8
STEADY_TURN_DEG = 1.0
WIDE_VIEW = 0.5  # of both cameras' views that the other one has: such cameras' simultaneous images have matches


@dataclass(frozen=True, kw_only=True)
class _Comparison:
    """Units (n,) of two cameras, and the share (n,) of their matches that fits the rig as given or as corrected.

    Cameras with a wide view in common have most of their views in common, and matches are expected.
    """

    units: Ints
    shares: Floats
    wide_view: bool = False

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
        return self._at(nearest_even_choice(len(self.units), count))

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
        return replace(self, units=self.units[rows], shares=self.shares[rows])


def require_images_as_listed(
    drive: Drive,
    features: Sequence[ImageFeatures],
    pairs: Sequence[PairMatches],
    matcher: Matcher,
    config: MatchConfig,
    calibration: BundleAdjustmentConfig,
    *,
    max_depth_m: float,
    rig_from_cam: Floats | None = None,
    cancel: Cancel | None = None,
) -> Finding | None:
    """Refuse a drive one of whose cameras is late by whole frames, or turned by far more than it could be by chance.

    Cameras whose simultaneous images fit the calibration as given, or as corrected by all of them, cost next to
    nothing. Where they do not, all along or in units that follow one another, some of these units are matched anew,
    each image of one camera with those of the other from up to `MAX_LAG` frames before and after it, and from farther
    ones where most matches do not fit. A camera whose simultaneous images have no matches with any other's is matched
    with all of them in some units: it may be given so wrong that it seems to look elsewhere.

    Parameters
    ----------
    features
        Of all images of the drive.
    pairs
        Verified pairs of images.
    max_depth_m
        How far views count that cameras may have in common.
    rig_from_cam
        Poses (c, 4, 4) of the cameras as their simultaneous images correct them.

    Returns
    -------
    Finding | None
        Two cameras that contradict the calibration all along, which neither explains.

    Raises
    ------
    InputError
        Where a camera's images fit the calibration in other frames, or as those of a camera that is turned.
    """
    rigs = [drive.rig_from_cam, *([] if rig_from_cam is None else [rig_from_cam])]
    compared = _compared(drive, features, pairs, rigs, config, max_depth_m)
    contradicted = {cameras: run for cameras, found in compared.items() if (run := found.contradicting()) is not None}
    looked_at = {**_unlinked(drive, pairs), **contradicted}
    if not looked_at:
        return None
    sigma_rad, sigma_m = calibration_sigmas(drive, calibration)
    searches = {
        cameras: RelistedImages(
            drive,
            features,
            matcher,
            config,
            cameras=cameras,
            units=(some := run.evenly(SEARCHED_UNITS)).units,
            listed_share=some.share,
            sigma_translation_m=sigma_m[list(cameras)],
            cancel=cancel,
        )
        for cameras, run in looked_at.items()
    }
    with threadpool_limits(1, "blas"):
        turns_deg = {cameras: search.turn_deg() for cameras, search in searches.items()}
        # In a steady turn, a camera that is late looks like one that is turned, and by less than a calibration errs.
        lags = {
            cameras: lag
            for cameras in contradicted
            if turns_deg[cameras] < STEADY_TURN_DEG and (lag := searches[cameras].lag())
        }
        if lags:
            agree = _that_agree(compared, but=lags)
            spans = {cameras: _span(drive, compared[cameras], contradicted[cameras]) for cameras in lags}
            raise _late(drive, lags, agree, spans)
        for cameras in looked_at:
            # A turn of less is left to the calibration's own estimate, whose prior is some degrees.
            least_deg = np.degrees(largest_turn_rad(*sigma_rad[list(cameras)]))
            # Matches at the edges of two views, in a narrow part of either, may fit a turn as well as the rig as given.
            share = compared[cameras].share if cameras in compared else searches[cameras].share_as_given()
            if share < CLEARLY_WORSE and turns_deg[cameras] > least_deg:
                raise _turned(drive, cameras, turns_deg[cameras])
        shares = {
            cameras: compared[cameras].share
            for cameras in contradicted
            if compared[cameras].share < CLEARLY_GIVEN
            and not searches[cameras].places_explain
            and (compared[cameras].wide_view or searches[cameras].see_the_same())
        }
    return _unexplained(drive, shares, _that_agree(compared, but=shares)) if shares else None


def _that_agree(compared: dict[tuple[int, int], _Comparison], *, but: Container[tuple[int, int]]) -> set[int]:
    """Cameras that fit the calibration with another one, of all pairs but some."""
    fit = {cameras for cameras, found in compared.items() if found.share >= CLEARLY_BETTER and cameras not in but}
    return {camera for cameras in fit for camera in cameras}


def _unexplained(drive: Drive, shares: dict[tuple[int, int], float], agree: set[int]) -> Finding:
    """Finding on those of some pairs of cameras whose simultaneous images fit the calibration least, by their share;
    one that agrees with others is not the wrong one of two."""
    (a, b), share = min(shares.items(), key=lambda item: item[1])
    names = [camera.name for camera in drive.cameras]
    wrong = " and ".join(names[camera] for camera in sorted({a, b} - agree or {a, b}))
    matches = f"{share:.0%} of their matches" if share else "none of their matches"
    return warning(
        "calibration-unexplained",
        f"simultaneous images of cameras {names[a]} and {names[b]} contradict rig.cameras: {matches} fit, and "
        "neither another frame nor a correction of rotations explains the others; lengths of the scene may be wrong by "
        "far more than is stated",
        f"Check of {wrong} that params, width and height belong to the images as they are stored, that none are "
        "mirrored, and rig_from_cam. Nothing needs to be done where the two cannot see the same, as in light and in "
        "infrared.",
    )


def _unlinked(drive: Drive, pairs: Sequence[PairMatches]) -> dict[tuple[int, int], _Comparison]:
    """Pairs of cameras of which one has simultaneous matches with none, and the units that have images of both.

    As a rule it looks elsewhere. So does one that is turned away by its calibration, and its matches would show it.
    """
    linked = {
        drive.images[image].camera
        for pair in pairs
        if are_simultaneous(drive, pair.image_a, pair.image_b) and len(pair.matches) >= MIN_INLIERS
        for image in (pair.image_a, pair.image_b)
    }
    image = {(one.unit, one.camera): i for i, one in enumerate(drive.images)}
    result = {}
    for a, b in combinations(range(len(drive.cameras)), 2):
        if not linked >= {a, b}:
            both = (unit for unit, camera in image if camera == a and (unit, b) in image)
            units = np.array([u for u in both if are_simultaneous(drive, image[u, a], image[u, b])], dtype=np.int64)
            if len(units) >= MIN_UNITS:
                result[a, b] = _Comparison(units=units, shares=np.zeros(len(units)))
    return result


def _compared(
    drive: Drive,
    features: Sequence[ImageFeatures],
    pairs: Sequence[PairMatches],
    rigs: Sequence[Floats],
    config: MatchConfig,
    max_depth_m: float,
) -> dict[tuple[int, int], _Comparison]:
    """Shares of their matches by which pairs of cameras with a common view fit the rig that explains them best.

    Units whose images have no matches, although the cameras have most of their views in common and both images match
    others, fit none.
    """
    kinds, params = pack_cameras(drive.cameras)
    focal_px = params[:, :2].mean(1)
    by_cameras: dict[tuple[int, int], list[PairMatches]] = {}
    for pair in pairs:
        if are_simultaneous(drive, pair.image_a, pair.image_b) and len(pair.matches) >= MIN_INLIERS:
            cameras = drive.images[pair.image_a].camera, drive.images[pair.image_b].camera
            by_cameras.setdefault(cameras, []).append(pair)
    expected = _units_with_common_view(drive, pairs, max_depth_m)
    result = {}
    for a, b in sorted(by_cameras.keys() | expected.keys()):
        shares = dict.fromkeys(expected.get((a, b), ()), [0.0] * len(rigs))
        gate = PAIR_ERROR_PX / float(focal_px[[a, b]].min())
        for pair in by_cameras.get((a, b), ()):
            rays_a, rays_b = (
                unproject_pixels(int(kinds[camera]), params[camera], features[image].xy_px[rows])
                for camera, image, rows in zip((a, b), (pair.image_a, pair.image_b), pair.matches.T, strict=True)
            )
            kept = pair.inliers
            if kept.sum() < MIN_INLIERS:  # the calibration left none of them
                max_error = max_error_rad(drive, pair.image_a, pair.image_b, focal_px, config)
                kept = essential_inliers(rays_a, rays_b, max_error=max_error)
            if kept.sum() >= MIN_INLIERS:
                unit = drive.images[pair.image_a].unit
                shares[unit] = [share_explained(rig[a], rig[b], rays_a[kept], rays_b[kept], gate) for rig in rigs]
        if len(shares) >= MIN_UNITS:
            of_rig = np.array([shares[unit] for unit in sorted(shares)]).T
            best = int(np.argmax(np.median(of_rig, axis=1)))
            units = np.array(sorted(shares), dtype=np.int64)
            result[a, b] = _Comparison(units=units, shares=of_rig[best], wide_view=(a, b) in expected)
    return result


def _units_with_common_view(
    drive: Drive, pairs: Sequence[PairMatches], max_depth_m: float
) -> dict[tuple[int, int], list[int]]:
    """Units in which simultaneous images should have matches, by the cameras that have most of their views in common.

    Both images match others of their own cameras: neither is dark, covered or blurred.
    """
    cameras = np.arange(len(drive.cameras))
    kinds, params = pack_cameras(drive.cameras)
    both = np.stack(np.triu_indices(len(cameras), 1), 1)
    overlap = view_overlap(
        both,
        world_from_cam=drive.rig_from_cam,
        camera=cameras,
        kind=kinds,
        params=params,
        size_px=np.array([(camera.width, camera.height) for camera in drive.cameras]),
        max_depth_m=max_depth_m,
    )
    clear = {
        (drive.images[image].unit, drive.images[image].camera): image
        for pair in pairs
        if drive.images[pair.image_a].camera == drive.images[pair.image_b].camera and pair.inliers.sum() >= MIN_INLIERS
        for image in (pair.image_a, pair.image_b)
    }
    result: dict[tuple[int, int], list[int]] = {}
    for a, b in both[overlap >= WIDE_VIEW].tolist():
        units = [unit for unit, camera in clear if camera == a and (unit, b) in clear]
        result[a, b] = [unit for unit in units if are_simultaneous(drive, clear[unit, a], clear[unit, b])]
    return result


def _span(drive: Drive, compared: _Comparison, run: _Comparison) -> str:
    """Time of a run among all units that were compared, in words; nothing where it is all of it."""
    first_us, last_us = drive.timestamps_us[run.units[[0, -1]]]
    begins, ends = run.units[[0, -1]] != compared.units[[0, -1]]
    if begins:
        return f" from {first_us} us {f'to {last_us} us' if ends else 'on'}"
    return f" until {last_us} us" if ends else ""


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
