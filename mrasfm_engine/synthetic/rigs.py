"""Camera sets of synthetic vehicles: where the cameras sit, where they look and how wide.

The rig frame is x forward, y left, z up with its origin on the ground below the rear axle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.types import Floats

MAX_SYNTHETIC_CAMERAS = 8

# Axes of a camera that looks along the rig's x axis: x right, y down, z forward.
_FORWARD_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])

# Models with distortion that a good automotive lens really has.
_DISTORTION: dict[str, tuple[float, ...]] = {
    "PINHOLE": (),
    "OPENCV": (-0.09, 0.025, 0.0006, -0.0004),
    "OPENCV_FISHEYE": (0.02, -0.008, 0.002, -0.0005),
}


@dataclass(frozen=True, kw_only=True)
class Mount:
    """One camera's nominal place on the vehicle."""

    name: str
    position_m: tuple[float, float, float]  # in the rig frame
    yaw_deg: float  # to the left of forward
    fov_deg: float  # horizontal field of view


@dataclass(frozen=True, kw_only=True)
class TrueCamera:
    """One camera as it really is."""

    name: str
    model: str
    width: int
    height: int
    params: tuple[float, ...]  # COLMAP's order, pixels
    rig_from_cam: Floats  # (4, 4)


_FRONT = Mount(name="front", position_m=(1.70, 0.02, 1.51), yaw_deg=0.0, fov_deg=72.0)
_FRONT_LEFT = Mount(name="front_left", position_m=(1.52, 0.49, 1.50), yaw_deg=55.0, fov_deg=72.0)
_FRONT_RIGHT = Mount(name="front_right", position_m=(1.55, -0.49, 1.49), yaw_deg=-55.0, fov_deg=72.0)
_BACK_LEFT = Mount(name="back_left", position_m=(1.04, 0.48, 1.56), yaw_deg=110.0, fov_deg=72.0)
_BACK_RIGHT = Mount(name="back_right", position_m=(1.01, -0.48, 1.56), yaw_deg=-110.0, fov_deg=72.0)
_BACK = Mount(name="back", position_m=(0.03, 0.00, 1.57), yaw_deg=180.0, fov_deg=98.0)
_SURROUND = (_FRONT, _FRONT_LEFT, _FRONT_RIGHT, _BACK_LEFT, _BACK_RIGHT, _BACK)


def _mount(name: str, position_m: tuple[float, float, float], yaw_deg: float, fov_deg: float) -> Mount:
    return Mount(name=name, position_m=position_m, yaw_deg=yaw_deg, fov_deg=fov_deg)


def mounts(cameras: int) -> tuple[Mount, ...]:
    """The arrangement for a number of cameras, 1 to 8.

    1 looks forward; 2 are a forward stereo pair with a baseline of 0.5 m; 3 look forward and to both sides; 4 look in
    four directions at 100 degrees each; 5 leave out the back; 6 are nuScenes' surround view; 7 and 8 add a forward
    camera 0.4 m beside the first and a second one behind.

    Raises
    ------
    InputError
        For any other number.
    """
    arrangements: dict[int, tuple[Mount, ...]] = {
        1: (_FRONT,),
        2: (_mount("left", (1.70, 0.25, 1.50), 0.0, 75.0), _mount("right", (1.70, -0.25, 1.50), 0.0, 75.0)),
        3: _SURROUND[:3],
        4: (
            _mount("front", (1.70, 0.02, 1.51), 0.0, 100.0),
            _mount("left", (1.20, 0.50, 1.55), 90.0, 100.0),
            _mount("right", (1.20, -0.50, 1.55), -90.0, 100.0),
            _mount("back", (0.10, 0.00, 1.57), 180.0, 100.0),
        ),
        5: _SURROUND[:5],
        6: _SURROUND,
        7: (*_SURROUND, _mount("front_second", (1.70, -0.38, 1.51), 0.0, 60.0)),
        8: (
            *_SURROUND,
            _mount("front_second", (1.70, -0.38, 1.51), 0.0, 60.0),
            _mount("back_second", (0.03, 0.45, 1.57), 180.0, 70.0),
        ),
    }
    if cameras not in arrangements:
        raise InputError(
            f"a synthetic vehicle cannot have {cameras} cameras", remedy=f"Ask for 1 to {MAX_SYNTHETIC_CAMERAS}."
        )
    return arrangements[cameras]


def true_cameras(
    cameras: int, *, width: int, height: int, model: str = "PINHOLE", rng: np.random.Generator
) -> list[TrueCamera]:
    """Cameras as a workshop would mount them: up to a degree and a centimetre off the nominal arrangement.

    Parameters
    ----------
    cameras
        Number of cameras, 1 to 8.
    width, height
        Image size in pixels.
    model
        PINHOLE, OPENCV or OPENCV_FISHEYE.
    rng
        Source of the deviations, of principal points off the centre and of slightly different focal lengths.
    """
    if model not in _DISTORTION:
        raise InputError(
            f"camera model {model!r} cannot be rendered", remedy=f"Use one of {', '.join(sorted(_DISTORTION))}."
        )
    result = []
    for mount in mounts(cameras):
        offset_m = rng.uniform(-0.01, 0.01, 3)
        tilt = se3.exp_so3(np.radians(rng.uniform(-0.7, 0.7, 3)))
        half_fov = np.radians(mount.fov_deg) / 2
        f = 0.5 * width / (half_fov if model == "OPENCV_FISHEYE" else np.tan(half_fov))
        fx = f * (1 + rng.uniform(-0.005, 0.005))
        fy = fx * (1 + rng.uniform(-0.001, 0.001))
        cx, cy = np.array([width, height]) * (0.5 + rng.uniform(-0.008, 0.008, 2))
        yaw = np.radians(mount.yaw_deg)
        rotation = se3.exp_so3([0.0, 0.0, yaw]) @ _FORWARD_CAMERA @ tilt
        result.append(
            TrueCamera(
                name=mount.name,
                model=model,
                width=width,
                height=height,
                params=(float(fx), float(fy), float(cx), float(cy), *_DISTORTION[model]),
                rig_from_cam=se3.transform(rotation, np.array(mount.position_m) + offset_m),
            )
        )
    return result
