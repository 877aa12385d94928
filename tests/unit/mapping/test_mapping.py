from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.bundle_adjustment.solver import SolverOptions
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import CancelledError, ReconstructionError
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.alignment import align_similarity
from mrasfm_engine.mapping.calibration import heading_change_deg
from mrasfm_engine.mapping.incremental_mapping import MappingLog, run_incremental_mapping
from mrasfm_engine.mapping.initialization import UnitScores, initialise
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.mapping_report import (
    contradicting_image_findings,
    covered_camera_findings,
    describe,
    idle_camera_findings,
)
from mrasfm_engine.mapping.pose_adjustment import adjust_poses
from mrasfm_engine.mapping.refinement import refine
from tests.helpers.simulated_drive import (
    SimulatedDrive,
    make_model,
    make_simulated_drive,
    metric_errors_m,
    rmse,
    scaled_rig,
    true_matches,
    with_true_poses,
)
from tests.helpers.slow import slow

HELD = EngineConfig(threads=1).model_copy(
    update={"bundle_adjustment": EngineConfig().bundle_adjustment.model_copy(update={"refine_calibration": False})}
)


def reconstruct(
    simulated: SimulatedDrive, *, prior: np.ndarray | None = None, config: EngineConfig = HELD, wrong: int = 0
) -> tuple[Mapper, MappingLog]:
    pairs = true_matches(simulated, wrong=wrong)
    mapper = make_model(simulated, pairs, config)
    return mapper, run_incremental_mapping(mapper, pairs, prior)


@pytest.mark.parametrize("wrong", [0, 2])
@pytest.mark.parametrize(("cameras", "points"), [(6, 1200), (2, 1000)])
def test_a_drive_is_mapped_end_to_end(cameras: int, points: int, wrong: int) -> None:
    simulated = make_simulated_drive(units=12, cameras=cameras, points=points)
    mapper, log = reconstruct(simulated, wrong=wrong)
    assert mapper.registered.all()
    assert log.initialisation is not None
    assert {r.unit for r in log.registrations} | set(log.initialisation.units) == set(range(12))
    assert log.global_adjustments
    assert 1e-4 < rmse(metric_errors_m(mapper, simulated)) < 0.02
    assert mapper.triangulated.sum() > 0.6 * len(simulated.truth.points_m)
    rows = mapper.observation_rows()
    errors = mapper.triangulator.errors_px(mapper.state, rows, mapper.state.points_m, mapper.tracks.of_keypoint[rows])
    assert 0.2 < np.median(errors) < 0.8  # 0.4 px of noise in each coordinate
    np.testing.assert_array_equal(mapper.state.rig_from_cam, simulated.drive.rig_from_cam)
    report = describe(mapper, log)
    assert report["registered_units"] == 12
    assert report["units_not_registered"] == []
    assert report["points"] == mapper.triangulated.sum()


@pytest.mark.parametrize("cameras", [6, 2])
def test_scale_is_the_rigs_and_never_normalised(cameras: int) -> None:
    """With baselines given 1.5 times as long, the same images are a scene 1.5 times as large."""
    ways = []
    for scale in (1.0, 1.5):
        simulated = make_simulated_drive(
            units=8, cameras=cameras, points=1000, given=lambda rig, scale=scale: scaled_rig(rig, scale)
        )
        mapper, _ = reconstruct(simulated)
        assert mapper.registered.all()
        ways.append(align_similarity(mapper.state.unit_position_m, simulated.world_from_rig[:, :3, 3]).scale)
    assert ways[0] == pytest.approx(1.0, abs=0.01)
    assert ways[1] == pytest.approx(1.5, abs=0.015)


def test_one_wrong_extrinsic_does_not_ruin_the_drive() -> None:
    def given(rig_from_cam: np.ndarray) -> np.ndarray:
        rig_from_cam[3, :3, :3] = se3.exp_so3(np.radians([0.0, 0.0, 4.0])) @ rig_from_cam[3, :3, :3]
        return rig_from_cam

    simulated = make_simulated_drive(units=10, cameras=6, points=1200, given=given)
    mapper, log = reconstruct(simulated)
    assert mapper.registered.all()
    assert 1e-4 < rmse(metric_errors_m(mapper, simulated)) < 0.15
    voted_out = [name for r in log.registrations for name in r.voted_out]
    assert set(voted_out) <= {simulated.drive.cameras[3].name}


def test_a_camera_occluded_for_half_of_the_drive() -> None:
    simulated = make_simulated_drive(
        units=12, cameras=6, points=1200, hidden=lambda unit, camera: camera == 0 and unit >= 6
    )
    mapper, _ = reconstruct(simulated)
    assert mapper.registered.all()
    assert 1e-4 < rmse(metric_errors_m(mapper, simulated)) < 0.03


@pytest.mark.parametrize("blind", [0, 6, 11])
def test_a_unit_that_sees_nothing_is_reported_not_lost(blind: int) -> None:
    simulated = make_simulated_drive(units=12, cameras=2, points=900, hidden=lambda unit, camera: unit == blind)
    mapper, log = reconstruct(simulated)
    assert np.flatnonzero(~mapper.registered).tolist() == [blind]
    missing = describe(mapper, log)["units_not_registered"]
    assert [(m["unit"], m["source_frame"]) for m in missing] == [(blind, blind)]
    assert missing[0]["reason"]
    assert 1e-4 < rmse(metric_errors_m(mapper, simulated)) < 0.03


def test_a_drive_in_two_pieces_is_not_forced_together() -> None:
    """Between units 5 and 6 nothing matches: one piece is mapped, the other reported."""
    simulated = make_simulated_drive(units=12, cameras=2, points=900)
    pairs = [
        p
        for p in true_matches(simulated)
        if (simulated.drive.images[p.image_a].unit < 6) == (simulated.drive.images[p.image_b].unit < 6)
    ]
    mapper = make_model(simulated, pairs, HELD)
    log = run_incremental_mapping(mapper, pairs, None)
    assert mapper.registered[:6].all() != mapper.registered[6:].all()
    assert mapper.registered.sum() == 6
    assert len(describe(mapper, log)["units_not_registered"]) == 6


def test_the_prior_puts_the_scene_into_its_frame() -> None:
    simulated = make_simulated_drive(units=8, cameras=2, points=800)
    rng = np.random.default_rng(0)
    move = se3.transform(se3.exp_so3([0.0, 0.0, 2.0]), [300.0, -200.0, 20.0])
    noise = se3.transform(se3.exp_so3(rng.normal(size=(8, 3)) * 0.01), rng.normal(size=(8, 3)) * 0.2)
    prior = move @ simulated.world_from_rig @ noise
    mapper, log = reconstruct(simulated, prior=prior)
    assert log.initialisation is not None
    u = log.initialisation.units[0]
    # Its later neighbours and it settle among themselves, by far less than the prior is off.
    np.testing.assert_allclose(mapper.state.world_from_rig[u], prior[u], atol=0.01)
    assert 1e-4 < rmse(metric_errors_m(mapper, simulated)) < 0.03


@pytest.mark.parametrize("cameras", [2, 6])
def test_initialisation_finds_the_relative_pose_of_two_units(cameras: int) -> None:
    simulated = make_simulated_drive(units=5, cameras=cameras, points=1200)
    pairs = true_matches(simulated)
    mapper = make_model(simulated, pairs, HELD)
    result = initialise(mapper, pairs, None)
    u, v = result.units
    assert mapper.registered.sum() == 2
    assert result.points >= 30
    found = se3.inverse(mapper.state.world_from_rig[u]) @ mapper.state.world_from_rig[v]
    true = se3.inverse(simulated.world_from_rig[u]) @ simulated.world_from_rig[v]
    assert 1e-5 < np.linalg.norm(found[:3, 3] - true[:3, 3]) < 0.1
    assert 1e-5 < float(se3.rotation_angle_deg(found[:3, :3] @ true[:3, :3].T)) < 0.2


@pytest.mark.parametrize(
    ("cameras", "used", "error_deg", "seed"), [(6, (0, 5), 0.5, 2), (6, (0, 5), 1.0, 1), (4, (0, 1), 1.0, 2)]
)
def test_a_straight_way_has_a_length_that_a_vehicle_drives(
    cameras: int, used: tuple[int, ...], error_deg: float, seed: int
) -> None:
    """Cameras that share no view hardly tell how far a vehicle goes that does not turn. From whatever length the first
    two units begin with, hundreds of times too long, the scene would never come back."""
    rng = np.random.default_rng(seed)

    def turned(rig_from_cam: np.ndarray) -> np.ndarray:
        turns = se3.exp_so3(np.radians(error_deg) * rng.normal(size=(len(rig_from_cam), 3)))
        return se3.transform(turns @ rig_from_cam[:, :3, :3], rig_from_cam[:, :3, 3])

    simulated = make_simulated_drive(
        units=16,
        cameras=cameras,
        points=1500,
        straight=True,
        seed=seed,
        given=turned,
        hidden=lambda unit, camera: camera not in used,
    )
    mapper, _ = reconstruct(simulated, config=EngineConfig(threads=1))
    assert mapper.registered.all()
    refined = refine(mapper)
    found_m, true_m = (
        np.linalg.norm(p[-1] - p[0]) for p in (mapper.state.unit_position_m, simulated.truth.world_from_rig[:, :3, 3])
    )
    assert refined.certainty is not None
    assert 0.5 < found_m / true_m < 2.0
    assert abs(np.log(found_m / true_m)) < 3.0 * refined.certainty.sigma_scale < 6.0


def test_nothing_in_common_is_an_error_that_says_so() -> None:
    simulated = make_simulated_drive(units=3, cameras=2, points=100)
    mapper = make_model(simulated, [])
    with pytest.raises(ReconstructionError, match="0 image pairs") as caught:
        run_incremental_mapping(mapper, [], None)
    assert caught.value.code == "nothing-matches"


def test_the_units_with_most_in_common() -> None:
    simulated = make_simulated_drive(units=5, cameras=2, points=500)
    pairs = true_matches(simulated)
    pairs[0].inliers[:5] = False
    mapper = make_model(simulated, pairs)
    scores = UnitScores.from_pairs(mapper, pairs)
    moving = {units: scores.moving(*units) for units in scores.between}
    assert scores.inside.sum() + sum(moving.values()) == sum(int(p.inliers.sum()) for p in pairs)
    assert (scores.inside > 0).all()
    for gap in {v - u for u, v in moving}:
        score = {(u, v): moving[u, v] + scores.inside[u] + scores.inside[v] for u, v in moving if v - u == gap}
        assert score[scores.best_of_gap(gap)] == max(score.values())


def test_units_that_stand_have_nothing_in_common() -> None:
    """However many matches they have: without motion they are no points."""
    simulated = make_simulated_drive(units=3, cameras=2, points=500)
    pairs = true_matches(simulated)
    mapper = make_model(simulated, pairs)
    for pair in pairs:
        if (mapper.image_unit[[pair.image_a, pair.image_b]] == [0, 1]).all():
            a, b = mapper.matched_keypoints(pair, 0)
            mapper.keypoints.rays[b] = mapper.keypoints.rays[a]
    scores = UnitScores.from_pairs(mapper, pairs)
    assert scores.moving(0, 1) < 0.5 * scores.moving(1, 2)
    assert scores.best_of_gap(1) == (1, 2)


def test_cancelling() -> None:
    simulated = make_simulated_drive(units=6, cameras=2, points=600)
    pairs = true_matches(simulated)
    with pytest.raises(CancelledError):
        run_incremental_mapping(make_model(simulated, pairs, HELD), pairs, None, cancel=lambda: True)


def test_progress_counts_up_to_all_units() -> None:
    simulated = make_simulated_drive(units=6, cameras=2, points=600)
    pairs, calls = true_matches(simulated), []
    run_incremental_mapping(
        make_model(simulated, pairs, HELD), pairs, None, progress=lambda done, total: calls.append((done, total))
    )
    assert calls == [(k, 6) for k in range(3, 7)]


def test_the_same_seed_gives_the_same_scene() -> None:
    simulated = make_simulated_drive(units=5, cameras=2, points=600)
    a, b = (reconstruct(simulated)[0] for _ in range(2))
    np.testing.assert_array_equal(a.state.unit_position_m, b.state.unit_position_m)
    np.testing.assert_array_equal(a.triangulated, b.triangulated)


def test_calibration_is_refined_where_the_drive_turns() -> None:
    def given(rig_from_cam: np.ndarray) -> np.ndarray:
        rng = np.random.default_rng(1)
        turn = se3.exp_so3(np.radians(rng.normal(size=(len(rig_from_cam), 3)) * 0.5))
        rig_from_cam[:, :3, :3] = turn @ rig_from_cam[:, :3, :3]
        return rig_from_cam

    simulated = make_simulated_drive(units=24, cameras=4, points=2000, spacing_m=2.0, given=given)
    mapper, _ = reconstruct(simulated, config=EngineConfig(threads=1))
    assert heading_change_deg(mapper) > 15

    def worst(rig_from_cam: np.ndarray) -> float:
        own, true = (
            np.swapaxes(m[[0], :3, :3], 1, 2) @ m[:, :3, :3] for m in (rig_from_cam, simulated.truth.rig_from_cam)
        )
        return float(se3.rotation_angle_deg(own @ np.swapaxes(true, 1, 2)).max())

    assert worst(simulated.drive.rig_from_cam) > 0.5
    assert 1e-3 < worst(mapper.state.rig_from_cam) < 0.1


@pytest.mark.parametrize("off_deg", [0.0, 0.03])
def test_on_a_straight_street_a_calibration_that_is_nearly_right_has_its_say(off_deg: float) -> None:
    """Its rotations know the scale about as well as images do whose lens models are off by half a pixel."""
    simulated = make_simulated_drive(units=24, cameras=2, points=1500, straight=True, given=turned_away(off_deg))
    mapper, _ = reconstruct(simulated, config=EngineConfig(threads=1))
    assert heading_change_deg(mapper) < 5
    assert np.abs(mapper.state.rig_from_cam - simulated.drive.rig_from_cam).max() > 1e-5  # it varies while mapping
    result = refine(mapper)
    assert result.calibration.free
    assert result.given_scale is not None
    assert 1e-4 < rmse(metric_errors_m(mapper, simulated)) < (0.03 if off_deg == 0.0 else 0.2)


@pytest.mark.parametrize("off_deg", [-1.5, 0.5, *slow(-0.5, 1.5)])
def test_a_camera_that_looks_aside_does_not_decide_the_scale(off_deg: float) -> None:
    """Turned about the vertical, the second of two cameras sees all points nearer or farther than they are."""
    simulated = make_simulated_drive(units=24, cameras=2, points=1500, straight=True, given=turned_away(off_deg))
    mapper, _ = reconstruct(simulated, config=EngineConfig(threads=1))
    assert mapper.registered.all()
    result = refine(mapper)
    assert result.calibration.free
    scale = align_similarity(mapper.state.unit_position_m, simulated.world_from_rig[:, :3, 3]).scale
    assert abs(scale - 1) < 0.03
    between, true = (
        rig[0, :3, :3].T @ rig[1, :3, :3] for rig in (mapper.state.rig_from_cam, simulated.truth.rig_from_cam)
    )
    assert 0 < se3.rotation_angle_deg(between @ true.T) < 0.05


def test_gates_hold_a_camera_that_looks_aside_and_lose_the_scale() -> None:
    simulated = make_simulated_drive(units=24, cameras=2, points=1500, straight=True, given=turned_away(0.5))
    settings = EngineConfig().bundle_adjustment.model_copy(update={"reassessment": False})
    mapper, _ = reconstruct(simulated, config=EngineConfig(threads=1, bundle_adjustment=settings))
    result = refine(mapper)
    assert not result.calibration.free
    np.testing.assert_array_equal(mapper.state.rig_from_cam, simulated.drive.rig_from_cam)
    scale = align_similarity(mapper.state.unit_position_m, simulated.world_from_rig[:, :3, 3]).scale
    assert 0.05 < abs(scale - 1) < 1.0


def turned_away(off_deg: float):  # type: ignore[no-untyped-def]
    """What the manifest says of the cameras: the last one turned about the vertical."""

    def given(rig_from_cam: np.ndarray) -> np.ndarray:
        rig_from_cam[-1, :3, :3] = se3.exp_so3([0.0, 0.0, np.radians(off_deg)]) @ rig_from_cam[-1, :3, :3]
        return rig_from_cam

    return given


def posed_model() -> tuple[SimulatedDrive, Mapper]:
    simulated = make_simulated_drive(units=5, cameras=2, points=600)
    return simulated, with_true_poses(make_model(simulated), simulated, range(5))


def test_filter_drops_bad_observations_and_points_left_alone() -> None:
    _, mapper = posed_model()
    rows = mapper.observation_rows()
    track = mapper.tracks.of_keypoint[rows]
    alone = np.unique(track)[:10]  # all observations but the first of these points are bad
    first = np.searchsorted(track, alone)
    bad = np.setdiff1d(rows[np.isin(track, alone)], rows[first])
    mapper.keypoints.xy_px[bad] += 50.0
    before = mapper.is_inlier.sum()
    observations, points = mapper.filter(4.0)
    assert (observations, points) == (len(bad), 10)
    assert not mapper.triangulated[alone].any()
    assert mapper.is_inlier.sum() == before - len(bad) - 10
    counts = np.bincount(mapper.tracks.of_keypoint[np.flatnonzero(mapper.is_inlier)], minlength=len(mapper.tracks))
    assert ((counts >= 2) == mapper.triangulated).all()


def test_extend_gives_a_new_unit_its_observations() -> None:
    simulated = make_simulated_drive(units=5, cameras=2, points=600)
    mapper = with_true_poses(make_model(simulated), simulated, [0, 1, 2, 3])
    points, observations = mapper.triangulated.sum(), mapper.is_inlier.sum()
    mapper.set_pose(4, simulated.world_from_rig[4])
    mapper.extend(4)
    assert mapper.triangulated.sum() > points
    assert (mapper.keypoints.unit[mapper.is_inlier] == 4).sum() > 200
    assert mapper.is_inlier.sum() > observations + 200


def test_local_adjustment_moves_only_what_is_free() -> None:
    _, mapper = posed_model()
    mapper.state.unit_position_m[3] += 0.02
    before = mapper.state.unit_position_m.copy()
    report = adjust_poses(mapper, np.array([False, False, False, True, False]), options=SolverOptions())
    assert report.final_cost < report.initial_cost
    np.testing.assert_array_equal(mapper.state.unit_position_m[[0, 1, 2, 4]], before[[0, 1, 2, 4]])
    assert 0.01 < np.linalg.norm(mapper.state.unit_position_m[3] - before[3]) < 0.06


@pytest.mark.parametrize("kept", [0, 1])
def test_a_drive_of_which_the_adjustment_leaves_nothing_is_an_error(kept: int, monkeypatch: pytest.MonkeyPatch) -> None:
    _, mapper = posed_model()
    most = np.sort(np.bincount(mapper.keypoints.unit[mapper.is_inlier]))[-kept - 1]
    monkeypatch.setattr(mapper, "drop_unsupported", lambda _: Mapper.drop_unsupported(mapper, int(most) + 1 - kept))
    with pytest.raises(ReconstructionError, match="no two units keep enough") as caught:
        refine(mapper)
    assert caught.value.code == "contradictory-drive"


def test_clear_forgets_poses_and_points() -> None:
    _, mapper = posed_model()
    assert mapper.visible_counts().min() > 100
    mapper.clear()
    assert not mapper.registered.any()
    assert not mapper.triangulated.any()
    assert not mapper.is_inlier.any()
    assert not mapper.visible_counts().any()


def test_a_camera_whose_images_contradict_the_vehicle_all_along_is_a_finding() -> None:
    simulated = make_simulated_drive(units=8, cameras=3, points=300)
    mapper = with_true_poses(make_model(simulated), simulated, range(8))
    of_camera = [i for i, image in enumerate(simulated.drive.images) if image.camera == 1]
    name = simulated.drive.cameras[1].name
    log = MappingLog(covered_images=dict.fromkeys(of_camera[:7], 0.9))
    (finding,) = covered_camera_findings(mapper, log)
    assert finding.code == "camera-against-rig"
    assert f"7 of 8 images of camera {name}" in finding.what
    # A lorry beside the vehicle for half of the drive is none.
    assert covered_camera_findings(mapper, MappingLog(covered_images=dict.fromkeys(of_camera[:4], 0.9))) == []


def test_a_camera_that_observes_hardly_a_point_all_along_is_a_finding() -> None:
    simulated = make_simulated_drive(units=8, cameras=3, points=300)
    mapper = with_true_poses(make_model(simulated), simulated, range(8))
    mapper.complete()
    assert idle_camera_findings(mapper) == []
    of_camera = [i for i, image in enumerate(simulated.drive.images) if image.camera == 1]
    mapper.is_inlier &= ~np.isin(mapper.keypoints.image, of_camera[:7])
    (finding,) = idle_camera_findings(mapper)
    assert finding.code == "camera-without-points"
    assert f"of 8 images of camera {simulated.drive.cameras[1].name} have matches" in finding.what
    mapper.missing[of_camera] = True  # images that are left out have findings of their own
    assert idle_camera_findings(mapper) == []


def test_a_camera_whose_images_match_nothing_is_a_finding() -> None:
    """A lens cap that was left on, or a sensor that gives noise: the scene is sound without it."""
    simulated = make_simulated_drive(units=8, cameras=3, points=300)
    camera_of = [image.camera for image in simulated.drive.images]
    of_others = [
        pair for pair in true_matches(simulated) if 1 not in (camera_of[pair.image_a], camera_of[pair.image_b])
    ]
    mapper = with_true_poses(make_model(simulated, of_others), simulated, range(8))
    mapper.complete()
    (finding,) = idle_camera_findings(mapper)
    assert finding.code == "camera-without-matches"
    assert finding.what.startswith(f"8 of 8 images of camera {simulated.drive.cameras[1].name} have under")


def test_single_images_that_contradict_their_unit_are_a_finding() -> None:
    """One image of another camera in one frame: its unit has its pose from the others, and nothing else says so."""
    simulated = make_simulated_drive(units=8, cameras=3, points=300)
    mapper = with_true_poses(make_model(simulated), simulated, range(8))
    mapper.complete()
    assert contradicting_image_findings(mapper) == []
    image = next(i for i, one in enumerate(simulated.drive.images) if (one.unit, one.camera) == (4, 1))
    mapper.is_inlier &= mapper.keypoints.image != image
    (finding,) = contradicting_image_findings(mapper)
    assert finding.code == "images-against-rig"
    assert finding.what.startswith("1 of 24 images contradict the poses of their units: images/")
    assert finding.what.endswith(simulated.drive.images[image].file)
    # Nothing to say of one whose points were taken out, as those of a lorry are, or of one that matches nothing.
    mapper.triangulated[mapper.tracks.of_keypoint[mapper.keypoints.image == image]] = False
    assert contradicting_image_findings(mapper) == []
    mapper.tracks.of_keypoint[mapper.keypoints.image == image] = -1
    mapper.triangulated[-1] = True
    assert contradicting_image_findings(mapper) == []
