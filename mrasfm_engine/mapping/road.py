"""Semantic-aided triangulation: points of the road that are off its surface are dropped.

Edges of shadows that move with cars, and wrong matches on asphalt, triangulate above and below the road. Where masks
label the road, every point of it must lie on its surface, or agree with the points around it: kerbs are steps. Without
masks the vehicle's trajectory decides: nothing stands below the road, and nothing stood in the lane that it drove.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.scene.road import Road, RoadPoints, RoadSource
from mrasfm_engine.scene.semantics import ROAD, UNKNOWN
from mrasfm_engine.triangulation.road_prior import points_below_trajectory, standing_is_impossible
from mrasfm_engine.triangulation.road_surface import FittedRoad, KnownPatches, fit_road
from mrasfm_engine.triangulation.triangulate import cam_from_world
from mrasfm_engine.triangulation.uncertainty import point_covariances
from mrasfm_engine.types import Bools, Floats, Ints

SIGMA_PX_RANGE = (0.5, 2.0)  # keypoints share errors that residuals do not show


@dataclass(frozen=True, kw_only=True)
class RoadAssessment:
    """Points that were taken for the road's, and which of them are on it. All arrays are by such a point."""

    source: RoadSource
    fitted: FittedRoad
    tracks: Ints
    points_m: Floats
    distance_m: Floats  # signed, to the surface; NaN where there is none
    limit_m: Floats  # how far from the surface a point of its uncertainty may be
    is_inlier: Bools

    @property
    def is_on_surface(self) -> Bools:
        """Points (n,) on the surface; other inliers are marked by being on no patch."""
        on: Bools = self.is_inlier & (np.abs(self.distance_m) <= self.limit_m)
        return on

    def patches_of(self, points_m: Floats) -> Ints:
        """Patches (n,) of the points where these lie now; -1 off the surface.

        Adjustments after the road was found move points with it, by less than it is uneven, and a few of them away.
        """
        distance_m, patch = self.fitted.surface.locate(points_m)
        stayed = (patch >= 0) & (np.abs(distance_m) <= self.limit_m + self.fitted.roughness_m)
        result: Ints = np.where(self.is_on_surface & stayed, patch, -1)
        return result

    @property
    def road(self) -> Road:
        """Road of the scene."""
        return Road(
            source=self.source,
            surface=self.fitted.surface,
            roughness_m=self.fitted.roughness_m,
            rig_height_m=self.fitted.rig_height_m,
            before=RoadPoints(points_m=self.points_m, distance_m=self.distance_m, is_inlier=self.is_inlier),
        )


def assess_road(mapper: Mapper, *, for_map: bool, known: KnownPatches | None = None) -> RoadAssessment | str:
    """Fit the road's surface to the mapper's points and judge each that is taken for the road's; else why not.

    Parameters
    ----------
    for_map
        Whether the points are for the map. Before, only those are off that are by their own uncertainty.
    known
        Patches of an earlier fit, to start from.
    """
    config = mapper.config.mapping
    units = np.flatnonzero(mapper.registered)
    world_from_rig = mapper.state.world_from_rig[units]
    found = _points_of_the_road(mapper, world_from_rig, for_map=for_map)
    if isinstance(found, str):
        return found
    source, tracks = found
    points = mapper.state.points_m[tracks]
    sigma = height_sigmas_m(mapper, tracks, world_from_rig)
    # In the map, what is off the road is wrong however uncertain it is; to poses, weak rays do no harm.
    max_offset_m = config.road_max_offset_m if for_map else np.inf
    fitted = fit_road(
        points,
        sigma,
        world_from_rig,
        radius_m=config.road_patch_m,
        rng=np.random.default_rng(mapper.config.seed),
        max_offset_m=max_offset_m,
        rounds=2 if for_map else 1,
        units=units,
        known=known,
        threads=mapper.config.threads,
    )
    if fitted is None:
        return f"{len(tracks)} points of the road are too few, or lie on no surface"
    limit = fitted.limits_m(sigma, sigmas=config.road_sigmas, max_offset_m=max_offset_m)
    off = fitted.off(limit)
    distance = np.where(fitted.patch < 0, np.nan, fitted.offset_m)
    if source is RoadSource.GEOMETRY:
        off &= standing_is_impossible(points, distance, world_from_rig)
    return RoadAssessment(
        source=source,
        fitted=fitted,
        tracks=tracks,
        points_m=points,
        distance_m=distance,
        limit_m=limit,
        is_inlier=~off,
    )


def drop_off_road(
    mapper: Mapper, *, for_map: bool = False, before: RoadAssessment | str | None = None
) -> RoadAssessment | str:
    """Judge the road's points and drop those off its surface; they wait until `Mapper.complete` or `Mapper.readmit`.

    For the map the surface is found from nothing, else from the one of the assessment `before`.
    """
    known = before.fitted.known if isinstance(before, RoadAssessment) and not for_map else None
    judgement = assess_road(mapper, for_map=for_map, known=known)
    if isinstance(judgement, RoadAssessment):
        mapper.drop(judgement.tracks[~judgement.is_inlier])
    return judgement


def road_where_points_are(mapper: Mapper, road: RoadAssessment | str) -> RoadAssessment | str:
    """The road of the map, found anew where its points have moved from its surface by more than the road is uneven.

    Where none is found, the one that was found stays if any of its points still are on it.
    """
    if not isinstance(road, RoadAssessment):
        return road
    distance_m, patch = road.fitted.surface.locate(mapper.state.points_m[road.tracks])
    kept = road.is_inlier & (patch >= 0) & np.isfinite(road.distance_m)
    if not kept.any() or np.median(np.abs(distance_m - road.distance_m)[kept]) <= road.fitted.roughness_m:
        return road
    again = drop_off_road(mapper, for_map=True)
    stays = isinstance(again, str) and (road.patches_of(mapper.state.points_m[road.tracks]) >= 0).any()
    return road if stays else again


def _points_of_the_road(mapper: Mapper, world_from_rig: Floats, *, for_map: bool) -> tuple[RoadSource, Ints] | str:
    """Tracks whose points are taken for the road's, and what says so; else why there are none."""
    if (mapper.track_class == ROAD).any():
        return RoadSource.MASKS, np.flatnonzero(mapper.triangulated & (mapper.track_class == ROAD))
    if _all_images_are_masked(mapper):
        return "no keypoint lies on the road of the masks"
    if not for_map:
        return "without masks, the road is judged in the finished scene only: too unsure to bear on poses"
    tracks = np.flatnonzero(mapper.triangulated & (mapper.track_class == UNKNOWN))
    below = points_below_trajectory(mapper.state.points_m[tracks], world_from_rig, _lowest_camera_m(mapper))
    if below is None:
        return "without masks, no points lie on one level below the vehicle's trajectory"
    return RoadSource.GEOMETRY, tracks[below]


def height_sigmas_m(mapper: Mapper, tracks: Ints, world_from_rig: Floats) -> Floats:
    """Standard deviations (n,) of the heights of points, from the noise of their observations and their rays."""
    rows = mapper.observation_rows(tracks)
    place = np.full(len(mapper.tracks), -1, dtype=np.int64)
    place[tracks] = np.arange(len(tracks))
    owner = mapper.tracks.of_keypoint[rows]
    errors = mapper.triangulator.errors_px(mapper.state, rows, mapper.state.points_m, owner)
    # The squared length of a 2D normal error has the median 2 ln 2 sigma^2; a point has used up three of its numbers.
    redundancy = max(0.1, 1.0 - 1.5 * len(tracks) / max(len(rows), 1))
    noise = float(np.sqrt(np.median(errors**2) / (2 * np.log(2)) / redundancy)) if len(rows) else 1.0
    r, t = cam_from_world(mapper.state, mapper.image_unit, mapper.image_camera)
    centre = -np.einsum("nji,nj->ni", r, t)
    covariance = point_covariances(
        mapper.state.points_m[tracks],
        place[owner],
        centre[mapper.keypoints.image[rows]],
        mapper.state.camera_params[mapper.keypoints.camera[rows], :2].mean(1),
        sigma_px=float(np.clip(noise, *SIGMA_PX_RANGE)),
    )
    up = world_from_rig[:, :3, 2].mean(0)
    up /= np.linalg.norm(up)
    variance = np.maximum(covariance @ up @ up, 0.0)
    result: Floats = np.sqrt(variance)
    return result


def _all_images_are_masked(mapper: Mapper) -> bool:
    """Every image with keypoints has some of a known class: an image without a mask has none."""
    images = np.flatnonzero(np.diff(mapper.keypoints.first))
    return bool(len(images)) and bool(mapper.keypoints.is_masked[images].all())


def _lowest_camera_m(mapper: Mapper) -> float:
    """Height of the lowest camera over the rig's origin."""
    return float(mapper.state.camera_position_m[:, 2].min())
