"""Scenes without positions whose cameras hardly share a view: of several sizes the most likely one is published."""

from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.alignment import align_similarity
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.refinement import refine
from tests.helpers.simulated_drive import SimulatedDrive, make_model, with_true_poses
from tests.helpers.slow import slow
from tests.unit.mapping.test_absolute_priors import drive_of_few_units, mapped


def log_scale(simulated: SimulatedDrive, mapper: Mapper) -> float:
    return float(np.log(align_similarity(mapper.state.unit_position_m, simulated.world_from_rig[:, :3, 3]).scale))


@pytest.mark.parametrize(
    "drive",  # cameras, units, metres, degrees by which cameras are turned, seed
    [
        (5, 5, 6.0, 2.0, 1),
        (4, 8, 8.0, 2.0, 0),
        (3, 8, 6.0, 1.0, 1),
        *slow((5, 5, 6.0, 2.0, 0), (4, 8, 8.0, 1.0, 0), (3, 8, 6.0, 2.0, 1), (6, 5, 2.0, 1.0, 0)),
    ],
)
def test_without_positions_a_scene_of_few_units_takes_the_size_that_is_most_likely(
    drive: tuple[int, int, float, float, int],
) -> None:
    """They came out 2.5 to 102 times too short with cameras as given, and some with no scale at all."""
    simulated = drive_of_few_units(*drive)
    mapper = mapped(simulated, AbsolutePriors())
    result = refine(mapper)
    assert result.calibration.free
    assert result.recalibrated.all()
    assert result.certainty is not None
    assert 0.0 < abs(log_scale(simulated, mapper)) < 3.0 * result.certainty.sigma_scale < 1.0
    assert abs(log_scale(simulated, mapper)) < 0.05
    turned_deg = se3.rotation_angle_deg(
        mapper.state.camera_rotation @ np.swapaxes(simulated.drive.rig_from_cam[:, :3, :3], 1, 2)
    )
    assert turned_deg.max() > 0.5


def test_cameras_that_are_held_by_the_settings_stay_whatever_size_is_more_likely() -> None:
    """Other sizes, with cameras that vary, are in the sigma."""
    simulated = drive_of_few_units(4, 8, 8.0, 1.0, 1)
    mapper = mapped(simulated, AbsolutePriors())
    mapper.begin_anew(np.ones(4, dtype=np.bool_))
    held = mapper.config.bundle_adjustment.model_copy(update={"refine_calibration": False})
    mapper.config = mapper.config.model_copy(update={"bundle_adjustment": held})
    before = mapper.state.camera_rotation.copy(), mapper.state.camera_position_m.copy()
    result = refine(mapper)
    assert not result.calibration.free
    assert not result.recalibrated.any()
    np.testing.assert_array_equal(mapper.state.camera_rotation, before[0])
    np.testing.assert_allclose(mapper.state.camera_position_m, before[1], atol=1e-12)
    assert result.certainty is not None
    assert 0.1 < abs(log_scale(simulated, mapper)) < 3.0 * result.certainty.sigma_scale


def test_a_smaller_component_keeps_the_calibration_of_the_largest_whatever_size_is_more_likely() -> None:
    simulated = drive_of_few_units(4, 8, 8.0, 1.0, 1)
    mapper = mapped(simulated, AbsolutePriors())
    largest = with_true_poses(make_model(simulated), simulated, range(8))
    result = refine(mapper, calibrated=largest)
    assert not result.calibration.free
    assert not result.recalibrated.any()
    np.testing.assert_array_equal(mapper.state.camera_rotation, largest.state.camera_rotation)
    np.testing.assert_array_equal(mapper.state.camera_position_m, largest.state.camera_position_m)
    assert result.certainty is not None
    assert 0.1 < abs(log_scale(simulated, mapper)) < 3.0 * result.certainty.sigma_scale
