"""Light, lenses and compression that change the images of a drive, and leave its geometry as it is."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from mrasfm_engine.types import Bytes
from tests.helpers.drive_variations import CameraVariation, ImageChange


def with_pixels(change: ImageChange) -> CameraVariation:
    """The same change of all images."""
    return lambda camera: change


def gamma(exponent: float) -> CameraVariation:
    """Another curve of brightness."""
    table = _bytes(255 * (np.arange(256) / 255) ** exponent)
    return with_pixels(lambda image: cv2.LUT(image, table))


def noise(sigma: float) -> CameraVariation:
    """White noise on every pixel, in grey levels."""

    def vary(camera: dict[str, Any]) -> ImageChange:
        rng = _rng(camera)
        return lambda image: _bytes(image + rng.normal(0.0, sigma, image.shape))

    return vary


def flicker(darkest: float, brightest: float) -> CameraVariation:
    """A brightness of its own for every image."""

    def vary(camera: dict[str, Any]) -> ImageChange:
        rng = _rng(camera)
        return lambda image: _bytes(image * rng.uniform(darkest, brightest))

    return vary


def night(brightness: float, sigma: float) -> CameraVariation:
    """Dark images with crushed shadows, and noise in grey levels."""

    def vary(camera: dict[str, Any]) -> ImageChange:
        rng = _rng(camera)
        return lambda image: _bytes(255 * brightness * (image / 255) ** 2.2 + rng.normal(0.0, sigma, image.shape))

    return vary


def jpeg(quality: int) -> CameraVariation:
    """Images that were compressed."""

    def change(image: Bytes) -> Bytes:
        _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED), dtype=np.uint8)

    return with_pixels(change)


def blurred(sigma_px: float) -> CameraVariation:
    """A lens out of focus."""
    return with_pixels(lambda image: cv2.GaussianBlur(image, None, sigma_px))


def dirt(camera: dict[str, Any]) -> ImageChange:
    """Two spots on the lens that hide a fifth of the image or less."""

    def change(image: Bytes) -> Bytes:
        spotted, (height, width) = image.copy(), image.shape[:2]
        for x, y, radius, grey in ((0.3, 0.4, 0.22, 40), (0.75, 0.7, 0.15, 22)):
            center = int(x * width), int(y * height)
            cv2.circle(spotted, center, int(radius * height), (grey,) * 3, cv2.FILLED)
        return spotted

    return change


def glare(camera: dict[str, Any]) -> ImageChange:
    """A low sun beside the middle of the image: all of it loses contrast, around the sun it is white."""
    height, width = camera["height"], camera["width"]
    y, x = np.mgrid[:height, :width]
    sun = 255 * np.exp(-(((x / width - 0.6) / 0.25) ** 2) - ((y / height - 0.3) / 0.5) ** 2)
    return lambda image: _bytes(0.8 * image + (sun[..., None] if image.ndim == 3 else sun))


def _rng(camera: dict[str, Any]) -> np.random.Generator:
    """Random numbers of one camera: another camera with the same noise would see the same points at infinity."""
    return np.random.default_rng(list(camera["name"].encode()))


def _bytes(values: ArrayLike) -> Bytes:
    return np.clip(np.round(values), 0, 255).astype(np.uint8)
