from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.geodesy import ecef_from_local, geodetic_from_local
from mrasfm_engine.importers.layouts import import_recording
from mrasfm_engine.preflight.drive_reader import check_drive, read_drive

FRAMES = 5
DAY, DRIVE = "2011_09_26", "2011_09_26_drive_0001_sync"
PLACE = [49.015, 8.434, 116.4]
YAW = 0.3
P0 = "4.0e+01 0 2.35e+01 0 0 4.0e+01 1.55e+01 0 0 0 1 0"
P1 = "4.0e+01 0 2.35e+01 -2.0e+01 0 4.0e+01 1.55e+01 0 0 0 1 0"  # half a metre to the right
# camera x right, y down, z forward of the laser scanner's forward, left, up
VELO_TO_CAM = "R: 0 -1 0 0 0 -1 1 0 0\nT: 0.0 -0.08 -0.27\n"
IMU_TO_VELO = "R: 1 0 0 0 1 0 0 0 1\nT: -0.81 0.32 -0.80\n"


def stamp(second: float) -> str:
    return f"2011-09-26 13:02:{second:012.9f}"


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """The vehicle drives 10 m/s at 0.3 rad from east, rolled by 0.02 rad; images come 5 ms after the positions."""
    day = tmp_path / "kitti" / DAY
    folder = day / DRIVE
    for i, name in enumerate(("image_00", "image_01")):
        (folder / name / "data").mkdir(parents=True)
        lines = [stamp(25.9 + 0.1 * f + 0.004 + 0.002 * i) for f in range(FRAMES)]
        (folder / name / "timestamps.txt").write_text("\n".join(lines) + "\n")
        for f in range(FRAMES):
            cv2.imwrite(str(folder / name / "data" / f"{f:010d}.png"), np.full((32, 48), 40 * f, np.uint8))
    (folder / "oxts" / "data").mkdir(parents=True)
    frame = ecef_from_local(PLACE)
    lines = []
    for f in range(FRAMES):
        lines.append(stamp(25.9 + 0.1 * f))
        east, north = f * np.cos(YAW), f * np.sin(YAW)
        place = geodetic_from_local(np.array([[east, north, 0.0]]), frame)[0]
        numbers = [*place, 0.02, 0.0, YAW, *[0.0] * 17, 0.03, *[0.0] * 6]
        (folder / "oxts" / "data" / f"{f:010d}.txt").write_text(" ".join(f"{v:.13f}" for v in numbers) + "\n")
    (folder / "oxts" / "timestamps.txt").write_text("\n".join(lines) + "\n")
    rectified = "R_rect_00: 1 0 0 0 1 0 0 0 1"
    (day / "calib_cam_to_cam.txt").write_text(
        f"calib_time: 09-Jan-2012 13:57:47\n{rectified}\nP_rect_00: {P0}\nP_rect_01: {P1}\n"
    )
    (day / "calib_velo_to_cam.txt").write_text(f"calib_time: 15-Mar-2012 11:37:16\n{VELO_TO_CAM}")
    (day / "calib_imu_to_velo.txt").write_text(f"calib_time: 25-May-2012 16:47:16\n{IMU_TO_VELO}")
    return folder


@pytest.mark.parametrize("given", [".", "..", "../.."])
def test_drive(drive: Path, tmp_path: Path, given: str) -> None:
    summary = import_recording(drive / given, tmp_path / "drive")
    assert (summary.layout, summary.cameras, summary.images, summary.truth) == ("KITTI raw", 2, 10, False)
    read = read_drive(tmp_path / "drive")
    assert [f.code for f in check_drive(read)] == []
    assert read.manifest.name == f"kitti-{DRIVE}"
    assert read.cameras[0].params == [40, 40, 24, 16]
    np.testing.assert_allclose(read.rig_from_cam[0, :3, :3], [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-9)
    # The scanner lies 0.81 m before, 0.32 m right of and 0.80 m above the inertial unit; the camera is 0.27 m before
    # and 0.08 m below the scanner.
    np.testing.assert_allclose(read.rig_from_cam[0, :3, 3], [0.81 + 0.27, -0.32, 0.80 - 0.08], atol=1e-9)
    np.testing.assert_allclose(read.rig_from_cam[1, :3, 3], [0.81 + 0.27, -0.82, 0.80 - 0.08], atol=1e-9)
    gaps_us = np.diff(read.timestamps_us)
    assert gaps_us.tolist() == [100_000] * (FRAMES - 1)


def test_positions_become_gnss_with_their_accuracy(drive: Path, tmp_path: Path) -> None:
    import_recording(drive, tmp_path / "drive")
    read = read_drive(tmp_path / "drive")
    gnss = read.manifest.gnss
    assert gnss is not None
    assert len(gnss.samples) == FRAMES
    assert read.timestamps_us[0] - gnss.samples[0].timestamp_us == 5_000
    assert gnss.samples[0].sigma_horizontal_m == 0.03
    assert gnss.samples[0].latitude_deg == pytest.approx(PLACE[0])
    assert gnss.antenna_in_rig_m == [0, 0, 0]


def test_a_camera_without_images_is_noted(drive: Path, tmp_path: Path) -> None:
    (drive / "image_02" / "data").mkdir(parents=True)
    assert "Cameras without any image, left out: image_02." in import_recording(drive, tmp_path / "drive").notes


def test_positions_in_files_without_leading_zeros(drive: Path, tmp_path: Path) -> None:
    """Frames 9 and 10 in the order of their numbers, not of their names."""
    times = "".join(f"{stamp(25.9 + 0.1 * f)}\n" for f in range(11))
    (drive / "oxts" / "timestamps.txt").write_text(times)
    for frame, name in ((3, "9.txt"), (4, "10.txt")):
        (drive / "oxts" / "data" / f"{frame:010d}.txt").rename(drive / "oxts" / "data" / name)
    import_recording(drive, tmp_path / "drive")
    gnss = read_drive(tmp_path / "drive").manifest.gnss
    assert gnss is not None
    times_us = [sample.timestamp_us for sample in gnss.samples]
    assert times_us == sorted(times_us)
    assert len(times_us) == FRAMES


def test_truth_where_asked_for(drive: Path, tmp_path: Path) -> None:
    assert import_recording(drive, tmp_path / "drive", truth=True).truth
    truth = np.loadtxt(tmp_path / "drive" / "truth.tum")
    assert len(truth) == FRAMES - 1  # the last image comes after the last position
    along_m = 10.0 * (0.005 + 0.1 * np.arange(FRAMES - 1))
    np.testing.assert_allclose(truth[:, 1], along_m * np.cos(YAW), atol=1e-4)
    np.testing.assert_allclose(truth[:, 2], along_m * np.sin(YAW), atol=1e-4)
    rotation = se3.rotation_from_quaternion(truth[0, 4:])
    np.testing.assert_allclose(rotation[:, 0], [np.cos(YAW), np.sin(YAW), 0.0], atol=1e-6)
    np.testing.assert_allclose(rotation[2, 1], np.sin(0.02), atol=1e-6)


def test_a_drive_without_positions(drive: Path, tmp_path: Path) -> None:
    for file in (drive / "oxts" / "data").iterdir():
        file.unlink()
    summary = import_recording(drive, tmp_path / "drive", truth=True)
    assert (summary.gnss_samples, summary.truth) == (0, False)


def test_one_of_several_drives(drive: Path, tmp_path: Path) -> None:
    (drive.parent / "2011_09_26_drive_0002_sync" / "image_00" / "data").mkdir(parents=True)
    with pytest.raises(InputError, match="2 scenes: 2011_09_26_drive_0001_sync, 2011_09_26_drive_0002_sync"):
        import_recording(drive.parent, tmp_path / "drive")
    with pytest.raises(InputError, match="no images"):
        import_recording(drive.parent, tmp_path / "drive", scene="2011_09_26_drive_0002_sync")
    assert import_recording(drive.parent, tmp_path / "drive", scene=DRIVE).images == 10


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("oxts/data/0000000001.txt", "1 2 3\n", "0000000001.txt, line 1: '1 2 3' is not 30 numbers"),
        ("oxts/data/0000000001.txt", "\n", "0000000001.txt has no values"),
        ("oxts/data/readme.txt", "units\n", "readme.txt is not named by a frame number"),
        ("oxts/data/0000000001.txt", f"{95.0} {'0 ' * 29}\n", "oxts .*, sample 1: latitude_deg 95"),
        ("oxts/timestamps.txt", f"{stamp(3)}\n", "timestamps.txt has 1 lines, but there is a file of frame 4"),
        ("image_01/timestamps.txt", "noon\n", "image_01/timestamps.txt, line 1: 'noon' is no date"),
        ("image_01/timestamps.txt", f"{stamp(3)}\n{stamp(2)}\n", "line 2: does not come after"),
        ("../calib_cam_to_cam.txt", "P_rect_00: 1\n", "calib_cam_to_cam.txt: R_rect_00 is not 9 numbers"),
        ("../calib_velo_to_cam.txt", "R: 2 0 0 0 2 0 0 0 2\nT: 0 0 0\n", "calib_velo_to_cam.txt is not a rigid"),
    ],
)
def test_malformed_files_are_named(drive: Path, tmp_path: Path, file: str, content: str, message: str) -> None:
    (drive / file).write_text(content)
    with pytest.raises(InputError, match=message):
        import_recording(drive, tmp_path / "drive")
    assert not (tmp_path / "drive").exists()


def test_a_missing_calibration_is_named(drive: Path, tmp_path: Path) -> None:
    (drive.parent / "calib_imu_to_velo.txt").unlink()
    with pytest.raises(InputError, match=r"calib_imu_to_velo.txt"):
        import_recording(drive, tmp_path / "drive")


def test_without_an_inertial_unit_nothing_is_noted_of_one(drive: Path, tmp_path: Path) -> None:
    assert any(note.startswith("GNSS:") for note in import_recording(drive, tmp_path / "with").notes)
    shutil.rmtree(drive / "oxts")
    notes = import_recording(drive, tmp_path / "without").notes
    assert notes == ["Times: KITTI's local ones, taken as UTC."]


def test_two_drives_of_one_name(drive: Path, tmp_path: Path) -> None:
    """A copy beside the day's folder is not taken in its place."""
    shutil.copytree(drive.parent, drive.parents[1] / "copy")
    with pytest.raises(InputError, match=rf"2 scenes: {DAY}/{DRIVE}, copy/{DRIVE}"):
        import_recording(drive.parents[1], tmp_path / "drive")
    shutil.rmtree(drive.parents[1] / "copy" / DRIVE / "image_01")
    assert import_recording(drive.parents[1], tmp_path / "drive", scene=f"copy/{DRIVE}").cameras == 1
