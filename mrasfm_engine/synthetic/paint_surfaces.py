"""Painted textures of everything but facades: ground, plants, cars, signs, sky."""

from __future__ import annotations

import string

import cv2
import numpy as np

from mrasfm_engine.synthetic.paint_noise import colourise, cracks, fractal, spots, to_bytes, with_alpha
from mrasfm_engine.types import Bytes, Floats32

LETTERS = np.array(list(string.ascii_uppercase + string.digits))


def detail(size: int, rng: np.random.Generator) -> Bytes:
    """Grey structure at all scales around 128 that multiplies other textures: dirt, pits, scratches, stains."""
    value = 0.06 * fractal(size, rng, coarsest=4, octave_gain=0.85)
    value += spots(size, rng, count=size * 2, radius_px=(1.5, 12.0), strength=0.13)
    value += spots(size, rng, count=size // 16, radius_px=(10.0, 45.0), strength=0.09)
    value += cracks(size, rng, count=size // 24, length_px=size / 6, strength=0.2)
    return to_bytes(colourise(np.clip(value, -0.5, 0.5), (128.0, 128.0, 128.0)))


def asphalt(size: int, rng: np.random.Generator) -> Bytes:
    """Grey road surface with coarse stones, tar patches and cracks."""
    value = 0.07 * fractal(size, rng, coarsest=4, octave_gain=0.9)
    value += spots(size, rng, count=size * 3, radius_px=(1.2, 5.0), strength=0.2)
    value += spots(size, rng, count=24, radius_px=(15.0, 70.0), strength=0.1)
    value += cracks(size, rng, count=14, length_px=size / 3, strength=0.35)
    return to_bytes(colourise(value, (98.0, 97.0, 99.0)))


def paving(size: int, rng: np.random.Generator, *, slabs: int = 8, colour: tuple[int, int, int]) -> Bytes:
    """Slabs in a bond of alternate rows, each with its own shade, with joints, chewing gum and stains."""
    image = np.zeros((size, size), np.float32)
    slab = size // slabs
    for row in range(slabs):
        shift = (row % 2) * slab // 2
        for col in range(slabs):
            shade = rng.normal(0.0, 0.11)
            for x in (col * slab + shift, col * slab + shift - size):
                cv2.rectangle(image, (x, row * slab), (x + slab - 1, (row + 1) * slab - 1), float(shade), -1)
                cv2.rectangle(image, (x, row * slab), (x + slab - 1, (row + 1) * slab - 1), -0.45, max(1, slab // 28))
    image += 0.05 * fractal(size, rng, coarsest=8, octave_gain=0.9)
    image += spots(size, rng, count=size // 2, radius_px=(1.5, 7.0), strength=0.2)
    return to_bytes(colourise(image, colour))


def grass(size: int, rng: np.random.Generator) -> Bytes:
    """Lawn with tufts, bare earth and fallen leaves."""
    value = 0.16 * fractal(size, rng, coarsest=8, octave_gain=0.95)
    image = colourise(value, (88.0, 118.0, 58.0))
    earth = fractal(size, rng, coarsest=4, octave_gain=0.7) > 1.1
    image[earth] = image[earth] * np.array([1.25, 0.9, 0.95], np.float32)
    image += spots(size, rng, count=size, radius_px=(1.5, 6.0), strength=28.0)[..., None] * np.array(
        [1.2, 0.9, 0.5], np.float32
    )
    return to_bytes(image)


def leaves(size: int, rng: np.random.Generator, *, colour: tuple[float, float, float], cover: float) -> Bytes:
    """A cluster of leaves with holes between them."""
    image = np.full((size, size, 3), np.array(colour, np.float32) * 0.6, np.float32)
    alpha = np.zeros((size, size), np.uint8)
    count = int(420 * cover)
    for i in range(count):
        # Later leaves lie on top and are brighter.
        reach = 0.47 * size * np.sqrt(rng.random())
        around = rng.uniform(0, 2 * np.pi)
        centre = (int(size / 2 + reach * np.cos(around)), int(size / 2 + reach * np.sin(around)))
        axes = (int(size * rng.uniform(0.022, 0.045)), int(size * rng.uniform(0.012, 0.022)))
        angle = float(rng.uniform(0, 180))
        shade = (0.55 + 0.6 * i / count) * rng.uniform(0.75, 1.2)
        tone = np.array(colour) * shade * rng.uniform(0.88, 1.12, 3)
        cv2.ellipse(image, centre, axes, angle, 0, 360, tuple(float(c) for c in tone), -1)
        cv2.ellipse(alpha, centre, axes, angle, 0, 360, 255, -1)
    return with_alpha(to_bytes(image), alpha)


def bark(size: int, rng: np.random.Generator) -> Bytes:
    """Vertical furrows."""
    noise = fractal(size, rng, coarsest=8, octave_gain=0.9)
    furrows = cv2.resize(noise[: size // 8], (size, size), interpolation=cv2.INTER_LINEAR)
    return to_bytes(colourise(0.25 * np.asarray(furrows, np.float32) + 0.1 * noise, (92.0, 78.0, 66.0)))


def metal(size: int, rng: np.random.Generator) -> Bytes:
    """Painted metal with scratches, rust and stickers."""
    value = 0.05 * fractal(size, rng, coarsest=4, octave_gain=0.8)
    image = colourise(value, (125.0, 128.0, 130.0))
    for _ in range(26):
        x, y = rng.integers(0, size, 2)
        w, h = rng.integers(size // 40, size // 9, 2)
        tone = tuple(float(c) for c in rng.uniform(30, 235, 3))
        cv2.rectangle(image, (int(x), int(y)), (int(x + w), int(y + h)), tone, -1)
    image += 40 * spots(size, rng, count=60, radius_px=(2.0, 10.0), strength=1.0)[..., None]
    return to_bytes(image)


def write_text(image: Floats32, rng: np.random.Generator, *, box: tuple[int, int, int, int], letters: int) -> None:
    """Write random letters into the box x, y, width, height of a colour image, filling it."""
    x, y, width, height = box
    text = "".join(rng.choice(LETTERS, letters))
    font = int(rng.choice([cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_SIMPLEX]))
    thickness = max(1, height // 14)
    (w, h), _ = cv2.getTextSize(text, font, 1.0, thickness)
    scale = min(width * 0.9 / w, height * 0.7 / h)
    dark = image[y + height // 2, x + width // 2].mean() > 120
    tone = (rng.uniform(0, 70, 3) if dark else rng.uniform(170, 255, 3)).astype(np.float32)
    # OpenCV 5 writes into 8 bits only.
    ink = np.zeros((height, width), np.uint8)
    start = (int((width - w * scale) / 2), int((height + h * scale) / 2))
    cv2.putText(ink, text, start, font, scale, 255, thickness, cv2.LINE_AA)
    target = image[y : y + height, x : x + width]
    cover = ink[: target.shape[0], : target.shape[1], None].astype(np.float32) / 255
    target += cover * (tone - target)


def poster(size: int, rng: np.random.Generator) -> Bytes:
    """A board with blocks of colour, letters and small print."""
    image = np.full((size, size, 3), rng.uniform(60, 230, 3), np.float32)
    for _ in range(9):
        x, y = rng.integers(0, size, 2)
        w, h = rng.integers(size // 10, size // 2, 2)
        tone = tuple(float(c) for c in rng.uniform(10, 245, 3))
        if rng.random() < 0.5:
            cv2.rectangle(image, (int(x), int(y)), (int(x + w), int(y + h)), tone, -1)
        else:
            cv2.circle(image, (int(x), int(y)), int(w // 2), tone, -1)
    for row in range(4):
        write_text(image, rng, box=(8, row * size // 4 + 4, size - 16, size // 4 - 8), letters=int(rng.integers(3, 9)))
    cv2.rectangle(image, (0, 0), (size - 1, size - 1), (25.0, 25.0, 28.0), size // 32)
    # Print is less saturated than random numbers are.
    image = 0.65 * image + 0.35 * image.mean(2, keepdims=True)
    return to_bytes(image)


def car_side(rng: np.random.Generator) -> Bytes:
    """A car seen from its right, 512x256 for 4.4 m x 1.5 m, with holes around the silhouette; white where tinted."""
    image = np.full((256, 512, 3), 205.0, np.float32)
    alpha = np.zeros((256, 512), np.uint8)
    body = np.array(
        [[4, 214], [4, 140], [40, 116], [118, 104], [176, 20], [360, 16], [430, 104], [504, 128], [508, 214]]
    )
    cv2.fillPoly(alpha, [body], 255)
    image += 6 * np.cos(np.arange(256) / 14.0)[:, None, None].astype(np.float32)
    for window in ([[136, 104], [184, 32], [262, 30], [262, 104]], [[272, 104], [272, 30], [352, 30], [408, 104]]):
        cv2.fillPoly(image, [np.array(window)], (42.0, 50.0, 58.0))
        top = np.array(window)
        shine = top.mean(0) + np.array([[-30, 30], [10, -30], [26, -30], [-12, 30]])
        cv2.fillPoly(image, [shine.astype(np.int32)], (110.0, 122.0, 132.0))
    for x in (128, 266, 420):
        cv2.line(image, (x, 104), (x - 6, 206), (120.0, 120.0, 120.0), 2)
    for x in (236, 384):
        cv2.rectangle(image, (x, 118), (x + 22, 124), (70.0, 70.0, 70.0), -1)
    cv2.rectangle(image, (4, 196), (508, 216), (60.0, 60.0, 62.0), -1)
    cv2.rectangle(image, (6, 136), (30, 156), (150.0, 30.0, 25.0), -1)
    cv2.rectangle(image, (478, 132), (504, 150), (235.0, 235.0, 215.0), -1)
    for x in (100, 408):
        cv2.circle(alpha, (x, 210), 42, 255, -1)
        cv2.circle(image, (x, 210), 46, (24.0, 24.0, 25.0), -1)
        cv2.circle(image, (x, 210), 28, (165.0, 166.0, 170.0), -1)
        for k in range(5):
            a = 2 * np.pi * k / 5 + rng.uniform(0, 1)
            cv2.line(image, (x, 210), (int(x + 26 * np.cos(a)), int(210 + 26 * np.sin(a))), (60.0, 60.0, 64.0), 5)
    image *= 1 + 0.03 * fractal(512, rng, coarsest=16, octave_gain=0.8)[:256, :, None]
    return with_alpha(to_bytes(image), alpha)


def car_face(rng: np.random.Generator, *, front: bool) -> Bytes:
    """A car's front or back, 256x128, with lights, grille and number plate."""
    image = np.full((128, 256, 3), 200.0, np.float32)
    lamp = (240.0, 240.0, 220.0) if front else (170.0, 25.0, 22.0)
    for x in (8, 200):
        cv2.rectangle(image, (x, 22), (x + 48, 50), lamp, -1)
        cv2.circle(image, (x + 24, 36), 10, (120.0, 120.0, 120.0), -1)
    if front:
        cv2.rectangle(image, (66, 24), (190, 60), (30.0, 30.0, 32.0), -1)
        for y in range(28, 60, 6):
            cv2.line(image, (66, y), (190, y), (110.0, 110.0, 112.0), 1)
    cv2.rectangle(image, (0, 96), (256, 128), (48.0, 48.0, 50.0), -1)
    cv2.rectangle(image, (84, 68), (172, 90), (235.0, 235.0, 228.0), -1)
    write_text(image, rng, box=(86, 69, 84, 20), letters=7)
    image *= 1 + 0.03 * fractal(256, rng, coarsest=8, octave_gain=0.8)[:128, :, None]
    return to_bytes(image)


def glass(size: int, rng: np.random.Generator) -> Bytes:
    """A dark pane with reflections."""
    value = 0.25 * fractal(size, rng, coarsest=2, octave_gain=0.5)
    return to_bytes(colourise(value, (58.0, 68.0, 78.0)))


def truck_side(rng: np.random.Generator) -> Bytes:
    """A lorry's tarpaulin, 1024x512, with large letters, stripes and folds."""
    image = np.full((512, 1024, 3), rng.uniform(120, 225, 3), np.float32)
    for _ in range(14):
        x, y = rng.integers(0, [1024, 512])
        w, h = rng.integers(30, 260, 2)
        cv2.rectangle(image, (int(x), int(y)), (int(x + w), int(y + h)), tuple(rng.uniform(20, 240, 3).tolist()), -1)
    for row in range(3):
        write_text(image, rng, box=(20, 30 + 160 * row, 980, 140), letters=int(rng.integers(6, 11)))
    noise: Floats32 = fractal(1024, rng, coarsest=8, octave_gain=0.85)[:512]
    image *= (
        1 + 0.1 * noise[..., None] + spots(1024, rng, count=900, radius_px=(2.0, 14.0), strength=0.18)[:512, :, None]
    )
    return to_bytes(image)


def clouds(size: int, rng: np.random.Generator) -> Bytes:
    """Soft clouds: 0 is clear sky."""
    value = np.clip(fractal(size, rng, coarsest=4, octave_gain=0.5) * 0.6 - 0.1, 0, 1)
    return to_bytes(colourise(value - 1.0, (255.0, 255.0, 255.0)))


def skyline(rng: np.random.Generator) -> Bytes:
    """Far wooded hills with buildings, 1024x256, holes above."""
    image = np.zeros((256, 1024, 3), np.float32)
    alpha = np.zeros((256, 1024), np.uint8)
    noise = fractal(1024, rng, coarsest=8, octave_gain=0.8)
    ridge = 110 + 26 * noise[0] + 8 * noise[500]
    rows = np.arange(256)[:, None]
    alpha[rows > ridge[None]] = 255
    image[:] = colourise(0.2 * noise[:256], (84.0, 102.0, 84.0))
    for _ in range(34):
        x, w, h = int(rng.integers(0, 1000)), int(rng.integers(18, 60)), int(rng.integers(40, 150))
        tone = rng.uniform(90, 175) * np.array([1.0, 0.97, 0.94])
        cv2.rectangle(image, (x, 256 - h - 40), (x + w, 256), tuple(tone.tolist()), -1)
        cv2.rectangle(alpha, (x, 256 - h - 40), (x + w, 256), 255, -1)
        for wx in range(x + 3, x + w - 4, 7):
            for wy in range(256 - h - 34, 250, 9):
                shade = float(rng.uniform(40, 90))
                cv2.rectangle(image, (wx, wy), (wx + 3, wy + 4), (shade, shade, shade * 1.1), -1)
    return with_alpha(to_bytes(image), alpha)


def crack_decal(size: int, rng: np.random.Generator) -> Bytes:
    """A branching crack filled with tar, with holes around it."""
    alpha = np.zeros((size, size), np.uint8)
    for _ in range(int(rng.integers(2, 5))):
        steps = 14
        heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.5, steps))
        walk = size / 2 + np.cumsum(np.stack([np.cos(heading), np.sin(heading)], -1) * size / 22, 0)
        cv2.polylines(alpha, [np.round(walk).astype(np.int32)], False, 255, int(rng.integers(3, 7)))
    return with_alpha(to_bytes(colourise(0.2 * fractal(size, rng), (52.0, 51.0, 52.0))), alpha)


def patch_decal(size: int, rng: np.random.Generator) -> Bytes:
    """A mended piece of road or a stain: an irregular outline of another grey."""
    alpha = np.zeros((size, size), np.uint8)
    corners = int(rng.integers(5, 10))
    angle = np.sort(rng.uniform(0, 2 * np.pi, corners))
    outline = size / 2 + size * rng.uniform(0.28, 0.49, (corners, 1)) * np.stack([np.cos(angle), np.sin(angle)], -1)
    cv2.fillPoly(alpha, [np.round(outline).astype(np.int32)], 255)
    value = 0.1 * fractal(size, rng, octave_gain=0.9) + spots(size, rng, count=90, radius_px=(1.5, 8), strength=0.2)
    return with_alpha(to_bytes(colourise(value, np.full(3, rng.uniform(62, 150)))), alpha)


def manhole(size: int, rng: np.random.Generator) -> Bytes:
    """A round cast-iron cover with a pattern."""
    alpha = np.zeros((size, size), np.uint8)
    half = size // 2
    cv2.circle(alpha, (half, half), half - 2, 255, -1)
    image = colourise(0.1 * fractal(size, rng, octave_gain=0.9), (84.0, 80.0, 77.0))
    for radius in (0.95, 0.75, 0.4):
        cv2.circle(image, (half, half), int(half * radius), (38.0, 37.0, 36.0), max(2, size // 40))
    for k in range(12):
        a = 2 * np.pi * k / 12 + rng.uniform(0, 0.2)
        inner, outer = 0.45 * half, 0.72 * half
        start = (int(half + inner * np.cos(a)), int(half + inner * np.sin(a)))
        end = (int(half + outer * np.cos(a)), int(half + outer * np.sin(a)))
        cv2.line(image, start, end, (135.0, 132.0, 128.0), max(2, size // 28))
    return with_alpha(to_bytes(image), alpha)


def paint_line(size: int, rng: np.random.Generator) -> Bytes:
    """White road paint, worn through in places."""
    worn = fractal(size, rng, coarsest=8, octave_gain=0.9)
    image = colourise(0.06 * worn, (212.0, 212.0, 206.0))
    return with_alpha(to_bytes(image), worn < 1.25)
