from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pyarrow import feather, table

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.importers import arrow_tables
from mrasfm_engine.importers.layouts import import_recording
from mrasfm_engine.importers.recording import RoughQuality
from mrasfm_engine.preflight.drive_reader import check_drive, read_drive
from mrasfm_engine.scene.drive import Drive, matrix_from_pose
from tests.helpers.av2_writing import write_log

LOG = "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
START_US = 315_966_265_259_836
FRAMES = 6
OPTICAL = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
YAW = 0.4
# Pose of the vehicle in the city, kilometres from its origin.
FIRST = se3.transform(se3.exp_so3([0, 0, YAW]), [1468.9, 211.5, 13.1])


def pose(time_us: int) -> np.ndarray:
    return FIRST @ se3.transform(np.eye(3), [8e-6 * (time_us - START_US), 0, 0])


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Two cameras at 20 Hz, of which one stands on its side and takes its images 3 ms later."""
    source = tmp_path / "source"
    cameras = {"ring_front_center": (32, 48, 0), "ring_side_left": (48, 32, 3000)}
    for name, (width, height, _) in cameras.items():
        (source / name).mkdir(parents=True)
        for f in range(FRAMES):
            cv2.imwrite(str(source / name / f"{f:06d}.jpg"), np.full((height, width), 30 * f, np.uint8))
    rig = {
        "body_axes": "flu",
        "cameras": {
            name: {
                "width": width,
                "height": height,
                "K": [[40.0, 0, width / 2 - 0.5], [0, 40.0, height / 2 - 0.5], [0, 0, 1]],
                "T_body_cam": se3.transform(OPTICAL, [1.6, 0.3 * i, 1.4]).tolist(),
            }
            for i, (name, (width, height, _)) in enumerate(cameras.items())
        },
    }
    (source / "rig.json").write_text(json.dumps(rig))
    import_recording(source, tmp_path / "given")
    given = read_drive(tmp_path / "given")
    frames = [
        frame.model_copy(
            update={
                "images": {
                    name: image.model_copy(
                        update={"timestamp_us": START_US + frame.source_frame * 50_000 + cameras[name][2]}
                    )
                    for name, image in frame.images.items()
                }
            }
        )
        for frame in given.manifest.frames
    ]
    manifest = given.manifest.model_copy(update={"frames": frames})
    times_us = range(START_US - 10_000, START_US + FRAMES * 50_000, 10_000)
    return write_log(Drive(given.root, manifest), {t: pose(t) for t in times_us}, tmp_path / "val" / LOG)


@pytest.mark.parametrize("given", [".", ".."])
def test_log(log: Path, tmp_path: Path, given: str) -> None:
    summary = import_recording(log / given, tmp_path / "drive")
    assert (summary.layout, summary.cameras, summary.units, summary.images) == ("Argoverse 2", 2, FRAMES, 2 * FRAMES)
    assert (summary.truth, summary.rough_poses, summary.gnss_samples) == (True, 0, 0)
    drive = read_drive(tmp_path / "drive")
    assert drive.manifest.name == f"av2-{LOG}"
    assert [f.code for f in check_drive(drive)] == []
    front, side = drive.cameras
    # The images are undistorted: the table's k1 to k3 are not theirs. Its pixels count from centres.
    assert (front.model, front.width, front.height, front.params) == ("PINHOLE", 32, 48, [40.0, 40.0, 16.0, 24.0])
    assert side.params == [40.0, 40.0, 24.0, 16.0]
    np.testing.assert_allclose(drive.rig_from_cam[1], se3.transform(OPTICAL, [1.6, 0.3, 1.4]), atol=1e-12)
    frame = drive.manifest.frames[2]
    assert frame.timestamp_us == START_US + 101_500
    assert frame.images["ring_side_left"].timestamp_us == START_US + 103_000
    truth = np.loadtxt(tmp_path / "drive" / "truth.tum")
    np.testing.assert_allclose(truth[2, 1:4], pose(START_US + 101_500)[:3, 3], atol=1e-6)
    assert any("not applied" in note for note in summary.notes)


def test_a_camera_whose_images_are_of_another_format_is_noted(log: Path, tmp_path: Path) -> None:
    folder = log / "sensors" / "cameras" / "stereo_front_left"
    folder.mkdir()
    (folder / f"{START_US * 1000}.webp").touch()
    notes = import_recording(log, tmp_path / "drive").notes
    assert "Cameras without any image, left out: stereo_front_left." in notes
    assert any("stereo_front_left: 1" in note for note in notes)


def test_poses_with_noise_become_rough_ones_in_the_city(log: Path, tmp_path: Path) -> None:
    quality = RoughQuality(sigma_m=0.5, sigma_deg=2.0)
    assert import_recording(log, tmp_path / "drive", rough_noise=quality).rough_poses == FRAMES
    drive = read_drive(tmp_path / "drive")
    rough = drive.manifest.rough_poses
    assert rough is not None
    assert (rough.common_world, rough.sigma_translation_m, rough.sigma_rotation_deg) == ("av2-PIT", 0.5, 2.0)
    true = np.stack([pose(frame.timestamp_us) for frame in drive.manifest.frames])
    away = se3.inverse(true) @ np.stack([matrix_from_pose(p.world_from_rig) for p in rough.poses])
    assert 0.1 < np.abs(away[:, :3, 3]).max() < 2.5
    assert 0.4 < se3.rotation_angle_deg(away[:, :3, :3]).max() < 10.0
    import_recording(log, tmp_path / "again", rough_noise=quality)
    assert read_drive(tmp_path / "again").manifest == drive.manifest


def test_wanted_cameras(log: Path, tmp_path: Path) -> None:
    import_recording(log, tmp_path / "drive", cameras=["ring_side_left"])
    assert [camera.name for camera in read_drive(tmp_path / "drive").cameras] == ["ring_side_left"]


def test_one_of_several_logs(log: Path, tmp_path: Path) -> None:
    shutil.copytree(log, log.with_name("other"))
    with pytest.raises(InputError, match=f"2 scenes: {LOG}, other"):
        import_recording(log.parent, tmp_path / "drive")
    assert import_recording(log.parent, tmp_path / "drive", scene=LOG).images == 2 * FRAMES


def test_logs_of_one_name_behind_links_are_several(log: Path, tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    logs.mkdir()
    for name in ("first", "second"):
        shutil.copytree(log, tmp_path / name / LOG)
        (logs / name).symlink_to(tmp_path / name / LOG)
    with pytest.raises(InputError, match="2 scenes: first, second"):
        import_recording(logs, tmp_path / "drive")
    assert import_recording(logs, tmp_path / "drive", scene="second").images == 2 * FRAMES


def test_poses_of_another_time_are_noted(log: Path, tmp_path: Path) -> None:
    changed(log / "city_SE3_egovehicle.feather", timestamp_ns=list(range(5 * FRAMES + 1)))
    summary = import_recording(log, tmp_path / "drive")
    assert not summary.truth
    assert any("are of 0.000 to 0.000 s and its images of 315966265.261" in note for note in summary.notes)


def test_an_image_that_is_not_named_by_its_time(log: Path, tmp_path: Path) -> None:
    first = min((log / "sensors" / "cameras" / "ring_side_left").iterdir())
    first.rename(first.with_name("first.jpg"))
    with pytest.raises(InputError, match=r"first\.jpg is not named by its time in nanoseconds"):
        import_recording(log, tmp_path / "drive")


def changed(file: Path, **columns: object) -> None:
    rows = {name: column.to_pylist() for name, column in zip(*_columns(file), strict=True)}
    rows.update(columns)
    feather.write_feather(table({name: values for name, values in rows.items() if values is not None}), file)


def _columns(file: Path) -> tuple[list[str], list[Any]]:
    read = feather.read_table(file)
    return read.column_names, read.columns


@pytest.mark.parametrize(
    ("file", "columns", "message"),
    [
        ("calibration/intrinsics.feather", {"fx_px": None}, "intrinsics.feather, column fx_px: is not there"),
        ("calibration/intrinsics.feather", {"cx_px": [np.nan, 1.0]}, "column cx_px: holds a value that is no finite"),
        ("calibration/intrinsics.feather", {"width_px": [33, 48]}, "is of 33x48 pixels, .* has 32x48"),
        ("calibration/intrinsics.feather", {"sensor_name": ["a", "b"]}, "0 rows of sensor ring_front_center"),
        ("calibration/intrinsics.feather", {"fx_px": [0.0, 40.0]}, "ring_front_center: params: focal length"),
        ("calibration/egovehicle_SE3_sensor.feather", {"qw": [3.0, 1.0]}, "holds a quaternion that is not of norm 1"),
        ("calibration/egovehicle_SE3_sensor.feather", {"sensor_name": [1, 2]}, "holds a value that is no text"),
        ("city_SE3_egovehicle.feather", {"timestamp_ns": None}, "column timestamp_ns: is not there"),
        (
            "calibration/egovehicle_SE3_sensor.feather",
            {"ty_m": [1e12, 0]},
            "sensor.feather, column tx_m, ty_m, tz_m: .* a",
        ),
        ("city_SE3_egovehicle.feather", {"tx_m": np.full(5 * FRAMES + 1, 1e300)}, r"beyond 1e\+08 m"),
        (
            "city_SE3_egovehicle.feather",
            {"timestamp_ns": np.full(5 * FRAMES + 1, 2**63, np.uint64)},
            "column timestamp_ns: holds a value that is no integer up",
        ),
    ],
)
def test_malformed_tables_are_named(
    log: Path, tmp_path: Path, file: str, columns: dict[str, object], message: str
) -> None:
    changed(log / file, **columns)
    with pytest.raises(InputError, match=message):
        import_recording(log, tmp_path / "drive")
    assert not (tmp_path / "drive").exists()


@pytest.mark.parametrize("file", ["calibration/intrinsics.feather", "city_SE3_egovehicle.feather"])
def test_damaged_tables_are_named(log: Path, tmp_path: Path, file: str) -> None:
    whole = (log / file).read_bytes()
    for kept in (0, 5, len(whole) // 2, len(whole) - 10):
        (log / file).write_bytes(whole[:kept])
        with pytest.raises(InputError, match=Path(file).name):
            import_recording(log, tmp_path / "drive")


def test_a_missing_table_and_a_missing_pyarrow(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow.feather", None)
    with pytest.raises(InputError, match=r"pip install 'mrasfm\[av2\]'"):
        import_recording(log, tmp_path / "drive")
    monkeypatch.undo()
    (log / "calibration" / "intrinsics.feather").unlink()
    with pytest.raises(InputError, match=r"intrinsics\.feather does not exist"):
        import_recording(log, tmp_path / "drive")


def test_a_table_of_no_feather(tmp_path: Path) -> None:
    (tmp_path / "a.feather").write_text("no table")
    with pytest.raises(InputError, match=r"table .*a\.feather"):
        arrow_tables.read_feather(tmp_path / "a.feather")


def test_rough_noise_needs_poses(tmp_path: Path) -> None:
    (tmp_path / "recording" / "a").mkdir(parents=True)
    for f in range(2):
        cv2.imwrite(str(tmp_path / "recording" / "a" / f"{f}.png"), np.zeros((32, 48), np.uint8))
    (tmp_path / "recording" / "rig.json").write_text(
        '{"body_axes": "flu", "cameras": {"a": {"width": 48, "height": 32, "K": [[40, 0, 24], [0, 40, 16], [0, 0, 1]], '
        '"T_body_cam": [[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0]]}}}'
    )
    with pytest.raises(InputError, match="rough poses cannot be made: it has no poses"):
        import_recording(tmp_path / "recording", tmp_path / "drive", rough_noise=RoughQuality(sigma_m=1, sigma_deg=1))
