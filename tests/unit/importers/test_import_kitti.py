from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from mrasfm_engine.errors import InputError
from mrasfm_engine.importers.layouts import import_recording
from mrasfm_engine.preflight.drive_reader import check_drive, read_drive

P0 = "P0: 40 0 23.5 0 0 40 15.5 0 0 0 1 0"
P2 = "P2: 40 0 23.5 2.4 0 40 15.5 -0.08 0 0 1 0.004"
P3 = "P3: 40 0 23.5 -18.9 0 40 15.5 0.12 0 0 1 0.005"


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    """Five frames of the colour cameras in the benchmark's folders, with the truth where the benchmark has it."""
    folder = tmp_path / "dataset/sequences/04"
    rng = np.random.default_rng(4)
    for name in ("image_2", "image_3"):
        (folder / name).mkdir(parents=True)
        for i in range(5):
            cv2.imwrite(str(folder / name / f"{i:06d}.png"), rng.integers(0, 255, (32, 48, 3), dtype=np.uint8))
    (folder / "calib.txt").write_text("\n".join([P0, P2, P3, "Tr: 1 0 0 0 0 1 0 0 0 0 1 0"]) + "\n")
    (folder / "times.txt").write_text("".join(f"{0.1037 * i:.6e}\n" for i in range(5)))
    (tmp_path / "dataset/poses").mkdir()
    rows = "".join(f"1 0 0 0 0 1 0 {-0.1 * i} 0 0 1 {1.5 * i}\n" for i in range(5))
    (tmp_path / "dataset/poses/04.txt").write_text(rows)
    return folder


def refused(folder: Path, out: Path) -> str:
    with pytest.raises(InputError) as caught:
        import_recording(folder, out)
    assert not out.exists()
    return caught.value.what


def test_sequence(sequence: Path, tmp_path: Path) -> None:
    summary = import_recording(sequence, tmp_path / "drive")
    assert (summary.layout, summary.cameras, summary.images, summary.truth) == ("KITTI odometry", 2, 10, True)
    drive = read_drive(tmp_path / "drive")
    assert check_drive(drive) == []
    assert [(camera.name, camera.width, camera.height) for camera in drive.cameras] == [
        ("image_2", 48, 32),
        ("image_3", 48, 32),
    ]
    assert drive.cameras[0].params == [40, 40, 24, 16]
    assert drive.timestamps_us.tolist() == [0, 103700, 207400, 311100, 414800]
    truth = np.loadtxt(tmp_path / "drive/truth.tum")
    np.testing.assert_allclose(truth[:, 1:4], [[1.5 * i, 0, 0.1 * i] for i in range(5)], atol=1e-9)


def test_cameras_project_as_their_matrices_do(sequence: Path, tmp_path: Path) -> None:
    import_recording(sequence, tmp_path / "drive")
    drive = read_drive(tmp_path / "drive")
    point_body = np.array([1.0, -0.5, 8.0])  # right, down, forward of camera 0
    point_rig = [8.0, -1.0, 0.5]
    for camera, line, rig_from_cam in zip(drive.cameras, (P2, P3), drive.rig_from_cam, strict=True):
        u, v, w = np.array([float(x) for x in line.split()[1:]]).reshape(3, 4) @ [*point_body, 1]
        x, y, z = (np.linalg.inv(rig_from_cam) @ [*point_rig, 1])[:3]
        fx, fy, cx, cy = camera.params
        np.testing.assert_allclose([fx * x / z + cx - 0.5, fy * y / z + cy - 0.5], [u / w, v / w], atol=1e-9)


def test_one_camera_without_times_and_truth(sequence: Path, tmp_path: Path) -> None:
    for file in (sequence / "image_3").iterdir():
        file.unlink()
    (sequence / "times.txt").unlink()
    (tmp_path / "dataset/poses/04.txt").unlink()
    summary = import_recording(sequence, tmp_path / "drive")
    assert (summary.cameras, summary.truth) == (1, False)
    assert "Cameras without any image, left out: image_3." in summary.notes
    assert not (tmp_path / "drive/truth.tum").exists()
    assert read_drive(tmp_path / "drive").timestamps_us.tolist() == [0, 100000, 200000, 300000, 400000]


def test_some_cameras(sequence: Path, tmp_path: Path) -> None:
    summary = import_recording(sequence, tmp_path / "drive", cameras=["image_3"])
    assert (summary.cameras, summary.images) == (1, 5)
    assert [camera.name for camera in read_drive(tmp_path / "drive").cameras] == ["image_3"]
    with pytest.raises(InputError, match="no camera image_7") as caught:
        import_recording(sequence, tmp_path / "other", cameras=["image_2", "image_7"])
    assert "image_2, image_3" in caught.value.remedy


def test_own_truth_comes_first(sequence: Path, tmp_path: Path) -> None:
    (sequence / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 7\n" * 5)
    import_recording(sequence, tmp_path / "drive")
    np.testing.assert_allclose(np.loadtxt(tmp_path / "drive/truth.tum")[:, 1], 7)


def test_gnss_antenna_is_in_camera_axes(sequence: Path, tmp_path: Path) -> None:
    header = "timestamp_us,latitude_deg,longitude_deg,ellipsoidal_height_m,sigma_horizontal_m,sigma_vertical_m"
    rows = [f"{100_000 * i},{49 + i / 111_000:.9f},8.4,110.0,0.5,1.0" for i in range(5)]
    (sequence / "gnss.csv").write_text("\n".join([header, *rows]))
    (sequence / "gnss_antenna.json").write_text('{"antenna_in_body_m": [0.3, -1.0, 0.5]}')
    import_recording(sequence, tmp_path / "drive", gnss_file=Path("gnss.csv"))
    gnss = read_drive(tmp_path / "drive").manifest.gnss
    assert gnss is not None
    np.testing.assert_allclose(gnss.antenna_in_rig_m, [0.5, -0.3, 1.0], atol=1e-12)


@pytest.mark.parametrize(
    ("calibration", "message"),
    [
        (P0 + "\n" + P2, "no P3"),
        (P2 + "\nP3: 1 2 3", "line 2: P3 is not 12 numbers"),
        (P2 + "\nP3: a" + " 0" * 11, "line 2: P3 is not 12 numbers"),
        (P2 + "\nP3: nan" + " 0" * 11, "line 2: P3 is not 12 numbers"),
        (P2 + "\nP3:" + " 0" * 12, "P3 is no calibration matrix: the last row is 0, 0, 0"),
        (P2 + "\nP3: 0 0 23.5 0 0 40 15.5 0 0 0 1 0", "P3 has a focal length of 0"),
        (P2 + "\nP3: 40 0 2350 0 0 40 15.5 0 0 0 1 0", "P3: params: principal point"),
        ("\n\n", "no P2"),
    ],
)
def test_bad_calibrations(sequence: Path, tmp_path: Path, calibration: str, message: str) -> None:
    (sequence / "calib.txt").write_text(calibration + "\n")
    what = refused(sequence, tmp_path / "drive")
    assert message in what
    assert str(sequence / "calib.txt") in what


def test_sequence_without_images(sequence: Path, tmp_path: Path) -> None:
    for file in sequence.glob("image_*/*"):
        file.unlink()
    assert "has no images in image_2, image_3" in refused(sequence, tmp_path / "drive")


def test_unreadable_first_image(sequence: Path, tmp_path: Path) -> None:
    (sequence / "image_3/000000.png").write_bytes(b"")
    assert "image_3/000000.png is empty" in refused(sequence, tmp_path / "drive")
