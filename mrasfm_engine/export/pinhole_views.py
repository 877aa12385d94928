"""Pinhole views of cameras: where an image is looked up to undo its distortion.

A view has square pixels (but for the rounding of its size) and its principal point in its middle, which 3DGS takes for
granted. A camera with a usual field has one view, along its axis. A wide one has two, turned to its left and right:
one plane would stretch its border beyond use, and cannot hold 180 degrees. A view has as many pixels as the part of
the image that it shows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import (
    PERSPECTIVE,
    largest_angle_rad,
    pack_camera,
    project_points,
    unproject_pixels,
)
from mrasfm_engine.types import Bools, Floats, Floats32
from schemas import Camera

ONE_VIEW_DEG = 55.0  # half of the field up to which one view shows all of it
WIDEST_DEG = 100.0  # half of the field that two views show
OVERLAP_DEG = 10.0  # of two views
HIGHEST_DEG = 50.0  # half of a view's vertical field
KEPT = 0.8  # of the image's extent that a view without blank pixels must show; else it has some, which are masked
GRID = 65  # rays across and down a view that its resolution is found from
BORDER = 129  # pixels along each border of the image that its extent is found from
SIDES = ("left", "right")


@dataclass(frozen=True, kw_only=True)
class PinholeView:
    """A view of a camera.

    Attributes
    ----------
    side
        "left" or "right" of a camera with two views, else empty.
    cam_from_view
        Rotation (3, 3).
    width, height
        Size in pixels of the undistorted image, and `full_width`, `full_height` before it is scaled down.
    focal_px
        Focal length before the image is scaled down.
    """

    side: str
    cam_from_view: Floats
    full_width: int
    full_height: int
    focal_px: float
    width: int
    height: int

    @property
    def params(self) -> list[float]:
        """fx, fy, cx, cy of the image as it is written."""
        fx, fy = self.focal_px * self.width / self.full_width, self.focal_px * self.height / self.full_height
        return [fx, fy, 0.5 * self.width, 0.5 * self.height]

    def pixels(self, rays_cam: Floats) -> tuple[Floats, Bools]:
        """Pixels (n, 2) of rays (n, 3) in the camera's axes, and which of them the view shows."""
        rays = rays_cam @ self.cam_from_view
        fx, fy, cx, cy = self.params
        ahead = rays[:, 2] > 1e-6
        plane = rays[:, :2] / np.where(ahead, rays[:, 2], 1.0)[:, None]
        pixels = plane * [fx, fy] + [cx, cy]
        return pixels, ahead & ((pixels > 0.0) & (pixels < [self.width, self.height])).all(axis=1)

    def lookup(self, camera: Camera, params: Floats) -> tuple[Floats32, Bools]:
        """Places (h, w, 2) in the image, as OpenCV counts, of the view's pixels at full size, and which are in it."""
        v, u = np.mgrid[0 : self.full_height, 0 : self.full_width] + 0.5
        plane = np.stack([u - 0.5 * self.full_width, v - 0.5 * self.full_height], -1).reshape(-1, 2) / self.focal_px
        places = _project(camera, params, plane, self.cam_from_view)
        inside = ((places >= 0.0) & (places <= [camera.width, camera.height])).all(axis=1)
        places = np.where(np.isfinite(places), places - 0.5, -1.0)
        shape = (self.full_height, self.full_width)
        return places.reshape(*shape, 2).astype(np.float32), inside.reshape(shape)


def pinhole_views(camera: Camera, params: Floats, image_size_px: int | None) -> list[PinholeView]:
    """The views of a camera with parameters as COLMAP orders them.

    Parameters
    ----------
    image_size_px
        Longest side that views are scaled down to.
    """
    kind, packed = pack_camera(camera.model, params)
    limit = largest_angle_rad(packed)
    left, right, up, down = _half_fields_rad(camera, params)
    half = min(max(left, right), limit)
    if half <= math.radians(ONE_VIEW_DEG):
        plane = _one_view_extent(camera, params, limit) if kind != PERSPECTIVE else _pinhole_extent(packed, camera)
        return [_view(camera, params, "", np.eye(3), plane, image_size_px)]
    half = min(half, math.radians(WIDEST_DEG))
    overlap = math.radians(OVERLAP_DEG)
    yaw, across = 0.5 * (half - 0.5 * overlap), 0.5 * (half + 0.5 * overlap)
    vertical = min(max(up, down), math.radians(HIGHEST_DEG))
    extent = (math.tan(across), math.tan(vertical))
    return [
        _view(camera, params, side, se3.exp_so3([0.0, turn, 0.0]), extent, image_size_px)
        for side, turn in zip(SIDES, (-yaw, yaw), strict=True)
    ]


def _half_fields_rad(camera: Camera, params: Floats) -> tuple[float, float, float, float]:
    """Angles from the axis, left, right, up and down, at which the image ends."""
    kind, packed = pack_camera(camera.model, params)
    cx, cy = packed[2], packed[3]
    ends = np.array([[0.0, cy], [camera.width, cy], [cx, 0.0], [cx, camera.height]])
    rays = unproject_pixels(kind, packed, ends)
    angles = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    left, right, up, down = angles.tolist()
    return left, right, up, down


def _pinhole_extent(packed: Floats, camera: Camera) -> tuple[float, float]:
    fx, fy, cx, cy = packed[:4].tolist()
    ends = ((cx / fx, (camera.width - cx) / fx), (cy / fy, (camera.height - cy) / fy))
    across, down = (_kept(min(two), max(two)) for two in ends)
    return across, down


def _one_view_extent(camera: Camera, params: Floats, limit_rad: float) -> tuple[float, float]:
    """Half of the width and height, in the plane at distance 1, of what one view shows.

    Without blank pixels, as far as the image's nearest border reaches; as far as its farthest where that would lose too
    much.
    """
    kind, packed = pack_camera(camera.model, params)
    t = np.linspace(0.0, 1.0, BORDER)
    extents = []
    for axis, (side, other) in enumerate(((camera.width, camera.height), (camera.height, camera.width))):
        near, far = [], []
        for end in (0.0, float(side)):
            pixels = np.empty((BORDER, 2))
            pixels[:, axis], pixels[:, 1 - axis] = end, t * other
            rays = unproject_pixels(kind, packed, pixels)
            # Behind the plane or beyond the limit, a border says no more than the limit does.
            widest = math.tan(min(limit_rad, math.radians(ONE_VIEW_DEG)))
            reach = np.where(rays[:, 2] > 1e-3, np.abs(rays[:, axis]) / np.maximum(rays[:, 2], 1e-3), widest)
            near.append(min(float(reach.min()), widest))
            far.append(min(float(reach.max()), widest))
        extents.append(_kept(min(near), max(far)))
    return extents[0], extents[1]


def _kept(nearest: float, farthest: float) -> float:
    return nearest if nearest >= KEPT * farthest else farthest


def _view(
    camera: Camera,
    params: Floats,
    side: str,
    cam_from_view: Floats,
    extent: tuple[float, float],
    image_size_px: int | None,
) -> PinholeView:
    focal = _focal_px(camera, params, cam_from_view, extent)
    full = [max(2, math.floor(2.0 * focal * half + 1e-6)) for half in extent]
    scale = 1.0 if image_size_px is None else min(1.0, image_size_px / max(full))
    width, height = (max(1, round(scale * size)) for size in full)
    return PinholeView(
        side=side,
        cam_from_view=cam_from_view,
        full_width=full[0],
        full_height=full[1],
        focal_px=focal,
        width=width,
        height=height,
    )


def _focal_px(camera: Camera, params: Floats, cam_from_view: Floats, extent: tuple[float, float]) -> float:
    """Focal length with which a view has as many pixels as the part of the image that it shows."""
    x, y = (np.linspace(-half, half, GRID) for half in extent)
    plane = np.stack(np.meshgrid(x, y), -1)
    places = _project(camera, params, plane.reshape(-1, 2), cam_from_view).reshape(GRID, GRID, 2)
    along: Floats = np.asarray(np.gradient(places, x, axis=1))
    down: Floats = np.asarray(np.gradient(places, y, axis=0))
    area = np.abs(along[..., 0] * down[..., 1] - along[..., 1] * down[..., 0])
    inside = ((places >= 0.0) & (places <= [camera.width, camera.height])).all(axis=2) & np.isfinite(area)
    if not inside.any():
        raise ValueError(f"camera {camera.name} shows nothing")
    return float(np.sqrt(area[inside].mean()))


def _project(camera: Camera, params: Floats, plane: Floats, cam_from_view: Floats) -> Floats:
    """Pixels (n, 2) of the camera for places (n, 2) in a view's plane at distance 1, NaN where it shows none."""
    rays = np.column_stack([plane, np.ones(len(plane))]) @ cam_from_view.T
    return project_points(*pack_camera(camera.model, params), rays)
