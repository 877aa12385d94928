from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.config import EngineConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.mapping.calibration import scale_with_baselines
from mrasfm_engine.mapping.incremental_mapping import MappingLog, run_incremental_mapping
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.mapping_report import describe_refinement, motion_findings
from mrasfm_engine.mapping.refinement_result import Refinement
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
from tests.helpers.slow import slow

SKEW_MS = [0, 40, -35, 25, -20, 50]
SPACING_M = 1.1


def settings(**mapping: object) -> EngineConfig:
    default = EngineConfig(threads=1)
    return default.model_copy(
        update={
            "mapping": default.mapping.model_copy(update=mapping),
            "bundle_adjustment": default.bundle_adjustment.model_copy(update={"refine_calibration": False}),
        }
    )


def skewed(**options: object) -> SimulatedDrive:
    drive = {"units": 10, "cameras": 6, "points": 1500, "time_offset_ms": SKEW_MS, "noise_px": 0.2}
    return make_simulated_drive(**{**drive, **options})


def true_unit_from_image(simulated: SimulatedDrive, mapper: Mapper) -> np.ndarray:
    images = simulated.drive.images
    offset_s = np.array([(i.timestamp_us - int(simulated.drive.timestamps_us[i.unit])) / 1e6 for i in images])
    unit = np.array([i.unit for i in images])
    then = poses_along((unit + 10 * offset_s) * SPACING_M, spacing_m=SPACING_M)
    return se3.inverse(simulated.world_from_rig[unit]) @ then


def place_truly(mapper: Mapper, simulated: SimulatedDrive) -> None:
    for u, pose in enumerate(simulated.world_from_rig):
        mapper.set_pose(u, pose)
    mapper.renew_motion()


def reprojection_px(mapper: Mapper) -> np.ndarray:
    rows = mapper.observation_rows()
    return mapper.triangulator.errors_px(mapper.state, rows, mapper.state.points_m, mapper.tracks.of_keypoint[rows])


def point_errors_m(mapper: Mapper, simulated: SimulatedDrive) -> np.ndarray:
    rows = np.flatnonzero(mapper.is_inlier)
    point = np.concatenate(simulated.point_of_keypoint)
    true = np.full((len(mapper.triangulated), 3), np.nan)
    true[mapper.tracks.of_keypoint[rows]] = simulated.truth.points_m[point[rows]]
    return np.linalg.norm(mapper.state.points_m - true, axis=1)[mapper.triangulated]


def test_the_motion_between_a_units_images_follows_from_its_neighbours() -> None:
    simulated = skewed()
    mapper = make_model(simulated)
    place_truly(mapper, simulated)
    error = se3.inverse(true_unit_from_image(simulated, mapper)) @ mapper.motion.unit_from_image(mapper.state)
    assert 1e-6 < np.linalg.norm(error[:, :3, 3], axis=1).max() < 0.005
    assert 1e-4 < se3.rotation_angle_deg(error[:, :3, :3]).max() < 0.1
    largest = mapper.motion.largest(mapper.state, mapper.registered)
    assert 0.5 < largest.translation_m < 0.6
    assert 0.1 < largest.rotation_deg < 3.0


def test_points_of_a_skewed_drive_fit_only_with_the_motion() -> None:
    simulated = skewed()
    with_motion, without = (make_model(simulated, config=settings(motion_compensation=on)) for on in (True, False))
    for mapper in (with_motion, without):
        place_truly(mapper, simulated)
        mapper.triangulate()
    assert without.state.simultaneous
    assert 0.1 < np.median(reprojection_px(with_motion)) < 0.4
    assert with_motion.is_inlier.sum() > 1.2 * without.is_inlier.sum()
    error_m = np.median(point_errors_m(with_motion, simulated))
    assert 1e-3 < error_m < 0.06
    assert np.median(point_errors_m(without, simulated)) > 5 * error_m


def test_a_unit_is_registered_with_the_motion_of_its_neighbours() -> None:
    simulated = skewed()
    mapper, unit = make_model(simulated), 5
    place_truly(mapper, simulated)
    mapper.registered[unit] = False
    mapper.renew_motion()
    mapper.triangulate()
    mapper.motion.predict(mapper.state, mapper.registered, unit)
    result = register_unit(mapper, unit)
    assert result.world_from_rig is not None
    assert result.voted_out == ()
    true = simulated.world_from_rig[unit]
    assert 1e-5 < np.linalg.norm(result.world_from_rig[:3, 3] - true[:3, 3]) < 0.02
    assert result.inliers > 0.9 * result.correspondences


@pytest.mark.parametrize("with_prior", [False, *slow(True)])
def test_a_skewed_drive_is_mapped_as_well_as_a_simultaneous_one(with_prior: bool) -> None:
    def mapped(simulated: SimulatedDrive, config: EngineConfig) -> tuple[Mapper, MappingLog]:
        pairs = true_matches(simulated)
        mapper = make_model(simulated, pairs, config)
        prior = simulated.world_from_rig.copy() if with_prior else None
        if prior is not None:
            prior[:, :3, 3] += np.random.default_rng(0).normal(size=(len(prior), 3)) * 0.3
            mapper.motion.follow_prior(prior)
        return mapper, run_incremental_mapping(mapper, pairs, prior)

    simulated = skewed()
    mapper, log = mapped(simulated, settings())
    assert mapper.registered.all()
    assert not [r for r in log.registrations if r.voted_out]
    error_m = rmse(metric_errors_m(mapper, simulated))
    assert 1e-4 < error_m < 0.02
    ignored, _ = mapped(simulated, settings(motion_compensation=False))
    assert rmse(metric_errors_m(ignored, simulated)) > 5 * error_m


def test_rows_of_a_rolling_shutter_have_their_own_times() -> None:
    simulated = skewed(time_offset_ms=None, readout_ms=30, cameras=2, points=1200, noise_px=0.1)
    mapper, without = make_model(simulated), make_model(simulated, config=settings(motion_compensation=False))
    bands = mapper.motion.bands
    assert len(bands) == 61 * len(simulated.drive.images)
    np.testing.assert_array_equal(bands.time_offset_s[bands.middle_of_image], 0.0)
    for m in (mapper, without):
        place_truly(m, simulated)
        m.triangulate()
    assert 0.05 < np.median(reprojection_px(mapper)) < 0.2
    error_m = np.median(point_errors_m(mapper, simulated))
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
    mapper = make_model(simulated)
    place_truly(mapper, simulated)
    assert mapper.motion.not_compensated(mapper.state, mapper.registered).tolist() == [3, 6]
    alone = mapper.motion.unit_from_image(mapper.state)[mapper.image_unit == 3]
    np.testing.assert_array_equal(alone, np.tile(np.eye(4), (6, 1, 1)))
    report = describe_refinement(mapper, Refinement(recalibrated=np.zeros(6, dtype=np.bool_)))
    assert report["motion_within_units"]["units_not_compensated"] == 2
    (said,) = motion_findings(mapper)
    assert said.code == "motion-not-compensated"
    assert "2 of 7 registered units" in said.what
    # Images with poses of their own are where they are, whatever their times.
    images = np.flatnonzero(mapper.image_unit == 3)
    mapper.set_image_poses(images, np.tile(np.eye(4), (len(images), 1, 1)))
    assert mapper.motion.not_compensated(mapper.state, mapper.registered).tolist() == [6]
    # A unit without a pose is not missed, but its neighbour is alone now.
    mapper.registered[5] = False
    assert mapper.motion.not_compensated(mapper.state, mapper.registered).tolist() == [4, 6]


def test_a_prior_tells_the_motion_where_no_registered_unit_does() -> None:
    simulated = skewed(units=5)
    mapper = make_model(simulated)
    mapper.set_pose(2, simulated.world_from_rig[2])
    assert len(motion_findings(mapper)) == 1
    mapper.motion.follow_prior(simulated.world_from_rig)
    assert motion_findings(mapper) == []


def test_nothing_is_to_be_compensated_where_images_are_simultaneous_or_it_is_switched_off() -> None:
    alone = [4.0 * u for u in range(3)]
    off, at_once = settings(motion_compensation=False), skewed(units=3, time_offset_ms=None)
    for simulated, config in ((skewed(units=3), off), (at_once, settings())):
        drive = in_time(simulated, alone)
        mapper = make_model(drive, config=config)
        place_truly(mapper, drive)
        assert motion_findings(mapper) == []


def test_simultaneous_images_need_no_bands() -> None:
    simulated = make_simulated_drive(units=4, cameras=2, points=400)
    mapper = make_model(simulated)
    assert not mapper.motion.needed
    assert mapper.state.simultaneous
    assert mapper.renew_motion() == 0.0
    np.testing.assert_array_equal(mapper.keypoints.band, mapper.keypoints.image)
    np.testing.assert_array_equal(mapper.motion.unit_from_image(mapper.state), np.tile(np.eye(4), (8, 1, 1)))


def test_jitter_of_the_clocks_is_no_motion() -> None:
    simulated = make_simulated_drive(units=4, cameras=2, points=400)
    for frame in simulated.drive.manifest.frames:
        for k, (name, image) in enumerate(frame.images.items()):
            frame.images[name] = image.model_copy(update={"timestamp_us": frame.timestamp_us + 200 * k})
    assert not make_model(simulated).motion.needed


def test_an_image_can_have_a_pose_of_its_own() -> None:
    simulated = skewed()
    mapper, image = make_model(simulated), 14
    place_truly(mapper, simulated)
    before = mapper.motion.unit_from_image(mapper.state)
    own = se3.transform(se3.exp_so3([0.0, 0.0, 0.02]), [0.3, -0.1, 0.05])
    mapper.set_image_pose(image, own)
    mapper.renew_motion()
    after = mapper.motion.unit_from_image(mapper.state)
    np.testing.assert_allclose(after[image], own, atol=1e-12)
    others = np.arange(len(after)) != image
    np.testing.assert_array_equal(after[others], before[others])


def test_an_image_of_a_simultaneous_drive_can_have_a_pose_of_its_own() -> None:
    simulated = make_simulated_drive(units=4, cameras=2, points=400)
    mapper = make_model(simulated)
    place_truly(mapper, simulated)
    mapper.triangulate()
    good = reprojection_px(mapper)
    own = se3.transform(np.eye(3), [0.5, 0.0, 0.0])
    mapper.set_image_pose(3, own)
    np.testing.assert_allclose(mapper.motion.unit_from_image(mapper.state)[3], own)
    rows = mapper.observation_rows()
    moved = mapper.keypoints.image[rows] == 3
    assert np.median(reprojection_px(mapper)[moved]) > 5 * np.median(good[moved])
    np.testing.assert_allclose(reprojection_px(mapper)[~moved], good[~moved], atol=1e-9)


def test_a_unit_that_is_forgotten_leaves_no_pose_of_its_images() -> None:
    simulated = skewed()
    mapper = make_model(simulated)
    place_truly(mapper, simulated)
    before = mapper.motion.unit_from_image(mapper.state)
    pushed = before.copy()
    pushed[:, 0, 3] += 0.3
    images = np.flatnonzero(np.isin(mapper.image_unit, [3, 4]))
    mapper.set_image_poses(images, pushed[images])
    mapper.forget(np.array([3]))
    assert not mapper.motion.own_poses[0][mapper.image_unit == 3].any()
    assert mapper.motion.own_poses[0][mapper.image_unit == 4].all()
    mapper.clear()
    assert not mapper.motion.own_poses[0].any()


def test_own_poses_and_rows_go_together() -> None:
    simulated = skewed(time_offset_ms=None, readout_ms=30, cameras=2)
    mapper = make_model(simulated)
    place_truly(mapper, simulated)
    bands, image = mapper.motion.bands, 7
    rows = np.arange(bands.first_of_image[image], bands.first_of_image[image + 1])
    before = mapper.state.unit_from_band[rows]
    own = se3.transform(se3.exp_so3([0.01, 0.0, 0.02]), [0.1, 0.2, 0.0])
    mapper.set_image_pose(image, own)
    np.testing.assert_allclose(mapper.state.unit_from_band[rows], own @ before, atol=1e-12)


def test_scaling_the_scene_changes_no_image() -> None:
    simulated = skewed()
    mapper = make_model(simulated)
    place_truly(mapper, simulated)
    mapper.triangulate()
    before = reprojection_px(mapper)
    scale_with_baselines(mapper, 1.2)
    np.testing.assert_allclose(reprojection_px(mapper), before, atol=1e-7)
