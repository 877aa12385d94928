from __future__ import annotations

import json
import shutil
import sqlite3
import tempfile
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from backports.zstd import ZstdCompressor
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import StoragePlugin

from mrasfm_engine.cli import main
from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.geodesy import ecef_from_local, local_from_geodetic
from mrasfm_engine.importers import bag_reader, bags
from mrasfm_engine.importers.bag_cameras import is_rectified
from mrasfm_engine.importers.drive_writer import ImportSummary
from mrasfm_engine.importers.kalibr import read_camchain
from mrasfm_engine.importers.layouts import import_recording
from mrasfm_engine.io.images import read_image_gray, read_image_rgb
from mrasfm_engine.preflight.drive_reader import check_drive, read_drive
from mrasfm_engine.scene.drive import Drive, matrix_from_pose
from tests.helpers.bag_writing import FORMATS, MOVING, STATIC, Messages, messages_of_drive
from tests.helpers.slow import slow

START_US = 1_700_000_000_000_000
PERIOD_US = 100_000
SIZE = (48, 32)
K = [[40.0, 0.0, 23.5], [0.0, 41.0, 15.5], [0.0, 0.0, 1.0]]
OPTICAL = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # rig_from_cam's rotation of a camera that looks ahead
LEFT = se3.transform(OPTICAL, [1.0, 0.25, 1.5])
RIGHT = se3.transform(OPTICAL, [1.0, -0.25, 1.5])
PLACE = (49.0, 8.4, 110.0)

Edit = Callable[[Messages], None]


def picture(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (SIZE[1], SIZE[0]), dtype=np.uint8)


def stereo(*, is_ros1: bool = False, frames: int = 4, late_us: int = 0, **info: Any) -> Messages:
    """A stereo pair at 10 Hz with a receiver; the right camera comes later."""
    made = Messages(is_ros1)
    for name, pose in (("left", LEFT), ("right", RIGHT)):
        made.transform(STATIC, START_US, "base_link", name, pose)
    made.transform(STATIC, START_US, "base_link", "antenna", se3.transform(np.eye(3), [0.1, 0.2, 1.8]))
    for f in range(frames):
        time_us = START_US + f * PERIOD_US
        for i, name in enumerate(("left", "right")):
            made.info(f"/{name}/camera_info", time_us + i * late_us, name, size=SIZE, K=K, **info)
            made.image(f"/{name}/image_raw", time_us + i * late_us, name, picture(2 * f + i))
        made.fix("/fix", time_us, "antenna", (PLACE[0] + f * 1e-5, *PLACE[1:]), variances=[0.25, 0.25, 1.0])
    return made


def compressed_mcap(made: Messages, folder: Path, compression: str) -> Path:
    """The messages with their chunks compressed, which rosbags itself does not write."""
    source, target = made.write(folder / "plain", "mcap") / "plain.mcap", folder / "compressed.mcap"
    with source.open("rb") as stream, target.open("wb") as sink:
        writer = Writer(sink, compression=CompressionType[compression.upper()])
        writer.start(profile="ros2")
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            if channel.id not in channels:
                schemas.setdefault(schema.id, writer.register_schema(schema.name, schema.encoding, schema.data))
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.id], channel.metadata
                )
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()  # type: ignore[no-untyped-call]
    return target


def without(topic: str) -> Edit:
    def edit(made: Messages) -> None:
        made.kept[:] = [row for row in made.kept if row[0] != topic]

    return edit


def imported(made: Messages, folder: Path, kind: str = "mcap", **options: Any) -> tuple[Drive, ImportSummary]:
    path = made.write(folder / ("bag.bag" if kind == "ros1" else "bag"), kind)
    summary = import_recording(path, folder / "drive", options=options)
    return read_drive(folder / "drive"), summary


def refused(made: Messages, folder: Path, **options: Any) -> str:
    with pytest.raises(InputError) as caught:
        imported(made, folder, **options)
    assert caught.value.remedy
    assert not (folder / "drive").exists()
    return str(caught.value)


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("compressed", [False, True])
def test_a_drive_comes_back_from_every_format(tmp_path: Path, kind: str, compressed: bool) -> None:
    given, _ = imported(stereo(), tmp_path)
    made = messages_of_drive(given, is_ros1=kind == "ros1", compressed=compressed)
    path = made.write(tmp_path / ("again.bag" if kind == "ros1" else "again"), kind)
    import_recording(path, tmp_path / "again-drive")
    again = read_drive(tmp_path / "again-drive")
    assert again.manifest.model_copy(update={"name": given.manifest.name}) == given.manifest
    for image in given.images:
        one, other = (drive.root / image.file for drive in (given, again))
        assert np.array_equal(read_image_gray(one), read_image_gray(other))
        assert not compressed or one.read_bytes() == other.read_bytes()


@pytest.mark.parametrize("kind", FORMATS)
def test_content_of_a_bag(tmp_path: Path, kind: str) -> None:
    drive, summary = imported(stereo(is_ros1=kind == "ros1"), tmp_path, kind)
    assert (summary.layout, summary.cameras, summary.units, summary.images) == ("ROS bag", 2, 4, 8)
    assert [f.code for f in check_drive(drive)] == []
    assert [camera.name for camera in drive.cameras] == ["left", "right"]
    # ROS counts from the centre of the first pixel, manifests from its corner.
    assert drive.cameras[0].params == [40.0, 41.0, 24.0, 16.0]
    np.testing.assert_allclose(drive.rig_from_cam, [LEFT, RIGHT], atol=1e-12)
    assert drive.timestamps_us.tolist() == [START_US + f * PERIOD_US for f in range(4)]
    assert np.array_equal(read_image_gray(drive.root / drive.images[5].file), picture(5))
    gnss = drive.manifest.gnss
    assert gnss is not None
    assert gnss.antenna_in_rig_m == pytest.approx([0.1, 0.2, 1.8])
    assert (gnss.samples[2].sigma_horizontal_m, gnss.samples[2].sigma_vertical_m) == (0.5, 1.0)
    assert gnss.samples[2].latitude_deg == PLACE[0] + 2e-5
    assert "readout_us" in summary.notes[-1]


def test_a_file_of_a_bag_and_a_split_recording(tmp_path: Path) -> None:
    stereo(is_ros1=True).write(tmp_path / "day_0.bag", "ros1")
    later = stereo(is_ros1=True)
    for _, _, message in later.kept:
        for header in [message.header] if hasattr(message, "header") else [t.header for t in message.transforms]:
            header.stamp.sec += 1
    later.kept[:] = [(topic, time_us + 1_000_000, message) for topic, time_us, message in later.kept]
    later.write(tmp_path / "day_1.bag", "ros1")
    assert import_recording(tmp_path, tmp_path / "both").units == 8
    assert import_recording(tmp_path / "day_1.bag", tmp_path / "one").units == 4
    stereo().write(tmp_path / "bag", "mcap")
    (tmp_path / "bag" / "bag.mcap").rename(tmp_path / "day.mcap")
    assert import_recording(tmp_path / "day.mcap", tmp_path / "file").units == 4
    with pytest.raises(InputError, match=r"bags of several formats: day_0\.bag, day\.mcap"):
        import_recording(tmp_path, tmp_path / "none")


def test_a_bag_without_definitions_is_read_by_those_of_ros(tmp_path: Path) -> None:
    """As bags of ROS 2 in SQLite before Iron."""
    import sqlite3

    stereo().write(tmp_path / "bag", "sqlite")
    with sqlite3.connect(tmp_path / "bag" / "bag.db3") as database:
        database.execute("DELETE FROM message_definitions")
    assert import_recording(tmp_path / "bag", tmp_path / "drive").images == 8


@pytest.mark.slow
def test_images_are_read_one_at_a_time(tmp_path: Path) -> None:
    made, pixels = stereo(frames=1), np.random.default_rng(0).integers(0, 256, (1000, 1000), dtype=np.uint8)
    made.kept[:] = [row for row in made.kept if row[0] == STATIC]
    made.info("/left/camera_info", START_US, "left", size=(1000, 1000), K=[[900, 0, 500], [0, 900, 500], [0, 0, 1]])
    for f in range(50):
        made.image("/left/image_raw", START_US + f * PERIOD_US, "left", pixels)
    path = made.write(tmp_path / "bag", "mcap")
    import_recording(path, tmp_path / "warm", frames="0:1")
    tracemalloc.start()
    try:
        assert import_recording(path, tmp_path / "drive").images == 50
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert 1e6 < peak < 15e6  # of 50 MB


# Cameras


def test_cameras_that_are_not_simultaneous(tmp_path: Path) -> None:
    """The right camera is late by four tenths of a period and has lost a frame, the left one another."""
    made = stereo(frames=6, late_us=40_000)
    lost = {("/left/image_raw", START_US + 3 * PERIOD_US), ("/right/image_raw", START_US + PERIOD_US + 40_000)}
    made.kept[:] = [row for row in made.kept if row[:2] not in lost]
    drive, _ = imported(made, tmp_path)
    cameras = [sorted(frame.images) for frame in drive.manifest.frames]
    assert cameras == [["left", "right"], ["left"], ["left", "right"], ["right"], *[["left", "right"]] * 2]
    frame = drive.manifest.frames[0]
    assert frame.timestamp_us == START_US + 20_000
    assert [frame.images[name].timestamp_us for name in ("left", "right")] == [START_US, START_US + 40_000]


@pytest.mark.parametrize(
    ("info", "model", "params"),
    [
        ({"D": [0.1, -0.2, 0.01, 0.02, 0.0]}, "OPENCV", [0.1, -0.2, 0.01, 0.02]),
        ({"D": [0.1, -0.2, 0.01, 0.02, 0.05]}, "FULL_OPENCV", [0.1, -0.2, 0.01, 0.02, 0.05, 0, 0, 0]),
        (
            {"model": "rational_polynomial", "D": [1.0, 2.0, 0.1, 0.2, 3.0, 4.0, 5.0, 6.0]},
            "FULL_OPENCV",
            [1.0, 2.0, 0.1, 0.2, 3.0, 4.0, 5.0, 6.0],
        ),
        ({"model": "equidistant", "D": [0.1, 0.2, 0.3, 0.4]}, "OPENCV_FISHEYE", [0.1, 0.2, 0.3, 0.4]),
        ({"model": "", "D": []}, "PINHOLE", []),
    ],
)
def test_distortion(tmp_path: Path, info: dict[str, Any], model: str, params: list[float]) -> None:
    drive, _ = imported(stereo(**info), tmp_path)
    assert drive.cameras[0].model == model
    assert drive.cameras[0].params == [40.0, 41.0, 24.0, 16.0, *params]


@pytest.mark.parametrize(
    ("info", "message"),
    [
        ({"model": "mirror_ball"}, "/left/camera_info: distortion model 'mirror_ball' is not known"),
        ({"model": "equidistant", "D": [0.1] * 5}, "model 'equidistant' has 5 coefficients instead of 4"),
        ({"model": "rational_polynomial", "D": [0.1] * 12}, "has terms of a thin prism"),
        ({"D": [np.nan] * 5}, "coefficient of distortion is not finite"),
        ({"K": np.zeros((3, 3))}, "/left/camera_info: K is not set: the camera is not calibrated"),
        ({"K": np.transpose(K)}, "/left/camera_info: K is no calibration matrix: the last row is 23.5, 15.5, 1"),
        ({"size": (96, 64)}, "calibration is of images of 96x64 pixels, those of the bag have 48x32"),
    ],
)
def test_what_no_camera_of_a_manifest_has_is_refused(tmp_path: Path, info: dict[str, Any], message: str) -> None:
    made = stereo()
    made.kept[:] = [row for row in made.kept if row[0] != "/left/camera_info"]
    made.info("/left/camera_info", START_US, "left", **({"size": SIZE, "K": K} | info))
    assert message in refused(made, tmp_path)


def test_a_part_of_the_sensor_with_binned_pixels(tmp_path: Path) -> None:
    """Half of a sensor of 192x128, from column 96 and row 32 on, each two by two pixels as one."""
    full = [[80.0, 0.0, 143.5], [0.0, 82.0, 63.5], [0.0, 0.0, 1.0]]
    made = stereo()
    for side in ("left", "right"):
        without(f"/{side}/camera_info")(made)
        roi = {"x_offset": 96, "y_offset": 32, "width": 96, "height": 64}
        made.info(f"/{side}/camera_info", START_US, side, size=(192, 128), K=full, roi=roi, binning=2)
    drive, _ = imported(made, tmp_path)
    assert drive.cameras[0].params == [40.0, 41.0, (144 - 96) / 2, (64 - 32) / 2]


def test_a_rectified_pair_that_shares_a_frame(tmp_path: Path) -> None:
    """stereo_image_proc: both name the left frame, R turns into it, and P says how far right the other camera is."""
    turned = se3.exp_so3([0.0, 0.02, 0.0])
    made = Messages(False)
    made.transform(STATIC, START_US, "base_link", "left", LEFT)
    for f in range(3):
        for i, name in enumerate(("left", "right")):
            time_us = START_US + f * PERIOD_US
            p = [[38.0, 0, 23.5, -38.0 * 0.5 * i], [0, 38.0, 15.5, 0], [0, 0, 1, 0]]
            made.info(f"/{name}/camera_info", time_us, "left", size=SIZE, K=K, D=[0.3] * 5, R=turned, P=p)
            made.image(f"/{name}/image_rect", time_us, "left", picture(f))
    drive, _ = imported(made, tmp_path)
    assert [camera.params for camera in drive.cameras] == [[38.0, 38.0, 24.0, 16.0]] * 2
    rectified = LEFT @ se3.transform(turned.T, np.zeros(3))
    np.testing.assert_allclose(drive.rig_from_cam[0], rectified, atol=1e-12)
    np.testing.assert_allclose(drive.rig_from_cam[1], rectified @ se3.transform(np.eye(3), [0.5, 0, 0]), atol=1e-12)


def test_two_cameras_of_one_frame_are_refused(tmp_path: Path) -> None:
    made = stereo()
    for topic, _, message in made.kept:
        if topic.startswith("/right/"):
            message.header.frame_id = "left"
    text = refused(made, tmp_path)
    assert "cameras /left/image_raw, /right/image_raw share the frame 'left'" in text
    assert "--calibration" in text


def test_several_topics_of_one_camera(tmp_path: Path) -> None:
    made = stereo()
    for f in range(4):
        content = cv2.imencode(".jpg", picture(2 * f))[1].tobytes()
        made.compressed("/left/image_raw/compressed", START_US + f * PERIOD_US, "left", content, "jpeg")
    drive, summary = imported(made, tmp_path)
    assert summary.notes[0] == "Left out: images of /left/image_raw/compressed."
    assert np.array_equal(read_image_gray(drive.root / drive.images[0].file), picture(0))
    for f in range(4):
        made.image("/left/image_rect", START_US + f * PERIOD_US, "left", picture(99))
    (tmp_path / "second").mkdir()
    text = refused(made, tmp_path / "second")
    assert "camera /left has images in /left/image_raw, /left/image_raw/compressed, /left/image_rect" in text
    (tmp_path / "third").mkdir()
    drive, _ = imported(made, tmp_path / "third", topics=["/left/image_rect", "/right/image_raw"])
    assert np.array_equal(read_image_gray(drive.root / drive.images[0].file), picture(99))
    assert drive.manifest.gnss is None  # its topic is not among those that are wanted


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (without("/left/camera_info"), "no CameraInfo is of the images /left/image_raw: looked for /left/camera_info"),
        (without(STATIC), "no transform has the frame 'base_link'. Known frames: none: the bag has no tf or tf_static"),
        (lambda m: without("/left/image_raw")(m) or without("/right/image_raw")(m), "has no topic of images"),
    ],
)
def test_missing_topics_are_named(tmp_path: Path, edit: Edit, message: str) -> None:
    made = stereo()
    edit(made)
    assert message in refused(made, tmp_path)


def test_an_unknown_topic_is_named(tmp_path: Path) -> None:
    text = refused(stereo(), tmp_path, topics=["/front/image_raw"])
    assert "no images or positions in /front/image_raw" in text
    assert "Choose among /left/image_raw, /right/image_raw, /fix" in text


@pytest.mark.parametrize(
    "change",
    [
        {"K": 2 * np.array(K)},
        {"model": "rational_polynomial"},
        {"roi": {"x_offset": 8, "y_offset": 0, "width": SIZE[0], "height": SIZE[1]}},
    ],
)
def test_a_calibration_that_changes_is_refused(tmp_path: Path, change: dict[str, Any]) -> None:
    """Also where a part of the sensor of the same size is read out elsewhere."""
    made = stereo()
    made.info("/left/camera_info", START_US + 350_000, "left", **({"size": SIZE, "K": K} | change))
    assert "/left/camera_info: the calibration changes within the bag" in refused(made, tmp_path)


def test_topics_whose_last_part_names_the_camera(tmp_path: Path) -> None:
    """As /stereo/image_left; "direct" does not say that images are rectified."""
    made = Messages(False)
    for i, (name, pose) in enumerate((("left", LEFT), ("right", RIGHT))):
        made.transform(STATIC, START_US, "base_link", name, pose)
        for f in range(3):
            topic, time_us = f"/direct/image_{name}", START_US + f * PERIOD_US
            made.info(f"{topic}/camera_info", time_us, name, size=SIZE, K=K, D=[0.1] * 5, P=np.zeros((3, 4)))
            made.image(topic, time_us, name, picture(2 * f + i))
    drive, _ = imported(made, tmp_path)
    assert [camera.name for camera in drive.cameras] == ["direct_image_left", "direct_image_right"]
    assert drive.cameras[0].model == "FULL_OPENCV"
    assert [is_rectified(t) for t in ("/a/image_rect", "/a/image_rect_color", "/a/rectified/compressed")] == [True] * 3
    assert [is_rectified(t) for t in ("/a/direct", "/rect/image_raw", "/a/rectangle")] == [False] * 3


# Transforms


def test_another_frame_of_the_vehicle(tmp_path: Path) -> None:
    made = stereo()
    lowered = se3.transform(np.eye(3), [0.0, 0.0, -0.4])
    made.transform(STATIC, START_US, "base_link", "footprint", lowered)
    drive, _ = imported(made, tmp_path, rig_frame="footprint")
    np.testing.assert_allclose(drive.rig_from_cam[0], se3.inverse(lowered) @ LEFT, atol=1e-12)
    text = refused(made, tmp_path / "second", rig_frame="chassis") if (tmp_path / "second").mkdir() is None else ""
    assert "no transform has the frame 'chassis'. Known frames: antenna, base_link, footprint, left, right" in text
    assert "--rig-frame" in text


def test_transforms_of_cameras_that_are_published_again_and_again(tmp_path: Path) -> None:
    """As ROS 1 does; a camera on a joint that moves is refused."""
    made = stereo()
    without(STATIC)(made)
    for f in range(4):
        for name, pose in (("left", LEFT), ("right", RIGHT), ("antenna", np.eye(4))):
            made.transform(MOVING, START_US + f * PERIOD_US, "/base_link", name, pose)
    imported(made, tmp_path)
    made.transform(MOVING, START_US + 350_000, "base_link", "right", RIGHT @ se3.exp_se3([0, 0.01, 0, 0, 0, 0]))
    (tmp_path / "second").mkdir()
    text = refused(made, tmp_path / "second")
    assert "camera /right/image_raw: the transform from right to base_link moves by 0.000 m and 0.57 deg" in text


def test_frames_that_nothing_links_and_two_parents(tmp_path: Path) -> None:
    made = stereo()
    made.transform(STATIC, START_US, "odom", "chassis", np.eye(4))
    assert "no transforms link the frames 'left' and 'chassis'" in refused(made, tmp_path, rig_frame="chassis")
    made.transform(STATIC, START_US, "chassis", "left", LEFT)
    (tmp_path / "second").mkdir()
    assert "frame left has two parents, base_link and chassis" in refused(made, tmp_path / "second")


def test_defects_of_frames_that_no_camera_needs_do_no_harm(tmp_path: Path) -> None:
    """Two localisers place the vehicle in their own worlds, and an arm that is off has no rotation."""
    made = stereo()
    for world in ("odom", "map"):
        made.transform(MOVING, START_US, world, "base_link", np.eye(4))
    made.transform(STATIC, START_US, "base_link", "arm", np.eye(4))
    made.kept[-1][2].transforms[0].transform.rotation.w = 0.0
    assert imported(made, tmp_path)[1].images == 8
    for number, (frame, message) in enumerate(
        (("map", "frame base_link has two parents, odom and map"), ("arm", "transform from arm to base_link: rotation"))
    ):
        (tmp_path / str(number)).mkdir()
        options = {"world_frame": frame} if frame == "map" else {"rig_frame": frame}
        assert message in refused(made, tmp_path / str(number), **options)


def test_poses_in_a_world_frame_become_rough_poses(tmp_path: Path) -> None:
    made = stereo(frames=5)
    for f in range(4):  # at 10 Hz, half a period off the images; the last image is beyond them
        pose = se3.transform(se3.exp_so3([0, 0, 0.1 * f]), [f * 1.0, 0.0, 0.0])
        made.transform(MOVING, START_US - 50_000 + f * PERIOD_US, "odom", "base_link", pose)
    drive, summary = imported(made, tmp_path, world_frame="odom")
    rough = drive.manifest.rough_poses
    assert rough is not None
    assert summary.rough_poses == 3
    poses = np.stack([matrix_from_pose(pose.world_from_rig) for pose in rough.poses])
    np.testing.assert_allclose(poses[:, 0, 3], [0.5, 1.5, 2.5], atol=1e-9)
    np.testing.assert_allclose(np.arcsin(poses[:, 1, 0]), [0.05, 0.15, 0.25], atol=1e-9)
    (tmp_path / "second").mkdir()
    text = refused(made, tmp_path / "second", world_frame="map")
    assert "--world-frame: no transform has the frame 'map'" in text


# The receiver


def test_a_receiver_that_states_no_accuracy_is_asked_for(tmp_path: Path) -> None:
    made = stereo()
    for topic, _, message in made.kept:
        if topic == "/fix":
            message.position_covariance_type = 0
    text = refused(made, tmp_path)
    assert "/fix: 4 of 4 positions have no covariance" in text
    assert "--gnss-sigma" in text
    (tmp_path / "second").mkdir()
    drive, summary = imported(made, tmp_path / "second", gnss_sigma_m=1.5)
    assert drive.manifest.gnss is not None
    assert drive.manifest.gnss.samples[0].sigma_vertical_m == 3.0
    assert any("1.5 m" in note for note in summary.notes)


def test_an_antenna_that_no_transform_has_is_asked_for(tmp_path: Path) -> None:
    made = stereo()
    for topic, _, message in made.kept:
        if topic == "/fix":
            message.header.frame_id = "gps"
    text = refused(made, tmp_path)
    assert "/fix: no transform says where the antenna, frame 'gps', is on the vehicle" in text
    assert "--antenna X,Y,Z" in text
    (tmp_path / "second").mkdir()
    drive, _ = imported(made, tmp_path / "second", antenna_m=[-0.5, 0.0, 1.7])
    assert drive.manifest.gnss is not None
    assert drive.manifest.gnss.antenna_in_rig_m == [-0.5, 0.0, 1.7]


def test_positions_without_a_fix_are_left_out(tmp_path: Path) -> None:
    made = stereo()
    made.fix("/fix", START_US + 310_000, "antenna", (0.0, 0.0, 0.0), status=-1)
    made.fix("/fix", START_US + 320_000, "antenna", (np.nan, np.nan, np.nan))
    drive, summary = imported(made, tmp_path)
    assert drive.manifest.gnss is not None
    assert len(drive.manifest.gnss.samples) == 4
    assert any("2 positions without a fix" in note for note in summary.notes)


def test_two_receivers_are_asked_for(tmp_path: Path) -> None:
    made = stereo()
    made.fix("/other/fix", START_US, "antenna", PLACE)
    assert "positions of several receivers: /fix, /other/fix" in refused(made, tmp_path)


# Images


def packed(values: np.ndarray, encoding: str) -> Edit:
    def edit(made: Messages) -> None:
        without("/left/image_raw")(made)
        for f in range(3):
            made.image("/left/image_raw", START_US + f * PERIOD_US, "left", values, encoding)

    return edit


RGB = np.random.default_rng(3).integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
FLAT = np.broadcast_to(np.array([200, 120, 40], np.uint8), (SIZE[1], SIZE[0], 3))  # red, green, blue


def mosaic(pattern: str, image: np.ndarray) -> np.ndarray:
    channel = {"r": 0, "g": 1, "b": 2}
    out = np.empty(image.shape[:2], image.dtype)
    for i, letter in enumerate(pattern):
        out[i // 2 :: 2, i % 2 :: 2] = image[i // 2 :: 2, i % 2 :: 2, channel[letter]]
    return out


@pytest.mark.parametrize(
    ("values", "encoding", "expected", "off"),
    [
        (RGB, "rgb8", RGB, 0),
        (RGB[..., ::-1], "bgr8", RGB, 0),
        (np.dstack([RGB, RGB[..., :1]]), "rgba8", RGB, 0),
        (np.dstack([RGB[..., ::-1], RGB[..., :1]]), "bgra8", RGB, 0),
        (RGB.astype("<u2") * 257, "rgb16", RGB, 0),
        *((mosaic(pattern, FLAT), f"bayer_{pattern}8", FLAT, 0) for pattern in ("rggb", "bggr", "gbrg", "grbg")),
    ],
)  # fmt: skip
def test_encodings(tmp_path: Path, values: np.ndarray, encoding: str, expected: np.ndarray, off: int) -> None:
    made = stereo()
    packed(values, encoding)(made)
    drive, _ = imported(made, tmp_path)
    found = read_image_rgb(drive.root / drive.images[0].file)
    inner = (slice(2, -2), slice(2, -2)) if encoding.startswith("bayer") else (slice(None), slice(None))
    assert np.abs(found[inner].astype(int) - expected[inner]).max() <= off


@pytest.mark.parametrize(("encoding", "order"), [("yuv422", "uyvy"), ("yuv422_yuy2", "yuyv")])
def test_chroma_of_two_pixels(tmp_path: Path, encoding: str, order: str) -> None:
    values = np.empty((SIZE[1], SIZE[0], 2), np.uint8)
    part = {"y": 120, "u": 90, "v": 190}
    values.reshape(SIZE[1], -1, 4)[:] = [part[letter] for letter in order]
    made = stereo()
    packed(values, encoding)(made)
    drive, _ = imported(made, tmp_path)
    red, green, blue = read_image_rgb(drive.root / drive.images[0].file)[5, 5]
    luma = 1.164 * (120 - 16)  # BT.601
    expected = [luma + 1.596 * 62, luma - 0.813 * 62 + 0.391 * 38, luma - 2.018 * 38]
    np.testing.assert_allclose([red, green, blue], expected, atol=2.0)


def test_padded_rows_and_big_endian_values(tmp_path: Path) -> None:
    made = stereo()
    values = (np.arange(SIZE[0] * SIZE[1]).reshape(SIZE[1], SIZE[0]) * 40).astype(">u2")
    padded = np.zeros((SIZE[1], 2 * SIZE[0] + 10), np.uint8)
    padded[:, : 2 * SIZE[0]] = values.view(np.uint8)
    without("/left/image_raw")(made)
    for f in range(3):
        made.image("/left/image_raw", START_US + f * PERIOD_US, "left", padded)
        message = made.kept[-1][2]
        message.width, message.encoding, message.is_bigendian = SIZE[0], "mono16", 1
    drive, _ = imported(made, tmp_path)
    found = cv2.imread(str(drive.root / drive.images[0].file), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(found, values.astype(np.uint16))


@pytest.mark.parametrize(("bits", "encoding"), [(12, "mono16"), (10, "bayer_rggb16"), (14, "rgb16"), (8, "bgr16")])
def test_sensors_of_fewer_bits_in_16(tmp_path: Path, bits: int, encoding: str) -> None:
    """As they are, pictures of 12 bits would be all but black in 8."""
    shape = (SIZE[1], SIZE[0], 3) if encoding in ("rgb16", "bgr16") else (SIZE[1], SIZE[0])
    values = np.random.default_rng(1).integers(2 ** (bits - 1), 2**bits, shape).astype("<u2")
    made = stereo()
    packed(values, encoding)(made)
    drive, summary = imported(made, tmp_path)
    note = f"Images of /left/image_raw use {bits} of 16 bits: all values are taken times {2 ** (16 - bits)}."
    assert note in summary.notes
    found = cv2.imread(str(drive.root / drive.images[0].file), cv2.IMREAD_UNCHANGED)
    if encoding == "mono16":
        assert np.array_equal(found, values << 4)
    assert 100 < read_image_gray(drive.root / drive.images[0].file).mean() < 230
    assert (
        sum("of 16 bits" in note for note in summary.notes) == 1
    )  # of the right camera's 8 bits there is nothing to say


@pytest.mark.parametrize(
    ("said", "is_pattern"),
    [
        ("bayer_rggb8; jpeg compressed ", True),
        ("bayer_rggb8; png compressed bayer_rggb8", True),
        ("bayer_rggb8; jpeg compressed mono8", False),
        ("mono8; jpeg compressed mono8", False),
        ("jpeg", False),
    ],
)
def test_compressed_bayer_patterns_become_colours(tmp_path: Path, said: str, is_pattern: bool) -> None:
    """image_transport compresses a pattern as it is, as a gray image; converted ones say so last."""
    kind = ".png" if "png" in said else ".jpg"
    content = cv2.imencode(kind, mosaic("rggb", FLAT))[1].tobytes()
    made = stereo()
    without("/left/image_raw")(made)
    for f in range(2):
        made.compressed("/left/image_raw/compressed", START_US + f * PERIOD_US, "left", content, said)
    made.compressed("/left/image_raw/compressed", START_US + 2 * PERIOD_US, "left", content[:-40], said)
    drive, summary = imported(made, tmp_path)
    file = drive.root / next(image.file for image in drive.images if drive.cameras[image.camera].name == "left")
    assert (file.suffix == ".png") == (is_pattern or kind == ".png")
    assert any("a compressed image is damaged" in note for note in summary.notes) == is_pattern
    if is_pattern:
        assert np.abs(read_image_rgb(file)[2:-2, 2:-2].astype(int) - FLAT[2:-2, 2:-2]).max() <= 10
    else:
        assert file.read_bytes() == content


def test_topics_whose_cameras_would_have_one_name_are_named(tmp_path: Path) -> None:
    made = stereo()
    for topic in ("/a/left/image_raw", "/a_left/image_raw"):
        made.image(topic, START_US, "left", picture(0))
    message = refused(made, tmp_path)
    assert "several topics are of camera a_left: /a/left/image_raw, /a_left/image_raw" in message
    assert "--topics" in message


def test_images_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    made = stereo()
    packed(RGB, "nv21")(made)
    assert "/left/image_raw: images are encoded as 'nv21', which is not known" in refused(made, tmp_path)
    made = stereo()
    packed(RGB[:, :-1, :2], "yuv422")(made)
    (tmp_path / "odd").mkdir()
    assert "/left/image_raw: an image of 47 columns as yuv422" in refused(made, tmp_path / "odd")
    made = stereo()
    made.image("/left/image_raw", START_US + 30_000, "left", picture(1)[:16])
    (tmp_path / "second").mkdir()
    _, summary = imported(made, tmp_path / "second")
    assert (
        "Left out: 1 images of /left/image_raw. The first: /left/image_raw: images have 48x32 and 48x16"
        in (summary.notes[0])
    )
    made = stereo()
    made.kept[-2][2].data = made.kept[-2][2].data[:100]
    (tmp_path / "third").mkdir()
    assert "an image of 48x32 pixels as mono8 has 100 bytes in rows of 48" in refused(made, tmp_path / "third")


def test_distances_are_no_pictures_and_repeated_stamps_are_counted(tmp_path: Path) -> None:
    made = stereo()
    made.image("/depth/image_raw", START_US, "left", picture(0).astype("<u2"), "16UC1")
    made.image("/left/image_raw", START_US, "left", picture(77))
    png = cv2.imencode(".png", np.full((SIZE[1], SIZE[0]), 1200, np.uint16))[1].tobytes()
    made.compressed("/depth_b/image_raw/compressed", START_US, "left", png, "16UC1; png compressed ")
    drive, summary = imported(made, tmp_path)
    assert "Left out: /depth/image_raw, which holds distances." in summary.notes
    assert "Left out: /depth_b/image_raw/compressed, which holds distances." in summary.notes
    assert "Left out: 1 images of /left/image_raw with a stamp that an earlier one has." in summary.notes
    assert np.array_equal(read_image_gray(drive.root / drive.images[0].file), picture(0))


def test_frames_and_a_stamp_that_is_not_set(tmp_path: Path) -> None:
    made = stereo()
    for _, time_us, message in made.kept:
        if hasattr(message, "header"):
            message.header.stamp.sec = message.header.stamp.nanosec = 0
            del time_us
    path = made.write(tmp_path / "bag", "mcap", late_us=0)
    summary = import_recording(path, tmp_path / "drive", frames="1:3")
    assert summary.images == 4
    for name in ("left", "right"):
        assert any(f"4 images of /{name}/image_raw have no stamp" in note for note in summary.notes)
    drive = read_drive(tmp_path / "drive")
    assert drive.timestamps_us.tolist() == [START_US + PERIOD_US, START_US + 2 * PERIOD_US]
    assert np.array_equal(read_image_gray(drive.root / drive.images[0].file), picture(2))


def test_messages_beside_a_database_are_not_lost(tmp_path: Path) -> None:
    """A recorder in SQLite's WAL mode that is killed leaves the last messages in a file of their own."""
    whole = stereo().write(tmp_path / "whole", "sqlite")
    file = next(whole.glob("*.db3"))
    recorder = sqlite3.connect(file)
    recorder.execute("PRAGMA journal_mode = WAL")
    rows = recorder.execute("SELECT * FROM messages").fetchall()
    recorder.execute("DELETE FROM messages")
    recorder.commit()
    recorder.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    recorder.executemany(f"INSERT INTO messages VALUES ({', '.join('?' * len(rows[0]))})", rows)
    recorder.commit()
    killed = shutil.copytree(whole, tmp_path / "killed")
    recorder.close()
    for path in (killed, killed / file.name):
        with pytest.raises(InputError, match=r"\.db3 is not whole: .*\.db3-wal holds what its recorder") as found:
            import_recording(path, tmp_path / "drive")
        assert f"sqlite3 {file.name} VACUUM" in found.value.remedy
    repaired = sqlite3.connect(killed / file.name)  # as the remedy does
    repaired.execute("VACUUM")
    repaired.close()
    assert import_recording(killed, tmp_path / "drive").images == 8


# Calibrations beside the bag


def camchain(right_from_left: np.ndarray) -> str:
    lines = []
    for number, (name, model) in enumerate((("left", "radtan"), ("right", "equidistant"))):
        lines += [f"cam{number}:", *(["  T_cn_cnm1:"] if number else [])]
        lines += [f"  - {row}" for row in right_from_left.tolist()] if number else []
        lines += ["  camera_model: pinhole", "  distortion_coeffs: [0.1, 0.2, 0.01, 0.02]"]
        lines += [f"  distortion_model: {model}", "  intrinsics: [50.0, 51.0, 23.5, 15.5]"]
        lines += [f"  resolution: [{SIZE[0]}, {SIZE[1]}]", f"  rostopic: /{name}/image_raw/compressed"]
    return "\n".join(lines) + "\n"


def test_kalibrs_chain(tmp_path: Path) -> None:
    """Its lenses and relative poses count; only the first camera's place on the vehicle is from the transforms."""
    right_from_left = se3.transform(se3.exp_so3([0.01, 0.02, 0.03]), [-0.51, 0.01, 0.0])
    (tmp_path / "camchain.yaml").write_text(camchain(right_from_left))
    options = {"calibration": tmp_path / "camchain.yaml"}
    drive, summary = imported(stereo(), tmp_path, **options)
    assert drive.cameras[0].params == [50.0, 51.0, 24.0, 16.0, 0.1, 0.2, 0.01, 0.02]
    assert [camera.model for camera in drive.cameras] == ["OPENCV", "OPENCV_FISHEYE"]
    np.testing.assert_allclose(drive.rig_from_cam[0], LEFT, atol=1e-12)
    np.testing.assert_allclose(drive.rig_from_cam[1], LEFT @ se3.inverse(right_from_left), atol=1e-12)
    assert any(note.startswith("Rig frame: base_link") for note in summary.notes)
    made = stereo()
    without(STATIC)(made)
    without("/fix")(made)
    (tmp_path / "second").mkdir()
    drive, summary = imported(made, tmp_path / "second", **options)
    np.testing.assert_allclose(drive.rig_from_cam[0], se3.transform(OPTICAL, np.zeros(3)), atol=1e-12)
    assert any("taken to look level" in note for note in summary.notes)


def test_a_chain_in_order_of_names(tmp_path: Path) -> None:
    """Kalibr's YAML is in order of names: cam10 stands after cam1, and its pose is that in cam9."""
    step = se3.transform(se3.exp_so3([0.0, 0.1, 0.0]), [-0.1, 0.0, 0.0])
    blocks = [
        f"cam{number}:\n  T_cn_cnm1: {step.tolist()}\n  camera_model: pinhole\n  distortion_coeffs: [0, 0, 0, 0]\n"
        f"  distortion_model: radtan\n  intrinsics: [50, 51, 23.5, 15.5]\n  resolution: [48, 32]\n"
        f"  rostopic: /{number}\n"
        for number in range(12)
    ]
    (tmp_path / "camchain.yaml").write_text("".join(sorted(blocks)))
    chain = read_camchain(tmp_path / "camchain.yaml")
    assert [camera.name for camera in chain] == [f"cam{number}" for number in range(12)]
    for number, camera in enumerate(chain):
        first_from_cam = np.linalg.matrix_power(se3.inverse(step), number)
        np.testing.assert_allclose(camera.first_from_cam, first_from_cam, atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("/left/image_raw", "/front/image_raw", "has no camera with the images /left/image_raw, but /front, /right"),
        ("resolution: [48", "resolution: [96", "cam0: is of 96x32 pixels, the images /left/image_raw have 48x32"),
        ("distortion_model: radtan", "distortion_model: fov", "cam0: distortion model 'fov' is not known"),
        ("camera_model: pinhole", "camera_model: ds", "cam0: camera_model 'ds' with 4 intrinsics is not known"),
        ("  T_cn_cnm1:", "  T_other:", "cam1: T_cn_cnm1 is missing"),
        ("cam0:", "cam0: [", "is not YAML"),
        ("/left/image_raw/compressed", "2024-13-45", "camchain.yaml is not YAML: month must be in 1..12"),
        ("camera_model: pinhole", "camera_model: !!int pinhole", "camchain.yaml is not YAML: invalid literal"),
        ("camera_model: pinhole", "camera_model: !!bool pinhole", "camchain.yaml is not YAML: 'pinhole'"),
        ("intrinsics: [50.0", "intrinsics: [abc", "cam0.intrinsics.0: Input should be a valid number"),
    ],
)
def test_a_chain_that_does_not_fit_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = camchain(se3.transform(np.eye(3), [-0.5, 0, 0]))
    (tmp_path / "camchain.yaml").write_text(text.replace(old, new))
    assert message in refused(stereo(), tmp_path, calibration=tmp_path / "camchain.yaml")


def test_a_time_shift_of_the_chain_is_noted(tmp_path: Path) -> None:
    text = camchain(se3.transform(np.eye(3), [-0.5, 0, 0]))
    (tmp_path / "camchain.yaml").write_text(text.replace("cam0:\n", "cam0:\n  timeshift_cam_imu: 0.033\n"))
    _, summary = imported(stereo(), tmp_path, calibration=tmp_path / "camchain.yaml")
    assert any("timeshift_cam_imu is not applied: cam0 (0.033 s)." in note for note in summary.notes)


def test_a_transposed_chain_is_refused(tmp_path: Path) -> None:
    right_from_left = se3.transform(np.eye(3), [-0.5, 0, 0])
    (tmp_path / "camchain.yaml").write_text(camchain(right_from_left.T))
    message = refused(stereo(), tmp_path, calibration=tmp_path / "camchain.yaml")
    assert "camchain.yaml: cam1: T_cn_cnm1: the fourth row is -0.5, 0, 0, 1" in message
    assert "transposed?" in message


def test_a_rig_file_replaces_camera_info_and_transforms(tmp_path: Path) -> None:
    poses = {"left": LEFT, "right": RIGHT}
    cameras: dict[str, Any] = {
        name: {"width": SIZE[0], "height": SIZE[1], "K": K, "T_body_cam": pose.tolist()} for name, pose in poses.items()
    }
    cameras["left"]["readout"] = 30_000
    (tmp_path / "rig.json").write_text(json.dumps({"body_axes": "flu", "cameras": cameras}))
    made = stereo()
    for topic in (STATIC, "/left/camera_info", "/right/camera_info"):
        without(topic)(made)
    options = {"calibration": tmp_path / "rig.json"}
    assert "--antenna" in refused(made, tmp_path, **options)
    (tmp_path / "second").mkdir()
    drive, summary = imported(made, tmp_path / "second", **options, antenna_m=[0, 0, 2])
    assert "rig.json: cameras: not known, and not read: readout (is it readout_us?)." in summary.notes
    np.testing.assert_allclose(drive.rig_from_cam, [LEFT, RIGHT], atol=1e-12)
    del cameras["right"]
    (tmp_path / "rig.json").write_text(json.dumps({"body_axes": "flu", "cameras": cameras}))
    (tmp_path / "third").mkdir()
    text = refused(made, tmp_path / "third", **options)
    assert "has no camera 'right', which /right/image_raw is of" in text


# Damage and commands


@pytest.mark.parametrize(("kind", "compression"), [("mcap", "lz4"), ("mcap", "zstd"), ("ros1", "lz4"), ("ros1", "bz2")])
def test_a_chunk_is_not_taken_to_the_end_of_the_memory(
    tmp_path: Path, kind: str, compression: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A few kilobytes decompress to 16 MB: they are refused, whatever the chunk says of its size."""
    made = stereo(is_ros1=kind == "ros1")
    blank = np.zeros((4000, 4000), np.uint8)
    made.image("/left/image_raw", START_US + 350_000, "left", blank)
    if kind == "ros1":
        path = tmp_path / "bag.bag"
        writer = rosbag1.Writer(path)
        writer.set_compression(rosbag1.Writer.CompressionFormat[compression.upper()])
        with writer as bag:
            made.write_into(bag)
    else:
        path = compressed_mcap(made, tmp_path, compression)
    assert path.stat().st_size < 1e6
    assert import_recording(path, tmp_path / "drive").images == 8
    monkeypatch.setattr(bag_reader, "MAX_CHUNK_BYTES", 4_000_000)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"bag .* cannot be read: .*holds over 4 MB"):
            import_recording(path, tmp_path / "none")
        assert tracemalloc.get_traced_memory()[1] < 14e6
    finally:
        tracemalloc.stop()


def zstd_bag(made: Messages, path: Path, mode: str, *, storage: str = "sqlite") -> Path:
    """The messages as `ros2 bag record --compression-mode file` (or message) writes them."""
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(rosbag2.CompressionMode[mode.upper()], rosbag2.CompressionFormat.ZSTD)
    with writer as bag:
        made.write_into_ros2(bag)
    return path


@pytest.mark.parametrize(("mode", "storage"), [("file", "sqlite"), ("file", "mcap"), ("message", "sqlite")])
def test_bags_of_ros_2_in_zstd(tmp_path: Path, mode: str, storage: str, monkeypatch: pytest.MonkeyPatch) -> None:
    made = stereo()
    bag = zstd_bag(made, tmp_path / "recorded", mode, storage=storage)
    (tmp_path / "there").mkdir()
    # What rosbags itself would take out of zstd lies there, and nowhere else.
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "no such folder"))
    before = sorted(bag.iterdir())
    assert import_recording(bag, tmp_path / "there" / "drive").images == 8
    assert read_drive(tmp_path / "there" / "drive").manifest.name == "recorded"
    assert [path.name for path in (tmp_path / "there").iterdir()] == ["drive"]
    assert sorted(bag.iterdir()) == before


@pytest.mark.parametrize("is_stated", [True, False])
def test_a_file_in_zstd_does_not_fill_the_disk(
    tmp_path: Path, is_stated: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some kilobytes say, or are, 200 MB more: they are refused by name, and nothing is left."""
    bag = zstd_bag(stereo(), tmp_path / "recorded", "file")
    (file,) = bag.glob("*.zstd")
    packer = ZstdCompressor()
    if is_stated:
        packer.set_pledged_input_size(200_000_000)
    with file.open("wb") as sink:
        for _ in range(200):
            sink.write(packer.compress(bytes(1_000_000)))
        sink.write(packer.flush())
    assert file.stat().st_size < 1e6
    usage = shutil.disk_usage(tmp_path)._replace(free=20_000_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    (tmp_path / "there").mkdir()
    with pytest.raises(InputError, match=rf"bag file .*{file.name} is compressed.* over 10 MB") as found:
        import_recording(bag, tmp_path / "there" / "drive")
    assert found.value.code == "bag-too-large"
    assert [*(tmp_path / "there").iterdir()] == []


def test_a_message_in_zstd_does_not_fill_the_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = stereo()
    made.image("/left/image_raw", START_US + 350_000, "left", np.zeros((4000, 4000), np.uint8))
    bag = zstd_bag(made, tmp_path / "recorded", "message")
    assert sum(file.stat().st_size for file in bag.iterdir()) < 1e6
    monkeypatch.setattr(bag_reader, "MAX_CHUNK_BYTES", 4_000_000)
    with pytest.raises(InputError, match=r"bag .*recorded cannot be read: .*holds over 4 MB"):
        import_recording(bag, tmp_path / "none")


@pytest.mark.parametrize("keep", [0, 10, 0.5])
def test_a_damaged_file_in_zstd_is_refused(tmp_path: Path, keep: float) -> None:
    bag = zstd_bag(stereo(), tmp_path / "recorded", "file")
    (file,) = bag.glob("*.zstd")
    whole = file.read_bytes()
    file.write_bytes(whole[: int(keep if keep > 1 else keep * len(whole))])
    with pytest.raises(InputError, match=r"bag .*recorded cannot be read: "):
        import_recording(bag, tmp_path / "drive")
    assert not (tmp_path / "drive").exists()


@pytest.mark.parametrize("kind", FORMATS)
def test_damaged_bags_are_refused_by_name(tmp_path: Path, kind: str) -> None:
    path = stereo(is_ros1=kind == "ros1").write(tmp_path / ("bag.bag" if kind == "ros1" else "bag"), kind)
    file = path if kind == "ros1" else path / ("bag.mcap" if kind == "mcap" else "bag.db3")
    whole = file.read_bytes()
    rng = np.random.default_rng(11)
    refusals = 0
    for attempt in range(40):
        damaged = bytearray(whole)
        if attempt % 2:
            del damaged[int(rng.integers(len(whole))) :]
        else:
            for place in rng.integers(len(whole), size=30):
                damaged[place] ^= int(rng.integers(1, 256))
        file.write_bytes(damaged)
        try:
            import_recording(path, tmp_path / f"drive{attempt}")
        except InputError:  # and no other error
            refusals += 1
            assert not (tmp_path / f"drive{attempt}").exists()
    assert 15 < refusals <= 40


@pytest.mark.parametrize("kind", FORMATS)
def test_a_definition_without_a_field_of_the_standard_is_refused(tmp_path: Path, kind: str) -> None:
    path = stereo(is_ros1=kind == "ros1").write(tmp_path / ("bag.bag" if kind == "ros1" else "bag"), kind)
    file = path if kind == "ros1" else path / ("bag.mcap" if kind == "mcap" else "bag.db3")
    whole = file.read_bytes()
    assert whole.count(b"distortion_model")
    file.write_bytes(whole.replace(b"distortion_model", b"distortion_madel"))
    with pytest.raises(InputError, match="definition of sensor_msgs/msg/CameraInfo has no field distortion_model"):
        import_recording(path, tmp_path / "drive")
    assert not (tmp_path / "drive").exists()


def test_a_recording_of_another_kind_in_mcap_is_refused(tmp_path: Path) -> None:
    path = stereo().write(tmp_path / "bag", "mcap") / "bag.mcap"
    path.write_bytes(path.read_bytes().replace(b"ros2", b"ros1", 1))
    with pytest.raises(InputError, match=r"bag .*bag\.mcap cannot be read: Profile is not ros2"):
        import_recording(path, tmp_path / "drive")


def test_options_of_bags_are_of_no_use_elsewhere(tmp_path: Path) -> None:
    (tmp_path / "rig.json").write_text("{}")
    with pytest.raises(InputError, match="no use for --gnss-sigma, --topics"):
        import_recording(tmp_path, tmp_path / "drive", options={"gnss_sigma_m": 1.0, "topics": ["/a"]})
    file = tmp_path / "notes.txt"
    file.write_text("none")
    with pytest.raises(InputError, match=r"the layout of .*notes.txt is not known"):
        import_recording(file, tmp_path / "drive")


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = stereo()
    made.transform(STATIC, START_US, "base_link", "footprint", np.eye(4))
    path = made.write(tmp_path / "bag", "sqlite")
    topics = "/left/image_raw,/right/image_raw,/fix"
    options = ["--topics", topics, "--rig-frame", "footprint", "--antenna=-1,0,2", "--gnss-sigma", "0.5"]
    assert main(["import", str(path), "--out", str(tmp_path / "drive"), *options]) == 0
    said = capsys.readouterr().out
    assert f"Imported {path} (ROS bag): 2 cameras, 4 units, 8 images" in said
    assert bags.READOUT_NOTE in said
    gnss = read_drive(tmp_path / "drive").manifest.gnss
    assert gnss is not None
    assert gnss.antenna_in_rig_m == [-1.0, 0.0, 2.0]
    for wrong in ("--antenna=1,2", "--gnss-sigma=0"):
        with pytest.raises(SystemExit):
            main(["import", str(path), "--out", str(tmp_path / "other"), wrong])


@pytest.mark.real
@pytest.mark.parametrize("kind", [FORMATS[0], *slow(*FORMATS[1:])])
def test_kitti_06_as_a_bag(shared_data: Path, tmp_path: Path, kind: str) -> None:
    import_recording(shared_data / "kitti06", tmp_path / "direct")
    direct = read_drive(tmp_path / "direct")
    made = messages_of_drive(direct, is_ros1=kind == "ros1", start_us=START_US, compressed=kind == "sqlite")
    path = made.write(tmp_path / ("bag.bag" if kind == "ros1" else "bag"), kind)
    import_recording(path, tmp_path / "drive")
    drive = read_drive(tmp_path / "drive")
    assert drive.cameras == direct.cameras
    assert (drive.timestamps_us - START_US).tolist() == direct.timestamps_us.tolist()
    one, other = drive.manifest.gnss, direct.manifest.gnss
    assert one is not None
    assert other is not None
    np.testing.assert_allclose(one.antenna_in_rig_m, other.antenna_in_rig_m, atol=1e-9)
    places = [[(s.latitude_deg, s.longitude_deg, s.height_m) for s in gnss.samples] for gnss in (one, other)]
    frame = ecef_from_local(places[0][0])
    local = [local_from_geodetic(np.array(place), frame) for place in places]
    assert np.abs(local[0] - local[1]).max() < 1e-3
    assert np.linalg.norm(local[0][-1]) > 30.0
    for image in direct.images[::10]:
        assert np.array_equal(*(read_image_gray(d.root / image.file) for d in (drive, direct)))
