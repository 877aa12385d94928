from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.config import EngineConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.mapping.incremental_mapping import run_incremental_mapping
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.mapping_report import describe, describe_refinement
from mrasfm_engine.mapping.refinement import refine
from mrasfm_engine.mapping.road import (
    RoadAssessment,
    assess_road,
    drop_off_road,
    height_sigmas_m,
    road_where_points_are,
)
from mrasfm_engine.scene.road import RoadSource
from mrasfm_engine.scene.semantics import ROAD, UNKNOWN
from mrasfm_engine.triangulation.tracks import Keypoints
from tests.helpers.simulated_drive import (
    SimulatedDrive,
    make_model,
    make_simulated_drive,
    shown_points,
    true_matches,
    with_true_poses,
)

UNITS = 12
SHADOW_M_PER_UNIT = 0.4  # of a shadow along the trajectory, of the vehicle's 1.1
ON, OFF = (
    EngineConfig(threads=1).model_copy(
        update={"mapping": EngineConfig().mapping.model_copy(update={"semantic_triangulation": on})}
    )
    for on in (True, False)
)


def drive_over_shadows(*, share: float = 0.35, masks: bool = True) -> tuple[SimulatedDrive, np.ndarray]:
    """A drive of which a share of the road's points are edges of shadows that move along it; and which points do."""
    simulated = make_simulated_drive(units=UNITS, cameras=6, points=6000, clutter=0)
    truth = simulated.truth
    road = truth.points_m[:, 2] == 0.0
    moving = road & (np.random.default_rng(1).random(len(road)) < share)
    forward = truth.world_from_rig[-1, :3, 3] - truth.world_from_rig[0, :3, 3]
    step = SHADOW_M_PER_UNIT * forward / np.linalg.norm(forward)
    features = []
    for image, found, of in zip(simulated.drive.images, simulated.features, simulated.point_of_keypoint, strict=True):
        cam_from_world = se3.inverse(truth.world_from_rig[image.unit] @ truth.rig_from_cam[image.camera])
        seen = se3.apply(cam_from_world, truth.points_m[of] + np.where(moving[of], image.unit, 0.0)[:, None] * step)
        still = se3.apply(cam_from_world, truth.points_m[of])
        shift = (seen[:, :2] / seen[:, 2:] - still[:, :2] / still[:, 2:]) * truth.camera_params[image.camera, :2]
        classes = np.where(road[of], ROAD, 1).astype(np.uint8)
        features.append(
            replace(
                found,
                xy_px=(found.xy_px + shift).astype(np.float32),
                classes=classes if masks else np.full(len(of), UNKNOWN, np.uint8),
            )
        )
    return replace(simulated, features=features), moving


def mapped(simulated: SimulatedDrive, config: EngineConfig = ON) -> Mapper:
    return with_true_poses(make_model(simulated, config=config), simulated, range(UNITS))


def is_moving(mapper: Mapper, simulated: SimulatedDrive, moving: np.ndarray, tracks: np.ndarray) -> np.ndarray:
    result: np.ndarray = moving[shown_points(mapper, simulated)[tracks]]
    return result


@pytest.fixture(scope="module")
def shadows() -> tuple[SimulatedDrive, np.ndarray]:
    return drive_over_shadows()


@pytest.mark.parametrize("for_map", [False, True])
def test_shadows_that_move_are_dropped_and_the_road_stays(
    shadows: tuple[SimulatedDrive, np.ndarray], for_map: bool
) -> None:
    simulated, moving = shadows
    mapper = mapped(simulated)
    judgement = assess_road(mapper, for_map=for_map)
    assert isinstance(judgement, RoadAssessment)
    assert judgement.source is RoadSource.MASKS
    wrong = is_moving(mapper, simulated, moving, judgement.tracks)
    height = judgement.points_m[:, 2]
    # Far beyond both ends of the way there are only points of shadows, which make a road of their own.
    way = simulated.world_from_rig[:, :3, 3]
    near = np.linalg.norm(judgement.points_m[:, None] - way[None], axis=2).min(1) < 40.0
    off = near & (np.abs(height) > 0.1)
    assert (wrong & off).sum() > 100
    assert (~judgement.is_inlier)[wrong & off].mean() > (0.97 if for_map else 0.85)
    assert 0.9 < judgement.is_inlier[~wrong & (np.abs(height) < 0.05)].mean() <= 1.0
    assert abs(judgement.fitted.rig_height_m) < 0.05
    assert 0 < judgement.road.thickness_after.range90_m < 0.5 * judgement.road.thickness_before.range90_m


def test_what_was_dropped_waits_until_all_are_tried_again(shadows: tuple[SimulatedDrive, np.ndarray]) -> None:
    simulated, _ = shadows
    mapper = mapped(simulated)
    before = mapper.triangulated.copy()
    judgement = drop_off_road(mapper)
    assert isinstance(judgement, RoadAssessment)
    dropped = judgement.tracks[~judgement.is_inlier]
    assert len(dropped) > 50
    assert not mapper.triangulated[dropped].any()
    rows = np.flatnonzero(mapper.is_inlier)
    assert not np.isin(mapper.tracks.of_keypoint[rows], dropped).any()
    mapper.extend(UNITS - 1)
    assert not mapper.triangulated[dropped].any()
    mapper.readmit()
    assert mapper.triangulated[dropped].all()
    assert not mapper.rejected.any()
    drop_off_road(mapper)
    mapper.complete()
    assert (mapper.triangulated & before).sum() > 0.99 * before.sum()


def test_far_points_may_scatter_more(shadows: tuple[SimulatedDrive, np.ndarray]) -> None:
    simulated, _ = shadows
    mapper = mapped(simulated)
    tracks = np.flatnonzero(mapper.triangulated & (mapper.track_class == ROAD))
    sigma = height_sigmas_m(mapper, tracks, mapper.state.world_from_rig)
    away = np.abs(mapper.state.points_m[tracks, 2])
    nearest, farthest = sigma < np.quantile(sigma, 0.2), sigma > np.quantile(sigma, 0.8)
    assert 3 * np.median(sigma[nearest]) < np.median(sigma[farthest])
    assert 2 * np.median(away[nearest]) < np.median(away[farthest])
    judgement = assess_road(mapper, for_map=False)
    assert isinstance(judgement, RoadAssessment)
    assert judgement.limit_m[farthest].min() > 2 * judgement.limit_m[nearest].min()
    for_map = assess_road(mapper, for_map=True)
    assert isinstance(for_map, RoadAssessment)
    assert for_map.limit_m.max() <= max(0.05, 3 * for_map.fitted.roughness_m) + 1e-9


def test_without_masks_only_what_cannot_stand_is_dropped() -> None:
    simulated, moving = drive_over_shadows(masks=False)
    mapper = mapped(simulated)
    judgement = assess_road(mapper, for_map=True)
    assert isinstance(judgement, RoadAssessment)
    assert judgement.source is RoadSource.GEOMETRY
    wrong = is_moving(mapper, simulated, moving, judgement.tracks)
    dropped = ~judgement.is_inlier
    assert dropped[wrong].sum() > 10
    assert dropped[wrong].sum() > 3 * dropped[~wrong & (np.abs(judgement.points_m[:, 2]) < 0.05)].sum()
    beside = np.abs(judgement.points_m[:, 2]) < 0.05
    assert judgement.is_inlier[~wrong & beside].mean() > 0.95


def test_cameras_that_do_not_see_the_road_change_nothing() -> None:
    simulated = make_simulated_drive(units=6, cameras=4, points=1500, clutter=0)
    above = [simulated.truth.points_m[p, 2] > 0.5 for p in simulated.point_of_keypoint]
    features, points = [], []
    for found, of, seen in zip(simulated.features, simulated.point_of_keypoint, above, strict=True):
        features.append(
            replace(
                found,
                xy_px=found.xy_px[seen],
                descriptors=found.descriptors[seen],
                colors=found.colors[seen],
                classes=np.zeros(0, np.uint8),
            )
        )
        points.append(of[seen])
    simulated = replace(simulated, features=features, point_of_keypoint=points)
    pairs, results = true_matches(simulated), []
    for config in (ON, OFF):
        mapper = make_model(simulated, pairs, config)
        log = run_incremental_mapping(mapper, pairs, None)
        refinement = refine(mapper)
        results.append((mapper, log, refinement))
    (on, log, refinement), (off, _, switched_off) = results
    np.testing.assert_array_equal(on.state.points_m[on.triangulated], off.state.points_m[off.triangulated])
    np.testing.assert_array_equal(on.state.world_from_rig, off.state.world_from_rig)
    assert sum(describe(on, log)["road_points_dropped"]) == 0
    said = describe_refinement(on, refinement)["road"]
    assert said["source"] is None
    assert "below the vehicle's trajectory" in said["reason"]
    assert "switched off" in describe_refinement(off, switched_off)["road"]["reason"]


def test_points_that_an_adjustment_moves_away_are_on_no_patch(shadows: tuple[SimulatedDrive, np.ndarray]) -> None:
    simulated, _ = shadows
    mapper = mapped(simulated)
    judgement = drop_off_road(mapper, for_map=True)
    assert isinstance(judgement, RoadAssessment)
    points_m = mapper.state.points_m
    on = judgement.tracks[judgement.patches_of(points_m[judgement.tracks]) >= 0]
    assert len(on) > 100
    np.testing.assert_array_equal(np.isin(judgement.tracks, on), judgement.is_on_surface)
    points_m[on[:10], 0] += 500.0
    points_m[on[10:20], 2] += 3.0
    patches = judgement.patches_of(points_m[judgement.tracks])
    np.testing.assert_array_equal(judgement.tracks[patches >= 0], on[20:])
    assert road_where_points_are(mapper, judgement) is judgement


def test_a_road_that_all_points_have_left_is_no_road(shadows: tuple[SimulatedDrive, np.ndarray]) -> None:
    simulated, _ = shadows
    mapper = mapped(simulated)
    judgement = drop_off_road(mapper, for_map=True)
    mapper.state.points_m[:, 2] += 3.0
    mapper.triangulated[judgement.tracks if isinstance(judgement, RoadAssessment) else []] = False
    found = road_where_points_are(mapper, judgement)
    assert isinstance(found, str)
    assert "too few" in found


def test_bad_road_points_do_not_pull_the_poses(shadows: tuple[SimulatedDrive, np.ndarray]) -> None:
    simulated, moving = shadows
    mapper = mapped(simulated)
    refinement = refine(mapper)
    assert isinstance(refinement.road, RoadAssessment)
    report = describe_refinement(mapper, refinement)["road"]
    assert report["source"] == "masks"
    assert report["kept"] + report["dropped"] == report["points"]
    assert report["patches"] == len(refinement.road.fitted.surface) > 3
    assert 0 < report["thickness_after_m"] < 0.5 * report["thickness_before_m"]
    assert 0 < report["spread_after_m"] <= report["spread_before_m"]
    error = np.linalg.norm(mapper.state.unit_position_m - simulated.world_from_rig[:, :3, 3], axis=1)
    assert 0 < error.max() < 0.02
    left = np.flatnonzero(mapper.triangulated & (mapper.track_class == ROAD))
    assert 0 < np.percentile(np.abs(mapper.state.points_m[left, 2]), 90) < 0.06
    assert moving.any()


def test_classes_of_tracks_are_those_of_most_of_their_keypoints(shadows: tuple[SimulatedDrive, np.ndarray]) -> None:
    simulated, _ = shadows
    keypoints = Keypoints.from_features(simulated.drive, simulated.features)
    assert len(keypoints.classes) == len(keypoints.image)
    mapper = mapped(simulated)
    point = shown_points(mapper, simulated)
    expected = np.where(simulated.truth.points_m[point, 2] == 0.0, ROAD, 1)
    assert (mapper.track_class == expected).mean() > 0.999


def test_one_mask_does_not_switch_off_what_geometry_says_of_the_other_images() -> None:
    simulated, _ = drive_over_shadows(masks=False)
    alone = assess_road(mapped(simulated), for_map=True)
    first = replace(simulated.features[0], classes=np.full(len(simulated.features[0].xy_px), 1, np.uint8))
    one = assess_road(mapped(replace(simulated, features=[first, *simulated.features[1:]])), for_map=True)
    assert isinstance(alone, RoadAssessment)
    assert isinstance(one, RoadAssessment)
    assert one.source is RoadSource.GEOMETRY
    # What the mask says is not road is none; of the rest geometry judges as before.
    assert 50 < len(one.tracks) < len(alone.tracks)
    assert set(one.tracks.tolist()) <= set(alone.tracks.tolist())
