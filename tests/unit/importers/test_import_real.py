from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.geodesy import ecef_from_local, local_from_geodetic
from mrasfm_engine.importers.layouts import import_recording
from mrasfm_engine.preflight.drive_reader import Severity, check_drive, read_drive
from mrasfm_engine.scene.drive import Drive, matrix_from_pose
from schemas.manifest_check import check_manifest

pytestmark = pytest.mark.real


def imported(folder: Path, out: Path, **options: str) -> tuple[Drive, np.ndarray]:
    """The drive and its truth, world_from_rig (units, 4, 4)."""
    gnss = options.pop("gnss", None)
    import_recording(folder, out, gnss_file=None if gnss is None else Path(gnss), frames=options.get("frames"))
    rows = np.loadtxt(out / "truth.tum")
    return read_drive(out), se3.transform(se3.rotation_from_quaternion(rows[:, 4:]), rows[:, 1:4])


def headings_deg(world_from_rig: np.ndarray) -> np.ndarray:
    """Angle between the direction of motion and the rig's x axis."""
    motion = np.diff(world_from_rig[:, :3, 3], axis=0)
    motion /= np.linalg.norm(motion, axis=1, keepdims=True)
    return np.degrees(np.arccos(np.clip((motion * world_from_rig[:-1, :3, 0]).sum(1), -1, 1)))


@pytest.mark.parametrize(("name", "units", "images"), [("kitti06", 51, 102), ("kitti02", 20, 40), ("ddad", 3, 18)])
def test_drives_are_sound(shared_data: Path, tmp_path: Path, name: str, units: int, images: int) -> None:
    drive, truth = imported(shared_data / name, tmp_path / name)
    assert (len(drive.manifest.frames), len(drive.images), len(truth)) == (units, images, units)
    found = check_drive(drive)
    assert [f for f in found if f.severity is Severity.ERROR] == []
    assert {f.code for f in found} <= {"gnss-jump"}
    angles = headings_deg(truth)
    assert 0 < angles.max() < 3.0  # it drives where its x axis points
    assert 0.99 < truth[:, 2, 2].min() <= 1.0  # and stays upright


def test_stereo_pair_is_left_and_right(shared_data: Path, tmp_path: Path) -> None:
    drive, _ = imported(shared_data / "kitti06", tmp_path / "drive")
    np.testing.assert_allclose(drive.rig_from_cam[1][:3, 3], [0, -0.537, 0], atol=5e-4)
    np.testing.assert_allclose(drive.rig_from_cam[:, :3, 2], [[1, 0, 0]] * 2, atol=1e-9)
    assert drive.cameras[0].params == [707.0912, 707.0912, 602.3873, 183.6104]
    assert drive.manifest.gnss is not None
    np.testing.assert_allclose(drive.manifest.gnss.antenna_in_rig_m, [-1.1, -0.32, 0.66], atol=1e-9)


def test_gnss_outliers_are_named(shared_data: Path, tmp_path: Path) -> None:
    drive, _ = imported(shared_data / "kitti06", tmp_path / "drive")
    findings = check_manifest(drive.manifest)
    assert [f.code for f in findings] == ["gnss-jump"]
    assert "gnss.samples.13, gnss.samples.14, gnss.samples.37" in findings[0].what


def test_gnss_agrees_with_truth_through_the_lever_arm(shared_data: Path, tmp_path: Path) -> None:
    drive, truth = imported(shared_data / "kitti06", tmp_path / "drive")
    gnss = drive.manifest.gnss
    assert gnss is not None
    geodetic = np.array([(s.latitude_deg, s.longitude_deg, s.height_m) for s in gnss.samples])
    local = local_from_geodetic(geodetic, ecef_from_local(geodetic[0]))
    antenna = truth[:, :3, :3] @ gnss.antenna_in_rig_m + truth[:, :3, 3]
    yaw = np.radians(90 - 35)  # the drive's heading is 35 degrees at its start
    east_north = antenna[:, :2] @ np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    difference = (local[:, :2] - local[0, :2]) - (east_north - east_north[0])
    assert 0.05 < np.median(np.linalg.norm(difference - np.median(difference, axis=0), axis=1)) < 1.0


@pytest.mark.parametrize(
    ("gnss", "frames", "units", "first_us"),
    [("gnss_drive_a.csv", "0:35:2", 18, 0), ("gnss_drive_b.csv", "17:50:2", 17, 1_700_000)],
)
def test_two_drives_of_one_street(
    shared_data: Path, tmp_path: Path, gnss: str, frames: str, units: int, first_us: int
) -> None:
    drive, _ = imported(shared_data / "kitti06", tmp_path / "drive", gnss=gnss, frames=frames)
    assert drive.manifest.gnss is not None
    assert len(drive.manifest.frames) == len(drive.manifest.gnss.samples) == units
    assert drive.timestamps_us[0] == drive.manifest.gnss.samples[0].timestamp_us == first_us
    assert check_drive(drive) == []


def test_rough_poses_are_the_truth_within_their_noise(shared_data: Path, tmp_path: Path) -> None:
    drive, truth = imported(shared_data / "ddad", tmp_path / "drive")
    rough = drive.manifest.rough_poses
    assert rough is not None
    poses = np.stack([matrix_from_pose(pose.world_from_rig) for pose in rough.poses])
    distance = np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1)
    angle = se3.rotation_angle_deg(np.swapaxes(poses[:, :3, :3], 1, 2) @ truth[:, :3, :3])
    assert 0.02 < distance.max() < 0.6
    assert 0.1 < angle.max() < 4.0


def test_masks_come_along(shared_data: Path, tmp_path: Path) -> None:
    for name in ("ddad", "kitti02"):
        drive, _ = imported(shared_data / name, tmp_path / name)
        assert all(image.mask is not None for image in drive.images)
        assert drive.manifest.label_map is not None


def test_pandaset_is_read_as_distributed(shared_data: Path, tmp_path: Path) -> None:
    drive, truth = imported(shared_data / "pandaset_002", tmp_path / "drive")
    assert (len(drive.manifest.frames), len(drive.images), len(drive.cameras)) == (52, 312, 6)
    assert {f.code for f in check_drive(drive) if f.severity is Severity.ERROR} == set()
    moving = truth[30:]  # it stands at first
    assert headings_deg(moving).max() < 3.0
    forward = drive.rig_from_cam[[camera.name == "front_camera" for camera in drive.cameras]][0, :3, 2]
    assert forward[0] > 0.99


def test_kitti_raw_is_read_as_distributed(shared_data: Path, tmp_path: Path) -> None:
    import_recording(shared_data / "kitti_raw_0001", tmp_path / "drive", truth=True)
    drive = read_drive(tmp_path / "drive")
    assert (len(drive.manifest.frames), len(drive.images), len(drive.cameras)) == (24, 96, 4)
    assert {f.code for f in check_drive(drive) if f.severity is Severity.ERROR} == set()
    rows = np.loadtxt(tmp_path / "drive" / "truth.tum")
    truth = se3.transform(se3.rotation_from_quaternion(rows[:, 4:]), rows[:, 1:4])
    assert headings_deg(truth).max() < 3.0
    np.testing.assert_allclose(drive.rig_from_cam[1, :3, 3] - drive.rig_from_cam[0, :3, 3], [0, -0.537, 0], atol=0.02)
