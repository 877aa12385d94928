"""Format `mcap`: one MCAP file with Foxglove's schemas, for Foxglove, Lichtblick and rerun.

| topic | schema | content |
|---|---|---|
| `/tf` | FrameTransform | `rig` in `map` at the time of every unit and image; cameras in `rig`, once or with images |
| `/points` | PointCloud | points with colours, once |
| `/fix` | LocationFix | positions of units of a georeferenced scene, with their sigmas |
| `/CAMERA/image` | CompressedImage | registered images, as they are |
| `/CAMERA/calibration` | CameraCalibration | beside every image |

Frames and topics of a map begin with the scene's name. Foxglove's pixels count from the centre of the top left one: the
principal point is less by half a pixel. All times are those of the drive. Where a camera's images were taken at other
times than their stamps say (refined time offsets), the rig has no one pose at a stamp: such a camera is placed in the
rig with each of its images, so that the image is where it was taken.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import cv2
import numpy as np

from mrasfm_engine.export.check import Check
from mrasfm_engine.export.contract import ExportSource, ExportWork, Written
from mrasfm_engine.export.mcap_cameras import RIG, SentCamera, sent_cameras
from mrasfm_engine.export.mcap_readback import ReadFile, compare_file, read_file
from mrasfm_engine.export.pose_files import geodetic_positions
from mrasfm_engine.export.rig_files import EQUIDISTANT, ros_distortion
from mrasfm_engine.geometry import se3
from mrasfm_engine.types import Bytes, Floats

if TYPE_CHECKING:
    from mcap_protobuf.writer import Writer

FILE = "scene.mcap"
WORLD = "map"
POINT = np.dtype([*((axis, "<f4") for axis in "xyz"), *((name, "u1") for name in ("red", "green", "blue", "alpha"))])
KANNALA_BRANDT = "kannala_brandt"  # Foxglove's name of ROS's equidistant
JPEG_QUALITY = 95
SAME_POSE = 1e-9  # metres, and elements of a rotation: rounding of two products
DIAGONAL_KNOWN = 2  # of a covariance


class HashingFile:
    """A file with the digest of what was written to it."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.digest = hashlib.sha256()

    def write(self, data: Any) -> int:
        """Write bytes at the end."""
        self.digest.update(data)
        return self._file.write(data)

    def tell(self) -> int:
        """Return the number of bytes so far."""
        return self._file.tell()

    def flush(self) -> None:
        """Do nothing: the file is flushed when it is closed."""


def write_mcap(work: ExportWork) -> Written:
    """Write the file."""
    from mcap_protobuf.writer import Writer as ProtobufWriter

    source = work.source
    cameras = sent_cameras(source, work.options.image_size_px)
    if taken := {camera.name for camera in cameras} & {RIG, WORLD}:
        raise ValueError(f"camera {min(taken)} has the name of a frame: tf would lead in a circle")
    digests: dict[int, str] = {}
    with (work.folder / FILE).open("wb") as stream:
        file = HashingFile(stream)
        with ProtobufWriter(file) as writer:
            sink = _Sink(writer)
            for time_us, send in sorted(_events(work, cameras, digests), key=lambda event: event[0]):
                send(sink, time_us)
    compare: Callable[[ReadFile], Any] = partial(compare_file, source, cameras, digests, file.digest.hexdigest())
    unknown = [camera.name for camera in cameras if camera.lens is None]
    rolling = [camera.name for camera in source.scene.drive.cameras if camera.readout_us]
    notes = [
        *([f"Foxglove has no model for {', '.join(unknown)}: no calibration"] if unknown else []),
        *([f"images have the pose of their middle row: {', '.join(rolling)}"] if rolling else []),
    ]
    return Written(checks=[Check(FILE, read_file, compare)], notes=notes)


Event = tuple[int, Callable[["_Sink", int], None]]


class _Sink:
    """Messages by topic, with one time each."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer

    def put(self, topic: str, message: Any, time_us: int) -> None:
        self._writer.write_message(topic, message, log_time=time_us * 1000, publish_time=time_us * 1000)

    def transform(self, parent: str, child: str, pose: Floats, time_us: int) -> None:
        from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform

        message = FrameTransform(timestamp=_stamp(time_us), parent_frame_id=parent, child_frame_id=child)
        message.translation.x, message.translation.y, message.translation.z = pose[:3, 3].tolist()
        q, r = se3.quaternion_from_rotation(pose[:3, :3]).tolist(), message.rotation
        r.x, r.y, r.z, r.w = q
        self.put("/tf", message, time_us)


def _stamp(time_us: int) -> Any:
    from google.protobuf.timestamp_pb2 import Timestamp

    return Timestamp(seconds=time_us // 1_000_000, nanos=time_us % 1_000_000 * 1000)


def _events(work: ExportWork, cameras: list[SentCamera], digests: dict[int, str]) -> Iterator[Event]:
    """Everything that is sent, with its time; images are read when they are sent."""
    source = work.source
    times = rig_poses(source)
    start_us = min((time_us for time_us, _, _ in times), default=0)
    shifted = shifted_cameras(source, times)
    for k, camera in enumerate(cameras):
        for time_us, pose in shifted.get(k, [(start_us, camera.rig_from_cam)]):
            yield time_us, lambda sink, t, c=camera, p=pose: sink.transform(c.rig, c.name, p, t)  # type: ignore[misc]
    yield start_us, lambda sink, t: sink.put("/points", _points(source, t), t)
    for time_us, rig, pose in times:
        yield time_us, lambda sink, t, r=rig, p=pose: sink.transform(WORLD, r, p, t)  # type: ignore[misc]
    yield from _fixes(source)
    for number, i in enumerate(source.registered, start=1):
        image = source.scene.drive.images[i]

        def send(sink: _Sink, t: int, i: int = i, camera: SentCamera = cameras[image.camera], n: int = number) -> None:
            _send_image(work, sink, t, i, camera, digests)
            work.step(n, len(source.registered))

        yield image.timestamp_us, send


def rig_poses(source: ExportSource) -> list[tuple[int, str, Floats]]:
    """Time, frame and pose (4, 4) of the rigs at units and at images whose times differ from their unit's."""
    scene = source.scene
    found: dict[tuple[int, str], Floats] = {}
    for unit in np.flatnonzero(scene.unit_registered).tolist():
        found[int(scene.drive.timestamps_us[unit]), rig_of_unit(source, unit)] = scene.world_from_rig[unit]
    if scene.unit_from_image is not None:
        for i in source.registered:
            image = scene.drive.images[i]
            key = (image.timestamp_us, rig_of_unit(source, image.unit))
            found.setdefault(key, scene.world_from_rig[image.unit] @ scene.unit_from_image[i])
    return [(time_us, rig, found[time_us, rig]) for time_us, rig in sorted(found)]


def shifted_cameras(source: ExportSource, rigs: list[tuple[int, str, Floats]]) -> dict[int, list[tuple[int, Floats]]]:
    """Times and poses (4, 4) in the rig of cameras whose images are not where the rig and their calibration place them.

    By camera; all others have the pose of their calibration at all times.
    """
    scene = source.scene
    if scene.unit_from_image is None:
        return {}
    world_from_rig = {(time_us, rig): pose for time_us, rig, pose in rigs}
    found: dict[int, list[tuple[int, Floats]]] = {}
    moved: set[int] = set()
    for i in source.registered:
        image = scene.drive.images[i]
        at_stamp = world_from_rig[image.timestamp_us, rig_of_unit(source, image.unit)]
        rig_from_cam = scene.calibration[image.camera].rig_from_cam
        at_image = scene.world_from_rig[image.unit] @ scene.unit_from_image[i]
        found.setdefault(image.camera, []).append((image.timestamp_us, se3.inverse(at_stamp) @ at_image @ rig_from_cam))
        if np.abs(found[image.camera][-1][1] - rig_from_cam).max() > SAME_POSE:
            moved.add(image.camera)
    return {camera: poses for camera, poses in found.items() if camera in moved}


def rig_of_unit(source: ExportSource, unit: int) -> str:
    """Frame of the rig that a unit is of."""
    scene = source.scene_of_unit[unit] if source.is_map else ""
    return f"{scene}/{RIG}" if scene else RIG


def _points(source: ExportSource, time_us: int) -> Any:
    from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
    from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

    rows = np.zeros(len(source.scene.points_m), POINT)
    for k, axis in enumerate("xyz"):
        rows[axis] = source.scene.points_m[:, k]
    for k, name in enumerate(("red", "green", "blue")):
        rows[name] = source.scene.point_colors[:, k]
    rows["alpha"] = 255
    cloud = PointCloud(timestamp=_stamp(time_us), frame_id=WORLD, point_stride=POINT.itemsize, data=rows.tobytes())
    cloud.pose.orientation.w = 1.0
    assert POINT.fields is not None
    for name, (kind, offset) in ((name, field[:2]) for name, field in POINT.fields.items()):
        number = PackedElementField.FLOAT32 if kind == np.dtype("<f4") else PackedElementField.UINT8
        cloud.fields.add(name=name, offset=offset, type=number)
    return cloud


def _fixes(source: ExportSource) -> Iterator[Event]:
    scene = source.scene
    if scene.georeference is None:
        return
    places = geodetic_positions(scene, scene.world_from_rig)
    assert places is not None
    for unit in np.flatnonzero(scene.unit_registered).tolist():

        def send(sink: _Sink, t: int, u: int = unit) -> None:
            from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix

            latitude, longitude, height = places[u].tolist()
            rig = rig_of_unit(source, u)
            fix = LocationFix(
                timestamp=_stamp(t), frame_id=rig, latitude=latitude, longitude=longitude, altitude=height
            )
            if np.isfinite(scene.sigma_position_m[u]).all():
                fix.position_covariance.extend(np.diag(scene.sigma_position_m[u] ** 2).ravel().tolist())
                fix.position_covariance_type = DIAGONAL_KNOWN  # type: ignore[assignment]
            sink.put(f"/{rig.removesuffix(RIG)}fix", fix, t)

        yield int(scene.drive.timestamps_us[unit]), send


def _send_image(
    work: ExportWork, sink: _Sink, time_us: int, image: int, camera: SentCamera, digests: dict[int, str]
) -> None:
    from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

    if camera.lens is not None:
        fx, fy, cx, cy = camera.lens.intrinsics
        model, coefficients = ros_distortion(camera.lens)
        calibration = CameraCalibration(
            timestamp=_stamp(time_us),
            frame_id=camera.name,
            width=camera.width,
            height=camera.height,
            distortion_model=KANNALA_BRANDT if model == EQUIDISTANT else model,
            D=coefficients,
            K=[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
            R=np.eye(3).ravel().tolist(),
            P=[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        )
        sink.put(f"/{camera.name}/calibration", calibration, time_us)
    data, kind = _image(work, image, camera)
    digests[image] = hashlib.sha256(data).hexdigest()
    message = CompressedImage(timestamp=_stamp(time_us), frame_id=camera.name, format=kind, data=data)
    sink.put(f"/{camera.name}/image", message, time_us)


def _image(work: ExportWork, image: int, camera: SentCamera) -> tuple[bytes, str]:
    source = work.source
    given = source.scene.drive.images[image]
    kind = "jpeg" if Path(given.file).suffix.lower() in (".jpg", ".jpeg") else "png"
    whole = source.scene.drive.cameras[given.camera]
    if (camera.width, camera.height) == (whole.width, whole.height):
        return source.content(image), kind
    pixels: Bytes = np.asarray(
        cv2.resize(source.pixels(image), (camera.width, camera.height), interpolation=cv2.INTER_AREA), np.uint8
    )
    settings = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if kind == "jpeg" else []
    suffix = ".jpg" if kind == "jpeg" else ".png"
    return cv2.imencode(suffix, pixels[..., ::-1], settings)[1].tobytes(), kind
