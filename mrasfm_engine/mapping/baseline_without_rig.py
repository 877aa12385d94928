"""Registration of single images, without the camera set: a baseline (`camera_set_registration = false`).

Every image gets its pose by its own PnP. The unit takes the pose of its best supported image. Images that agree with it
belong to the set, an image with another pose keeps that pose, and an image whose PnP fails is missing. All other steps
are the same.
"""

from __future__ import annotations

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.per_camera_pnp import Vote, agree
from mrasfm_engine.mapping.unit_registration import Registration, camera_votes, correspondences_of_unit, failed
from mrasfm_engine.types import Floats


def register_images_singly(mapper: Mapper, unit: int) -> Registration:
    """Find the pose of a unit from that of its best image, and the poses of its other images."""
    matched = correspondences_of_unit(mapper, unit)
    votes = camera_votes(mapper, matched)
    if not votes:
        return failed(unit, matched, 0, "no image of it could be registered alone")
    best = max(votes, key=lambda vote: vote.inliers)
    own = _own_poses(votes, best.world_from_rig)
    voters = {vote.camera for vote in votes}
    return Registration(
        unit=unit,
        world_from_rig=best.world_from_rig,
        correspondences=len(matched.camera),
        inliers=sum(vote.inliers for vote in votes),
        method="single images",
        voted_out=tuple(mapper.drive.cameras[c].name for c in own),
        own_poses=own,
        missing=tuple(int(c) for i, c in _images_of(mapper, unit) if c not in voters),
    )


def take_over(mapper: Mapper, registered_unit: Registration) -> None:
    """Give the images of a registered unit the poses that are not the unit's."""
    for image, camera in _images_of(mapper, registered_unit.unit):
        if camera in registered_unit.own_poses:
            mapper.set_image_pose(image, registered_unit.own_poses[camera])
        if camera in registered_unit.missing:
            mapper.missing[image] = True


def retry_missing(mapper: Mapper) -> None:
    """Try images that are missing once more, now that the scene has more points."""
    for unit in np.unique(mapper.image_unit[mapper.missing]):
        images = {camera: image for image, camera in _images_of(mapper, int(unit)) if mapper.missing[image]}
        votes = [
            vote for vote in camera_votes(mapper, correspondences_of_unit(mapper, int(unit))) if vote.camera in images
        ]
        own = _own_poses(votes, mapper.state.world_from_rig[unit])
        for vote in votes:
            mapper.missing[images[vote.camera]] = False
            if vote.camera in own:
                mapper.set_image_pose(images[vote.camera], own[vote.camera])
        if votes:
            mapper.extend(int(unit))


def _own_poses(votes: list[Vote], world_from_rig: Floats) -> dict[int, Floats]:
    """Poses relative to the unit's of the cameras that voted for another one."""
    if not votes:
        return {}
    poses = np.stack([vote.world_from_rig for vote in votes])
    relative = se3.inverse(world_from_rig) @ poses
    same = agree(votes, world_from_rig)
    return {vote.camera: relative[k] for k, vote in enumerate(votes) if not same[k]}


def _images_of(mapper: Mapper, unit: int) -> list[tuple[int, int]]:
    """Images of a unit and their cameras."""
    return [(int(i), int(mapper.image_camera[i])) for i in np.flatnonzero(mapper.image_unit == unit)]
