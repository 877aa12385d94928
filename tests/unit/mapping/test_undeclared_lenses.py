"""Lenses that nobody declared uncertain vary where their errors bend the way."""

from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.config import BundleAdjustmentConfig, EngineConfig
from mrasfm_engine.geometry.alignment import align_similarity
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.refinement import refine
from mrasfm_engine.mapping.refinement_result import Refinement
from tests.helpers.simulated_drive import SimulatedDrive, make_model, make_simulated_drive, with_true_poses
from tests.helpers.slow import slow
from tests.unit.mapping.test_intrinsics import K1, distorted
from tests.unit.mapping.test_placement import ARM_M, received

UNITS = 30


def refined(
    simulated: SimulatedDrive, *, with_gnss: bool = True, refine_focal: bool | None = None
) -> tuple[Mapper, Refinement]:
    config = EngineConfig(threads=1, bundle_adjustment=BundleAdjustmentConfig(refine_focal=refine_focal))
    units = range(len(simulated.world_from_rig))
    mapper = with_true_poses(make_model(simulated, config=config), simulated, units)
    absolute = AbsolutePriors(gnss=received(simulated, 0.05), antenna_in_rig_m=ARM_M)
    return mapper, refine(mapper, absolute if with_gnss else None)


def bent_m(mapper: Mapper, simulated: SimulatedDrive) -> float:
    """RMSE of the rig's origin after a similarity."""
    true_m, found_m = simulated.world_from_rig[:, :3, 3], mapper.state.unit_position_m
    return float(np.linalg.norm(align_similarity(true_m, found_m).apply(found_m) - true_m) / np.sqrt(len(true_m)))


@pytest.mark.parametrize("with_gnss", [True, *slow(False)])
def test_distortion_that_bends_a_way_is_estimated(with_gnss: bool) -> None:
    simulated = distorted(make_simulated_drive(units=UNITS, cameras=2, points=2500))
    held, _ = refined(simulated, with_gnss=with_gnss, refine_focal=False)
    mapper, result = refined(simulated, with_gnss=with_gnss)
    assert bent_m(held, simulated) > 0.01
    assert bent_m(mapper, simulated) < 0.003
    assert {camera.model for camera in held.drive.cameras} == {"PINHOLE"}
    assert {camera.model for camera in mapper.drive.cameras} == {"OPENCV"}
    np.testing.assert_allclose(mapper.state.camera_params[:, 4], K1, atol=0.15 * K1)
    assert result.intrinsics is not None
    assert result.intrinsics.asked.all()
    assert result.systematic is None, "what lenses err by is in the certainty"


@pytest.mark.parametrize(("is_distorted", "is_free"), [(True, True), (False, False)])
def test_few_units_that_turn_tell_it_as_well(is_distorted: bool, is_free: bool) -> None:
    simulated = make_simulated_drive(units=8, cameras=2, points=900, radius_m=8)
    simulated = distorted(simulated) if is_distorted else simulated
    held, _ = refined(simulated, refine_focal=False)
    mapper, result = refined(simulated)
    assert result.intrinsics_vary == is_free
    assert bent_m(mapper, simulated) <= bent_m(held, simulated) * (0.5 if is_free else 1.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cameras", "straight", "is_distorted"), [(2, False, False), (2, True, True), (6, False, True)]
)
def test_lenses_that_hardly_bend_it_stay_as_given(cameras: int, straight: bool, is_distorted: bool) -> None:
    """Right ones, those of a straight street, and those of a vehicle whose other cameras hold the way."""
    simulated = make_simulated_drive(units=UNITS, cameras=cameras, points=2500, straight=straight)
    simulated = distorted(simulated) if is_distorted else simulated
    held, _ = refined(simulated, refine_focal=False)
    mapper, result = refined(simulated)
    assert not result.intrinsics_are_asked
    assert {camera.model for camera in mapper.drive.cameras} == {"PINHOLE"}
    np.testing.assert_array_equal(mapper.state.unit_position_m, held.state.unit_position_m)


def test_a_drive_whose_motion_is_interpolated_keeps_its_lenses() -> None:
    """Times that are wrong bend a turn as lenses do: these right ones would vary, and the scene get worse."""
    late = make_simulated_drive(units=12, cameras=2, points=900, radius_m=8, time_offset_ms=[0, 20], late_ms=[0, 10])
    mapper = with_true_poses(make_model(late, config=EngineConfig(threads=1)), late, range(12))
    assert not mapper.state.simultaneous
    assert not refine(mapper).intrinsics_are_asked
