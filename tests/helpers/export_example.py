"""A small scene whose every number is known, for the tests of what is written of it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from mrasfm_engine.geometry import geodesy, se3
from mrasfm_engine.geometry.camera_model import pack_camera, project_points
from mrasfm_engine.scene.drive import Drive, pose_from_matrix
from mrasfm_engine.scene.road import Road, RoadPoints, RoadSource, RoadSurface
from mrasfm_engine.scene.road_relief import Relief
from mrasfm_engine.scene.scene import CameraCalibration, Georeference, ImageFeatures, PairMatches, Scene
from mrasfm_engine.scene.semantics import ROAD
from schemas import Camera, DriveManifest, Frame, FrameImage, Rig

UNITS, POINTS, EXTRA_KEYPOINTS = 5, 50, 7
MISSING_UNIT, MISSING_IMAGE = 1, 9  # the second camera of the last unit
FILES = {
    "model",
    "points.ply",
    "points.copc.laz",
    "trajectory.gpkg",
    "view.json",
    "report.html",
    "rig",
    "autoware",
    "poses.tum",
    "poses.json",
    "calibration.json",
    "frame.json",
    "features.db",
    "manifest.json",
    "report.json",
}
# x right, y down, z forward of a camera that looks along the rig's x axis
RIG_FROM_FORWARD_CAM = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
MODELS = {"PINHOLE": [800.0, 810.0, 480.0, 300.0], "OPENCV": [700.0, 705.0, 470.0, 310.0, -0.05, 0.01, 1e-3, -5e-4]}


FOREIGN_MODEL = {"MEI": [1400.0, 1410.0, 470.0, 310.0, 0.01, 0.5, 1e-3, -5e-4, 1.1]}  # which COLMAP does not have


def make_scene(
    *,
    georeferenced: bool = True,
    folder: str = "images",
    moving: bool = False,
    models: Mapping[str, list[float]] = MODELS,
) -> Scene:
    """Two cameras, five units of which one is missing, and points projected exactly.

    `moving`: the images of a unit are not taken at one time.
    """
    rng = np.random.default_rng(3)
    given = [
        se3.transform(se3.exp_so3([0, 0, yaw]) @ RIG_FROM_FORWARD_CAM, [1.5, y, 1.6])
        for yaw, y in ((0.1, 0.5), (-0.1, -0.5))
    ]
    cameras = [
        Camera(name=name, model=model, width=960, height=600, params=models[model], rig_from_cam=pose_from_matrix(pose))
        for name, model, pose in zip(("left", "right"), models, given, strict=True)
    ]
    frames = [
        Frame(
            timestamp_us=1_600_000_000_000_001 + 500_000 * u,
            source_frame=10 * u,
            images={c.name: FrameImage(file=f"{folder}/{c.name}/{u:03d}.png") for c in cameras},
        )
        for u in range(UNITS)
    ]
    drive = Drive(Path("nowhere"), DriveManifest(name="example", rig=Rig(cameras=cameras), frames=frames))
    change = se3.transform(se3.exp_so3(np.radians([0.1, -0.2, 0.3])), [0.01, -0.02, 0.03])
    calibration = [
        CameraCalibration(
            rig_from_cam=se3.transform(change[:3, :3] @ pose[:3, :3], pose[:3, 3] + change[:3, 3]),
            params=np.array(camera.params) + np.array([2.0, 2.0] + [0.0] * (len(camera.params) - 2)),
            sigma_rotation_deg=np.array([0.1, 0.2, 0.3]),
            sigma_translation_m=np.full(3, np.nan),
            repeatability_rotation_deg=np.array([0.01, 0.02, 0.03]),
            repeatability_translation_m=np.full(3, np.nan),
            sigma_focal_px=1.5,
            observed=np.array([True, True, True, False, True, False]),
        )
        for camera, pose in zip(cameras, given, strict=True)
    ]
    yaw = np.linspace(0.3, 0.5, UNITS)
    rotations = se3.exp_so3(np.column_stack([0.01 * yaw, -0.02 * yaw, yaw]))
    world_from_rig = se3.transform(
        rotations, np.column_stack([2.0 * np.arange(UNITS), 0.3 * np.arange(UNITS), 0.1 * yaw])
    )
    points = se3.apply(world_from_rig[2], rng.uniform([20, -5, -1], [40, 5, 6], (POINTS, 3)))
    world_from_rig[MISSING_UNIT] = np.nan
    unit_registered = np.arange(UNITS) != MISSING_UNIT
    image_registered = np.array([unit_registered[image.unit] for image in drive.images])
    image_registered[MISSING_IMAGE] = False
    features, rows = [], []
    steps = np.random.default_rng(4).normal(size=(len(drive.images), 6)) * [0.01, 0.01, 0.02, 0.4, 0.02, 0.02]
    unit_from_image = se3.exp_se3(steps if moving else 0 * steps)
    for i, image in enumerate(drive.images):
        xy = rng.uniform(0, 600, (POINTS + EXTRA_KEYPOINTS, 2))
        if image_registered[i]:
            places = rng.permutation(len(xy))[:POINTS]
            world_from_image = world_from_rig[image.unit] @ unit_from_image[i]
            cam_from_world = se3.inverse(world_from_image @ calibration[image.camera].rig_from_cam)
            lens = pack_camera(cameras[image.camera].model, calibration[image.camera].params)
            xy[places] = project_points(*lens, se3.apply(cam_from_world, points))
            rows += [(p, i, k) for p, k in enumerate(places)]
        features.append(
            ImageFeatures(
                xy_px=xy.astype(np.float32),
                descriptors=rng.integers(0, 256, (len(xy), 128), dtype=np.uint8),
                colors=np.zeros((len(xy), 3), np.uint8),
            )
        )
    observations = np.array(sorted(rows), dtype=np.int64)
    pairs = [
        PairMatches(
            image_a=a,
            image_b=b,
            matches=np.column_stack([rng.permutation(30), rng.permutation(30)]).astype(np.int32),
            inliers=np.arange(30) % 3 > 0 if b != 5 else np.zeros(30, dtype=bool),
        )
        for a, b in ((0, 1), (0, 4), (1, 5), (8, 9))
    ]
    place = [48.1, 11.5, 520.0]
    georeference = Georeference(
        origin_latitude_deg=place[0],
        origin_longitude_deg=place[1],
        origin_ellipsoidal_height_m=place[2],
        height_datum="EPSG:5773",
        ecef_from_local=geodesy.ecef_from_local(place),
    )
    return Scene(
        drive=drive,
        unit_registered=unit_registered,
        image_registered=image_registered,
        world_from_rig=world_from_rig,
        sigma_position_m=np.where(unit_registered[:, None], [0.01, 0.01, 0.03], np.nan),
        calibration=calibration,
        points_m=points,
        point_colors=rng.integers(0, 256, (POINTS, 3), dtype=np.uint8),
        point_error_px=np.full(POINTS, 0.25),
        observation_point=observations[:, 0],
        observation_image=observations[:, 1],
        observation_keypoint=observations[:, 2],
        features=features,
        pairs=pairs,
        georeference=georeference if georeferenced else None,
        rough_world_from_local=None if georeferenced else se3.transform(np.eye(3), [100.0, 200.0, 3.0]),
        notes=["an example"],
        unit_from_image=unit_from_image if moving else None,
    )


def assert_nothing_published(out: Path) -> None:
    assert not out.exists()
    assert not [p for p in out.parent.iterdir() if "partial" in p.name]


def withheld_files(out: Path) -> list[str]:
    """Notes of a scene's report on files that are withheld."""
    notes = json.loads((out / "report.json").read_text())["summary"]["notes"]
    return [note for note in notes if " is withheld: " in note]


def assert_withheld(out: Path, *files: str) -> None:
    """The scene in `out` is complete but for these files, and its report names each."""
    withheld = withheld_files(out)
    assert [note.split(" is withheld: ")[0] for note in withheld] == list(files), withheld
    assert all("does not read back" in note for note in withheld)
    assert not any((out / file).exists() for file in files)
    assert (out / "model" / "points3D.bin").is_file()


def scene_with_road(*, far: bool = False) -> Scene:
    """The example with a level road of two patches under its way; points 0 to 19 lie on it."""
    scene, off_m = make_scene(), 0.4
    way = scene.world_from_rig[scene.unit_registered, :3, 3]
    rng = np.random.default_rng(0)
    points = scene.points_m.copy()
    points[:20] = np.column_stack([rng.uniform(0, 10, 20), rng.uniform(-3, 3, 20), rng.normal(-1.5, 0.01, 20)])
    surface = RoadSurface(
        axes=np.eye(3),
        centre_m=np.array([[2.0, 0.0, -1.5], [8.0, 0.0, -1.5]]),
        normal=np.tile([0.0, 0.0, 1.0], (2, 1)),
        radius_m=8.0,
        relief=Relief(
            node_m=np.array([[4.5, 0.5, -1.5], [5.5, -0.5, -1.5]]),
            height_m=np.array([0.02, -0.01]),
            slope=np.array([[0.01, -0.02], [0.0, 0.005]]),
            sigma_m=np.array([0.005, 0.007]),
        ),
    )
    shift = np.array([0.0, 0.0, off_m])
    before = np.concatenate([points[:20], points[:20] + shift, points[:20] - shift])
    if far:
        before[-1] = [1e4, 0.0, 900.0]
    distance, patch = surface.locate(before)
    road = Road(
        source=RoadSource.MASKS,
        surface=surface,
        roughness_m=0.01,
        rig_height_m=float(way[0, 2] + 1.5),
        before=RoadPoints(points_m=before, distance_m=distance, is_inlier=np.arange(60) < 20),
    )
    classes = np.where(np.arange(len(points)) < 20, ROAD, 1).astype(np.uint8)
    patches = np.full(len(points), -1, np.int32)
    patches[:20] = patch[:20]
    return replace(scene, points_m=points, point_classes=classes, point_patches=patches, road=road)


def street_of_points(count: int) -> Scene:
    """The example with other points, along a street of 600 m dense at one end; of observations, their numbers alone."""
    rng, scene = np.random.default_rng(5), scene_with_road()
    along = 600 * rng.random(count) ** 2 - 80
    return replace(
        scene,
        points_m=np.column_stack([along, 30 * np.sin(along / 90) + rng.normal(0, 6, count), 4 * rng.random(count)]),
        point_colors=rng.integers(0, 256, (count, 3), dtype=np.uint8),
        point_error_px=rng.gamma(2.0, 0.2, count),
        point_classes=rng.integers(0, 6, count).astype(np.uint8),
        point_patches=rng.integers(-1, 2, count).astype(np.int32),
        observation_point=np.sort(rng.integers(0, count, 4 * count)),
    )
