from __future__ import annotations

import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.geodesy import ecef_from_local, geodetic_from_local
from mrasfm_engine.preflight.drive_reader import Finding, Severity, check_drive, read_drive, require_sound
from mrasfm_engine.scene.drive import matrix_from_pose, pose_from_matrix
from schemas import Pose
from schemas.findings import as_json

WriteDrive = Callable[[dict[str, Any]], Path]
Document = dict[str, Any]


def findings(root: Path, **options: Any) -> dict[str, list[Finding]]:
    result: dict[str, list[Finding]] = {}
    for finding in check_drive(read_drive(root), **options):
        result.setdefault(finding.code, []).append(finding)
    return result


def only(root: Path, code: str, severity: Severity, **options: Any) -> Finding:
    """The drive's one finding, which must have this code and severity."""
    found = findings(root, **options)
    assert list(found) == [code]
    assert len(found[code]) == 1
    assert found[code][0].severity is severity
    assert found[code][0].remedy
    return found[code][0]


def test_sound_drive_has_no_findings(drive_document: Document, write_drive: WriteDrive) -> None:
    calls: list[tuple[int, int]] = []
    drive_document["frames"][0]["images"]["left"]["mask"] = "masks/left.png"
    drive_document["frames"][1]["images"]["left"]["mask"] = "masks/left.png"
    drive = read_drive(write_drive(drive_document))
    assert check_drive(drive, progress=lambda done, total: calls.append((done, total))) == []
    require_sound([])
    assert [done for done, _ in calls] == list(range(1, 12))  # ten images and the mask they share
    assert calls[-1] == (11, 11)


def test_errors_come_first_and_are_raised(drive_document: Document, write_drive: WriteDrive) -> None:
    root = write_drive(drive_document)
    cv2.imwrite(str(root / "images/left/999999.png"), np.zeros((4, 4), np.uint8))
    (root / "images/left/000002.png").unlink()
    (root / "images/right/000001.png").write_bytes(b"")
    found = check_drive(read_drive(root))
    assert [f.severity for f in found] == [Severity.ERROR, Severity.ERROR, Severity.WARNING]
    with pytest.raises(InputError, match=r"000001.png is empty .* \(1 more error\)") as caught:
        require_sound(found)
    assert caught.value.code == "empty-file"
    require_sound(found[2:])


def test_missing_image(drive_document: Document, write_drive: WriteDrive) -> None:
    root = write_drive(drive_document)
    (root / "images/left/000002.png").unlink()
    finding = only(root, "missing-file", Severity.ERROR)
    assert "images/left/000002.png does not exist" in finding.what
    assert str(root) not in finding.what


def test_many_missing_images_are_counted(drive_document: Document, write_drive: WriteDrive) -> None:
    root = write_drive(drive_document)
    for file in root.glob("images/*/*.png"):
        file.unlink()
    found = findings(root)["missing-file"]
    assert len(found) == 6
    assert "5 more files" in found[-1].what
    assert as_json(found[-1])["count"] == 5
    with pytest.raises(InputError, match=r"images/left/000000.png does not exist \(9 more errors\)"):
        require_sound(found)


@pytest.mark.parametrize(("links", "more"), [(1, ""), (2, " (1 more error)"), (6, " (5 more errors)"), (8, " (7 more")])
def test_links_out_of_the_drive_are_counted(
    drive_document: Document, write_drive: WriteDrive, tmp_path: Path, links: int, more: str
) -> None:
    root = write_drive(drive_document)
    for file in sorted(root.glob("images/*/*.png"))[:links]:
        file.rename(tmp_path / f"{file.parent.name} {file.name}")
        file.symlink_to(tmp_path / f"{file.parent.name} {file.name}")
    with pytest.raises(InputError) as caught:
        require_sound(check_drive(read_drive(root)))
    assert caught.value.what.startswith(f"file images/left/000000.png is a link to a place outside the drive{more}")
    assert bool(more) == ("more" in caught.value.what)


def test_unlisted_images(drive_document: Document, write_drive: WriteDrive) -> None:
    root = write_drive(drive_document)
    for i in range(4):
        (root / f"images/left/extra{i}.JPG").touch()
    (root / "images/left/notes.txt").touch()
    finding = only(root, "unlisted-images", Severity.WARNING)
    assert finding.what.startswith("4 images")
    assert "images/left/extra0.JPG" in finding.what


def test_images_that_are_copies_of_the_one_before(drive_document: Document, write_drive: WriteDrive) -> None:
    root = write_drive(drive_document)
    images = root / "images/left"
    for copy, original in ((2, 1), (3, 1)):
        (images / f"00000{copy}.png").write_bytes((images / f"00000{original}.png").read_bytes())
    # Of another camera, and of other frames than the one before, they are no repetition.
    (root / "images/right/000000.png").write_bytes((images / "000000.png").read_bytes())
    (root / "images/right/000004.png").write_bytes((root / "images/right/000002.png").read_bytes())
    finding = only(root, "repeated-images", Severity.WARNING)
    assert "2 of 5 images of camera left are copies of the one before them, up to 2 in a row" in finding.what
    assert "images/left/000002.png, images/left/000003.png" in finding.what


def test_links_out_of_the_drive(drive_document: Document, write_drive: WriteDrive, tmp_path: Path) -> None:
    root = write_drive(drive_document)
    outside = tmp_path / "outside.png"
    (root / "images/left/000002.png").rename(outside)
    (root / "images/left/000002.png").symlink_to(outside)
    assert "images/left/000002.png" in only(root, "path-escapes", Severity.ERROR).what
    (root / "images/left/000002.png").unlink()
    outside.rename(root / "elsewhere.png")
    (root / "images/left/000002.png").symlink_to(root / "elsewhere.png")
    assert findings(root) == {}  # a link inside the drive


def test_folder_linked_out_of_the_drive(drive_document: Document, write_drive: WriteDrive, tmp_path: Path) -> None:
    root = write_drive(drive_document)
    (root / "images/left").rename(tmp_path / "left")
    (root / "images/left").symlink_to(tmp_path / "left")
    assert len(findings(root)["path-escapes"]) == 5


def test_links_in_a_circle(drive_document: Document, write_drive: WriteDrive) -> None:
    root = write_drive(drive_document)
    file = root / "images/left/000002.png"
    file.unlink()
    file.symlink_to(file)
    assert "000002.png" in only(root, "path-escapes", Severity.ERROR).what


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_truncated_and_foreign_images(drive_document: Document, write_drive: WriteDrive, suffix: str) -> None:
    drive_document["frames"][0]["images"]["left"]["file"] = f"images/left/000000{suffix}"
    root = write_drive(drive_document)
    file = root / f"images/left/000000{suffix}"
    data = file.read_bytes()
    file.write_bytes(data[:-20])
    assert "is truncated" in only(root, "truncated-image", Severity.ERROR).what
    file.write_bytes(b"no image at all")
    assert "neither a JPEG nor a PNG" in only(root, "not-an-image", Severity.ERROR).what
    file.write_bytes(b"")
    assert "0 bytes" in only(root, "empty-file", Severity.ERROR).what


def test_image_of_another_size(drive_document: Document, write_drive: WriteDrive) -> None:
    root = write_drive(drive_document)
    cv2.imwrite(str(root / "images/right/000003.png"), np.zeros((24, 32), np.uint8))
    what = only(root, "image-size", Severity.ERROR).what
    assert "images/right/000003.png has 32x24 pixels" in what
    assert "camera right is for 48x32" in what


def test_turned_image(drive_document: Document, write_drive: WriteDrive) -> None:
    drive_document["frames"][0]["images"]["left"]["file"] = "images/left/000000.jpg"
    root = write_drive(drive_document)
    file = root / "images/left/000000.jpg"
    data = file.read_bytes()
    tiff = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x08\0\0\0\0\0\0\0"
    file.write_bytes(data[:2] + b"\xff\xe1" + (len(tiff) + 8).to_bytes(2, "big") + b"Exif\0\0" + tiff + data[2:])
    finding = only(root, "exif-orientation", Severity.ERROR)
    assert "images/left/000000.jpg" in finding.what
    assert "EXIF orientation 8" in finding.what


def test_unusual_pixels_are_warned_of_once(drive_document: Document, write_drive: WriteDrive) -> None:
    root = write_drive(drive_document)
    for i in range(2):
        cv2.imwrite(str(root / f"images/left/{i:06d}.png"), np.full((32, 48, 4), i, np.uint16))
    found = findings(root)
    assert sorted(found) == ["16-bit-image", "alpha-channel"]
    for group in found.values():
        assert [f.severity for f in group] == [Severity.WARNING]
        assert group[0].what.startswith("2 images")


@pytest.mark.parametrize(
    ("pixels", "code", "message"),
    [
        (np.zeros((16, 24), np.uint8), "mask-size", "24x16 pixels, its image has 48x32"),
        (np.zeros((32, 48, 3), np.uint8), "bad-mask", "rgb"),
        (np.zeros((32, 48), np.uint16), "bad-mask", "16 bits"),
        (np.full((32, 48), 77, np.uint8), "unknown-label", "does not have: 77"),
        (None, "missing-file", "masks/l.png does not exist"),
    ],
)
def test_bad_masks(
    drive_document: Document, write_drive: WriteDrive, pixels: np.ndarray | None, code: str, message: str
) -> None:
    drive_document["frames"][2]["images"]["left"]["mask"] = "masks/l.png"
    root = write_drive(drive_document)
    (root / "masks/l.png").unlink()
    if pixels is not None:
        cv2.imwrite(str(root / "masks/l.png"), pixels)
    finding = only(root, code, Severity.ERROR)
    assert message in finding.what
    assert str(root) not in finding.what


def test_mask_ids_follow_the_label_map(drive_document: Document, write_drive: WriteDrive) -> None:
    drive_document["frames"][2]["images"]["left"]["mask"] = "masks/l.png"
    drive_document["label_map"] = {"ids": {"77": "road"}}
    root = write_drive(drive_document)
    assert "does not have: 0" in only(root, "unknown-label", Severity.ERROR).what
    cv2.imwrite(str(root / "masks/l.png"), np.full((32, 48), 77, np.uint8))
    assert findings(root) == {}


def test_too_few_frames(drive_document: Document, write_drive: WriteDrive) -> None:
    drive_document["frames"] = drive_document["frames"][:1]
    assert "1 frames" in only(write_drive(drive_document), "too-few-frames", Severity.ERROR, use_gnss=False).what


def test_two_frames_are_enough(drive_document: Document, write_drive: WriteDrive) -> None:
    drive_document["frames"] = drive_document["frames"][:2]
    assert findings(write_drive(drive_document)) == {}


def test_frame_and_camera_without_images(drive_document: Document, write_drive: WriteDrive) -> None:
    drive_document["frames"][3]["images"] = {}
    assert "frames.3" in only(write_drive(drive_document), "frame-without-images", Severity.WARNING).what
    for frame in drive_document["frames"]:
        frame["images"].pop("right", None)
    found = findings(write_drive(drive_document))
    assert sorted(found) == ["camera-without-images", "frame-without-images", "scale-not-from-rig"]
    assert "camera right" in found["camera-without-images"][0].what


def test_a_camera_that_is_never_in_a_frame_with_another(drive_document: Document, write_drive: WriteDrive) -> None:
    for number, frame in enumerate(drive_document["frames"]):
        del frame["images"]["left" if number % 2 else "right"]
    assert "left, right" in only(write_drive(drive_document), "camera-alone", Severity.WARNING).what
    for number, frame in enumerate(drive_document["frames"]):
        frame["images"] = {"left": {"file": f"images/left/{number:06d}.png"}}
    assert "camera-alone" not in findings(write_drive(drive_document))


@pytest.mark.parametrize(("factor", "unit"), [(0.001, "milliseconds"), (1000, "nanoseconds")])
def test_frame_times_in_other_units(
    drive_document: Document, write_drive: WriteDrive, factor: float, unit: str
) -> None:
    for frame in drive_document["frames"]:
        frame["timestamp_us"] = int(frame["timestamp_us"] * factor)
    assert unit in only(write_drive(drive_document), "frame-rate", Severity.ERROR, use_gnss=False).what


def test_unsynchronised_image(drive_document: Document, write_drive: WriteDrive) -> None:
    images = drive_document["frames"][2]["images"]
    images["left"]["timestamp_us"] = 1_200_000 + 60_000
    assert findings(write_drive(drive_document)) == {}
    images["right"]["timestamp_us"] = 1_200_000 - 61_000
    finding = only(write_drive(drive_document), "unsynchronised", Severity.WARNING)
    assert "images/right/000002.png with 61 ms" in finding.what


@pytest.mark.parametrize("late_us", [250_000, -250_000])
def test_images_of_other_frames(drive_document: Document, write_drive: WriteDrive, late_us: int) -> None:
    """Of a camera that is synchronous to none of its frames, but to others."""
    for frame in drive_document["frames"]:
        frame["images"]["left"]["timestamp_us"] = frame["timestamp_us"] + late_us
    root = write_drive(drive_document)
    (finding,) = findings(root, use_gnss=False)["unsynchronised"]
    assert finding.severity == Severity.ERROR
    assert "5 images are over 60 ms" in finding.what
    assert "between most images of left and their frames lie other frames" in finding.what
    for frame in drive_document["frames"][:3]:
        del frame["images"]["left"]["timestamp_us"]
    (finding,) = findings(write_drive(drive_document), use_gnss=False)["unsynchronised"]
    assert finding.severity is Severity.WARNING


def test_a_slow_camera_may_be_late_beside_a_fast_one(drive_document: Document, write_drive: WriteDrive) -> None:
    """Units of the fast one alone lie between its time and that of its unit."""
    for i, frame in enumerate(drive_document["frames"]):
        frame["images"]["left"]["timestamp_us"] = frame["timestamp_us"] + 250_000
        if i != 1:
            del frame["images"]["left"]
    root = write_drive(drive_document)
    assert only(root, "unsynchronised", Severity.WARNING, use_gnss=False)


def test_one_camera_needs_another_scale(drive_document: Document, write_drive: WriteDrive) -> None:
    drive_document["rig"]["cameras"] = drive_document["rig"]["cameras"][:1]
    for frame in drive_document["frames"]:
        frame["images"].pop("right")
    root = write_drive(drive_document)
    assert "from GNSS alone" in only(root, "scale-not-from-rig", Severity.WARNING).what
    only(root, "no-metric-scale", Severity.ERROR, use_gnss=False)
    drive_document["rough_poses"] = rough_poses([(0.0, float(i)) for i in range(5)])
    root = write_drive(drive_document)
    assert "rough poses alone" in only(root, "scale-not-from-rig", Severity.WARNING, use_gnss=False).what


def rough_poses(track: list[tuple[float, float]]) -> Document:
    return {
        "sigma_translation_m": 0.2,
        "poses": [
            {
                "timestamp_us": 1_000_000 + 100_000 * i,
                "world_from_rig": pose_from_matrix(se3.transform(np.eye(3), [x, y, 0.0])).model_dump(),
            }
            for i, (x, y) in enumerate(track)
        ],
    }


@pytest.mark.parametrize("in_radians", [True, False])
def test_positions_where_there_is_no_land(drive_document: Document, write_drive: WriteDrive, in_radians: bool) -> None:
    samples = drive_document["gnss"]["samples"]
    wrong = samples if in_radians else samples[:2]  # a receiver that gives zeros until it has a fix
    for sample in wrong:
        for name in ("latitude_deg", "longitude_deg"):
            sample[name] = np.radians(sample[name]).item() if in_radians else 0.0
    (finding,) = findings(write_drive(drive_document))["gnss-at-sea"]
    assert finding.severity is Severity.WARNING
    assert finding.what.startswith(f"{len(wrong)} of {len(samples)} gnss.samples lie in the sea")


def test_heights_that_are_all_zero(drive_document: Document, write_drive: WriteDrive) -> None:
    samples = drive_document["gnss"]["samples"]
    for sample in samples:
        sample["height_m"] = 0.0
    what = only(write_drive(drive_document), "gnss-heights-zero", Severity.WARNING).what
    assert what.startswith(f"all {len(samples)} gnss.samples have a height_m of exactly 0")
    samples[-1]["height_m"] = 0.1  # a coast is at such heights
    assert findings(write_drive(drive_document)) == {}


def test_rough_poses_in_time(drive_document: Document, write_drive: WriteDrive) -> None:
    drive_document["rough_poses"] = rough_poses([(0.0, float(i)) for i in range(5)])
    poses = drive_document["rough_poses"]["poses"]
    assert findings(write_drive(drive_document)) == {}
    drive_document["rough_poses"]["poses"] = poses[:3]
    assert "2 of 5 frames" in only(write_drive(drive_document), "rough-poses-partial", Severity.WARNING).what
    drive_document["rough_poses"]["poses"] = [poses[1], poses[0]]
    only(write_drive(drive_document), "rough-poses-order", Severity.ERROR)
    drive_document["rough_poses"]["poses"] = [poses[0] | {"timestamp_us": 90_000_000}]
    only(write_drive(drive_document), "rough-poses-not-covering", Severity.ERROR)


def test_rough_poses_in_centimetres(drive_document: Document, write_drive: WriteDrive) -> None:
    """Faster than any vehicle, unless that is within the noise that they state."""
    drive_document["rough_poses"] = rough_poses([(0.0, 10.0 * i) for i in range(5)])  # 100 m/s
    assert findings(write_drive(drive_document)) == {}
    drive_document["rough_poses"] = rough_poses([(0.0, 200.0 * i) for i in range(5)])
    finding = only(write_drive(drive_document), "rough-poses-speed", Severity.ERROR)
    assert "200 m in 0.1 s" in finding.what
    assert "centimetres" in finding.remedy
    drive_document["rough_poses"]["sigma_translation_m"] = 50.0
    assert findings(write_drive(drive_document)) == {}


@pytest.mark.parametrize("axes", ["flu", "frd"])
def test_rough_poses_in_a_world_with_z_down(drive_document: Document, write_drive: WriteDrive, axes: str) -> None:
    """North, east, down; a vehicle of axes forward, right, down lies level in it, and is upside down for us."""
    drive_document["rough_poses"] = rough_poses([(float(i), 0.0) for i in range(5)])
    over = [1.0, 0.0, 0.0, 0.0]  # about x: z points down
    drive_document["rig"]["body_axes"] = axes
    if axes == "frd":
        turn = se3.transform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
        for camera in drive_document["rig"]["cameras"]:
            pose = matrix_from_pose(Pose(**camera["rig_from_cam"]))
            camera["rig_from_cam"] = pose_from_matrix(turn @ pose).model_dump()
        drive_document["gnss"]["antenna_in_rig_m"] = [0.0, 0.0, -1.8]
    else:
        for pose in drive_document["rough_poses"]["poses"]:
            pose["world_from_rig"]["rotation_xyzw"] = over
    finding = only(write_drive(drive_document), "rough-poses-world", Severity.WARNING)
    assert "z axis points up" in finding.remedy
    for pose in drive_document["rough_poses"]["poses"]:
        pose["world_from_rig"]["rotation_xyzw"] = over if axes == "frd" else [0.0, 0.0, 0.0, 1.0]
    assert findings(write_drive(drive_document)) == {}


def test_wrong_axes_of_the_whole_rig(drive_document: Document, write_drive: WriteDrive) -> None:
    first, second = drive_document["rig"]["cameras"]
    first["rig_from_cam"]["rotation_xyzw"] = [0, 0, 0, 1]  # KITTI's, declared as ours
    finding = only(write_drive(drive_document), "camera-turned", Severity.WARNING)
    assert "camera left is turned" in finding.what
    assert "where it is mounted so" in finding.remedy  # upside down, or on edge
    second["rig_from_cam"]["rotation_xyzw"] = [0.5, -0.5, 0.5, 0.5]  # the inverse of what it should be
    finding = only(write_drive(drive_document), "rig-axes", Severity.ERROR)
    assert "cameras left, right are turned" in finding.what
    drive_document["rig"]["body_axes"] = "rdf"
    second["rig_from_cam"]["rotation_xyzw"] = [0, 0, 0, 1]
    drive_document["gnss"]["antenna_in_rig_m"] = [0, -1.8, 0]
    assert findings(write_drive(drive_document)) == {}


def test_portrait_cameras_whose_images_lie_on_their_side_are_no_wrong_axes(
    drive_document: Document, write_drive: WriteDrive
) -> None:
    upright = Rotation.from_quat([-0.5, 0.5, -0.5, 0.5])  # looks ahead, in forward, left, up
    cameras = drive_document["rig"]["cameras"]

    def turned_by(*angles_deg: float) -> None:
        for camera, angle in zip(cameras, angles_deg, strict=True):
            camera["rig_from_cam"]["rotation_xyzw"] = (
                (upright * Rotation.from_euler("z", angle, True)).as_quat().tolist()
            )

    turned_by(90.0, 80.0)
    assert "on edge" in only(write_drive(drive_document), "rig-axes", Severity.WARNING).remedy
    turned_by(90.0, -90.0)
    only(write_drive(drive_document), "rig-axes", Severity.WARNING)
    turned_by(180.0, 180.0)  # or an aviator's axes
    assert "upside down" in only(write_drive(drive_document), "rig-axes", Severity.ERROR).remedy
    for camera in cameras:
        camera["rig_from_cam"]["rotation_xyzw"] = upright.inv().as_quat().tolist()  # look aside, on edge
    only(write_drive(drive_document), "rig-axes", Severity.ERROR)


def test_cameras_that_look_down_at_the_road_are_no_wrong_axes(
    drive_document: Document, write_drive: WriteDrive
) -> None:
    ahead = Rotation.from_quat([-0.5, 0.5, -0.5, 0.5])  # in forward, left, up
    cameras = drive_document["rig"]["cameras"]
    for camera, pitch_deg in zip(cameras, (-90.0, -65.0), strict=True):
        camera["rig_from_cam"]["rotation_xyzw"] = (ahead * Rotation.from_euler("x", pitch_deg, True)).as_quat().tolist()
    assert "look down at the road" in only(write_drive(drive_document), "rig-axes", Severity.WARNING).remedy
    cameras[0]["rig_from_cam"]["rotation_xyzw"] = (ahead * Rotation.from_euler("x", 90.0, True)).as_quat().tolist()
    only(write_drive(drive_document), "rig-axes", Severity.ERROR)  # one looks up


def test_findings_read_well(drive_document: Document, write_drive: WriteDrive) -> None:
    root = write_drive(drive_document)
    (root / "images/left/000002.png").unlink()
    assert str(check_drive(read_drive(root))[0]).startswith("error: image images/left/000002.png does not exist\n  ")


def test_gnss_without_samples(drive_document: Document, write_drive: WriteDrive) -> None:
    drive_document["gnss"]["samples"] = []
    root = write_drive(drive_document)
    assert "--no-gnss" in only(root, "gnss-empty", Severity.ERROR).remedy
    assert findings(root, use_gnss=False) == {}


def test_gnss_order(drive_document: Document, write_drive: WriteDrive) -> None:
    samples = drive_document["gnss"]["samples"]
    samples[2]["timestamp_us"] = samples[1]["timestamp_us"]
    finding = only(write_drive(drive_document), "gnss-repeats", Severity.ERROR)
    assert "gnss.samples.2.timestamp_us repeats 1100000" in finding.what
    samples[3]["timestamp_us"] = 5
    found = findings(write_drive(drive_document))
    assert sorted(found) == ["gnss-order", "gnss-repeats"]
    assert "gnss.samples.3.timestamp_us goes back from 1100000 to 5" in found["gnss-order"][0].what


@pytest.mark.parametrize(
    ("leap", "direction", "verb"), [(18, "late", "Subtract"), (-18, "early", "Add"), (17, "late", "Subtract")]
)
def test_gnss_off_by_leap_seconds(
    drive_document: Document, write_drive: WriteDrive, leap: int, direction: str, verb: str
) -> None:
    for frame in drive_document["frames"]:
        frame["timestamp_us"] += 100_000_000
    for sample in drive_document["gnss"]["samples"]:
        sample["timestamp_us"] += 100_000_000 + leap * 1_000_000
    finding = only(write_drive(drive_document), "gnss-leap-seconds", Severity.ERROR)
    assert f"{abs(leap)} s too {direction}" in finding.what
    assert finding.remedy.startswith(f"{verb} {abs(leap)}000000")


@pytest.mark.parametrize(("start_s", "end_s", "severity"), [(18, 78, Severity.ERROR), (10, 100, Severity.WARNING)])
def test_gnss_that_may_be_off_by_leap_seconds(
    drive_document: Document, write_drive: WriteDrive, start_s: int, end_s: int, severity: Severity
) -> None:
    """A drive of a minute: samples off by 18 s cover most of it, as do those of a receiver that began late."""
    for i, frame in enumerate(drive_document["frames"]):
        frame["timestamp_us"] = 15_000_000 * i
    sample = drive_document["gnss"]["samples"][0]
    drive_document["gnss"]["samples"] = [sample | {"timestamp_us": 1_000_000 * t} for t in range(start_s, end_s + 1)]
    finding = only(write_drive(drive_document), "gnss-leap-seconds", severity)
    assert "18 s too late" in finding.what


def test_gnss_of_another_time(drive_document: Document, write_drive: WriteDrive) -> None:
    for sample in drive_document["gnss"]["samples"]:
        sample["timestamp_us"] += 60_000_000
    finding = only(write_drive(drive_document), "gnss-not-covering", Severity.ERROR)
    assert "images span 1.000 to 1.400 s, the GNSS samples 61.000 to 61.400 s" in finding.what


def test_gnss_of_part_of_the_drive(drive_document: Document, write_drive: WriteDrive) -> None:
    samples = drive_document["gnss"]["samples"]
    drive_document["gnss"]["samples"] = samples[:4]  # the last image is one sample away
    assert findings(write_drive(drive_document)) == {}
    drive_document["gnss"]["samples"] = samples[:3]
    assert "2 of 10 images" in only(write_drive(drive_document), "gnss-partial", Severity.WARNING).what


def test_gnss_whose_times_have_another_unit(drive_document: Document, write_drive: WriteDrive) -> None:
    samples = drive_document["gnss"]["samples"]
    first_us = samples[0]["timestamp_us"]
    for sample in samples:  # nanoseconds since the first image
        sample["timestamp_us"] = first_us + 1000 * (sample["timestamp_us"] - first_us)
    finding = only(write_drive(drive_document), "gnss-sparse", Severity.WARNING)
    assert "8 of 10 images lie between gnss.samples that are over 2 s apart, by up to 100 s" in finding.what


def test_gnss_jump(drive_document: Document, write_drive: WriteDrive) -> None:
    samples = drive_document["gnss"]["samples"]
    samples[2]["latitude_deg"] += 9 / 111_000  # 100 m/s and half a metre of noise: still a car in bad reception
    assert findings(write_drive(drive_document)) == {}
    samples[2]["latitude_deg"] += 10 / 111_000
    finding = only(write_drive(drive_document), "gnss-jump", Severity.WARNING)
    assert "gnss.samples.2, gnss.samples.3: 20 m in 0.1 s" in finding.what


@pytest.mark.parametrize("swapped", [False, True])
def test_gnss_with_latitude_and_longitude_exchanged(
    drive_document: Document, write_drive: WriteDrive, swapped: bool
) -> None:
    """A bend of 10 m radius: with exchanged coordinates it turns the other way."""
    angle = np.linspace(0, 1.5, 5)
    track = np.stack([10 * np.sin(angle), 10 * (1 - np.cos(angle)), np.zeros(5)], -1)
    geodetic = geodetic_from_local(track, ecef_from_local([49.0, 8.4, 110.0]))
    for sample, (latitude, longitude, height) in zip(drive_document["gnss"]["samples"], geodetic, strict=True):
        pair = (longitude, latitude) if swapped else (latitude, longitude)
        sample.update(latitude_deg=pair[0], longitude_deg=pair[1], height_m=height)
    drive_document["rough_poses"] = rough_poses([(float(x), float(y)) for x, y, _ in track])
    root = write_drive(drive_document)
    if not swapped:
        assert findings(root) == {}
        return
    assert "latitude and longitude exchanged" in only(root, "gnss-swapped", Severity.ERROR).what


@pytest.mark.parametrize(
    ("datum", "code", "message"),
    [
        ("EPSG:5773", "missing-geoid-grid", "us_nga_egm96_15.tif"),
        ("EPSG:7837", "missing-geoid-grid", "de_bkg_gcg2016.tif"),
        ("EPSG:4326", "height-datum", "not a vertical datum"),
        ("EPSG:999999", "height-datum", "not known"),
    ],
)
def test_height_datum_without_grid_is_refused(
    drive_document: Document, write_drive: WriteDrive, datum: str, code: str, message: str
) -> None:
    drive_document["gnss"]["height_datum"] = datum
    finding = only(write_drive(drive_document), code, Severity.ERROR)
    assert message in finding.what
    assert "ellipsoidal" in finding.remedy


def test_height_datum_with_its_grid(tmp_path: Path) -> None:
    """With a made-up geoid of 47.5 m everywhere; in another process, as PROJ keeps what it has looked up."""
    rows, columns = 181, 361
    head = struct.pack(">ddddii", -90.0, -180.0, 1.0, 1.0, rows, columns)
    (tmp_path / "egm96_15.gtx").write_bytes(head + np.full((rows, columns), 47.5, ">f4").tobytes())
    program = (
        "import sys, pyproj\n"
        "pyproj.datadir.append_data_dir(sys.argv[1])\n"
        "from mrasfm_engine.io.heights import ellipsoidal_heights\n"
        "from schemas import Gnss, GnssSample\n"
        "s = GnssSample(timestamp_us=0, latitude_deg=49, longitude_deg=8, height_m=100.25, sigma_horizontal_m=1,"
        " sigma_vertical_m=1)\n"
        "print(*ellipsoidal_heights(Gnss(height_datum='EPSG:5773', antenna_in_rig_m=[0, 0, 0], samples=[s, s])))\n"
    )
    done = subprocess.run([sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True, check=True)
    np.testing.assert_allclose([float(word) for word in done.stdout.split()], [147.75, 147.75], atol=1e-6)
