"""Pinhole images of cameras of all kinds: what they show, where points are in them, and their files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest

from mrasfm_engine.errors import InputError
from mrasfm_engine.export import run_export as exports
from mrasfm_engine.export.contract import ExportOptions, ExportWork
from mrasfm_engine.export.formats import WRITERS
from mrasfm_engine.export.pinhole_views import pinhole_views
from mrasfm_engine.export.run_export import ExportRequest, run_export
from mrasfm_engine.export.scene import write_scene
from mrasfm_engine.export.stored_scene import read_source
from mrasfm_engine.export.undistorted import reprojection_errors_px
from mrasfm_engine.preflight.drive_reader import write_manifest
from tests.helpers import splatting_rule
from tests.helpers.export_example import make_scene
from tests.helpers.export_images import FISHEYES, HEIGHT, USUAL, WIDTH, camera_of, seen_along, written

FORMATS = ("colmap", "nerfstudio")


def exported(tmp_path: Path, *formats: str, **options: int) -> dict[str, Any]:
    request = ExportRequest(
        folder=tmp_path / "scene",
        out=tmp_path / "out",
        formats=formats,
        options=ExportOptions(**options),
        drives={"": tmp_path / "drive"},
        threads=1,
    )
    return run_export(request, progress=lambda *_: None, cancel=lambda: False)


@pytest.mark.parametrize("models", [USUAL, FISHEYES], ids=["usual", "fisheyes"])
def test_pinhole_images_show_the_rays_of_their_pixels(models: dict[str, list[float]], tmp_path: Path) -> None:
    """Pixels are compared with the world along the rays of a pinhole, and observations with COLMAP's projection."""
    scene = written(tmp_path, models)
    report = exported(tmp_path, "colmap")
    assert "withheld" not in report["formats"]["colmap"]
    workspace = tmp_path / "out" / "colmap"
    model = pycolmap.Reconstruction(str(workspace / "sparse" / "0"))
    views = 1 if models is USUAL else 2
    assert len(model.cameras) == 2 * views
    assert len(model.images) == int(scene.image_registered.sum()) * views
    errors, rig_from_cam = [], {}
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        assert camera.model.name == "PINHOLE"
        fx, fy, cx, cy = camera.params
        assert (cx, cy) == (camera.width / 2, camera.height / 2)  # 3DGS takes it for granted
        pixels = cv2.imread(str(workspace / "images" / image.name))[..., ::-1]
        assert pixels.shape == (camera.height, camera.width, 3)
        mask = cv2.imread(str(workspace / "masks" / f"{image.name}.png"), cv2.IMREAD_GRAYSCALE)
        shown = np.ones(pixels.shape[:2], bool) if mask is None else mask == 255
        assert shown.mean() > 0.6
        v, u = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
        rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], -1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        name = image.name.split(".")[0]
        k = [c.name for c in scene.drive.cameras].index(name)
        rig = model.rigs[model.frames[image.frame_id].rig_id]
        cam_from_rig = rig.sensor_from_rig(camera.sensor_id).matrix()
        rig_from_cam[image.camera_id] = cam_from_rig
        # Of the camera's axes from the view's: both are on the rig.
        turn = scene.calibration[k].rig_from_cam[:3, :3].T @ cam_from_rig[:, :3].T
        expected = seen_along(rays @ turn.T)
        assert np.abs(pixels - expected)[shown].max() < 4.0
        for point2d in image.points2D:
            projected = image.project_point(model.points3D[point2d.point3D_id].xyz)
            errors.append(np.linalg.norm(projected - point2d.xy))
    own = np.median(reprojection_errors_px(read_source(tmp_path / "scene").scene))
    # Keypoints are stored with 32 bits: that is all of the example's error.
    assert 0 < np.median(errors) < 1.1 * own + 3e-5
    shown_points = len(model.points3D) / len(scene.points_m)
    assert 0.9 < shown_points <= 1.0


@pytest.mark.slow
@pytest.mark.parametrize("models", [USUAL, FISHEYES], ids=["usual", "fisheyes"])
def test_by_the_rule_of_3dgs_points_are_as_near_as_in_the_scene(models: dict[str, list[float]], tmp_path: Path) -> None:
    """Keypoints are half a pixel off, as real ones: a principal point or a pixel's centre that is off would show."""
    scene, rng = written(tmp_path, models), np.random.default_rng(8)
    features = [
        replace(f, xy_px=(f.xy_px + rng.normal(0, 0.4, f.xy_px.shape)).astype(np.float32)) for f in scene.features
    ]
    write_scene(replace(scene, features=features), tmp_path / "scene", {})
    exported(tmp_path, "colmap")
    images, points = splatting_rule.load(tmp_path / "out" / "colmap")
    errors = splatting_rule.errors_px(images, points)
    own = float(np.median(reprojection_errors_px(read_source(tmp_path / "scene").scene)))
    assert len(images) == int(scene.image_registered.sum()) * (1 if models is USUAL else 2)
    assert len(errors) > 0.9 * len(scene.observation_point)
    assert 0.3 < np.median(errors) <= 1.1 * own < 0.6
    moved = [image._replace(xy_px=image.xy_px + 0.5) for image in images]
    assert np.median(splatting_rule.errors_px(moved, points)) > 1.3 * own


def test_views_of_a_usual_camera_lose_little_and_have_no_blank_pixels() -> None:
    for model, params in USUAL.items():
        camera = camera_of(model, params)
        (view,) = pinhole_views(camera, np.array(params), None)
        assert view.lookup(camera, np.array(params))[1].all()
        assert 0.9 * WIDTH * HEIGHT < view.width * view.height <= 1.02 * WIDTH * HEIGHT
        (small,) = pinhole_views(camera, np.array(params), 320)
        assert max(small.width, small.height) == 320
        assert small.params[0] / view.params[0] == pytest.approx(320 / view.width, rel=1e-9)


def test_a_principal_point_far_from_the_middle_keeps_the_image_with_blank_pixels() -> None:
    params = np.array([700.0, 700.0, 480.0, 60.0])  # the sky was cut off
    camera = camera_of("PINHOLE", params)
    (view,) = pinhole_views(camera, params, None)
    inside = view.lookup(camera, params)[1]
    assert view.height == 2 * 540
    assert inside.mean() == pytest.approx(HEIGHT / view.height, abs=0.01)


def test_two_views_of_a_fisheye_show_all_of_its_width() -> None:
    for model, params in FISHEYES.items():
        camera = camera_of(model, params)
        left, right = pinhole_views(camera, np.array(params), None)
        assert (left.side, right.side) == ("left", "right")
        for turn, views in ((-80, [left]), (80, [right]), (-20, [left]), (20, [right]), (2, [left, right])):
            ray = np.array([[np.sin(np.radians(turn)), 0.1, np.cos(np.radians(turn))]])
            assert [v for v in (left, right) if v.pixels(ray)[1][0]] == views, turn
        assert left.cam_from_view[0, 2] < 0 < right.cam_from_view[0, 2]


def test_masks_leave_out_what_moves_the_own_car_and_blank_pixels(tmp_path: Path) -> None:
    scene = written(tmp_path, USUAL, masked=True, kind="jpg")
    car = np.zeros((HEIGHT, WIDTH), bool)
    car[560:] = True
    write_scene(replace(scene, own_cars=[car, None]), tmp_path / "scene", {})
    report = exported(tmp_path, *FORMATS)
    assert all("withheld" not in result for result in report["formats"].values())
    for form in FORMATS:
        masks = tmp_path / "out" / form / "masks"
        left, right = (cv2.imread(str(masks / f"{name}.000000.jpg.png"), 0) for name in ("left", "right"))
        assert len(list(masks.iterdir())) == len(list((masks.parent / "images").iterdir()))
        for mask, of_car in ((left, True), (right, False)):
            assert set(np.unique(mask).tolist()) == {0, 255}
            unused = mask == 0
            assert 85 <= unused[100].sum() <= 115
            assert unused[100].nonzero()[0].mean() == pytest.approx(550 - (WIDTH - mask.shape[1]) / 2, abs=15)
            assert unused[-5].all() == of_car


def test_masks_that_are_not_kept_are_said(tmp_path: Path) -> None:
    scene = written(tmp_path, USUAL)
    stages = [{"stage": "features", "images_with_mask": {"given": 0, "made_by_model": 7}}]
    write_scene(scene, tmp_path / "scene", {"stages": stages})
    notes = exported(tmp_path, "colmap", image_size_px=64)["formats"]["colmap"]["notes"]
    assert [note for note in notes if "no mask has the moving objects of 7 images" in note]
    write_scene(scene, tmp_path / "scene", {"stages": [{"stage": "features"}]})
    notes = exported(tmp_path, "colmap", image_size_px=64)["formats"]["colmap"]["notes"]
    assert [note for note in notes if "no mask" in note] == []


def test_flipped_bits_withhold_the_format_and_name_the_file(tmp_path: Path) -> None:
    written(tmp_path, USUAL, masked=True)
    source = read_source(tmp_path / "scene")
    request = ExportRequest(folder=tmp_path, out=tmp_path, formats=FORMATS, drives={"": tmp_path / "drive"})
    source = replace(source, files=exports._drive_files(request, source))
    rng = np.random.default_rng(0)
    for form in FORMATS:
        folder = tmp_path / form
        folder.mkdir()
        result = WRITERS[form](
            ExportWork(source=source, options=ExportOptions(image_size_px=200), folder=folder, step=lambda *_: None)
        )
        assert exports._fault(result, folder) is None
        for path in sorted(p for p in folder.rglob("*") if p.is_file()):
            content = path.read_bytes()
            head = content.index(b"end_header") if path.suffix == ".ply" else 0
            for at in rng.integers(head, len(content), 12 if path.suffix in (".bin", ".ply") else 1).tolist():
                flipped = bytearray(content)
                flipped[at] ^= 0x01
                path.write_bytes(flipped)
                fault = exports._fault(result, folder)
                assert fault is not None, (path.name, at)
                assert path.parent.name in fault or path.name in fault
            path.write_bytes(content)
        assert exports._fault(result, folder) is None


def test_another_drive_is_refused_by_name(tmp_path: Path) -> None:
    written(tmp_path, USUAL)
    with pytest.raises(InputError, match="needs the images of the drive") as found:
        run_export(
            ExportRequest(folder=tmp_path / "scene", out=tmp_path / "out", formats=["colmap"], drives={}),
            progress=lambda *_: None,
            cancel=lambda: False,
        )
    assert found.value.code == "drive-needed"
    image = tmp_path / "drive" / "left" / "0.png"
    cv2.imwrite(str(image), np.zeros((10, 20), np.uint8))
    with pytest.raises(InputError, match=r"left/0.png has 20 x 10 pixels, camera left has 960 x 600"):
        exported(tmp_path, "colmap")
    image.unlink()
    with pytest.raises(InputError, match=r"left/0.png"):
        exported(tmp_path, "colmap")
    assert not (tmp_path / "out").exists()
    write_manifest(make_scene().drive.manifest, tmp_path / "drive")
    with pytest.raises(InputError, match=r"has no image left/0.png") as found:
        exported(tmp_path, "colmap")
    assert found.value.code == "other-drive"
