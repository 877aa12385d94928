"""Units of a standing car in the finished scene: their poses follow from the units at both ends of the stop."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_cameras
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures, Scene
from mrasfm_engine.types import Bools, Floats, Ints


@dataclass(frozen=True, kw_only=True)
class Stop:
    """Units between two that are reconstructed, which stand where these do.

    Attributes
    ----------
    first, last
        The two units.
    sigma_m
        (units between,) standard deviation of each axis of their positions; NaN where they have no pose.
    """

    first: int
    last: int
    sigma_m: Floats


def with_standing_units(scene: Scene, drive: Drive, included: Bools, moved_px: Floats) -> tuple[Scene, list[Stop]]:
    """The scene of all units of a drive, from that of those that are included (units,).

    A unit between is posed between the two ends of its stop, by time, or where the one is that has a pose. Its position
    is as uncertain as theirs, and by what it may have moved meanwhile: the way between the ends, as if evenly spread,
    and what its images would show of a motion across the view at the usual distance of the scene's points.

    Parameters
    ----------
    moved_px
        (units,) how far the images of units between moved, NaN for those that are included.
    """
    drive = drive.with_rig(scene.drive.manifest.rig)  # whose lens models are those that were found
    unit_of = np.flatnonzero(included)
    units, images = len(included), drive.images
    new_image = np.flatnonzero(included[[image.unit for image in images]])
    registered = np.zeros(units, dtype=np.bool_)
    poses, sigma = np.full((units, 4, 4), np.nan), np.full((units, 3), np.nan)
    registered[unit_of] = scene.unit_registered
    poses[unit_of], sigma[unit_of] = scene.world_from_rig, scene.sigma_position_m
    metres_per_px = _metres_per_px(scene, drive)
    stops = []
    for first, last in pairwise(unit_of.tolist()):
        between, ends = np.arange(first + 1, last), [unit for unit in (first, last) if registered[unit]]
        stop = Stop(first=first, last=last, sigma_m=np.full(len(between), np.nan))
        if len(between) and ends:
            poses[between] = se3.interpolate(drive.timestamps_us[ends], poses[ends], drive.timestamps_us[between])
            moved_m = np.linalg.norm(poses[ends[-1], :3, 3] - poses[ends[0], :3, 3]) / np.sqrt(12.0)
            unseen_m = moved_px[between] * metres_per_px
            sigma[between] = np.sqrt((sigma[ends] ** 2).max(axis=0) + moved_m**2 + unseen_m[:, None] ** 2)
            stop.sigma_m[:] = sigma[between].max(axis=1)
            registered[between] = True
        if len(between):
            stops.append(stop)
    image_registered = registered[[image.unit for image in images]]
    image_registered[new_image] = scene.image_registered
    return (
        replace(
            scene,
            drive=drive,
            unit_registered=registered,
            image_registered=image_registered,
            world_from_rig=poses,
            sigma_position_m=sigma,
            unit_component=np.zeros(units, dtype=np.int64),
            observation_image=new_image[scene.observation_image],
            features=_features(scene, new_image, len(images)),
            pairs=[
                replace(pair, image_a=int(new_image[pair.image_a]), image_b=int(new_image[pair.image_b]))
                for pair in scene.pairs
            ],
            unit_from_image=_unit_from_image(scene, new_image, len(images)),
        ),
        stops,
    )


def without_units(scene: Scene, units: Bools) -> Scene:
    """The scene in which units (units,), of which none has an observation, have no pose."""
    unit = np.array([image.unit for image in scene.drive.images], dtype=np.int64)
    poses, sigma = scene.world_from_rig.copy(), scene.sigma_position_m.copy()
    poses[units], sigma[units] = np.nan, np.nan
    return replace(
        scene,
        unit_registered=scene.unit_registered & ~units,
        image_registered=scene.image_registered & ~units[unit],
        world_from_rig=poses,
        sigma_position_m=sigma,
    )


def _metres_per_px(scene: Scene, drive: Drive) -> float:
    """Way across the view that moves the scene's points by a pixel, at their median distance; NaN without points."""
    if not len(scene.observation_point):
        return float("nan")
    unit = np.array([image.unit for image in scene.drive.images], dtype=np.int64)[scene.observation_image]
    away_m = np.linalg.norm(scene.points_m[scene.observation_point] - scene.world_from_rig[unit, :3, 3], axis=1)
    focal_px = float(np.median(pack_cameras(drive.cameras)[1][:, 0]))
    return float(np.median(away_m)) / focal_px


def _features(scene: Scene, new_image: Ints, count: int) -> list[ImageFeatures]:
    """Features of all images; those between have none, of the kind that the others have."""
    kind = scene.features[0]
    none = ImageFeatures(
        xy_px=kind.xy_px[:0],
        descriptors=kind.descriptors[:0],
        colors=kind.colors[:0],
        scores=None if kind.scores is None else kind.scores[:0],
    )
    result = [none] * count
    for image, found in zip(new_image.tolist(), scene.features, strict=True):
        result[image] = found
    return result


def _unit_from_image(scene: Scene, new_image: Ints, count: int) -> Floats | None:
    if scene.unit_from_image is None:
        return None
    result = np.tile(np.eye(4), (count, 1, 1))
    result[new_image] = scene.unit_from_image
    return result
