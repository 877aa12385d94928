"""Sub-maps: parts of a drive that were mapped by themselves, and how one scene is made of them.

Neighbours share units. Their poses are of the same images in both, so they say how one lies to the other, and by how
much its scale differs. That, and the mean of the calibrations, is where the adjustment of all units begins.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.errors import ReconstructionError
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.averaging import geometric_median, robust_mean_rotation
from mrasfm_engine.mapping.calibration import take_calibration
from mrasfm_engine.mapping.components import MIN_UNITS, Component, DriveMapping
from mrasfm_engine.mapping.incremental_mapping import MappingLog, adjust_globally, register_remaining
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.types import Bools, Floats, Ints

# Shared units whose shapes differ by more than this share of their extent are not believed: trajectories that were
# mapped from the same images agree to some thousandths, whatever their frames and scales.
MAX_DIFFERENCE = 0.1


@dataclass(frozen=True, kw_only=True)
class Part:
    """A part of a sub-map with a frame of its own, in the units and images of the whole drive.

    Attributes
    ----------
    units, world_from_rig
        Units (n,) that have a pose, and these poses (n, 4, 4).
    rig_from_cam, camera_params, camera_time_offset_s
        The calibration (c, 4, 4), (c, PARAMETERS), (c,) that they were found with.
    missing
        Images (m,) of its units that have no pose.
    own, unit_from_image
        Images (k,) with poses of their own, and these (k, 4, 4) relative to their units.
    observations
        What the calibration rests on.
    """

    units: Ints
    world_from_rig: Floats
    rig_from_cam: Floats
    camera_params: Floats
    camera_time_offset_s: Floats
    missing: Ints
    own: Ints
    unit_from_image: Floats
    observations: int

    def scaled(self, factor: float) -> Part:
        """The part with other lengths, units and cameras alike; the cameras' mean place in the rig is kept."""
        poses, cameras, images = self.world_from_rig.copy(), self.rig_from_cam.copy(), self.unit_from_image.copy()
        mean_m = cameras[:, :3, 3].mean(axis=0)
        moved_m = (factor - 1.0) * mean_m
        poses[:, :3, 3] = factor * poses[:, :3, 3] + poses[:, :3, :3] @ moved_m
        cameras[:, :3, 3] = mean_m + factor * (cameras[:, :3, 3] - mean_m)
        images[:, :3, 3] = factor * images[:, :3, 3] + images[:, :3, :3] @ moved_m - moved_m
        return replace(self, world_from_rig=poses, rig_from_cam=cameras, unit_from_image=images)

    def moved(self, a_from_b: Floats) -> Part:
        """The part in another frame, by a rigid transform (4, 4)."""
        return replace(self, world_from_rig=a_from_b @ self.world_from_rig)


def part_arrays(component: Component) -> dict[str, NDArray[Any]]:
    """A component of a sub-map as arrays, for `part_from_arrays`."""
    mapper = component.mapper
    has_own_pose, unit_from_image = mapper.motion.own_poses
    return {
        "registered": mapper.registered,
        "world_from_rig": mapper.state.world_from_rig,
        "rig_from_cam": mapper.state.rig_from_cam,
        "camera_params": mapper.state.camera_params,
        "camera_time_offset_s": mapper.state.camera_time_offset_s,
        "missing": mapper.missing,
        "has_own_pose": has_own_pose,
        "unit_from_image": unit_from_image,
        "observations": np.array(int(mapper.is_inlier.sum())),
    }


def part_from_arrays(arrays: Mapping[str, NDArray[Any]], units: Ints, images: Ints) -> Part:
    """The part whose `part_arrays` these are, given which units and images of the drive its sub-map has."""
    registered, own = arrays["registered"], arrays["has_own_pose"]
    return Part(
        units=units[registered],
        world_from_rig=arrays["world_from_rig"][registered],
        rig_from_cam=arrays["rig_from_cam"],
        camera_params=arrays["camera_params"],
        camera_time_offset_s=arrays["camera_time_offset_s"],
        missing=images[arrays["missing"]],
        own=images[own],
        unit_from_image=arrays["unit_from_image"][own],
        observations=int(arrays["observations"]),
    )


def join(begun: DriveMapping, parts: Sequence[Part], keyframe: Bools) -> list[Component]:
    """One scene of the parts of sub-maps, as far as shared units or anything else links them.

    Parameters
    ----------
    begun
        Mapping of the whole drive, of which nothing has a pose yet.
    parts
        Of all sub-maps.
    keyframe
        Units (units,) that the sub-maps used.

    Raises
    ------
    ReconstructionError
        Where no sub-map has a part.
    CancelledError
        Where it is cancelled.
    """
    if not parts:
        raise ReconstructionError(
            "no part of the drive has two units that fit together",
            remedy="Check that consecutive frames show the same scene, and that images are sharp and not mixed up.",
            code="no-initial-units",
        )
    begun.mapper.keyframe = keyframe
    groups = in_common_frames(parts)
    in_any = np.isin(np.arange(len(keyframe)), np.concatenate([part.units for part in parts]))
    for group in groups:
        mapper = _mapper_of(begun, group)
        component = Component(mapper=mapper, log=MappingLog(absolute=replace(begun.absolute)))
        adjust_globally(mapper, component.log, begun.cancel)
        # Units that another group has are linked with all of it, or not at all.
        mapper.keyframe = keyframe & (mapper.registered | ~in_any)
        register_remaining(mapper, component.log, progress=begun.progress, cancel=begun.cancel)
        mapper.keyframe = keyframe
        begun.parts.append(component)
    begun.parts.sort(key=lambda part: -part.size)
    begun.map_others()
    return begun.finish()


def in_common_frames(parts: Sequence[Part]) -> list[list[Part]]:
    """Groups of parts that shared units link, each in one frame and of one scale; the one with most units first.

    Lengths of a group are the mean of its parts' own, as each knows them from the same baselines.
    """
    left = sorted(parts, key=lambda part: -len(part.units))
    groups: list[list[Part]] = []
    while left:
        group, factors = [left.pop(0)], [1.0]
        while (found := _next_linked(group, left)) is not None:
            number, a_from_b, factor = found
            part = left.pop(number)
            group.append(part.scaled(factor).moved(a_from_b))
            factors.append(factor)
        weights = np.array([len(part.units) for part in group], dtype=np.float64)
        mean = float(np.exp(-(weights @ np.log(factors)) / weights.sum()))
        groups.append([part.scaled(mean) for part in group])
    return groups


def _next_linked(group: Sequence[Part], left: Sequence[Part]) -> tuple[int, Floats, float] | None:
    """Part of those left that shares most units with the group, a_from_b (4, 4) to it, and its factor of lengths."""
    known = {
        int(unit): pose for part in reversed(group) for unit, pose in zip(part.units, part.world_from_rig, strict=True)
    }
    best: tuple[int, Floats, float] | None = None
    most = MIN_UNITS - 1
    for number, part in enumerate(left):
        rows = np.flatnonzero([int(unit) in known for unit in part.units])
        if len(rows) <= most:
            continue
        in_group = np.stack([known[int(unit)] for unit in part.units[rows]])
        linked = _link(in_group, part, rows)
        if linked is not None:
            best, most = (number, *linked), len(rows)
    return best


def _link(in_group: Floats, part: Part, rows: Ints) -> tuple[Floats, float] | None:
    """a_from_b (4, 4) and the factor of a part's lengths, by poses (n, 4, 4) of some of its units in a group's frame.

    None where the two shapes are not the same.
    """
    # Of the places that scaling keeps in the rig: about them, lengths scale exactly.
    mean_m = part.rig_from_cam[:, :3, 3].mean(axis=0)
    in_group_m, own_m = (poses[:, :3, :3] @ mean_m + poses[:, :3, 3] for poses in (in_group, part.world_from_rig[rows]))
    factor = _extent(in_group_m) / _extent(own_m)
    own = part.scaled(factor).world_from_rig[rows]
    rotation = robust_mean_rotation(in_group[:, :3, :3] @ np.swapaxes(own[:, :3, :3], 1, 2))
    a_from_b = se3.transform(rotation, geometric_median(in_group[:, :3, 3] - own[:, :3, 3] @ rotation.T))
    moved = a_from_b @ own
    off_m = np.linalg.norm(moved[:, :3, 3] - in_group[:, :3, 3], axis=1)
    turned_rad = np.radians(se3.rotation_angle_deg(np.swapaxes(in_group[:, :3, :3], 1, 2) @ moved[:, :3, :3]))
    if np.median(off_m) > MAX_DIFFERENCE * _extent(in_group[:, :3, 3]) or np.median(turned_rad) > MAX_DIFFERENCE:
        return None
    return a_from_b, factor


def _extent(position_m: Floats) -> float:
    spread_m = np.sqrt(((position_m - position_m.mean(axis=0)) ** 2).sum(axis=1).mean())
    return max(float(spread_m), float(np.finfo(np.float64).tiny))


def _mapper_of(begun: DriveMapping, group: Sequence[Part]) -> Mapper:
    """A mapper of the whole drive with the poses of a group, the mean of its calibrations, and points from all."""
    empty = begun.mapper
    mapper = Mapper(empty.drive, empty.keypoints, empty.tracks, empty.config)
    if begun.prior_world_from_rig is not None:
        mapper.motion.follow_prior(begun.prior_world_from_rig)
    mapper.keyframe, mapper.rig_as_begun = empty.keyframe, empty.rig_as_begun
    weights = np.array([part.observations for part in group], dtype=np.float64) + 1.0
    weights /= weights.sum()
    cameras = np.stack([part.rig_from_cam for part in group], axis=1)
    rotation = np.stack([se3.mean_rotation(of_camera[:, :3, :3], weights) for of_camera in cameras])
    mapper.state = replace(
        mapper.state,
        camera_rotation=rotation,
        camera_position_m=np.einsum("p,cpk->ck", weights, cameras[:, :, :3, 3]),
        camera_params=np.einsum("p,pck->ck", weights, np.stack([part.camera_params for part in group])),
        camera_time_offset_s=weights @ np.stack([part.camera_time_offset_s for part in group]),
    )
    for part in sorted(group, key=lambda part: len(part.units)):  # shared units have the larger part's pose
        for unit, pose in zip(part.units.tolist(), part.world_from_rig, strict=True):
            mapper.set_pose(unit, pose)
        images = np.flatnonzero(np.isin(mapper.image_unit, part.units))
        mapper.missing[images] = False
        mapper.motion.forget_image_poses(images)
        mapper.missing[part.missing] = True
        if len(part.own):
            mapper.set_image_poses(part.own, part.unit_from_image)
    mapper.renew_motion()
    if not mapper.config.bundle_adjustment.refine_calibration:
        take_calibration(mapper, empty)
    mapper.triangulate()
    return mapper
