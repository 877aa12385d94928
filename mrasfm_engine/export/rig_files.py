"""A vehicle's cameras in other people's formats: Kalibr's camera chain, ROS's CameraInfo, and the rig as URDF.

They hold the refined calibration. None of them can say sigmas, verdicts and time offsets, which `calibration.json` has,
or the readout of a rolling shutter.

Their pixel coordinates count from the centre of the top left pixel, ours from its corner: the principal point is less
by half a pixel. What a format has no model for is not in it: Kalibr knows no rational distortion, ROS no unified model
of omnidirectional cameras. All other cameras are there without loss.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.types import Floats
from schemas import CAMERA_MODELS

CAMCHAIN, DESCRIPTION, CAMERA_INFO = "camchain.yaml", "rig.urdf", "camera_info"
ROBOT = "rig"
BASE_LINK, OPTICAL_FRAME = "base_link", "_optical_frame"  # REP 103: x forward, y left, z up; z forward, x right, y down
# Coefficients: k1, k2, p1, p2; of the angle's polynomial k1 to k4; k1, k2, p1, p2, k3 to k6; k1, k2, p1, p2
RADTAN, EQUIDISTANT, RATIONAL, OMNIDIRECTIONAL = "radtan", "equidistant", "rational", "omnidirectional"
PIXEL_CENTRE_PX = 0.5


@dataclass(frozen=True, kw_only=True)
class RigCamera:
    """A camera as the formats have it."""

    name: str
    width: int
    height: int
    intrinsics: list[float]  # fx, fy, cx, cy; the centre of the top left pixel is at (0, 0)
    distortion: str
    coefficients: list[float]
    xi: float = 0.0  # of an omnidirectional one
    rig_from_cam: Floats  # (4, 4)


def rig_cameras(scene: Scene, prefix: str = "") -> list[RigCamera]:
    """Cameras with their refined calibration; those whose name begins with `prefix`, without it."""
    return [
        RigCamera(
            name=given.name.removeprefix(prefix),
            width=given.width,
            height=given.height,
            rig_from_cam=refined.rig_from_cam,
            **_lens(given.model, refined.params),
        )
        for given, refined in zip(scene.drive.cameras, scene.calibration, strict=True)
        if given.name.startswith(prefix)
    ]


def _lens(model: str, params: Floats) -> dict[str, Any]:
    """Intrinsics and distortion of one of the manifest's models; a polynomial of one in `k` begins with k1."""
    value = dict(zip(CAMERA_MODELS[model], params.tolist(), strict=True))
    names = ["k2", "k3", "k4"] if model == "OPENCV_FISHEYE" else ["k2", "p1", "p2"]
    coefficients = [value.get("k", value.get("k1", 0.0)), *(value.get(name, 0.0) for name in names)]
    distortion = {"OPENCV_FISHEYE": EQUIDISTANT, "MEI": OMNIDIRECTIONAL}.get(model, RADTAN)
    higher = [value[name] for name in ("k3", "k4", "k5", "k6")] if model == "FULL_OPENCV" else []
    if any(higher):
        distortion, coefficients = RATIONAL, coefficients + higher
    fx, fy = (value.get(name, value.get("f")) for name in ("fx", "fy"))
    return {
        "intrinsics": [fx, fy, value["cx"] - PIXEL_CENTRE_PX, value["cy"] - PIXEL_CENTRE_PX],
        "distortion": distortion,
        "coefficients": coefficients,
        "xi": value.get("xi", 0.0),
    }


def known_to_kalibr(camera: RigCamera) -> bool:
    """Return whether Kalibr has a model for the camera."""
    return camera.distortion != RATIONAL


def known_to_ros(camera: RigCamera) -> bool:
    """Return whether CameraInfo has a model for the camera."""
    return camera.distortion != OMNIDIRECTIONAL


def write_rig(cameras: Sequence[RigCamera], folder: Path) -> list[str]:
    """Write `rig.urdf`, `camchain.yaml` and `camera_info/CAMERA.yaml` into a new folder; what these lack, and why."""
    folder.mkdir(parents=True)
    (folder / DESCRIPTION).write_text(description_text(cameras), encoding="utf-8")
    if for_kalibr := list(filter(known_to_kalibr, cameras)):
        (folder / CAMCHAIN).write_text(camchain_text(for_kalibr), encoding="utf-8")
    for camera in filter(known_to_ros, cameras):
        (folder / CAMERA_INFO).mkdir(exist_ok=True)
        (folder / CAMERA_INFO / f"{camera.name}.yaml").write_text(camera_info_text(camera), encoding="utf-8")
    return [
        *(f"{CAMCHAIN} lacks {c.name}: Kalibr has no model for it" for c in cameras if not known_to_kalibr(c)),
        *(f"{CAMERA_INFO} lacks {c.name}: ROS has no model for it" for c in cameras if not known_to_ros(c)),
    ]


def camchain_text(cameras: Sequence[RigCamera]) -> str:
    """Kalibr's camera chain: each camera's pose is relative to the camera before it.

    An undistorted camera is one of four zeros: few readers know Kalibr's `none`.
    """
    lines = []
    for number, camera in enumerate(cameras):
        lines += [f"cam{number}:"]
        if number:
            cam_from_last = se3.inverse(camera.rig_from_cam) @ cameras[number - 1].rig_from_cam
            lines += ["  T_cn_cnm1:", *(f"  - {_floats(row)}" for row in cam_from_last.tolist())]
        is_omnidirectional = camera.distortion == OMNIDIRECTIONAL
        intrinsics = [camera.xi, *camera.intrinsics] if is_omnidirectional else camera.intrinsics
        lines += [
            f"  camera_model: {'omni' if is_omnidirectional else 'pinhole'}",
            f"  distortion_coeffs: {_floats(camera.coefficients)}",
            f"  distortion_model: {EQUIDISTANT if camera.distortion == EQUIDISTANT else RADTAN}",
            f"  intrinsics: {_floats(intrinsics)}",
            f"  resolution: [{camera.width}, {camera.height}]",
            f"  rostopic: {json.dumps(f'/{camera.name}/image_raw')}",
        ]
    return "\n".join([*lines, ""])


def camera_info_text(camera: RigCamera) -> str:
    """ROS's CameraInfo as `camera_calibration_parsers` reads it."""
    fx, fy, cx, cy = camera.intrinsics
    model, coefficients = ros_distortion(camera)
    return "\n".join(
        [
            f"image_width: {camera.width}",
            f"image_height: {camera.height}",
            f"camera_name: {json.dumps(camera.name)}",
            *_matrix("camera_matrix", 3, [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
            f"distortion_model: {model}",
            *_matrix("distortion_coefficients", 1, coefficients),
            *_matrix("rectification_matrix", 3, np.eye(3).ravel().tolist()),
            *_matrix("projection_matrix", 3, [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]),
            "",
        ]
    )


def ros_distortion(camera: RigCamera) -> tuple[str, list[float]]:
    """Name of ROS's model and its coefficients; `plumb_bob` has k3, too, as its fifth."""
    if camera.distortion == EQUIDISTANT:
        return "equidistant", camera.coefficients
    coefficients = [*camera.coefficients, *[0.0] * (8 - len(camera.coefficients))]
    return ("rational_polynomial", coefficients) if any(coefficients[5:]) else ("plumb_bob", coefficients[:5])


def description_text(cameras: Sequence[RigCamera]) -> str:
    """The rig as URDF: a link of the vehicle, and each camera's optical frame fixed to it."""
    root = ElementTree.Element("robot", name=ROBOT)
    ElementTree.SubElement(root, "link", name=BASE_LINK)
    for camera in cameras:
        frame = f"{camera.name}{OPTICAL_FRAME}"
        ElementTree.SubElement(root, "link", name=frame)
        joint = ElementTree.SubElement(root, "joint", name=f"{camera.name}_joint", type="fixed")
        ElementTree.SubElement(joint, "parent", link=BASE_LINK)
        ElementTree.SubElement(joint, "child", link=frame)
        place, angles = camera.rig_from_cam[:3, 3].tolist(), roll_pitch_yaw(camera.rig_from_cam[:3, :3])
        ElementTree.SubElement(joint, "origin", xyz=" ".join(map(repr, place)), rpy=" ".join(map(repr, angles)))
    ElementTree.indent(root)
    return f'<?xml version="1.0"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'


def roll_pitch_yaw(rotation: Floats) -> list[float]:
    """Angles in radians about the fixed axes x, y, z, in this order, of a rotation (3, 3), also where x is vertical."""
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    # Without the yaw as it is, whatever the noise in it: near the pole the others make up for it.
    level = se3.exp_so3([0.0, 0.0, -yaw]) @ rotation
    return [math.atan2(-level[1, 2], level[1, 1]), math.atan2(-level[2, 0], level[0, 0]), yaw]


def _matrix(name: str, rows: int, values: Sequence[float]) -> list[str]:
    return [f"{name}:", f"  rows: {rows}", f"  cols: {len(values) // rows}", f"  data: {_floats(values)}"]


def _floats(values: Sequence[float]) -> str:
    return f"[{', '.join(map(_float, values))}]"


def _float(value: float) -> str:
    """All digits of a number; YAML 1.1 takes one without a point, as 1e-05, for a text."""
    text = repr(float(value))
    return text if "." in text else text.replace("e", ".0e")
