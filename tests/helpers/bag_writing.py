"""Writes recordings as ROS bags, in all formats that the importer reads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from mrasfm_engine.geometry import se3
from mrasfm_engine.io.images import read_image_gray
from mrasfm_engine.scene.drive import Drive

FORMATS = ("mcap", "sqlite", "ros1")
FIX, INFO, TF = "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
STATIC, MOVING = "/tf_static", "/tf"


@dataclass
class Messages:
    """Makes messages of one version of ROS, and keeps them with their topics in the order of recording."""

    is_ros1: bool
    store: Typestore = field(init=False)
    kept: list[tuple[str, int, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.store = _store(is_ros1=self.is_ros1)

    def new(self, kind: str, **values: Any) -> Any:
        return self.store.types[kind](**values)

    def header(self, time_us: int, frame: str) -> Any:
        stamp = self.new("builtin_interfaces/msg/Time", sec=time_us // 1_000_000, nanosec=time_us % 1_000_000 * 1000)
        return self.new("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **({"seq": 0} if self.is_ros1 else {}))

    def keep(self, topic: str, time_us: int, message: Any) -> None:
        self.kept.append((topic, time_us, message))

    def image(self, topic: str, time_us: int, frame: str, pixels: np.ndarray, encoding: str = "mono8") -> None:
        height, width = pixels.shape[:2]
        data = np.ascontiguousarray(pixels).view(np.uint8).reshape(-1)
        values = {"height": height, "width": width, "encoding": encoding, "step": len(data) // height}
        message = self.new(IMAGE, header=self.header(time_us, frame), is_bigendian=0, data=data, **values)
        self.keep(topic, time_us, message)

    def compressed(self, topic: str, time_us: int, frame: str, content: bytes, kind: str) -> None:
        data = np.frombuffer(content, np.uint8)
        self.keep(topic, time_us, self.new(COMPRESSED, header=self.header(time_us, frame), format=kind, data=data))

    def info(self, topic: str, time_us: int, frame: str, *, size: tuple[int, int], K: Any, **other: Any) -> None:
        """CameraInfo with K (3, 3) from pixel centres; `other` are D, R, P, the model, the binning or the ROI."""
        projection = other.get("P", np.hstack([np.asarray(K), np.zeros((3, 1))]))
        arrays = {"K": K, "D": other.get("D", [0.0] * 5), "R": other.get("R", np.eye(3)), "P": projection}
        names = {name: name if self.is_ros1 else name.lower() for name in arrays}
        roi = dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0) | other.get("roi", {})
        message = self.new(
            INFO,
            header=self.header(time_us, frame),
            width=size[0],
            height=size[1],
            distortion_model=other.get("model", "plumb_bob"),
            binning_x=other.get("binning", 0),
            binning_y=other.get("binning", 0),
            roi=self.new("sensor_msgs/msg/RegionOfInterest", do_rectify=False, **roi),
            **{names[name]: np.asarray(value, dtype=np.float64).ravel() for name, value in arrays.items()},
        )
        self.keep(topic, time_us, message)

    def transform(self, topic: str, time_us: int, parent: str, child: str, parent_from_child: np.ndarray) -> None:
        q = se3.quaternion_from_rotation(parent_from_child[:3, :3])
        pose = self.new(
            "geometry_msgs/msg/Transform",
            translation=self.new(
                "geometry_msgs/msg/Vector3", **dict(zip("xyz", parent_from_child[:3, 3].tolist(), strict=True))
            ),
            rotation=self.new("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", q.tolist(), strict=True))),
        )
        stamped = self.new(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(time_us, parent),
            child_frame_id=child,
            transform=pose,
        )
        self.keep(topic, time_us, self.new(TF, transforms=[stamped]))

    def fix(self, topic: str, time_us: int, frame: str, place: Sequence[float], **other: Any) -> None:
        """Latitude, longitude and height, with variances east, north, up unless their type says unknown."""
        latitude, longitude, altitude = place
        self.keep(
            topic,
            time_us,
            self.new(
                FIX,
                header=self.header(time_us, frame),
                status=self.new("sensor_msgs/msg/NavSatStatus", status=other.get("status", 0), service=1),
                latitude=latitude,
                longitude=longitude,
                altitude=altitude,
                position_covariance=np.diag(other.get("variances", [1.0, 1.0, 4.0])).ravel(),
                position_covariance_type=other.get("covariance_type", 2),
            ),
        )

    def write(self, path: Path, kind: str, *, late_us: int = 3000) -> Path:
        """Write all as a bag of the kind; each message is recorded some time after its stamp."""
        if kind == "ros1":
            with rosbag1.Writer(path) as bag:
                self.write_into(bag, late_us=late_us)
            return path
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        with rosbag2.Writer(path, version=9, storage_plugin=plugin) as bag:
            self.write_into_ros2(bag, late_us=late_us)
        return path

    def write_into_ros2(self, bag: rosbag2.Writer, *, late_us: int = 3000) -> None:
        """Write all into an open bag of ROS 2."""
        self._write(bag, self.store.serialize_cdr, late_us)

    def write_into(self, bag: rosbag1.Writer, *, late_us: int = 3000) -> None:
        """Write all into an open bag of ROS 1."""
        self._write(bag, self.store.serialize_ros1, late_us)

    def _write(self, bag: Any, serialize: Any, late_us: int) -> None:
        connections: dict[str, Any] = {}
        for topic, time_us, message in self.kept:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, kind, typestore=self.store)
            bag.write(connections[topic], (time_us + late_us) * 1000, bytes(serialize(message, kind)))


@cache
def _store(*, is_ros1: bool) -> Typestore:
    """All types of a version of ROS; rosbags compiles them, which takes longer than to write a short bag."""
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    if TF not in store.types:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
    return store


def messages_of_drive(drive: Drive, *, is_ros1: bool, start_us: int = 0, compressed: bool = False) -> Messages:
    """A drive of pinhole cameras as a vehicle's driver would publish it, with its receiver where it has one.

    Parameters
    ----------
    start_us
        Added to all times: bags have the clock of the day.
    compressed
        Whether the images are published as the files that they are.
    """
    made = Messages(is_ros1)
    for camera, rig_from_cam in zip(drive.cameras, drive.rig_from_cam, strict=True):
        made.transform(STATIC, start_us, "base_link", f"{camera.name}_optical", rig_from_cam)
    if drive.manifest.gnss is not None:
        antenna = se3.transform(np.eye(3), drive.manifest.gnss.antenna_in_rig_m)
        made.transform(STATIC, start_us, "base_link", "gnss", antenna)
    for time_us, add in sorted(_events(made, drive, start_us, compressed), key=lambda event: event[0]):
        add(time_us)
    return made


def _events(made: Messages, drive: Drive, start_us: int, compressed: bool) -> Iterator[tuple[int, Any]]:
    for image in drive.images:
        camera = drive.cameras[image.camera]
        frame = f"{camera.name}_optical"
        fx, fy, cx, cy = camera.params
        k = [[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]]

        def add(time_us: int, image: Any = image, camera: Any = camera, frame: str = frame, k: Any = k) -> None:
            base, file = f"/{camera.name}", drive.root / image.file
            made.info(f"{base}/camera_info", time_us, frame, size=(camera.width, camera.height), K=k)
            if compressed:
                made.compressed(f"{base}/image_raw/compressed", time_us, frame, file.read_bytes(), file.suffix[1:])
            else:
                made.image(f"{base}/image_raw", time_us, frame, read_image_gray(file))

        yield start_us + image.timestamp_us, add
    for sample in drive.manifest.gnss.samples if drive.manifest.gnss else ():
        place = (sample.latitude_deg, sample.longitude_deg, sample.height_m)
        variances = [sample.sigma_horizontal_m**2, sample.sigma_horizontal_m**2, sample.sigma_vertical_m**2]

        def add_fix(time_us: int, place: Any = place, variances: Any = variances) -> None:
            made.fix("/gnss/fix", time_us, "gnss", place, variances=variances)

        yield start_us + sample.timestamp_us, add_fix
