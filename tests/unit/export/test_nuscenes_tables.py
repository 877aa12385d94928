"""The tables of nuScenes: what is written, read back, and imported again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mrasfm_engine.errors import InputError
from mrasfm_engine.export import run_export as exports
from mrasfm_engine.export.contract import DriveFiles, ExportOptions, ExportWork
from mrasfm_engine.export.formats import WRITERS
from mrasfm_engine.export.nuscenes_channels import channel_name
from mrasfm_engine.export.nuscenes_readback import TABLES
from mrasfm_engine.export.run_export import ExportRequest, run_export
from mrasfm_engine.export.stored_scene import read_source
from mrasfm_engine.geometry import se3
from mrasfm_engine.importers.layouts import import_recording
from mrasfm_engine.io.images import read_image_rgb
from mrasfm_engine.preflight.drive_reader import check_drive, read_drive
from mrasfm_engine.scene.scene import Scene
from tests.helpers.export_example import MISSING_IMAGE, MISSING_UNIT, UNITS
from tests.helpers.export_images import USUAL, written


def _nothing(*_: object) -> None:
    return None


def exported(folder: Path, **options: Any) -> dict[str, Any]:
    request = ExportRequest(
        folder=folder / "scene",
        out=folder / "out",
        formats=["nuscenes"],
        options=ExportOptions(**options),
        drives={"": folder / "drive"},
    )
    report = run_export(request, progress=_nothing, cancel=lambda: False)["formats"]["nuscenes"]
    assert "withheld" not in report, report
    return report


def tables_of(folder: Path) -> dict[str, list[dict[str, Any]]]:
    return {name: json.loads((folder / "v1.0-mrasfm" / f"{name}.json").read_text()) for name in TABLES}


def reprojection_px(scene: Scene, folder: Path, channel: str, camera: int, *, half: float = 0.5) -> np.ndarray:
    """Distances between keypoints and their points as the tables project them, by formulas of the development kit."""
    tables = tables_of(folder)
    by_token = {row["token"]: row for rows in tables.values() for row in rows}
    errors = []
    for row in tables["sample_data"]:
        calibrated, ego = (by_token[row[f"{key}_token"]] for key in ("calibrated_sensor", "ego_pose"))
        if by_token[calibrated["sensor_token"]]["channel"] != channel:
            continue
        unit = int(Path(row["filename"]).stem)
        image = next(i for i, im in enumerate(scene.drive.images) if (im.unit, im.camera) == (unit, camera))
        poses = [
            se3.transform(se3.rotation_from_quaternion(np.roll(p["rotation"], -1)), p["translation"])
            for p in (ego, calibrated)
        ]
        own = np.flatnonzero(scene.observation_image == image)
        points = se3.apply(se3.inverse(poses[0] @ poses[1]), scene.points_m[scene.observation_point[own]])
        pixels = points @ np.array(calibrated["camera_intrinsic"]).T
        keypoints = scene.features[image].xy_px[scene.observation_keypoint[own]]
        errors.append(np.linalg.norm(pixels[:, :2] / pixels[:, 2:] + half - keypoints, axis=1))
    return np.concatenate(errors)


def test_tables_of_pinhole_cameras_with_their_own_images(tmp_path: Path) -> None:
    scene = written(tmp_path, {"PINHOLE": USUAL["PINHOLE"], "OPENCV": USUAL["OPENCV"]}, kind="jpg")
    report = exported(tmp_path)
    out = tmp_path / "out" / "nuscenes"
    tables = tables_of(out)
    assert [row["channel"] for row in tables["sensor"]] == ["CAM_LEFT", "CAM_RIGHT"]
    assert len(tables["sample"]) == UNITS - 1
    assert len(tables["sample_data"]) == 2 * (UNITS - 1) - 1  # an image and a unit have no pose
    assert tables["scene"][0]["nbr_samples"] == UNITS - 1
    assert report["notes"] == ["images are undistorted: right", "1 of 5 units have no pose and are left out"]
    left = scene.drive.images[0]
    assert (out / "samples" / "CAM_LEFT" / "000000.jpg").read_bytes() == (tmp_path / "drive" / left.file).read_bytes()
    # Keypoints are float32; without half a pixel nothing fits.
    assert reprojection_px(scene, out, "CAM_LEFT", 0).max() < 1e-3
    assert np.median(reprojection_px(scene, out, "CAM_LEFT", 0, half=0.0)) > 0.5
    assert {str(MISSING_IMAGE), str(MISSING_UNIT)}.isdisjoint(
        Path(row["filename"]).stem for row in tables["sample_data"] if "RIGHT" in row["filename"]
    )


def test_imported_again_they_are_the_scene(tmp_path: Path) -> None:
    scene = written(tmp_path, {"PINHOLE": USUAL["PINHOLE"], "SIMPLE_PINHOLE": [700.0, 470.0, 310.0]})
    exported(tmp_path)
    summary = import_recording(tmp_path / "out" / "nuscenes", tmp_path / "again")
    assert (summary.layout, summary.units, summary.truth) == ("nuScenes", UNITS - 1, True)
    assert not any("plane" in note for note in summary.notes)
    again = read_drive(tmp_path / "again")
    # All images of a camera are one file here.
    assert {f.code for f in check_drive(again)} == {"repeated-images"}
    for k, (camera, name) in enumerate(zip(again.cameras, ("CAM_LEFT", "CAM_RIGHT"), strict=True)):
        given = scene.calibration[k].params.tolist()
        assert (camera.name, camera.model, camera.width, camera.height) == (name, "PINHOLE", 960, 600)
        np.testing.assert_allclose(camera.params, given if k == 0 else [given[0], *given], atol=1e-9)
        np.testing.assert_allclose(again.rig_from_cam[k], scene.calibration[k].rig_from_cam, atol=1e-9)
    registered = [image for i, image in enumerate(scene.drive.images) if scene.image_registered[i]]
    assert [image.timestamp_us for image in again.images] == [image.timestamp_us for image in registered]
    for one, other in zip(again.images, registered, strict=True):
        assert (again.root / one.file).read_bytes() == (tmp_path / "drive" / other.file).read_bytes()
    # The truth is the mean of the images' poses.
    truth = np.loadtxt(tmp_path / "again" / "truth.tum")
    poses = scene.world_from_rig[scene.image_unit] @ scene.unit_from_image
    first = [i for i, image in enumerate(scene.drive.images) if image.unit == 0 and scene.image_registered[i]]
    np.testing.assert_allclose(truth[0, 1:4], poses[first, :3, 3].mean(0), atol=1e-6)


def test_images_of_another_drive_are_refused(tmp_path: Path) -> None:
    scene = written(tmp_path, {"PINHOLE": USUAL["PINHOLE"], "OPENCV": USUAL["OPENCV"]})
    file = tmp_path / "drive" / scene.drive.images[0].file
    cv2.imwrite(str(file), np.zeros((40, 60, 3), np.uint8))
    with pytest.raises(InputError, match="has 60 x 40 pixels, camera left has 960 x 600"):
        exported(tmp_path)
    file.unlink()
    with pytest.raises(InputError, match="does not exist"):
        exported(tmp_path)
    assert not (tmp_path / "out").exists()


def test_scaled_images_are_made_anew(tmp_path: Path) -> None:
    written(tmp_path, {"PINHOLE": USUAL["PINHOLE"], "OPENCV": USUAL["OPENCV"]})
    exported(tmp_path, image_size_px=240)
    out = tmp_path / "out" / "nuscenes"
    rows = tables_of(out)["sample_data"]
    assert {max(row["width"], row["height"]) for row in rows} == {240}
    assert max(read_image_rgb(out / rows[0]["filename"]).shape) == 240


def written_work(tmp_path: Path) -> tuple[Any, Path]:
    written(tmp_path, {"PINHOLE": USUAL["PINHOLE"], "OPENCV": USUAL["OPENCV"]})
    source = replace(read_source(tmp_path / "scene"), files=DriveFiles(folders={"": tmp_path / "drive"}))
    folder = tmp_path / "work"
    folder.mkdir()
    return WRITERS["nuscenes"](ExportWork(source=source, options=ExportOptions(), folder=folder, step=_nothing)), folder


@pytest.mark.slow
def test_a_changed_character_withholds_the_format_and_names_the_file(tmp_path: Path) -> None:
    """By what the tables say: digests, which would find it first, are left out."""
    made, folder = written_work(tmp_path)
    made = replace(made, digests={})
    assert exports._fault(made, folder) is None
    rng = np.random.default_rng(1)
    for path in sorted((folder / "v1.0-mrasfm").glob("*.json")):
        content = path.read_bytes()
        wanted = [at for at, byte in enumerate(content) if chr(byte).isalnum()]
        refused = total = 0
        for at in rng.choice(wanted, size=min(len(wanted), 60), replace=False) if wanted else []:
            other = b"7" if content[at : at + 1] != b"7" else b"3"
            path.write_bytes(content[:at] + other + content[at + 1 :])
            fault = exports._fault(made, folder)
            refused += fault is not None and path.name in fault
            total += 1
        path.write_bytes(content)
        assert refused == total, path.name
    image = next((folder / "samples" / "CAM_LEFT").iterdir())
    content = image.read_bytes()
    image.write_bytes(content[:500] + bytes([content[500] ^ 1]) + content[501:])
    assert f"{image.name}'s content" in str(exports._fault(made, folder))
    image.write_bytes(content)
    (folder / "maps" / "empty.png").unlink()
    assert "maps" in str(exports._fault(made, folder))


def test_a_mask_that_the_development_kit_asks_for(tmp_path: Path) -> None:
    _, folder = written_work(tmp_path)
    assert cv2.imread(str(folder / "maps" / "empty.png"), cv2.IMREAD_GRAYSCALE).shape == (8, 8)


@pytest.mark.parametrize("name", ["front.left", "CAM_BACK", "Räder vorn"])
def test_channels_have_names_as_those_of_nuscenes(name: str) -> None:
    assert channel_name(name, "") in {"CAM_FRONT_LEFT", "CAM_BACK", "CAM_R_DER_VORN"}
