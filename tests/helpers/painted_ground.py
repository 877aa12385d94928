"""Images of a level ground whose pattern is a formula, as cameras of any model see it."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_camera, unproject_pixels
from mrasfm_engine.visualization.views import View

SIZE_PX = (320, 240)
PARAMS = {
    "PINHOLE": [160.0, 160.0, 160.0, 120.0],
    "OPENCV": [160.0, 160.0, 160.0, 120.0, -0.08, 0.01, 1e-3, -5e-4],
    "OPENCV_FISHEYE": [100.0, 100.0, 160.0, 120.0, -0.02, 0.003, 0.0, 0.0],
}
# x right, y down, z forward of a camera that looks along the rig's x axis, tilted down
RIG_FROM_FORWARD_CAM = se3.exp_so3([0.0, np.radians(25.0), 0.0]) @ np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
HEIGHT_M = 1.6


def pattern(xy: np.ndarray) -> np.ndarray:
    """Grey values (n,) that tell every place from its neighbours."""
    x, y = xy[..., 0], xy[..., 1]
    waves = np.sin(3.1 * x + 1.3 * np.sin(2.3 * y)) + np.sin(4.3 * y + 1.7 * np.sin(1.9 * x)) + np.sin(2.9 * (x + y))
    result: np.ndarray = 128 + 38 * waves
    return result


class Level:
    """A ground at height 0 that counts how often it is asked."""

    asked = 0

    def height_m(self, xy_m: np.ndarray) -> np.ndarray:
        self.asked += len(xy_m)
        return np.zeros(len(xy_m))


class Slope:
    """A plane through the origin."""

    def __init__(self, slope: tuple[float, float]) -> None:
        self.slope = np.array(slope)

    def height_m(self, xy_m: np.ndarray) -> np.ndarray:
        result: np.ndarray = xy_m @ self.slope
        return result


def looking(yaw_deg: float, x_m: float) -> np.ndarray:
    """`plan_from_cam` of a camera at x_m that looks to the side by so much."""
    turn = se3.exp_so3([0.0, 0.0, np.radians(yaw_deg)])
    return se3.transform(turn @ RIG_FROM_FORWARD_CAM, [x_m, 0.0, HEIGHT_M])


def photographed(model: str, plan_from_cam: np.ndarray) -> np.ndarray:
    """What such a camera sees, (h, w, 3)."""
    kind, params = pack_camera(model, PARAMS[model])
    u, v = np.meshgrid(np.arange(SIZE_PX[0]) + 0.5, np.arange(SIZE_PX[1]) + 0.5)
    rays = unproject_pixels(kind, params, np.column_stack([u.ravel(), v.ravel()])) @ plan_from_cam[:3, :3].T
    down = np.minimum(rays[:, 2], -1e-6)
    hit = plan_from_cam[:2, 3] + rays[:, :2] * (plan_from_cam[2, 3] / -down)[:, None]
    gray = np.where(rays[:, 2] < -0.02, pattern(hit), 255.0)
    return np.repeat(gray.reshape(SIZE_PX[::-1])[..., None], 3, axis=2).round().astype(np.uint8)


def view_of(
    model: str, camera: int, plan_from_cam: np.ndarray, *, given: np.ndarray | None = None, gain: float = 1.0
) -> View:
    """A view whose refined pose is right, and whose given pose may not be."""
    kind, params = pack_camera(model, PARAMS[model])
    return View(
        camera=camera,
        plan_from_cam=np.stack([plan_from_cam if given is None else given, plan_from_cam]),
        params=np.stack([params, params]),
        kind=kind,
        size_px=SIZE_PX,
        plan_from_rig=se3.transform(np.eye(3), plan_from_cam[:3, 3]),
        gain=np.full(3, gain),
    )
