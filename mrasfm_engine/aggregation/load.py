"""Reads scenes' folders for aggregation, and refuses what cannot take part before any work."""

from __future__ import annotations

import json
import re
import sqlite3
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from mrasfm_engine.aggregation.source import SourceScene, unit_from_images
from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import geodesy, se3
from mrasfm_engine.io.read_model import ModelImage, read_images, read_points, read_vertices
from mrasfm_engine.scene.drive import matrix_from_pose
from mrasfm_engine.scene.receiver_as_found import gnss_as_found
from mrasfm_engine.types import Bools, Bytes, Floats, Floats32, Ints
from schemas import Camera, DriveManifest, Pose
from schemas.artifacts import COMPONENT_MARK, COMPONENTS_FOLDER, REPORT_FILE, component_folder, component_scene
from schemas.file_names import portable_key
from schemas.gnss_check import MAX_SPEED_MPS

SCHEMA_VERSION = 1
MIN_UNITS = 2
POSES_APART = 1e-3  # of two files, at most: metres, and a rotation's entries
FROM_UNIT_M = 0.5  # of images, at most, from their unit, besides what is driven between their times
NUMBER = re.compile(r"[1-9][0-9]{0,8}")
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")
NEEDED = (
    "report.json", "manifest.json", "poses.json", "calibration.json", "frame.json", "points.ply", "features.db",
    "model/images.bin", "model/points3D.bin",
)  # fmt: skip
AGAIN = "Reconstruct the drive again with this version."


def name_scenes(scenes: Mapping[str, Path] | Sequence[Path]) -> dict[str, Path]:
    """Scenes by name: as given, or by their folders' names.

    Raises
    ------
    InputError
        Where a name repeats or is not one that a file can have.
    """
    if isinstance(scenes, Mapping):
        named = [(str(name), Path(folder)) for name, folder in scenes.items()]
    else:
        named = [(Path(folder).resolve().name, Path(folder)) for folder in scenes]
    result: dict[str, Path] = {}
    for name, folder in named:
        if not NAME.fullmatch(name):
            raise InputError(
                f"{name!r} cannot be the name of a scene",
                remedy="Use letters, digits, '_', '.' and '-': NAME=FOLDER gives a scene another name.",
                code="bad-scene-name",
            )
        alike = like_named(name, result)
        if alike is not None:
            raise duplicate_scene(name, folder, alike, result[alike])
        result[name] = folder
    return result


def like_named(name: str, others: Collection[str]) -> str | None:
    """The one of other scenes whose files are those of a scene of this name on systems that ignore case, or None."""
    return next((other for other in others if portable_key(other) == portable_key(name)), None)


def duplicate_scene(name: str, folder: Path, other_name: str, other: Path) -> InputError:
    """Refusal of two scenes with one name."""
    called = (
        f"called {name!r}" if name == other_name else f"called {other_name!r} and {name!r}, one name on many systems"
    )
    return InputError(
        f"two scenes are {called}: {other} and {folder}",
        remedy="Give each scene once, or names of their own: NAME=FOLDER.",
        code="duplicate-scene",
    )


def components_of(folder: Path, name: str) -> dict[str, Path]:
    """Folders of a scene's smaller components by the names that they have in a map."""
    found = (folder / COMPONENTS_FOLDER).glob("*") if (folder / COMPONENTS_FOLDER).is_dir() else ()
    numbers = sorted(int(path.name) for path in found if NUMBER.fullmatch(path.name))
    return {component_scene(name, number): folder / component_folder(number) for number in numbers}


def not_georeferenced(name: str, found: str = "") -> InputError:
    """Refusal of a scene that nothing places on the earth, with what was `found` of its images."""
    return InputError(
        f"scene {name} is not georeferenced{found}",
        remedy="Reconstruct the drive with GNSS, give it rough_poses with a common_world that all drives declare, or "
        "add a georeferenced drive that sees the same places.",
        code="not-georeferenced",
    )


def read_scene(folder: Path, name: str) -> SourceScene:
    """Read what aggregation needs of a scene's folder.

    Units that have their pose in another component are left out.

    Raises
    ------
    InputError
        Where it is no scene, of another schema, damaged, or too small.
    """
    folder = Path(folder)
    _require_files(folder, name)
    manifest = _manifest(folder, name)
    frame, poses, calibration, report = (
        _document(folder / f"{part}.json", name) for part in ("frame", "poses", "calibration", "report")
    )
    for part, document in (("frame", frame), ("poses", poses), ("calibration", calibration)):
        if document.get("version") != SCHEMA_VERSION:
            raise InputError(
                f"scene {name}: {part}.json is of version {document.get('version')!r}, not of {SCHEMA_VERSION}",
                remedy=AGAIN,
                code="scene-version",
            )
    place = _place(folder, frame, manifest, name)
    with _damaged(folder, name):
        scene = _arrays(
            folder,
            name=name,
            manifest=_with_receiver(folder, _with_refined(folder, manifest, calibration, name), report, name),
            documents=(frame, poses, calibration, report),
            place=place,
        )
        scene = scene.of_units(_own_units(poses, scene.unit_registered, is_component=COMPONENT_MARK in name))
    with _damaged(folder / "calibration.json", name):
        _ = scene.certainty_of_cameras, scene.given_rig_from_cam, scene.given_lenses
        _ = scene.focal_given_of_found, scene.sigma_focal_px
    if scene.unit_registered.sum() < MIN_UNITS or not len(scene.points_m):
        raise InputError(
            f"scene {name} has {int(scene.unit_registered.sum())} registered units and {len(scene.points_m)} points",
            remedy="Leave it out, or reconstruct it from more images.",
            code="empty-scene",
        )
    return scene


def _require_files(folder: Path, name: str) -> None:
    if not folder.is_dir():
        state = "is not a folder" if folder.exists() else "does not exist"
        raise InputError(
            f"scene {name}: {folder} {state}",
            remedy="Give the folder that `mrasfm reconstruct --out` wrote.",
            code="not-a-scene",
        )
    if (folder / "map.json").exists():
        raise InputError(
            f"scene {name}: {folder} is a map",
            remedy="Give the scenes themselves, or add scenes to the map with --into.",
            code="not-a-scene",
        )
    missing = [file for file in NEEDED if not (folder / file).is_file()]
    if missing == ["manifest.json"]:
        raise InputError(
            f"scene {name}: {folder} has no manifest.json, an earlier version of the engine wrote it",
            remedy=AGAIN,
            code="scene-version",
        )
    if missing:
        raise InputError(
            f"scene {name}: {folder} is no complete scene, it has no {missing[0]}",
            remedy="Give the folder that `mrasfm reconstruct --out` wrote, with all its files.",
            code="not-a-scene",
        )


@contextmanager
def _damaged(path: Path, name: str) -> Iterator[None]:
    try:
        yield
    except InputError:
        raise
    except (
        OSError, ValueError, KeyError, TypeError, IndexError, AttributeError, ArithmeticError, sqlite3.Error,
        StopIteration,
    ) as error:  # fmt: skip
        raise InputError(
            f"scene {name}: {path} is damaged: {type(error).__name__}: {_in_a_line(error)}",
            remedy="Copy or download the scene again, or reconstruct the drive again.",
            code="damaged-scene",
        ) from error


def _in_a_line(error: Exception) -> str:
    """The first problem that a validation found, or what an error says."""
    if not isinstance(error, ValidationError):
        return str(error)
    first = error.errors()[0]
    return ": ".join(filter(None, (".".join(map(str, first["loc"])), first["msg"])))


def _document(path: Path, name: str) -> dict[str, Any]:
    with _damaged(path, name):
        document = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(document, dict):
            raise ValueError("it holds no JSON object")
        return document


def _manifest(folder: Path, name: str) -> DriveManifest:
    path = folder / "manifest.json"
    with _damaged(path, name):
        return DriveManifest.model_validate_json(path.read_bytes())


def _own_units(poses: dict[str, Any], registered: Bools, *, is_component: bool) -> Bools:
    """Units (u,) that are the scene's, registered or not: not those of other components of its drive."""
    unposed = np.array([not is_component and "component" not in unit for unit in poses["units"]], dtype=np.bool_)
    return registered | unposed


def _place(folder: Path, frame: dict[str, Any], manifest: DriveManifest, name: str) -> tuple[Floats | None, str | None]:
    """ecef_from_local and None, rough_world_from_local and the common world's name, or nothing."""
    if frame.get("georeferenced") is True:
        matrix = frame.get("ecef_from_local")
    else:
        rough = manifest.rough_poses
        world = None if rough is None else rough.common_world
        if world is None or "rough_world_from_local" not in frame:
            return None, None
        matrix = frame["rough_world_from_local"]
    with _damaged(folder / "frame.json", name):
        result = np.array(matrix, dtype=np.float64)
        rotation = result[:3, :3]
        rigid = result.shape == (4, 4) and np.allclose(rotation @ rotation.T, np.eye(3)) and np.linalg.det(rotation) > 0
        if not rigid or not np.isfinite(result).all() or not np.array_equal(result[3], [0, 0, 0, 1]):
            raise ValueError("the frame's transform is not a rigid one")
        if frame.get("georeferenced") is True:
            geodesy.geodetic_from_ecef(result[:3, 3])  # raises where it is not near the earth's surface
    return result, None if frame.get("georeferenced") is True else world


def _with_refined(folder: Path, manifest: DriveManifest, calibration: dict[str, Any], name: str) -> DriveManifest:
    """The manifest with the scene's refined calibration in the place of the given one."""

    def refined(camera: Camera) -> Camera:
        found = calibration["cameras"][camera.name]["refined"]
        # Validated, as no copy is: parameters that no camera can have would fail much later.
        return Camera(**dict(camera) | {"rig_from_cam": Pose(**found["rig_from_cam"]), "params": found["params"]})

    with _damaged(folder / "calibration.json", name):
        cameras = [refined(camera) for camera in manifest.rig.cameras]
    return manifest.model_copy(update={"rig": manifest.rig.model_copy(update={"cameras": cameras})})


def _with_receiver(folder: Path, manifest: DriveManifest, report: dict[str, Any], name: str) -> DriveManifest:
    """The manifest with the receiver's clock and antenna as the scene's adjustment found them."""
    with _damaged(folder / REPORT_FILE, name):
        found = [stage["gnss"] for stage in report.get("stages", ()) if "gnss" in stage]
        if manifest.gnss is None or not found:
            return manifest
        return manifest.model_copy(update={"gnss": gnss_as_found(manifest.gnss, found[-1])})


def _arrays(
    folder: Path,
    *,
    name: str,
    manifest: DriveManifest,
    documents: tuple[dict[str, Any], ...],
    place: tuple[Floats | None, str | None],
) -> SourceScene:
    frame, poses, calibration, report = documents
    with _damaged(folder / "poses.json", name):
        units, images = poses["units"], poses["images"]
        unit_registered = np.array([bool(unit["registered"]) for unit in units])
        image_registered = np.array([bool(image["registered"]) for image in images])
        world_from_rig, world_from_cam = _poses(units, "world_from_rig"), _poses(images, "world_from_cam")
        sigma = [unit.get("sigma_position_m", [np.nan] * 3) for unit in units]
        sigma_position_m = np.array(sigma, dtype=np.float64).reshape(-1, 3)
    listed = [image.file for frame in manifest.frames for image in frame.images.values()]
    if len(units) != len(manifest.frames) or sorted(listed) != sorted(image["file"] for image in images):
        raise ValueError("manifest.json and poses.json speak of different images")
    if not unit_registered[
        [image["unit"] for image, posed in zip(images, image_registered, strict=True) if posed]
    ].all():
        raise ValueError("poses.json has images with a pose of units without one")
    rig_from_cam = {c.name: matrix_from_pose(c.rig_from_cam) for c in manifest.rig.cameras}
    with _damaged(folder / "model" / "images.bin", name):
        model = read_images(folder / "model" / "images.bin")
    with _damaged(folder / "model" / "points3D.bin", name):
        points = read_points(folder / "model" / "points3D.bin")
    with _damaged(folder / "points.ply", name):
        classes = _point_classes(folder / "points.ply", len(points.xyz_m))
    with _damaged(folder / "features.db", name):
        first, xy, point, descriptors = _keypoints(folder, model, len(images), len(points.xyz_m))
    kind = features_kind(report)
    result = SourceScene(
        name=name,
        manifest=manifest,
        calibration=calibration,
        report={key: report[key] for key in ("engine_version", "drive", "summary") if key in report} | _scale(report),
        features_kind=kind,
        height_datum=str(frame.get("height_datum", "")),
        common_world=place[1],
        is_placed=place[0] is not None,
        ecef_from_local=np.full((4, 4), np.nan) if place[0] is None else place[0],
        unit_registered=unit_registered,
        world_from_rig=world_from_rig,
        sigma_position_m=sigma_position_m,
        image_registered=image_registered,
        unit_from_image=unit_from_images(
            world_from_rig[[image["unit"] for image in images]],
            world_from_cam,
            np.stack([rig_from_cam[image["camera"]] for image in images]),
            image_registered,
        ),
        points_m=points.xyz_m,
        point_colors=points.color,
        point_errors_px=points.error_px,
        point_classes=classes,
        keypoint_first=first,
        keypoint_xy_px=xy,
        keypoint_point=point,
        descriptors=descriptors if kind.startswith("sift") else descriptors.view(np.float32),
    )
    _require_poses_of_model(result, model)
    _require_images_at_units(result, calibration)
    return result


def _require_poses_of_model(scene: SourceScene, model: Mapping[int, ModelImage]) -> None:
    """Refuse poses of images that are not the model's: its points would be seen from elsewhere."""
    rows = [i for i in sorted(model) if i < len(scene.image_registered) and scene.image_registered[i]]
    if not rows:
        return
    found = np.stack([model[i].cam_from_world for i in rows])
    cam_from_world = se3.transform(se3.rotation_from_quaternion(found[:, [1, 2, 3, 0]]), found[:, 4:])
    apart = np.abs(cam_from_world @ scene.world_from_cam[rows] - np.eye(4)).max(axis=(1, 2))
    worst = int(np.argmax(apart))
    if not apart[worst] <= POSES_APART:
        raise ValueError(
            f"poses.json and model/images.bin have different poses of {scene.drive.images[rows[worst]].file}"
        )


def _require_images_at_units(scene: SourceScene, calibration: Mapping[str, Any]) -> None:
    """Refuse images that are farther from their units than a vehicle drives between their times."""
    if not len(scene.unit_from_image):
        return
    late_us = [
        abs(float(calibration["cameras"][camera.name]["refined"].get("time_offset_us") or 0.0))
        + (camera.readout_us or 0)
        for camera in scene.drive.cameras
    ]
    apart_us = [
        abs(image.timestamp_us - int(scene.drive.timestamps_us[image.unit])) + late_us[image.camera]
        for image in scene.drive.images
    ]
    away_m = np.linalg.norm(scene.unit_from_image[:, :3, 3], axis=1)
    excess_m = away_m - (FROM_UNIT_M + MAX_SPEED_MPS * np.array(apart_us) / 1e6)
    worst = int(np.argmax(np.round(excess_m, 3)))  # the first of those of a unit, which are all as far
    if not excess_m[worst] <= 0.0:
        raise ValueError(
            f"poses.json has {scene.drive.images[worst].file} {away_m[worst]:.2f} m from its unit, by "
            f"calibration.json, and at most {apart_us[worst] / 1e3:.1f} ms from it in time"
        )


def _scale(report: dict[str, Any]) -> dict[str, Any]:
    """The part of a report on the scene's scale."""
    found = [stage["scale"] for stage in report.get("stages", ()) if "scale" in stage]
    return {"scale": {key: found[-1][key] for key in ("sigma_relative", "from") if key in found[-1]}} if found else {}


def features_kind(report: dict[str, Any]) -> str:
    """Return the extractor, and its model, of a scene's descriptors: others cannot be compared with them."""
    extractor = report.get("settings", {}).get("features", {}).get("extractor", "sift")
    model = report.get("models", {}).get("extractor", {}).get("sha256", "")
    return f"{extractor} {model}".strip()


def _poses(entries: Sequence[dict[str, Any]], key: str) -> Floats:
    result = np.full((len(entries), 4, 4), np.nan)
    for i, entry in enumerate(entries):
        if entry["registered"]:
            result[i] = matrix_from_pose(Pose(**entry[key]))
    return result


def _point_classes(path: Path, count: int) -> Bytes:
    _, rows = read_vertices(path)
    if len(rows) != count:
        raise ValueError(f"points.ply has {len(rows)} points, model/points3D.bin {count}")
    return np.ascontiguousarray(rows["class"])


def _uri(database: Path) -> str:
    """SQLite's URI of a database that nobody writes; its folder may have any name."""
    return f"{database.resolve().as_uri()}?mode=ro&immutable=1"


def _keypoints(
    folder: Path, model: Mapping[int, ModelImage], images: int, points: int
) -> tuple[Ints, Floats32, Ints, Bytes]:
    """First keypoint of every image, positions, points, and the descriptors of keypoints with a point, as bytes."""
    counts, xy, point, descriptors = np.zeros(images, dtype=np.int64), [], [], []
    with closing(sqlite3.connect(_uri(folder / "features.db"), uri=True)) as db:
        for i in range(images):
            found = model.get(i)
            if found is None:
                continue
            counts[i] = len(found.xy_px)
            xy.append(found.xy_px)
            point.append(found.point)
            if not counts[i]:
                continue
            row = db.execute("SELECT rows, cols, data FROM descriptors WHERE image_id = ?", (i + 1,)).fetchone()
            if row is None:
                raise ValueError(f"it has no descriptors of image {i + 1}")
            rows, columns, data = row
            if rows != counts[i]:
                raise ValueError(
                    f"features.db has {rows} descriptors of image {i + 1}, the model {counts[i]} keypoints"
                )
            table = np.frombuffer(data or b"", np.uint8).reshape(rows, columns)
            descriptors.append(table[found.point >= 0])
    flat = np.concatenate(point) if point else np.zeros(0, dtype=np.int64)
    if len(flat) and (flat.max() >= points or not (flat >= 0).any()):
        raise ValueError("the model's images and points do not belong together")
    first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return first, np.concatenate(xy), flat.astype(np.int64), np.concatenate(descriptors)
