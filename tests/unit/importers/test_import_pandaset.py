from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.geodesy import ecef_from_local, geodetic_from_local
from mrasfm_engine.importers.layouts import import_recording
from mrasfm_engine.preflight.drive_reader import check_drive, read_drive

START_S = 1_557_539_956.0
FRAMES = 6
# After the vehicle's pose, seconds; the vehicle drives 5 m/s north in the world of the poses.
OFFSET_S = {"front_camera": -0.05, "left_camera": -0.08}
RIG_FROM_CAM = {
    "front_camera": se3.transform([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [1.5, 0.0, 1.6]),
    "left_camera": se3.transform([[1, 0, 0], [0, 0, 1], [0, -1, 0]], [0.5, 0.6, 1.5]),
}
VEHICLE_FROM_RIG = se3.transform([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [0, 0, 0])
PLACE = [37.776, -122.399, 2.95]


def world_from_rig(time_s: float) -> np.ndarray:
    return se3.transform(se3.exp_so3([0, 0, np.pi / 2]), [0.0, 5.0 * (time_s - START_S), 0.0])


def row(pose: np.ndarray) -> dict[str, Any]:
    x, y, z, w = se3.quaternion_from_rotation(pose[:3, :3]).tolist()
    position = dict(zip("xyz", pose[:3, 3].tolist(), strict=True))
    return {"position": position, "heading": {"w": w, "x": x, "y": y, "z": z}}


def write(folder: Path, times_s: list[float], poses: list[np.ndarray]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "timestamps.json").write_text(json.dumps(times_s))
    (folder / "poses.json").write_text(json.dumps([row(pose) for pose in poses]))


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    folder = tmp_path / "pandaset" / "002"
    times_s = [START_S + 0.1 * i for i in range(FRAMES)]
    write(folder / "lidar", times_s, [world_from_rig(t) @ se3.inverse(VEHICLE_FROM_RIG) for t in times_s])
    for name, offset_s in OFFSET_S.items():
        camera, seen_s = folder / "camera" / name, [t + offset_s for t in times_s]
        write(camera, seen_s, [world_from_rig(t) @ RIG_FROM_CAM[name] for t in seen_s])
        (camera / "intrinsics.json").write_text(json.dumps({"fx": 40.0, "fy": 40.0, "cx": 23.5, "cy": 15.5}))
        for i in range(FRAMES):
            cv2.imwrite(str(camera / f"{i:02d}.jpg"), np.full((32, 48, 3), 9 * i, np.uint8))
    meta, frame = folder / "meta", ecef_from_local(PLACE)
    places = [geodetic_from_local(world_from_rig(t)[None, :3, 3], frame)[0].tolist() for t in times_s]
    meta.mkdir()
    (meta / "timestamps.json").write_text(json.dumps(times_s))
    (meta / "gps.json").write_text(json.dumps([{"lat": a, "long": b, "height": c, "xvel": 0.0} for a, b, c in places]))
    return folder


@pytest.mark.parametrize("given", [".", ".."])
def test_sequence(sequence: Path, tmp_path: Path, given: str) -> None:
    summary = import_recording(sequence / given, tmp_path / "drive")
    assert (summary.layout, summary.cameras, summary.images, summary.truth) == ("PandaSet", 2, 12, True)
    drive = read_drive(tmp_path / "drive")
    assert [f.code for f in check_drive(drive)] == []
    assert drive.manifest.name == "pandaset-002"
    assert [camera.name for camera in drive.cameras] == list(OFFSET_S)
    assert drive.cameras[0].params == [40, 40, 24, 16]
    np.testing.assert_allclose(drive.rig_from_cam, list(RIG_FROM_CAM.values()), atol=1e-6)


def test_units_lie_in_the_middle_of_their_images(sequence: Path, tmp_path: Path) -> None:
    import_recording(sequence, tmp_path / "drive")
    frames = read_drive(tmp_path / "drive").manifest.frames
    start_us = int(START_S * 1e6)
    assert [frame.timestamp_us - start_us for frame in frames] == [100_000 * i - 65_000 for i in range(FRAMES)]
    assert frames[2].images["left_camera"].timestamp_us == start_us + 120_000
    truth = np.loadtxt(tmp_path / "drive/truth.tum")
    assert len(truth) == FRAMES - 1  # the first unit lies before the vehicle's first pose
    np.testing.assert_allclose(truth[:, 2], 5.0 * (truth[:, 0] - START_S), atol=1e-5)
    np.testing.assert_allclose(truth[:, 1], 0.0, atol=1e-9)


def test_gnss_is_the_vehicles_and_of_the_selected_frames(sequence: Path, tmp_path: Path) -> None:
    import_recording(sequence, tmp_path / "drive")
    gnss = read_drive(tmp_path / "drive").manifest.gnss
    assert gnss is not None
    assert len(gnss.samples) == FRAMES
    assert gnss.antenna_in_rig_m == [0, 0, 0]
    assert gnss.samples[0].latitude_deg == pytest.approx(PLACE[0], abs=1e-9)
    (sequence / "meta" / "gps.json").unlink()
    assert import_recording(sequence, tmp_path / "without").notes == []
    assert read_drive(tmp_path / "without").manifest.gnss is None


def test_one_of_several_sequences(sequence: Path, tmp_path: Path) -> None:
    root = sequence.parent
    (root / "053" / "camera").mkdir(parents=True)
    write(root / "053" / "lidar", [0.0], [np.eye(4)])
    with pytest.raises(InputError, match="2 scenes: 002, 053"):
        import_recording(root, tmp_path / "drive")
    with pytest.raises(InputError, match="no scene '054'"):
        import_recording(root, tmp_path / "drive", scene="054")
    assert import_recording(root, tmp_path / "drive", scene="002").images == 12


def changed(file: Path, place: list[Any], value: Any) -> None:
    document = json.loads(file.read_text())
    inner = document
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    file.write_text(json.dumps(document))


@pytest.mark.parametrize(
    ("file", "place", "value", "message"),
    [
        ("meta/gps.json", [2, "lat"], 122.0, "gps.json, sample 2: latitude_deg 122"),
        ("meta/timestamps.json", [3], 5.0, r"meta/timestamps.json: .* not increasing"),
        ("lidar/poses.json", [1, "heading", "w"], 3.0, r"lidar/poses.json: its headings are no unit quaternions"),
        ("camera/left_camera/intrinsics.json", ["fx"], -40.0, r"left_camera/intrinsics.json: params"),
        ("camera/left_camera/poses.json", [1, "position"], {"x": 0.0, "y": 0.0}, r"poses.json.*z"),
    ],
)
def test_malformed_files_are_named(
    sequence: Path, tmp_path: Path, file: str, place: list[Any], value: Any, message: str
) -> None:
    changed(sequence / file, place, value)
    with pytest.raises(InputError, match=message):
        import_recording(sequence, tmp_path / "drive")
    assert not (tmp_path / "drive").exists()


def test_cameras_whose_poses_are_not_the_vehicles_are_refused(sequence: Path, tmp_path: Path) -> None:
    camera = sequence / "camera" / "left_camera"
    rng = np.random.default_rng(0)
    for i in range(FRAMES):
        changed(camera / "poses.json", [i, "position", "x"], float(rng.uniform(-1, 1)))
    with pytest.raises(InputError, match=r"left_camera: its poses and the vehicle's disagree by"):
        import_recording(sequence, tmp_path / "drive")
