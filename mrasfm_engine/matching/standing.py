"""Units of a standing car, found in small images before anything is extracted.

A minute at a red light is hundreds of units that show the same. Of a stop the first and the last unit are included,
those between take no part in the reconstruction and get their poses from these two (see `scene.standing_units`).

Each unit is compared with the last one that moved, so that the steps of a creeping car add up. An image is divided into
blocks, and each block's displacement follows from its gradients and its change (Lucas and Kanade, IJCAI 1981), where a
change of exposure is allowed. A camera moved as the median of its blocks did: traffic covers less than half of most
images. The car moved where more than half of the cameras did: a lorry beside it fills the cameras of one side. Where
the prior trajectory shows motion no image is read.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numba import njit

from mrasfm_engine.errors import CancelledError, InputError
from mrasfm_engine.features.extraction import one_opencv_thread
from mrasfm_engine.io.images import read_image_small
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory
from mrasfm_engine.parallel import in_order
from mrasfm_engine.scene.drive import Drive, DriveImage
from mrasfm_engine.types import Bools, Cancel, Floats, Floats32

REDUCED = 8  # times smaller: libjpeg then decodes one value of a block; noise averages out
SMOOTHING_PX = 1.0  # sigma: of finer detail the difference of two neighbours is less than the gradient
BLOCK_PX = 8  # side of a block in the reduced image
# Grey levels: a sensor's noise in daylight is about 4 levels, an eighth of which is left, and rounding adds to it.
SIGMA_GREY = 1.0
# A block tells if noise moves it by less than this share of the motion that counts.
MAX_NOISE = 1 / 3
MIN_BLOCKS = 8  # that tell, of a camera: the median of fewer is that of one passing thing
# What is left of a block's change may be no more than its gradients would make of this many reduced pixels: where they
# do not explain the change, the block shows something else.
MAX_UNEXPLAINED_PX = 1.0
# Contrast of two images of one view differs by no more than two stops of exposure. A grey image would else be any other
# with another exposure.
MAX_CONTRAST_RATIO = 4.0
# The prior shows motion where it went this many sigmas, and a metre, within a window.
MOVED_SIGMAS, MOVED_M = 6.0, 1.0
WINDOWS_S = (0.5, 1.0, 2.0)  # before the unit, and after it: a stop of two seconds and more is seen


@dataclass(frozen=True, kw_only=True)
class Standing:
    """Units of a drive by what small images show.

    Attributes
    ----------
    included
        (units,) those that are reconstructed; the others stand between two of them.
    moved_px
        (units,) how far a unit that is left out moved against the first of its stop, at full size: in the camera that
        moved most, but for cameras that show something else; NaN for the other units.
    compared
        Units whose images were read.
    """

    included: Bools
    moved_px: Floats
    compared: int

    def spans(self) -> list[tuple[int, int]]:
        """First and last unit, both included, of each stop."""
        included = np.flatnonzero(self.included).tolist()
        return [(a, b) for a, b in pairwise(included) if b - a > 1]


def find_standing(
    drive: Drive, prior: PriorTrajectory, *, min_motion_px: float, threads: int, cancel: Cancel | None = None
) -> Standing:
    """Find the units that moved less than `min_motion_px`, in pixels of full images.

    A drive without any motion keeps all units, as mapping does. Units with an image that cannot be read are not left
    out: the extraction says what is wrong with it.

    Raises
    ------
    CancelledError
        Where `cancel` answers True.
    """
    units = len(drive.timestamps_us)
    moves = moving_by_prior(drive, prior)
    # A standing unit is compared with one before it: the last that moves is read as well.
    read = np.flatnonzero(~moves | np.append(~moves[1:], False)).tolist()
    stands, moved_px = np.zeros(units, dtype=np.bool_), np.full(units, np.nan)
    of_unit = _by_unit(drive)

    def small(unit: int) -> dict[int, Floats32]:
        if cancel is not None and cancel():
            raise CancelledError
        return _small_images(drive, of_unit[unit])

    way = _PriorWay.from_prior(drive, prior)
    last, kept_images = 0, dict[int, Floats32]()
    with one_opencv_thread(), closing(in_order(threads, small, read)) as images:
        for unit, now in zip(read, images, strict=True):
            motion_px = (np.inf, np.inf)
            if not (moves[unit] or way.shows_motion(last, unit)):
                motion_px = unit_motion_px(kept_images, now, min_motion_px=min_motion_px)
            if motion_px[0] < min_motion_px:
                stands[unit], moved_px[unit] = True, motion_px[1]
            else:
                last, kept_images = unit, now
    included = ~(stands & np.append(stands[1:], False))  # the last one of a stop is included
    if stands.sum() >= units - 1:
        included[:] = True
    moved_px[included] = np.nan
    return Standing(included=included, moved_px=moved_px, compared=len(read))


def moving_by_prior(drive: Drive, prior: PriorTrajectory) -> Bools:
    """Units (u,) before and after which the prior trajectory shows motion far beyond its own error.

    Stops shorter than the window are not seen then, and their units are reconstructed.
    """
    way, times_s = _PriorWay.from_prior(drive, prior), drive.timestamps_us / 1e6
    moves = np.zeros(len(times_s), dtype=np.bool_)
    for window_s in WINDOWS_S:
        moves |= way.known & way.moved(times_s - window_s, times_s) & way.moved(times_s, times_s + window_s)
    return moves


@dataclass(frozen=True, kw_only=True)
class _PriorWay:
    """Horizontal way by the prior trajectory, where there is one."""

    times_s: Floats  # (units,)
    known: Bools  # (units,)
    position_m: Floats  # (known units, 2)
    sigma_m: Floats  # (known units,)

    @staticmethod
    def from_prior(drive: Drive, prior: PriorTrajectory) -> _PriorWay:
        times_s = drive.timestamps_us / 1e6
        if prior.world_from_rig is None or prior.sigma is None:
            none = np.zeros(0)
            return _PriorWay(
                times_s=times_s,
                known=np.zeros(len(times_s), dtype=np.bool_),
                position_m=none.reshape(0, 2),
                sigma_m=none,
            )
        known = np.isfinite(prior.world_from_rig[:, 0, 3]) & np.isfinite(prior.sigma).all(axis=1)
        return _PriorWay(
            times_s=times_s,
            known=known,
            position_m=prior.world_from_rig[known, :2, 3],
            sigma_m=prior.sigma[known, 3:5].max(axis=1),
        )

    def moved(self, from_s: Floats, to_s: Floats) -> Bools:
        """Between pairs of times (n,): whether the way is far beyond what the positions may be wrong by."""
        if not self.known.any():
            return np.zeros(len(from_s), dtype=np.bool_)
        (xa, ya, sa), (xb, yb, sb) = (
            [np.interp(at, self.times_s[self.known], v) for v in (*self.position_m.T, self.sigma_m)]
            for at in (from_s, to_s)
        )
        result: Bools = np.hypot(xb - xa, yb - ya) > np.maximum(MOVED_M, MOVED_SIGMAS * np.hypot(sa, sb))
        return result

    def shows_motion(self, unit_a: int, unit_b: int) -> bool:
        """Answer `moved` for two units of which the prior knows something."""
        units = np.array([unit_a, unit_b])
        return bool(self.known[units].all() and self.moved(self.times_s[units[:1]], self.times_s[units[1:]])[0])


def unit_motion_px(
    before: dict[int, Floats32], now: dict[int, Floats32], *, min_motion_px: float
) -> tuple[float, float]:
    """Motion (px, at full size) of more than half of the cameras, and of the one that moved most.

    Cameras that show something else count in the first only. Both are infinite where no camera tells.
    """
    max_sigma_px = MAX_NOISE * min_motion_px / REDUCED
    moved = []
    for camera in before.keys() & now.keys():
        if before[camera].shape != now[camera].shape:
            continue
        blocks = block_motion_px(before[camera], now[camera], max_sigma_px)
        tell = blocks[~np.isnan(blocks)]
        if len(tell) >= MIN_BLOCKS:
            moved.append(float(np.median(tell)) * REDUCED)
    if not moved:
        return np.inf, np.inf
    moved.sort()
    explained = [way_px for way_px in moved if np.isfinite(way_px)]
    # The smaller one of the two in the middle: half of the cameras may see one lorry.
    return moved[(len(moved) - 1) // 2], max(explained, default=np.inf)


def _by_unit(drive: Drive) -> list[list[DriveImage]]:
    result: list[list[DriveImage]] = [[] for _ in drive.timestamps_us]
    for image in drive.images:
        result[image.unit].append(image)
    return result


def _small_images(drive: Drive, images: Sequence[DriveImage]) -> dict[int, Floats32]:
    """Small grey images by camera; none at all where one of them cannot be read."""
    result: dict[int, Floats32] = {}
    for image in images:
        camera = drive.cameras[image.camera]
        try:
            size_px, width_px = (camera.width, camera.height), max(camera.width // REDUCED, 1)
            grey = read_image_small(drive.root / image.file, size_px, width_px, colours="GRAY")
        except InputError:
            return {}
        if grey is None:
            return {}
        smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), SMOOTHING_PX)
        result[image.camera] = np.asarray(smooth, dtype=np.float32)
    return result


@njit(cache=True, nogil=True)
def block_motion_px(before: Any, now: Any, max_sigma_px: float) -> Any:
    """Displacement (blocks,) of each block between two small images (h, w), in their pixels.

    NaN where a block has too little texture to tell, infinite where neither a displacement nor an exposure
    explains its change.
    """
    height, width = before.shape
    rows, columns = (height - 2) // BLOCK_PX, (width - 2) // BLOCK_PX
    result = np.full(rows * columns, np.nan)
    for block in range(rows * columns):
        top, left = 1 + (block // columns) * BLOCK_PX, 1 + (block % columns) * BLOCK_PX
        normal, right, square = np.zeros((4, 4)), np.zeros(4), 0.0
        contrast_before, contrast_now = 0.0, 0.0  # sums of squared gradients
        column = np.empty(4)
        for y in range(top, top + BLOCK_PX):
            for x in range(left, left + BLOCK_PX):
                # Gradients of both images' mean: displacements are then right to second order.
                column[0] = 0.25 * (before[y, x + 1] - before[y, x - 1] + now[y, x + 1] - now[y, x - 1])
                column[1] = 0.25 * (before[y + 1, x] - before[y - 1, x] + now[y + 1, x] - now[y - 1, x])
                column[2] = before[y, x] - before[top, left]  # another exposure
                column[3] = 1.0
                contrast_before += (before[y, x + 1] - before[y, x - 1]) ** 2 + (
                    before[y + 1, x] - before[y - 1, x]
                ) ** 2
                contrast_now += (now[y, x + 1] - now[y, x - 1]) ** 2 + (now[y + 1, x] - now[y - 1, x]) ** 2
                change = now[y, x] - before[y, x]
                square += change * change
                for i in range(4):
                    right[i] += column[i] * change
                    for j in range(4):
                        normal[i, j] += column[i] * column[j]
        xx, xy, yy = normal[0, 0], normal[0, 1], normal[1, 1]
        weakest = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
        if weakest < (SIGMA_GREY / max_sigma_px) ** 2:
            continue
        if max(contrast_before, contrast_now) > MAX_CONTRAST_RATIO**2 * min(contrast_before, contrast_now):
            result[block] = np.inf
            continue
        for i in range(4):
            normal[i, i] += 1e-6 * (1.0 + normal[i, i])
        solution = np.linalg.solve(normal, right)
        left_over = max(square - (solution * right).sum(), 0.0) / BLOCK_PX**2
        unexplained = max(left_over - 2.0 * SIGMA_GREY**2, 0.0) / (0.5 * (xx + yy) / BLOCK_PX**2)
        if unexplained > MAX_UNEXPLAINED_PX**2:
            result[block] = np.inf
        else:
            result[block] = np.hypot(solution[0], solution[1])
    return result
