"""Motion of the vehicle from its images alone, as far as the selection of pairs needs it.

Each image is matched with the two that follow it first. The parallax of these matches says how far the vehicle went,
against the depth of what it sees; the matches that the second loses against the first say how far away images still
overlap. So windows count motion, at any frame rate and speed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from mrasfm_engine.geometry.camera_model import pack_cameras
from mrasfm_engine.geometry.frustum import DEPTH_FRACTIONS, frustum_samples
from mrasfm_engine.matching.verification import parallax_rad
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import PairMatches
from mrasfm_engine.types import Bools, Floats, Ints

NEXT_UNITS = 2  # units that each is paired with however little they move: one blurred image does not cut the drive
# Steps closer than this give depth to nothing: a point at the end of the view, beside the path, needs so much parallax.
MIN_PARALLAX_RAD = np.radians(1.0)
NOISE_PX = 0.8  # median distance that two keypoints, each off by 0.5 px in a coordinate, have for nothing
STEPS_M = np.geomspace(0.01, 30.0, 40)
SMOOTHED_UNITS = 5  # by which the counts of matches are averaged: of a single pair they scatter by a tenth


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Motion from unit to unit.

    Attributes
    ----------
    travelled_m
        (units,) Length of the path up to each unit; from images alone it is as exact as the scene's depth is usual.
    lost_per_m
        (cameras, units) Decay of the number of an image's matches with the distance to the other image; zero where
        unknown.
    matches
        (cameras, units) Matches of an image with the next one; infinite where unknown.
    """

    travelled_m: Floats
    lost_per_m: Floats
    matches: Floats

    @staticmethod
    def from_travelled(drive: Drive, travelled_m: Floats) -> Motion:
        """Motion of which the distances (units,) are known, and nothing of the views."""
        shape = (len(drive.cameras), len(travelled_m))
        return Motion(travelled_m=travelled_m, lost_per_m=np.zeros(shape), matches=np.full(shape, np.inf))

    def expected_matches(self, camera: int, unit: int, other: int) -> float:
        """Matches that an image of `unit` has with the one of `other`, a later unit."""
        beyond_m = self.travelled_m[other] - self.travelled_m[unit + 1]
        return float(self.matches[camera, unit] * np.exp(-self.lost_per_m[camera, unit] * max(beyond_m, 0.0)))


def following_units(travelled_m: Floats, *, spacing_m: float, count: int, usable: Bools | None = None) -> list[Ints]:
    """The units after each one that it is paired with: the next, and others at least `spacing_m` apart.

    `travelled_m` (units,) never gets less. Units that are not `usable` (units,) are passed over, as if they had never
    been recorded: a few dark or grey ones do not cut the drive.
    """
    spacing_m *= 1.0 - 1e-6  # equal steps are rounded
    candidates = np.arange(len(travelled_m)) if usable is None else np.flatnonzero(usable)
    way_m, result = travelled_m[candidates], []
    for unit in range(len(travelled_m)):
        first = int(np.searchsorted(candidates, unit, side="right"))
        chosen = list(range(first, min(first + min(NEXT_UNITS, count), len(candidates))))
        while chosen and len(chosen) < count:
            ahead = int(np.searchsorted(way_m, way_m[chosen[-1]] + spacing_m))
            if ahead == len(candidates):
                break
            chosen.append(ahead)
        result.append(candidates[chosen])
    return result


def are_following(following: Sequence[Ints], unit_a: Ints, unit_b: Ints) -> Bools:
    """Mask (n,) of pairs of units that are one and the same, or of which one follows the other."""
    count = len(following)
    codes = np.array([u * count + v for u, ahead in enumerate(following) for v in ahead], dtype=np.int64)
    low, high = np.minimum(unit_a, unit_b), np.maximum(unit_a, unit_b)
    result: Bools = (low == high) | np.isin(low * count + high, codes)
    return result


def next_in_time(drive: Drive, usable: Bools | None = None) -> Ints:
    """Pairs (n, 2) of each image with those that come next of its camera, among usable images (i,), by default all."""
    camera = np.array([image.camera for image in drive.images], dtype=np.int64)
    pairs = [np.zeros((0, 2), dtype=np.int64)]
    for one in range(len(drive.cameras)):
        images = np.flatnonzero((camera == one) & (True if usable is None else usable))
        pairs += [np.stack([images[:-gap], images[gap:]], 1) for gap in range(1, NEXT_UNITS + 1)]
    return np.concatenate(pairs).astype(np.int64)


def motion_from_images(
    drive: Drive,
    pairs: Sequence[PairMatches],
    rays_of: Callable[[PairMatches], tuple[Floats, Floats]],
    *,
    max_depth_m: float,
) -> Motion:
    """Motion from matched pairs of `next_in_time`; `rays_of` gives the viewing rays (n, 3) of a pair's inliers."""
    units, cameras = len(drive.timestamps_us), len(drive.cameras)
    parallaxes = [_parallaxes(drive, camera, max_depth_m) for camera in range(cameras)]
    pixel_rad = 1.0 / pack_cameras(drive.cameras)[1][:, :2].mean(1)
    steps_m = np.full((cameras, max(units - 1, 0)), np.nan)
    counts = np.full((NEXT_UNITS, cameras, units), np.nan)
    for pair in pairs:
        a, b = drive.images[pair.image_a], drive.images[pair.image_b]
        gap = b.unit - a.unit
        if not 1 <= gap <= NEXT_UNITS:
            continue
        counts[gap - 1, a.camera, a.unit] = pair.inliers.sum()
        if gap == 1:
            moved = parallax_rad(*rays_of(pair)) ** 2 - (NOISE_PX * pixel_rad[a.camera]) ** 2
            steps_m[a.camera, a.unit] = np.interp(np.sqrt(max(moved, 0.0)), parallaxes[a.camera], [0.0, *STEPS_M])
    travelled_m = _travelled_m(steps_m, max_depth_m)
    first, second = (_averaged(count) for count in counts)
    between_m = np.full(units, np.nan)
    between_m[:-2] = travelled_m[2:] - travelled_m[1:-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        lost_per_m = np.log(first / second) / between_m
    return Motion(
        travelled_m=travelled_m,
        lost_per_m=np.where(np.isfinite(lost_per_m), np.maximum(lost_per_m, 0.0), 0.0),
        matches=np.where(np.isfinite(first), first, np.inf),
    )


def spacing_m(max_depth_m: float) -> float:
    """Distance of units that give depth to all that is seen."""
    return float(MIN_PARALLAX_RAD * max_depth_m)


def _parallaxes(drive: Drive, camera: int, max_depth_m: float) -> Floats:
    """Median parallax (1 + steps,) of what the camera sees, after no step and those of `STEPS_M`.

    Without the nearest samples of the view: few keypoints are so near, and fewer are matched.
    """
    kind, params = pack_cameras(drive.cameras)
    own = drive.cameras[camera]
    points = frustum_samples(int(kind[camera]), params[camera], own.width, own.height, max_depth_m)
    points = points[np.linalg.norm(points, axis=1) > 1.01 * DEPTH_FRACTIONS[0] * max_depth_m]
    before = points / np.linalg.norm(points, axis=1, keepdims=True)
    ahead = drive.rig_from_cam[camera, 0, :3]  # the vehicle's x axis, in the camera's
    result = [0.0]
    for step_m in STEPS_M:
        moved = points - step_m * ahead
        after = moved / np.linalg.norm(moved, axis=1, keepdims=True)
        seen = after[:, 2] >= before[:, 2].min()
        result.append(parallax_rad(before[seen], after[seen]) if seen.sum() >= 3 else result[-1])
    return np.maximum.accumulate(result)


def _travelled_m(steps_m: Floats, max_depth_m: float) -> Floats:
    """Distance travelled (units,) from the steps (cameras, units - 1) that cameras show; unknown ones are as others."""
    known = np.isfinite(steps_m).any(axis=0)
    step_m = np.full(steps_m.shape[1], spacing_m(max_depth_m))
    if known.any():
        step_m[known] = np.nanmedian(steps_m[:, known], axis=0)
        step_m[~known] = np.median(step_m[known])
    return np.concatenate([[0.0], np.cumsum(step_m)])


def _averaged(count: Floats) -> Floats:
    """Numbers of matches (cameras, units) averaged over near units, NaN where none is known."""
    known = np.isfinite(count)
    both = [
        uniform_filter1d(x.astype(np.float64), SMOOTHED_UNITS, axis=1) for x in (np.where(known, count, 0.0), known)
    ]
    result: Floats = np.where(both[1] > 0.5 / SMOOTHED_UNITS, both[0] / np.maximum(both[1], 1e-9), np.nan)
    return result
