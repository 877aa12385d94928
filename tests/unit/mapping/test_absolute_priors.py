from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from mrasfm_engine.bundle_adjustment.priors import RotationPrior, UprightPrior
from mrasfm_engine.bundle_adjustment.receiver_positions import ReceiverPositions
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import ReconstructionError
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.alignment import align_rigid, align_similarity
from mrasfm_engine.geometry.gnss_track import GnssTrack
from mrasfm_engine.mapping.absolute_priors import LOCAL_POSITIONS, AbsolutePriors
from mrasfm_engine.mapping.calibration import scale_scene
from mrasfm_engine.mapping.incremental_mapping import run_incremental_mapping
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.mapping_report import describe_refinement
from mrasfm_engine.mapping.placement import place_by_gnss
from mrasfm_engine.mapping.receiver_findings import (
    jump_findings,
    outlier_findings,
    rough_scale_findings,
    rough_shape_findings,
)
from mrasfm_engine.mapping.refinement import refine
from mrasfm_engine.scene.drive import pose_from_matrix
from schemas import RoughPose, RoughTrajectory
from tests.helpers.simulated_drive import (
    SimulatedDrive,
    make_model,
    make_simulated_drive,
    scaled_rig,
    true_matches,
    with_true_poses,
)
from tests.helpers.slow import slow
from tests.unit.mapping.test_placement import ARM_M, received

UNITS, ROUGH_M, ROUGH_DEG = 24, 0.1, 0.5
ROUGH_FROM_WORLD = se3.transform(se3.exp_so3([0.0, 0.0, 1.0]), [40.0, -20.0, 3.0])


def rough_poses(simulated: SimulatedDrive, *, wrong: int = 0) -> np.ndarray:
    """The true poses in a world of their own, with independent errors; some are far off."""
    rng = np.random.default_rng(3)
    turn = se3.exp_so3(np.radians(ROUGH_DEG) * rng.normal(size=(UNITS, 3)))
    poses = ROUGH_FROM_WORLD @ simulated.world_from_rig
    poses[:, :3, :3] = turn @ poses[:, :3, :3]
    poses[:, :3, 3] += ROUGH_M * rng.normal(size=(UNITS, 3))
    poses[rng.choice(UNITS, wrong, replace=False), :3, 3] += [8.0, 3.0, 0.0]
    return poses


def with_rough_poses(simulated: SimulatedDrive, poses: np.ndarray) -> SimulatedDrive:
    manifest = simulated.drive.manifest
    rough = RoughTrajectory(
        sigma_translation_m=ROUGH_M,
        sigma_rotation_deg=ROUGH_DEG,
        poses=[
            RoughPose(timestamp_us=frame.timestamp_us, world_from_rig=pose_from_matrix(pose))
            for frame, pose in zip(manifest.frames, poses, strict=True)
        ],
    )
    return replace(
        simulated, drive=replace(simulated.drive, manifest=manifest.model_copy(update={"rough_poses": rough}))
    )


def long_baseline(rig_from_cam: np.ndarray) -> np.ndarray:
    rig_from_cam[:, :3, 3] = rig_from_cam[:, :3, 3].mean(0) + 1.06 * (
        rig_from_cam[:, :3, 3] - rig_from_cam[:, :3, 3].mean(0)
    )
    return rig_from_cam


def mapped(simulated: SimulatedDrive, absolute: AbsolutePriors) -> Mapper:
    pairs = true_matches(simulated)
    mapper = make_model(simulated, pairs, EngineConfig(threads=1))
    run_incremental_mapping(mapper, pairs, None, absolute=absolute)
    return mapper


@pytest.mark.parametrize("wrong", [3, *slow(0)])
def test_rough_poses_say_how_large_the_scene_is_and_where_it_lies(wrong: int) -> None:
    simulated = make_simulated_drive(units=UNITS, cameras=2, points=1500, given=long_baseline)
    poses = rough_poses(simulated, wrong=wrong)
    simulated = with_rough_poses(simulated, poses)
    mapper = mapped(simulated, AbsolutePriors(rough_world_from_rig=poses))
    result = refine(mapper, AbsolutePriors(rough_world_from_rig=poses))
    assert result.placed_by_rough_poses
    assert not result.georeferenced
    scale = align_similarity(mapper.state.unit_position_m, simulated.world_from_rig[:, :3, 3]).scale
    assert 1e-6 < abs(scale - 1) < 0.015  # 0.06 by the baselines as given
    true_m = (ROUGH_FROM_WORLD @ simulated.world_from_rig)[:, :3, 3]
    off_m = np.linalg.norm(mapper.state.unit_position_m - true_m, axis=1)
    assert 1e-3 < np.sqrt((off_m**2).mean()) < 0.8 * ROUGH_M
    assert result.certainty is not None
    assert result.certainty.sigma_scale < 0.02


def test_rough_poses_of_another_scale_than_the_rig_are_a_finding_and_the_sigma_holds_the_difference() -> None:
    simulated = make_simulated_drive(units=UNITS, cameras=2, points=1500)
    poses = rough_poses(simulated)
    poses[:, :3, 3] *= 0.4
    simulated = with_rough_poses(simulated, poses)
    mapper = mapped(simulated, AbsolutePriors(rough_world_from_rig=poses))
    result = refine(mapper, AbsolutePriors(rough_world_from_rig=poses))
    scale = align_similarity(mapper.state.unit_position_m, simulated.world_from_rig[:, :3, 3]).scale
    assert 0.35 < scale < 0.45
    [finding] = rough_scale_findings(mapper, result.scale_of_rough_poses)
    assert "rough_poses make the way 0.40" in finding.what
    assert result.certainty is not None
    assert 0.3 < -np.log(scale) / result.certainty.sigma_scale < 1.5


def in_camera_axes(poses: np.ndarray) -> np.ndarray:
    axes = np.eye(4)
    axes[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    turned: np.ndarray = poses @ axes
    return turned


@pytest.mark.parametrize("wrong", [se3.inverse, in_camera_axes])
def test_rough_poses_of_another_shape_take_no_part(wrong: Callable[[np.ndarray], np.ndarray]) -> None:
    simulated = make_simulated_drive(units=UNITS, cameras=2, points=1500)
    poses = wrong(rough_poses(simulated))
    simulated = with_rough_poses(simulated, poses)
    mapper = with_true_poses(make_model(simulated), simulated, range(UNITS))
    mapper.complete()
    result = refine(mapper, AbsolutePriors(rough_world_from_rig=poses))
    assert not result.placed_by_rough_poses
    assert not result.absolute.terms(mapper)
    scale = align_similarity(mapper.state.unit_position_m, simulated.world_from_rig[:, :3, 3]).scale
    assert scale == pytest.approx(1.0, abs=0.01)  # that of the rig
    [finding] = rough_shape_findings(result.absolute.rough_fault)
    assert ("their inverses have it" in finding.what) is (wrong is se3.inverse)


def test_one_camera_with_rough_poses_of_another_shape_says_so() -> None:
    simulated = make_simulated_drive(units=UNITS, cameras=1, points=1500)
    poses = se3.inverse(rough_poses(simulated))
    simulated = with_rough_poses(simulated, poses)
    mapper = with_true_poses(make_model(simulated), simulated, range(UNITS))
    mapper.complete()
    with pytest.raises(ReconstructionError, match=r"rough poses do not have the shape .*their inverses have it"):
        refine(mapper, AbsolutePriors(rough_world_from_rig=poses))


def test_receiver_and_rough_poses_stand_side_by_side_in_worlds_of_their_own() -> None:
    simulated = make_simulated_drive(units=UNITS, cameras=2, points=1500)
    poses = rough_poses(simulated)
    simulated = with_rough_poses(simulated, poses)
    known = AbsolutePriors(gnss=received(simulated, 0.3), antenna_in_rig_m=ARM_M, rough_world_from_rig=poses)
    mapper = mapped(simulated, known)
    kinds = [type(term) for term in known.terms(mapper)]
    assert sorted(kind.__name__ for kind in kinds) == sorted(
        kind.__name__ for kind in (ReceiverPositions, UprightPrior, ReceiverPositions, RotationPrior)
    )
    errors_m = np.linalg.norm(mapper.state.unit_position_m - simulated.world_from_rig[:, :3, 3], axis=1)
    assert 1e-3 < np.sqrt((errors_m**2).mean()) < 0.3  # where the receiver says


def test_local_adjustment_has_the_positions_around_its_units() -> None:
    units = 120
    simulated = make_simulated_drive(units=units, cameras=2, points=300)
    mapper = with_true_poses(make_model(simulated), simulated, range(units))
    known = AbsolutePriors(gnss=received(simulated, 0.3), antenna_in_rig_m=ARM_M)
    known.place(mapper)
    free = np.zeros(units, dtype=np.bool_)
    free[[60, 61]] = True
    positions, upright = known.local_terms(mapper, free)
    assert isinstance(positions, ReceiverPositions)
    assert isinstance(upright, UprightPrior)
    assert len(positions.unit) == LOCAL_POSITIONS + 2
    assert np.abs(positions.unit - 60.5).max() < 0.6 * LOCAL_POSITIONS
    assert upright.unit.tolist() == [60, 61]
    # Together the units of a drive weigh as one measurement, and these two their share of it.
    (whole,) = [term for term in known.terms(mapper) if isinstance(term, UprightPrior)]
    assert upright.sigma_roll_rad / whole.sigma_roll_rad == pytest.approx(np.sqrt(units / 2))


def test_without_priors_or_with_gates_nothing_takes_part_while_the_scene_grows() -> None:
    simulated = make_simulated_drive(units=12, cameras=2, points=600)
    for setting in ("priors", "reassessment"):
        mapper = with_true_poses(make_model(simulated), simulated, range(12))
        settings = mapper.config.bundle_adjustment.model_copy(update={setting: False})
        mapper.config = mapper.config.model_copy(update={"bundle_adjustment": settings})
        known = AbsolutePriors(gnss=received(simulated, 0.3), antenna_in_rig_m=ARM_M)
        known.renew(mapper)
        assert known.terms(mapper) == []
        assert not known.hold_the_frame


def test_units_that_were_dropped_tell_nothing_of_the_receivers_error() -> None:
    """A unit that is not registered stands where it stood last, which measures no error."""
    simulated = make_simulated_drive(units=UNITS, cameras=2, points=600)
    mapper = with_true_poses(make_model(simulated), simulated, range(UNITS))
    known = AbsolutePriors(gnss=received(simulated, 0.3), antenna_in_rig_m=ARM_M)
    known.place(mapper)
    mapper.forget(np.array([10]))
    (positions,) = [term for term in known.terms(mapper) if isinstance(term, ReceiverPositions)]
    assert len(positions.unit) >= UNITS - 3
    assert 10 not in positions.unit


def test_rough_poses_that_contradict_a_growing_scene_take_no_part_in_it() -> None:
    simulated = make_simulated_drive(units=UNITS, cameras=2, points=600)
    poses = rough_poses(simulated)
    poses[:, :3, 3] *= 2.0
    simulated = with_rough_poses(simulated, poses)
    mapper = with_true_poses(make_model(simulated), simulated, range(UNITS))
    known = AbsolutePriors(rough_world_from_rig=poses)
    known.renew(mapper)
    assert known.rough is None
    assert not known.hold_the_frame


def stereo_drive() -> SimulatedDrive:
    return make_simulated_drive(units=UNITS, cameras=2, points=1500)


def scaled(simulated: SimulatedDrive, factor: float) -> Mapper:
    """The drive's true scene in another size than by its baseline."""
    mapper = with_true_poses(make_model(simulated), simulated, range(UNITS))
    scale_scene(mapper, factor)
    return mapper


def test_positions_that_contradict_the_scale_of_a_growing_scene_are_compared_with_the_adjusted_one() -> None:
    simulated = stereo_drive()
    mapper = scaled(simulated, 0.7)
    known = AbsolutePriors(gnss=received(simulated, 0.05), antenna_in_rig_m=ARM_M)
    known.place(mapper)
    assert known.positions_are_refused
    assert refine(mapper, known).georeferenced
    scale = align_similarity(mapper.state.unit_position_m, simulated.world_from_rig[:, :3, 3]).scale
    assert 0.99 < scale < 1.01


def turned_about_every_axis(rig_from_cam: np.ndarray, *, by_deg: float, seed: int) -> np.ndarray:
    sign = np.random.default_rng(seed).choice([-1, 1], (len(rig_from_cam), 3))
    rig_from_cam[:, :3, :3] = rig_from_cam[:, :3, :3] @ se3.exp_so3(np.radians(by_deg) * sign)
    return rig_from_cam


def drive_of_few_units(cameras: int, units: int, way_m: float, by_deg: float, seed: int) -> SimulatedDrive:
    """Cameras that hardly share a view, turned about every axis, on their first metres from a standstill."""
    return make_simulated_drive(
        units=units,
        cameras=cameras,
        points=600,
        straight=True,
        travelled_m=way_m * (np.arange(units) / (units - 1)) ** 2,
        given=partial(turned_about_every_axis, by_deg=by_deg, seed=seed),
        seed=seed,
    )


@pytest.mark.parametrize(
    "drive",  # cameras, units, metres, degrees by which cameras are turned, seed
    [(5, 5, 6.0, 1.0, 1), (4, 5, 6.0, 2.0, 0), (4, 5, 2.0, 1.0, 1), *slow((5, 8, 0.7, 2.0, 0), (6, 5, 2.0, 2.0, 1))],
)
def test_a_receiver_is_right_beside_a_rig_whose_few_units_take_any_size(
    drive: tuple[int, int, float, float, int],
) -> None:
    """Cameras that hardly share a view, turned by a degree or two, on their first metres from a standstill."""
    simulated, way_m = drive_of_few_units(*drive), drive[2]
    known = {"gnss": received(simulated, 0.05 * way_m), "antenna_in_rig_m": ARM_M}
    mapper = mapped(simulated, AbsolutePriors(**known))
    result = refine(mapper, AbsolutePriors(**known))
    assert result.placement is not None
    assert not result.placement.reason
    assert result.georeferenced
    scale = align_similarity(mapper.state.unit_position_m, simulated.world_from_rig[:, :3, 3]).scale
    assert result.certainty is not None
    assert 0.0 < abs(np.log(scale)) < 3.0 * result.certainty.sigma_scale
    assert 0.7 < scale < 1.4


@pytest.mark.parametrize("factor", [0.305, 1.6, *slow(2.4)])
def test_positions_of_another_scale_than_the_rigs_give_the_scene_theirs_and_say_so(factor: float) -> None:
    """Baselines may be in feet, or a camera late by a frame; no receiver stretches a trajectory."""
    simulated = make_simulated_drive(units=UNITS, cameras=2, points=1500, given=partial(scaled_rig, scale=1.0 / factor))
    mapper = scaled(simulated, 1.0 / factor)
    result = refine(mapper, AbsolutePriors(gnss=received(simulated, 0.05), antenna_in_rig_m=ARM_M))
    assert result.georeferenced
    scale = align_similarity(mapper.state.unit_position_m, simulated.world_from_rig[:, :3, 3]).scale
    assert scale == pytest.approx(1.0, rel=0.01)
    assert result.placement is not None
    (finding,) = [one for one in result.placement.findings if one.code == "scale-disagreement"]
    assert "antenna_in_rig_m" in finding.remedy  # half a metre aside makes the way of a U-turn a tenth longer
    assert result.placement.scale_of_rig == pytest.approx(factor, rel=0.1)  # the rig is turned about another place


def test_positions_that_have_the_rigs_length_with_coordinates_swapped_are_refused() -> None:
    """Along a straight line nothing but its length tells that latitude and longitude are swapped."""
    simulated = make_simulated_drive(units=UNITS, cameras=2, points=1500, straight=True)
    mapper = scaled(simulated, 1.0)
    right = received(simulated, 0.05)
    # Given as 5 degrees north, 60 degrees east: at 60 degrees north, degrees of longitude are half as long.
    swapped_from_local = np.array([[0.0, 0.5, 0.0], [1.004, 0.0, 0.0], [0.0, 0.0, 1.0]])
    gnss = replace(
        right,
        position_m=right.position_m @ np.linalg.inv(swapped_from_local).T,
        swapped_from_local=swapped_from_local,
    )
    result = refine(mapper, AbsolutePriors(gnss=gnss, antenna_in_rig_m=ARM_M))
    assert not result.georeferenced
    assert result.placement is not None
    assert "swapped" in result.placement.reason
    scale = align_similarity(mapper.state.unit_position_m, simulated.world_from_rig[:, :3, 3]).scale
    assert 0.9 < scale < 1.1


@pytest.mark.parametrize("sigma_m", [0.8, *slow(0.05)])
def test_a_receiver_whose_error_jumps_neither_scales_nor_bends_the_scene(sigma_m: float) -> None:
    simulated = stereo_drive()
    mapper = scaled(simulated, 1.0)
    gnss = received(simulated, 0.02)
    position_m = gnss.position_m + (np.arange(UNITS) >= 11)[:, None] * [2.5, -2.0, 0.0]
    gnss = replace(gnss, position_m=position_m, sigma_m=np.full((UNITS, 3), sigma_m))
    result = refine(mapper, AbsolutePriors(gnss=gnss, antenna_in_rig_m=ARM_M))
    assert result.placement is not None
    assert result.placement.jumps.tolist() == [11]
    assert [finding.code for finding in jump_findings(mapper, result.placement)] == ["gnss-error-jumps"]
    assert outlier_findings(result.placement) == []  # what jumps together is no outlier
    assert describe_refinement(mapper, result)["gnss"]["residual_rms_m"] < 0.5  # of 3.2 m by which it jumps
    few = replace(result.placement, inlier=np.arange(len(result.placement.inlier)) < 5)
    (finding,) = outlier_findings(few)
    assert finding.what.startswith(f"{UNITS - 5} of {UNITS} positions of the receiver contradict the scene")
    aligned = align_rigid(simulated.world_from_rig[:, :3, 3], mapper.state.unit_position_m)
    off_m = se3.apply(aligned.a_from_b, mapper.state.unit_position_m) - simulated.world_from_rig[:, :3, 3]
    assert np.sqrt((off_m**2).sum(1).mean()) < 0.1
    assert result.certainty is not None
    scale = align_similarity(mapper.state.unit_position_m, simulated.world_from_rig[:, :3, 3]).scale
    assert abs(scale - 1.0) < 3 * result.certainty.sigma_scale


@pytest.mark.parametrize("phase", [0.0, *slow(0.15, 0.35)])
def test_a_jump_of_a_slow_receiver_is_dated_by_its_own_samples(phase: float) -> None:
    """Units between two samples have a blend of both: those across the jump are outliers."""
    simulated = make_simulated_drive(units=64, cameras=2, points=3000)
    mapper = with_true_poses(make_model(simulated), simulated, range(64))
    times_us = simulated.drive.timestamps_us
    unit_us = float(np.median(np.diff(times_us)))
    at_us = np.arange(times_us[0] + phase * unit_us, times_us[-1], 4.0 * unit_us).astype(np.int64)
    quick = received(simulated, 0.02)
    position_m = np.stack([np.interp(at_us, times_us, quick.position_m[:, axis]) for axis in range(3)], axis=1)
    position_m[8:] += [3.0, 2.0, 0.0]
    gnss = GnssTrack(
        timestamps_us=at_us,
        position_m=position_m,
        sigma_m=np.full(position_m.shape, 0.5),
        good=np.ones(len(at_us), dtype=np.bool_),
    )
    placement = place_by_gnss(mapper, gnss, ARM_M)
    first = int(np.searchsorted(times_us, at_us[8]))
    last = int(np.searchsorted(times_us, at_us[7], side="right")) - 1
    assert placement.jumps.tolist() == [first]
    assert placement.blended.tolist() == list(range(last + 1, first))
    assert not placement.inlier[np.isin(placement.units, placement.blended)].any()
    assert not placement.is_contradicted


def test_rough_poses_do_not_say_where_a_scene_is_that_positions_place_afterwards() -> None:
    simulated = stereo_drive()
    poses = rough_poses(simulated)
    simulated = with_rough_poses(simulated, poses)
    mapper = scaled(simulated, 0.7)
    known = AbsolutePriors(gnss=received(simulated, 0.05), antenna_in_rig_m=ARM_M, rough_world_from_rig=poses)
    result = refine(mapper, known)
    assert result.georeferenced
    assert not result.placed_by_rough_poses
    off_m = np.linalg.norm(mapper.state.unit_position_m - simulated.world_from_rig[:, :3, 3], axis=1)
    assert 0.0 < off_m.max() < 0.2


def test_positions_that_hardly_move_give_a_scene_no_scale() -> None:
    """They are refused for that, and the rig keeps its length."""
    simulated = stereo_drive()
    mapper = scaled(simulated, 1.0)
    gnss = received(simulated, 0.05)
    drifting_m = np.linspace(0.0, 150.0, UNITS)[:, None] * [1.0, 0.0, 0.0]
    gnss = replace(gnss, position_m=gnss.position_m + drifting_m, sigma_m=np.full((UNITS, 3), 60.0))
    result = refine(mapper, AbsolutePriors(gnss=gnss, antenna_in_rig_m=ARM_M))
    assert not result.georeferenced
    scale = align_similarity(mapper.state.unit_position_m, simulated.world_from_rig[:, :3, 3]).scale
    assert 0.9 < scale < 1.1


def test_positions_of_another_scale_leave_a_rig_alone_that_is_held_by_the_settings() -> None:
    simulated = make_simulated_drive(units=UNITS, cameras=2, points=1500, given=partial(scaled_rig, scale=3.28))
    config = EngineConfig(threads=1)
    held = config.bundle_adjustment.model_copy(update={"refine_calibration": False})
    config = config.model_copy(update={"bundle_adjustment": held})
    mapper = with_true_poses(make_model(simulated, config=config), simulated, range(UNITS))
    scale_scene(mapper, 3.28)
    result = refine(mapper, AbsolutePriors(gnss=received(simulated, 0.05), antenna_in_rig_m=ARM_M))
    assert not result.georeferenced
    assert result.placement is not None
    assert "times as long as the rig's" in result.placement.reason


@pytest.mark.parametrize("covered", [0, 1])
def test_a_scene_with_hardly_any_position_is_left_where_it_is(covered: int) -> None:
    simulated = stereo_drive()
    mapper = scaled(simulated, 1.0)
    gnss = received(simulated, 0.05)
    gnss = replace(gnss, timestamps_us=gnss.timestamps_us + 10**9 * (np.arange(UNITS) >= covered))
    assert not refine(mapper, AbsolutePriors(gnss=gnss, antenna_in_rig_m=ARM_M)).georeferenced
