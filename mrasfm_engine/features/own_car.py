"""The vehicle's own bonnet, boot lid or roof in its cameras' images, found from what stays while the vehicle moves.

An edge of the vehicle stays at its pixel, and what moves blurs out in the mean of many images. So the share of a
pixel's gradient that is the same in all of them tells edges that stay, whatever their contrast. Edges of the world stay
as well where they point along the motion (kerbs, lane markings) or are far away. On rays that fall steeply enough the
ground is near, and there an edge across the motion cannot stay: only such edges are evidence. The vehicle is what lies
between the image's lower border and an outline of edges that stay, if enough of the outline is evidence. Asphalt, sky
and vignetting are uniform but have no such outline.

Pixels whose value never changes, at the border of an image (black borders, bars with a time), count as the own car too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from enum import StrEnum
from itertools import chain, islice, pairwise

import cv2
import numpy as np

from mrasfm_engine.errors import CancelledError
from mrasfm_engine.even_choice import nearest_even_choice
from mrasfm_engine.features.static_outline import RESOLUTION, RIM_PX, StaticEdges, gradients_of, trace_outline
from mrasfm_engine.geometry.camera_model import pack_camera, project_points, unproject_pixels
from mrasfm_engine.io.image_decoding import IncompleteImageError
from mrasfm_engine.io.images import read_image_small
from mrasfm_engine.parallel import in_order
from mrasfm_engine.scene.drive import Drive, DriveImage
from mrasfm_engine.types import Bools, Bytes, Cancel, Floats, Floats32, Ints
from schemas.findings import Finding, warning

WIDTH_PX = 480  # of the images looked at: an outline is then true to a thousandth of the width
MAX_PIXELS = WIDTH_PX * 960  # of one of them: twice as high as wide
MAX_IMAGES = 64  # of a camera that are read: more hardly sharpen a mean
# Of a camera that differ. The mean of n gradients that have nothing in common keeps 1/n of their energy: of fewer
# images that is as much as an edge keeps whose contrast varies.
MIN_IMAGES = 12
# An image counts as another one if a quarter of its pixels with contrast changed by what one pixel's shift changes. So
# far the image moves where the vehicle moves; passing traffic does it too, but not in most cameras at the same time.
MOVED_PX, MOVING_QUANTILE = 1.0, 0.75
COARSE_PX = 2.0  # sigma, so that noise is no change
# Of the way, in each of which the car is seen: a lorry in the next lane comes and goes.
PARTS = 4
SMOOTHING_PX = 0.8  # sigma against noise and compression, before gradients
FINE_PX = 2.5  # sigma of the detail whose change tells moving surfaces
DARK = 8.0  # grey levels, about the noise of dark pixels: detail is relative to brightness above it

# Sine of how steeply a ray must fall: ground that is seen 10 degrees below the horizon from 1.5 m is 8.5 m away, so
# that it passes within the way of a few images, and traffic keeps farther away than that.
MIN_FALL = 0.17
# Evidence along the outline. Where a camera looks along the motion, half of the length of a curved outline is across
# it, and its contrast varies: a tenth remains with few images. What follows kerbs and noise has none on average.
MIN_EVIDENCE_SHARE = 1 / 20
MIN_EVIDENCE_PX = WIDTH_PX / 20  # less than this of an outline can be dirt or one thing that moves along

JPEG_BLOCK_PX = 16  # side of a block with subsampled colours
SURROUND_LEVELS = 24  # grey levels that stray light and compression leave of black
CONSTANT_LEVELS = 2  # change of a value that rounding and compression alone explain
MIN_CONSTANT_SHARE = 0.002  # of an image; less is not worth a mask
MIN_BORDER_EDGE = 0.5  # of the outline of constant pixels; that of a black or saturated sky moves
LARGE_SHARE = 1 / 3  # of an image; bonnets and boot lids fill a quarter of one and less
MARGIN_SHARE = 0.004  # of an image's width around the mask, in which keypoints still depend on the outline


class NotFound(StrEnum):
    """Reason for a camera without a mask of the own car."""

    NO_MOTION = "too few images that differ: the vehicle hardly moves, or too little is seen"
    NOT_SEEN = "nothing stays while the vehicle moves"


@dataclass(frozen=True, kw_only=True)
class OwnCar:
    """Result of the search in one camera."""

    mask: Bools | None  # (h, w) at the camera's full size; None: nothing found
    reason: NotFound | None  # where there is no mask
    images: int  # that were compared

    @property
    def share(self) -> float:
        """Share of the image that shows the own car."""
        return 0.0 if self.mask is None else float(self.mask.mean())

    def report(self) -> dict[str, object]:
        """The entry of `report.json`."""
        found = {"reason": str(self.reason)} if self.mask is None else {"share": round(self.share, 4)}
        return {**found, "images_compared": self.images}


def find_own_cars(drive: Drive, *, threads: int, cancel: Cancel | None = None) -> list[OwnCar]:
    """Look for the own car in a sample of the units' images.

    Parameters
    ----------
    cancel
        Asked before every image.

    Returns
    -------
    list of OwnCar
        By camera, in the rig's order.

    Raises
    ------
    InputError
        Where an image cannot be read at all.
    CancelledError
        Where `cancel` answers True.
    """
    statistics = [_Statistics() for _ in drive.cameras]
    if len(drive.manifest.frames) < MIN_IMAGES:
        return [OwnCar(mask=None, reason=NotFound.NO_MOTION, images=0) for _ in drive.cameras]
    images_of: dict[int, list[DriveImage]] = {}
    for image in drive.images:
        images_of.setdefault(image.unit, []).append(image)
    units = sorted(images_of)

    def look(image: DriveImage) -> tuple[Bytes, Floats32] | None:
        if cancel is not None and cancel():
            raise CancelledError
        camera = drive.cameras[image.camera]
        width_px = small_width_px(camera.width, camera.height)
        try:
            small = read_image_small(drive.path_of(image.file), (camera.width, camera.height), width_px)
        except IncompleteImageError:
            return None
        return None if small is None else (small, _outlines(small))

    sampled = nearest_even_choice(len(units), MAX_IMAGES)
    groups = [images_of[units[index]] for index in sampled.tolist()]
    with (
        closing(in_order(threads, look, chain.from_iterable(groups))) as found,
        ThreadPoolExecutor(threads) as pool,
    ):
        for images in groups:
            # An image of another size than its camera's is refused by name when features are extracted.
            looks = [
                (statistics[image.camera], *small)
                for image, small in zip(images, islice(found, len(images)), strict=True)
                if small is not None
            ]
            if _vehicle_moved(pool, looks):
                list(pool.map(lambda of_one: of_one[0].add(*of_one[1:]), looks))
        return list(pool.map(lambda camera: _judge(drive, camera, statistics[camera]), range(len(statistics))))


def small_width_px(width: int, height: int) -> int:
    """Width of the image looked at: `WIDTH_PX` at most, and less where it would have more than `MAX_PIXELS`."""
    return max(1, min(WIDTH_PX, math.floor(math.sqrt(MAX_PIXELS * width / height))))


def large_share_finding(camera: str, mask: Bools | None) -> list[Finding]:
    """Warn if a camera sees little but the own car."""
    share = 0.0 if mask is None else float(mask.mean())
    if share <= LARGE_SHARE:
        return []
    return [
        warning(
            "own-car-large",
            f"{share:.0%} of the area of every image of camera {camera} stays while the vehicle moves and is left out",
            f"Look at own_car/{camera}.png of the scene; if it covers more than the vehicle itself, set "
            "`own_car = false` under [features] and give masks.",
        )
    ]


def _vehicle_moved(pool: Executor, looks: Sequence[tuple[_Statistics, Bytes, Floats32]]) -> bool:
    """Return whether most cameras that compare show other outlines (h, w) than when images last counted."""
    compared = [(of_camera.last, outlines) for of_camera, _, outlines in looks if of_camera.last is not None]
    return 2 * sum(pool.map(lambda both: _moved(*both), compared)) >= len(compared)


def _judge(drive: Drive, camera: int, statistics: _Statistics) -> OwnCar:
    count = statistics.count
    if count < MIN_IMAGES:
        return OwnCar(mask=None, reason=NotFound.NO_MOTION, images=count)
    small_mask = _static_region(drive, camera, statistics)
    if not small_mask.any():
        return OwnCar(mask=None, reason=NotFound.NOT_SEEN, images=count)
    size = (drive.cameras[camera].width, drive.cameras[camera].height)
    mask = cv2.resize(small_mask.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) > 0.5
    return OwnCar(mask=mask, reason=None, images=count)


def with_margin(mask: Bools) -> Bools:
    """The mask (h, w) and the pixels around it whose keypoints would depend on its outline."""
    return _near(mask, max(1, round(MARGIN_SHARE * mask.shape[1])))


def _near(mask: Bools, margin_px: int) -> Bools:
    side = 2 * margin_px + 1
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


class _Statistics:
    """Sums over one camera's small images."""

    def __init__(self) -> None:
        self.count = 0
        self.last: Floats32 | None = None  # outlines of the last image
        self._parts: list[Floats32] = []  # sums of gradients over consecutive images
        self._images_in_part = 1

    def add(self, image: Bytes, outlines: Floats32) -> None:
        """Count an image (h, w, 3) with its outlines (h, w)."""
        smooth = _smoothed(image, SMOOTHING_PX)
        gradient = gradients_of(smooth)
        detail = (smooth - _smoothed(image, FINE_PX)) / (smooth + DARK)
        energy = _channel_sum(gradient[0] ** 2 + gradient[1] ** 2)
        if self.count == 0:
            self._energy = energy
            self._detail, self._detail_squared = (np.zeros((2, *detail.shape), np.float32) for _ in range(2))
            self._lowest, self._highest = image.copy(), image.copy()
        else:
            self._energy += energy
            np.minimum(self._lowest, image, out=self._lowest)
            np.maximum(self._highest, image, out=self._highest)
        half = self.count % 2
        self._detail[half] += detail
        self._detail_squared[half] += detail**2
        self._add_to_part(gradient)
        self.last = outlines
        self.count += 1

    def _add_to_part(self, gradient: Floats32) -> None:
        """Keep sums over parts of equally many images; where there are too many parts, neighbours are joined."""
        if self.count % self._images_in_part == 0:
            if len(self._parts) == 2 * PARTS:
                self._parts = [a + b for a, b in zip(self._parts[::2], self._parts[1::2], strict=True)]
                self._images_in_part *= 2
            self._parts.append(np.zeros_like(gradient))
        self._parts[-1] += gradient

    @property
    def gradients(self) -> Floats32:
        """Mean gradients (parts, 2, h, w, 3) along x and y of consecutive parts of the way, in grey levels per pixel.

        They are weighted so that their mean is that of all images.
        """
        bounds = np.linspace(0, len(self._parts), PARTS + 1).round().astype(int)
        sums = [sum(self._parts[a:b], np.float32(0)) for a, b in pairwise(bounds)]
        return np.asarray(np.stack(sums) * (PARTS / self.count), dtype=np.float32)

    @property
    def energy(self) -> Floats32:
        """Mean square (h, w) of the gradient over all channels."""
        return np.asarray(self._energy / self.count, dtype=np.float32)

    @property
    def changes(self) -> Floats32:
        """Standard deviations (2, h, w) over time of each pixel's fine detail, relative to its brightness.

        The first is that of every other image, the second that of those between.
        """
        counts = np.array([(self.count + 1) // 2, self.count // 2])[:, None, None, None]
        variance = np.maximum(self._detail_squared / counts - (self._detail / counts) ** 2, 0.0).mean(-1)
        return np.asarray(np.sqrt(variance), dtype=np.float32)

    @property
    def dark(self) -> Bools:
        """Pixels (h, w) that are never brighter than the surroundings of an image circle."""
        return np.asarray(self._highest.max(-1) <= SURROUND_LEVELS)

    @property
    def constant(self) -> Bools:
        """Pixels (h, w) that never change and are not saturated."""
        spread = self._highest.astype(np.int16) - self._lowest
        return np.asarray((spread.max(-1) <= CONSTANT_LEVELS) & (self._lowest.min(-1) < 255 - CONSTANT_LEVELS))


def _smoothed(image: Bytes | Floats32, sigma_px: float) -> Floats32:
    return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma_px), dtype=np.float32)


def _outlines(image: Bytes) -> Floats32:
    """An image (h, w, 3) in grey without noise and fine detail."""
    return _smoothed(_channel_sum(image.astype(np.float32)) / np.float32(3), COARSE_PX)


def _channel_sum(values: Floats32) -> Floats32:
    """Sum (h, w) over the channels of (h, w, 3); NumPy's own over a short last axis takes ten times as long."""
    return np.asarray(cv2.transform(values, np.ones((1, 3), np.float32)), dtype=np.float32)


def _moved(before: Floats32, after: Floats32) -> bool:
    """Return whether much of what two images (h, w) show is at other pixels."""
    along_x, along_y = np.abs(np.diff(after, axis=1))[:-1], np.abs(np.diff(after, axis=0))[:, :-1]
    contrast = np.maximum(along_x, along_y)
    detailed = contrast > max(float(np.median(contrast)), RESOLUTION)
    if not detailed.any():
        return False
    change = after - before
    change = np.abs(change - np.median(change))[:-1, :-1]  # without the change of the exposure
    return float(np.quantile(change[detailed] / contrast[detailed], MOVING_QUANTILE)) > MOVED_PX


def _static_region(drive: Drive, camera: int, statistics: _Statistics) -> Bools:
    """Pixels (h, w) of the small images that show the own car or never change."""
    fall, flow, side = _world_motion(drive, camera, statistics.energy.shape)
    edges = StaticEdges.from_sums(
        statistics.gradients, statistics.energy, statistics.changes, statistics.count, fall=fall, flow=flow
    )
    block_px = math.ceil(JPEG_BLOCK_PX * fall.shape[1] / drive.cameras[camera].width)
    # The dark around an image circle is no part of a sky that it touches, and its rim, which stays, none of the car.
    surround = _constant_border(statistics.constant & statistics.dark, edges.edge, block_px)
    other = _constant_border(statistics.constant & ~statistics.dark, edges.edge, block_px)
    result = surround | other
    for part in trace_outline(edges.without(_near(surround, block_px + RIM_PX)).turned(side)):
        if part.evidence_px >= MIN_EVIDENCE_PX and part.evidence_share >= MIN_EVIDENCE_SHARE:
            result = result | np.rot90(part.mask, -side)
    return np.ascontiguousarray(result)


def _world_motion(drive: Drive, camera: int, shape: tuple[int, ...]) -> tuple[Floats, Floats, int]:
    """Fall of the rays of a camera and motion of its image, if the vehicle goes straight on.

    Returns
    -------
    fall
        By how much (sine) each pixel's ray (h, w) falls below the horizon, beyond `MIN_FALL`.
    flow
        Unit vectors (h, w, 2) along which the image of anything at rest moves.
    side
        Quarter turns counterclockwise that bring the ground to the image's lower border.
    """
    height, width = shape
    given = drive.cameras[camera]
    kind, params = pack_camera(given.model, given.params)
    scale = given.width / width
    pixels = (np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 2) + 0.5) * scale
    rays = unproject_pixels(kind, params, pixels)
    forward, up = drive.rig_from_cam[camera][0, :3], drive.rig_from_cam[camera][2, :3]
    step = 1e-3  # of the distance: the direction is that at the pixel itself
    flow = project_points(kind, params, rays + step * forward) - project_points(kind, params, rays - step * forward)
    flow /= np.maximum(np.linalg.norm(flow, axis=1, keepdims=True), 1e-12)
    flow[~np.isfinite(flow).all(1)] = 0.0
    ways_up = {0: -up[1], 1: up[0], 2: up[1], 3: -up[0]}
    side = max(ways_up, key=lambda turns: ways_up[turns])
    return (-(rays @ up) - MIN_FALL).reshape(height, width), flow.reshape(height, width, 2), side


def _constant_border(constant: Bools, edge: Floats32, block_px: int) -> Bools:
    """Areas (h, w) of constant pixels that reach the image's border and that an edge separates from the rest.

    Compression mixes a block of `block_px` at the edge with the rest, so that the areas are grown to the edge.
    """
    height, width = constant.shape
    # What is written in a bar may change.
    window = cv2.getStructuringElement(cv2.MORPH_RECT, (width // 20 * 2 + 1, height // 20 * 2 + 1))
    pad = max(window.shape)
    padded = cv2.copyMakeBorder(constant.astype(np.uint8), pad, pad, pad, pad, cv2.BORDER_REPLICATE)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, window)[pad:-pad, pad:-pad]
    labels = cv2.connectedComponents(closed, connectivity=4)[1]
    border = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    result = np.zeros(constant.shape, np.bool_)
    block = np.ones((2 * block_px + 1, 2 * block_px + 1), np.uint8)
    near = cv2.dilate(edge, block)
    for label in _present(border):
        area = labels == label
        outline = cv2.dilate(area.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.bool_) & ~area
        is_whole = constant[area].mean() > 0.5
        if is_whole and area.mean() > MIN_CONSTANT_SHARE and outline.any() and near[outline].mean() > MIN_BORDER_EDGE:
            result |= area
    grown = (cv2.dilate(result.astype(np.uint8), block) > 0) & (edge > MIN_BORDER_EDGE)
    return np.asarray(cv2.morphologyEx((result | grown).astype(np.uint8), cv2.MORPH_CLOSE, block) > 0)


def _present(labels: Ints | Bytes) -> Sequence[int]:
    return [int(label) for label in np.unique(labels) if label]
