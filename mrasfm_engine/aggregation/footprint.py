"""Overlap of images' footprints on the ground: images of two scenes that may show the same.

A camera's footprint is the part of the ground that it sees within some depth, from the rig at its usual height. The
camera's pose and calibration give the homography from the ground to the image; it is applied to a few points of every
footprint. For a camera that sees no ground, points at the height of its optical axis stand in.
"""

from __future__ import annotations

import numpy as np

from mrasfm_engine.aggregation.source import SourceScene
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_cameras, unproject_pixels
from mrasfm_engine.geometry.frustum import mutual_overlap
from mrasfm_engine.types import Floats, Ints

GRID = (5, 6)  # rays across and down an image
RANGES = (0.15, 0.35, 0.65, 1.0)  # of the depth, along rays that do not meet the ground before it ends
GROUND_BELOW_M = 4.0  # no vehicle carries its rig's origin higher
NEAR_M = 6.0  # points this near to the trajectory give the ground's height
MIN_GROUND_POINTS = 30


def rig_height_m(scene: SourceScene) -> float:
    """Height of the rig's origin above the ground, from the lowest points near the trajectory; zero without any."""
    known = np.flatnonzero(scene.unit_registered)
    heights = []
    for unit in known[:: max(1, len(known) // 12)]:
        local = se3.apply(se3.inverse(scene.world_from_rig[unit]), scene.points_m)
        near = (np.hypot(local[:, 0], local[:, 1]) < NEAR_M) & (local[:, 2] > -GROUND_BELOW_M) & (local[:, 2] < 1.0)
        if near.sum() >= MIN_GROUND_POINTS:
            heights.append(-float(np.percentile(local[near, 2], 15)))
    return float(np.median(heights)) if heights else 0.0


def footprints(scene: SourceScene, max_depth_m: float) -> Floats:
    """Points (cameras, s, 3) of every camera's footprint, in its own axes."""
    if max_depth_m not in scene.footprints:
        scene.footprints[max_depth_m] = _footprints(scene, max_depth_m)
    return scene.footprints[max_depth_m]


def _footprints(scene: SourceScene, max_depth_m: float) -> Floats:
    height = rig_height_m(scene)
    kind, params = pack_cameras(scene.drive.cameras)
    return np.stack(
        [
            _footprint(int(k), p, (c.width, c.height), rig_from_cam, height, max_depth_m)
            for k, p, c, rig_from_cam in zip(kind, params, scene.drive.cameras, scene.drive.rig_from_cam, strict=True)
        ]
    )


def _footprint(
    kind: int, params: Floats, size: tuple[int, int], rig_from_cam: Floats, height_m: float, max_depth_m: float
) -> Floats:
    u, v = ((np.arange(n) + 0.5) / n * side for n, side in zip(GRID, size, strict=True))
    rays = unproject_pixels(kind, params, np.stack(np.meshgrid(u, v), -1).reshape(-1, 2))
    turned = rays @ rig_from_cam[:3, :3].T
    above = rig_from_cam[2, 3] + height_m
    # Along each ray: to the ground, or to the end of sight.
    with np.errstate(divide="ignore"):
        reach = np.where(turned[:, 2] < -1e-3, -above / np.minimum(turned[:, 2], -1e-3), np.inf)
    meets = (reach > 0) & (reach <= max_depth_m)
    samples = [rays * np.where(meets, reach, r * max_depth_m)[:, None] for r in RANGES]
    return np.concatenate(samples)


def overlaps(
    pairs: Ints,
    a: SourceScene,
    b: SourceScene,
    *,
    a_from_b: Floats,
    samples: tuple[Floats, Floats],
    max_depth_m: float,
) -> Floats:
    """Overlap (n,) of images of a and of b (n, 2), 0 to 1: geometric mean of the shares that the other camera sees."""
    poses = np.concatenate([a.world_from_cam, a_from_b @ b.world_from_cam])
    cameras = len(a.drive.cameras)
    kinds, params = zip(*(pack_cameras(s.drive.cameras) for s in (a, b)), strict=True)
    camera = np.concatenate([a.image_camera, b.image_camera + cameras])
    size = np.array([(c.width, c.height) for s in (a, b) for c in s.drive.cameras], dtype=np.int64)
    numbered = np.column_stack([pairs[:, 0], pairs[:, 1] + len(a.image_camera)]).astype(np.int64)
    return mutual_overlap(
        numbered,
        world_from_cam=poses,
        camera=camera,
        kind=np.concatenate(kinds),
        params=np.concatenate(params),
        size_px=size,
        samples=np.concatenate(samples),
        max_depth_m=max_depth_m,
    )
