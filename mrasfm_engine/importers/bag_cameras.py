"""Cameras of a bag: image topics with their CameraInfo, as cameras of a manifest.

ROS counts pixels from the centre of the top left pixel, manifests from its corner: half a pixel is added to the
principal point.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

import numpy as np

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.importers.lenses import Lens, lens_from_distortion
from mrasfm_engine.importers.recording import pinhole_params
from mrasfm_engine.types import Floats

COMPRESSED = "/compressed"  # image_transport's topic of JPEG or PNG beside the raw one
# The last part of a topic that says no more than that these are images; image_left is a camera's own name.
_ONLY_IMAGES = re.compile(r"image(_(raw|colou?r|mono|gr[ae]y|rect|rectified|rgb|bgr|bayer))*")
_RECTIFIED = re.compile(r"(?:^|_)rect(?:ified)?(?:_|$)")
_CALIBRATE = "Record the calibrated camera's CameraInfo, or give the calibration with --calibration."


def image_base(topic: str) -> str:
    """The topic without the part that image_transport adds for its encoding."""
    return topic.removesuffix(COMPRESSED)


def namespace(topic: str) -> str:
    """The camera's namespace: the topic without its last part, where that says only that these are images."""
    base = image_base(topic)
    parent, _, last = base.rpartition("/")
    return parent if _ONLY_IMAGES.fullmatch(last) else base


def is_rectified(topic: str) -> bool:
    """Return whether the topic has rectified images, by ROS's names: image_rect, image_rect_color."""
    return _RECTIFIED.search(image_base(topic).rpartition("/")[2]) is not None


def camera_name(topic: str) -> str:
    """Name of the camera in the manifest."""
    return namespace(topic).strip("/~_").replace("/", "_")[-64:].lstrip("_.-") or "camera"


def chosen_topics(topics: Iterable[str]) -> list[str]:
    """One topic of each camera: of a raw and a compressed one the raw one, which has lost nothing.

    Raises
    ------
    InputError
        If a camera has several kinds of images, as raw and rectified ones.
    """
    by_camera: dict[str, list[str]] = {}
    for topic in sorted(topics):
        by_camera.setdefault(namespace(topic), []).append(topic)
    chosen = []
    for camera, own in by_camera.items():
        if len({image_base(topic) for topic in own}) > 1:
            raise InputError(
                f"camera {camera or '/'} has images in {', '.join(own)}",
                remedy="Name the topics that are wanted with --topics.",
                code="several-topics",
            )
        chosen.append(min(own, key=len))
    return chosen


def lens_from_camera_info(info: Any, *, topic: str, size: tuple[int, int], rectified: bool) -> Lens:
    """The camera of the images as they are: cut out, binned or rectified, as CameraInfo says.

    Parameters
    ----------
    info
        A CameraInfo of ROS 1 or ROS 2.
    topic
        Its topic, for messages.
    size
        Width and height of the images.

    Raises
    ------
    InputError
        If the camera is not calibrated, its model is not known, or the calibration is of other images.
    """
    matrix = _matrix(info, "P", (3, 4))[:, :3] if rectified else _matrix(info, "K", (3, 3))
    if not np.isfinite(matrix).all() or matrix[0, 0] == 0.0:
        raise InputError(
            f"{topic}: {'P' if rectified else 'K'} is not set: the camera is not calibrated",
            remedy=_CALIBRATE,
            code="not-calibrated",
        )
    params = pinhole_params(matrix, what=f"{topic}: {'P' if rectified else 'K'}")
    lens = (
        Lens(model="PINHOLE", params=params)
        if rectified
        else lens_from_distortion(params, str(info.distortion_model), _field(info, "D").tolist(), where=topic)
    )
    return _as_sent(lens, info, topic=topic, size=size)


def _as_sent(lens: Lens, info: Any, *, topic: str, size: tuple[int, int]) -> Lens:
    """The camera of the part of the sensor that was read out, with its pixels binned."""
    roi, binning = info.roi, (max(int(info.binning_x), 1), max(int(info.binning_y), 1))
    full = (int(info.width), int(info.height))
    is_cut = 0 < roi.width <= full[0] and 0 < roi.height <= full[1]
    read_out = (int(roi.width), int(roi.height)) if is_cut else full
    sent = (read_out[0] // binning[0], read_out[1] // binning[1])
    if sent != size:
        raise InputError(
            f"{topic}: the calibration is of images of {sent[0]}x{sent[1]} pixels, those of the bag have "
            f"{size[0]}x{size[1]}",
            remedy="Record the CameraInfo of these images, or give the calibration with --calibration.",
            code="bad-calibration",
        )
    fx, fy, cx, cy, *rest = lens.params
    left, top = (int(roi.x_offset), int(roi.y_offset)) if is_cut else (0, 0)
    # From the corner of the top left pixel, cutting is a shift and binning a scale.
    cut = [fx / binning[0], fy / binning[1], (cx - left) / binning[0], (cy - top) / binning[1]]
    return Lens(model=lens.model, params=[*cut, *rest])


def frame_from_camera(info: Any, *, rectified: bool, shares_frame: bool) -> Floats:
    """Pose (4, 4) of the camera of the images in the frame of its CameraInfo.

    Rectified images have axes of their own. The frame's origin is the camera's centre, but where both cameras of a
    stereo pair name one frame it is the left one's, and P says how far right the other one is.
    """
    if not rectified:
        return np.eye(4)
    rotation, p = _matrix(info, "R", (3, 3)), _matrix(info, "P", (3, 4))
    if not np.isfinite(rotation).all() or abs(np.linalg.det(rotation) - 1.0) > 1e-3:
        rotation = np.eye(3)  # all zeros where a driver rectifies itself
    centre_m = np.array([-p[0, 3] / p[0, 0], -p[1, 3] / p[1, 1], 0.0]) if shares_frame else np.zeros(3)
    return se3.transform(rotation.T, rotation.T @ centre_m)


def same_calibration(one: Any, other: Any) -> bool:
    """Return whether two CameraInfos say the same of the lens and of what is read out."""
    return (
        all(np.array_equal(_field(one, name), _field(other, name), equal_nan=True) for name in ("K", "D", "R", "P"))
        and all(getattr(one, name) == getattr(other, name) for name in ("width", "height", "distortion_model"))
        and all(getattr(one, name) == getattr(other, name) for name in ("binning_x", "binning_y"))
        and all(getattr(one.roi, name) == getattr(other.roi, name) for name in ("x_offset", "y_offset"))
        and all(getattr(one.roi, name) == getattr(other.roi, name) for name in ("width", "height"))
    )


def _field(info: Any, name: str) -> Floats:
    """K, D, R or P, which ROS 2 spells in small letters."""
    value = getattr(info, name) if hasattr(info, name) else getattr(info, name.lower())
    return np.asarray(value, dtype=np.float64)


def _matrix(info: Any, name: str, shape: tuple[int, int]) -> Floats:
    return _field(info, name).reshape(shape)
