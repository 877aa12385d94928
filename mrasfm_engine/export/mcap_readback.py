"""Reading of an MCAP file beside what the scene says.

Messages are decoded by the schemas in the file itself, not by the classes that wrote them; rotations are scipy's,
positions on the earth pyproj's.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mrasfm_engine.export.comparisons import Row, Rows
from mrasfm_engine.export.contract import ExportSource
from mrasfm_engine.export.file_contents import sha256
from mrasfm_engine.export.mcap_cameras import SentCamera
from mrasfm_engine.export.projection_readback import geodetic
from mrasfm_engine.export.readers import transforms
from mrasfm_engine.types import Floats

POSITION_TOLERANCE_M, ROTATION_TOLERANCE = 1e-9, 1e-9
DEGREES, METRES = 1e-9, 1e-4  # of positions on the earth
PIXELS = 1e-9
SAME_POSE = 1e-9
MODELS = {"radtan": "plumb_bob", "rational": "rational_polynomial", "equidistant": "kannala_brandt"}
COEFFICIENTS = {"plumb_bob": 5, "rational_polynomial": 8, "kannala_brandt": 4}


@dataclass(frozen=True, kw_only=True)
class ReadFile:
    """Digest of a file, and its messages with their topics and times in nanoseconds, one at a time in memory."""

    sha256: str
    content: Iterator[tuple[str, int, str, Any]]  # topic, time, schema, message


def read_file(path: Path) -> ReadFile:
    """An MCAP file; the checksums of its chunks are verified."""
    return ReadFile(sha256=sha256(path), content=_messages(path))


def _messages(path: Path) -> Iterator[tuple[str, int, str, Any]]:
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            yield channel.topic, message.log_time, "" if schema is None else schema.name, decoded


def compare_file(
    source: ExportSource,
    cameras: Sequence[SentCamera],
    digests: Mapping[int, str],
    expected_sha256: str,
    found: ReadFile,
) -> Rows:
    """Every message, and that no other is there."""
    yield Row("its content", found.sha256, expected_sha256)
    known = _Known(source, cameras, digests)
    counts: Counter[str] = Counter()
    last_ns = 0
    for topic, time_ns, schema, message in found.content:
        counts[topic] += 1
        yield Row(f"the order of {topic}", time_ns >= last_ns, True)
        last_ns = time_ns
        stamp = message.timestamp.seconds * 1_000_000_000 + message.timestamp.nanos
        yield Row(f"the time of a message of {topic}", stamp, time_ns)
        yield from known.rows(topic, schema, time_ns, message)
    yield Row("its numbers of messages", dict(counts), known.counts())


class _Known:
    """The scene as messages must have it."""

    def __init__(self, source: ExportSource, cameras: Sequence[SentCamera], digests: Mapping[int, str]) -> None:
        self._source, self._cameras, self._digests = source, {camera.name: camera for camera in cameras}, digests
        scene = source.scene
        self._images = {(scene.drive.cameras[scene.drive.images[i].camera].name, _ns(source, i)): i for i in digests}
        self._units = {
            (self._rig(unit), int(scene.drive.timestamps_us[unit]) * 1000): unit
            for unit in np.flatnonzero(scene.unit_registered).tolist()
        }
        self._times = set(self._units)
        if scene.unit_from_image is not None:
            self._times |= {(self._rig(scene.drive.images[i].unit), _ns(source, i)) for i in source.registered}
        self._shifted = self._shifted_images()

    def _rig(self, unit: int) -> str:
        return f"{self._source.scene_of_unit[unit]}/rig" if self._source.is_map else "rig"

    def _shifted_images(self) -> dict[tuple[str, int], Floats]:
        """Poses in the rig, by camera and time, of cameras that are elsewhere at a stamp than their calibration says.

        As the rig is at the stamp: at the unit's time the unit's, else that of the first image.
        """
        scene, found, moving = self._source.scene, {}, set()
        for i in self._source.registered if scene.unit_from_image is not None else ():
            image = scene.drive.images[i]
            name, rig = scene.drive.cameras[image.camera].name, self._pose(self._rig(image.unit), _ns(self._source, i))
            found[name, _ns(self._source, i)] = np.linalg.solve(rig, scene.world_from_cam[i])
            off = np.abs(found[name, _ns(self._source, i)] - self._cameras[name].rig_from_cam).max()
            moving |= {name} if off > SAME_POSE else set()
        return {key: pose for key, pose in found.items() if key[0] in moving}

    def counts(self) -> dict[str, int]:
        """Messages by topic."""
        fixed = len(self._cameras.keys() - {camera for camera, _ in self._shifted})
        counts: Counter[str] = Counter({"/tf": fixed + len(self._shifted) + len(self._times), "/points": 1})
        for camera, _ in self._images:
            counts[f"/{camera}/image"] += 1
            counts[f"/{camera}/calibration"] += self._cameras[camera].lens is not None
        if self._source.scene.georeference is not None:
            for rig, _ in self._units:
                counts[f"/{rig.removesuffix('rig')}fix"] += 1
        return {topic: count for topic, count in counts.items() if count}

    def rows(self, topic: str, schema: str, time_ns: int, message: Any) -> Rows:
        """Rows of one message."""
        kind = topic.rpartition("/")[2]
        schemas = {
            "tf": ("FrameTransform", self._transform),
            "points": ("PointCloud", self._points),
            "fix": ("LocationFix", self._fix),
            "image": ("CompressedImage", self._image),
            "calibration": ("CameraCalibration", self._calibration),
        }
        name, rows = schemas[kind]
        yield Row(f"the schema of {topic}", schema, f"foxglove.{name}")
        yield from rows(topic, time_ns, message)

    def _transform(self, topic: str, time_ns: int, message: Any) -> Rows:
        q, t = message.rotation, message.translation
        quaternion = np.array([q.x, q.y, q.z, q.w])
        yield Row("a quaternion's norm", float(np.linalg.norm(quaternion)), 1.0, ROTATION_TOLERANCE)
        found = transforms([quaternion], [[t.x, t.y, t.z]])[0]
        child = message.child_frame_id
        if child in self._cameras:
            camera = self._cameras[child]
            yield Row(f"the parent of {child}", message.parent_frame_id, camera.rig)
            moves = any(name == child for name, _ in self._shifted)
            expected = self._shifted[child, time_ns] if moves else camera.rig_from_cam
        else:
            yield Row(f"the parent of {child}", message.parent_frame_id, "map")
            expected = self._pose(child, time_ns)
        scale = max(1.0, float(np.abs(expected[:3, 3]).max()))
        yield Row(f"the place of {child}", found[:3, 3], expected[:3, 3], POSITION_TOLERANCE_M * scale)
        yield Row(f"the rotation of {child}", found[:3, :3], expected[:3, :3], ROTATION_TOLERANCE)

    def _pose(self, rig: str, time_ns: int) -> Floats:
        """The rig's pose; at the time of an image, through that image's camera and back."""
        scene = self._source.scene
        unit = self._units.get((rig, time_ns))
        if unit is not None:
            at_unit: Floats = scene.world_from_rig[unit]
            return at_unit
        image = next(
            i for i in self._source.registered
            if _ns(self._source, i) == time_ns and self._rig(scene.drive.images[i].unit) == rig
        )  # fmt: skip
        camera = scene.calibration[scene.drive.images[image].camera]
        pose: Floats = scene.world_from_cam[image] @ np.linalg.inv(camera.rig_from_cam)
        return pose

    def _points(self, topic: str, time_ns: int, message: Any) -> Rows:
        fields = [(field.name, field.offset) for field in message.fields]
        named = [("x", 0), ("y", 4), ("z", 8), ("red", 12), ("green", 13), ("blue", 14), ("alpha", 15)]
        yield Row("the fields of points", (fields, message.point_stride, message.frame_id), (named, 16, "map"))
        data = np.frombuffer(message.data, np.uint8).reshape(-1, 16)
        scene = self._source.scene
        yield Row("a point", np.ascontiguousarray(data[:, :12]).view("<f4"), scene.points_m.astype(np.float32))
        yield Row("a colour", data[:, 12:15], np.asarray(scene.point_colors, np.uint8))

    def _fix(self, topic: str, time_ns: int, message: Any) -> Rows:
        scene, georeference = self._source.scene, self._source.scene.georeference
        assert georeference is not None
        unit = self._units[message.frame_id, time_ns]
        longitude, latitude, height = geodetic(georeference, scene.world_from_rig[unit][None, :3, 3])[0]
        yield Row("a longitude and latitude", [message.longitude, message.latitude], [longitude, latitude], DEGREES)
        yield Row("a height", message.altitude, height, METRES)
        sigmas_m = scene.sigma_position_m[unit]
        if np.isfinite(sigmas_m).all():
            covariance = np.diag(np.square(sigmas_m)).ravel()
            yield Row("a covariance", list(message.position_covariance), covariance, 1e-12)
            yield Row("a covariance's type", int(message.position_covariance_type), 2)
        else:
            yield Row("a covariance", len(message.position_covariance), 0)

    def _image(self, topic: str, time_ns: int, message: Any) -> Rows:
        image = self._images[message.frame_id, time_ns]
        file = self._source.scene.drive.images[image].file
        yield Row(f"the topic of {file}", topic, f"/{message.frame_id}/image")
        yield Row(f"the content of {file}", hashlib.sha256(message.data).hexdigest(), self._digests[image])
        yield Row(f"the format of {file}", message.format, "png" if file.lower().endswith(".png") else "jpeg")

    def _calibration(self, topic: str, time_ns: int, message: Any) -> Rows:
        camera = self._cameras[message.frame_id]
        lens = camera.lens
        assert lens is not None
        yield Row("the topic of a calibration", topic, f"/{camera.name}/calibration")
        yield Row(f"the size of {camera.name}", (message.width, message.height), (camera.width, camera.height))
        fx, fy, cx, cy = lens.intrinsics
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        yield Row(f"K of {camera.name}", list(message.K), matrix.ravel(), PIXELS)
        yield Row(f"R of {camera.name}", list(message.R), np.eye(3).ravel(), 0.0)
        yield Row(f"P of {camera.name}", list(message.P), np.column_stack([matrix, np.zeros(3)]).ravel(), PIXELS)
        higher = any(lens.coefficients[5:])
        model = MODELS[lens.distortion if lens.distortion != "rational" or higher else "radtan"]
        yield Row(f"the model of {camera.name}", message.distortion_model, model)
        expected = [*lens.coefficients, *[0.0] * 8][: COEFFICIENTS[model]]
        yield Row(f"D of {camera.name}", list(message.D), expected, PIXELS)


def _ns(source: ExportSource, image: int) -> int:
    return source.scene.drive.images[image].timestamp_us * 1000
