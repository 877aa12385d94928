"""Semantic-aided triangulation: points of the road that are off its surface are dropped.

Edges of shadows that move with cars, and wrong matches on asphalt, triangulate above and below the road. Where masks
say what is road, every point of the road must lie on its surface. Where there are none, the vehicle's own way tells:
nothing that stands is below the road, and nothing was where the vehicle drove.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mrasfm_engine.mapping.mapper import Model
from mrasfm_engine.scene.road import Road, RoadPoints, RoadSource
from mrasfm_engine.scene.semantics import ROAD, UNKNOWN
from mrasfm_engine.triangulation.road_prior import points_below_the_way, standing_is_impossible
from mrasfm_engine.triangulation.road_surface import FittedRoad, fit_road
from mrasfm_engine.triangulation.triangulate import cam_from_world
from mrasfm_engine.triangulation.uncertainty import point_covariances
from mrasfm_engine.types import Bools, Floats, Ints

MAX_SLOPE_CHANGE = 0.05  # of the road beyond its last patch
SIGMA_PX_RANGE = (0.5, 2.0)  # keypoints share errors that residuals do not show


@dataclass(frozen=True, kw_only=True)
class RoadJudgement:
    """Points that were taken for the road's, and which of them are on it. All arrays are by such a point."""

    source: RoadSource
    fitted: FittedRoad
    tracks: Ints
    points_m: Floats
    distance_m: Floats  # signed, to the surface; NaN where there is none
    patch: Ints  # -1 where there is none
    limit_m: Floats  # how far from the surface a point of its uncertainty may be
    kept: Bools

    @property
    def road(self) -> Road:
        """What the scene says of the road."""
        return Road(
            source=self.source,
            surface=self.fitted.surface,
            roughness_m=self.fitted.roughness_m,
            rig_height_m=self.fitted.rig_height_m,
            before=RoadPoints(points_m=self.points_m, distance_m=self.distance_m, kept=self.kept),
        )


def judge_road(model: Model, *, final: bool) -> RoadJudgement | str:
    """Fit the road's surface to the model's points and judge each that is taken for the road's; else why not.

    Parameters
    ----------
    final
        Whether the points are for the map. Before, only those are off that are by their own uncertainty.
    """
    config = model.config.mapping
    world_from_rig = model.state.world_from_rig[model.registered]
    source, tracks = RoadSource.MASKS, np.flatnonzero(model.solved & (model.track_class == ROAD))
    if not (model.track_class == ROAD).any():
        if _all_images_are_masked(model):
            return "no keypoint lies on the road of the masks"
        if not final:
            return "without masks, the road is judged in the finished scene only: too unsure to bear on poses"
        source = RoadSource.GEOMETRY
        tracks = np.flatnonzero(model.solved & (model.track_class == UNKNOWN))
        below = points_below_the_way(model.state.points_m[tracks], world_from_rig, _lowest_camera_m(model))
        if below is None:
            return "without masks, no points lie on one level below the vehicle's way"
        tracks = tracks[below]
    points = model.state.points_m[tracks]
    sigma = height_sigmas_m(model, tracks, world_from_rig)
    fitted = fit_road(
        points,
        sigma,
        world_from_rig,
        radius_m=config.road_patch_m,
        rng=np.random.default_rng(model.config.seed),
        rounds=2 if final else 1,
    )
    if fitted is None:
        return f"{len(tracks)} points of the road are too few, or lie on no surface"
    distance, patch = fitted.surface.locate(points)
    limit = config.road_sigmas * np.hypot(sigma, fitted.roughness_m)
    if final:
        # In the map, what is off the road is wrong however uncertain it is; to poses, weak rays do no harm.
        limit = np.minimum(limit, max(config.road_max_offset_m, config.road_sigmas * fitted.roughness_m))
    off = np.abs(distance) > limit
    # Where no patch reaches, the nearest one tells roughly: the farther away, the less.
    alone = np.isnan(distance)
    offset, beyond = fitted.surface.beyond(points[alone])
    off[alone] = np.abs(offset) > limit[alone] + MAX_SLOPE_CHANGE * beyond
    if source is RoadSource.GEOMETRY:
        off &= standing_is_impossible(points, distance, world_from_rig)
    return RoadJudgement(
        source=source,
        fitted=fitted,
        tracks=tracks,
        points_m=points,
        distance_m=distance,
        patch=patch,
        limit_m=limit,
        kept=~off,
    )


def drop_off_road(model: Model, *, final: bool = False) -> RoadJudgement | str:
    """Judge the road's points and drop those off its surface; they wait until `Model.complete` or `Model.readmit`."""
    judgement = judge_road(model, final=final)
    if isinstance(judgement, RoadJudgement):
        model.drop(judgement.tracks[~judgement.kept])
    return judgement


def height_sigmas_m(model: Model, tracks: Ints, world_from_rig: Floats) -> Floats:
    """Standard deviations (n,) of the heights of points, from the noise of their observations and their rays."""
    rows = model.observation_rows(tracks)
    place = np.full(len(model.tracks), -1, dtype=np.int64)
    place[tracks] = np.arange(len(tracks))
    owner = model.tracks.of_keypoint[rows]
    errors = model.triangulator.errors_px(model.state, rows, model.state.points_m, owner)
    # The squared length of a 2D normal error has the median 2 ln 2 sigma^2; a point has used up three of its numbers.
    redundancy = max(0.1, 1.0 - 1.5 * len(tracks) / max(len(rows), 1))
    noise = float(np.sqrt(np.median(errors**2) / (2 * np.log(2)) / redundancy)) if len(rows) else 1.0
    r, t = cam_from_world(model.state, model.image_unit, model.image_camera)
    centre = -np.einsum("nji,nj->ni", r, t)
    covariance = point_covariances(
        model.state.points_m[tracks],
        place[owner],
        centre[model.keypoints.image[rows]],
        model.state.camera_params[model.keypoints.camera[rows], :2].mean(1),
        sigma_px=float(np.clip(noise, *SIGMA_PX_RANGE)),
    )
    up = world_from_rig[:, :3, 2].mean(0)
    up /= np.linalg.norm(up)
    variance = np.maximum(covariance @ up @ up, 0.0)
    result: Floats = np.sqrt(variance)
    return result


def _all_images_are_masked(model: Model) -> bool:
    """Whether every image with keypoints has some of a known class: an image without a mask has none."""
    image, classes = model.keypoints.image, model.keypoints.classes
    return len(np.unique(image[classes != UNKNOWN])) == len(np.unique(image))


def _lowest_camera_m(model: Model) -> float:
    """Height of the lowest camera over the rig's origin."""
    return float(model.state.camera_position_m[:, 2].min())
