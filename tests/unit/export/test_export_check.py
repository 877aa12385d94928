from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mrasfm_engine.errors import MrasfmError
from mrasfm_engine.export import (
    calibration,
    colmap,
    comparisons,
    coordinate_frame,
    feature_database,
    ply,
    pose_files,
)
from mrasfm_engine.export import scene as scene_export
from mrasfm_engine.export.scene import write_scene
from mrasfm_engine.scene.scene import Scene
from tests.helpers.export_example import assert_nothing_published, make_scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene()


def moved(transforms: np.ndarray) -> np.ndarray:
    """One pose 5 micrometres off: above the tolerance, below what anybody would see."""
    out = transforms.copy()
    out[0, 0, 3] += 5e-6
    return out


def corrupt(monkeypatch: pytest.MonkeyPatch, module: Any, name: str, change: Any) -> None:
    original = getattr(module, name)
    monkeypatch.setattr(module, name, lambda *args: change(original, *args))


def shift_json(key: list[Any]) -> Any:
    def change(original: Any, scene: Scene, *args: Any) -> Any:
        document = original(scene, *args)
        place = document
        for part in key[:-1]:
            place = place[part]
        place[key[-1]] = place[key[-1]] + 5e-6
        return document

    return change


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-40])


def text_without_end(original: Any, binary: Path, folder: Path) -> Any:
    written = original(binary, folder)
    truncate(folder / "images.txt")
    return written


def with_moved_rig(original: Any, scene: Scene) -> Any:
    return original(replace(scene, world_from_rig=moved(scene.world_from_rig)))


def with_swapped_points(original: Any, scene: Scene, *args: Any) -> Any:
    return original(replace(scene, points_m=scene.points_m[::-1].copy()), *args)


def with_wrong_keypoint(original: Any, scene: Scene) -> Any:
    keypoints = scene.observation_keypoint.copy()
    keypoints[:2] = (
        keypoints[:2][::-1] if scene.observation_image[0] == scene.observation_image[1] else keypoints[:2] + 1
    )
    return original(replace(scene, observation_keypoint=keypoints))


def with_moved_camera(original: Any, scene: Scene) -> Any:
    first = scene.calibration[0]
    wrong = replace(first, rig_from_cam=moved(first.rig_from_cam[None])[0])
    return original(replace(scene, calibration=[wrong, *scene.calibration[1:]]))


def without_a_pair(original: Any, scene: Scene, path: Path) -> Any:
    return original(replace(scene, pairs=scene.pairs[:-1]), path)


def with_wrong_descriptor(original: Any, scene: Scene, path: Path) -> Any:
    first = scene.features[0]
    wrong = replace(first, descriptors=first.descriptors[::-1].copy())
    return original(replace(scene, features=[wrong, *scene.features[1:]]), path)


def ply_without_end(original: Any, scene: Scene, path: Path) -> Any:
    digest = original(scene, path)
    truncate(path)
    return digest


def tum_with_gap(original: Any, scene: Scene) -> str:
    return "\n".join(original(scene).splitlines()[:-1]) + "\n"


@pytest.mark.parametrize(
    ("module", "function", "change", "file"),
    [
        (colmap, "_frames", with_moved_rig, "model .*composed pose"),
        (colmap, "_images", with_moved_rig, "images.bin"),  # the stale pose that COLMAP overlooks
        (colmap, "_images", with_wrong_keypoint, "images"),
        (colmap, "_rigs", with_moved_camera, "model .*rigs: left's pose"),
        (
            colmap,
            "_cameras",
            lambda original, scene: original(scene)[:-8] + bytes(8),
            "model .*cameras: right's params",
        ),
        (colmap, "_points", with_swapped_points, "model .*points3D: a point"),
        (colmap, "_points", lambda original, scene: b"", "model .*points3D.bin is empty"),
        (scene_export, "write_text_model", text_without_end, "images.txt"),
        (ply, "write_ply", ply_without_end, "points.ply"),
        (ply, "write_ply", with_swapped_points, "points.ply"),
        (feature_database, "write_features", without_a_pair, "features.db"),
        (feature_database, "write_features", with_wrong_descriptor, "features.db"),
        (pose_files, "poses_text", with_moved_rig, "poses.tum"),
        (pose_files, "poses_text", tum_with_gap, "poses.tum"),
        (
            pose_files,
            "poses_document",
            shift_json(["images", 0, "world_from_cam", "translation_m", 2]),
            "poses.json",
        ),
        (pose_files, "poses_document", shift_json(["images", 0, "geodetic", "latitude_deg"]), "poses.json"),
        (
            calibration,
            "calibration_document",
            shift_json(["cameras", "left", "difference", "translation_m", 1]),
            "calibration.json",
        ),
        (coordinate_frame, "frame_document", shift_json(["origin", "longitude_deg"]), "frame.json"),
        (coordinate_frame, "frame_document", shift_json(["ecef_from_local", 0, 3]), "frame.json"),
    ],
)
def test_a_file_that_says_something_else_is_refused(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: Any, function: str, change: Any, file: str
) -> None:
    corrupt(monkeypatch, module, function, change)
    with pytest.raises(MrasfmError, match=file) as raised:
        write_scene(scene, tmp_path / "scene", {})
    assert raised.value.code == "export-check-failed"
    assert_nothing_published(tmp_path / "scene")


def test_a_file_that_no_check_covers_is_refused(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def with_another_file(original: Any, scene: Scene, path: Path) -> Any:
        path.with_name("added.json").write_text("{}")
        return original(scene, path)

    corrupt(monkeypatch, ply, "write_ply", with_another_file)
    with pytest.raises(MrasfmError, match=r"added.json .*no check covers it"):
        write_scene(scene, tmp_path / "scene", {})
    assert_nothing_published(tmp_path / "scene")


def test_cameras_whose_distance_changes_are_refused(scene: Scene) -> None:
    registered = [image for image, is_known in zip(scene.drive.images, scene.image_registered, strict=True) if is_known]
    rng = np.random.default_rng(0)
    rig = rng.normal(size=(len(scene.calibration), 3))
    of_unit = rng.normal(size=(len(scene.unit_registered), 3))
    centres = np.array([rig[image.camera] + of_unit[image.unit] for image in registered])
    (row,) = comparisons._baselines(scene, centres)
    assert row.agrees
    moved = next(n for n, image in enumerate(registered) if (image.unit, image.camera) == (2, 0))
    centres[moved] += 5e-6 * (rig[0] - rig[1]) / np.linalg.norm(rig[0] - rig[1])
    (row,) = comparisons._baselines(scene, centres)
    assert not row.agrees
    moving = replace(scene, unit_from_image=np.tile(np.eye(4), (len(scene.drive.images), 1, 1)))
    assert not list(comparisons._baselines(moving, centres))
    # Two vehicles are not one rig, however they move against each other.
    assert not list(comparisons._baselines(replace(scene, rig_of_camera=np.array([0, 1])), centres))
