"""Draws a map from above: `python -m tests.documentation.map_image MAP docs/images/map.png`.

The committed image shows a map of four rendered drives at a crossing:

    mrasfm synth --world crossing --drives 4 --units 36 --spacing-m 1.5 --width 640 --height 360 --seed 3 --out drives
    for n in 0 1 2 3; do mrasfm reconstruct drives/drive_$n --out scene-$n; done
    mrasfm aggregate scene-0 scene-1 scene-2 scene-3 --out map
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.io.read_map import read_map
from mrasfm_engine.io.read_model import read_points
from mrasfm_engine.visualization.drawing import framed

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float64]

WIDTH_PX = 760
MARGIN_M = 12.0  # around the trajectories
MAX_HEIGHT_M = 9.0  # above the vehicle: crowns of trees and roofs would hide the street
OVERSAMPLING = 3  # of the trajectories; points are whole pixels, which compress well
SHADE_STEP = 32  # of the points' colours, for the same reason
TRAJECTORY_COLORS = ((214, 39, 40), (31, 119, 180), (44, 160, 44), (255, 127, 14))
PAPER = 255


def draw(folder: Path) -> Bytes:
    """A map from above, north up: points in their colours, trajectories over them; (h, w, 3) red, green, blue."""
    poses = read_map(folder)
    points = read_points(folder / "model" / "points3D.bin")
    paths = [trajectory.world_from_rig[:, :3, 3] for trajectory in poses.trajectories.values()]
    corners = np.concatenate(paths)
    low, high = corners[:, :2].min(axis=0) - MARGIN_M, corners[:, :2].max(axis=0) + MARGIN_M
    cell_m = float(high[0] - low[0]) / WIDTH_PX
    height = int(np.ceil((high[1] - low[1]) / cell_m))
    picture = np.full((height, WIDTH_PX, 3), PAPER, np.uint8)
    below = points.xyz_m[:, 2] <= corners[:, 2].max() + MAX_HEIGHT_M
    _draw_points(picture, points.xyz_m[below], points.color[below], low_m=low, cell_m=cell_m)
    fine = cv2.resize(picture, None, fx=OVERSAMPLING, fy=OVERSAMPLING, interpolation=cv2.INTER_NEAREST)
    for path, color in zip(paths, TRAJECTORY_COLORS, strict=False):
        _draw_path(fine, _pixels(path, low, cell_m / OVERSAMPLING, len(fine)), color)
    picture = cv2.resize(fine, (WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    title = [f"{len(paths)} drives, {poses.registered_images} images, {len(points.xyz_m):,} points, seen from above"]
    return framed(picture, title, cell_m=cell_m, arrows=[("north", (0.0, 1.0))]).picture


def _pixels(xyz_m: Floats, low_m: Floats, cell_m: float, height: int) -> NDArray[np.int64]:
    """Pixels (n, 2) x right, y down."""
    xy = np.floor((xyz_m[:, :2] - low_m) / cell_m).astype(np.int64)
    return np.stack([xy[:, 0], height - 1 - xy[:, 1]], axis=1)


def _draw_points(picture: Bytes, xyz_m: Floats, color: Bytes, *, low_m: Floats, cell_m: float) -> None:
    """Squares of 2 pixels, the highest points last."""
    order = np.argsort(xyz_m[:, 2])
    shades = np.minimum(color[order] // SHADE_STEP * SHADE_STEP + SHADE_STEP // 2, PAPER).astype(np.uint8)
    x, y = _pixels(xyz_m[order], low_m, cell_m, len(picture)).T
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        inside = (x + dx >= 0) & (x + dx < picture.shape[1]) & (y + dy >= 0) & (y + dy < len(picture))
        picture[y[inside] + dy, x[inside] + dx] = shades[inside]


def _draw_path(picture: Bytes, pixels: NDArray[np.int64], color: Sequence[int]) -> None:
    line = pixels.astype(np.int32).reshape(-1, 1, 2)
    cv2.polylines(picture, [line], False, (PAPER, PAPER, PAPER), 14, cv2.LINE_AA)
    cv2.polylines(picture, [line], False, color, 8, cv2.LINE_AA)
    for x, y in pixels.tolist():
        cv2.circle(picture, (x, y), 8, color, cv2.FILLED, cv2.LINE_AA)
    x, y = pixels[-1].tolist()
    dx, dy = pixels[-1] - pixels[-3]
    cv2.arrowedLine(picture, (x, y), (x + 2 * int(dx), y + 2 * int(dy)), color, 10, cv2.LINE_AA, tipLength=0.5)


def main() -> None:
    """Draw the map that the arguments name."""
    parser = argparse.ArgumentParser(description="Draw a map from above.")
    parser.add_argument("map", type=Path, metavar="MAP", help="folder that `mrasfm aggregate` wrote")
    parser.add_argument("image", type=Path, metavar="PNG", help="file of the image")
    arguments = parser.parse_args()
    picture = draw(arguments.map)
    cv2.imwrite(str(arguments.image), picture[:, :, ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
