"""Comparison of a vehicle's cameras in other people's formats with the scene, before they are put in place.

The texts must be those that are to be written, to the last digit, and say what the scene says. Of YAML is read what
these files use: mappings of one or two levels whose values are JSON or words, and lists of JSON.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from mrasfm_engine.export import rig_files
from mrasfm_engine.export.comparisons import ROUNDING, Row, Rows
from mrasfm_engine.scene.scene import CameraCalibration, Scene
from schemas import Camera

_LINE = re.compile(r"(?P<indent>|  )(?:(?P<key>\w+):(?: (?P<value>.+))?|- (?P<item>\[.*\]))")
_WORD = re.compile(r"[A-Za-z]\w*")
# Places of a model's parameters: fx, fy, cx, cy, then k1, k2, p1, p2, k3 to k6, or a fisheye's k1 to k4; None: zero
_PLACES: dict[str, tuple[int | None, ...]] = {
    "SIMPLE_PINHOLE": (0, 0, 1, 2, None, None, None, None),
    "PINHOLE": (0, 1, 2, 3, None, None, None, None),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3, None, None, None),
    "RADIAL": (0, 0, 1, 2, 3, 4, None, None),
    "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
    "OPENCV_FISHEYE": (0, 1, 2, 3, 4, 5, 6, 7),
    "FULL_OPENCV": tuple(range(12)),
    "MEI": (0, 1, 2, 3, 4, 5, 6, 7),
}


def parsed_yaml(text: str) -> dict[str, Any]:
    """A mapping of values, or of mappings of values; ValueError where it is anything else."""
    document: dict[str, Any] = {}
    outer, last = "", (document, "")
    for line in text.splitlines():
        found = _LINE.fullmatch(line)
        if found is None:
            raise ValueError(f"{line!r} is not understood")
        if found["item"] is not None:
            holder, key = last
            holder[key] = [*(holder[key] or []), json.loads(found["item"])]
            continue
        holder, key, value = document[outer] if found["indent"] else document, found["key"], found["value"]
        if key in holder:
            raise ValueError(f"{key} is there twice")
        if not found["indent"]:
            outer = key
        holder[key] = {} if value is None and not found["indent"] else _value(value)
        last = holder, key
    return document


def _value(text: str | None) -> Any:
    return text if text is None or _WORD.fullmatch(text) else json.loads(text)


def camchain(scene: Scene, prefix: str, text: str) -> Rows:
    """Kalibr's camera chain: the poses that it composes to, and every camera's lens."""
    known = [camera for camera in rig_files.rig_cameras(scene, prefix) if rig_files.known_to_kalibr(camera)]
    yield Row("its text", text, rig_files.camchain_text(known))
    # No rational distortion: more than four coefficients
    cameras = [pair for pair in _cameras(scene, prefix) if not any(_lens(*pair)[8:])]
    found = parsed_yaml(text)
    yield Row("its cameras", list(found), [f"cam{number}" for number in range(len(cameras))])
    chained = cameras[0][1].rig_from_cam
    for number, ((given, refined), camera) in enumerate(zip(cameras, found.values(), strict=True)):
        fields = ["camera_model", "distortion_coeffs", "distortion_model", "intrinsics", "resolution", "rostopic"]
        yield Row(f"the fields of {given.name}", list(camera), ["T_cn_cnm1", *fields] if number else fields)
        if number:
            step = np.array(camera["T_cn_cnm1"], dtype=np.float64)
            last_row = step[3].tolist()
            yield Row(f"the last row of {given.name}'s step", last_row, [0.0, 0.0, 0.0, 1.0])
            before = cameras[number - 1][1].rig_from_cam
            yield Row(f"{given.name}'s step", step, np.linalg.inv(refined.rig_from_cam) @ before, 1e-12)
            chained = chained @ np.linalg.inv(step)
        yield Row(f"{given.name}'s pose", chained, refined.rig_from_cam, ROUNDING)
        described = [camera[name] for name in ("camera_model", "distortion_model", "resolution", "rostopic")]
        is_mei, topic = given.model == "MEI", f"/{given.name.removeprefix(prefix)}/image_raw"
        models = ["omni" if is_mei else "pinhole", "equidistant" if given.model == "OPENCV_FISHEYE" else "radtan"]
        yield Row(f"{given.name}'s model", described, [*models, [given.width, given.height], topic])
        xi = refined.params[8:].tolist() if is_mei else []
        lens = [*camera["intrinsics"], *camera["distortion_coeffs"]]
        yield Row(f"{given.name}'s lens", lens, [*xi, *_lens(given, refined)[:8]])


def camera_info(scene: Scene, prefix: str, name: str, text: str) -> Rows:
    """ROS's CameraInfo of one camera."""
    (camera,) = (camera for camera in rig_files.rig_cameras(scene, prefix) if camera.name == name)
    yield Row("its text", text, rig_files.camera_info_text(camera))
    (given, refined), found = next(p for p in _cameras(scene, prefix) if p[0].name == prefix + name), parsed_yaml(text)
    yield Row("its size", [found["image_width"], found["image_height"]], [given.width, given.height])
    yield Row("its name", found["camera_name"], name)
    fx, fy, cx, cy, *coefficients = _lens(given, refined)
    if given.model == "OPENCV_FISHEYE":
        model = "equidistant"
    else:
        coefficients += [0.0] * (8 - len(coefficients))
        model = "rational_polynomial" if any(coefficients[5:]) else "plumb_bob"
        coefficients = coefficients if any(coefficients[5:]) else coefficients[:5]
    yield Row("its distortion model", found["distortion_model"], model)
    matrices = {
        "camera_matrix": np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
        "distortion_coefficients": np.array([coefficients]),
        "rectification_matrix": np.eye(3),
        "projection_matrix": np.array([[fx, 0, cx, 0], [0, fy, cy, 0], [0, 0, 1, 0]]),
    }
    fields = {"image_width", "image_height", "camera_name", "distortion_model", *matrices}
    yield Row("its fields", found.keys(), fields)
    for field, matrix in matrices.items():
        yield Row(f"the fields of {field}", list(found[field]), ["rows", "cols", "data"])
        yield Row(f"the size of {field}", (found[field]["rows"], found[field]["cols"]), matrix.shape)
        yield Row(field, np.array(found[field]["data"], dtype=np.float64), matrix.ravel())


def description(scene: Scene, prefix: str, text: str) -> Rows:
    """The rig as URDF: its links, and the pose of every camera's."""
    yield Row("its text", text, rig_files.description_text(rig_files.rig_cameras(scene, prefix)))
    cameras, found = _cameras(scene, prefix), ElementTree.fromstring(text)
    names = [given.name.removeprefix(prefix) for given, _ in cameras]
    yield Row("the robot", (found.tag, found.attrib), ("robot", {"name": "rig"}))
    links = [element.attrib for element in found if element.tag == "link"]
    yield Row("its links", links, [{"name": n} for n in ("base_link", *(f"{name}_optical_frame" for name in names))])
    joints = [element for element in found if element.tag == "joint"]
    yield Row("its parts", len(found), len(links) + len(joints))
    yield Row("its joints", [j.attrib for j in joints], [{"name": f"{name}_joint", "type": "fixed"} for name in names])
    for name, joint, (_, refined) in zip(names, joints, cameras, strict=True):
        parent, child, origin = joint
        ends = [("parent", {"link": "base_link"}), ("child", {"link": f"{name}_optical_frame"})]
        yield Row(f"the ends of {name}'s joint", [(end.tag, end.attrib) for end in (parent, child)], ends)
        yield Row(f"the origin of {name}", (origin.tag, sorted(origin.attrib)), ("origin", ["rpy", "xyz"]))
        place, angles = (np.array(origin.attrib[key].split(), dtype=np.float64) for key in ("xyz", "rpy"))
        yield Row(f"{name}'s position", place, refined.rig_from_cam[:3, 3], 0.0)
        rotation = Rotation.from_euler("xyz", angles).as_matrix()  # about fixed axes
        yield Row(f"{name}'s rotation", rotation, refined.rig_from_cam[:3, :3], ROUNDING)


def read_text(path: Path) -> str:
    """A text in UTF-8 as it is."""
    return path.read_bytes().decode("utf-8")


def _cameras(scene: Scene, prefix: str) -> list[tuple[Camera, CameraCalibration]]:
    pairs = zip(scene.drive.cameras, scene.calibration, strict=True)
    return [(given, refined) for given, refined in pairs if given.name.startswith(prefix)]


def _lens(given: Camera, refined: CameraCalibration) -> list[float]:
    """Focal lengths, principal point from the centre of the top left pixel, coefficients."""
    values = [0.0 if place is None else float(refined.params[place]) for place in _PLACES[given.model]]
    return [*values[:2], values[2] - 0.5, values[3] - 0.5, *values[4:]]
