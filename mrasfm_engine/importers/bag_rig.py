"""Cameras of a bag on the vehicle: by CameraInfo and tf, by a `rig.json`, or by Kalibr's camera chain."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.importers.bag_cameras import (
    camera_name,
    frame_from_camera,
    image_base,
    is_rectified,
    lens_from_camera_info,
    namespace,
)
from mrasfm_engine.importers.bag_contents import BagContent, ImageTopic
from mrasfm_engine.importers.kalibr import read_camchain
from mrasfm_engine.importers.lenses import Lens
from mrasfm_engine.importers.rig_folder import checked_camera, read_rig
from mrasfm_engine.io.axes import flu_from_body
from mrasfm_engine.types import Floats
from schemas import BodyAxes, Camera
from schemas.drive import MAX_CAMERAS
from schemas.findings import listed


def cameras_of_bag(content: BagContent, calibration: Path | None, rig_frame: str) -> tuple[list[Camera], list[str]]:
    """Cameras of all image topics, and notes of what is assumed.

    Parameters
    ----------
    calibration
        Kalibr's camera chain, or a `rig.json`.
    rig_frame
        The vehicle's frame in the transforms.

    Raises
    ------
    InputError
        If a camera's lens or its place on the vehicle is not known.
    """
    if calibration is None:
        return _cameras_of_infos(content, rig_frame), []
    if calibration.suffix == ".json":
        return _cameras_of_rig(content, calibration)
    return _cameras_of_chain(content, calibration, rig_frame)


def _cameras_of_infos(content: BagContent, rig_frame: str) -> list[Camera]:
    infos = {topic: _info_of(topic, images, content.infos) for topic, images in content.images.items()}
    frames = {topic: images.frame or _frame_of(infos[topic][1]) for topic, images in content.images.items()}
    shared = {frame for frame, count in Counter(frames.values()).items() if count > 1}
    cameras = []
    for topic, images in content.images.items():
        info_topic, info = infos[topic]
        rectified = is_rectified(topic)
        if not frames[topic]:
            raise InputError(
                f"{topic}: its images have no frame_id, so that no transform says where the camera is",
                remedy="Set frame_id in the camera's driver, or give the cameras' poses with --calibration.",
                code="missing-transform",
            )
        lens = lens_from_camera_info(info, topic=info_topic, size=images.size, rectified=rectified)
        rig_from_frame = content.transforms.fixed(rig_frame, frames[topic], what=f"camera {topic}")
        shares_frame = frames[topic] in shared
        frame_from_cam = frame_from_camera(info, rectified=rectified, shares_frame=shares_frame)
        cameras.append(_camera(topic, lens, images.size, rig_from_frame @ frame_from_cam, source=info_topic))
    _require_different(cameras, frames, shared)
    return cameras


def _frame_of(stamped: Any) -> str:
    return str(stamped.header.frame_id).removeprefix("/")


def _require_different(cameras: list[Camera], frames: dict[str, str], shared: set[str]) -> None:
    """Two cameras in one place are one frame_id for two cameras, which rectification does not tell apart."""
    places = {tuple(camera.rig_from_cam.translation_m): topic for camera, topic in zip(cameras, frames, strict=True)}
    if shared and len(places) < len(cameras):
        same = [topic for topic, frame in frames.items() if frame in shared]
        raise InputError(
            f"cameras {', '.join(same)} share the frame {frames[same[0]]!r}, and nothing says how they stand to each "
            "other",
            remedy="Give each camera a frame_id of its own, or the cameras' poses with --calibration.",
            code="missing-transform",
        )


def _info_of(topic: str, images: ImageTopic, infos: dict[str, Any]) -> tuple[str, Any]:
    """The CameraInfo beside the images, by ROS's names, or the one of their frame."""
    looked_for = list(dict.fromkeys([f"{namespace(topic)}/camera_info", f"{image_base(topic)}/camera_info"]))
    candidates = [t for t in looked_for if t in infos]
    candidates = candidates or [t for t, info in infos.items() if images.frame and _frame_of(info) == images.frame]
    if not candidates:
        raise InputError(
            f"no CameraInfo is of the images {topic}: looked for {' and '.join(looked_for)}, and for frame "
            f"{images.frame!r}",
            remedy="Record it, or give the calibration with --calibration.",
            code="missing-calibration",
        )
    return candidates[0], infos[candidates[0]]


def _cameras_of_rig(content: BagContent, file: Path) -> tuple[list[Camera], list[str]]:
    read, rig = read_rig(file)
    known = {camera.name: camera for camera in read}
    cameras = []
    for topic, images in content.images.items():
        camera = known.get(camera_name(topic))
        if camera is None:
            raise InputError(
                f"calibration {file} has no camera {camera_name(topic)!r}, which {topic} is of",
                remedy="Add it to the calibration, or leave the topic out with --topics.",
                code="missing-calibration",
            )
        _require_size(f"calibration {file}: {camera.name}", (camera.width, camera.height), images, topic)
        cameras.append(camera)
    return cameras, rig.notes(file)


def _require_size(where: str, size: tuple[int, int], images: ImageTopic, topic: str) -> None:
    if size != images.size:
        raise InputError(
            f"{where}: is of {size[0]}x{size[1]} pixels, the images {topic} have {images.size[0]}x{images.size[1]}",
            remedy="Give the calibration of these images.",
            code="bad-calibration",
        )


def _cameras_of_chain(content: BagContent, file: Path, rig_frame: str) -> tuple[list[Camera], list[str]]:
    """Lenses and relative poses of Kalibr's chain; the chain's pose on the vehicle is that of one of its cameras."""
    chain = {namespace(camera.topic): camera for camera in read_camchain(file)}
    for topic in content.images:
        if namespace(topic) not in chain:
            raise InputError(
                f"calibration {file} has no camera with the images {topic}, but {', '.join(chain)}",
                remedy="Correct rostopic in the calibration, or leave the topic out with --topics.",
                code="missing-calibration",
            )
    of_images = {topic: chain[namespace(topic)] for topic in content.images}
    anchored = [topic for topic, images in content.images.items() if images.frame in content.transforms.frames]
    if anchored and rig_frame in content.transforms.frames:
        rig_from_cam = content.transforms.fixed(
            rig_frame, content.images[anchored[0]].frame, what=f"camera {anchored[0]}"
        )
        rig_from_first = rig_from_cam @ se3.inverse(of_images[anchored[0]].first_from_cam)
        notes = [f"Rig frame: {rig_frame}; the transforms have camera {anchored[0]} in it, {file.name} the others."]
    else:
        rig_from_first = flu_from_body(BodyAxes.RDF)
        notes = [
            f"Rig frame: no transform says where the cameras are on the vehicle. Its origin is taken at "
            f"{next(iter(chain.values())).topic}, which is taken to look level and straight ahead."
        ]
    cameras = []
    for topic, camera in of_images.items():
        images, where = content.images[topic], f"calibration {file}: {camera.name}"
        _require_size(where, camera.size, images, topic)
        cameras.append(_camera(topic, camera.lens, images.size, rig_from_first @ camera.first_from_cam, source=where))
    if shifted := [f"{camera.name} ({camera.timeshift_s:g} s)" for camera in chain.values() if camera.timeshift_s]:
        notes.append(
            f"{file.name}: timeshift_cam_imu is not applied: {listed(shifted, MAX_CAMERAS)}. Times of images are those "
            "of the bag; where the receiver's clock is another one, give images.*.timestamp_us in drive.json on it."
        )
    return cameras, notes


def _camera(topic: str, lens: Lens, size: tuple[int, int], rig_from_cam: Floats, *, source: str) -> Camera:
    return checked_camera(
        camera_name(topic), model=lens.model, size=size, params=lens.params, rig_from_cam=rig_from_cam, source=source
    )
