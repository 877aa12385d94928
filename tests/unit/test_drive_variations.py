"""Variations of drives: points are seen where the changed images show them, and positions go with the true poses."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.alignment import align_rigid
from mrasfm_engine.geometry.geodesy import ecef_from_local, geodetic_from_local, local_from_geodetic
from mrasfm_engine.io.trajectory_file import Trajectory, format_tum
from mrasfm_engine.preflight.drive_reader import read_drive
from mrasfm_engine.scene.drive import matrix_from_pose, pose_from_matrix
from mrasfm_engine.types import Floats
from schemas import DriveManifest, Pose
from schemas.manifest_check import check_manifest
from tests.benchmarks.variations import EXACT, LIGHT, RESAMPLED, SURROUND, VARIATIONS
from tests.conftest import WriteDrive
from tests.helpers.drive_variations import GEODETIC, MIRROR, VariedDrive, composed, mirrored, on_cameras, placed_at
from tests.helpers.image_variations import noise

START_US, STEP_US, LATE_US, RECEIVER_US = 1_700_000_000_000_000, 100_000, 12_000, 37_000
PLACE, ANTENNA_M = (49.0, 8.4, 110.0), np.array([-0.4, 0.3, 1.7])
CAMERA_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # looks ahead
UNITS, LEAST_COMPARED = 6, 60
EXACTLY_PX = 1e-5
RESAMPLED_PX = 0.1  # areas of whole pixels that a fraction covers; half a pixel's shift is 0.3 px or more


@pytest.fixture
def drive() -> VariedDrive:
    """A turning, climbing and rolling vehicle with two different cameras, of which one is late."""
    times_us = START_US + STEP_US * np.arange(UNITS)
    stamps_us = np.sort(np.concatenate([times_us, times_us + LATE_US, times_us + RECEIVER_US]))
    truth = Trajectory(timestamps_us=stamps_us, world_from_rig=_poses((stamps_us - START_US) / STEP_US))
    antenna_m = se3.apply(truth.world_from_rig, ANTENNA_M[None])[:, 0]
    places = geodetic_from_local(antenna_m, ecef_from_local(PLACE))
    at = np.searchsorted(stamps_us, times_us + RECEIVER_US)
    samples = [
        {"timestamp_us": int(stamps_us[k]), **dict(zip(GEODETIC, places[k].tolist(), strict=True)),
         "sigma_horizontal_m": 0.1, "sigma_vertical_m": 0.2}
        for k in at
    ]  # fmt: skip
    frames = [
        {
            "timestamp_us": int(time_us),
            "source_frame": k,
            "images": {
                "ahead": {"file": f"images/ahead/{k}.jpg"},
                "aside": {"file": f"images/aside/{k}.jpg", "timestamp_us": int(time_us) + LATE_US},
            },
        }
        for k, time_us in enumerate(times_us)
    ]
    manifest = {
        "version": 1,
        "name": "turning",
        "rig": {"body_axes": "flu", "cameras": [_camera("ahead", 120, 80, 4.0), _camera("aside", 100, 90, 70.0)]},
        "frames": frames,
        "gnss": {"height_datum": "ellipsoidal", "antenna_in_rig_m": ANTENNA_M.tolist(), "samples": samples},
    }
    return VariedDrive(manifest=manifest, truth=truth)


def _poses(steps: Floats) -> Floats:
    turn = se3.exp_so3(np.stack([0.02 * steps, -0.01 * steps, 0.12 * steps], -1))
    return se3.transform(turn, np.stack([3.0 * steps, 0.3 * steps**2, 0.1 * steps], -1))


def _camera(name: str, width: int, height: int, yaw_deg: float) -> dict[str, Any]:
    pose = se3.transform(se3.exp_so3([0.02, 0.03, np.radians(yaw_deg)]) @ CAMERA_AXES, [1.2, 0.4, 1.5])
    params = [0.61 * width, 0.63 * width, 0.47 * width, 0.54 * height]
    return {"name": name, "model": "PINHOLE", "width": width, "height": height, "params": params,
            "rig_from_cam": pose_from_matrix(pose).model_dump()}  # fmt: skip


def _pixels(drive: VariedDrive, points_m: Floats) -> Iterator[tuple[str, dict[str, Any], Floats]]:
    """File and camera of each image, and the pixels (n, 2) of points; NaN behind the camera."""
    poses = dict(zip(drive.truth.timestamps_us.tolist(), drive.truth.world_from_rig, strict=True))
    cameras = {camera["name"]: camera for camera in drive.cameras}
    for frame in drive.manifest["frames"]:
        for name, image in frame["images"].items():
            rig_from_cam = matrix_from_pose(Pose(**cameras[name]["rig_from_cam"]))
            world_from_cam = poses[image.get("timestamp_us", frame["timestamp_us"])] @ rig_from_cam
            x, y, z = se3.apply(se3.inverse(world_from_cam), points_m).T
            fx, fy, cx, cy = cameras[name]["params"]
            pixels = np.stack([fx * x / z + cx, fy * y / z + cy], -1)
            yield image["file"], cameras[name], np.where(z[:, None] > 0.5, pixels, np.nan)


def _own_coordinates(camera: dict[str, Any]) -> list[Floats]:
    """Two images (h, w): each pixel's x, and each pixel's y."""
    rows, columns = np.mgrid[: camera["height"], : camera["width"]]
    return [columns + 0.5, rows + 0.5]


def _sampled(image: Floats, pixels: Floats) -> Floats:
    return np.asarray(map_coordinates(image, (pixels[:, ::-1] - 0.5).T, order=1))


def _is_inside(pixels: Floats, camera: dict[str, Any], margin_px: float) -> np.ndarray:
    sides = np.array([camera["width"], camera["height"]])
    return np.asarray(((pixels > margin_px) & (pixels < sides - margin_px)).all(1))


@pytest.mark.parametrize("title", [*EXACT, *RESAMPLED])
def test_points_are_where_the_changed_images_show_them(drive: VariedDrive, title: str) -> None:
    varied = copy.deepcopy(drive)
    VARIATIONS[title](varied)
    points_m = np.random.default_rng(1).uniform([-10, -30, -3], [60, 40, 8], (400, 3))
    before = {file: (camera, pixels) for file, camera, pixels in _pixels(drive, points_m)}
    points_m = se3.apply(MIRROR, points_m) if "mirrored" in title else points_m
    compared, most_px = 0, RESAMPLED_PX if title in RESAMPLED else EXACTLY_PX
    for file, camera, after in _pixels(varied, points_m):
        camera_before, expected = before.pop(file)
        shown = _own_coordinates(camera_before)
        for change in varied.image_changes[camera["name"]]:
            shown = [change(image) for image in shown]
        assert {image.shape for image in shown} == {(camera["height"], camera["width"])}
        both = _is_inside(after, camera, 3.0) & _is_inside(expected, camera_before, 3.0)
        seen = np.stack([_sampled(image, after[both]) for image in shown], -1)
        assert np.abs(seen - expected[both]).max() < most_px
        compared += int(both.sum())
        if title in EXACT:
            inside = _is_inside(after, camera, 0.01)
            assert np.array_equal(inside, _is_inside(expected, camera_before, 0.01))
    assert before == {}
    assert compared > LEAST_COMPARED


@pytest.mark.parametrize("title", list(VARIATIONS))
def test_positions_of_the_receiver_go_with_the_true_poses(drive: VariedDrive, title: str) -> None:
    VARIATIONS[title](drive)
    poses = dict(zip(drive.truth.timestamps_us.tolist(), drive.truth.world_from_rig, strict=True))
    gnss = drive.manifest["gnss"]
    true = np.stack([poses[sample["timestamp_us"]] for sample in gnss["samples"]])
    antenna_m = se3.apply(true, np.array(gnss["antenna_in_rig_m"])[None])[:, 0]
    geodetic = np.array([[sample[key] for key in GEODETIC] for sample in gnss["samples"]])
    local_m = local_from_geodetic(geodetic, ecef_from_local(geodetic[0]))
    # A rigid transform alone: a mirror image would not fit. The truth stands upright, as the receiver's frame does.
    local_from_world = align_rigid(local_m, antenna_m).a_from_b
    assert 0 < np.abs(se3.apply(local_from_world, antenna_m) - local_m).max() < 1e-6
    assert local_from_world[2, 2] > 1 - 1e-9


@pytest.mark.parametrize("title", list(VARIATIONS))
def test_varied_manifests_are_right(drive: VariedDrive, title: str) -> None:
    VARIATIONS[title](drive)
    manifest = DriveManifest.model_validate(drive.manifest)
    errors = [finding.code for finding in check_manifest(manifest) if finding.severity == "error"]
    assert errors == []


def test_the_date_line_is_crossed(drive: VariedDrive) -> None:
    EXACT["at the date line"](drive)
    longitudes = [sample["longitude_deg"] for sample in drive.manifest["gnss"]["samples"]]
    assert min(longitudes) < -179.99
    assert max(longitudes) > 179.99


def test_a_mirror_image_of_a_mirror_image_is_the_drive(drive: VariedDrive) -> None:
    varied = copy.deepcopy(drive)
    composed(mirrored, placed_at(10.0, 20.0, 30.0), mirrored)(varied)
    placed_at(10.0, 20.0, 30.0)(drive)
    assert np.allclose(varied.truth.world_from_rig, drive.truth.world_from_rig)
    for ours, theirs in zip(varied.cameras, drive.cameras, strict=True):
        assert np.allclose(ours["params"], theirs["params"])
    for ours, theirs in zip(varied.manifest["gnss"]["samples"], drive.manifest["gnss"]["samples"], strict=True):
        assert ours == pytest.approx(theirs, abs=1e-7)


@pytest.mark.parametrize("channels", [(), (3,)])
@pytest.mark.parametrize("title", list(LIGHT))
def test_light_changes_pixels_and_nothing_else(drive: VariedDrive, title: str, channels: tuple[int, ...]) -> None:
    varied = copy.deepcopy(drive)
    LIGHT[title](varied)
    assert (varied.manifest, varied.truth.timestamps_us.tolist()) == (
        drive.manifest,
        drive.truth.timestamps_us.tolist(),
    )
    camera = drive.cameras[0]
    image = np.random.default_rng(2).integers(0, 256, (camera["height"], camera["width"], *channels), dtype=np.uint8)
    (change,) = varied.image_changes[camera["name"]]
    changed, original = change(image), image.copy()
    assert (changed.shape, changed.dtype) == (image.shape, image.dtype)
    assert (changed != image).mean() > 0.05
    assert np.array_equal(image, original)


def test_noise_of_two_cameras_is_not_the_same(drive: VariedDrive) -> None:
    on_cameras(slice(None), noise(6.0))(drive)
    grey = np.full((40, 50), 128, np.uint8)
    changed = [drive.image_changes[camera["name"]][0](grey).astype(float) for camera in drive.cameras]
    assert all(5.5 < image.std() < 6.5 for image in changed)
    assert abs(np.corrcoef(changed[0].ravel(), changed[1].ravel())[0, 1]) < 0.1


def test_drives_are_written_with_their_changed_images(
    write_drive: WriteDrive, drive_document: dict[str, Any], tmp_path: Path
) -> None:
    drive_document["frames"][0]["images"]["left"]["mask"] = "masks/0.png"
    source = write_drive(drive_document)
    times_us = [frame["timestamp_us"] for frame in drive_document["frames"]]
    poses = se3.transform(np.eye(3), np.arange(3 * len(times_us)).reshape(-1, 3))
    (source / "truth.tum").write_text(format_tum(times_us, poses))
    drive, out = VariedDrive.read(source), tmp_path / "varied"
    EXACT["a camera upside down"](drive)
    drive.write(source, out)
    read = read_drive(out)
    assert {image.mask for image in read.images} == {None}
    for image, before in zip(read.images, read_drive(source).images, strict=True):
        ours, theirs = (
            cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in (out / image.file, source / before.file)
        )
        assert np.array_equal(ours, theirs[::-1, ::-1] if image.camera == 0 else theirs)
        assert (out / image.file).samefile(source / before.file) == (image.camera != 0)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda manifest: manifest["rig"]["cameras"][0].update(readout_us=20_000), "readout_us"),
        (lambda manifest: manifest["rig"]["cameras"][1].update(model="OPENCV"), "OPENCV"),
        (lambda manifest: manifest["rig"].update(body_axes="rdf"), "rdf"),
        (lambda manifest: manifest.update(rough_poses={}), "rough_poses"),
    ],
)
def test_drives_that_variations_would_not_keep_right_are_refused(
    drive: VariedDrive, change: Callable[[dict[str, Any]], None], named: str
) -> None:
    change(drive.manifest)
    with pytest.raises(ValueError, match=named):
        VariedDrive(manifest=drive.manifest, truth=drive.truth)


def test_surround_drives_have_variations_of_the_line() -> None:
    assert set(SURROUND) < set(VARIATIONS)
