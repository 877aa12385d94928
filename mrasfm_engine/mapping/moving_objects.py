"""Tracks on things that move, found in the scene with all of its poses, without masks."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mrasfm_engine.mapping.ground_path import ground_path
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.motion_groups import ALONE, BESIDE, MIXTURE, SHARED, MotionGroups, Neighbours, group
from mrasfm_engine.mapping.single_unit_tracks import log_odds_in_single_units
from mrasfm_engine.scene.semantics import UNKNOWN
from mrasfm_engine.triangulation.point_hypotheses import Views
from mrasfm_engine.triangulation.track_motion import TrackMotion, weigh_tracks
from mrasfm_engine.triangulation.triangulate import cam_from_world
from mrasfm_engine.types import Bools, Floats, Ints
from schemas import SemanticClass

SIGMA_PX_RANGE = (0.1, 3.0)
QUANTILE = 0.85  # of residuals, from which the noise is
MIN_OBSERVATIONS = 3  # of a point, whose residuals tell the noise
IN_ONE_UNIT = 5  # beside the reasons of `motion_groups`
REASONS = {
    ALONE: "its observations show a motion",
    SHARED: "it fits the motion of its neighbours",
    MIXTURE: "its observations contradict one another, and its neighbours move",
    BESIDE: "most of its neighbours move, and it hardly tells",
    IN_ONE_UNIT: "one unit alone sees it and what is around it",
}


@dataclass(frozen=True, kw_only=True)
class MovingTracks:
    """Tracks that were taken out as they move."""

    tracks: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    reason: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # keys of REASONS
    points: int = 0  # that these tracks had
    judged: int = 0  # tracks that could have been taken out


def drop_moving(mapper: Mapper, *, for_map: bool) -> MovingTracks:
    """Take out the points of tracks that move, and reject them; `Mapper.complete` and `readmit` let them in again.

    Where masks name what moves, only keypoints without a class are judged: all others show the static world.

    Parameters
    ----------
    for_map
        Also those that one unit alone observes. Seen at one instant, a thing that moves contradicts no pose. Where
        images of a unit are not simultaneous, these are always taken out.
    """
    may_move = np.ones(len(mapper.tracks), dtype=np.bool_)
    if _masks_name_what_moves(mapper):
        may_move = mapper.track_class == UNKNOWN
    if not (mapper.config.mapping.drop_moving and may_move.any() and mapper.registered.sum() > 1):
        return MovingTracks()
    views, path = views_of(mapper), ground_path(mapper)
    motion = TrackMotion.empty(len(mapper.tracks))

    def weigh(which: Ints, *, only_unsure: bool = False) -> None:
        weigh_tracks(
            motion, which, mapper.keypoints, mapper.tracks, mapper.state.points_m, mapper.triangulated, views, path,
            only_unsure=only_unsure, threads=mapper.config.threads,
        )  # fmt: skip

    weigh(np.flatnonzero(may_move), only_unsure=True)
    focal_px = mapper.state.camera_params[:, :2].mean(1)
    neighbours = Neighbours(motion, mapper.keypoints, mapper.tracks, focal_px, threads=mapper.config.threads)
    suspects = np.flatnonzero(motion.log_evidence + motion.log_prior > 0.0)

    def moving(suspects: Ints, known: Floats) -> MotionGroups:
        return group(motion, suspects, known, neighbours, weigh=weigh)

    found = moving(suspects, np.full(len(mapper.tracks), np.nan))
    in_one_unit = np.zeros(len(mapper.tracks), dtype=np.bool_)
    if for_map or not mapper.state.simultaneous:
        known = log_odds_in_single_units(mapper, _among(found.tracks, may_move), path)
        known[~may_move] = np.nan
        in_one_unit = known > 0.0
    if in_one_unit.any():
        # What one unit alone observes speaks for its neighbours, too: those on the same thing that hardly tell.
        found = moving(np.union1d(suspects, np.flatnonzero(in_one_unit)), known)
    moves = _among(found.tracks, may_move)
    reasons = np.zeros(len(mapper.tracks), dtype=np.int64)
    reasons[found.tracks] = found.reason
    reasons[in_one_unit] = IN_ONE_UNIT
    tracks = np.flatnonzero(moves)
    points = int(mapper.triangulated[tracks].sum())
    mapper.drop(tracks)
    posed = np.flatnonzero(mapper.image_posed[mapper.keypoints.image])
    of_keypoint = mapper.tracks.of_keypoint[posed]
    seen = np.bincount(of_keypoint[of_keypoint >= 0], minlength=len(mapper.tracks))
    judged = int((may_move & (seen > 1)).sum())
    return MovingTracks(tracks=tracks, reason=reasons[tracks], points=points, judged=judged)


def _among(tracks: Ints, may_move: Bools) -> Bools:
    """Mask (tracks,) of the tracks in a list that may move."""
    result = np.zeros(len(may_move), dtype=np.bool_)
    result[tracks] = may_move[tracks]
    return result


def views_of(mapper: Mapper) -> Views:
    """The cameras at the instants of their row bands, and the noise of their image coordinates."""
    bands, state, us = mapper.motion.bands, mapper.state, mapper.drive.timestamps_us
    every = None if state.simultaneous else np.arange(len(bands.unit))
    rotation, translation_m = cam_from_world(state, bands.unit, bands.camera, every)
    return Views(
        rotation=rotation,
        translation_m=translation_m,
        time_s=(us[bands.unit] - us[0]) / 1e6 + bands.time_offset_s + state.camera_time_offset_s[bands.camera],
        is_posed=mapper.image_posed[bands.image],
        kind=mapper.camera_kind,
        params=state.camera_params,
        sigma_px=_sigmas_px(mapper),
    )


def _sigmas_px(mapper: Mapper) -> Floats:
    """Standard deviations (c,) of image coordinates of every camera, from a high quantile of its residuals.

    Keypoints on edges, of large blobs and of leaves are several times worse than most. A median would take what they do
    for motion.
    """
    rows = np.flatnonzero(mapper.is_inlier)
    tracks = mapper.tracks.of_keypoint[rows]
    errors = mapper.triangulator.errors_px(mapper.state, rows, mapper.state.points_m, tracks)
    size = np.bincount(tracks, minlength=len(mapper.tracks))[tracks]
    telling = size >= MIN_OBSERVATIONS
    # The squared length of a 2D normal error exceeds 2 ln(1 / p) sigma^2 with probability p; a point uses up three
    # numbers of its observations.
    squared = errors[telling] ** 2 / (-2 * np.log(1 - QUANTILE) * (1.0 - 1.5 / size[telling]))
    camera = mapper.keypoints.camera[rows[telling]]
    result = np.full(len(mapper.camera_kind), np.nan)
    for c in range(len(result)):
        of_camera = squared[camera == c]
        if len(of_camera):
            result[c] = np.sqrt(np.quantile(of_camera, QUANTILE))
    if np.isnan(result).any():
        result[np.isnan(result)] = np.sqrt(np.quantile(squared, QUANTILE)) if len(squared) else 1.0
    clipped: Floats = np.clip(result, *SIGMA_PX_RANGE)
    return clipped


def _masks_name_what_moves(mapper: Mapper) -> bool:
    """Some keypoints have a class, and what moves would have one of its own."""
    labels = mapper.drive.manifest.label_map
    names = labels is None or SemanticClass.DYNAMIC in labels.ids.values()
    return names and bool((mapper.track_class != UNKNOWN).any())
