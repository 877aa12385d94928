"""Scenes of drives along one simulated street, without images: what they have in common is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mrasfm_engine import __version__
from mrasfm_engine.aggregation.load import read_scene
from mrasfm_engine.aggregation.scene_matching import CrossMatches
from mrasfm_engine.aggregation.source import SourceScene
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.export.calibration import ONLY_PRIOR
from mrasfm_engine.export.scene import write_scene
from mrasfm_engine.geometry import geodesy, se3
from mrasfm_engine.scene.drive import Drive, pose_from_matrix
from mrasfm_engine.scene.scene import CalibrationObservability, CameraCalibration, Georeference, ImageFeatures, Scene
from mrasfm_engine.synthetic.rigs import mounts, true_cameras
from mrasfm_engine.synthetic.simulate import poses_along, simulate_observations
from schemas import Gnss, GnssSample, RoughPose, RoughTrajectory
from tests.helpers.simulated_drive import FIRST_US, make_drive, random_descriptors

PLACE = (48.1, 11.5, 520.0)  # origin of the street's frame, east-north-up
ANTENNA_M = (0.4, 0.1, 1.9)
SIZE_PX = (640, 400)
MAX_DEPTH_M = 35.0
STEP_US = 100_000
TURNED = se3.transform(se3.exp_so3([0.0, 0.0, np.pi]), np.zeros(3))
REPORT = {"engine_version": __version__, "settings": {"features": {"extractor": "sift"}}}
CONFIG = EngineConfig(threads=1)


@dataclass(frozen=True, kw_only=True)
class Street:
    """Points beside a street, with a look of their own each."""

    points_m: np.ndarray  # (n, 3)
    descriptors: np.ndarray  # (n, 128)
    ecef_from_street: np.ndarray  # (4, 4)


def make_street(*, length_m: float = 24.0, points: int = 1500, place: Sequence[float] = PLACE, seed: int = 0) -> Street:
    rng = np.random.default_rng(seed)
    units = round(length_m) + 1
    found = simulate_observations(units=units, cameras=4, points=points, spacing_m=1.0, noise_px=0.0, rng=rng)
    return Street(
        points_m=found.points_m,
        descriptors=random_descriptors(len(found.points_m), rng),
        ecef_from_street=geodesy.ecef_from_local(place),
    )


@dataclass(frozen=True, kw_only=True)
class Driven:
    """A scene, and the truth about it."""

    source: SourceScene
    street_from_scene: np.ndarray  # (4, 4)
    street_from_rig: np.ndarray  # (u, 4, 4)
    point_of_street: np.ndarray  # (p,) which one each of the scene's points is
    folder: Path
    seed: int


def drive_along(
    street: Street,
    folder: Path,
    travelled_m: np.ndarray,
    *,
    cameras: int = 4,
    lateral_m: float = 0.0,
    back: bool = False,
    bias_m: Sequence[float] = (0.0, 0.0, 0.0),
    gnss_noise_m: float = 0.05,
    noise_px: float = 0.4,
    bend_m: float = 0.0,
    scale: float = 1.0,
    offset_ms: Sequence[int] | None = None,
    common_world: str | None = None,
    missing_units: Sequence[int] = (),
    cameras_off_deg: float | None = None,
    own_frame: np.ndarray | None = None,
    component: int = 0,
    vehicle: str | None = None,
    rig_seed: int | None = None,
    knocked_deg: dict[int, float] | None = None,
    seed: int = 0,
) -> Driven:
    """Drive, write the scene, and read it as an aggregation does.

    `bias_m` is the receiver's constant error, `bend_m` by how much the scene's ends are bent aside, `scale` its lengths
    in true ones, `offset_ms` when each camera takes its image after its unit's time. With `cameras_off_deg` the scene
    refined its calibration, and is so uncertain about rotations, and so far off. Without a receiver the scene lies in
    `own_frame`, street_from_scene (4, 4). Drives of one `rig_seed` have the same cameras, but for those that were
    knocked by an angle.
    """
    rng = np.random.default_rng(1000 + seed)
    of_rig = rng if rig_seed is None else np.random.default_rng(1000 + rig_seed)
    rig = true_cameras(cameras, width=SIZE_PX[0], height=SIZE_PX[1], rng=of_rig)
    rig_from_cam = np.stack([camera.rig_from_cam for camera in rig])
    for camera, by_deg in (knocked_deg or {}).items():
        rig_from_cam[camera, :3, :3] = se3.exp_so3(np.radians([0.0, by_deg, 0.0])) @ rig_from_cam[camera, :3, :3]
    params = np.array([camera.params for camera in rig])
    aside = (TURNED if back else np.eye(4)) @ se3.transform(np.eye(3), [0.0, lateral_m, 0.0])
    street_from_rig = poses_along(travelled_m) @ aside
    units = len(travelled_m)
    speed = np.gradient(travelled_m)  # a unit's time
    offsets = np.zeros(cameras) if offset_ms is None else np.array(offset_ms) * 1e3 / STEP_US
    then = (travelled_m[:, None] + speed[:, None] * offsets).ravel()
    street_from_band = (poses_along(then) @ aside).reshape(units, cameras, 4, 4)

    middle = street_from_rig[units // 2, :3, 3] + bias_m
    biased = geodesy.geodetic_from_local(middle, street.ecef_from_street)
    ecef_from_scene = geodesy.ecef_from_local(biased)
    believed = se3.inverse(street.ecef_from_street) @ ecef_from_scene
    if common_world is not None:
        believed = se3.transform(np.eye(3), np.round(middle))
    if own_frame is not None:
        believed = own_frame
    street_from_scene = se3.transform(np.eye(3), -np.asarray(bias_m)) @ believed
    scene_from_street = se3.inverse(street_from_scene)

    street_from_cam = (street_from_band @ rig_from_cam).reshape(-1, 4, 4)
    seen, xy = _projected(street.points_m, street_from_cam, np.tile(params, (units, 1)))
    registered = ~np.isin(np.arange(units), list(missing_units))
    seen &= np.repeat(registered, cameras)[:, None]
    kept = np.flatnonzero(seen.sum(0) >= 2)
    image, row = np.nonzero(seen[:, kept])
    xy_px = (xy[:, kept][image, row] + rng.normal(0.0, noise_px, (len(image), 2))).astype(np.float32)
    points = _triangulated(street_from_cam, np.tile(params, (units, 1)), image, row, xy_px, len(kept))
    sane = np.linalg.norm(points - street.points_m[kept], axis=1) < 2.0
    kept, points, fine = kept[sane], points[sane], sane[row]
    image, row, xy_px = image[fine], (np.cumsum(sane) - 1)[row[fine]], xy_px[fine]

    poses, points = _bent(street_from_rig, points, bend_m)
    poses, points = scene_from_street @ poses, se3.apply(scene_from_street, points)
    poses[:, :3, 3] *= scale
    rig_in_scene = rig_from_cam.copy()
    rig_in_scene[:, :3, 3] *= scale
    unit_from_image = (se3.inverse(street_from_rig)[:, None] @ street_from_band).reshape(-1, 4, 4)
    unit_from_image[:, :3, 3] *= scale
    poses[~registered] = np.nan

    if cameras_off_deg is not None:
        turn = np.radians(cameras_off_deg) * np.random.default_rng(seed).normal(size=(cameras, 3))
        rig_in_scene[:, :3, :3] = se3.exp_so3(turn - turn.mean(0)) @ rig_in_scene[:, :3, :3]
    drive = make_drive(
        rig_in_scene,
        params,
        units=units,
        size_px=SIZE_PX,
        names=[m.name for m in mounts(cameras)],
        time_offset_us=None if offset_ms is None else [1000 * ms for ms in offset_ms],
    )
    positions: dict[str, object] = {}
    if own_frame is not None:
        pass
    elif common_world is None:
        antenna = se3.apply(street_from_rig, np.tile(ANTENNA_M, (units, 1, 1)))[:, 0] + bias_m
        antenna += rng.normal(0.0, gnss_noise_m, antenna.shape)
        positions["gnss"] = _gnss(geodesy.geodetic_from_local(antenna, street.ecef_from_street), gnss_noise_m)
    else:
        positions["rough_poses"] = _rough(street_from_rig, np.asarray(bias_m), common_world)
    manifest = drive.manifest.model_copy(update={"name": folder.name, "version": 2, "vehicle": vehicle, **positions})
    features, keypoint = _features(street, kept[row], image, xy_px, units * cameras, rng)
    order = np.argsort(row, kind="stable")
    scene = Scene(
        drive=Drive(Path("nowhere"), manifest),
        unit_registered=registered,
        image_registered=np.repeat(registered, cameras),
        world_from_rig=poses,
        sigma_position_m=np.where(registered[:, None], 0.01, np.nan) * np.ones(3),
        calibration=[
            CameraCalibration(
                rig_from_cam=pose,
                params=p,
                sigma_rotation_deg=np.full(3, 3.0 * (cameras_off_deg or 0.1)),  # with what drives of a vehicle share
                sigma_translation_m=np.full(3, 0.03),
                repeatability_rotation_deg=np.full(3, cameras_off_deg or 0.1),
                repeatability_translation_m=np.full(3, 0.01),
                sigma_focal_px=1.0,
                observed=np.repeat([True, False], 3),
            )
            for pose, p in zip(rig_in_scene, params, strict=True)
        ],
        points_m=scale * points,
        calibration_observability=CalibrationObservability(
            adjusted=cameras_off_deg is not None,
            reason="",
            scale_observed=False,
            scale_rests_on=ONLY_PRIOR,
            sigma_scale=np.nan,
        ),
        point_colors=np.full((len(points), 3), 128, np.uint8),
        point_error_px=np.full(len(points), noise_px),
        observation_point=row[order],
        observation_image=image[order],
        observation_keypoint=keypoint[order],
        features=features,
        pairs=[],
        georeference=None if positions.keys() != {"gnss"} else _georeference(biased, ecef_from_scene),
        rough_world_from_local=None if common_world is None else believed,
        unit_from_image=unit_from_image if offset_ms is not None else None,
    )
    write_scene(scene, folder, {**REPORT, "component": component} if component else REPORT)
    return Driven(
        source=read_scene(folder, folder.name),
        street_from_scene=street_from_scene,
        street_from_rig=street_from_rig,
        point_of_street=kept,
        folder=folder,
        seed=seed if rig_seed is None else rig_seed,
    )


def _projected(points: np.ndarray, street_from_cam: np.ndarray, params: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which image sees which point (i, p), and where (i, p, 2)."""
    local = se3.apply(se3.inverse(street_from_cam), points)
    depth = np.where(local[..., 2] > 0.5, local[..., 2], np.inf)
    xy = local[..., :2] / depth[..., None] * params[:, None, :2] + params[:, None, 2:]
    inside = ((xy > 0) & (xy < np.array(SIZE_PX))).all(-1)
    return inside & (depth < MAX_DEPTH_M), xy


def _triangulated(
    street_from_cam: np.ndarray, params: np.ndarray, image: np.ndarray, point: np.ndarray, xy: np.ndarray, count: int
) -> np.ndarray:
    """Points nearest to their rays, by their angles."""
    rays = np.concatenate([(xy - params[image, 2:]) / params[image, :2], np.ones((len(xy), 1))], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rays = np.einsum("nij,nj->ni", street_from_cam[image, :3, :3], rays)
    origin, weight = street_from_cam[image, :3, 3], np.ones(len(rays))
    for _ in range(2):
        off = (np.eye(3) - rays[:, :, None] * rays[:, None]) * weight[:, None, None]
        square, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
        np.add.at(square, point, off)
        np.add.at(right, point, np.einsum("nij,nj->ni", off, origin))
        result = np.linalg.solve(square + 1e-12 * np.eye(3), right[..., None])[..., 0]
        weight = 1.0 / ((result[point] - origin) ** 2).sum(1).clip(0.25)
    return result


def _bent(poses: np.ndarray, points: np.ndarray, bend_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Poses and points with the ends of the way bent to its left: a motion that is rigid to first order everywhere."""
    ends = poses[[0, -1], :3, 3]
    half = max(0.5 * float(np.linalg.norm(ends[1] - ends[0])), 1e-9)
    ahead = (ends[1] - ends[0]) / (2 * half)
    left = np.cross([0.0, 0.0, 1.0], ahead)

    def moved(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        along = (x - ends.mean(0)) @ ahead / half
        turn = 2 * bend_m * along / half
        aside = (x - ends.mean(0)) @ left
        return x + (bend_m * along**2)[:, None] * left - (turn * aside)[:, None] * ahead, turn

    position, turn = moved(poses[:, :3, 3])
    return se3.transform(se3.exp_so3(turn[:, None] * [0.0, 0.0, 1.0]) @ poses[:, :3, :3], position), moved(points)[0]


def _gnss(geodetic: np.ndarray, sigma_m: float) -> Gnss:
    return Gnss(
        height_datum="ellipsoidal",
        antenna_in_rig_m=list(ANTENNA_M),
        samples=[
            GnssSample(
                timestamp_us=FIRST_US + STEP_US * k,
                latitude_deg=float(latitude),
                longitude_deg=float(longitude),
                height_m=float(height),
                sigma_horizontal_m=sigma_m,
                sigma_vertical_m=2 * sigma_m,
            )
            for k, (latitude, longitude, height) in enumerate(geodetic)
        ],
    )


def _rough(street_from_rig: np.ndarray, bias_m: np.ndarray, common_world: str) -> RoughTrajectory:
    shift = se3.transform(np.eye(3), bias_m)
    poses = [
        RoughPose(timestamp_us=FIRST_US + STEP_US * k, world_from_rig=pose_from_matrix(shift @ pose))
        for k, pose in enumerate(street_from_rig)
    ]
    return RoughTrajectory(poses=poses, common_world=common_world)


def _georeference(origin: np.ndarray, ecef_from_local: np.ndarray) -> Georeference:
    return Georeference(
        origin_latitude_deg=float(origin[0]),
        origin_longitude_deg=float(origin[1]),
        origin_ellipsoidal_height_m=float(origin[2]),
        height_datum="ellipsoidal",
        ecef_from_local=ecef_from_local,
    )


def _features(
    street: Street, point: np.ndarray, image: np.ndarray, xy_px: np.ndarray, images: int, rng: np.random.Generator
) -> tuple[list[ImageFeatures], np.ndarray]:
    """Keypoints of all images in random order, among them some clutter; and where each observation is in its image."""
    features, place, clutter = [], np.zeros(len(point), dtype=np.int64), 8
    for i in range(images):
        rows = np.flatnonzero(image == i)
        spot = rng.permutation(len(rows) + clutter)
        place[rows] = spot[: len(rows)]
        noisy = street.descriptors[point[rows]].astype(int) + rng.integers(-5, 6, (len(rows), 128))
        xy = np.empty((len(spot), 2), np.float32)
        descriptors = np.empty((len(spot), 128), np.uint8)
        xy[spot] = np.concatenate([xy_px[rows], rng.uniform(1, SIZE_PX[1] - 1, (clutter, 2))])
        descriptors[spot] = np.concatenate([noisy.clip(0, 255), random_descriptors(clutter, rng)])
        features.append(ImageFeatures(xy_px=xy, descriptors=descriptors, colors=np.full((len(xy), 3), 128, np.uint8)))
    return features, place


def true_a_from_b(a: Driven, b: Driven) -> np.ndarray:
    return se3.inverse(a.street_from_scene) @ b.street_from_scene


def off(found: np.ndarray, truth: np.ndarray, at_m: np.ndarray) -> tuple[float, float]:
    """By how much (m, deg) a transform is wrong at a place (3,)."""
    shift = np.linalg.norm(se3.apply(found, at_m[None]) - se3.apply(truth, at_m[None]))
    return float(shift), float(se3.rotation_angle_deg(found[:3, :3] @ truth[:3, :3].T))


def noisy(pose: np.ndarray, rng: np.random.Generator, *, m: float, deg: float) -> np.ndarray:
    return pose @ se3.transform(se3.exp_so3(np.radians(deg) * rng.normal(size=3)), m * rng.normal(size=3))


def shared_points(a: Driven, b: Driven) -> np.ndarray:
    """Points (n, 2) of both scenes that are one."""
    _, of_a, of_b = np.intersect1d(a.point_of_street, b.point_of_street, return_indices=True)
    return np.column_stack([of_a, of_b]).astype(np.int64)


def true_matches(a: Driven, b: Driven) -> CrossMatches:
    """One keypoint of each scene for every point that they share."""
    pairs = shared_points(a, b)
    first_a, first_b = (_first_keypoints(driven.source) for driven in (a, b))
    return CrossMatches(a=first_a[pairs[:, 0]], b=first_b[pairs[:, 1]])


def _first_keypoints(scene: SourceScene) -> np.ndarray:
    """A keypoint (p,) of every point."""
    rows = np.flatnonzero(scene.keypoint_point >= 0)
    first: np.ndarray = rows[np.unique(scene.keypoint_point[rows], return_index=True)[1]]
    return first


def in_assembly(pairs: np.ndarray, a: Driven) -> np.ndarray:
    """Pairs of points (n, 2) as an assembly of two scenes, a first, numbers them."""
    return pairs + np.array([0, len(a.source.points_m)])


def with_noise(scene: SourceScene, rng: np.random.Generator, sigma_px: float) -> SourceScene:
    """The scene with its keypoints measured anew."""
    added = rng.normal(0.0, sigma_px, scene.keypoint_xy_px.shape)
    return replace(scene, keypoint_xy_px=(scene.keypoint_xy_px + added).astype(np.float32))


def configured(**aggregation: object) -> EngineConfig:
    """The defaults with other settings of the aggregation, on one thread."""
    return EngineConfig.model_validate({"threads": 1, "aggregation": aggregation})
