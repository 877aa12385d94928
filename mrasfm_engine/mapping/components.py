"""Components: parts of a drive that grow from seeds of their own, as no unit of one sees enough of another.

Darkness, glare, a tunnel, or minutes without images cut a drive. Each part is mapped by itself, and then put together
with the others by the best knowledge that there is: images that see the same places, else positions or rough poses,
which say where each part lies. What nothing links stays a component, metric by the rig, in a frame of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import ReconstructionError
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.averaging import geometric_median, robust_mean_rotation
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.dynamic_objects import without_keypoints
from mrasfm_engine.mapping.incremental_mapping import (
    MappingLog,
    adjust_globally,
    cleaned_and_closed,
    mapper_of_drive,
    register_remaining,
    run_incremental_mapping,
    with_tracks_of,
)
from mrasfm_engine.mapping.loop_closure import MIN_SUPPORT, largest_agreement, seen_again, split_pairs
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.placement import move, place_by_gnss, positions_fit
from mrasfm_engine.mapping.places_alike import SoundPairs, sound_pairs
from mrasfm_engine.mapping.rough_placement import between_poses, place_by_rough_poses
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import PairMatches
from mrasfm_engine.triangulation.tracks import Keypoints, build_tracks
from mrasfm_engine.types import Bools, Cancel, CountProgress, Floats, Ints
from schemas.findings import Finding

# Two units are a seed; that a third one agrees with their points is the least that confirms it.
MIN_UNITS = 3


class LinkedBy(StrEnum):
    """Knowledge by which a part of a drive is put together with another."""

    IMAGES = "images"
    POSITIONS = "GNSS positions"
    ROUGH_POSES = "rough poses"


@dataclass(frozen=True, kw_only=True)
class Link:
    """A part of the drive that was put together with the larger one."""

    units: Bools  # (units,) of the smaller part
    by: LinkedBy


@dataclass(kw_only=True)
class Component:
    """A part of the drive with a frame of its own.

    Attributes
    ----------
    mapper, log
        The scene, of whose units all others of the drive have no pose, and how it grew.
    links
        Parts that it was put together of, besides the one with most units.
    """

    mapper: Mapper
    log: MappingLog
    links: list[Link] = field(default_factory=list)

    @property
    def size(self) -> int:
        """Number of units with a pose."""
        return int(self.mapper.registered.sum())


def map_drive(
    drive: Drive,
    keypoints: Keypoints,
    pairs: Sequence[PairMatches],
    prior_world_from_rig: Floats | None,
    config: EngineConfig,
    *,
    absolute: AbsolutePriors | None = None,
    progress: CountProgress | None = None,
    cancel: Cancel | None = None,
) -> list[Component]:
    """Map a whole drive: parts grow from their seeds, are put together, cleaned of what moves along, and loops closed.

    Returns
    -------
    list of Component
        The one with most units first.

    Raises
    ------
    ReconstructionError
        Where the scene cannot even begin.
    CancelledError
        Where `cancel` answers True.
    """
    begun = begin_mapping(drive, keypoints, pairs, prior_world_from_rig, config, absolute, progress, cancel)
    begun.map_from_seeds()
    return begun.finish()


def begin_mapping(
    drive: Drive,
    keypoints: Keypoints,
    pairs: Sequence[PairMatches],
    prior_world_from_rig: Floats | None,
    config: EngineConfig,
    absolute: AbsolutePriors | None = None,
    progress: CountProgress | None = None,
    cancel: Cancel | None = None,
) -> DriveMapping:
    """Mapping of a drive of which nothing has a pose yet."""
    following, far = split_pairs(pairs)
    alike = sound_pairs(drive, keypoints, following, config.matching, cancel)
    near = alike.pairs
    mapper, still, contradiction = mapper_of_drive(drive, keypoints, near, prior_world_from_rig, config)
    return DriveMapping(
        mapper=mapper,
        still=still,
        near=near,
        far=far,
        alike=alike,
        sound=without_keypoints(near, keypoints.first, still) if still.any() else near,
        prior_world_from_rig=prior_world_from_rig,
        absolute=AbsolutePriors() if absolute is None else absolute,
        contradiction=contradiction,
        progress=progress,
        cancel=cancel,
    )


@dataclass(kw_only=True)
class DriveMapping:
    """Parts of a drive while they grow, and what they grow from.

    Attributes
    ----------
    mapper
        The drive without poses.
    still
        Keypoints (k,) that stand still in the image while the car moves.
    near, far
        Pairs of units that follow one another, and of those that may be revisits.
    alike
        What became of the former where places look alike.
    sound
        Those of `near` without the keypoints that stand still.
    contradiction
        What the cameras' motions have against the calibration as given.
    parts
        What has grown so far.
    """

    mapper: Mapper
    still: Bools
    near: Sequence[PairMatches]
    far: Sequence[PairMatches]
    alike: SoundPairs
    sound: Sequence[PairMatches]
    prior_world_from_rig: Floats | None
    absolute: AbsolutePriors
    contradiction: Finding | None
    progress: CountProgress | None
    cancel: Cancel | None
    parts: list[Component] = field(default_factory=list)

    def map_from_seeds(self) -> None:
        """Grow a part from the best seed, and others of what it does not reach.

        Raises
        ------
        ReconstructionError
            Where not even the first can begin.
        """
        log = run_incremental_mapping(
            self.mapper,
            self.sound,
            self.prior_world_from_rig,
            absolute=self.absolute,
            progress=self.progress,
            cancel=self.cancel,
        )
        self.parts.append(Component(mapper=self.mapper, log=log))
        self.map_others()

    def map_others(self) -> None:
        """Grow parts of units that have no pose yet, as far as they hold together."""
        if self.mapper.config.mapping.camera_set_registration:
            _grow_others(self.parts, self.sound, self.prior_world_from_rig, self.absolute, self.progress, self.cancel)

    def put_together(self) -> list[Component]:
        """The parts, of which those that anything links are one; the one with most units first."""
        together = _put_together(
            self.parts, self.sound, self.far, self.prior_world_from_rig, self.progress, self.cancel
        )
        return sorted(together, key=lambda part: -part.size)

    def finish(self) -> list[Component]:
        """The parts as `put_together` gives them, cleaned of what moves along, and with their loops closed."""
        result, taken = list[Component](), np.zeros(len(self.mapper.registered), dtype=np.bool_)
        for part in self.put_together():
            part.mapper = cleaned_and_closed(
                part.mapper, part.log, self.near, self.far, self.still, progress=self.progress, cancel=self.cancel
            )
            part.mapper.forget(np.flatnonzero(part.mapper.registered & taken))
            if not result or part.size >= MIN_UNITS:
                taken |= part.mapper.registered
                result.append(part)
        result[0].log.contradiction, result[0].log.alike = self.contradiction, self.alike
        return result


def _grow_others(
    grown: list[Component],
    pairs: Sequence[PairMatches],
    prior_world_from_rig: Floats | None,
    absolute: AbsolutePriors,
    progress: CountProgress | None,
    cancel: Cancel | None,
) -> None:
    """Grow parts among the units that have no pose yet, each from its own best seed, until none grows any more."""
    mapper = grown[0].mapper
    ends = np.array([(pair.image_a, pair.image_b) for pair in pairs], dtype=np.int64).reshape(-1, 2)
    units = mapper.image_unit[ends]
    left = mapper.keyframe & ~np.any([part.mapper.registered for part in grown], axis=0)
    while (group := _largest_group(units, left)) is not None:
        inside = np.asarray(group[units].all(axis=1))
        own = [pair for pair, chosen in zip(pairs, inside, strict=True) if chosen]
        part = _grown_in(group, grown, own, prior_world_from_rig, replace(absolute), progress, cancel)
        if part is None:
            left &= ~group  # nothing grows there
        else:
            grown.append(part)
            left &= ~part.mapper.registered


def _largest_group(pair_units: Ints, left: Bools) -> Bools | None:
    """The most of the units `left` (u,) that pairs (n, 2) hold together; None where these are too few for a part."""
    rows = pair_units[left[pair_units].all(axis=1)]
    links = coo_matrix((np.ones(len(rows)), (rows[:, 0], rows[:, 1])), shape=(len(left), len(left)))
    label = connected_components(links, directed=False)[1]
    most = int(np.bincount(label[left], minlength=1).argmax())
    group: Bools = left & (label == most)
    return group if group.sum() >= MIN_UNITS else None


def _grown_in(
    group: Bools,
    grown: Sequence[Component],
    pairs: Sequence[PairMatches],
    prior_world_from_rig: Floats | None,
    absolute: AbsolutePriors,
    progress: CountProgress | None,
    cancel: Cancel | None,
) -> Component | None:
    """A part among a group of units (u,), from its best seed; None where none grows.

    Its calibration is the largest part's, which tells more of it: alone, a few units would change their scale.
    """
    largest = grown[0].mapper
    mapper = _without_poses(largest, pairs)
    mapper.keyframe = group
    if prior_world_from_rig is not None:
        mapper.motion.follow_prior(prior_world_from_rig)

    def step(done: int, total: int) -> None:
        if progress is not None:
            before = sum(part.size for part in grown)
            progress(before + done, before + total)

    try:
        log = run_incremental_mapping(
            mapper,
            pairs,
            prior_world_from_rig,
            absolute=absolute,
            calibration_held=True,
            progress=step,
            cancel=cancel,
        )
    except ReconstructionError:
        return None  # no two of these units have enough in common
    mapper.keyframe = largest.keyframe
    return Component(mapper=mapper, log=log) if mapper.registered.sum() >= MIN_UNITS else None


def _without_poses(mapper: Mapper, pairs: Sequence[PairMatches]) -> Mapper:
    """A mapper of the same drive with the calibration as it is now, and tracks of some pairs."""
    result = Mapper(mapper.drive, mapper.keypoints, build_tracks(mapper.keypoints, pairs), mapper.config)
    result.state = result.state.with_cameras_of(mapper.state)
    result.rig_as_begun = mapper.rig_as_begun
    return result


def _put_together(
    grown: Sequence[Component],
    near: Sequence[PairMatches],
    far: Sequence[PairMatches],
    prior_world_from_rig: Floats | None,
    progress: CountProgress | None,
    cancel: Cancel | None,
) -> list[Component]:
    """Parts that anything links as one; the others as they are."""
    result: list[Component] = []
    across = [*near, *far]
    ordered = sorted(grown, key=lambda part: -part.size)
    ordered[0].log.calibration_held = False
    for part in ordered:
        result = _with(result, part, near, across, prior_world_from_rig)
    for whole in result:
        if not whole.links:
            continue
        adjust_globally(whole.mapper, whole.log, cancel)
        # Units that saw too little of one part alone may see enough of all.
        register_remaining(whole.mapper, whole.log, progress=progress, cancel=cancel)
    return result


def _with(
    wholes: list[Component],
    part: Component,
    near: Sequence[PairMatches],
    across: Sequence[PairMatches],
    prior_world_from_rig: Floats | None,
) -> list[Component]:
    """The parts with another one, linked to the first of them that it can be linked to."""
    for whole in wholes:
        whole_from_part = _by_images(whole.mapper, part, across)
        if whole_from_part is not None:
            _take_in(whole, part, whole_from_part, near, LinkedBy.IMAGES)
            return wholes
    for whole in wholes:
        by = _in_one_world(whole, part, prior_world_from_rig)
        if by is not None:
            _take_in(whole, part, np.eye(4), near, by)
            return wholes
    return [*wholes, part]


def _by_images(whole: Mapper, part: Component, pairs: Sequence[PairMatches]) -> Floats | None:
    """whole_from_part (4, 4) by units of the part that see points of the whole.

    None where too few of them agree, where positions are against it, and for one camera, whose scale is arbitrary in
    each part unless positions tell it.
    """
    other, by_units = part.mapper, dict[tuple[int, int], list[PairMatches]]()
    if whole.drive.has_single_camera and part.log.absolute.positions is None:
        return None
    for pair in pairs:
        u, v = int(whole.image_unit[pair.image_a]), int(whole.image_unit[pair.image_b])
        if whole.registered[v] and other.registered[u]:
            u, v = v, u
        if whole.registered[u] and other.registered[v]:
            by_units.setdefault((u, v), []).append(pair)
    poses = other.state.world_from_rig
    if not whole.state.simultaneous:  # the rig's motion within the part's units, which is known there
        rows = np.flatnonzero(other.registered[whole.motion.bands.unit] & ~whole.registered[whole.motion.bands.unit])
        whole.state.band_rotation[rows] = other.state.band_rotation[rows]
        whole.state.band_position_m[rows] = other.state.band_position_m[rows]
    tried = (seen_again(whole, u, v, own, current=poses[v]) for (u, v), own in sorted(by_units.items()))
    seen = [revisit for revisit in tried if revisit is not None]
    agreeing = largest_agreement(whole, other, seen)
    if len(agreeing) < MIN_SUPPORT:
        return None
    centre_m = other.state.unit_position_m[[revisit.later for revisit in agreeing]].mean(axis=0)
    drifts = np.stack([revisit.drift for revisit in agreeing])
    rotation = robust_mean_rotation(drifts[:, :3, :3])
    result = se3.transform(rotation, geometric_median(se3.apply(drifts, centre_m[None])[:, 0]) - rotation @ centre_m)
    known = part.log.absolute.placement
    if known is not None and known.prior is not None and not positions_fit(other, known, result):
        return None
    return result


def _in_one_world(whole: Component, part: Component, prior_world_from_rig: Floats | None) -> LinkedBy | None:
    """Move the part to where positions or rough poses say that it lies in the whole's world, which they tell as well.

    A part too short to be turned by its own positions stands as the prior trajectory does; its positions must fit.
    """
    absolute = part.log.absolute
    if whole.log.absolute.positions is not None and absolute.gnss is not None:
        assert absolute.antenna_in_rig_m is not None
        known = whole.log.absolute.placement
        assert known is not None
        own = place_by_gnss(part.mapper, absolute.gnss, absolute.antenna_in_rig_m)
        if own.prior is None and prior_world_from_rig is not None:
            _move_to_prior(part.mapper, prior_world_from_rig)
        return LinkedBy.POSITIONS if positions_fit(part.mapper, known) else None
    sigma, rough = part.mapper.drive.manifest.rough_poses, absolute.rough_world_from_rig
    if rough is not None and sigma is not None and part.mapper.config.bundle_adjustment.priors:
        both = all(place_by_rough_poses(one.mapper, rough, sigma.sigma_translation_m) for one in (whole, part))
        return LinkedBy.ROUGH_POSES if both else None
    return None


def _move_to_prior(mapper: Mapper, prior_world_from_rig: Floats) -> None:
    units = np.flatnonzero(mapper.registered & np.isfinite(prior_world_from_rig[:, 0, 3]))
    if len(units):
        move(mapper, between_poses(prior_world_from_rig[units], mapper.state.world_from_rig[units]))


def _take_in(
    whole: Component, part: Component, whole_from_part: Floats, pairs: Sequence[PairMatches], by: LinkedBy
) -> None:
    """Give the whole the part's units, and points from all."""
    mapper, other = whole.mapper, part.mapper
    poses = whole_from_part @ other.state.world_from_rig
    for unit in np.flatnonzero(other.registered).tolist():
        mapper.set_pose(unit, poses[unit])
        whole.log.failures.pop(unit, None)
    mapper.missing |= other.missing
    images = np.flatnonzero(other.motion.own_poses[0])
    if len(images):
        mapper.set_image_poses(images, other.motion.own_poses[1][images])
    whole.mapper = with_tracks_of(mapper, pairs)
    whole.links.append(Link(units=other.registered.copy(), by=by))
    whole.log.registrations += part.log.registrations
