"""COLMAP's own mappers on the features and matches of a scene, to compare with side by side."""

from __future__ import annotations

import math
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from mrasfm_engine.errors import InputError
from mrasfm_engine.evaluation.trajectory import TrajectoryErrors, compare_known
from mrasfm_engine.geometry import se3
from mrasfm_engine.subprocess_run import memory_bytes, run_in_subprocess
from mrasfm_engine.types import Bools, Floats, StageProgress

# Of the pair that the incremental mapper begins with. Cameras that look ahead have few that reach COLMAP's 16 deg, and
# where its own relaxation finds none either, it begins again with this.
SMALL_INITIAL_ANGLE_DEG = 4.0


class Baseline(StrEnum):
    """COLMAP's mappers, with free or fixed calibration."""

    GLOBAL = "global"  # its defaults: focal lengths and poses of the cameras vary
    GLOBAL_FIXED_CALIBRATION = "global, calibration fixed"
    INCREMENTAL = "incremental"  # its defaults, the same
    INCREMENTAL_FIXED_CALIBRATION = "incremental, calibration fixed"


@dataclass(frozen=True, kw_only=True)
class PeerResult:
    """Reconstruction of a scene's matches by a baseline method.

    Attributes
    ----------
    seconds
        Of mapping alone, from the database to the model; NaN where there is no model. Of a search for an initial pair
        that finds none, only what follows it.
    registered_images
        Of the largest model, where there are several.
    world_from_rig
        Poses (units, 4, 4) in that model's own world; NaN for units that are not in it.
    failure
        Why there is no model; empty where there is one.
    peak_memory_bytes, start_memory_bytes
        What its process had resident at most, and before it began to map; None where that is not known.
    """

    mapper: Baseline
    seconds: float
    registered_images: int
    world_from_rig: Floats
    failure: str = ""
    peak_memory_bytes: int | None = None
    start_memory_bytes: int | None = None

    @property
    def registered(self) -> Bools:
        """Units (n,) that the model holds."""
        result: Bools = np.isfinite(self.world_from_rig[:, 0, 0])
        return result

    def errors(self, truth_world_from_rig: Floats) -> TrajectoryErrors | None:
        """Errors over the registered units against the truth (units, 4, 4), NaN where there is none; None for fewer
        than three of them."""
        return compare_known(self.world_from_rig, truth_world_from_rig[: len(self.world_from_rig)])


def run_baseline(
    database: Path,
    mapper: Baseline,
    *,
    threads: int,
    unit_of_image: Mapping[str, int] | None = None,
    timeout_s: float = 3600.0,
    cancel: Callable[[], bool] = lambda: False,
) -> PeerResult:
    """Run one mapper on a copy of a scene's `features.db`, in a process of its own because COLMAP may abort it.

    Parameters
    ----------
    database
        As `export.scene` writes it: with the rig, and verified matches.
    unit_of_image
        By image name. Without, every frame of the database is a unit; images that are not simultaneous have frames of
        their own there, and are taken as simultaneous here.

    Raises
    ------
    InputError
        Where there is no such file.
    CancelledError
        Where `cancel` answers True.
    """
    if not database.is_file():
        raise InputError(f"{database} does not exist", remedy="Give the features.db of a scene.")
    with tempfile.TemporaryDirectory(prefix="mrasfm-baseline-") as name:
        folder = Path(name)
        shutil.copyfile(database, folder / "features.db")  # COLMAP writes into databases that it only reads
        ran = run_in_subprocess(_map, folder, mapper, threads, unit_of_image, timeout_s=timeout_s, cancel=cancel)
    if ran.result is None:
        return PeerResult(
            mapper=mapper, seconds=math.nan, registered_images=0, world_from_rig=np.zeros((0, 4, 4)),
            failure=ran.failure, peak_memory_bytes=ran.peak_memory_bytes,
        )  # fmt: skip
    return replace(ran.result, peak_memory_bytes=ran.peak_memory_bytes)


def _map(
    progress: StageProgress, folder: Path, mapper: Baseline, threads: int, unit_of_image: Mapping[str, int] | None
) -> PeerResult:
    pycolmap.logging.minloglevel = 3
    out = folder / "models"
    out.mkdir()
    database = str(folder / "baseline.db")
    reference_from_rig, units = _rewrite(folder / "features.db", folder / "baseline.db", unit_of_image)
    start_memory_bytes = memory_bytes()
    started = time.perf_counter()
    if mapper in (Baseline.GLOBAL, Baseline.GLOBAL_FIXED_CALIBRATION):
        models = pycolmap.global_mapping(database, folder, out, _global_options(mapper, threads))
    else:
        options = _incremental_options(mapper, threads)
        models = pycolmap.incremental_mapping(database, folder, out, options)
        if not models:
            options.mapper.init_min_tri_angle = SMALL_INITIAL_ANGLE_DEG
            started = time.perf_counter()  # the search in vain is not held against it
            models = pycolmap.incremental_mapping(database, folder, out, options)
    seconds = time.perf_counter() - started
    largest = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
    return PeerResult(
        mapper=mapper,
        seconds=seconds,
        registered_images=0 if largest is None else largest.num_reg_images(),
        world_from_rig=_world_from_rig(largest, units, reference_from_rig),
        failure="no model" if largest is None else "",
        start_memory_bytes=start_memory_bytes,
    )


def _rewrite(source: Path, target: Path, unit_of_image: Mapping[str, int] | None) -> tuple[Floats, int]:
    """Copy a scene's database with the first camera as the rig's reference, without descriptors.

    The scene's own reference is the vehicle, on which the incremental mapper finds no initial pair.

    Returns
    -------
    tuple
        `reference_from_rig` (4, 4), and the number of units.
    """
    with pycolmap.Database.open(str(source)) as old, pycolmap.Database.open(str(target)) as new:
        for camera in old.read_all_cameras():
            new.write_camera(camera, use_camera_id=True)
        (vehicle,) = old.read_all_rigs()
        sensors = sorted(vehicle.non_ref_sensors, key=lambda sensor: int(sensor.id))
        reference_from_rig = vehicle.sensor_from_rig(sensors[0])
        rig = pycolmap.Rig(rig_id=vehicle.rig_id)
        rig.add_ref_sensor(sensors[0])
        for sensor in sensors[1:]:
            rig.add_sensor(sensor, vehicle.sensor_from_rig(sensor) * reference_from_rig.inverse())
        new.write_rig(rig, use_rig_id=True)
        _copy_images(old, new)
        units = _copy_frames(old, new, unit_of_image)
        for pair, geometry in zip(*old.read_two_view_geometries(), strict=True):
            images = pycolmap.pair_id_to_image_pair(pair)
            new.write_matches(*images, geometry.inlier_matches)
            new.write_two_view_geometry(*images, geometry)
    matrix = reference_from_rig.matrix()
    return se3.transform(matrix[:, :3], matrix[:, 3]), units


def _copy_images(old: Any, new: Any) -> None:
    for image in old.read_all_images():
        copy = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
        new.write_image(copy, use_image_id=True)
        new.write_keypoints(image.image_id, old.read_keypoints(image.image_id))


def _copy_frames(old: Any, new: Any, unit_of_image: Mapping[str, int] | None) -> int:
    """Write the frames, numbered from 1 as units are from 0, and return how many units these are."""
    copies: dict[int, Any] = {}
    name_of_image = {image.image_id: image.name for image in old.read_all_images()}
    for frame in old.read_all_frames():
        for item in frame.data_ids:
            number = int(frame.frame_id) if unit_of_image is None else unit_of_image[name_of_image[item.id]] + 1
            copy = copies.setdefault(number, pycolmap.Frame(frame_id=number, rig_id=frame.rig_id))
            copy.add_data_id(item)
    for _, copy in sorted(copies.items()):
        new.write_frame(copy, use_frame_id=True)
    return max(copies)


def _global_options(mapper: Baseline, threads: int) -> Any:
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = threads
    options.random_seed = options.mapper.random_seed = 0
    if mapper is Baseline.GLOBAL_FIXED_CALIBRATION:
        options.mapper.refine_sensor_from_rig = False
        options.mapper.bundle_adjustment.refine_sensor_from_rig = False
        options.mapper.bundle_adjustment.refine_focal_length = False
        options.mapper.bundle_adjustment.refine_extra_params = False
    return options


def _incremental_options(mapper: Baseline, threads: int) -> Any:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = threads
    options.extract_colors = False
    if mapper is Baseline.INCREMENTAL_FIXED_CALIBRATION:
        options.ba_refine_sensor_from_rig = False
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
    return options


def _world_from_rig(model: Any, units: int, reference_from_rig: Floats) -> Floats:
    """Poses (units, 4, 4) of a model whose frames are numbered from 1 as the scene's units are from 0."""
    poses = np.full((units, 4, 4), np.nan)
    if model is not None:
        for frame_id in model.reg_frame_ids():
            reference_from_world = model.frame(frame_id).rig_from_world.matrix()
            world_from_reference = se3.inverse(se3.transform(reference_from_world[:, :3], reference_from_world[:, 3]))
            poses[frame_id - 1] = world_from_reference @ reference_from_rig
    return poses
