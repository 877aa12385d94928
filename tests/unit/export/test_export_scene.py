from __future__ import annotations

import errno
import json
import resource
import shutil
import sqlite3
from collections import namedtuple
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest

from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import CancelledError, InputError, MrasfmError, StorageError
from mrasfm_engine.export import comparisons, feature_database, picture_files, ply, publishing, readers
from mrasfm_engine.export.calibration import calibration_document, document_in_map
from mrasfm_engine.export.colmap import approximations, colmap_models
from mrasfm_engine.export.feature_database import write_features, write_matches
from mrasfm_engine.export.pose_files import poses_document
from mrasfm_engine.export.publishing import only_run, require_free
from mrasfm_engine.export.scene import write_scene
from mrasfm_engine.geometry import geodesy, se3
from mrasfm_engine.io.images import read_image_rgb
from mrasfm_engine.io.read_scene import read_calibration, read_poses
from mrasfm_engine.pipeline import reconstruct
from mrasfm_engine.scene.drive import matrix_from_pose
from mrasfm_engine.scene.scene import CalibrationObservability, ImageFeatures, Scene
from schemas import Pose
from schemas.drive import MAX_IMAGE_SIDE_PX
from tests.helpers.export_example import (
    EXTRA_KEYPOINTS,
    FILES,
    FOREIGN_MODEL,
    MISSING_IMAGE,
    MISSING_UNIT,
    MODELS,
    POINTS,
    UNITS,
    assert_nothing_published,
    make_scene,
)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene()


@pytest.fixture(scope="module")
def written(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("export") / "deep" / "scene"
    write_scene(scene, out, {"stages": [{"stage": "mapping", "seconds": np.float64(1.5)}], "path": Path("a")})
    return out


def load(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


def test_the_folder_is_complete_and_alone(written: Path) -> None:
    assert {p.name for p in written.iterdir()} == FILES
    assert [p.name for p in written.parent.iterdir()] == ["scene"]
    assert written.stat().st_mode & 0o777 == written.parent.stat().st_mode & 0o777


@pytest.mark.parametrize("folder", ["model", "model/text"])
def test_colmap_reads_the_model_and_its_points_project_onto_their_keypoints(
    scene: Scene, written: Path, folder: str
) -> None:
    model = pycolmap.Reconstruction(str(written / folder))
    assert model.is_valid()
    assert model.num_reg_frames() == UNITS - 1
    assert sorted(model.images) == [i + 1 for i in np.flatnonzero(scene.image_registered)]
    assert sorted(model.frames) == [1, 3, 4, 5]
    errors = []
    for point in model.points3D.values():
        for element in point.track.elements:
            image = model.images[element.image_id]
            errors.append(np.linalg.norm(image.project_point(point.xyz) - image.points2D[element.point2D_idx].xy))
    assert len(errors) == len(scene.observation_point) == 7 * POINTS
    assert 0 < max(errors) < 1e-3  # the keypoints are float32
    model.update_point_3d_errors()
    assert 0 < model.compute_mean_reprojection_error() < 1e-4


def test_a_camera_that_colmap_does_not_have_is_written_as_its_nearest_model(tmp_path: Path) -> None:
    scene = make_scene(models={"PINHOLE": MODELS["PINHOLE"], **FOREIGN_MODEL})
    write_scene(scene, tmp_path / "scene", {})
    (finding,) = approximations(scene)
    off_px = colmap_models(scene)[1].error_px
    assert finding.code == "colmap-model-approximate"
    assert "camera right as OPENCV_FISHEYE" in finding.what
    assert f"{off_px:.2g} px" in finding.what
    assert 0.0 < off_px < 2.0
    model = pycolmap.Reconstruction(str(tmp_path / "scene" / "model"))
    assert [model.cameras[k].model.name for k in (1, 2)] == ["PINHOLE", "OPENCV_FISHEYE"]
    errors_px = []
    for image in model.images.values():
        if image.camera_id == 2:
            seen = [(point.xy, model.points3D[point.point3D_id].xyz) for point in image.points2D if point.has_point3D()]
            errors_px += [np.linalg.norm(image.project_point(xyz) - xy) for xy, xyz in seen]
    assert len(errors_px) > 50
    assert 0.0 < max(errors_px) < off_px + 1e-3  # keypoints are floats
    calibration = json.loads((tmp_path / "scene" / "calibration.json").read_text())
    assert calibration["cameras"]["right"]["model"] == "MEI"
    assert calibration["cameras"]["right"]["param_names"][-1] == "xi"


def test_images_that_are_not_simultaneous_are_frames_of_their_own(tmp_path: Path) -> None:
    scene = make_scene(moving=True)
    write_scene(scene, tmp_path / "out", {})
    model = pycolmap.Reconstruction(str(tmp_path / "out" / "model"))
    registered = (np.flatnonzero(scene.image_registered) + 1).tolist()
    assert sorted(model.frames) == registered
    errors = [
        np.linalg.norm(
            model.images[e.image_id].project_point(p.xyz) - model.images[e.image_id].points2D[e.point2D_idx].xy
        )
        for p in model.points3D.values()
        for e in p.track.elements
        for image in [model.images[e.image_id]]
    ]
    assert 0 < max(errors) < 1e-3
    poses = read_poses(tmp_path / "out")
    np.testing.assert_allclose(poses.trajectory.world_from_rig, scene.world_from_rig[scene.unit_registered], atol=1e-9)
    for i, image in enumerate(scene.drive.images):
        if scene.image_registered[i]:
            np.testing.assert_allclose(poses.world_from_cam[image.file], scene.world_from_cam[i], atol=1e-9)
            pose = model.images[i + 1].cam_from_world().inverse().matrix()
            np.testing.assert_allclose(pose, scene.world_from_cam[i][:3], atol=1e-9)
    apart = scene.world_from_cam[0][:3, 3] - (scene.world_from_rig[0] @ scene.calibration[0].rig_from_cam)[:3, 3]
    assert 0.05 < np.linalg.norm(apart) < 2.0
    document = json.loads((tmp_path / "out" / "poses.json").read_text())
    assert "at its own" in document["pose_time"]
    database = pycolmap.Database.open(str(tmp_path / "out" / "features.db"))
    assert [image.frame_id for image in database.read_all_images()] == list(range(1, 2 * UNITS + 1))
    database.close()


def test_the_rig_is_the_vehicle(scene: Scene, written: Path) -> None:
    model = pycolmap.Reconstruction(str(written / "model"))
    rig = model.rigs[1]
    assert rig.ref_sensor_id.type == pycolmap.SensorType.IMU
    for k, camera in enumerate(scene.calibration):
        pose = rig.sensor_from_rig(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, k + 1)).inverse().matrix()
        np.testing.assert_allclose(pose, camera.rig_from_cam[:3], atol=1e-12)
    pose = model.frames[3].rig_from_world.inverse().matrix()
    np.testing.assert_allclose(pose, scene.world_from_rig[2][:3], atol=1e-12)
    assert model.images[6].name == "images/right/002.png"
    assert model.images[6].num_points2D() == POINTS + EXTRA_KEYPOINTS


def test_the_database_has_the_models_ids_and_all_features(scene: Scene, written: Path, tmp_path: Path) -> None:
    # A copy, because COLMAP turns write-ahead mode on in what it opens.
    database = pycolmap.Database.open(str(shutil.copy(written / "features.db", tmp_path)))
    images = database.read_all_images()
    model = pycolmap.Reconstruction(str(written / "model"))
    assert [i.image_id for i in images] == list(range(1, 2 * UNITS + 1))
    for image in images:
        source = scene.drive.images[image.image_id - 1]
        assert (image.name, image.camera_id, image.frame_id) == (source.file, source.camera + 1, source.unit + 1)
        if image.image_id in model.images:
            assert model.images[image.image_id].name == image.name
            assert model.images[image.image_id].frame_id == image.frame_id
        features = scene.features[image.image_id - 1]
        np.testing.assert_array_equal(database.read_keypoints(image.image_id), features.xy_px)
        descriptors = database.read_descriptors(image.image_id)
        np.testing.assert_array_equal(descriptors.data, features.descriptors)
        assert descriptors.type == pycolmap.FeatureExtractorType.SIFT
    assert database.num_matched_image_pairs() == len(scene.pairs)
    assert database.num_verified_image_pairs() == len(scene.pairs) - 1
    pair = scene.pairs[1]
    np.testing.assert_array_equal(database.read_matches(1, 5), pair.matches)
    verified = database.read_two_view_geometry(1, 5)
    np.testing.assert_array_equal(verified.inlier_matches, pair.matches[pair.inliers])
    np.testing.assert_array_equal(database.read_camera(2).params, scene.calibration[1].params)
    database.close()


def test_float_descriptors_are_kept_bit_for_bit(scene: Scene, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    numbers = [rng.normal(size=(len(f.xy_px), 64)).astype(np.float32) for f in scene.features]
    numbers[3] = numbers[3][:0]
    features = [
        replace(f, descriptors=d, xy_px=f.xy_px[: len(d)], colors=f.colors[: len(d)])
        for f, d in zip(scene.features, numbers, strict=True)
    ]
    path = tmp_path / "features.db"
    learned = replace(scene, features=features)
    write_features(learned, path)
    assert all(row.agrees for row in comparisons.features(learned, readers.database(path)))
    database = pycolmap.Database.open(str(path))
    read = [database.read_descriptors(i + 1) for i in range(len(numbers))]
    database.close()
    assert all(d.type == pycolmap.FeatureExtractorType.UNDEFINED for d in read)
    np.testing.assert_array_equal(read[0].data.view(np.float32), numbers[0])


def test_matches_alone_have_the_given_calibration_and_units_as_frames(scene: Scene, tmp_path: Path) -> None:
    path = tmp_path / "matches.db"
    write_matches(scene.drive, scene.features, scene.pairs, path)
    with closing(pycolmap.Database.open(str(path))) as database:
        images = scene.drive.images
        assert database.num_images() == len(images)
        assert database.num_descriptors() == 0
        assert [f.frame_id for f in database.read_all_frames()] == sorted({image.unit + 1 for image in images})
        np.testing.assert_array_equal(database.read_keypoints(1), scene.features[0].xy_px)
        np.testing.assert_array_equal(database.read_camera(1).params, scene.drive.cameras[0].params)
        (rig,) = database.read_all_rigs()
        given = [rig.sensor_from_rig(s).inverse().matrix() for s in sorted(rig.non_ref_sensors, key=lambda s: s.id)]
        np.testing.assert_allclose(given, scene.drive.rig_from_cam[:, :3], atol=1e-12)
        pair = scene.pairs[0]
        verified = database.read_two_view_geometry(pair.image_a + 1, pair.image_b + 1)
        np.testing.assert_array_equal(verified.inlier_matches, pair.matches[pair.inliers])


def test_the_database_is_one_file_that_a_read_only_folder_can_hold(written: Path) -> None:
    with closing(sqlite3.connect(f"file:{written / 'features.db'}?mode=ro", uri=True)) as db:
        assert db.execute("PRAGMA journal_mode").fetchone() == ("delete",)


def test_ply(scene: Scene, written: Path) -> None:
    head, _, body = (written / "points.ply").read_bytes().partition(b"end_header\n")
    assert b"property float x" in head
    assert f"element vertex {POINTS}\n".encode() in head
    assert len(body) == POINTS * (3 * 4 + 3 + 4 + 4 + 1 + 4 + 4)
    np.testing.assert_allclose(np.frombuffer(body[:12], "<f4"), scene.points_m[0], rtol=1e-6)
    assert tuple(body[12:15]) == tuple(scene.point_colors[0])
    assert np.frombuffer(body[15:19], "<i4") == 7


def test_ply_far_from_the_origin_is_double(scene: Scene, tmp_path: Path) -> None:
    ply.write_ply(replace(scene, points_m=scene.points_m + 50_000.0), tmp_path / "points.ply")
    assert b"property double x" in (tmp_path / "points.ply").read_bytes()


def test_poses_are_read_back(scene: Scene, written: Path) -> None:
    poses = read_poses(written)
    np.testing.assert_array_equal(poses.trajectory.timestamps_us, scene.drive.timestamps_us[scene.unit_registered])
    np.testing.assert_allclose(poses.trajectory.world_from_rig, scene.world_from_rig[scene.unit_registered], atol=1e-8)
    assert (poses.total_units, poses.registered_images, poses.total_images) == (5, 7, 10)
    expected = scene.world_from_rig[2] @ scene.calibration[1].rig_from_cam
    np.testing.assert_allclose(poses.world_from_cam["images/right/002.png"], expected, atol=1e-9)


def test_what_is_not_registered_has_no_pose(written: Path) -> None:
    poses = load(written / "poses.json")
    assert poses["units"][MISSING_UNIT].keys() == {"timestamp_us", "source_frame", "registered"}
    assert poses["images"][MISSING_IMAGE]["registered"] is False
    assert "world_from_cam" not in poses["images"][MISSING_IMAGE]
    assert poses["units"][3]["source_frame"] == 30
    assert poses["units"][3]["sigma_position_m"] == [0.01, 0.01, 0.03]


def test_geodetic_positions_lie_where_the_local_ones_do(scene: Scene, written: Path) -> None:
    image = load(written / "poses.json")["images"][0]
    place = [image["geodetic"][k] for k in ("latitude_deg", "longitude_deg", "ellipsoidal_height_m")]
    assert scene.georeference is not None
    local = geodesy.local_from_geodetic(place, scene.georeference.ecef_from_local)
    np.testing.assert_allclose(local, image["world_from_cam"]["translation_m"], atol=1e-5)


def test_frame_of_a_georeferenced_scene(written: Path) -> None:
    frame = load(written / "frame.json")
    assert frame["georeferenced"] is True
    assert frame["world_crs"] == "EPSG:4978"
    assert frame["world_crs_wkt2"].startswith("GEODCRS")
    assert frame["height_datum"] == "EPSG:5773"
    np.testing.assert_array_equal(frame["ecef_from_local"], geodesy.ecef_from_local([48.1, 11.5, 520.0]))


def test_without_georeference_geodetic_fields_are_absent(tmp_path: Path) -> None:
    write_scene(make_scene(georeferenced=False), tmp_path / "scene", {})
    frame, poses = load(tmp_path / "scene" / "frame.json"), load(tmp_path / "scene" / "poses.json")
    assert frame["georeferenced"] is False
    assert not {"world_crs", "world_crs_wkt2", "height_datum", "origin", "ecef_from_local"} & frame.keys()
    assert np.array(frame["rough_world_from_local"])[:3, 3].tolist() == [100.0, 200.0, 3.0]
    assert not any("geodetic" in entry for entry in poses["units"] + poses["images"])


def test_calibration(scene: Scene, written: Path) -> None:
    left = load(written / "calibration.json")["cameras"]["left"]
    np.testing.assert_allclose(left["difference"]["rotation_vector_deg"], [0.1, -0.2, 0.3], atol=1e-9)
    np.testing.assert_allclose(left["difference"]["translation_m"], [0.01, -0.02, 0.03], atol=1e-12)
    assert left["difference"]["focal_px"] == pytest.approx(2.0)
    assert left["sigma"] == {"rotation_deg": [0.1, 0.2, 0.3], "focal_px": 1.5}
    assert left["repeatability"] == {"rotation_deg": [0.01, 0.02, 0.03]}
    assert left["observed"] == {"rotation": [True] * 3, "translation": [False, True, False]}
    assert left["verdict"]["translation"] == ["only the prior", "observed", "only the prior"]
    assert left["wrong"] is False
    read = read_calibration(written / "calibration.json")
    np.testing.assert_allclose(read["right"], scene.calibration[1].rig_from_cam, atol=1e-12)


def test_a_time_offset_is_told_where_it_was_estimated(scene: Scene) -> None:
    late = replace(scene.calibration[0], time_offset_s=0.004, sigma_time_offset_s=0.0005, time_offset_observed=True)
    cameras = calibration_document(replace(scene, calibration=[late, *scene.calibration[1:]]))["cameras"]
    first, second = (cameras[camera.name] for camera in scene.drive.cameras[:2])
    assert first["refined"]["time_offset_us"] == pytest.approx(4000.0)
    assert first["sigma"]["time_offset_us"] == pytest.approx(500.0)
    assert first["observed"]["time_offset"] is True
    assert first["verdict"]["time_offset"] == "observed"
    assert "time_offset_us" not in second["refined"]


def test_a_focal_length_has_a_verdict_where_intrinsics_were_asked_for(scene: Scene) -> None:
    asked = [replace(scene.calibration[0], focal_observed=True), replace(scene.calibration[1], focal_observed=False)]
    for calibration, words in ((asked, ["observed", "held"]), (scene.calibration, [None, None])):
        cameras = calibration_document(replace(scene, calibration=calibration))["cameras"]
        assert [cameras[camera.name]["verdict"].get("focal") for camera in scene.drive.cameras[:2]] == words


def test_what_all_cameras_share_is_never_called_observed(scene: Scene) -> None:
    observability = CalibrationObservability(
        adjusted=True, reason="GNSS", scale_observed=True, scale_rests_on="observed by positions", sigma_scale=0.004
    )
    common = calibration_document(replace(scene, calibration_observability=observability))["common"]
    assert common["rotation"]["observed"] == common["translation"]["observed"] == [False] * 3
    assert common["scale"] == {"observed": True, "sigma_relative": 0.004, "verdict": "observed by positions"}
    unknown = replace(observability, scale_observed=False, sigma_scale=float("nan"), scale_rests_on="what was given")
    common = calibration_document(replace(scene, calibration_observability=unknown))["common"]
    assert common["scale"] == {"observed": False, "verdict": "what was given"}


def test_report(written: Path) -> None:
    report = load(written / "report.json")
    assert report["stages"] == [{"stage": "mapping", "seconds": 1.5}]
    assert report["summary"]["registered_images"] == 7
    assert report["summary"]["mean_track_length"] == 7
    assert report["summary"]["notes"] == ["an example"]


def test_image_names_with_spaces_withhold_the_text_model(tmp_path: Path) -> None:
    write_scene(make_scene(folder="my images"), tmp_path / "scene", {})
    model = pycolmap.Reconstruction(str(tmp_path / "scene" / "model"))
    assert model.images[1].name == "my images/left/000.png"
    assert not (tmp_path / "scene" / "model" / "text").exists()
    assert "text is withheld" in load(tmp_path / "scene" / "report.json")["summary"]["notes"][-1]


def test_images_without_keypoints_and_scenes_without_points(scene: Scene, tmp_path: Path) -> None:
    nothing = np.zeros(0, dtype=np.int64)
    empty = ImageFeatures(
        xy_px=np.zeros((0, 2), np.float32), descriptors=np.zeros((0, 128), np.uint8), colors=np.zeros((0, 3), np.uint8)
    )
    bare = replace(
        scene,
        features=[empty] * len(scene.features),
        pairs=[],
        points_m=np.zeros((0, 3)),
        point_colors=np.zeros((0, 3), np.uint8),
        point_error_px=np.zeros(0),
        point_classes=np.zeros(0, np.uint8),
        point_patches=np.zeros(0, np.int32),
        observation_point=nothing,
        observation_image=nothing,
        observation_keypoint=nothing,
    )
    write_scene(bare, tmp_path / "scene", {})
    assert pycolmap.Reconstruction(str(tmp_path / "scene" / "model")).num_reg_images() == 7


def test_a_report_that_is_not_finite_is_refused(scene: Scene, tmp_path: Path) -> None:
    with pytest.raises(MrasfmError, match=r"report\.json"):
        write_scene(scene, tmp_path / "scene", {"figure": float("nan")})
    assert_nothing_published(tmp_path / "scene")


def test_components_are_scenes_inside_the_scene(scene: Scene, tmp_path: Path) -> None:
    out, other = tmp_path / "scene", make_scene(georeferenced=False)
    missing = int(np.flatnonzero(~scene.unit_registered)[0])
    seen = np.arange(len(scene.unit_registered)) == missing
    write_scene(scene, out, {"run": 1}, components=[(other, {"component": 1})])
    assert load(out / "components" / "1" / "report.json")["component"] == 1
    assert {p.name for p in (out / "components" / "1").iterdir()} == FILES - {"autoware"}  # of no place
    assert pycolmap.Reconstruction(str(out / "components" / "1" / "model")).is_valid()
    document = poses_document(scene, [seen])
    assert [unit.get("component") for unit in document["units"]] == [1 if one else None for one in seen]
    write_scene(scene, out, {"run": 2})
    assert {p.name for p in out.iterdir()} == FILES  # what an earlier run left is gone


def test_writing_again_replaces_the_scene_and_keeps_other_files(scene: Scene, tmp_path: Path) -> None:
    out = tmp_path / "scene"
    write_scene(scene, out, {"run": 1})
    (out / "notes.txt").write_text("mine")
    (out / "model" / "stale.bin").write_text("old")
    write_scene(scene, out, {"run": 2})
    assert load(out / "report.json")["run"] == 2
    assert {p.name for p in out.iterdir()} == FILES | {"notes.txt"}
    assert not (out / "model" / "stale.bin").exists()


@pytest.mark.parametrize("exception", [KeyboardInterrupt, OSError(errno.ENOSPC, "No space left on device")])
def test_an_interrupted_run_leaves_the_old_scene(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exception: Any
) -> None:
    out = tmp_path / "scene"
    write_scene(scene, out, {"run": 1})
    before = {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}

    def stop(*_: Any) -> None:
        raise exception

    monkeypatch.setattr(feature_database, "write_features", stop)
    expected = StorageError if isinstance(exception, OSError) else KeyboardInterrupt
    with pytest.raises(expected):
        write_scene(scene, out, {"run": 2})
    assert {p: p.read_bytes() for p in out.rglob("*") if p.is_file()} == before


def test_a_run_that_fails_while_files_move_leaves_the_scene_that_was_there(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "scene"
    write_scene(scene, out, {"run": 1})
    original = Path.rename

    def stop_at_ply(self: Path, target: Any) -> Path:
        if self.name == "points.ply" and Path(target).parent == out:
            raise KeyboardInterrupt
        return original(self, target)

    before = {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}
    monkeypatch.setattr(Path, "rename", stop_at_ply)
    with pytest.raises(KeyboardInterrupt):
        write_scene(scene, out, {"run": 2})
    assert {p: p.read_bytes() for p in out.rglob("*") if p.is_file()} == before


def test_leftovers_of_killed_runs_are_cleared(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / ".scene.partial-1-00").mkdir()
    monkeypatch.setattr(publishing, "LEFTOVER_AGE_S", -1.0)
    write_scene(scene, tmp_path / "scene", {})
    assert [p.name for p in tmp_path.iterdir()] == ["scene"]


def test_too_little_disk_is_said_before_anything_is_written(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(1, 1, 1000))
    with pytest.raises(StorageError, match=r"scene needs about .* MB free\n  Free space"):
        write_scene(scene, tmp_path / "scene", {})
    assert_nothing_published(tmp_path / "scene")


@pytest.mark.parametrize("limit", [2_000, 6_000, 20_000, 60_000])
def test_files_that_cannot_grow_are_a_storage_error(scene: Scene, tmp_path: Path, limit: int) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        with pytest.raises(MrasfmError) as raised:
            write_scene(scene, tmp_path / "scene", {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    # COLMAP's text writer is silent when the disk is full: there the re-reading finds it and names the file.
    assert isinstance(raised.value, StorageError) or "disk is not full" in raised.value.remedy
    assert_nothing_published(tmp_path / "scene")


def test_a_folder_that_cannot_be_made_is_a_storage_error(scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "scene"):
        with pytest.raises(StorageError, match=f"{out} cannot be written"):
            write_scene(scene, out, {})


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("sigma_position_m", lambda s: s.sigma_position_m[:, :1], "sizes do not fit"),
        ("points_m", lambda s: np.full_like(s.points_m, np.nan), "a point is not finite"),
        ("world_from_rig", lambda s: np.full_like(s.world_from_rig, np.nan), "pose is not finite"),
        ("observation_keypoint", lambda s: s.observation_keypoint + 500, "names no keypoint"),
        ("observation_keypoint", lambda s: s.observation_keypoint * 0, "observes two points"),
        ("observation_image", lambda s: s.observation_image + 1, "image is not registered"),
        ("observation_point", lambda s: s.observation_point[::-1], "not sorted"),
        ("image_registered", lambda s: np.ones_like(s.image_registered), "without its unit"),
        ("features", lambda s: s.features[1:], "features for every image"),
    ],
)
def test_a_scene_that_contradicts_itself_is_refused(
    scene: Scene, tmp_path: Path, field: str, value: Any, message: str
) -> None:
    with pytest.raises(MrasfmError, match=message):
        write_scene(replace(scene, **{field: value(scene)}), tmp_path / "scene", {})
    assert_nothing_published(tmp_path / "scene")


def test_pictures_are_part_of_the_scene(scene: Scene, tmp_path: Path) -> None:
    out = tmp_path / "scene"
    picture = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    write_scene(scene, out, {}, lambda: {"a.png": picture_files.png_of(picture)})
    assert {p.name for p in out.iterdir()} == {*FILES, "pictures"}
    np.testing.assert_array_equal(read_image_rgb(out / "pictures" / "a.png"), picture)
    write_scene(scene, out, {}, lambda: {"b.png": picture_files.png_of(picture[:20])})
    assert [p.name for p in (out / "pictures").iterdir()] == ["b.png"]
    write_scene(scene, out, {})
    assert {p.name for p in out.iterdir()} == FILES  # old pictures would show another scene


def test_drawing_adds_to_the_report_and_ends_a_run_with_nothing_published(scene: Scene, tmp_path: Path) -> None:
    report: dict[str, Any] = {"stages": ["mapping"]}

    def draw() -> dict[str, bytes]:
        report["stages"].append("pictures")
        return {}

    write_scene(scene, tmp_path / "scene", report, draw)
    assert json.loads((tmp_path / "scene" / "report.json").read_text())["stages"] == ["mapping", "pictures"]

    def stop() -> dict[str, bytes]:
        raise CancelledError

    with pytest.raises(CancelledError):
        write_scene(scene, tmp_path / "other", report, stop)
    assert_nothing_published(tmp_path / "other")


def test_a_picture_that_does_not_read_back_is_withheld(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_bytes = Path.write_bytes
    monkeypatch.setattr(
        Path, "write_bytes", lambda path, data: write_bytes(path, data[: len(data) - (path.suffix == ".png")])
    )
    with pytest.raises(MrasfmError, match=r"a.png was written but does not read back"):
        write_scene(
            scene, tmp_path / "scene", {}, lambda: {"a.png": picture_files.png_of(np.ones((2, 2, 3), np.uint8))}
        )
    assert_nothing_published(tmp_path / "scene")


def test_our_own_pictures_may_be_longer_than_camera_images() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (3, MAX_IMAGE_SIDE_PX + 1, 3), dtype=np.uint8)
    data = np.frombuffer(picture_files.png_of(picture), np.uint8)
    np.testing.assert_array_equal(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1], picture)
    with pytest.raises(MrasfmError, match="cannot be made a PNG"):
        picture_files.png_of(picture[:0])


def test_a_calibration_that_was_adjusted_in_a_map(scene: Scene) -> None:
    document = calibration_document(scene)
    names = list(document["cameras"])
    poses = {name: refined.rig_from_cam.copy() for name, refined in zip(names, scene.calibration, strict=True)}
    found = {name: matrix_from_pose(Pose(**document["cameras"][name]["refined"]["rig_from_cam"])) for name in names}
    params = {name: np.array(document["cameras"][name]["refined"]["params"]) for name in names}

    def in_map(poses: dict[str, np.ndarray], params: dict[str, np.ndarray]) -> dict[str, Any]:
        return document_in_map(document, {name: (poses[name], params[name]) for name in names})

    assert in_map(found, params) == document
    turn = se3.exp_so3(np.radians([0.0, 0.3, 0.0]))
    poses[names[0]] = se3.transform(turn @ found[names[0]][:3, :3], found[names[0]][:3, 3] + [0.01, 0.0, 0.0])
    adjusted = in_map(found | {names[0]: poses[names[0]]}, params)
    assert {name for name in names if adjusted["cameras"][name] != document["cameras"][name]} == {names[0]}
    camera, before = adjusted["cameras"][names[0]], document["cameras"][names[0]]
    assert camera["since_scene"]["rotation_vector_deg"] == pytest.approx([0.0, 0.3, 0.0], abs=1e-9)
    assert camera["since_scene"]["translation_m"] == pytest.approx([0.01, 0.0, 0.0], abs=1e-12)
    new, given = (matrix_from_pose(Pose(**camera[key]["rig_from_cam"])) for key in ("refined", "given"))
    np.testing.assert_allclose(new, poses[names[0]], atol=1e-12)
    change = camera["difference"]
    turned = se3.exp_so3(np.radians(change["rotation_vector_deg"])) @ given[:3, :3]
    np.testing.assert_allclose(turned, new[:3, :3], atol=1e-9)
    np.testing.assert_allclose(given[:3, 3] + change["translation_m"], new[:3, 3], atol=1e-12)
    kept = ("sigma", "observed", "given", "verdict")
    assert {key: camera[key] for key in kept} == {key: before[key] for key in kept}
    assert change["focal_px"] == before["difference"]["focal_px"]
    assert camera["since_scene"]["focal_px"] == 0.0
    longer = np.array([3.0, 3.0, *np.zeros(len(params[names[1]]) - 2)])
    focal = in_map(found, params | {names[1]: params[names[1]] + longer})["cameras"][names[1]]
    assert focal["since_scene"]["focal_px"] == pytest.approx(3.0)
    assert focal["difference"]["focal_px"] == pytest.approx(document["cameras"][names[1]]["difference"]["focal_px"] + 3)
    assert focal["refined"]["params"] == pytest.approx((params[names[1]] + longer).tolist())
    assert focal["since_scene"]["rotation_deg"] == 0.0


def test_every_point_names_its_component(scene: Scene, tmp_path: Path) -> None:
    """Two units whose points no other one observes are a component of their own, in the same frame."""
    apart = np.array([0, 0, 0, 2, 2])
    unit = scene.image_unit[scene.observation_image]
    first_point_of_others = int(scene.observation_point[-1]) // 2
    kept = (scene.observation_point < first_point_of_others) == (apart[unit] == 0)
    split = replace(
        scene,
        unit_component=apart,
        observation_point=scene.observation_point[kept],
        observation_image=scene.observation_image[kept],
        observation_keypoint=scene.observation_keypoint[kept],
    )
    other = replace(scene, unit_component=np.where(scene.unit_registered, 1, 0))
    write_scene(split, tmp_path / "out", {}, components=[(other, {"component": 1})])
    expected = np.where(np.arange(POINTS) < first_point_of_others, 0, 2)
    rows = readers.ply(tmp_path / "out" / "points.ply")
    np.testing.assert_array_equal(rows["component"], expected)
    assert (readers.ply(tmp_path / "out" / "components" / "1" / "points.ply")["component"] == 1).all()
    listed = load(tmp_path / "out" / "report.json")["components"]
    assert [(one["component"], one["folder"], one["points"]) for one in listed] == [
        (0, ".", first_point_of_others),
        (1, "components/1", POINTS),
        (2, ".", POINTS - first_point_of_others),
    ]
    assert [one["registered_units"] for one in listed] == [2, UNITS - 1, 2]
    assert [unit.get("component") for unit in load(tmp_path / "out" / "poses.json")["units"]] == [1, None, 1, 1, 1]
    calibrations = [load(tmp_path / "out" / folder / "calibration.json") for folder in (".", "components/1")]
    assert "component" not in calibrations[0]
    assert (calibrations[1]["component"], calibrations[1]["from_component"]) == (1, 0)
    rows = rows.copy()
    rows["component"][0] += 1
    assert [row.agrees for row in comparisons.ply(split, rows) if row.what == "a component"] == [False]


@pytest.mark.parametrize("inside", [".", "scene", "some/scene"])
def test_a_file_is_no_folder_for_a_scene(tmp_path: Path, inside: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"/file is a file, and no folder for a scene") as found:
        reconstruct(tmp_path / "no drive", tmp_path / "file" / inside, EngineConfig())
    assert found.value.code == "bad-out-folder"
    (tmp_path / "nowhere").symlink_to(tmp_path / "gone")
    with pytest.raises(InputError, match=r"/nowhere is a file"):
        reconstruct(tmp_path / "no drive", tmp_path / "nowhere" / inside, EngineConfig())


def test_the_folder_of_a_drive_is_no_folder_for_a_scene(tmp_path: Path) -> None:
    """Also where a scene lies in it already: what belongs to which would be lost."""
    (tmp_path / "drive.json").touch()
    for _ in range(2):
        with pytest.raises(InputError, match=r"is the folder of a drive, whose files a scene would lie among") as found:
            reconstruct(tmp_path, tmp_path, EngineConfig())
        assert found.value.code == "bad-out-folder"
        (tmp_path / "report.json").touch()
    require_free(tmp_path / "scene", result="scene")


@pytest.mark.parametrize("name", ["pictures/mine.jpg", "notes.txt", "report.json"])
def test_a_folder_with_files_that_no_scene_has_made_is_refused(tmp_path: Path, name: str) -> None:
    """Somebody's own pictures, say, would be replaced; a scene's files are hard to tell from others."""
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text('{"version": 1, "formats": {}}')
    first = tmp_path / name.partition("/")[0]
    with pytest.raises(InputError, match=f"{first} was made by no scene") as found:
        reconstruct(tmp_path / "no drive", tmp_path, EngineConfig())
    assert found.value.code == "bad-out-folder"
    assert found.value.remedy == "Give the scene a new or empty folder with --out."
    require_free(tmp_path / "new", result="scene")
    (tmp_path / ".stages").mkdir()
    require_free(tmp_path, result="scene")  # of a run that was interrupted


def test_one_run_at_a_time_makes_a_result_in_a_folder(tmp_path: Path) -> None:
    out = tmp_path / "new" / "scene"
    with only_run(out):
        with pytest.raises(InputError, match=r"another run is making a result in .*scene") as found, only_run(out):
            pytest.fail("the folder is taken")
        (out / ".stages" / "features.npz").touch()
    assert found.value.code == "output-in-use"
    with only_run(out):
        (out / ".stages" / "features.npz").unlink()
    assert (out / ".stages").is_dir()  # it was there before
    with pytest.raises(CancelledError), only_run(tmp_path / "other" / "scene"):
        raise CancelledError
    assert [path.name for path in tmp_path.iterdir()] == ["new"]


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a folder that was deleted, and in /proc, making one fails as if another run had just removed it."""
    tried = 0

    def fails(self: Path, *_: object, **__: object) -> None:
        nonlocal tried
        tried += 1
        assert tried < 10_000, "it is tried for ever"
        raise FileNotFoundError(2, "No such file or directory", str(self))

    monkeypatch.setattr(Path, "mkdir", fails)
    with pytest.raises(StorageError, match="No such file or directory"), only_run(tmp_path / "scene"):
        pass


@pytest.mark.parametrize("report", ['{"summary": {"passed": 3}, "tests": []}', '{"summary": 3}', "[[]]", "[" * 100_000])
def test_a_report_of_another_program_is_spared(tmp_path: Path, report: str) -> None:
    (tmp_path / "report.json").write_text(report)
    with pytest.raises(InputError, match=r"report\.json was made by no scene"):
        require_free(tmp_path, result="scene")


def test_a_folder_of_ours_stays_free(scene: Scene, tmp_path: Path) -> None:
    """An empty one, one that only a file manager has opened, and a scene's, to which notes were added."""
    for name in (".DS_Store", "Thumbs.db", "desktop.ini"):
        (tmp_path / name).touch()
    require_free(tmp_path, result="scene")
    write_scene(scene, tmp_path / "scene", {})
    (tmp_path / "scene" / "notes.txt").touch()
    require_free(tmp_path / "scene", result="scene")
