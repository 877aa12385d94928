"""Vehicles that move, added to a simulated drive: keypoints that no static point explains."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import PERSPECTIVE, packed, project_points
from tests.helpers.simulated_drive import SimulatedDrive, random_descriptors

SIZE_M = (4.4, 1.8, 1.5)


@dataclass(frozen=True, kw_only=True)
class Car:
    """A car that keeps its heading: where it is at the drive's first unit, in that unit's rig, and its velocity."""

    place_m: tuple[float, float]
    velocity_m_s: tuple[float, float]


def with_cars(
    simulated: SimulatedDrive, cars: list[Car], *, points: int = 40, noise_px: float = 0.4, seed: int = 2
) -> SimulatedDrive:
    """The drive with cars whose surfaces have points that all cameras see: car c has the points from
    `len(truth.points_m) + c * points` on."""
    rng = np.random.default_rng(seed)
    truth = simulated.truth
    first, time_s = truth.world_from_rig[0], (truth.timestamps_us - truth.timestamps_us[0]) / 1e6
    bodies = [rng.uniform(-0.5, 0.5, (points, 3)) * SIZE_M + [0, 0, 0.5 * SIZE_M[2]] for _ in cars]
    texture = random_descriptors(points * len(cars), rng)
    width, height = truth.image_size_px
    features, of = [], []
    for image, old, old_of in zip(simulated.drive.images, simulated.features, simulated.point_of_keypoint, strict=True):
        cam_from_world = se3.inverse(truth.world_from_rig[image.unit] @ truth.rig_from_cam[image.camera])
        xy, which = [], []
        for c, (car, body) in enumerate(zip(cars, bodies, strict=True)):
            shift = np.array([*car.place_m, 0.0]) + time_s[image.unit] * np.array([*car.velocity_m_s, 0.0])
            in_camera = se3.apply(cam_from_world, se3.apply(first, body + shift))
            params = packed(PERSPECTIVE, truth.camera_params[image.camera])[1]
            pixels = project_points(PERSPECTIVE, params, in_camera)
            inside = np.flatnonzero(((pixels > 0) & (pixels < [width, height])).all(1) & (in_camera[:, 2] > 1.0))
            xy.append(pixels[inside] + rng.normal(0, noise_px, (len(inside), 2)))
            which.append(c * points + inside)
        seen = np.concatenate(which)
        features.append(
            replace(
                old,
                xy_px=np.concatenate([old.xy_px, *[x.astype(np.float32) for x in xy]]),
                descriptors=np.concatenate([old.descriptors, texture[seen]]),
                colors=np.concatenate([old.colors, np.full((len(seen), 3), 128, np.uint8)]),
                classes=np.concatenate([old.classes, np.zeros(len(seen), np.uint8)]),
            )
        )
        of.append(np.concatenate([old_of, len(truth.points_m) + seen]).astype(np.int64))
    return replace(simulated, features=features, point_of_keypoint=of)
