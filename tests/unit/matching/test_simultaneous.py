from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from mrasfm_engine.config import BundleAdjustmentConfig, MatchConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_cameras, unproject_pixels
from mrasfm_engine.matching.relative_pose import UncertainRig
from mrasfm_engine.matching.simultaneous import (
    RigEstimate,
    SimultaneousMatches,
    contradiction,
    estimate_rig,
    rig_of_drive,
    verified_again,
)
from mrasfm_engine.matching.verification import signed_parallax
from mrasfm_engine.scene.scene import PairMatches
from tests.helpers.simulated_drive import SimulatedDrive, make_simulated_drive, true_matches

DEG = np.pi / 180


def turned(camera: int, rotation_deg: list[float]) -> SimulatedDrive:
    """A drive of six cameras of which one is given with another rotation than it has, about its own axes."""

    def given(rig_from_cam: np.ndarray) -> np.ndarray:
        rig_from_cam[camera, :3, :3] = rig_from_cam[camera, :3, :3] @ se3.exp_so3(np.array(rotation_deg) * DEG)
        return rig_from_cam

    return make_simulated_drive(units=6, cameras=6, points=3000, given=given)


def rays_of_matches(simulated: SimulatedDrive) -> Callable[[PairMatches], tuple[np.ndarray, np.ndarray]]:
    """Viewing rays of all matches of a pair."""
    kinds, params = pack_cameras(simulated.drive.cameras)

    def rays(image: int, keypoints: np.ndarray) -> np.ndarray:
        camera = simulated.drive.images[image].camera
        return unproject_pixels(int(kinds[camera]), params[camera], simulated.features[image].xy_px[keypoints])

    def rays_of(pair: PairMatches) -> tuple[np.ndarray, np.ndarray]:
        a, b = pair.matches.T
        return rays(pair.image_a, a), rays(pair.image_b, b)

    return rays_of


def estimate(simulated: SimulatedDrive, *, wrong: int = 0, **calibration: bool) -> RigEstimate:
    rays_of = rays_of_matches(simulated)
    pairs = true_matches(simulated, window=0, wrong=wrong)
    return rig_of_drive(simulated.drive, pairs, rays_of, MatchConfig(), BundleAdjustmentConfig(**calibration))


def relative_error_deg(found: np.ndarray, true: np.ndarray, a: int, b: int) -> float:
    """Error of the rotation between two cameras."""
    off = (found[a, :3, :3].T @ found[b, :3, :3]).T @ (true[a, :3, :3].T @ true[b, :3, :3])
    return float(np.degrees(np.linalg.norm(se3.log_so3(off))))


def test_a_rig_that_is_given_well_stays_exactly_as_given() -> None:
    simulated = turned(1, [0.0, 0.0, 0.0])
    rig = estimate(simulated)
    np.testing.assert_array_equal(rig.rig_from_cam, simulated.drive.rig_from_cam)
    assert rig.matches > 500
    assert rig.fitted_as_given == rig.fitted > 0.98
    assert contradiction([c.name for c in simulated.drive.cameras], simulated.drive.rig_from_cam, rig) is None


@pytest.mark.parametrize("wrong", [0, 10])
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_camera_that_is_turned_within_its_prior_is_found(sign: int, wrong: int) -> None:
    simulated = turned(1, [sign * 1.5, 0.0, 0.0])
    rig = estimate(simulated, wrong=wrong)
    true = simulated.truth.rig_from_cam
    neighbours = [b for b in range(6) if b != 1 and true[b, :3, 2] @ true[1, :3, 2] > 0.3]
    assert neighbours
    for b in neighbours:
        assert relative_error_deg(simulated.drive.rig_from_cam, true, 1, b) == pytest.approx(1.5, abs=0.01)
        assert relative_error_deg(rig.rig_from_cam, true, 1, b) < 0.3
    assert rig.fitted > rig.fitted_as_given + 0.1


@pytest.mark.parametrize("axis", [0, 2])  # a rig all around sees little of yaw
def test_a_camera_that_is_turned_far_beyond_its_prior_is_found(axis: int) -> None:
    """Matches that are all wrong by hundreds of pixels say next to nothing, until the camera is where it is."""
    simulated = turned(1, (15.0 * np.eye(3)[axis]).tolist())
    rig = estimate(simulated)
    true = simulated.truth.rig_from_cam
    neighbours = [b for b in range(6) if b != 1 and true[b, :3, 2] @ true[1, :3, 2] > 0.3]
    for b in neighbours:
        assert relative_error_deg(rig.rig_from_cam, true, 1, b) < 1.0
    assert rig.fitted > 0.9
    assert contradiction([c.name for c in simulated.drive.cameras], simulated.drive.rig_from_cam, rig) is not None


@pytest.mark.parametrize(("units", "found"), [(1, False), (6, True)])
def test_matches_of_one_unit_that_all_agree_turn_no_camera_far(units: int, found: bool) -> None:
    """What one unit shows of two cameras may be a lorry's side, or one facade taken for another."""
    simulated = turned(1, [0.0, 0.0, 0.0])
    given, rng = simulated.drive.rig_from_cam, np.random.default_rng(1)
    wrong = given.copy()
    wrong[1, :3, :3] = given[1, :3, :3] @ se3.exp_so3(np.array([15.0, 0.0, 0.0]) * DEG)
    points_m = (
        wrong[1] @ np.concatenate([rng.uniform(-4, 4, (40, 2)), np.full((40, 1), 9.0), np.ones((40, 1))], 1).T
    ).T
    rays = [
        (pose[:3, :3].T @ (points_m[:, :3] - pose[:3, 3]).T).T + rng.normal(0, 1e-3, (40, 3))
        for pose in (wrong[0], wrong[1])
    ]
    rays = [one / np.linalg.norm(one, axis=1, keepdims=True) for one in rays]
    matches = SimultaneousMatches(camera_a=0, camera_b=1, rays_a=rays[0], rays_b=rays[1], units=units)
    rig = estimate_rig(
        given, [matches], sigma_rotation_rad=np.full(6, 2.0 * DEG), sigma_translation_m=np.full(6, 0.05),
        focal_px=np.full(6, 700.0), max_error_px=4.0,
    )  # fmt: skip
    assert rig.is_far == found
    if not found:
        np.testing.assert_array_equal(rig.rig_from_cam, given)


@pytest.mark.parametrize("seed", range(4))
def test_cameras_whose_places_are_as_uncertain_as_they_are_apart_are_corrected(seed: int) -> None:
    """Two stereo pairs, one in grey and one in colour, whose cameras stand beside one another."""
    rng = np.random.default_rng(seed)
    ahead = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    true = se3.transform(np.tile(ahead, (4, 1, 1)), [[1.1, y, 0.7] for y in (-0.31, -0.85, -0.25, -0.79)])
    given = se3.transform(
        se3.exp_so3(rng.normal(0.0, 1.0, (4, 3)) * DEG) @ true[:, :3, :3],
        true[:, :3, 3] + rng.normal(0.0, 0.04, (4, 3)),
    )
    points_m = rng.uniform([4.0, -3.0, -1.0], [12.0, 3.0, 3.0], (2000, 3))
    rays = se3.apply(se3.inverse(true), points_m)
    rays = rays / rays[..., 2:] + rng.normal(0.0, 0.3 / 700.0, rays.shape) * [1.0, 1.0, 0.0]
    rig = estimate_rig(
        given,
        [SimultaneousMatches(camera_a=a, camera_b=b, rays_a=rays[a], rays_b=rays[b], units=9)
         for a, b in combinations(range(4), 2)],
        sigma_rotation_rad=np.full(4, 2.0 * DEG), sigma_translation_m=np.full(4, 0.05),
        focal_px=np.full(4, 700.0), max_error_px=4.0,
    )  # fmt: skip
    assert rig.fitted_as_given < 0.5
    assert rig.fitted > 0.95
    np.testing.assert_array_equal(rig.rig_from_cam[:, :3, 3], given[:, :3, 3])
    for a, b in combinations(range(4), 2):
        assert relative_error_deg(rig.rig_from_cam, true, a, b) < 0.7


def test_a_correction_under_which_few_matches_fit_is_none() -> None:
    """Two cameras side by side of which one is yawed by more than their matches can tell."""

    def given(rig_from_cam: np.ndarray) -> np.ndarray:
        rig_from_cam[1, :3, :3] = rig_from_cam[1, :3, :3] @ se3.exp_so3(np.array([0.0, 22.0, 0.0]) * DEG)
        return rig_from_cam

    simulated = make_simulated_drive(units=6, cameras=2, points=3000, given=given)
    rig = estimate(simulated)
    np.testing.assert_array_equal(rig.rig_from_cam, simulated.drive.rig_from_cam)
    assert rig.fitted == rig.fitted_as_given < 0.5


def test_what_was_found_is_said_where_most_matches_contradict_the_calibration() -> None:
    given = make_simulated_drive(units=6, cameras=2, points=2000).drive.rig_from_cam
    estimated = given.copy()
    estimated[1, :3, :3] = estimated[1, :3, :3] @ se3.exp_so3(np.array([1.5, 0.0, 0.0]) * DEG)
    rig = RigEstimate(
        rig_from_cam=estimated, covariance=np.eye(12), matches=800, fitted_as_given=0.02, fitted=0.99,
    )  # fmt: skip
    found = contradiction(["front", "left"], given, rig)
    assert found is not None
    assert "front and left turned by 1.50 deg" in found.what
    assert "2% fit the calibration as given, 99%" in found.what


def test_settings_that_hold_the_calibration_hold_it_here_too() -> None:
    simulated = turned(1, [1.5, 0.0, 0.0])
    rig = estimate(simulated, refine_calibration=False)
    np.testing.assert_array_equal(rig.rig_from_cam, simulated.drive.rig_from_cam)
    assert rig.matches == 0
    # Nothing is known but the prior, so the gate is as wide as that.
    np.testing.assert_allclose(np.sqrt(np.diag(rig.covariance)), np.tile([2.0 * DEG] * 3 + [0.05] * 3, 6))


def test_cameras_at_one_place_and_matches_of_nothing_do_no_harm() -> None:
    rng = np.random.default_rng(0)
    given = make_simulated_drive(units=1, cameras=6, points=50).drive.rig_from_cam.copy()
    given[:, :3, 3] = given[0, :3, 3]
    rays = rng.normal(size=(2, 300, 3)) + np.array([0, 0, 3])
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    found = [SimultaneousMatches(camera_a=0, camera_b=1, rays_a=rays[0], rays_b=rays[1], units=6)]
    sigmas = np.full(6, 2.0 * DEG), np.full(6, 0.05)
    rig = estimate_rig(
        given, found, sigma_rotation_rad=sigmas[0], sigma_translation_m=sigmas[1], focal_px=np.full(6, 700.0),
        max_error_px=2.0,
    )  # fmt: skip
    turned_deg = np.degrees(
        np.linalg.norm(se3.log_so3(rig.rig_from_cam[:, :3, :3] @ given[:, :3, :3].swapaxes(1, 2)), axis=1)
    )
    assert turned_deg.max() < 6.0
    assert np.isfinite(rig.covariance).all()


def test_parallax_has_the_sign_of_the_side_on_which_rays_meet() -> None:
    rng = np.random.default_rng(0)
    b_from_a = se3.transform(se3.exp_so3([0.02, -0.01, 0.03]), [-0.5, 0.02, 0.1])
    points = rng.uniform(-2, 2, (50, 3)) + np.array([0, 0, 10])
    rays_a, rays_b = points, se3.apply(b_from_a, points)
    rays_a, rays_b = (r / np.linalg.norm(r, axis=1, keepdims=True) for r in (rays_a, rays_b))
    front = signed_parallax(b_from_a, rays_a, rays_b)
    angles = np.arccos(((rays_a @ b_from_a[:3, :3].T) * rays_b).sum(1))
    np.testing.assert_allclose(front, np.sin(angles), rtol=1e-6)
    backward = b_from_a.copy()
    backward[:3, 3] *= -1
    np.testing.assert_allclose(signed_parallax(backward, rays_a, rays_b), -front, rtol=1e-6)
    assert np.abs(signed_parallax(b_from_a, rays_a, rays_a @ b_from_a[:3, :3].T)).max() < 1e-9


def exactly_known(rig_from_cam: np.ndarray) -> UncertainRig:
    sigma = np.tile([0.05 * DEG] * 3 + [0.01] * 3, len(rig_from_cam))
    return UncertainRig(rig_from_cam=rig_from_cam, covariance=np.diag(sigma**2))


def test_matches_come_back_when_the_rig_has_moved_to_where_it_is() -> None:
    """By a calibration ten sigmas off they are gone, by the true one all are there but the wrong ones."""
    simulated = turned(1, [30.0, 0.0, 0.0])
    rays_of, config = rays_of_matches(simulated), MatchConfig()
    focal_px = pack_cameras(simulated.drive.cameras)[1][:, 0]
    matched = true_matches(simulated, window=1, wrong=10)
    counts = []
    first = verified_again(
        simulated.drive, matched, rays_of, exactly_known(simulated.drive.rig_from_cam), focal_px=focal_px, config=config
    )
    again = verified_again(
        simulated.drive, first, rays_of, exactly_known(simulated.truth.rig_from_cam), focal_px=focal_px, config=config
    )
    for pairs in (first, again):
        assert [(p.image_a, p.image_b) for p in pairs] == [(p.image_a, p.image_b) for p in matched]
        inside, right, wrong = 0, 0, 0
        for pair, whole in zip(pairs, matched, strict=True):
            a, b = (simulated.drive.images[i] for i in (pair.image_a, pair.image_b))
            if a.unit != b.unit:
                assert pair is whole  # the vehicle's motion is no matter of the rig
            elif 1 in (a.camera, b.camera):
                inside += len(whole.matches) - 10
                right += int(pair.inliers[:-10].sum())
                wrong += int(pair.inliers[-10:].sum())
            assert not pair.inliers.any() or pair.inliers.sum() >= config.min_matches
        counts.append((inside, right, wrong))
    (inside, before, _), (_, after, wrong) = counts
    assert inside > 500
    assert before < 0.05 * inside
    assert 0.95 * inside < after < inside
    assert wrong < 0.01 * after


def test_a_rig_that_has_not_moved_keeps_its_inliers() -> None:
    simulated = turned(1, [0.0, 0.0, 0.0])
    rays_of, config = rays_of_matches(simulated), MatchConfig()
    focal_px = pack_cameras(simulated.drive.cameras)[1][:, 0]
    rig = exactly_known(simulated.drive.rig_from_cam)
    matched = [p for p in true_matches(simulated, window=0) if len(p.matches) > 30]
    emptied = [replace(p, inliers=np.zeros_like(p.inliers)) for p in matched]
    results = [
        verified_again(simulated.drive, p, rays_of, rig, focal_px=focal_px, config=config) for p in (matched, emptied)
    ]
    for one, other in zip(*results, strict=True):
        np.testing.assert_array_equal(one.inliers, other.inliers)
        assert 0.9 < one.inliers.mean() <= 1.0
