"""A drive without images: simulated keypoints with a descriptor for every point, and matches that are known."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mrasfm_engine.config import EngineConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.scene.drive import Drive, pose_from_matrix
from mrasfm_engine.scene.row_bands import RowBands
from mrasfm_engine.scene.scene import ImageFeatures, PairMatches
from mrasfm_engine.synthetic.rigs import mounts
from mrasfm_engine.synthetic.simulate import SimulatedObservations, simulate_observations
from mrasfm_engine.triangulation.tracks import Keypoints, build_tracks
from schemas import Camera, DriveManifest, Frame, FrameImage, Rig

FIRST_US = 1_750_000_000_000_000


@dataclass(frozen=True, kw_only=True)
class SimulatedDrive:
    """A drive, its features, and which point of the truth every keypoint shows (-1 for clutter)."""

    truth: SimulatedObservations
    drive: Drive
    features: list[ImageFeatures]
    point_of_keypoint: list[np.ndarray]

    @property
    def world_from_rig(self) -> np.ndarray:
        """The true poses."""
        return self.truth.world_from_rig


def make_drive(
    rig_from_cam: np.ndarray,
    params: np.ndarray,
    *,
    units: int,
    size_px: tuple[int, int] = (960, 540),
    names: Iterable[str] | None = None,
    present: Callable[[int, int], bool] = lambda unit, camera: True,
    time_offset_us: Sequence[int] | None = None,
    **camera_fields: Any,
) -> Drive:
    """A manifest of PINHOLE cameras without files."""
    names = list(names or (f"camera{c}" for c in range(len(rig_from_cam))))
    cameras = [
        Camera(
            name=name,
            model="PINHOLE",
            width=size_px[0],
            height=size_px[1],
            params=[float(v) for v in p],
            rig_from_cam=pose_from_matrix(pose),
            **camera_fields,
        )
        for name, p, pose in zip(names, params, rig_from_cam, strict=True)
    ]
    frames = [
        Frame(
            timestamp_us=FIRST_US + 100_000 * u,
            source_frame=u,
            images={
                n: FrameImage(
                    file=f"images/{n}/{u:06d}.png",
                    timestamp_us=None if time_offset_us is None else FIRST_US + 100_000 * u + time_offset_us[c],
                )
                for c, n in enumerate(names)
                if present(u, c)
            },
        )
        for u in range(units)
    ]
    return Drive(Path("nowhere"), DriveManifest(name="simulated", rig=Rig(cameras=cameras), frames=frames))


def make_simulated_drive(
    *,
    units: int = 12,
    cameras: int = 6,
    points: int = 1500,
    noise_px: float = 0.4,
    clutter: int = 20,
    straight: bool = False,
    radius_m: float | None = None,
    spacing_m: float = 1.1,
    given: Callable[[np.ndarray], np.ndarray] = lambda rig_from_cam: rig_from_cam,
    hidden: Callable[[int, int], bool] = lambda unit, camera: False,
    time_offset_ms: Sequence[int] | None = None,
    late_ms: Sequence[int] | None = None,
    readout_ms: int = 0,
    travelled_m: np.ndarray | None = None,
    seed: int = 0,
) -> SimulatedDrive:
    """Images of (unit, camera) for which `hidden` says True have no keypoints; `given` is what the manifest says.

    Cameras take their images `time_offset_ms` after the units' timestamps, and `late_ms` after their own.
    """
    stamped_ms = None if time_offset_ms is None else np.subtract(time_offset_ms, late_ms or [0] * cameras).tolist()
    rng = np.random.default_rng(seed)
    truth = simulate_observations(
        units=units,
        cameras=cameras,
        points=points,
        noise_px=noise_px,
        straight=straight,
        radius_m=radius_m,
        spacing_m=spacing_m,
        time_offset_s=0.0 if time_offset_ms is None else np.array(time_offset_ms) / 1e3,
        readout_s=readout_ms / 1e3,
        travelled_m=travelled_m,
        rng=rng,
    )
    drive = make_drive(
        given(truth.rig_from_cam.copy()),
        truth.camera_params,
        units=units,
        size_px=truth.image_size_px,
        names=[m.name for m in mounts(cameras)],
        time_offset_us=None if stamped_ms is None else [1000 * ms for ms in stamped_ms],
        readout_us=1000 * readout_ms or None,
    )
    descriptors = random_descriptors(len(truth.points_m), rng)
    features, point_of_keypoint = [], []
    for image in drive.images:
        rows = np.flatnonzero((truth.unit == image.unit) & (truth.camera == image.camera))
        rows = rng.permutation(rows) if not hidden(image.unit, image.camera) else rows[:0]
        extra = 0 if hidden(image.unit, image.camera) else clutter
        xy = np.concatenate([truth.xy_px[rows], rng.uniform(0, 1, (extra, 2)) * truth.image_size_px])
        noisy = descriptors[truth.point[rows]].astype(int) + rng.integers(-6, 7, (len(rows), 128))
        features.append(
            ImageFeatures(
                xy_px=xy.astype(np.float32),
                descriptors=np.concatenate([noisy.clip(0, 255).astype(np.uint8), random_descriptors(extra, rng)]),
                colors=np.full((len(xy), 3), 128, np.uint8),
            )
        )
        point_of_keypoint.append(np.concatenate([truth.point[rows], np.full(extra, -1)]).astype(np.int64))
    return SimulatedDrive(truth=truth, drive=drive, features=features, point_of_keypoint=point_of_keypoint)


def with_lorry(
    simulated: SimulatedDrive,
    covered: Callable[[int, int], bool],
    *,
    keypoints: int = 200,
    left: float = 0.1,
    noise_px: float = 0.3,
    seed: int = 1,
) -> SimulatedDrive:
    """A lorry with its own texture drives along: images of (unit, camera) for which `covered` says True show the same
    keypoints at the same pixels, and only a share `left` of the world."""
    rng = np.random.default_rng(seed)
    width, height = simulated.truth.image_size_px
    cameras = len(simulated.drive.cameras)
    places = rng.uniform(0.03, 0.97, (cameras, keypoints, 2)) * [width, height]
    texture = random_descriptors(cameras * keypoints, rng).reshape(cameras, keypoints, 128)
    first = len(simulated.truth.points_m)  # points of lorries come after those of the world
    features, points = [], []
    for image, old, of in zip(simulated.drive.images, simulated.features, simulated.point_of_keypoint, strict=True):
        if not covered(image.unit, image.camera):
            features.append(old)
            points.append(of)
            continue
        seen = np.flatnonzero(rng.random(len(of)) < left)
        xy = places[image.camera] + rng.normal(0, noise_px, (keypoints, 2))
        features.append(
            ImageFeatures(
                xy_px=np.concatenate([old.xy_px[seen], xy.astype(np.float32)]),
                descriptors=np.concatenate([old.descriptors[seen], texture[image.camera]]),
                colors=np.full((len(seen) + keypoints, 3), 128, np.uint8),
            )
        )
        own = first + image.camera * keypoints + np.arange(keypoints)
        points.append(np.concatenate([of[seen], own]).astype(np.int64))
    return replace(simulated, features=features, point_of_keypoint=points)


def random_descriptors(count: int, rng: np.random.Generator) -> np.ndarray:
    """Descriptors (count, 128) of length about 512 that are little alike."""
    d = rng.exponential(size=(count, 128))
    return np.clip(512 * d / np.linalg.norm(d, axis=1, keepdims=True), 0, 255).astype(np.uint8)


def true_matches(
    simulated: SimulatedDrive, *, window: int = 3, min_matches: int = 15, wrong: int = 0, seed: int = 0
) -> list[PairMatches]:
    """Matches of all image pairs up to `window` units apart that share points; `wrong` more in each are mismatched."""
    rng = np.random.default_rng(seed)
    images, result, points = simulated.drive.images, [], simulated.point_of_keypoint
    by_point = [np.argsort(of)[np.count_nonzero(of < 0) :] for of in points]  # keypoints of each image
    keypoint_a = np.full(1 + max(int(of.max(initial=0)) for of in points), -1)  # of every point in image a
    for a in range(len(images)):
        of_a = points[a]
        keypoint_a[:] = -1
        keypoint_a[of_a[by_point[a]]] = by_point[a]
        for b in range(a + 1, len(images)):
            if images[b].unit - images[a].unit > window:
                break
            of_b = points[b]
            i = keypoint_a[of_b[by_point[b]]]
            i, j = i[i >= 0], by_point[b][i >= 0]
            if len(i) < min_matches:
                continue
            k = min(wrong, len(i))
            i = np.concatenate([i, rng.integers(0, len(of_a), k)])
            j = np.concatenate([j, rng.integers(0, len(of_b), k)])
            result.append(
                PairMatches(
                    image_a=a,
                    image_b=b,
                    matches=np.stack([i, j], 1).astype(np.int32),
                    inliers=np.ones(len(i), dtype=np.bool_),
                )
            )
    return result


def make_model(
    simulated: SimulatedDrive, pairs: list[PairMatches] | None = None, config: EngineConfig | None = None
) -> Mapper:
    """A model of the drive without any pose, one thread."""
    config = config or EngineConfig(threads=1)
    keypoints = keypoints_of(simulated, config)
    tracks = build_tracks(keypoints, true_matches(simulated) if pairs is None else pairs)
    return Mapper(simulated.drive, keypoints, tracks, config)


def keypoints_of(simulated: SimulatedDrive, config: EngineConfig) -> Keypoints:
    """The drive's keypoints at the times that the settings give them."""
    bands = RowBands.from_drive(simulated.drive, compensate=config.mapping.motion_compensation)
    return Keypoints.from_features(simulated.drive, simulated.features, bands)


def with_true_poses(mapper: Mapper, simulated: SimulatedDrive, units: Iterable[int]) -> Mapper:
    """The model with some units at their true poses, and the points these see."""
    for u in units:
        mapper.set_pose(u, simulated.world_from_rig[u])
    mapper.renew_motion()
    mapper.triangulate()
    return mapper


def shown_points(mapper: Mapper, simulated: SimulatedDrive) -> np.ndarray:
    """The true point (tracks,) of every track; -1 for one of nothing."""
    first = mapper.tracks.keypoints[mapper.tracks.first[:-1]]
    result: np.ndarray = np.concatenate(simulated.point_of_keypoint)[first]
    return result


def metric_errors_m(mapper: Mapper, simulated: SimulatedDrive) -> np.ndarray:
    """Distances (registered units,) after a rigid alignment, without scale, by positions and rotations."""
    units = np.flatnonzero(mapper.registered)
    own, true = mapper.state.world_from_rig[units], simulated.world_from_rig[units]
    turn = se3.mean_rotation(true[:, :3, :3] @ np.swapaxes(own[:, :3, :3], 1, 2))
    moved = own[:, :3, 3] @ turn.T
    moved = moved + (true[:, :3, 3] - moved).mean(0)
    return np.linalg.norm(moved - true[:, :3, 3], axis=1)


def rmse(errors: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(errors**2)))


def scaled_rig(rig_from_cam: np.ndarray, scale: float) -> np.ndarray:
    """All cameras `scale` times as far from the rig's origin."""
    result = rig_from_cam.copy()
    result[:, :3, 3] *= scale
    return result


def inverted(rig_from_cam: np.ndarray) -> np.ndarray:
    """The mistake of the trade: cam_from_rig where rig_from_cam is asked for."""
    return se3.inverse(rig_from_cam)


def with_cameras(simulated: SimulatedDrive, cameras: Sequence[Camera]) -> SimulatedDrive:
    """The same drive, whose manifest has other cameras."""
    manifest = simulated.drive.manifest
    rig = manifest.rig.model_copy(update={"cameras": list(cameras)})
    return replace(simulated, drive=replace(simulated.drive, manifest=manifest.model_copy(update={"rig": rig})))


def enlarged(simulated: SimulatedDrive, factor: int) -> SimulatedDrive:
    """The same drive by sensors of `factor` times as many pixels a side: so is everything that pixels measure."""
    truth = simulated.truth
    cameras = [
        c.model_copy(
            update={"width": factor * c.width, "height": factor * c.height, "params": [factor * v for v in c.params]}
        )
        for c in simulated.drive.cameras
    ]
    return replace(
        with_cameras(simulated, cameras),
        truth=replace(
            truth,
            camera_params=factor * truth.camera_params,
            xy_px=factor * truth.xy_px,
            image_size_px=(factor * truth.image_size_px[0], factor * truth.image_size_px[1]),
        ),
        features=[replace(f, xy_px=(factor * f.xy_px).astype(np.float32)) for f in simulated.features],
    )


def with_lens_errors(
    simulated: SimulatedDrive, off_px: float, *, seed: int = 0, parameters: Sequence[int] = range(8)
) -> SimulatedDrive:
    """The manifest's lenses are off: each parameter of each lens moves what images show by `off_px`, RMS.

    Parameters
    ----------
    parameters
        Places among fx, fy, cx, cy, k1, k2, p1, p2; the others are right.
    """
    rng = np.random.default_rng(seed)
    is_off = np.isin(np.arange(8), parameters)
    cameras = simulated.drive.cameras
    return with_cameras(simulated, [_with_lens_error(c, off_px * rng.normal(size=8) * is_off) for c in cameras])


def _with_lens_error(camera: Camera, off_px: np.ndarray) -> Camera:
    """A pinhole whose parameters are off by as much as moves pixels by `off_px` (8,), RMS over its image."""
    fx, fy, cx, cy = camera.params
    grid = np.meshgrid(np.linspace(0, camera.width, 20), np.linspace(0, camera.height, 12))
    x, y = (grid[0].ravel() - cx) / fx, (grid[1].ravel() - cy) / fy
    r2, zero, one = x**2 + y**2, np.zeros_like(x), np.ones_like(x)
    moved = [
        (x, zero), (zero, y), (one, zero), (zero, one),
        (x * r2, y * r2), (x * r2**2, y * r2**2), (2 * x * y, r2 + 2 * y**2), (r2 + 2 * x**2, 2 * x * y),
    ]  # fmt: skip
    off = off_px / [np.sqrt(np.mean(a**2 + b**2)) for a, b in moved]
    params = [fx + off[0], fy + off[1], cx + off[2], cy + off[3], *(off[4:] / fx)]
    return camera.model_copy(update={"model": "OPENCV", "params": [float(value) for value in params]})
