"""Adjustment without camera sets, and without priors."""

from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.bundle_adjustment.priors import CalibrationPrior, RotationPrior, UprightPrior
from mrasfm_engine.bundle_adjustment.receiver_positions import ReceiverPositions
from mrasfm_engine.bundle_adjustment.solver import SolverOptions
from mrasfm_engine.config import BundleAdjustmentConfig, EngineConfig, GnssConfig
from mrasfm_engine.errors import CancelledError
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.gnss_track import GnssTrack
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.calibration import assess_calibration, calibration_prior
from mrasfm_engine.mapping.free_image_adjustment import MIN_OBSERVATIONS, terms_of_images
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.pose_adjustment import adjust_poses
from mrasfm_engine.mapping.refinement import refine
from mrasfm_engine.mapping.refinement_result import Refinement
from tests.helpers.simulated_drive import SimulatedDrive, make_model, make_simulated_drive, with_true_poses

UNITS, CAMERAS = 10, 6
BY_IMAGE = EngineConfig(threads=1, bundle_adjustment=BundleAdjustmentConfig(camera_set_adjustment=False))


def world_from_cam(mapper: Mapper) -> np.ndarray:
    rig = mapper.state.world_from_rig[mapper.image_unit] @ mapper.motion.unit_from_image(mapper.state)
    result: np.ndarray = rig @ mapper.state.rig_from_cam[mapper.image_camera]
    return result


def true_world_from_cam(simulated: SimulatedDrive, mapper: Mapper) -> np.ndarray:
    result: np.ndarray = simulated.world_from_rig[mapper.image_unit] @ simulated.truth.rig_from_cam[mapper.image_camera]
    return result


def started(config: EngineConfig, *, hidden: bool = False, noise_px: float = 0.4) -> tuple[SimulatedDrive, Mapper]:
    """A model whose units are some centimetres off; with `hidden` one image sees nothing."""
    simulated = make_simulated_drive(
        units=UNITS,
        cameras=CAMERAS,
        points=900,
        noise_px=noise_px,
        hidden=lambda unit, camera: hidden and (unit, camera) == (4, 2),
    )
    mapper = with_true_poses(make_model(simulated, config=config), simulated, range(UNITS))
    rng = np.random.default_rng(0)
    for u in range(1, UNITS):
        pose = simulated.world_from_rig[u].copy()
        pose[:3, 3] += rng.normal(0, 0.03, 3)
        pose[:3, :3] = se3.exp_so3(rng.normal(0, 0.002, 3)) @ pose[:3, :3]
        mapper.set_pose(u, pose)
    return simulated, mapper


def all_but_the_first() -> np.ndarray:
    return np.arange(UNITS) > 0


def test_every_image_is_a_variable_and_finds_its_own_place() -> None:
    simulated, mapper = started(BY_IMAGE)
    report = adjust_poses(mapper, all_but_the_first(), options=SolverOptions())
    images = (UNITS - 1) * CAMERAS
    assert report.pose_parameters == 6 * images
    assert report.parameters == 6 * images + 3 * mapper.triangulated.sum()
    assert report.final_cost < 0.2 * report.initial_cost
    off_m = np.linalg.norm(world_from_cam(mapper)[:, :3, 3] - true_world_from_cam(simulated, mapper)[:, :3, 3], axis=1)
    assert (off_m[mapper.image_unit == 0] < 1e-12).all()  # the first unit's images hold the frame and the scale
    assert 1e-4 < np.median(off_m[mapper.image_unit > 0]) < 0.02
    own = mapper.motion.unit_from_image(mapper.state)[mapper.image_unit > 0]
    assert 1e-4 < np.linalg.norm(own[:, :3, 3], axis=1).max() < 0.05  # nothing ties the cameras together
    np.testing.assert_array_equal(mapper.state.rig_from_cam, simulated.drive.rig_from_cam)
    # A unit is where its images are on the whole.
    for u in range(1, UNITS):
        assert np.linalg.norm(np.median(own[(u - 1) * CAMERAS : u * CAMERAS, :3, 3], axis=0)) < 0.01


def test_with_camera_sets_there_are_fewer_unknowns_and_a_smaller_error() -> None:
    errors, unknowns = [], []
    for config in (EngineConfig(threads=1), BY_IMAGE):
        simulated, mapper = started(config)
        unknowns.append(adjust_poses(mapper, all_but_the_first(), options=SolverOptions()).pose_parameters)
        off = world_from_cam(mapper)[:, :3, 3] - true_world_from_cam(simulated, mapper)[:, :3, 3]
        errors.append(float(np.sqrt((off**2).sum(1).mean())))
    assert unknowns == [6 * (UNITS - 1), 6 * (UNITS - 1) * CAMERAS]
    assert errors[1] > 1.3 * errors[0] > 0


def test_without_noise_both_find_the_truth() -> None:
    for config in (EngineConfig(threads=1), BY_IMAGE):
        simulated, mapper = started(config, noise_px=0.0)
        adjust_poses(
            mapper, all_but_the_first(), options=SolverOptions(function_tolerance=1e-12, decrement_tolerance=1e-12)
        )
        off = world_from_cam(mapper)[:, :3, 3] - true_world_from_cam(simulated, mapper)[:, :3, 3]
        assert 0 < np.abs(off).max() < 2e-3


def test_an_image_that_sees_nothing_stays_with_its_unit() -> None:
    _, mapper = started(BY_IMAGE, hidden=True)
    blind = next(i for i, image in enumerate(mapper.drive.images) if (image.unit, image.camera) == (4, 2))
    assert (mapper.keypoints.image == blind).sum() < MIN_OBSERVATIONS
    report = adjust_poses(mapper, all_but_the_first(), options=SolverOptions())
    assert report.pose_parameters == 6 * ((UNITS - 1) * CAMERAS - 1)
    np.testing.assert_allclose(mapper.motion.unit_from_image(mapper.state)[blind], np.eye(4), atol=1e-12)


def test_a_local_adjustment_moves_its_units_images_only() -> None:
    _, mapper = started(BY_IMAGE)
    before, free = world_from_cam(mapper), np.isin(np.arange(UNITS), [4, 5])
    adjust_poses(mapper, free, options=SolverOptions())
    moved = np.abs(world_from_cam(mapper) - before).max(axis=(1, 2)) > 1e-9
    np.testing.assert_array_equal(moved, free[mapper.image_unit])


def test_a_cancelled_adjustment_is_no_result() -> None:
    _, mapper = started(BY_IMAGE)
    before = world_from_cam(mapper)
    with pytest.raises(CancelledError):
        adjust_poses(mapper, all_but_the_first(), options=SolverOptions(), cancel=lambda: True)
    np.testing.assert_array_equal(world_from_cam(mapper), before)


def test_positions_hold_for_every_image_with_the_weight_of_one_unit() -> None:
    image_unit = np.repeat(np.arange(4), 3)
    adjusted = np.ones(12, dtype=np.bool_)
    adjusted[[0, 1, 2, 4]] = False
    positions = ReceiverPositions.from_samples(
        unit=np.array([0, 1, 3]), position_m=np.arange(9.0).reshape(3, 3), white_m=np.full((3, 3), 0.6),
        wander_m=np.zeros((3, 3)), lever_arm_m=np.array([0.1, 0.2, 0.3]), time_s=np.array([0.0, 0.1, 0.3]),
        wander_time_s=60.0, least_spacing_s=1.0,
    )  # fmt: skip
    turns = RotationPrior(unit=np.array([1, 3]), rotation=np.tile(np.eye(3), (2, 1, 1)), sigma_rad=np.array([0.1, 0.2]))
    upright = UprightPrior(unit=np.arange(3), sigma_roll_rad=0.1, sigma_pitch_rad=0.1)
    calibration = CalibrationPrior(
        rotation=np.eye(3)[None], position_m=np.zeros((1, 3)), sigma_rotation_rad=np.ones(1),
        sigma_translation_m=np.ones(1),
    )  # fmt: skip
    of_images = terms_of_images([positions, calibration, turns, upright], image_unit, adjusted)
    assert len(of_images) == 3
    position, turn, level = of_images
    assert isinstance(position, ReceiverPositions)
    assert isinstance(turn, RotationPrior)
    assert turn.unit.tolist() == [3, 5, 9, 10, 11]
    np.testing.assert_allclose(np.bincount(image_unit[turn.unit], turn.sigma_rad**-2), [0, 100, 0, 25])
    assert isinstance(level, UprightPrior)
    assert position.unit.tolist() == [3, 5, 9, 10, 11]
    np.testing.assert_allclose(position.position_m[:, 0], [3, 3, 6, 6, 6])
    information = np.bincount(image_unit[position.unit], 1 / position.sigma_m[:, 0] ** 2)
    np.testing.assert_allclose(information, [0, 1 / 0.36, 0, 1 / 0.36], atol=1e-12)
    assert level.unit.tolist() == [3, 5, 6, 7, 8]


def test_calibration_is_held_without_camera_sets() -> None:
    _, mapper = started(BY_IMAGE)
    verdict = assess_calibration(
        mapper, free_units=all_but_the_first(), terms=(), georeferenced=True, options=SolverOptions()
    )
    assert not verdict.free
    assert "on their own" in verdict.reason


def refined(adjustment: BundleAdjustmentConfig, *, bent: bool) -> tuple[Mapper, Refinement]:
    """A turning drive refined with GNSS whose positions bend away from the truth, or with none."""
    simulated = make_simulated_drive(units=20, cameras=4, points=1200)
    # Errors that are independent from sample to sample weigh most.
    config = EngineConfig(
        threads=1, bundle_adjustment=adjustment, gnss=GnssConfig(wander_time_s=0.01, correlation_time_s=0.01)
    )
    mapper = make_model(simulated, config=config)
    with_true_poses(mapper, simulated, range(20))
    position = simulated.world_from_rig[:, :3, 3].copy()
    position[:, 2] += 0.3 * np.sin(np.linspace(0, 2 * np.pi, 20))
    times = mapper.drive.timestamps_us
    gnss = GnssTrack(
        timestamps_us=times, position_m=position, sigma_m=np.full((20, 3), 0.1), good=np.ones(20, dtype=np.bool_)
    )
    return mapper, refine(mapper, AbsolutePriors(gnss=gnss if bent else None, antenna_in_rig_m=np.zeros(3)))


def distances(mapper: Mapper) -> np.ndarray:
    p = mapper.state.unit_position_m
    result: np.ndarray = np.linalg.norm(p[:, None] - p[None], axis=-1)
    return result


@pytest.mark.slow
def test_without_priors_gnss_aligns_but_does_not_pull() -> None:
    held = BundleAdjustmentConfig(refine_calibration=False)
    unpulled, _ = refined(held, bent=False)
    shapes, stretch = {}, distances(unpulled).max()
    for priors in (True, False):
        mapper, result = refined(held.model_copy(update={"priors": priors}), bent=True)
        assert result.georeferenced
        assert (result.certainty is None) is not priors
        shapes[priors] = np.abs(distances(mapper) - distances(unpulled)).max() / stretch
    # Images know the shape a thousand times better than the receiver: what it changes is small, and not nothing.
    assert 0 <= shapes[False] < 1e-8
    assert 5e-8 < shapes[True] < 1e-3


def test_without_priors_the_calibration_varies_freely() -> None:
    def moved(priors: bool) -> float:
        mapper, result = refined(BundleAdjustmentConfig(priors=priors), bent=True)
        assert result.calibration.free
        corrections = calibration_prior(mapper).corrections(mapper.state)
        return float(np.abs(corrections.mean(0)).max())

    held, loose = moved(True), moved(False)
    assert held < 1e-4  # the gauge: the mean correction of all cameras is held at zero
    assert loose > 2 * held
