"""Re-reads the files of a written scene, with other code than wrote them, before they are put in place.

Rotations are composed with scipy, geodetic positions projected back with PROJ, and the database is read with SQLite.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike
from pyproj import CRS, Transformer
from scipy.spatial.transform import Rotation

from mrasfm_engine.errors import MrasfmError
from mrasfm_engine.export.colmap import frame_of_image
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.types import Floats
from schemas import DriveManifest

POSE_TOLERANCE = 1e-6  # metres, and elements of rotation matrices
GEODETIC_TOLERANCE_M = 1e-4
GEODETIC_FIELDS = ("world_crs", "world_crs_wkt2", "height_datum", "origin", "ecef_from_local")


def refuse(path: Path, what: str) -> NoReturn:
    """Withhold a file that does not say what the scene says.

    Raises
    ------
    MrasfmError
        Always.
    """
    raise MrasfmError(
        f"{path.name} was written but does not read back: {what}; nothing was published",
        remedy="Check that the disk is not full and run again; if it happens again, report it as a defect of mrasfm.",
        code="export-check-failed",
    )


@contextmanager
def checking(path: Path) -> Iterator[None]:
    """Turn whatever goes wrong while a file is read back into a refusal that names it."""
    try:
        yield
    except MrasfmError:
        raise
    except Exception as error:
        refuse(path, f"{type(error).__name__}: {error}")


def require(condition: bool | np.bool_, path: Path, what: str) -> None:
    """Refuse a file unless the condition holds."""
    if not condition:
        refuse(path, what)


def require_close(actual: ArrayLike, expected: ArrayLike, *, path: Path, what: str, tolerance: float) -> None:
    """Refuse a file unless two arrays have one shape and differ by no more than the tolerance; NaN differs."""
    a, b = np.asarray(actual, dtype=np.float64), np.asarray(expected, dtype=np.float64)
    require(a.shape == b.shape, path, f"{what} has shape {a.shape} instead of {b.shape}")
    require(bool((np.abs(a - b) <= tolerance).all()), path, f"{what} is not what the scene says")


def matrices(quaternions_xyzw: ArrayLike, translations: ArrayLike) -> Floats:
    """Transforms (n, 4, 4) as scipy composes them."""
    translations = np.asarray(translations, dtype=np.float64).reshape(-1, 3)
    out = np.tile(np.eye(4), (len(translations), 1, 1))
    if len(translations):
        out[:, :3, :3] = Rotation.from_quat(np.asarray(quaternions_xyzw, dtype=np.float64).reshape(-1, 4)).as_matrix()
    out[:, :3, 3] = translations
    return out


def check_documents(scene: Scene, folder: Path) -> None:
    """Check all JSON files, `poses.tum` and what they say about each other."""
    frame_path, calibration_path, poses_path = (folder / f"{n}.json" for n in ("frame", "calibration", "poses"))
    with checking(frame_path):
        frame = read_json(frame_path)
        check_frame(scene, frame, frame_path)
    with checking(calibration_path):
        rig_from_cam = _check_calibration(scene, read_json(calibration_path), calibration_path)
    with checking(poses_path):
        check_poses(scene, read_json(poses_path), frame, rig_from_cam, path=poses_path)
    with checking(folder / "poses.tum"):
        _check_tum(scene, folder / "poses.tum")
    with checking(folder / "report.json"):
        read_json(folder / "report.json")


def check_ply(scene: Scene, path: Path) -> None:
    """Check vertex count, coordinates, colours, classes and patches of the road."""
    types = {"float": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4"}
    with checking(path):
        head, _, body = path.read_bytes().partition(b"end_header\n")
        lines = [line.split() for line in head.decode("ascii").splitlines()]
        count = next(int(line[2]) for line in lines if line[:2] == ["element", "vertex"])
        rows = np.frombuffer(body, dtype=[(line[2], types[line[1]]) for line in lines if line[0] == "property"])
        require(count == len(rows) == len(scene.points_m), path, f"{count} vertices announced, {len(rows)} found")
        xyz = np.stack([rows[name] for name in "xyz"], -1)
        require_close(xyz, scene.points_m, path=path, what="a point", tolerance=1e-3)
        colors = np.stack([rows[name] for name in ("red", "green", "blue")], -1)
        require(np.array_equal(colors, scene.point_colors), path, "a colour is not what the scene says")
        require(np.array_equal(rows["class"], scene.point_classes), path, "a class is not what the scene says")
        require(np.array_equal(rows["road_patch"], scene.point_patches), path, "a patch is not what the scene says")
        require(int(rows["track_length"].sum()) == len(scene.observation_point), path, "track lengths do not add up")


def check_road(scene: Scene, path: Path) -> None:
    """Check the patches of the road, and that points said to be on one are near its plane."""
    assert scene.road is not None
    with checking(path):
        document = read_json(path)
        centre, normal = (
            np.array([patch[key] for patch in document["patches"]], dtype=np.float64).reshape(-1, 3)
            for key in ("centre_m", "normal")
        )
        surface = scene.road.surface
        require_close(centre, surface.centre_m, path=path, what="a patch's centre", tolerance=1e-9)
        require_close(normal, surface.normal, path=path, what="a patch's normal", tolerance=1e-9)
        require_close(np.linalg.norm(normal, axis=1), np.ones(len(normal)), path=path, what="a normal", tolerance=1e-9)
        counts = np.array([patch["points"] for patch in document["patches"]])
        require(counts.sum() == (scene.point_patches >= 0).sum(), path, "points of patches do not add up")
        on_road = np.flatnonzero(scene.point_patches >= 0)
        away = np.linalg.norm(scene.points_m[on_road] - centre[scene.point_patches[on_road]], axis=1)
        require(bool((away < 2 * document["patch_radius_m"]).all()), path, "a point is far from its patch")


def check_manifest(scene: Scene, path: Path) -> None:
    """Check that the drive's manifest reads back as what it is."""
    with checking(path):
        read, given = DriveManifest.model_validate(read_json(path)), scene.drive.manifest
        require(read.frames == given.frames and read.gnss == given.gnss, path, "frames or gnss are not the drive's")
        names = [camera.name for camera in read.rig.cameras]
        require(names == [camera.name for camera in given.rig.cameras], path, "its cameras are not the drive's")
        # Reading a quaternion normalises it once more.
        for camera, expected in zip(read.rig.cameras, given.rig.cameras, strict=True):
            poses = [
                matrices([p.rotation_xyzw], [p.translation_m]) for p in (camera.rig_from_cam, expected.rig_from_cam)
            ]
            require_close(*poses, path=path, what=f"{camera.name}'s pose", tolerance=POSE_TOLERANCE)


def check_features(scene: Scene, path: Path) -> None:
    """Check ids, rows and content of every table."""
    images = scene.drive.images
    with checking(path), closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as db:
        found = db.execute("SELECT image_id, name, camera_id FROM images ORDER BY image_id").fetchall()
        expected = [(i + 1, image.file, image.camera + 1) for i, image in enumerate(images)]
        require(found == expected, path, "images are not the drive's")
        frames = db.execute("SELECT frame_id, sensor_id, data_id FROM frame_data ORDER BY data_id").fetchall()
        expected_frames = [(frame_of_image(scene, i), image.camera + 1, i + 1) for i, image in enumerate(images)]
        require(frames == expected_frames, path, "frames are not the drive's")
        cameras = [np.frombuffer(row[0]) for row in db.execute("SELECT params FROM cameras ORDER BY camera_id")]
        same = [np.array_equal(a, b.params) for a, b in zip(cameras, scene.calibration, strict=True)]
        require(all(same), path, "camera parameters are not the scene's")
        for table, column in (("keypoints", "xy_px"), ("descriptors", "descriptors")):
            rows = db.execute(f"SELECT image_id, rows, data FROM {table} ORDER BY image_id").fetchall()
            require(len(rows) == len(images), path, f"{table} of {len(rows)} images instead of {len(images)}")
            for (image_id, count, data), features in zip(rows, scene.features, strict=True):
                array = getattr(features, column)
                require(
                    count == len(array) and (data or b"") == array.tobytes(),
                    path,
                    f"{table} of image {image_id} differ",
                )
        _check_pairs(scene, db, path)


def _check_pairs(scene: Scene, db: sqlite3.Connection, path: Path) -> None:
    kept = {(p.image_a + 1, p.image_b + 1): p.matches.astype("<u4") for p in scene.pairs}
    inliers = {(p.image_a + 1, p.image_b + 1): p.matches[p.inliers].astype("<u4") for p in scene.pairs}
    for table, expected in (("matches", kept), ("two_view_geometries", {k: v for k, v in inliers.items() if len(v)})):
        rows = db.execute(f"SELECT pair_id, rows, data FROM {table}").fetchall()
        require(len(rows) == len(expected), path, f"{len(rows)} rows in {table} instead of {len(expected)}")
        for pair_id, count, data in rows:
            # COLMAP's pair id is the smaller image id times 2^31 - 1 plus the larger.
            matches = expected[divmod(pair_id, 2**31 - 1)]
            require(count == len(matches) and (data or b"") == matches.tobytes(), path, f"{table} of a pair differ")


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object; NaN and infinities are refused."""

    def refuse_constant(name: str) -> NoReturn:
        refuse(path, f"it holds {name}")

    document = json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse_constant)
    require(isinstance(document, dict), path, "it is no JSON object")
    return dict(document)


def check_frame(scene: Scene, frame: dict[str, Any], path: Path) -> None:
    """Check the coordinate contract."""
    place = scene.georeference
    require(frame["georeferenced"] == (place is not None), path, "georeferenced is wrong")
    if place is None:
        present = [name for name in GEODETIC_FIELDS if name in frame]
        require(not present, path, f"geodetic fields {present} without georeference")
        return
    require(CRS.from_wkt(frame["world_crs_wkt2"]) == CRS.from_epsg(4978), path, "WKT2 is not EPSG:4978")
    origin, matrix = frame["origin"], np.array(frame["ecef_from_local"], dtype=np.float64)
    require_close(matrix, place.ecef_from_local, path=path, what="ecef_from_local", tolerance=0.0)
    latitude, longitude, height = (origin[k] for k in ("latitude_deg", "longitude_deg", "ellipsoidal_height_m"))
    to_ecef = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    # One metre north and up of the origin by the ellipsoid's own geometry; east follows from orthogonality.
    base = np.array(to_ecef.transform(longitude, latitude, height))
    up = np.array(to_ecef.transform(longitude, latitude, height + 1.0)) - base
    require_close(matrix[:3, 3], base, path=path, what="the origin", tolerance=GEODETIC_TOLERANCE_M)
    require_close(matrix[:3, 2], up, path=path, what="the local frame's up axis", tolerance=1e-6)
    require(abs(matrix[2, 0]) < 1e-9 and matrix[2, 1] >= -1e-9, path, "the local frame's x and y are not east, north")
    rotation = matrix[:3, :3]
    require_close(rotation @ rotation.T, np.eye(3), path=path, what="a rotation", tolerance=1e-9)
    require(np.linalg.det(rotation) > 0, path, "ecef_from_local is a reflection")


def _check_calibration(scene: Scene, document: dict[str, Any], path: Path) -> dict[str, Floats]:
    """`rig_from_cam` by camera as the file has it."""
    cameras = document["cameras"]
    require(list(cameras) == [c.name for c in scene.drive.cameras], path, "its cameras are not the drive's")
    refined: dict[str, Floats] = {}
    for (name, camera), expected in zip(cameras.items(), scene.calibration, strict=True):
        poses = [camera[key]["rig_from_cam"] for key in ("given", "refined")]
        given, new = matrices([p["rotation_xyzw"] for p in poses], [p["translation_m"] for p in poses])
        change = camera["difference"]
        turned = Rotation.from_rotvec(np.radians(change["rotation_vector_deg"])).as_matrix() @ given[:3, :3]
        require_close(new, expected.rig_from_cam, path=path, what=f"{name}'s pose", tolerance=POSE_TOLERANCE)
        require_close(turned, new[:3, :3], path=path, what=f"{name}'s difference", tolerance=POSE_TOLERANCE)
        moved = given[:3, 3] + change["translation_m"]
        require_close(moved, new[:3, 3], path=path, what=f"{name}'s difference", tolerance=POSE_TOLERANCE)
        require_close(camera["refined"]["params"], expected.params, path=path, what=f"{name}'s params", tolerance=0.0)
        refined[name] = new
    return refined


def check_poses(
    scene: Scene, document: dict[str, Any], frame: dict[str, Any], rig_from_cam: dict[str, Floats], *, path: Path
) -> None:
    """Check every unit's and image's pose, also as composed of rig and cameras, and its place on the earth."""
    units, images = document["units"], document["images"]
    require([u["registered"] for u in units] == scene.unit_registered.tolist(), path, "its units are not the scene's")
    require(
        [i["registered"] for i in images] == scene.image_registered.tolist(), path, "its images are not the scene's"
    )
    require([i["file"] for i in images] == [i.file for i in scene.drive.images], path, "its files are not the drive's")
    registered = [unit for unit in units if unit["registered"]]
    world_from_rig = _poses(registered, "world_from_rig")
    expected = scene.world_from_rig[scene.unit_registered]
    require_close(world_from_rig, expected, path=path, what="a unit's pose", tolerance=POSE_TOLERANCE)
    row = dict(zip(np.flatnonzero(scene.unit_registered).tolist(), range(len(registered)), strict=True))
    seen = [image for image in images if image["registered"]]
    world_from_cam = _poses(seen, "world_from_cam")
    moved = np.tile(np.eye(4), (len(images), 1, 1)) if scene.unit_from_image is None else scene.unit_from_image
    composed = [
        world_from_rig[row[image["unit"]]] @ unit_from_image @ rig_from_cam[image["camera"]]
        for image, unit_from_image in zip(seen, moved[scene.image_registered], strict=True)
    ]
    require_close(
        world_from_cam,
        np.reshape(composed, (-1, 4, 4)),
        path=path,
        what="an image's pose",
        tolerance=POSE_TOLERANCE,
    )
    for entries, poses in ((registered, world_from_rig), (seen, world_from_cam)):
        _check_geodetic(entries, poses, frame, path)
    without = [e for e in [*units, *images] if not e["registered"] and {"world_from_rig", "world_from_cam"} & set(e)]
    require(not without, path, "something that is not registered has a pose")


def _poses(entries: list[dict[str, Any]], key: str) -> Floats:
    return matrices([e[key]["rotation_xyzw"] for e in entries], [e[key]["translation_m"] for e in entries])


def _check_geodetic(entries: list[dict[str, Any]], poses: Floats, frame: dict[str, Any], path: Path) -> None:
    if not frame["georeferenced"]:
        require(not any("geodetic" in e for e in entries), path, "geodetic positions without georeference")
        return
    places = np.array(
        [[e["geodetic"][k] for k in ("longitude_deg", "latitude_deg", "ellipsoidal_height_m")] for e in entries]
    ).reshape(-1, 3)
    ecef = np.stack(Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform(*places.T), -1)
    matrix = np.array(frame["ecef_from_local"])
    expected = poses[:, :3, 3] @ matrix[:3, :3].T + matrix[:3, 3]
    require_close(ecef, expected, path=path, what="a geodetic position", tolerance=GEODETIC_TOLERANCE_M)


def _check_tum(scene: Scene, path: Path) -> None:
    lines = [line.split() for line in path.read_text(encoding="ascii").splitlines() if not line.startswith("#")]
    rows = np.array([line[1:] for line in lines], dtype=np.float64).reshape(-1, 7)
    expected = scene.world_from_rig[scene.unit_registered]
    require(len(rows) == len(expected), path, f"{len(rows)} poses instead of {len(expected)}")
    # Whole microseconds: a float of seconds would round them.
    times_us = [int(line[0].replace(".", "")) for line in lines]
    require(times_us == scene.drive.timestamps_us[scene.unit_registered].tolist(), path, "a timestamp is wrong")
    poses = matrices(rows[:, 3:], rows[:, :3])
    require_close(poses, expected, path=path, what="a pose", tolerance=POSE_TOLERANCE)
