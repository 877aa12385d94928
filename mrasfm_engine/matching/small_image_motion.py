"""Motion between two instants in small images of all cameras.

An image is divided into blocks, and each block's displacement follows from its gradients and its change (Lucas and
Kanade, IJCAI 1981), where a change of exposure is allowed. A camera moved as the median of its blocks did: traffic
covers less than half of most images. The car moved where more than half of the cameras did: a lorry beside it fills the
cameras of one side.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry.small_cholesky import factorise, solve
from mrasfm_engine.io.images import read_image_small
from mrasfm_engine.jit import njit, uncounted
from mrasfm_engine.scene.drive import Drive, DriveImage
from mrasfm_engine.types import Floats32

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


def small_images(drive: Drive, images: Sequence[DriveImage]) -> dict[int, Floats32]:
    """Small grey images by camera; none at all where one of them cannot be read."""
    result: dict[int, Floats32] = {}
    for image in images:
        camera = drive.cameras[image.camera]
        try:
            size_px, width_px = (camera.width, camera.height), max(camera.width // REDUCED, 1)
            grey = read_image_small(drive.path_of(image.file), size_px, width_px, colours="GRAY")
        except InputError:
            return {}
        if grey is None:
            return {}
        smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), SMOOTHING_PX)
        result[image.camera] = np.asarray(smooth, dtype=np.float32)
    return result


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


@njit(cache=True, nogil=True)
def block_motion_px(before: Any, now: Any, max_sigma_px: float) -> Any:
    """Displacement (blocks,) of each block between two small images (h, w), in their pixels.

    NaN where a block has too little texture to tell, infinite where neither a displacement nor an exposure
    explains its change.
    """
    height, width = before.shape
    rows, columns = (height - 2) // BLOCK_PX, (width - 2) // BLOCK_PX
    result = np.full(rows * columns, np.nan)
    _move_blocks(
        before, now, max_sigma_px, result, np.empty((4, 4)), np.empty((4, 4)), np.empty(4), np.empty(4), np.empty(4)
    )
    return result


@uncounted()
def _move_blocks(
    before: Any, now: Any, max_sigma_px: float, result: Any,
    normal: Any, factor: Any, right: Any, column: Any, solution: Any,
) -> None:  # fmt: skip
    columns = (before.shape[1] - 2) // BLOCK_PX
    for block in range(len(result)):
        top, left = 1 + (block // columns) * BLOCK_PX, 1 + (block % columns) * BLOCK_PX
        normal[:] = 0.0
        right[:] = 0.0
        square = 0.0
        contrast_before, contrast_now = 0.0, 0.0  # sums of squared gradients
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
        factorise(normal, 4, factor)
        solve(factor, right, 4, solution)
        explained = 0.0
        for i in range(4):
            explained += solution[i] * right[i]
        left_over = max(square - explained, 0.0) / BLOCK_PX**2
        unexplained = max(left_over - 2.0 * SIGMA_GREY**2, 0.0) / (0.5 * (xx + yy) / BLOCK_PX**2)
        if unexplained > MAX_UNEXPLAINED_PX**2:
            result[block] = np.inf
        else:
            result[block] = np.hypot(solution[0], solution[1])
