"""Frame of a picture: title, scale bar, direction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from mrasfm_engine.types import Bytes

FONT = cv2.FONT_HERSHEY_SIMPLEX
INK, PAPER = (30, 30, 30), (255, 255, 255)
MARGIN_PX = 10  # beside the title lines
BAR_LENGTHS_M = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)


@dataclass(frozen=True)
class Framed:
    """A picture (h, w, 3) with its frame, and where the picture's own top left corner is in it, pixels from the top."""

    picture: Bytes
    top_px: int


def framed(
    picture: Bytes,
    lines: Sequence[str],
    *,
    cell_m: float,
    arrows: Sequence[tuple[str, tuple[float, float]]],
    lines_of_other: Sequence[str] = (),
) -> Framed:
    """The picture under its title lines, above a scale bar and arrows. The frame is as wide as its longest line.

    Parameters
    ----------
    picture
        (h, w, 3) red, green, blue.
    arrows
        Labels and directions (x right, y up) in the picture.
    lines_of_other
        Title lines of a picture of the same size that this one is compared with: both frames are equally wide.
    """
    height, width = picture.shape[:2]
    size = float(np.clip(width / 1800, 0.45, 1.2))
    line = round(34 * size) + 6
    top, bottom = line * len(lines) + 12, 3 * line
    widest = max((_text_width(text, size) for text in (*lines, *lines_of_other)), default=0)
    out = np.full((height + top + bottom, max(width, 640, widest + 2 * MARGIN_PX), 3), PAPER, np.uint8)
    out[top : top + height, :width] = picture
    for k, text in enumerate(lines):
        write_text(out, text, (MARGIN_PX, line * (k + 1)), size=size)
    _scale_bar(out, (20, top + height + line), width, cell_m, size)
    x = out.shape[1] - round(90 * size) - 10
    for label, direction in reversed(arrows):
        _arrow(out, (x, top + height + round(1.5 * line)), direction, label, size)
        x -= round(190 * size)
    return Framed(out, top)


def write_text(
    picture: Bytes,
    text: str,
    at: tuple[int, int],
    *,
    size: float = 0.5,
    align: Literal["left", "centre", "right"] = "left",
) -> None:
    """Write a line into a picture (h, w, 3): its left end, middle or right end at a column, its foot on a row.

    Parameters
    ----------
    at
        Column and row, pixels.
    size
        Of OpenCV's fonts: capitals are about 21 pixels high times that.
    """
    width = _text_width(text, size)
    shift = {"left": 0, "centre": width // 2, "right": width}[align]
    cv2.putText(picture, text, (at[0] - shift, at[1]), FONT, size, INK, _thickness(size), cv2.LINE_AA)


def _text_width(text: str, size: float) -> int:
    return int(cv2.getTextSize(text, FONT, size, _thickness(size))[0][0])


def _thickness(size: float) -> int:
    return max(1, round(1.6 * size))


def _scale_bar(out: Bytes, at: tuple[int, int], width: int, cell_m: float, size: float) -> None:
    """A bar of about a fifth of the picture's width."""
    length_m = max((m for m in BAR_LENGTHS_M if m / cell_m <= 0.25 * width), default=BAR_LENGTHS_M[0])
    pixels, thick = round(length_m / cell_m), max(6, round(12 * size))
    x, y = at
    cv2.rectangle(out, (x, y), (x + pixels, y + thick), INK, 1)
    cv2.rectangle(out, (x, y), (x + pixels // 2, y + thick), INK, -1)
    for share in (0.0, 0.5, 1.0):
        foot = x + round(share * pixels) - 4, y + thick + round(26 * size)
        write_text(out, f"{share * length_m:g}", foot, size=0.8 * size)
    write_text(out, "m", (x + pixels + round(46 * size), y + thick + round(26 * size)), size=0.8 * size)


def _arrow(out: Bytes, centre: tuple[int, int], direction: tuple[float, float], label: str, size: float) -> None:
    v = np.array([direction[0], -direction[1]]) * round(26 * size)
    tail, tip = (tuple((np.array(centre) + s * v).round().astype(int).tolist()) for s in (-1, 1))
    cv2.arrowedLine(out, tail, tip, INK, max(2, round(3 * size)), cv2.LINE_AA, tipLength=0.35)
    write_text(out, label, (centre[0] - round(110 * size), centre[1] + round(8 * size)), size=0.8 * size)
