"""Painted facades: walls with rows of alike but never equal windows, shops, doors, signs and weather."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.synthetic.paint_noise import cracks, fractal, spots, to_bytes
from mrasfm_engine.synthetic.paint_surfaces import write_text
from mrasfm_engine.types import Bytes, Floats32

Colour = tuple[float, float, float]

_WALL_COLOURS = np.array(
    [
        [196, 178, 142],
        [178, 130, 104],
        [168, 168, 164],
        [204, 190, 162],
        [150, 98, 80],
        [146, 160, 170],
        [190, 160, 120],
        [168, 150, 150],
        [210, 205, 195],
        [128, 138, 120],
    ],
    np.float32,
)


def _tone(colour: NDArray[np.floating[Any]]) -> Colour:
    """A colour for OpenCV, less saturated than random numbers are."""
    grey = float(colour.mean())
    r, g, b = (grey + 0.7 * (float(c) - grey) for c in colour)
    return r, g, b


def wall(size: int, rng: np.random.Generator, *, material: str, colour: Floats32) -> Floats32:
    """A bare wall (size, size, 3) of plaster, brick, stone or panels, float colours; brick, stone and panels tile."""
    relief = np.zeros((size, size), np.float32)
    if material != "plaster":
        rows, cols = {"brick": (64, 22), "stone": (22, 11), "panel": (8, 6)}[material]
        ys = np.linspace(0, size, rows + 1).round().astype(int)
        xs = np.linspace(0, size, cols + 1).round().astype(int)
        spread = {"brick": 0.13, "stone": 0.12, "panel": 0.05}[material]
        shift = 0 if material == "panel" else (xs[1] // 2)
        for r in range(rows):
            for c in range(cols):
                shade = float(rng.normal(0, spread))
                x = int(xs[c] + (r % 2) * shift)
                cv2.rectangle(relief, (x, int(ys[r])), (x + int(xs[1]), int(ys[r + 1])), shade, -1)
                if x + xs[1] > size:
                    cv2.rectangle(relief, (0, int(ys[r])), (x + int(xs[1]) - size, int(ys[r + 1])), shade, -1)
            cv2.line(relief, (0, int(ys[r])), (size, int(ys[r])), -0.22, 1 if material == "brick" else 2)
        if material != "brick":
            for c in range(cols):
                for r in range(rows):
                    x = int(xs[c] + (r % 2) * shift)
                    cv2.line(relief, (x, int(ys[r])), (x, int(ys[r + 1])), -0.25, 2)
    noise = fractal(size, rng, coarsest=4, octave_gain=0.75)
    relief += 0.055 * noise + 0.6 * cracks(size, rng, count=10, length_px=size / 5, strength=0.3)
    relief += spots(size, rng, count=size // 2, radius_px=(2.0, 9.0), strength=0.1)
    return (1.0 + relief)[..., None] * colour


def _window(image: Floats32, rng: np.random.Generator, box: tuple[int, int, int, int], style: dict[str, float]) -> None:
    """Draw one window into x, y, width, height."""
    x, y, w, h = box
    frame = _tone(np.full(3, style["frame"]) * rng.uniform(0.95, 1.05))
    border = max(3, w // 14)
    cv2.rectangle(image, (x - border, y - border), (x + w + border, y + h + border), frame, -1)
    pane = np.array([54.0, 64.0, 76.0]) * rng.uniform(0.6, 1.5)
    cv2.rectangle(image, (x, y), (x + w, y + h), _tone(pane), -1)
    # Reflected sky in the upper part, a blind or curtains inside, sometimes a plant or a lamp.
    cv2.fillPoly(
        image,
        [np.array([[x, y], [x + int(w * rng.uniform(0.3, 1.0)), y], [x, y + int(h * rng.uniform(0.2, 0.9))]])],
        _tone(pane * rng.uniform(1.3, 2.0)),
    )
    kind = rng.random()
    if kind < 0.35:
        drop = int(h * rng.uniform(0.15, 0.85))
        tone = rng.uniform(120, 220)
        cv2.rectangle(image, (x, y), (x + w, y + drop), _tone(np.array([tone, tone, tone * 0.92])), -1)
        for line in range(y + 4, y + drop, 6):
            cv2.line(image, (x, line), (x + w, line), _tone(np.full(3, tone * 0.8)), 1)
    elif kind < 0.7:
        cloth = _tone(rng.uniform(90, 225, 3))
        for side in (x, x + w - int(w * 0.28)):
            cv2.rectangle(image, (side, y), (side + int(w * rng.uniform(0.15, 0.28)), y + h), cloth, -1)
    if rng.random() < 0.4:
        cx, cy = x + int(w * rng.uniform(0.2, 0.8)), y + int(h * 0.85)
        cv2.circle(image, (cx, cy), max(3, int(w * rng.uniform(0.08, 0.2))), _tone(rng.uniform(20, 200, 3)), -1)
    bar = max(2, w // 22)
    cv2.line(image, (x + w // 2, y), (x + w // 2, y + h), frame, bar)
    if style["cross"] > 0.5:
        cv2.line(image, (x, y + int(h * 0.35)), (x + w, y + int(h * 0.35)), frame, bar)
    sill = _tone(np.full(3, style["sill"]))
    cv2.rectangle(image, (x - border - 4, y + h + border), (x + w + border + 4, y + h + border + 7), sill, -1)
    cv2.line(
        image, (x - border - 4, y + h + border + 9), (x + w + border + 4, y + h + border + 9), (50.0, 48.0, 46.0), 2
    )
    if style["shutters"] > 0.5 and rng.random() < 0.85:
        wood = np.array([style["shutter_r"], style["shutter_g"], style["shutter_b"]]) * rng.uniform(0.85, 1.15)
        width = int(w * 0.42)
        for sx in (x - border - width, x + w + border):
            cv2.rectangle(image, (sx, y), (sx + width, y + h), _tone(wood), -1)
            for line in range(y + 4, y + h, 7):
                cv2.line(image, (sx + 2, line), (sx + width - 2, line), _tone(wood * 0.7), 1)
    if rng.random() < 0.12:
        ax, ay = x + int(w * 0.1), y + h + border + 12
        cv2.rectangle(image, (ax, ay), (ax + w // 2, ay + w // 4), (205.0, 205.0, 200.0), -1)
        cv2.circle(image, (ax + w // 4, ay + w // 8), w // 10, (70.0, 70.0, 70.0), 2)


def _shop(image: Floats32, rng: np.random.Generator, box: tuple[int, int, int, int]) -> None:
    """Draw a shop window with a sign over it."""
    x, y, w, h = box
    cv2.rectangle(image, (x, y), (x + w, y + h), _tone(rng.uniform(30, 110, 3)), -1)
    board = _tone(rng.uniform(20, 235, 3))
    cv2.rectangle(image, (x, y), (x + w, y + h // 4), board, -1)
    write_text(image, rng, box=(x + 4, y + 2, w - 8, h // 4 - 4), letters=int(rng.integers(4, 10)))
    gx, gy, gw, gh = x + 8, y + h // 4 + 8, w - 16, h - h // 4 - 30
    cv2.rectangle(image, (gx, gy), (gx + gw, gy + gh), (46.0, 54.0, 62.0), -1)
    for _ in range(26):
        px, py = int(rng.integers(gx, gx + gw - 8)), int(rng.integers(gy, gy + gh - 8))
        pw, ph = int(rng.integers(5, max(6, gw // 5))), int(rng.integers(5, max(6, gh // 2)))
        corner = (min(px + pw, gx + gw), min(py + ph, gy + gh))
        cv2.rectangle(image, (px, py), corner, _tone(rng.uniform(15, 240, 3)), -1)
    for k in range(1, 3):
        cv2.line(image, (gx + gw * k // 3, gy), (gx + gw * k // 3, gy + gh), (150.0, 150.0, 150.0), 4)


def _door(image: Floats32, rng: np.random.Generator, box: tuple[int, int, int, int]) -> None:
    x, y, w, h = box
    tone = rng.uniform(35, 150, 3)
    cv2.rectangle(image, (x - 8, y - 8), (x + w + 8, y + h), _tone(np.full(3, rng.uniform(140, 220))), -1)
    cv2.rectangle(image, (x, y), (x + w, y + h), _tone(tone), -1)
    for row in range(3):
        top = y + 8 + row * h // 3
        cv2.rectangle(image, (x + 8, top), (x + w - 8, top + h // 3 - 16), _tone(tone * rng.uniform(0.6, 1.4)), -1)
    cv2.circle(image, (x + w - 10, y + h // 2), 4, (220.0, 200.0, 120.0), -1)
    for k in range(int(rng.integers(2, 6))):
        bx, by = x + w + 14, y + 40 + 12 * k
        cv2.rectangle(image, (bx, by), (bx + 22, by + 8), _tone(rng.uniform(120, 240, 3)), -1)


def facade(size: int, rng: np.random.Generator) -> Bytes:
    """A front (size, size, 3) of 3 to 4 floors, ground floor included, for a width and height of 9 to 15 m each."""
    k = size / 1024
    shift = rng.uniform(0.9, 1.1) * rng.uniform(0.96, 1.04, 3)
    colour = _WALL_COLOURS[rng.integers(len(_WALL_COLOURS))] * shift.astype(np.float32)
    material = str(rng.choice(["plaster", "brick", "stone", "panel"], p=[0.35, 0.3, 0.2, 0.15]))
    image = wall(1024, rng, material=material, colour=colour)
    floors, columns = int(rng.integers(3, 5)), int(rng.integers(3, 6))
    style = {
        "frame": float(rng.choice([225.0, 60.0, 150.0])),
        "sill": float(rng.uniform(110, 215)),
        "cross": float(rng.random()),
        "shutters": float(columns <= 4 and rng.random() < 0.4),
        **{f"shutter_{c}": float(v) for c, v in zip("rgb", rng.uniform(40, 150, 3), strict=True)},
    }
    storey, ground = 1024 // (floors + 1), 1024 - 1024 // (floors + 1)
    cell = 1024 // columns
    w, h = int(cell * rng.uniform(0.34, 0.48)), int(storey * rng.uniform(0.5, 0.62))
    for row in range(floors):
        top = 1024 * row // (floors + 1)
        for col in range(columns):
            if rng.random() < 0.06:
                continue
            # Masons are not exact: nor are these windows.
            x = col * cell + (cell - w) // 2 + int(rng.integers(-4, 5))
            y = top + (storey - h) // 2 + int(rng.integers(-3, 4))
            _window(image, rng, (x, y, w, h), style)
        if style["cross"] > 0.3:
            cv2.rectangle(image, (0, top + storey - 8), (1024, top + storey), _tone(colour * 0.8), -1)
    cv2.rectangle(image, (0, ground), (1024, ground + 10), _tone(colour * 0.6), -1)
    x = 14
    while x < 1024 - 150:
        kind = rng.random()
        if kind < 0.5:
            width = min(int(rng.integers(220, 400)), 1024 - x - 14)
            _shop(image, rng, (x, ground + 16, width, 1024 - ground - 30))
        elif kind < 0.75:
            width = 110
            _door(image, rng, (x + 16, ground + 50, 78, 1024 - ground - 56))
        else:
            width = 150
            _window(image, rng, (x + 26, ground + 40, 90, int((1024 - ground) * 0.5)), style)
        x += width + int(rng.integers(14, 44))
    for _ in range(int(rng.integers(1, 4))):
        px = int(rng.integers(4, 1000))
        cv2.line(image, (px, 0), (px, 1024), _tone(rng.uniform(60, 150, 3)), 6)
        for joint in range(60, 1024, 190):
            cv2.rectangle(image, (px - 6, joint), (px + 6, joint + 8), (60.0, 60.0, 62.0), -1)
    for _ in range(int(rng.integers(2, 7))):
        px, py = int(rng.integers(0, 940)), int(rng.integers(ground + 30, 960))
        cv2.rectangle(image, (px, py), (px + 46, py + 58), _tone(rng.uniform(40, 240, 3)), -1)
        write_text(image, rng, box=(px + 2, py + 6, 42, 18), letters=4)
    weather = 0.08 * fractal(1024, rng, coarsest=4, octave_gain=0.8)
    streaks = cv2.resize(weather[:16], (1024, 1024), interpolation=cv2.INTER_CUBIC)
    image *= (1 + weather + 0.4 * np.asarray(streaks, np.float32))[..., None]
    if k != 1:
        image = np.asarray(cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA), np.float32)
    return to_bytes(image)


def side_wall(size: int, rng: np.random.Generator) -> Bytes:
    """A tileable wall without windows."""
    colour = _WALL_COLOURS[rng.integers(len(_WALL_COLOURS))] * np.float32(0.85)
    material = str(rng.choice(["brick", "stone", "panel"]))
    return to_bytes(wall(size, rng, material=material, colour=colour))
