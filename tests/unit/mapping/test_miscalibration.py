from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.bundle_adjustment.observability_analysis import Observability
from mrasfm_engine.geometry import se3
from mrasfm_engine.mapping.calibration import calibration_prior, observed_directions
from mrasfm_engine.mapping.incremental_mapping import MappingLog, adjust_globally
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.miscalibration import (
    Miscalibration,
    find_miscalibrations,
    find_wrong_pair,
    finding,
    pair_finding,
    voted_out,
)
from mrasfm_engine.mapping.refinement import refine
from mrasfm_engine.mapping.refinement_result import Refinement
from mrasfm_engine.mapping.systematic_errors import SystematicErrors
from mrasfm_engine.mapping.unit_registration import Registration
from tests.helpers.simulated_drive import (
    SimulatedDrive,
    make_model,
    make_simulated_drive,
    true_matches,
    with_cameras,
    with_true_poses,
)

TURNING, STRAIGHT = 24, 8  # units


def turned(camera: int | None, *, deg: float = 3.0, others_deg: float = 0.0, seed: int = 0):  # type: ignore[no-untyped-def]
    """What the manifest says of the cameras: one by `deg`, the others by `others_deg` off, in random directions."""

    def given(rig_from_cam: np.ndarray) -> np.ndarray:
        rng = np.random.default_rng(seed)
        for c in range(len(rig_from_cam)):
            direction = rng.normal(size=3)
            size = np.radians(deg if c == camera else others_deg)
            rig_from_cam[c, :3, :3] = rig_from_cam[c, :3, :3] @ se3.exp_so3(
                size * direction / np.linalg.norm(direction)
            )
        return rig_from_cam

    return given


def refined(simulated: SimulatedDrive) -> tuple[Mapper, Refinement]:
    """From true poses of the units, and the calibration as given, adjusted as mapping does."""
    mapper = with_true_poses(make_model(simulated), simulated, range(len(simulated.world_from_rig)))
    adjust_globally(mapper, MappingLog(), None)
    return mapper, refine(mapper)


def drive(given, *, straight: bool = False, points: int = 900) -> SimulatedDrive:  # type: ignore[no-untyped-def]
    units = STRAIGHT if straight else TURNING
    return make_simulated_drive(units=units, points=points, straight=straight, given=given)


def relative_errors_deg(mapper: Mapper, simulated: SimulatedDrive) -> np.ndarray:
    """Rotation errors (c,) of the cameras against the median of all."""
    errors = se3.log_so3(mapper.state.camera_rotation @ np.swapaxes(simulated.truth.rig_from_cam[:, :3, :3], 1, 2))
    return np.degrees(np.linalg.norm(errors - np.median(errors, axis=0), axis=1))


@pytest.mark.parametrize("straight", [False, True])
def test_a_wrong_camera_is_named_and_recalibrated(straight: bool) -> None:
    """Also on a straight street of few units without positions."""
    simulated = drive(turned(2), straight=straight, points=1500)
    mapper, result = refined(simulated)
    assert result.recalibrated.all()
    assert [w.camera for w in result.miscalibrations] == [2]
    wrong = result.miscalibrations[0]
    assert 2.9 < wrong.rotation_deg < 3.1
    assert 0 <= wrong.others_rotation_deg < 0.05
    errors = relative_errors_deg(mapper, simulated)
    assert 0 < errors[2] < 0.1
    assert errors.max() < 0.1


def test_a_camera_far_from_where_it_is_declared_to_a_millimetre_is_named_and_moved() -> None:
    """The drive knows its place less well than the declaration, which the adjustment has let go."""

    def moved(rig_from_cam: np.ndarray) -> np.ndarray:
        rig_from_cam[3, :3, 3] += [0.0, 0.3, 0.0]
        return rig_from_cam

    simulated = drive(moved)
    certain = {"sigma_translation_m": 0.001, "sigma_rotation_deg": 0.2}
    cameras = [camera.model_copy(update=certain) for camera in simulated.drive.manifest.rig.cameras]
    mapper, result = refined(with_cameras(simulated, cameras))
    assert [wrong.camera for wrong in result.miscalibrations] == [3]
    assert 0.25 < result.miscalibrations[0].translation_m < 0.35
    off_m = mapper.state.camera_position_m[3] - simulated.truth.rig_from_cam[3, :3, 3]
    assert np.linalg.norm(off_m) < 0.05


@pytest.mark.parametrize("straight", [False, True])
def test_a_usual_calibration_names_nobody(straight: bool) -> None:
    """Cameras that are off by 0.3 deg under a prior of 2 deg are what recalibration is for."""
    simulated = drive(turned(None, others_deg=0.3), straight=straight)
    mapper, result = refined(simulated)
    assert result.miscalibrations == []
    assert result.recalibrated.all()
    assert 0 < relative_errors_deg(mapper, simulated).max() < 0.2


def test_a_finding_says_which_camera_and_by_how_much() -> None:
    wrong = Miscalibration(
        camera=4,
        rotation_deg=2.96,
        translation_m=0.012,
        prior_sigmas=1.4,
        others_rotation_deg=0.02,
        others_translation_m=0.003,
    )
    said = finding("back_right", wrong)
    assert said.code == "camera-miscalibrated"
    assert "camera back_right is turned by 2.96 deg and moved by 0.012 m" in said.what
    assert "calibration.json" in said.remedy
    assert "Check first that params and images are its own" in said.remedy


def test_votes_in_units_with_covered_images_blame_no_camera() -> None:
    registrations = [
        Registration(unit=u, world_from_rig=np.eye(4), correspondences=9, inliers=9, method="vote", voted_out=names)
        for u, names in enumerate([("left",), ("left", "back"), ("back",), ()])
    ]
    assert voted_out(registrations, set()) == {"left": 2, "back": 2}
    assert voted_out(registrations, {1, 2}) == {"left": 1}


def test_of_two_cameras_only_the_pair_is_called_wrong() -> None:
    mapper = make_model(make_simulated_drive(units=4, cameras=2, points=200))
    prior = replace(calibration_prior(mapper), sigma_rotation_rad=np.radians([0.2, 0.2]))
    off = se3.exp_so3([0.0, 0.0, np.radians(1.5)])
    state = replace(
        mapper.state,
        camera_rotation=np.stack([off @ prior.rotation[0], off.T @ prior.rotation[1]]),
        camera_position_m=prior.position_m,
    )
    sees_rotations = np.tile([True, True, True, False, False, False], (2, 1))
    directions = Observability(
        observed=sees_rotations,
        ratio=np.where(sees_rotations, 0.01, np.nan),
        prior_sigma=prior.sigma,
        scale_observed=False,
        scale_only_prior=False,
        sigma_scale=0.01,
        prior_sigma_scale=0.01,
    )
    assert find_miscalibrations(prior, state, directions) == []
    pair = find_wrong_pair(prior, state, directions)
    assert pair is not None
    assert pair.rotation_deg == pytest.approx(3.0)
    said = pair_finding(["left", "right"], pair)
    assert "cameras left and right are turned by 3.00 deg" in said.what
    at_rest = replace(state, camera_rotation=prior.rotation)
    assert find_wrong_pair(prior, at_rest, directions) is None
    # Lenses that leave 0.4 deg of a rotation open explain 1.5 deg under five sigmas of 0.2 and 0.4 deg.
    assert find_wrong_pair(prior, state, directions, lens_errors(0.1, cameras=2)) is not None
    assert find_wrong_pair(prior, state, directions, lens_errors(0.4, cameras=2)) is None


def lens_errors(sigma_deg: float, *, cameras: int) -> SystematicErrors:
    """Errors of lens models that turn every camera by so much about each axis, and move none."""
    by_lenses = np.zeros((cameras, 7))
    by_lenses[:, :3] = np.radians(sigma_deg) ** 2
    return SystematicErrors(by_lenses=by_lenses, by_others=np.zeros_like(by_lenses), lens_px=1.0, factor=1.0)


@pytest.mark.parametrize(("lenses_deg", "wrong"), [(0.02, [1]), (0.1, [])])
def test_what_lens_models_turn_a_camera_by_is_no_miscalibration(lenses_deg: float, wrong: list[int]) -> None:
    """A calibration that is declared to 0.02 deg, and a camera that is found 0.3 deg off."""
    mapper = make_model(make_simulated_drive(units=4, cameras=4, points=200))
    prior = replace(calibration_prior(mapper), sigma_rotation_rad=np.radians([0.02] * 4))
    rotation = prior.rotation.copy()
    rotation[1] = se3.exp_so3(np.radians([0.3, 0.0, 0.0])) @ rotation[1]
    state = replace(mapper.state, camera_rotation=rotation, camera_position_m=prior.position_m)
    directions = Observability(
        observed=np.ones((4, 6), dtype=np.bool_),
        ratio=np.full((4, 6), 0.1),
        prior_sigma=prior.sigma,
        scale_observed=False,
        scale_only_prior=False,
        sigma_scale=0.01,
        prior_sigma_scale=0.01,
    )
    found = find_miscalibrations(prior, state, directions, lens_errors(lenses_deg, cameras=4))
    assert [one.camera for one in found] == wrong


@pytest.mark.parametrize(("about_y_deg", "wrong"), [(0.3, []), (1.5, [1])])
def test_a_direction_that_is_hardly_known_makes_no_camera_wrong(about_y_deg: float, wrong: list[int]) -> None:
    """A camera that shares little with the others: 1.2 deg about x are within what the drive leaves open."""
    mapper = make_model(make_simulated_drive(units=4, cameras=4, points=200))
    prior = calibration_prior(mapper)
    rotation = prior.rotation.copy()
    rotation[1] = se3.exp_so3(np.radians([1.2, about_y_deg, 0.0])) @ rotation[1]
    state = replace(mapper.state, camera_rotation=rotation, camera_position_m=prior.position_m)
    ratio = np.full((4, 6), 0.01)
    ratio[1, 0] = np.radians(0.3) / prior.sigma_rotation_rad[1]
    directions = Observability(
        observed=np.ones((4, 6), dtype=np.bool_),
        ratio=ratio,
        prior_sigma=prior.sigma,
        scale_observed=False,
        scale_only_prior=False,
        sigma_scale=0.01,
        prior_sigma_scale=0.01,
    )
    assert [one.camera for one in find_miscalibrations(prior, state, directions)] == wrong


def test_of_a_camera_that_observes_nothing_no_direction_is_observed() -> None:
    simulated = make_simulated_drive(units=8, cameras=3, points=300, hidden=lambda unit, camera: camera == 1)
    mapper, result = refined(simulated)
    known = observed_directions(mapper, result.certainty, 1e-12 * np.eye(18), placed=True)
    assert known is not None
    np.testing.assert_array_equal(known.observed.all(axis=1), [True, False, True])
    assert not known.observed[1].any()


def test_what_the_drive_does_not_observe_of_a_wrong_camera_stays_as_given() -> None:
    """A camera that shares no point with others, in three units of a straight street: nothing tells its pitch."""

    def about_vertical(rig_from_cam: np.ndarray) -> np.ndarray:
        rig_from_cam[2, :3, :3] = se3.exp_so3([0.0, 0.0, np.radians(3.0)]) @ rig_from_cam[2, :3, :3]
        return rig_from_cam

    simulated = make_simulated_drive(
        units=STRAIGHT,
        points=900,
        straight=True,
        given=about_vertical,
        hidden=lambda unit, camera: camera == 2 and unit not in (2, 3, 4),
    )
    images = simulated.drive.images
    pairs = [p for p in true_matches(simulated) if (images[p.image_a].camera == 2) == (images[p.image_b].camera == 2)]
    mapper = with_true_poses(make_model(simulated, pairs), simulated, range(STRAIGHT))
    adjust_globally(mapper, MappingLog(), None)
    result = refine(mapper)
    assert [wrong.camera for wrong in result.miscalibrations] == [2]
    turn_deg = np.degrees(calibration_prior(mapper).corrections(mapper.state)[2, :3])
    assert result.held is not None
    np.testing.assert_array_equal(result.held[2], [True, False, False, True, True, True])
    assert -3.3 < turn_deg[2] < -2.7
    assert np.abs(turn_deg[0]) < 0.1
