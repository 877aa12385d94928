"""Row bands: the times at which images were taken. Cameras of a unit need not be simultaneous, nor rows of an image.

A row band is some rows of one image that share one pose: the vehicle hardly moves within its exposure. Where a camera
reads columns they take the place of rows. An image without a declared readout time is one row band, and then row bands
and images have the same numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.types import Floats, Ints
from schemas import Camera
from schemas.drive import ReadoutDirection

MAX_BAND_S = 0.5e-3  # at 15 m/s a car goes 7 mm in that time
MAX_BANDS = 65  # an image, which makes 33 ms of bands that short


@dataclass(frozen=True, kw_only=True)
class RowBands:
    """All row bands of a drive, by image and then from the first row to the last."""

    image: Ints  # (s,) index into Drive.images
    unit: Ints  # (s,)
    camera: Ints  # (s,)
    time_offset_s: Floats  # (s,) when the row band's middle row was taken, from its unit's timestamp on
    first_of_image: Ints  # (images + 1,) row bands of image i: first[i]:first[i + 1]
    readout: Floats  # (cameras, 3) see `readout_share`
    times_vary: bool  # a camera may have a time offset, which moves its row bands from their unit's timestamp

    @staticmethod
    def from_drive(drive: Drive, *, compensate: bool = True) -> RowBands:
        """The row bands of a drive. Without `compensate` all are taken as if at their unit's timestamp."""
        bands = np.array([_bands(camera.readout_us) if compensate else 1 for camera in drive.cameras], dtype=np.int64)
        readout_s = np.array([(camera.readout_us or 0) / 1e6 for camera in drive.cameras])
        camera_of_image = np.array([image.camera for image in drive.images], dtype=np.int64)
        unit_of_image = np.array([image.unit for image in drive.images], dtype=np.int64)
        first = np.concatenate([[0], np.cumsum(bands[camera_of_image])]).astype(np.int64)
        image = np.repeat(np.arange(len(drive.images), dtype=np.int64), bands[camera_of_image])
        offset_s = np.zeros(len(image))
        if compensate:
            taken_us = np.array([i.timestamp_us for i in drive.images], dtype=np.int64)
            of_image_s = (taken_us - drive.timestamps_us[unit_of_image]) / 1e6
            camera = camera_of_image[image]
            # An image's timestamp is that of its middle row; the number of bands is odd, so one of them is there.
            place = (np.arange(len(image)) - first[image] + 0.5) / bands[camera] - 0.5
            offset_s = of_image_s[image] + place * readout_s[camera]
            if np.abs(offset_s).max(initial=0.0) <= MAX_BAND_S:
                offset_s[:] = 0.0  # clocks that jitter are no motion
        return RowBands(
            image=image,
            unit=unit_of_image[image],
            camera=camera_of_image[image],
            time_offset_s=offset_s,
            first_of_image=first,
            readout=np.stack([readout_share(camera) for camera in drive.cameras]),
            times_vary=compensate and any(camera.sigma_time_offset_us is not None for camera in drive.cameras),
        )

    def __len__(self) -> int:
        return len(self.image)

    @property
    def simultaneous(self) -> bool:
        """Every row band is at its unit's timestamp, and stays there."""
        return not self.times_vary and not self.time_offset_s.any()

    @property
    def middle_of_image(self) -> Ints:
        """The row band (images,) that is at its image's timestamp."""
        result: Ints = (self.first_of_image[:-1] + self.first_of_image[1:]) // 2
        return result

    def of_pixels(self, image: Ints, xy_px: Floats) -> Ints:
        """The row bands (n,) that keypoints at xy_px (n, 2) of images (n,) belong to."""
        first, count = self.first_of_image[image], np.diff(self.first_of_image)[image]
        camera = self.camera[first] if len(first) else first
        readout = self.readout[camera]
        share = (readout[:, :2] * xy_px).sum(1) + readout[:, 2]
        band = np.floor(share * count).astype(np.int64)
        result: Ints = first + np.clip(band, 0, count - 1)
        return result


def readout_share(camera: Camera) -> Floats:
    """Weights (3,) of x, y (px) and 1 whose sum is the share of the image that was read before a pixel: 0 to 1."""
    width, height = float(camera.width), float(camera.height)
    weights = {
        ReadoutDirection.TOP_TO_BOTTOM: [0.0, 1.0 / height, 0.0],
        ReadoutDirection.BOTTOM_TO_TOP: [0.0, -1.0 / height, 1.0],
        ReadoutDirection.LEFT_TO_RIGHT: [1.0 / width, 0.0, 0.0],
        ReadoutDirection.RIGHT_TO_LEFT: [-1.0 / width, 0.0, 1.0],
    }
    return np.array(weights[camera.readout_direction or ReadoutDirection.TOP_TO_BOTTOM])


def _bands(readout_us: int | None) -> int:
    """An odd number of bands of at most MAX_BAND_S, as far as MAX_BANDS allows."""
    needed = math.ceil((readout_us or 0) / 1e6 / MAX_BAND_S)
    return min(MAX_BANDS, max(1, needed + 1 - needed % 2))
