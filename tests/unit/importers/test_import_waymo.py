from __future__ import annotations

import tracemalloc
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pyarrow import parquet, table

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.importers.layouts import import_recording
from mrasfm_engine.preflight.drive_reader import check_drive, read_drive, write_manifest
from mrasfm_engine.scene.drive import Drive, pose_from_matrix
from schemas import Camera, DriveManifest, Frame, FrameImage, Rig
from schemas.drive import ReadoutDirection
from tests.helpers.waymo_writing import CAMERAS, write_segment

SEGMENT = "10750135302241325253_180_000_200_000"
START_US = 1_553_629_304_740_000
FRAMES = 4
FIRST = se3.transform(se3.exp_so3([0.01, 0.0, 2.1]), [-5639.2, 22890.1, 31.5])
OPTICAL = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
TABLES = ("camera_image", "camera_calibration", "vehicle_pose")


def pose(time_us: int) -> np.ndarray:
    return FIRST @ se3.transform(np.eye(3), [9e-6 * (time_us - START_US), 0, 0])


def cameras() -> list[Camera]:
    lens = [40.0, 41.0, 23.7, 16.2]
    models = {
        "front": ("FULL_OPENCV", [*lens, 0.05, -0.3, 1e-3, -2e-3, 0.01, 0, 0, 0]),
        "front_left": ("OPENCV", [*lens, 0.05, -0.3, 1e-3, -2e-3]),
        "front_right": ("PINHOLE", lens),
        "side_left": ("PINHOLE", lens),
        "side_right": ("PINHOLE", lens),
    }
    directions = [*ReadoutDirection, None]
    yaws = [0.0, 0.8, -0.8, 1.6, -1.6]
    return [
        Camera(
            name=name,
            model=models[name][0],
            width=48,
            height=32,
            params=models[name][1],
            rig_from_cam=pose_from_matrix(se3.transform(se3.exp_so3([0, 0, yaw]) @ OPTICAL, [1.5, 0.1 * i, 2.1])),
            readout_us=0 if direction is None else 20_000,
            **({} if direction is None else {"readout_direction": direction}),
        )
        for i, (name, direction, yaw) in enumerate(zip(CAMERAS, directions, yaws, strict=True))
    ]


@pytest.fixture
def given(tmp_path: Path) -> Drive:
    """Five cameras that read their images out in all directions, one after the other."""
    root = tmp_path / "given"
    rng = np.random.default_rng(8)
    frames = []
    for f in range(FRAMES):
        images = {}
        for i, name in enumerate(CAMERAS):
            (root / name).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(root / name / f"{f}.jpg"), rng.integers(0, 256, (32, 48, 3), dtype=np.uint8))
            time_us = START_US + 100_000 * f + 11_000 * i
            images[name] = FrameImage(file=f"{name}/{f}.jpg", timestamp_us=time_us)
        frames.append(Frame(timestamp_us=START_US + 100_000 * f + 22_000, source_frame=f, images=images))
    manifest = DriveManifest(version=2, name=f"waymo-{SEGMENT}", rig=Rig(cameras=cameras()), frames=frames)
    write_manifest(manifest, root)
    return read_drive(root)


@pytest.fixture
def segment(given: Drive, tmp_path: Path) -> Path:
    times_us = {image.timestamp_us for image in given.images} | set(given.timestamps_us.tolist())
    return write_segment(given, {t: pose(t) for t in times_us}, tmp_path / "waymo", SEGMENT)


def test_segment(given: Drive, segment: Path, tmp_path: Path) -> None:
    summary = import_recording(segment, tmp_path / "drive")
    assert (summary.layout, summary.cameras, summary.units) == ("Waymo, version 2", 5, FRAMES)
    assert (summary.images, summary.truth, summary.notes) == (5 * FRAMES, True, [])
    drive = read_drive(tmp_path / "drive")
    assert [f.code for f in check_drive(drive)] == []
    # k3 stays, all readouts stay, and pixels count from the corner already.
    for one, other in zip(drive.cameras, given.cameras, strict=True):
        assert one.model_dump(exclude={"rig_from_cam"}) == other.model_dump(exclude={"rig_from_cam"})
    np.testing.assert_allclose(drive.rig_from_cam, given.rig_from_cam, atol=1e-12)
    assert drive.timestamps_us.tolist() == given.timestamps_us.tolist()
    assert [image.timestamp_us for image in drive.images] == [image.timestamp_us for image in given.images]
    for image, source in zip(drive.images, given.images, strict=True):
        assert (drive.root / image.file).read_bytes() == (given.root / source.file).read_bytes()
    truth = np.loadtxt(tmp_path / "drive" / "truth.tum")
    np.testing.assert_allclose(truth[1, 1:4], pose(START_US + 122_000)[:3, 3], atol=1e-5)


def test_frames_and_cameras(segment: Path, tmp_path: Path) -> None:
    summary = import_recording(segment, tmp_path / "drive", frames="1:3", cameras=["side_left", "front"])
    assert (summary.cameras, summary.images) == (2, 4)


def test_images_are_read_a_few_at_a_time(given: Drive, segment: Path, tmp_path: Path) -> None:
    file = segment / "camera_image" / f"{SEGMENT}.parquet"
    rows = parquet.read_table(file).to_pydict()
    noise = np.random.default_rng(0).integers(0, 256, 2_000_000, dtype=np.uint8).tobytes()
    rows["[CameraImageComponent].image"] = [
        content[:-2] + noise + content[-2:] for content in rows["[CameraImageComponent].image"]
    ]
    parquet.write_table(table(rows), file, row_group_size=2, compression="none")
    import_recording(segment, tmp_path / "warm", frames="0:1")
    tracemalloc.start()
    try:
        import_recording(segment, tmp_path / "drive")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert 2e6 < peak < 20e6  # of 40 MB


def changed(folder: Path, kind: str, **columns: Any) -> None:
    file = folder / kind / f"{SEGMENT}.parquet"
    rows = parquet.read_table(file).to_pydict()
    for name, value in columns.items():
        full = next(key for key in rows if key.endswith(name))
        if value is None:
            del rows[full]
        else:
            rows[full] = value(rows[full])
    parquet.write_table(table(rows), file)


@pytest.mark.parametrize(
    ("kind", "column", "value", "message"),
    [
        ("camera_image", "shutter", None, r"rolling_shutter_params\.shutter: is not there"),
        ("camera_image", "camera_readout_done_time", lambda v: [v[0] + 0.01, *v[1:]], "camera front: images are read"),
        (
            "camera_image",
            "camera_trigger_time",
            lambda v: [1e6 * t for t in v],
            "trigger_time: holds a time that is no",
        ),
        ("camera_image", "pose_timestamp", lambda v: [1e300, *v[1:]], "pose_timestamp: holds a time that is no"),
        ("camera_image", "frame_timestamp_micros", lambda v: v[::-1], "micros 1553629304862000 were not taken after"),
        (
            "camera_image",
            "pose.transform",
            lambda v: [[*v[0][:3], 1e200, *v[0][4:]], *v[1:]],
            r"pose\.transform: row 0 holds a coordinate beyond 1e\+08 m",
        ),
        ("camera_image", "camera_name", lambda v: [9, *v[1:]], "camera 9 is not known"),
        ("camera_image", "frame_timestamp_micros", lambda v: v[:1] * len(v), "several images of one camera at one"),
        (
            "vehicle_pose",
            "frame_timestamp_micros",
            lambda v: [2**63 - 1, *v[1:]],
            "holds a value that is no integer up",
        ),
        ("camera_image", ".image", lambda v: [b"none", *v[1:]], "is neither a JPEG nor a PNG"),
        (
            "camera_image",
            "pose.transform",
            lambda v: [[1.0] * 12 + [0.0] * 3 + [1.0], *v[1:]],
            r"row 0: .*pose\.transform is not a rigid",
        ),
        (
            "camera_image",
            "pose.transform",
            lambda v: [[1.0] * 16, *v[1:]],
            r"row 0: .*pose\.transform: the fourth row is",
        ),
        (
            "camera_calibration",
            "width",
            lambda v: [64, *v[1:]],
            "front, .* of 48x32 pixels, the calibration is of 64x32",
        ),
        ("camera_calibration", "camera_name", lambda v: [*v[:4], 4], "camera side_left has 2 rows"),
        ("camera_calibration", "extrinsic.transform", lambda v: [[2.0] * 3, *v[1:]], "row 0 is not 16 numbers"),
        ("camera_calibration", "intrinsic.f_u", lambda v: [1.0, *v[1:]], "focal length fx = 1"),
        ("camera_calibration", "intrinsic.k3", None, r"intrinsic\.k3: is not there"),
        ("vehicle_pose", "transform", None, r"world_from_vehicle\.transform: is not there"),
    ],
)
def test_malformed_tables_are_named(
    segment: Path, tmp_path: Path, kind: str, column: str, value: Any, message: str
) -> None:
    changed(segment, kind, **{column: value})
    with pytest.raises(InputError, match=message) as caught:
        import_recording(segment, tmp_path / "drive")
    assert SEGMENT in caught.value.what
    assert not (tmp_path / "drive").exists()


@pytest.mark.parametrize("kind", TABLES)
def test_damaged_tables_are_named(segment: Path, tmp_path: Path, kind: str) -> None:
    file = segment / kind / f"{SEGMENT}.parquet"
    whole = file.read_bytes()
    for kept in (0, 4, len(whole) // 2, len(whole) - 6):
        file.write_bytes(whole[:kept])
        with pytest.raises(InputError, match=f"{kind}/{SEGMENT}"):
            import_recording(segment, tmp_path / "drive")


def test_an_unknown_direction_is_noted(segment: Path, tmp_path: Path) -> None:
    changed(segment, "camera_calibration", rolling_shutter_direction=lambda v: [0, *v[1:]])
    summary = import_recording(segment, tmp_path / "drive")
    assert summary.notes == ["Shutter: the readout direction of a camera is not known."]
    assert read_drive(tmp_path / "drive").cameras[0].readout_us is None


def test_one_of_several_segments_and_no_poses(given: Drive, segment: Path, tmp_path: Path) -> None:
    write_segment(given, {image.timestamp_us: pose(image.timestamp_us) for image in given.images}, segment, "other")
    with pytest.raises(InputError, match=f"2 scenes: {SEGMENT}, other"):
        import_recording(segment, tmp_path / "drive")
    (segment / "vehicle_pose" / "other.parquet").unlink()
    assert import_recording(segment, tmp_path / "drive", scene="other").truth  # by the poses of the images
