from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.config import EngineConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.mapping.calibration import scale_with_baselines
from mrasfm_engine.mapping.incremental_mapping import MappingLog, grow
from mrasfm_engine.mapping.mapper import Model
from mrasfm_engine.mapping.mapping_report import describe_refinement, motion_findings
from mrasfm_engine.mapping.refinement import Refinement
from mrasfm_engine.mapping.unit_registration import register_unit
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.synthetic.simulate import poses_along
from tests.helpers.simulated_drive import (
    FIRST_US,
    SimulatedDrive,
    make_model,
    make_simulated_drive,
    metric_errors_m,
    rmse,
    true_matches,
)

SKEW_MS = [0, 40, -35, 25, -20, 50]
SPACING_M = 1.1


def settings(**mapping: object) -> EngineConfig:
    default = EngineConfig(threads=1)
    return default.model_copy(
        update={
            "mapping": default.mapping.model_copy(update=mapping),
            "adjustment": default.adjustment.model_copy(update={"refine_calibration": False}),
        }
    )


def skewed(**options: object) -> SimulatedDrive:
    drive = {"units": 10, "cameras": 6, "points": 1500, "time_offset_ms": SKEW_MS, "noise_px": 0.2}
    return make_simulated_drive(**{**drive, **options})  # type: ignore[arg-type]


def true_unit_from_image(simulated: SimulatedDrive, model: Model) -> np.ndarray:
    images = simulated.drive.images
    offset_s = np.array([(i.timestamp_us - int(simulated.drive.timestamps_us[i.unit])) / 1e6 for i in images])
    unit = np.array([i.unit for i in images])
    then = poses_along((unit + 10 * offset_s) * SPACING_M, spacing_m=SPACING_M)
    return se3.inverse(simulated.world_from_rig[unit]) @ then


def place_truly(model: Model, simulated: SimulatedDrive) -> None:
    for u, pose in enumerate(simulated.world_from_rig):
        model.set_pose(u, pose)
    model.renew_motion()


def reprojection_px(model: Model) -> np.ndarray:
    rows = model.observation_rows()
    return model.triangulator.errors_px(model.state, rows, model.state.points_m, model.tracks.of_keypoint[rows])


def point_errors_m(model: Model, simulated: SimulatedDrive) -> np.ndarray:
    rows = np.flatnonzero(model.kept)
    point = np.concatenate(simulated.point_of_keypoint)
    true = np.full((len(model.solved), 3), np.nan)
    true[model.tracks.of_keypoint[rows]] = simulated.truth.points_m[point[rows]]
    return np.linalg.norm(model.state.points_m - true, axis=1)[model.solved]


def test_the_motion_between_a_units_images_follows_from_its_neighbours() -> None:
    simulated = skewed()
    model = make_model(simulated)
    place_truly(model, simulated)
    error = se3.inverse(true_unit_from_image(simulated, model)) @ model.motion.unit_from_image(model.state)
    assert 1e-6 < np.linalg.norm(error[:, :3, 3], axis=1).max() < 0.005
    assert 1e-4 < se3.rotation_angle_deg(error[:, :3, :3]).max() < 0.1
    largest = model.motion.largest(model.state, model.registered)
    assert 0.5 < largest.translation_m < 0.6
    assert 0.1 < largest.rotation_deg < 3.0


def test_points_of_a_skewed_drive_fit_only_with_the_motion() -> None:
    simulated = skewed()
    with_motion, without = (make_model(simulated, config=settings(motion_compensation=on)) for on in (True, False))
    for model in (with_motion, without):
        place_truly(model, simulated)
        model.triangulate()
    assert without.state.simultaneous
    assert 0.1 < np.median(reprojection_px(with_motion)) < 0.4
    assert with_motion.kept.sum() > 1.2 * without.kept.sum()
    error_m = np.median(point_errors_m(with_motion, simulated))
    assert 1e-3 < error_m < 0.06
    assert np.median(point_errors_m(without, simulated)) > 5 * error_m


def test_a_unit_is_registered_with_the_motion_of_its_neighbours() -> None:
    simulated = skewed()
    model, unit = make_model(simulated), 5
    place_truly(model, simulated)
    model.registered[unit] = False
    model.renew_motion()
    model.triangulate()
    model.motion.predict(model.state, model.registered, unit)
    result = register_unit(model, unit)
    assert result.world_from_rig is not None
    assert result.voted_out == ()
    true = simulated.world_from_rig[unit]
    assert 1e-5 < np.linalg.norm(result.world_from_rig[:3, 3] - true[:3, 3]) < 0.02
    assert result.inliers > 0.9 * result.correspondences


@pytest.mark.parametrize("with_prior", [True, False])
def test_pitfall_1_a_skewed_drive_is_mapped_as_well_as_a_simultaneous_one(with_prior: bool) -> None:
    def mapped(simulated: SimulatedDrive, config: EngineConfig) -> tuple[Model, MappingLog]:
        pairs = true_matches(simulated)
        model = make_model(simulated, pairs, config)
        prior = simulated.world_from_rig.copy() if with_prior else None
        if prior is not None:
            prior[:, :3, 3] += np.random.default_rng(0).normal(size=(len(prior), 3)) * 0.3
            model.motion.follow_prior(prior)
        return model, grow(model, pairs, prior)

    simulated = skewed()
    model, log = mapped(simulated, settings())
    assert model.registered.all()
    assert not [r for r in log.registrations if r.voted_out]
    error_m = rmse(metric_errors_m(model, simulated))
    assert 1e-4 < error_m < 0.02
    ignored, _ = mapped(simulated, settings(motion_compensation=False))
    assert rmse(metric_errors_m(ignored, simulated)) > 5 * error_m


def test_rows_of_a_rolling_shutter_have_their_own_times() -> None:
    simulated = skewed(time_offset_ms=None, readout_ms=30, cameras=2, points=1200, noise_px=0.1)
    model, without = make_model(simulated), make_model(simulated, config=settings(motion_compensation=False))
    shots = model.motion.shots
    assert len(shots) == 61 * len(simulated.drive.images)
    np.testing.assert_array_equal(shots.time_offset_s[shots.middle_of_image], 0.0)
    for m in (model, without):
        place_truly(m, simulated)
        m.triangulate()
    assert 0.05 < np.median(reprojection_px(model)) < 0.2
    error_m = np.median(point_errors_m(model, simulated))
    assert 1e-3 < error_m < 0.04
    assert np.median(point_errors_m(without, simulated)) > 5 * error_m


def in_time(simulated: SimulatedDrive, time_s: list[float]) -> SimulatedDrive:
    """The drive at other times of its units; images are as far from them as before."""
    manifest = simulated.drive.manifest
    frames = []
    for frame, t in zip(manifest.frames, time_s, strict=True):
        later_us = FIRST_US + round(1e6 * t) - frame.timestamp_us
        images = {
            name: image.model_copy(update={"timestamp_us": (image.timestamp_us or frame.timestamp_us) + later_us})
            for name, image in frame.images.items()
        }
        frames.append(frame.model_copy(update={"timestamp_us": frame.timestamp_us + later_us, "images": images}))
    return replace(simulated, drive=Drive(simulated.drive.root, manifest.model_copy(update={"frames": frames})))


def test_units_far_from_all_others_are_counted_and_named_in_a_warning() -> None:
    simulated = in_time(skewed(units=7), [0.0, 0.1, 0.2, 5.0, 10.0, 10.1, 20.0])
    model = make_model(simulated)
    place_truly(model, simulated)
    assert model.motion.not_compensated(model.state, model.registered).tolist() == [3, 6]
    alone = model.motion.unit_from_image(model.state)[model.image_unit == 3]
    np.testing.assert_array_equal(alone, np.tile(np.eye(4), (6, 1, 1)))
    report = describe_refinement(model, Refinement(recalibrated=np.zeros(6, dtype=np.bool_)))
    assert report["motion_within_units"]["units_not_compensated"] == 2
    (said,) = motion_findings(model)
    assert said.code == "motion-not-compensated"
    assert "2 of 7 registered units" in said.what
    # Images with poses of their own are where they are, whatever their times.
    images = np.flatnonzero(model.image_unit == 3)
    model.set_image_poses(images, np.tile(np.eye(4), (len(images), 1, 1)))
    assert model.motion.not_compensated(model.state, model.registered).tolist() == [6]
    # A unit without a pose is not missed, but its neighbour is alone now.
    model.registered[5] = False
    assert model.motion.not_compensated(model.state, model.registered).tolist() == [4, 6]


def test_a_prior_tells_the_motion_where_no_registered_unit_does() -> None:
    simulated = skewed(units=5)
    model = make_model(simulated)
    model.set_pose(2, simulated.world_from_rig[2])
    assert len(motion_findings(model)) == 1
    model.motion.follow_prior(simulated.world_from_rig)
    assert motion_findings(model) == []


def test_nothing_is_to_be_compensated_where_images_are_simultaneous_or_it_is_switched_off() -> None:
    alone = [4.0 * u for u in range(3)]
    off, at_once = settings(motion_compensation=False), skewed(units=3, time_offset_ms=None)
    for simulated, config in ((skewed(units=3), off), (at_once, settings())):
        drive = in_time(simulated, alone)
        model = make_model(drive, config=config)
        place_truly(model, drive)
        assert motion_findings(model) == []


def test_simultaneous_images_need_no_shots() -> None:
    simulated = make_simulated_drive(units=4, cameras=2, points=400)
    model = make_model(simulated)
    assert not model.motion.needed
    assert model.state.simultaneous
    assert model.renew_motion() == 0.0
    np.testing.assert_array_equal(model.keypoints.shot, model.keypoints.image)
    np.testing.assert_array_equal(model.motion.unit_from_image(model.state), np.tile(np.eye(4), (8, 1, 1)))


def test_jitter_of_the_clocks_is_no_motion() -> None:
    simulated = make_simulated_drive(units=4, cameras=2, points=400)
    for frame in simulated.drive.manifest.frames:
        for k, (name, image) in enumerate(frame.images.items()):
            frame.images[name] = image.model_copy(update={"timestamp_us": frame.timestamp_us + 200 * k})
    assert not make_model(simulated).motion.needed


def test_an_image_can_have_a_pose_of_its_own() -> None:
    simulated = skewed()
    model, image = make_model(simulated), 14
    place_truly(model, simulated)
    before = model.motion.unit_from_image(model.state)
    own = se3.transform(se3.exp_so3([0.0, 0.0, 0.02]), [0.3, -0.1, 0.05])
    model.set_image_pose(image, own)
    model.renew_motion()
    after = model.motion.unit_from_image(model.state)
    np.testing.assert_allclose(after[image], own, atol=1e-12)
    others = np.arange(len(after)) != image
    np.testing.assert_array_equal(after[others], before[others])


def test_an_image_of_a_simultaneous_drive_can_have_a_pose_of_its_own() -> None:
    simulated = make_simulated_drive(units=4, cameras=2, points=400)
    model = make_model(simulated)
    place_truly(model, simulated)
    model.triangulate()
    good = reprojection_px(model)
    own = se3.transform(np.eye(3), [0.5, 0.0, 0.0])
    model.set_image_pose(3, own)
    np.testing.assert_allclose(model.motion.unit_from_image(model.state)[3], own)
    rows = model.observation_rows()
    moved = model.keypoints.image[rows] == 3
    assert np.median(reprojection_px(model)[moved]) > 5 * np.median(good[moved])
    np.testing.assert_allclose(reprojection_px(model)[~moved], good[~moved], atol=1e-9)


def test_a_unit_that_is_forgotten_leaves_no_pose_of_its_images() -> None:
    simulated = skewed()
    model = make_model(simulated)
    place_truly(model, simulated)
    before = model.motion.unit_from_image(model.state)
    pushed = before.copy()
    pushed[:, 0, 3] += 0.3
    images = np.flatnonzero(np.isin(model.image_unit, [3, 4]))
    model.set_image_poses(images, pushed[images])
    model.forget(np.array([3]))
    assert not model.motion.own_poses[0][model.image_unit == 3].any()
    assert model.motion.own_poses[0][model.image_unit == 4].all()
    model.clear()
    assert not model.motion.own_poses[0].any()


def test_own_poses_and_rows_go_together() -> None:
    simulated = skewed(time_offset_ms=None, readout_ms=30, cameras=2)
    model = make_model(simulated)
    place_truly(model, simulated)
    shots, image = model.motion.shots, 7
    rows = np.arange(shots.first_of_image[image], shots.first_of_image[image + 1])
    before = model.state.unit_from_shot[rows]
    own = se3.transform(se3.exp_so3([0.01, 0.0, 0.02]), [0.1, 0.2, 0.0])
    model.set_image_pose(image, own)
    np.testing.assert_allclose(model.state.unit_from_shot[rows], own @ before, atol=1e-12)


def test_scaling_the_scene_changes_no_image() -> None:
    simulated = skewed()
    model = make_model(simulated)
    place_truly(model, simulated)
    model.triangulate()
    before = reprojection_px(model)
    scale_with_baselines(model, 1.2)
    np.testing.assert_allclose(reprojection_px(model), before, atol=1e-7)
