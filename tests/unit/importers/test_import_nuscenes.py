from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.importers.layouts import import_recording
from mrasfm_engine.importers.recording import RoughQuality
from mrasfm_engine.preflight.drive_reader import check_drive, read_drive

START_US = 1_532_402_927_000_000
FRONT, BACK = "CAM_FRONT", "CAM_BACK"
SENSORS = ("LIDAR_TOP", FRONT, BACK)
OFFSET_US = {"LIDAR_TOP": 47_000, FRONT: 12_000, BACK: 37_000}
# Camera to ego, w x y z: the cameras look forward and back.
ROTATION = {FRONT: [0.5, -0.5, 0.5, -0.5], BACK: [0.5, -0.5, -0.5, 0.5], "LIDAR_TOP": [1.0, 0.0, 0.0, 0.0]}
TRANSLATION = {FRONT: [1.7, 0.0, 1.5], BACK: [0.0, 0.0, 1.5], "LIDAR_TOP": [0.9, 0.0, 1.8]}
Tables = dict[str, list[dict[str, Any]]]


def east_m(timestamp_us: int) -> float:
    return 600.0 + 10e-6 * (timestamp_us - START_US)


def make_tables() -> Tables:
    """Two scenes of four samples at 2 Hz, heading north-east, with a sweep between keyframes."""
    tables: Tables = {name: [] for name in ("scene", "sample", "sample_data", "ego_pose", "log")}
    tables["sensor"] = [
        {"token": f"s-{c}", "channel": c, "modality": "lidar" if c == "LIDAR_TOP" else "camera"} for c in SENSORS
    ]
    tables["calibrated_sensor"] = [
        {
            "token": f"c-{c}",
            "sensor_token": f"s-{c}",
            "translation": TRANSLATION[c],
            "rotation": ROTATION[c],
            "camera_intrinsic": [] if c == "LIDAR_TOP" else [[40.0, 0.0, 23.5], [0.0, 40.0, 15.5], [0.0, 0.0, 1.0]],
        }
        for c in SENSORS
    ]
    for s, scene in enumerate(("scene-0061", "scene-0103")):
        tokens = [f"{scene}-{i}" for i in range(4)]
        tables["scene"].append({"token": scene, "name": scene, "first_sample_token": tokens[0], "nbr_samples": 4})
        for i, token in enumerate(tokens):
            t = START_US + 100_000_000 * s + 500_000 * i
            following = tokens[i + 1] if i < 3 else ""
            tables["sample"].append({"token": token, "timestamp": t, "scene_token": scene, "next": following})
            for c in SENSORS:
                for key in (True, False):
                    add_data(tables, token, c, t + OFFSET_US[c] + (0 if key else 250_000), key)
    return tables


def add_data(tables: Tables, sample: str, channel: str, timestamp_us: int, key: bool) -> None:
    token = f"{channel}-{timestamp_us}"
    yaw = np.pi / 4
    tables["ego_pose"].append(
        {
            "token": token,
            "timestamp": timestamp_us,
            "rotation": [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)],
            "translation": [east_m(timestamp_us), 1600.0, 0.0],
        }
    )
    camera = channel != "LIDAR_TOP"
    tables["sample_data"].append(
        {
            "token": f"d-{token}",
            "sample_token": sample,
            "ego_pose_token": token,
            "calibrated_sensor_token": f"c-{channel}",
            "timestamp": timestamp_us,
            "is_key_frame": key,
            "filename": f"{'samples' if key else 'sweeps'}/{channel}/{timestamp_us}.{'jpg' if camera else 'bin'}",
            "width": 48 if camera else 0,
            "height": 32 if camera else 0,
        }
    )


def write_tables(root: Path, tables: Tables) -> Path:
    folder = root / "v1.0-mini"
    folder.mkdir(parents=True, exist_ok=True)
    for name, rows in tables.items():
        (folder / f"{name}.json").write_text(json.dumps(rows))
    return root


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    root = write_tables(tmp_path / "nuscenes", make_tables())
    rng = np.random.default_rng(5)
    for row in make_tables()["sample_data"]:
        if row["is_key_frame"] and row["width"]:
            file = root / row["filename"]
            file.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(file), rng.integers(0, 255, (32, 48, 3), dtype=np.uint8))
    return root


@pytest.mark.parametrize("inner", ["", "v1.0-mini"])
def test_scene(dataset: Path, tmp_path: Path, inner: str) -> None:
    summary = import_recording(dataset / inner, tmp_path / "drive", scene="scene-0103")
    assert (summary.layout, summary.cameras, summary.units, summary.images) == ("nuScenes", 2, 4, 8)
    drive = read_drive(tmp_path / "drive")
    assert check_drive(drive) == []
    assert [camera.name for camera in drive.cameras] == [BACK, FRONT]
    assert drive.cameras[1].params == [40, 40, 24, 16]
    np.testing.assert_allclose(drive.rig_from_cam[1][:3, 2], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(drive.rig_from_cam[0][:3, 2], [-1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(drive.rig_from_cam[1][:3, 3], [1.7, 0, 1.5])
    start = START_US + 100_000_000
    assert drive.timestamps_us.tolist() == [start + 47_000 + 500_000 * i for i in range(4)]
    assert [image.timestamp_us for image in drive.images[:2]] == [start + 37_000, start + 12_000]
    assert any("z = 0" in note for note in drive.manifest.notes)
    assert [frame.source_frame for frame in drive.manifest.frames] == [0, 1, 2, 3]


def test_the_vehicle_is_that_of_the_scenes_log(dataset: Path, tmp_path: Path) -> None:
    tables = dataset / "v1.0-mini"
    import_recording(dataset, tmp_path / "unknown", scene="scene-0103")
    assert read_drive(tmp_path / "unknown").manifest.vehicle is None
    scenes = json.loads((tables / "scene.json").read_text())
    (tables / "scene.json").write_text(json.dumps([{**scene, "log_token": f"log-{scene['name']}"} for scene in scenes]))
    logs = [{"token": "log-scene-0061", "vehicle": "n008"}, {"token": "log-scene-0103", "vehicle": "n015"}]
    (tables / "log.json").write_text(json.dumps(logs))
    import_recording(dataset, tmp_path / "known", scene="scene-0103")
    manifest = read_drive(tmp_path / "known").manifest
    assert (manifest.version, manifest.vehicle) == (2, "n015")
    for number, (name, expected) in enumerate(
        {" M-AB 123": "M-AB-123", "Zoë/2": "Zo-2", "n" * 70: "n" * 64, "—": None, 8: None}.items()
    ):
        (tables / "log.json").write_text(json.dumps([{"token": "log-scene-0103", "vehicle": name}]))
        import_recording(dataset, tmp_path / f"named {number}", scene="scene-0103")
        assert read_drive(tmp_path / f"named {number}").manifest.vehicle == expected
    import_recording(dataset, tmp_path / "given", scene="scene-0103", vehicle="van-7")
    assert read_drive(tmp_path / "given").manifest.vehicle == "van-7"


def test_truth_is_the_laser_scanners_ego_pose(dataset: Path, tmp_path: Path) -> None:
    import_recording(dataset, tmp_path / "drive", scene="scene-0061")
    truth = np.loadtxt(tmp_path / "drive/truth.tum")
    times_us = [START_US + 47_000 + 500_000 * i for i in range(4)]
    np.testing.assert_allclose(truth[:, 0], [t / 1e6 for t in times_us], atol=1e-6)
    np.testing.assert_allclose(truth[:, 1], [east_m(t) for t in times_us], atol=1e-8)
    rotation = se3.rotation_from_quaternion(truth[:, 4:])
    np.testing.assert_allclose(rotation[:, :3, 0], np.tile([0.5**0.5, 0.5**0.5, 0], (4, 1)), atol=1e-8)


def test_sweeps_are_put_together_by_their_times(dataset: Path, tmp_path: Path) -> None:
    """Between the keyframes, 25 ms apart, and of the front camera one is missing."""
    rng = np.random.default_rng(6)
    rows = [row for row in make_tables()["sample_data"] if not row["is_key_frame"] and row["width"]]
    for row in rows:
        file = dataset / row["filename"]
        file.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(file), rng.integers(0, 255, (32, 48, 3), dtype=np.uint8))
    tables = make_tables()
    tables["sample_data"].remove(next(row for row in rows if f"sweeps/{FRONT}" in row["filename"]))
    write_tables(dataset, tables)
    summary = import_recording(dataset, tmp_path / "drive", scene="scene-0061", options={"sweeps": True})
    assert (summary.units, summary.images) == (8, 15)
    drive = read_drive(tmp_path / "drive")
    assert check_drive(drive) == []
    assert [sorted(frame.images) for frame in drive.manifest.frames[:3]] == [[BACK, FRONT], [BACK], [BACK, FRONT]]
    middle_us = START_US + 24_500
    assert drive.timestamps_us.tolist()[::2] == [middle_us + 500_000 * i for i in range(4)]
    truth = np.loadtxt(tmp_path / "drive/truth.tum")
    assert len(truth) == 8
    np.testing.assert_allclose(truth[:, 1], [east_m(t) for t in drive.timestamps_us.tolist()], atol=1e-6)
    files = {drive.root / image.file for image in drive.images}
    assert len({file.read_bytes() for file in files}) == 15
    assert import_recording(dataset, tmp_path / "keyframes", scene="scene-0061").images == 8


def test_rough_poses_of_a_city(dataset: Path, tmp_path: Path) -> None:
    """Two scenes of one city can be aggregated by them; without a log, the world is known to one scene alone."""
    quality = RoughQuality(sigma_m=0.5, sigma_deg=2.0)
    import_recording(dataset, tmp_path / "unknown", scene="scene-0103", rough_noise=quality)
    rough = read_drive(tmp_path / "unknown").manifest.rough_poses
    assert rough is not None
    assert rough.common_world is None
    tables = make_tables()
    for scene in tables["scene"]:
        scene["log_token"] = "log"
    tables["log"] = [{"token": "log", "vehicle": "n008", "location": "boston-seaport"}]
    write_tables(dataset, tables)
    for name in ("scene-0061", "scene-0103"):
        summary = import_recording(dataset, tmp_path / name, scene=name, rough_noise=quality)
        assert (summary.rough_poses, summary.truth) == (4, True)
        drive = read_drive(tmp_path / name)
        rough = drive.manifest.rough_poses
        assert rough is not None
        assert (rough.common_world, rough.sigma_translation_m) == ("nuscenes-boston-seaport", 0.5)
        assert [f.code for f in check_drive(drive)] == []
        away = [p.world_from_rig.translation_m[0] - east_m(p.timestamp_us) for p in rough.poses]
        assert 0.01 < max(map(abs, away)) < 3.0


def test_without_laser_scanner_the_cameras_mean_counts(dataset: Path, tmp_path: Path) -> None:
    tables = make_tables()
    tables["sample_data"] = [row for row in tables["sample_data"] if "LIDAR" not in row["token"]]
    write_tables(dataset, tables)
    import_recording(dataset, tmp_path / "drive", scene="scene-0061")
    mean_us = START_US + (12_000 + 37_000) // 2
    assert read_drive(tmp_path / "drive").timestamps_us[0] == mean_us
    truth = np.loadtxt(tmp_path / "drive/truth.tum")
    assert abs(truth[0, 1] - east_m(mean_us)) < 1e-5


def test_tables_without_ego_poses_have_no_truth(dataset: Path, tmp_path: Path) -> None:
    write_tables(dataset, make_tables() | {"ego_pose": []})
    summary = import_recording(dataset, tmp_path / "drive", scene="scene-0061")
    assert not summary.truth
    assert not any("truth" in note for note in summary.notes)


def test_frames_and_the_only_scene(dataset: Path, tmp_path: Path) -> None:
    tables = make_tables()
    tables["scene"] = tables["scene"][:1]
    write_tables(dataset, tables)
    assert import_recording(dataset, tmp_path / "drive", frames="1:3").units == 2
    assert [frame.source_frame for frame in read_drive(tmp_path / "drive").manifest.frames] == [1, 2]


def drop(table: str, index: int) -> Callable[[Tables], None]:
    def edit(tables: Tables) -> None:
        del tables[table][index]

    return edit


def put(table: str, index: int, field: str, value: Any) -> Callable[[Tables], None]:
    def edit(tables: Tables) -> None:
        tables[table][index][field] = value

    return edit


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (drop("sample", 2), "sample 'scene-0061-2', which is not there"),
        (drop("sensor", 1), "sensor 's-CAM_FRONT'"),
        (drop("calibrated_sensor", 2), "calibrated_sensor 'c-CAM_BACK'"),
        (put("sample", 3, "next", "scene-0061-0"), "samples after 'scene-0061-0' lead in a circle"),
        (put("calibrated_sensor", 1, "camera_intrinsic", [[1.0]]), "no 3x3 camera_intrinsic"),
        (put("calibrated_sensor", 1, "camera_intrinsic", [[40.0, 0.0], [1.0]]), "no 3x3 camera_intrinsic"),
        (put("sample_data", 2, "timestamp", 10**20), "sample_data.json: 2.timestamp"),
        (put("sample_data", 2, "timestamp", -1), "sample_data.json: 2.timestamp"),
        (
            put("calibrated_sensor", 1, "camera_intrinsic", [[40.0, 0.0, 0.0], [0.0, 40.0, 0.0], [23.5, 15.5, 1.0]]),
            "camera_intrinsic is no calibration matrix",
        ),
        (put("calibrated_sensor", 1, "rotation", [1.0, 0.0]), "1.rotation"),
        (put("ego_pose", 0, "rotation", [0.0, 0.0, 0.0, 0.0]), "0.rotation"),
        (put("sample_data", 2, "filename", "../../etc/passwd"), "2.filename"),
        (lambda tables: tables["sample_data"].clear(), "no camera keyframes"),
        (lambda tables: tables.update(ego_pose=[{"token": 1}]), "ego_pose.json"),
    ],
)
def test_broken_tables(dataset: Path, tmp_path: Path, edit: Callable[[Tables], None], message: str) -> None:
    tables = make_tables()
    edit(tables)
    write_tables(dataset, tables)
    with pytest.raises(InputError) as caught:
        import_recording(dataset, tmp_path / "drive", scene="scene-0061")
    assert message in caught.value.what
    assert sorted(p.name for p in tmp_path.iterdir()) == ["nuscenes"]


def test_scene_must_be_named(dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="scene-0061, scene-0103") as caught:
        import_recording(dataset, tmp_path / "drive")
    assert "--scene" in caught.value.remedy
    with pytest.raises(InputError, match="no scene 'scene-9'"):
        import_recording(dataset, tmp_path / "drive", scene="scene-9")


def test_tables_without_scenes(dataset: Path, tmp_path: Path) -> None:
    (dataset / "v1.0-mini/scene.json").write_text("[]")
    with pytest.raises(InputError, match="holds no scenes"):
        import_recording(dataset, tmp_path / "drive")


def test_missing_files(dataset: Path, tmp_path: Path) -> None:
    min((dataset / "samples/CAM_FRONT").iterdir()).unlink()
    with pytest.raises(InputError, match="does not exist") as caught:
        import_recording(dataset, tmp_path / "drive", scene="scene-0061")
    assert "CAM_FRONT" in caught.value.what
    (dataset / "v1.0-mini/ego_pose.json").unlink()
    with pytest.raises(InputError, match=r"ego_pose\.json does not exist"):
        import_recording(dataset, tmp_path / "drive", scene="scene-0061")


def test_several_versions(dataset: Path, tmp_path: Path) -> None:
    (dataset / "v1.0-test").mkdir()
    (dataset / "v1.0-test/scene.json").write_text("[]")
    with pytest.raises(InputError, match=r"v1\.0-mini, v1\.0-test"):
        import_recording(dataset, tmp_path / "drive", scene="scene-0061")
