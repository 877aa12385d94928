"""A drive without images, with the features and matches that its stages would have left."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mrasfm_engine.benchmark.simulated_matches import simulate_matches
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import storage_error
from mrasfm_engine.preflight.drive_reader import read_drive, write_manifest
from mrasfm_engine.scene.drive import Drive, pose_from_matrix
from mrasfm_engine.scene.scene import ImageFeatures, PairMatches
from mrasfm_engine.stages import pack_pairs, unpack_pairs
from mrasfm_engine.synthetic.long_route import LongRoute, simulate_long_route
from mrasfm_engine.types import Floats, Floats32, StageProgress
from schemas import Camera, DriveManifest, Frame, FrameImage, Rig

ARRAYS = "simulated.npz"
FIRST_US, INTERVAL_US = 1_750_000_000_000_000, 100_000
GREY = 128  # nobody looks at the points' colours


@dataclass(frozen=True, kw_only=True)
class SimulatedDrive:
    """Input of mapping, and the truth. Keypoints have no descriptors: they are matched already."""

    drive: Drive
    features: list[ImageFeatures]
    pairs: list[PairMatches]
    world_from_rig: Floats  # (units, 4, 4)


def simulate_drive(
    rig: str, units: int, seed: int, config: EngineConfig, folder: Path, *, progress: StageProgress
) -> SimulatedDrive:
    """Simulate a long route (see `simulate_long_route`) and its matches; the calibration is given exactly.

    Parameters
    ----------
    folder
        Where the drive will be kept.
    """
    route = simulate_long_route(rig, units, seed=seed, progress=lambda done, total: progress("route", done, total))
    drive = drive_of_route(rig, route, folder)
    pairs = simulate_matches(
        drive,
        route,
        config,
        np.random.default_rng([seed, units]),
        progress=lambda done, total: progress("matches", done, total),
    )
    return SimulatedDrive(
        drive=drive,
        features=[_features(xy_px) for xy_px in route.xy_px],
        pairs=pairs,
        world_from_rig=route.world_from_rig,
    )


def drive_of_route(rig: str, route: LongRoute, folder: Path) -> Drive:
    """The drive that a route's cameras would have recorded into a folder."""
    return Drive(folder, _manifest(rig, route))


def _manifest(rig: str, route: LongRoute) -> DriveManifest:
    cameras = [
        Camera(
            name=camera.name,
            model=camera.model,
            width=camera.width,
            height=camera.height,
            params=list(camera.params),
            rig_from_cam=pose_from_matrix(camera.rig_from_cam),
        )
        for camera in route.cameras
    ]
    frames = [
        Frame(
            timestamp_us=FIRST_US + INTERVAL_US * unit,
            source_frame=unit,
            images={c.name: FrameImage(file=f"images/{c.name}/{unit:06d}.png") for c in cameras},
        )
        for unit in range(len(route.world_from_rig))
    ]
    return DriveManifest(name=f"simulated-{rig}-{len(frames)}", rig=Rig(cameras=cameras), frames=frames)


def _features(xy_px: Floats32) -> ImageFeatures:
    return ImageFeatures(
        xy_px=xy_px,
        descriptors=np.zeros((len(xy_px), 0), np.uint8),
        colors=np.full((len(xy_px), 3), GREY, np.uint8),
    )


def save(simulated: SimulatedDrive) -> None:
    """Write the drive into its folder.

    Raises
    ------
    StorageError
        Where it cannot be written.
    """
    file = simulated.drive.root / ARRAYS
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savez(
            file,
            counts=np.array([len(f.xy_px) for f in simulated.features], dtype=np.int64),
            xy_px=np.concatenate([f.xy_px for f in simulated.features]),
            world_from_rig=simulated.world_from_rig,
            **pack_pairs(simulated.pairs),  # type: ignore[arg-type]
        )
    except OSError as error:
        raise storage_error(file, error) from error
    write_manifest(simulated.drive.manifest, file.parent)


def load(folder: Path) -> SimulatedDrive:
    """Read what `save` wrote."""
    with np.load(folder / ARRAYS) as archive:
        arrays = {name: archive[name] for name in archive.files}
    return SimulatedDrive(
        drive=read_drive(folder),
        features=[_features(xy_px) for xy_px in np.split(arrays["xy_px"], np.cumsum(arrays["counts"])[:-1])],
        pairs=unpack_pairs(arrays),
        world_from_rig=arrays["world_from_rig"],
    )
