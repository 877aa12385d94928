from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from mrasfm_engine.config import BundleAdjustmentConfig, MatchConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.matching.motion_of_cameras import MotionEstimate, motion_contradiction, rig_by_motion
from mrasfm_engine.matching.simultaneous import rig_of_drive
from mrasfm_engine.scene.scene import PairMatches
from tests.helpers.simulated_drive import SimulatedDrive, make_simulated_drive, true_matches, with_cameras
from tests.unit.matching.test_simultaneous import rays_of_matches, relative_error_deg

FRONT, BACK_LEFT = 0, 3  # of six, they share no view


def turned(rotation_deg: list[float], *, straight: bool = True, seed: int = 0) -> SimulatedDrive:
    """A drive of two cameras without a common view; the one behind is given turned about the rig's axes."""

    def given(rig_from_cam: np.ndarray) -> np.ndarray:
        rig_from_cam[BACK_LEFT, :3, :3] = se3.exp_so3(np.radians(rotation_deg)) @ rig_from_cam[BACK_LEFT, :3, :3]
        return rig_from_cam

    return make_simulated_drive(
        units=8,
        cameras=6,
        points=1500,
        straight=straight,
        given=given,
        hidden=lambda unit, camera: camera not in (FRONT, BACK_LEFT),
        seed=seed,
    )


def by_motion(
    simulated: SimulatedDrive,
    pairs: list[PairMatches] | None = None,
    *,
    rays_of: Callable[[PairMatches], tuple[np.ndarray, np.ndarray]] | None = None,
    **calibration: bool,
) -> MotionEstimate:
    rays_of = rays_of_matches(simulated) if rays_of is None else rays_of
    pairs = true_matches(simulated) if pairs is None else pairs
    settings = BundleAdjustmentConfig(**calibration)
    rig = rig_of_drive(simulated.drive, pairs, rays_of, MatchConfig(), settings)
    return rig_by_motion(simulated.drive, pairs, rays_of, rig, MatchConfig(), settings)


def off_deg(simulated: SimulatedDrive, rig_from_cam: np.ndarray) -> float:
    return relative_error_deg(rig_from_cam, simulated.truth.rig_from_cam, FRONT, BACK_LEFT)


@pytest.mark.parametrize("straight", [True, False])
@pytest.mark.parametrize("pitch_deg", [0.0, 1.5])
def test_a_rig_that_is_off_by_no_more_than_its_prior_lets_expect_stays_exactly_as_given(
    pitch_deg: float, straight: bool
) -> None:
    simulated = turned([0.0, pitch_deg, 0.0], straight=straight)
    found = by_motion(simulated)
    np.testing.assert_array_equal(found.rig_from_cam, simulated.drive.rig_from_cam)
    assert found.motions > 10
    assert not found.is_corrected
    assert motion_contradiction(["a"] * 6, simulated.drive.rig_from_cam, found) is None


@pytest.mark.parametrize("straight", [True, False])
@pytest.mark.parametrize("pitch_deg", [-6.0, 5.0, 9.0])
def test_a_camera_without_a_common_view_that_is_turned_is_found(pitch_deg: float, straight: bool) -> None:
    simulated = turned([0.0, pitch_deg, 0.0], straight=straight)
    given = simulated.drive.rig_from_cam
    assert off_deg(simulated, given) == pytest.approx(abs(pitch_deg), abs=0.01)
    found = by_motion(simulated)
    assert 0.0 < off_deg(simulated, found.rig_from_cam) < 2.0
    others = [camera for camera in range(6) if camera not in (FRONT, BACK_LEFT)]
    np.testing.assert_allclose(found.rig_from_cam[others], given[others], atol=1e-9)
    np.testing.assert_array_equal(found.rig_from_cam[:, :3, 3], given[:, :3, 3])  # motions say nothing of places
    finding = motion_contradiction([c.name for c in simulated.drive.cameras], given, found)
    assert finding is not None
    assert finding.code == "calibration-contradicted"
    assert "front and back_left turned by" in finding.what


def test_roll_about_a_straight_street_stays_as_given() -> None:
    """No motion tells it, and what is not told is not made up."""
    found = by_motion(turned([6.0, 0.0, 0.0]))
    assert not found.is_corrected


def test_settings_that_hold_the_calibration_hold_it() -> None:
    simulated = turned([0.0, 6.0, 0.0])
    found = by_motion(simulated, refine_calibration=False)
    np.testing.assert_array_equal(found.rig_from_cam, simulated.drive.rig_from_cam)
    assert found.motions == 0


def test_a_camera_that_moves_as_no_calibration_lets_it_is_not_turned() -> None:
    """Its images may be another camera's: that is no matter of calibration."""
    simulated = turned([0.0, 60.0, 0.0])
    found = by_motion(simulated)
    assert not found.is_corrected
    assert found.apart_before_rad[FRONT, BACK_LEFT] > 0.5


def test_few_motions_turn_no_camera() -> None:
    """A lorry that fills one camera's images moves as well."""
    simulated = turned([0.0, 8.0, 0.0])
    unit_of = [image.unit for image in simulated.drive.images]
    pairs = [pair for pair in true_matches(simulated) if {unit_of[pair.image_a], unit_of[pair.image_b]} <= {0, 1}]
    found = by_motion(simulated, pairs)
    assert found.motions == 1
    assert found.apart_before_rad[FRONT, BACK_LEFT] > np.radians(5.0)
    assert not found.is_corrected


def test_a_turn_that_the_declared_sigma_lets_expect_is_left_to_the_adjustment() -> None:
    simulated = turned([0.0, 5.0, 0.0])
    assert by_motion(simulated).is_corrected
    cameras = [c.model_copy(update={"sigma_rotation_deg": 5.0}) for c in simulated.drive.manifest.rig.cameras]
    assert not by_motion(with_cameras(simulated, cameras)).is_corrected


def test_a_single_camera_has_nothing_to_be_compared_with() -> None:
    found = by_motion(make_simulated_drive(units=4, cameras=1, points=400))
    assert found.motions == 0
    assert not found.is_corrected
