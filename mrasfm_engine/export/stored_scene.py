"""Reader of a written scene or map as the `Scene` that its files were written of, for exports.

Descriptors, verified matches and sigmas of the calibration are not read: no format of exports has them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pydantic import ValidationError

from mrasfm_engine.errors import InputError, MrasfmError
from mrasfm_engine.export.contract import ExportSource
from mrasfm_engine.geometry import se3
from mrasfm_engine.io.read_map import is_map
from mrasfm_engine.io.read_model import read_images, read_points, read_vertices
from mrasfm_engine.io.read_scene import read_json
from mrasfm_engine.io.stage_store import StageStore
from mrasfm_engine.scene.drive import Drive, DriveImage, matrix_from_pose
from mrasfm_engine.scene.scene import CameraCalibration, Georeference, ImageFeatures, Scene
from mrasfm_engine.types import Bools, Floats, Ints
from schemas import DriveManifest, Frame, FrameImage, Pose, Rig
from schemas.artifacts import IMAGES_SHA256, MAP_FILE, OWN_CAR_FOLDER, REPORT_FILE, SCENES_FOLDER

VERSION = 1  # of the documents
REMEDY = "Give a folder that `mrasfm reconstruct --out` or `mrasfm aggregate --out` wrote, with all its files."
SAME_TIME = 1e-6  # of poses' elements: images nearer to their unit's pose are at its time


def read_source(folder: Path) -> ExportSource:
    """Read a scene's or a map's folder.

    Raises
    ------
    InputError
        Where it is neither, of another version, or damaged.
    """
    folder = Path(folder)
    if not (folder / REPORT_FILE).is_file():
        state = f"has no {REPORT_FILE}" if folder.is_dir() else "is no folder"
        raise InputError(f"{folder} is no scene or map: it {state}", remedy=REMEDY, code="not-a-scene")
    with _damaged(folder):
        return replace(_map(folder) if is_map(folder) else _scene(folder), folder=folder)


@contextmanager
def _damaged(path: Path) -> Iterator[None]:
    """Name what is damaged: a file, or the folder where files of it do not belong together."""
    try:
        yield
    except MrasfmError:
        raise
    except (OSError, ValueError, KeyError, TypeError, IndexError, AttributeError) as error:
        raise InputError(
            f"{path} is damaged: {type(error).__name__}: {error}",
            remedy="Copy or download it again, or make it anew.",
            code="damaged-scene",
        ) from error


def _scene(folder: Path) -> ExportSource:
    try:
        manifest = DriveManifest.model_validate_json((folder / "manifest.json").read_bytes())
    except ValidationError as error:
        raise ValueError(f"manifest.json: {error.errors()[0]['msg']}") from error
    calibration = _document(folder / "calibration.json")["cameras"]
    drive, report = Drive(Path(), manifest), read_json(folder / REPORT_FILE, remedy=REMEDY)
    calibrations = [_calibration(calibration[camera.name]) for camera in drive.cameras]
    return ExportSource(
        scene=_arrays(folder, drive, calibrations, np.zeros(len(drive.cameras), np.int64)),
        name=manifest.name,
        is_map=False,
        scene_of_unit=[manifest.name] * len(manifest.frames),
        own_cars=dict(_own_cars(folder, drive)),
        masks_of_network=_masks_of_network(report),
        components_elsewhere=[part["folder"] for part in report.get("components", []) if part["folder"] != "."],
        images_sha256=dict(report.get(IMAGES_SHA256, {})),
    )


def _masks_of_network(report: Mapping[str, Any]) -> int:
    """Number of images whose mask a network made, as the report's stages say."""
    stages = report.get("stages", [])
    return sum(stage.get("images_with_mask", {}).get("made_by_model", 0) for stage in stages)


def _map(folder: Path) -> ExportSource:
    """The drives of all its scenes as one, with a rig for each."""
    store, cameras, frames, rigs, names = StageStore(folder / SCENES_FOLDER), [], [], [], []
    calibrations: list[CameraCalibration] = []
    for number, entry in enumerate(_document(folder / MAP_FILE)["scenes"]):
        name = entry["name"]
        manifest = _manifest_in_map(store, name, entry["fingerprint"])
        found = _document(folder / "calibration" / f"{name}.json")["cameras"]
        for camera in manifest.rig.cameras:
            cameras.append(camera.model_copy(update={"name": f"{name}/{camera.name}"}))
            calibrations.append(_calibration(found[camera.name]))
            rigs.append(number)
        frames += [_frame_in_map(frame, name) for frame in manifest.frames]
        names += [name] * len(manifest.frames)
    # Not validated: frames of different drives need not be in order of time, and names have slashes.
    joined = DriveManifest.model_construct(
        name="map", rig=Rig.model_construct(cameras=cameras), frames=frames, notes=[], gnss=None, label_map=None
    )
    drive = Drive(Path(), joined)
    return ExportSource(
        scene=_arrays(folder, drive, calibrations, np.array(rigs, dtype=np.int64)),
        name=folder.resolve().name,
        is_map=True,
        scene_of_unit=names,
        own_cars={},
    )


def _manifest_in_map(store: StageStore, name: str, fingerprint: str) -> DriveManifest:
    found = store.open(name, fingerprint)  # its arrays, which may be large, are not needed
    if found is None:
        raise ValueError(f"it has no usable {SCENES_FOLDER}/{name}.npz")
    return DriveManifest.model_validate(found.report["manifest"])


def _frame_in_map(frame: Frame, scene: str) -> Frame:
    images = {
        f"{scene}/{name}": FrameImage.model_construct(
            file=f"{scene}/{image.file}",
            timestamp_us=image.timestamp_us,
            mask=None if image.mask is None else f"{scene}/{image.mask}",
        )
        for name, image in frame.images.items()
    }
    return frame.model_copy(update={"images": images})


def _document(path: Path) -> dict[str, Any]:
    document = read_json(path, remedy=REMEDY)
    if document.get("version") != VERSION:
        raise InputError(
            f"{path} is of version {document.get('version')!r}, not of {VERSION}",
            remedy="Make it again with this version.",
            code="scene-version",
        )
    return document


def _calibration(camera: Mapping[str, Any]) -> CameraCalibration:
    unknown = np.full(3, np.nan)
    refined = camera["refined"]
    return CameraCalibration(
        rig_from_cam=matrix_from_pose(Pose(**refined["rig_from_cam"])),
        params=np.array(refined["params"], dtype=np.float64),
        sigma_rotation_deg=unknown,
        sigma_translation_m=unknown,
        repeatability_rotation_deg=unknown,
        repeatability_translation_m=unknown,
        sigma_focal_px=float("nan"),
        observed=np.zeros(6, dtype=np.bool_),
    )


def _own_cars(folder: Path, drive: Drive) -> Iterator[tuple[str, Bools]]:
    for camera in drive.cameras:
        path = folder / OWN_CAR_FOLDER / f"{camera.name}.png"
        if not path.is_file():
            continue
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if mask is None or mask.shape != (camera.height, camera.width):
            raise ValueError(f"{OWN_CAR_FOLDER}/{path.name} is no mask of the camera")
        yield camera.name, mask > 127


def _arrays(folder: Path, drive: Drive, calibration: list[CameraCalibration], rigs: Ints) -> Scene:
    poses, frame = _document(folder / "poses.json"), _document(folder / "frame.json")
    units, listed = poses["units"], poses["images"]
    images = drive.images
    if len(units) != len(drive.manifest.frames) or [i["file"] for i in listed] != [i.file for i in images]:
        raise ValueError("poses.json and the drive's manifest speak of different images")
    image_registered = np.array([bool(image["registered"]) for image in listed], dtype=np.bool_)
    with _damaged(folder / "model" / "points3D.bin"):
        points = read_points(folder / "model" / "points3D.bin")
    features, observations = _observations(folder, images, len(points.xyz_m))
    with _damaged(folder / "poses.json"):
        world_from_rig, world_from_cam = _poses(units, "world_from_rig"), _poses(listed, "world_from_cam")
    with _damaged(folder / "frame.json"):
        georeference = _georeference(frame)
    with _damaged(folder / "points.ply"):
        _, rows = read_vertices(folder / "points.ply")
    if len(rows) != len(points.xyz_m):
        raise ValueError(f"points.ply has {len(rows)} points, model/points3D.bin {len(points.xyz_m)}")
    rough = frame.get("rough_world_from_local")
    return Scene(
        drive=drive,
        unit_registered=np.array([bool(unit["registered"]) for unit in units], dtype=np.bool_),
        image_registered=image_registered,
        world_from_rig=world_from_rig,
        sigma_position_m=np.array(
            [unit.get("sigma_position_m", [np.nan] * 3) for unit in units], dtype=np.float64
        ).reshape(-1, 3),
        calibration=calibration,
        points_m=points.xyz_m,
        point_colors=points.color,
        point_error_px=points.error_px,
        point_classes=np.ascontiguousarray(rows["class"]),
        observation_point=observations[:, 0],
        observation_image=observations[:, 1],
        observation_keypoint=observations[:, 2],
        features=features,
        pairs=[],
        georeference=georeference,
        rough_world_from_local=None if rough is None else np.array(rough, dtype=np.float64),
        unit_from_image=_unit_from_image(images, world_from_rig, world_from_cam, calibration),
        rig_of_camera=rigs,
        unit_component=np.array([unit.get("component", 0) for unit in units], dtype=np.int64),
    )


def _observations(folder: Path, images: list[DriveImage], points: int) -> tuple[list[ImageFeatures], Ints]:
    """Keypoints by image, and observations (n, 3): point, image, keypoint, sorted by point."""
    with _damaged(folder / "model" / "images.bin"):
        model = read_images(folder / "model" / "images.bin")
    features, found = [], [np.zeros((0, 3), np.int64)]
    for i, image in enumerate(images):
        known = model.get(i)
        if known is not None and known.name != image.file:
            raise ValueError(f"model/images.bin calls image {i + 1} {known.name!r}, poses.json {image.file!r}")
        xy = np.zeros((0, 2), np.float32) if known is None else known.xy_px
        features.append(
            ImageFeatures(xy_px=xy, descriptors=np.zeros((0, 128), np.uint8), colors=np.zeros((0, 3), np.uint8))
        )
        if known is not None:
            keypoints = np.flatnonzero(known.point >= 0)
            found.append(np.column_stack([known.point[keypoints], np.full(len(keypoints), i), keypoints]))
    rows = np.concatenate(found).astype(np.int64)
    if len(rows) and rows[:, 0].max() >= points:
        raise ValueError("the model's images and points do not belong together")
    return features, rows[np.lexsort((rows[:, 2], rows[:, 1], rows[:, 0]))]


def _poses(entries: list[dict[str, Any]], key: str) -> Floats:
    result = np.full((len(entries), 4, 4), np.nan)
    for i, entry in enumerate(entries):
        if entry["registered"]:
            result[i] = matrix_from_pose(Pose(**entry[key]))
    return result


def _unit_from_image(
    images: list[DriveImage], world_from_rig: Floats, world_from_cam: Floats, calibration: list[CameraCalibration]
) -> Floats | None:
    """Poses (images, 4, 4) of the rig at the images' times relative to their units'; None where they are the same."""
    result = np.tile(np.eye(4), (len(images), 1, 1))
    for i, image in enumerate(images):
        if np.isfinite(world_from_cam[i]).all():
            world_from_image = world_from_cam[i] @ se3.inverse(calibration[image.camera].rig_from_cam)
            result[i] = se3.inverse(world_from_rig[image.unit]) @ world_from_image
    return result if np.abs(result - np.eye(4)).max(initial=0.0) > SAME_TIME else None


def _georeference(frame: dict[str, Any]) -> Georeference | None:
    if frame.get("georeferenced") is not True:
        return None
    origin, matrix = frame["origin"], np.array(frame["ecef_from_local"], dtype=np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError("frame.json's ecef_from_local is no 4x4 matrix")
    return Georeference(
        origin_latitude_deg=float(origin["latitude_deg"]),
        origin_longitude_deg=float(origin["longitude_deg"]),
        origin_ellipsoidal_height_m=float(origin["ellipsoidal_height_m"]),
        height_datum=str(frame["height_datum"]),
        ecef_from_local=matrix,
    )
