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

FRONT, BACK_LEFT, BACK = 0, 3, 5  # of six, no two share a view; the last is at the rear axle, 1.7 m behind the first


def turned(
    rotation_deg: list[float],
    *,
    straight: bool = True,
    other: int = BACK_LEFT,
    radius_m: float | None = None,
    time_offset_ms: list[int] | None = None,
    readout_ms: int = 0,
    seed: int = 0,
) -> SimulatedDrive:
    """A drive of two cameras without a common view; the other one is given turned about the rig's axes."""

    def given(rig_from_cam: np.ndarray) -> np.ndarray:
        rig_from_cam[other, :3, :3] = se3.exp_so3(np.radians(rotation_deg)) @ rig_from_cam[other, :3, :3]
        return rig_from_cam

    return make_simulated_drive(
        units=8,
        cameras=6,
        points=1500,
        straight=straight,
        radius_m=radius_m,
        given=given,
        hidden=lambda unit, camera: camera not in (FRONT, other),
        time_offset_ms=time_offset_ms,
        readout_ms=readout_ms,
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


def off_deg(simulated: SimulatedDrive, rig_from_cam: np.ndarray, other: int = BACK_LEFT) -> float:
    return relative_error_deg(rig_from_cam, simulated.truth.rig_from_cam, FRONT, other)


def turn_off_deg(simulated: SimulatedDrive, rig_from_cam: np.ndarray) -> np.ndarray:
    """Error (3,) of BACK_LEFT's rotation against FRONT's, about the rig's axes."""
    by = rig_from_cam[:, :3, :3] @ np.swapaxes(simulated.truth.rig_from_cam[:, :3, :3], 1, 2)
    result: np.ndarray = np.degrees(se3.log_so3(by[BACK_LEFT] @ by[FRONT].T))
    return result


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
def test_a_rig_that_is_off_by_what_its_prior_and_the_noise_of_directions_let_expect_stays_as_given(
    straight: bool,
) -> None:
    simulated = turned([0.0, 3.0, 0.0], straight=straight)
    found = by_motion(simulated)
    by_prior_deg = np.hypot(2.0, 2.0)
    assert np.degrees(found.apart_before_rad[FRONT, BACK_LEFT]) > by_prior_deg
    assert not found.is_corrected


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


@pytest.mark.parametrize(("after_deg", "says"), [(4.0, "Mapping begins"), (174.0, "mirrored")])
def test_a_correction_that_leaves_two_cameras_driving_opposite_ways_is_not_taken_for_the_cause(
    after_deg: float, says: str
) -> None:
    given = np.tile(np.eye(4), (2, 1, 1))
    corrected = se3.transform(se3.exp_so3(np.radians([[0.0, 0.0, 3.0], [0.0, 0.0, 0.0]])), np.zeros((2, 3)))
    apart = 1.0 - np.eye(2)
    found = MotionEstimate(
        rig_from_cam=corrected,
        motions=24,
        apart_before_rad=np.radians(176.0) * apart,
        apart_rad=np.radians(after_deg) * apart,
    )
    finding = motion_contradiction(["left", "right"], given, found)
    assert finding is not None
    assert says in finding.remedy


def test_roll_about_a_straight_street_stays_as_given() -> None:
    """No motion shows it, and a correction of another axis brings none of it."""
    simulated = turned([6.0, 6.0, 0.0])
    found = by_motion(simulated)
    roll_deg, pitch_deg, yaw_deg = turn_off_deg(simulated, found.rig_from_cam)
    assert abs(pitch_deg) < 2.0
    assert roll_deg == pytest.approx(6.0, abs=1.0)
    assert abs(yaw_deg) < 1.0


def test_roll_is_found_where_the_street_winds() -> None:
    simulated = turned([6.0, 6.0, 0.0], straight=False)
    roll_deg, pitch_deg, _ = turn_off_deg(simulated, by_motion(simulated).rig_from_cam)
    assert abs(pitch_deg) < 2.0
    assert abs(roll_deg) < 3.5


@pytest.mark.parametrize("other", [BACK_LEFT, BACK])
def test_in_a_tight_turn_lever_arms_are_no_error_of_rotations(other: int) -> None:
    """Cameras far from the rear axle move aside: their directions differ, and no camera is turned."""
    simulated = turned([0.0, 0.0, 0.0], other=other, radius_m=5.0)
    found = by_motion(simulated)
    assert found.motions > 10
    assert found.apart_before_rad[FRONT, other] > np.radians(5.0)
    np.testing.assert_array_equal(found.rig_from_cam, simulated.drive.rig_from_cam)


@pytest.mark.parametrize("other", [BACK_LEFT, BACK])
@pytest.mark.parametrize("rotation_deg", [[6.0, 0.0, 0.0], [0.0, 6.0, 0.0]])
def test_a_turned_camera_is_found_in_a_tight_turn(rotation_deg: list[float], other: int) -> None:
    simulated = turned(rotation_deg, other=other, radius_m=5.0)
    assert off_deg(simulated, by_motion(simulated).rig_from_cam, other) < 2.0


# Cameras that are not simultaneous, with rolling shutters, of a vehicle that turns by 6 deg from unit to unit.
LATE = {"radius_m": 10.0, "time_offset_ms": [0, 50, 50, 50, 50, 50], "readout_ms": 30}


def test_cameras_that_are_not_simultaneous_are_not_turned_for_that() -> None:
    simulated = turned([0.0, 0.0, 0.0], **LATE)
    found = by_motion(simulated)
    assert found.motions > 10
    np.testing.assert_array_equal(found.rig_from_cam, simulated.drive.rig_from_cam)


def test_a_turned_camera_that_is_not_simultaneous_is_found() -> None:
    simulated = turned([0.0, 6.0, 0.0], **LATE)
    assert off_deg(simulated, by_motion(simulated).rig_from_cam) < 2.0


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
