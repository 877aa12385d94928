"""Comparisons of what a result's files say with the scene that they were written of."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import combinations
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from scipy.spatial.transform import Rotation

from mrasfm_engine.export.colmap import RIG_ID, colmap_models, frame_of_image
from mrasfm_engine.export.colmap_io import ModelRead
from mrasfm_engine.export.readers import ModelImage, ModelPoints, transforms
from mrasfm_engine.export.road import DECIMALS
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.types import Floats, Ints
from schemas import DriveManifest

POSE_TOLERANCE = 1e-6  # metres, and elements of rotation matrices
QUATERNION_TOLERANCE = 1e-6  # of a length: readers normalise
GEODETIC_TOLERANCE_M = 1e-4
PLY_TOLERANCE_M = 1e-3  # coordinates are float32 up to some kilometres from the origin
ROUNDING = 1e-9  # of numbers that are written with all their digits
RELIEF_ROUNDING = 0.5001 * 10.0**-DECIMALS
GEODETIC_FIELDS = ("world_crs", "world_crs_wkt2", "height_datum", "origin", "ecef_from_local")


class Row(NamedTuple):
    """Something that a file says beside what it must say."""

    what: str
    found: Any
    expected: Any
    tolerance: float | None = None  # of arrays, absolute; without one, both must be equal

    @property
    def agrees(self) -> bool:
        """True where both are the same; NaN agrees with nothing."""
        if self.tolerance is None:
            if isinstance(self.found, np.ndarray) or isinstance(self.expected, np.ndarray):
                return bool(np.array_equal(self.found, self.expected))
            return bool(self.found == self.expected)
        found, expected = (np.asarray(v, dtype=np.float64) for v in (self.found, self.expected))
        return found.shape == expected.shape and bool((np.abs(found - expected) <= self.tolerance).all())

    @property
    def difference(self) -> str:
        """A sentence's part that names it, with the values where they are short."""
        said = f" ({self.found} instead of {self.expected})"
        return f"{self.what} is not what the scene says{said if len(said) < 200 and chr(10) not in said else ''}"


Rows = Iterator[Row]


def nothing(document: object) -> Rows:
    """No rows: it is enough that the file can be read."""
    yield from ()


def content(expected: object, found: object) -> Rows:
    """The whole content at once."""
    yield Row("its content", found, expected)


def images(scene: Scene, found: Iterator[ModelImage]) -> Rows:
    """Every image's name, pose, keypoints and the points that they observe."""
    poses, points = np.linalg.inv(_registered_poses(scene)), _points_by_keypoint(scene)
    registered = np.flatnonzero(scene.image_registered).tolist()
    missing = dict(zip(registered, poses, strict=True))
    read, expected = list[tuple[str, Sequence[float]]](), list[Floats]()
    for image in found:
        i = image.image_id - 1
        yield Row(f"image {image.image_id}", i in missing, True)
        named = (image.name, image.camera_id)
        yield Row(f"image {image.image_id}", named, (scene.drive.images[i].file, scene.drive.images[i].camera + 1))
        read.append((image.name, image.cam_from_world))
        expected.append(missing.pop(i))
        yield Row(f"a keypoint of {image.name}", image.xy_px, scene.features[i].xy_px, POSE_TOLERANCE)
        yield Row(f"a point seen in {image.name}", image.point_ids, points[i])
    numbers = np.array([pose for _, pose in read], dtype=np.float64).reshape(-1, 7)
    for k in np.flatnonzero(~(np.abs(np.linalg.norm(numbers[:, :4], axis=1) - 1.0) < QUATERNION_TOLERANCE)):
        yield Row(f"the length of the quaternion of {read[k][0]}", np.linalg.norm(numbers[k, :4]), 1.0)
    composed = transforms(np.roll(numbers[:, :4], -1, axis=1), numbers[:, 4:])
    yield from _different([f"the pose of {name}" for name, _ in read], composed, np.reshape(expected, (-1, 4, 4)))
    yield Row("what it lacks of the registered images", [scene.drive.images[i].file for i in missing], [])


def model(scene: Scene, found: ModelRead) -> Rows:
    """The poses that rigs and frames compose to, cameras, and points, as COLMAP has read them."""
    yield from _rigs_and_cameras(scene, found)
    registered = np.flatnonzero(scene.image_registered)
    posed = [number for number, image in found.images.items() if image.cam_from_world is not None]
    yield Row("images: the registered ones", sorted(found.images), (registered + 1).tolist())
    yield Row("images: those with a pose", sorted(posed), (registered + 1).tolist())
    counts, composed = np.bincount(scene.observation_image, minlength=len(scene.drive.images)), list[Floats]()
    for i in registered.tolist():
        image, source = found.images[i + 1], scene.drive.images[i]
        described = (image.name, image.camera_id, image.frame_id, image.keypoints, image.observations)
        expected = (source.file, source.camera + 1, frame_of_image(scene, i), len(scene.features[i].xy_px), counts[i])
        yield Row("images: name, camera, frame, keypoints, observations", described, expected)
        composed.append(np.asarray(image.cam_from_world))
    poses = np.reshape(composed, (-1, 3, 4))
    known = np.asarray(np.linalg.inv(_registered_poses(scene))[:, :3], dtype=np.float64)
    yield from _different(
        [f"images: the composed pose of {scene.drive.images[i].file}" for i in registered], poses, known
    )
    yield from _baselines(scene, -np.einsum("nji,nj->ni", poses[:, :, :3], poses[:, :, 3]))
    yield Row("points3D: their number", len(found.points), len(scene.points_m))
    yield Row("points3D: observations", found.observations, len(scene.observation_point))
    yield Row("the model's consistency, as COLMAP finds it,", found.is_valid, True)
    yield Row("points3D: a point", found.points, scene.points_m, POSE_TOLERANCE)


def _different(names: Sequence[str], found: Floats, expected: Floats) -> Rows:
    """Rows of the poses (n, r, 4) that are not the expected ones."""
    for k in np.flatnonzero(~(np.abs(found - expected) <= POSE_TOLERANCE).all(axis=(1, 2))).tolist():
        yield Row(names[k], found[k], expected[k], POSE_TOLERANCE)


def _rigs_and_cameras(scene: Scene, found: ModelRead) -> Rows:
    vehicles, sizes = np.unique(scene.rig_of_camera, return_counts=True)
    yield Row("rigs: the vehicles", sorted(found.rigs), (vehicles + RIG_ID).tolist())
    for vehicle, size in zip(vehicles.tolist(), sizes.tolist(), strict=True):
        rig = found.rigs[vehicle + RIG_ID]
        sensors = (rig.sensors, rig.reference_is_imu)
        yield Row("rigs: cameras and the vehicle's reference", sensors, (size + 1, True))
    models = colmap_models(scene)
    for k, (given, refined, model) in enumerate(zip(scene.drive.cameras, scene.calibration, models, strict=True)):
        camera, rig = found.cameras[k + 1], found.rigs[int(scene.rig_of_camera[k]) + RIG_ID]
        known = (camera.model, camera.size_px)
        yield Row(f"cameras: {given.name}", known, (model.model, (given.width, given.height)))
        yield Row(f"cameras: {given.name}'s params", camera.params, model.params, ROUNDING)
        expected = np.linalg.inv(refined.rig_from_cam)[:3]
        yield Row(f"rigs: {given.name}'s pose", rig.cam_from_rig[k + 1], expected, POSE_TOLERANCE)


def _baselines(scene: Scene, centres: Floats) -> Rows:
    """The distances of simultaneous cameras of one vehicle: each is the same in every unit.

    Parameters
    ----------
    centres
        (n, 3) of the registered images.
    """
    if scene.unit_from_image is not None:
        return
    registered = np.flatnonzero(scene.image_registered)
    unit = scene.image_unit[registered]
    camera = np.array([scene.drive.images[i].camera for i in registered], dtype=np.int64)
    vehicle = scene.rig_of_camera[camera]
    order = np.argsort(vehicle, kind="stable")
    for own in np.split(order, np.flatnonzero(np.diff(vehicle[order])) + 1):
        cameras, of_camera = np.unique(camera[own], return_inverse=True)
        units, of_unit = np.unique(unit[own], return_inverse=True)
        places = np.full((len(units), len(cameras), 3), np.nan)
        places[of_unit, of_camera] = centres[own]
        for a, b in combinations(range(len(cameras)), 2):
            lengths = np.linalg.norm(places[:, a] - places[:, b], axis=1)
            lengths = lengths[np.isfinite(lengths)]
            if len(lengths):
                what = f"rigs: the distance of cameras {cameras[a]} and {cameras[b]}"
                yield Row(what, float(np.ptp(lengths)), 0.0, POSE_TOLERANCE)


def points_binary(scene: Scene, found: ModelPoints) -> Rows:
    """Every point, its colour, its error and its track, to the last bit."""
    yield Row("its point ids", found.ids, np.arange(1, len(scene.points_m) + 1))
    yield Row("a point", found.xyz, scene.points_m)
    yield Row("a colour", found.colors, scene.point_colors.astype(np.float64))
    yield Row("an error", found.errors, scene.point_error_px)
    observations = (scene.observation_point + 1, scene.observation_image + 1, scene.observation_keypoint)
    yield Row("a track", found.observations, np.column_stack(observations))


def ply(scene: Scene, rows: NDArray[Any]) -> Rows:
    """Coordinates, colours, classes, patches of the road, and the sum of the tracks' lengths."""
    yield Row("a point", np.stack([rows[name] for name in "xyz"], -1), scene.points_m, PLY_TOLERANCE_M)
    colors = np.stack([rows[name] for name in ("red", "green", "blue")], -1)
    yield Row("a colour", colors, scene.point_colors)
    yield Row("a class", rows["class"], scene.point_classes)
    yield Row("a patch", rows["road_patch"], scene.point_patches)
    unit = scene.unit_component[[image.unit for image in scene.drive.images]][scene.observation_image]
    components = np.zeros(len(scene.points_m), dtype=np.int64)
    components[scene.observation_point[::-1]] = unit[::-1]
    yield Row("a component", rows["component"], components)
    yield Row("the sum of track lengths", int(rows["track_length"].sum()), len(scene.observation_point))


def road(scene: Scene, document: dict[str, Any]) -> Rows:
    """The patches and the relief of the road, and that points said to be on a patch are near its plane."""
    assert scene.road is not None
    surface, on_road = scene.road.surface, np.flatnonzero(scene.point_patches >= 0)
    centre, normal = (
        np.array([patch[key] for patch in document["patches"]], dtype=np.float64).reshape(-1, 3)
        for key in ("centre_m", "normal")
    )
    yield Row("a patch's centre", centre, surface.centre_m, ROUNDING)
    yield Row("a patch's normal", normal, surface.normal, ROUNDING)
    yield Row("a normal's length", np.linalg.norm(normal, axis=1), np.ones(len(normal)), ROUNDING)
    yield Row("the sum of the patches' points", sum(patch["points"] for patch in document["patches"]), len(on_road))
    relief = document["relief"]
    for name, given in (
        ("node_m", surface.relief.node_m),
        ("height_m", surface.relief.height_m),
        ("slope", surface.relief.slope),
        ("sigma_m", surface.relief.sigma_m),
    ):
        found = np.array(relief[name], dtype=np.float64).reshape(-1, *given.shape[1:])
        yield Row(f"the relief's {name}", found, given, RELIEF_ROUNDING)
    away = np.linalg.norm(scene.points_m[on_road] - centre[scene.point_patches[on_road]], axis=1)
    yield Row("a point near its patch", bool((away < 2 * document["patch_radius_m"]).all()), True)


def manifest(scene: Scene, found: DriveManifest) -> Rows:
    """The drive's manifest."""
    given = scene.drive.manifest
    yield Row("its list of frames", found.frames, given.frames)
    yield Row("its gnss", found.gnss, given.gnss)
    yield Row("its cameras", [c.name for c in found.rig.cameras], [c.name for c in given.rig.cameras])
    for camera, expected in zip(found.rig.cameras, given.rig.cameras, strict=True):
        # Reading a quaternion normalises it once more.
        pose, other = (
            transforms([p.rotation_xyzw], [p.translation_m]) for p in (camera.rig_from_cam, expected.rig_from_cam)
        )
        yield Row(f"{camera.name}'s pose", pose, other, POSE_TOLERANCE)


def features(scene: Scene, select: Callable[[str], Iterator[Any]]) -> Rows:
    """Ids, rows and content of every table of `features.db`; one image's or pair's are in memory at one time."""
    images = scene.drive.images
    expected = [(i + 1, image.file, image.camera + 1) for i, image in enumerate(images)]
    found = select("SELECT image_id, name, camera_id FROM images ORDER BY image_id")
    yield Row("its images", list(found), expected)
    frames = [(frame_of_image(scene, i), image.camera + 1, i + 1) for i, image in enumerate(images)]
    yield Row(
        "its frames", list(select("SELECT frame_id, sensor_id, data_id FROM frame_data ORDER BY data_id")), frames
    )
    params = [row[0] for row in select("SELECT params FROM cameras ORDER BY camera_id")]
    yield Row("its camera parameters", params, [model.params.tobytes() for model in colmap_models(scene)])
    by_image = {i: found for i, found in enumerate(scene.features, 1) if len(found.xy_px)}
    for table, column in (("keypoints", "xy_px"), ("descriptors", "descriptors")):
        rows = select(f"SELECT image_id, rows, data FROM {table}")
        yield from _table(table, rows, by_image, attrgetter(column))
    by_pair = {(pair.image_a + 1, pair.image_b + 1): pair for pair in scene.pairs}
    verified = {ids: pair for ids, pair in by_pair.items() if pair.inliers.any()}
    for table, pairs, matches_of in (
        ("matches", by_pair, lambda pair: pair.matches.astype("<u4")),
        ("two_view_geometries", verified, lambda pair: pair.matches[pair.inliers].astype("<u4")),
    ):
        rows = select(f"SELECT pair_id, rows, data FROM {table}")
        # COLMAP's pair id is the smaller image id times 2^31 - 1 plus the larger.
        yield from _table(table, ((divmod(pair_id, 2**31 - 1), *row) for pair_id, *row in rows), pairs, matches_of)


def _table(
    table: str, rows: Iterator[Any], expected: Mapping[Any, Any], array_of: Callable[[Any], NDArray[Any]]
) -> Rows:
    """Rows of (key, number, bytes) beside arrays of what has that key."""
    missing = set(expected)
    for key, count, data in rows:
        yield Row(f"{table}: the entry of {key}", key in missing, True)
        missing.remove(key)
        array = array_of(expected[key])
        yield Row(f"{table}: the number of {key}", count, len(array))
        yield Row(f"{table}: those of {key}", data or b"", array.tobytes())
    yield Row(f"{table}: the entries that it lacks", sorted(missing), [])


def frame(scene: Scene, document: dict[str, Any]) -> Rows:
    """The coordinate contract."""
    place = scene.georeference
    yield Row("georeferenced", document["georeferenced"], place is not None)
    if place is None:
        yield Row("its list of geodetic fields", [name for name in GEODETIC_FIELDS if name in document], [])
        return
    yield Row("world_crs_wkt2", CRS.from_wkt(document["world_crs_wkt2"]), CRS.from_epsg(4978))
    matrix = np.array(document["ecef_from_local"], dtype=np.float64)
    yield Row("ecef_from_local", matrix, place.ecef_from_local)
    # A point one metre above the origin shows the ellipsoid's normal; east follows from orthogonality.
    above = document["origin"] | {"ellipsoidal_height_m": document["origin"]["ellipsoidal_height_m"] + 1.0}
    base, top = _ecef([document["origin"], above])
    yield Row("the origin", matrix[:3, 3], base, GEODETIC_TOLERANCE_M)
    yield Row("the local frame's up axis", matrix[:3, 2], top - base, 1e-6)
    yield Row("its east axis", bool(abs(matrix[2, 0]) < ROUNDING and matrix[2, 1] >= -ROUNDING), True)
    rotation = matrix[:3, :3]
    yield Row("a rotation", rotation @ rotation.T, np.eye(3), ROUNDING)
    yield Row("the sign of its determinant", bool(np.linalg.det(rotation) > 0), True)


def calibration(scene: Scene, document: dict[str, Any], *, prefix: str = "") -> Rows:
    """Every camera's refined calibration, and its difference from the given one.

    Parameters
    ----------
    prefix
        What the scene puts before the names of the file's cameras.
    """
    expected = {
        camera.name.removeprefix(prefix): refined
        for camera, refined in zip(scene.drive.cameras, scene.calibration, strict=True)
        if camera.name.startswith(prefix)
    }
    yield Row("its cameras", list(document["cameras"]), list(expected))
    for name, camera in document["cameras"].items():
        given, refined = _poses([camera["given"], camera["refined"]], "rig_from_cam")
        change = camera["difference"]
        turned = Rotation.from_rotvec(np.radians(change["rotation_vector_deg"])).as_matrix() @ given[:3, :3]
        moved = given[:3, 3] + change["translation_m"]
        yield Row(f"{name}'s pose", refined, expected[name].rig_from_cam, POSE_TOLERANCE)
        yield Row(f"{name}'s difference in rotation", turned, refined[:3, :3], POSE_TOLERANCE)
        yield Row(f"{name}'s difference in translation", moved, refined[:3, 3], POSE_TOLERANCE)
        yield Row(f"{name}'s params", camera["refined"]["params"], expected[name].params, 0.0)


def poses(scene: Scene, document: dict[str, Any]) -> Rows:
    """Every unit's and image's pose and place on the earth; what is not registered has none."""
    units, images = document["units"], document["images"]
    yield Row("its files", [i["file"] for i in images], [i.file for i in scene.drive.images])
    for what, entries, key, registered, expected in (
        ("unit", units, "world_from_rig", scene.unit_registered, scene.world_from_rig[scene.unit_registered]),
        ("image", images, "world_from_cam", scene.image_registered, _registered_poses(scene)),
    ):
        yield Row(f"its list of {what}s", [e["registered"] for e in entries], registered.tolist())
        yield Row(f"which {what}s have a pose", [key in e for e in entries], registered.tolist())
        known = [e for e in entries if e["registered"]]
        yield Row(f"the pose of one {what}", _poses(known, key), expected, POSE_TOLERANCE)
        places = [e["geodetic"] for e in entries if "geodetic" in e]
        if scene.georeference is None:
            yield Row(f"geodetic positions of {what}s", places, [])
        else:
            matrix = scene.georeference.ecef_from_local
            ecef = expected[:, :3, 3] @ matrix[:3, :3].T + matrix[:3, 3]
            yield Row(f"the geodetic position of one {what}", _ecef(places), ecef, GEODETIC_TOLERANCE_M)


def tum(scene: Scene, units: Ints, found: tuple[Ints, Floats]) -> Rows:
    """The poses of `units`, in this order."""
    yield Row("a timestamp", found[0], scene.drive.timestamps_us[units])
    yield Row("a pose", found[1], scene.world_from_rig[units], POSE_TOLERANCE)


def _registered_poses(scene: Scene) -> Floats:
    """Poses (n, 4, 4) of the cameras at the registered images, composed of units, moves within them and cameras.

    `Scene.world_from_cam` says the same, and is what the writers use.
    """
    poses = []
    for i in np.flatnonzero(scene.image_registered).tolist():
        image = scene.drive.images[i]
        unit_from_image = np.eye(4) if scene.unit_from_image is None else scene.unit_from_image[i]
        poses.append(scene.world_from_rig[image.unit] @ unit_from_image @ scene.calibration[image.camera].rig_from_cam)
    return np.reshape(poses, (-1, 4, 4))


def _points_by_keypoint(scene: Scene) -> list[Ints]:
    offsets = np.cumsum([0, *(len(features.xy_px) for features in scene.features)])
    flat = np.full(offsets[-1], -1, dtype=np.int64)
    flat[offsets[scene.observation_image] + scene.observation_keypoint] = scene.observation_point + 1
    return np.split(flat, offsets[1:-1])


def _poses(entries: list[dict[str, Any]], key: str) -> Floats:
    return transforms([e[key]["rotation_xyzw"] for e in entries], [e[key]["translation_m"] for e in entries])


def _ecef(places: list[dict[str, float]]) -> Floats:
    to_ecef = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    fields = ("longitude_deg", "latitude_deg", "ellipsoidal_height_m")
    rows = np.array([[place[field] for field in fields] for place in places]).reshape(-1, 3)
    return np.stack(to_ecef.transform(*rows.T), -1)
