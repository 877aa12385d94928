"""A seam from above: the points of two scenes in two colours, as positions put them, and in the map."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from mrasfm_engine.types import Bytes, Floats, Ints
from mrasfm_engine.visualization.drawing import framed

MARGIN_M = 15.0
LARGEST_SIDE_M = 120.0
SIDE_PX = 1100
COLOR_A, COLOR_B = (214, 96, 0), (0, 92, 190)


def seam_picture(
    title: Sequence[str],
    points_m: tuple[Floats, Floats],
    trajectories_m: tuple[Floats, Floats],
    centre_m: Floats,
    side_m: float,
    *,
    title_of_other: Sequence[str] = (),
) -> Bytes:
    """A picture (h, w, 3) of the ground around a place, east to the right and north up.

    Parameters
    ----------
    points_m, trajectories_m
        Points (n, 3) and units' positions (u, 3) of the two scenes, in one frame.
    side_m
        Of the square that is shown.
    title_of_other
        Title of the picture that this one is compared with: both are equally wide.
    """
    cell_m = side_m / SIDE_PX
    picture = np.full((SIDE_PX, SIDE_PX, 3), 255.0)

    def pixels(xyz: Floats) -> Ints:
        u = (xyz[:, 0] - centre_m[0]) / cell_m + SIDE_PX / 2
        v = SIDE_PX / 2 - (xyz[:, 1] - centre_m[1]) / cell_m
        return np.stack([np.floor(u), np.floor(v)], 1).astype(np.int64)

    for points, color in zip(points_m, (COLOR_A, COLOR_B), strict=True):
        at = pixels(points)
        at = at[((at >= 0) & (at < SIDE_PX - 1)).all(1)]
        cover = np.zeros((SIDE_PX, SIDE_PX))
        for du in (0, 1):
            for dv in (0, 1):
                np.add.at(cover, (at[:, 1] + dv, at[:, 0] + du), 1.0)
        # Ink that lets what is below shine through, so that both scenes are seen where they coincide.
        strength = (1.0 - 0.45 ** np.minimum(cover, 4.0))[..., None]
        picture *= 1.0 - strength * (1.0 - np.array(color) / 255.0)
    drawn = np.ascontiguousarray(picture.round().astype(np.uint8))
    for trajectory, color in zip(trajectories_m, (COLOR_A, COLOR_B), strict=True):
        for u, v in pixels(trajectory).tolist():
            cv2.circle(drawn, (int(u), int(v)), 4, color, -1, cv2.LINE_AA)
            cv2.circle(drawn, (int(u), int(v)), 4, (30, 30, 30), 1, cv2.LINE_AA)
    arrows = [("N", (0.0, 1.0))]
    return framed(drawn, title, cell_m=cell_m, arrows=arrows, lines_of_other=title_of_other).picture


def shown_square(places_m: Floats) -> tuple[Floats, float]:
    """Middle (3,) and side in metres of the square around the places (n, 3) of a seam."""
    low, high = places_m.min(0), places_m.max(0)
    side = float((high - low)[:2].max()) + 2 * MARGIN_M
    return 0.5 * (low + high), min(side, LARGEST_SIDE_M)
