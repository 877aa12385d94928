from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.mapping.georeferencing import GnssAlignment, Refusal, align_with_gnss, assess_residuals
from mrasfm_engine.synthetic.simulate import simulate_trajectory

ARM_M = np.array([-0.5, 0.2, 1.8])


@dataclass
class Track:
    """A trajectory in the model's frame, and what the receiver says of it."""

    model_from_rig: np.ndarray
    measured_m: np.ndarray
    sigma_m: np.ndarray
    world_from_model: np.ndarray

    def align(self) -> GnssAlignment | Refusal:
        rotation = self.model_from_rig[:, :3, :3]
        return align_with_gnss(
            self.model_from_rig[:, :3, 3] + rotation @ ARM_M,
            rotation[:, :, 2],
            rotation[:, :, 0],
            self.measured_m,
            self.sigma_m,
            outlier_sigmas=4.0,
            sigma_rig_scale=0.05,
            rng=np.random.default_rng(0),
        )


def track(
    *,
    units: int = 60,
    spacing_m: float = 1.5,
    straight: bool = False,
    sigma_m: float = 0.05,
    seed: int = 0,
    tilt: bool = True,
) -> Track:
    rng = np.random.default_rng(seed)
    world_from_rig = simulate_trajectory(units, spacing_m=spacing_m, straight=straight)
    antenna = world_from_rig[:, :3, 3] + world_from_rig[:, :3, :3] @ ARM_M
    # The model's frame is that of its first vehicle pose in any orientation, as a reconstruction begins.
    turn = se3.exp_so3(rng.normal(size=3)) if tilt else np.eye(3)
    model_from_world = se3.transform(turn, rng.normal(size=3) * 50)
    return Track(
        model_from_rig=model_from_world @ world_from_rig,
        measured_m=antenna + rng.normal(size=antenna.shape) * sigma_m,
        sigma_m=np.full(antenna.shape, max(sigma_m, 1e-3)),
        world_from_model=se3.inverse(model_from_world),
    )


def errors(found: GnssAlignment, expected: Track) -> tuple[float, float]:
    """Largest distance of a vehicle position from where it is (m), rotation error (deg)."""
    a, b = (m @ expected.model_from_rig for m in (found.world_from_model, expected.world_from_model))
    turn = found.world_from_model[:3, :3] @ expected.world_from_model[:3, :3].T
    return float(np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1).max()), float(se3.rotation_angle_deg(turn))


@pytest.mark.parametrize("seed", range(3))
def test_a_known_transform_is_recovered(seed: int) -> None:
    t = track(seed=seed)
    found = t.align()
    assert isinstance(found, GnssAlignment)
    position_m, rotation_deg = errors(found, t)
    assert 1e-4 < position_m < 0.1
    assert 1e-4 < rotation_deg < 1.0
    assert found.inlier.all()
    assert 0.03 < np.sqrt((found.residual_m**2).mean()) < 0.15
    assert found.scale == pytest.approx(1.0, abs=0.005)
    assert 1.0 <= found.noise_factor < 1.4


def test_the_transform_is_rigid_and_scale_only_told() -> None:
    t = track(sigma_m=0.3)
    t.model_from_rig[:, :3, 3] /= 1.02
    found = t.align()
    assert isinstance(found, GnssAlignment)
    rotation = found.world_from_model[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert found.scale == pytest.approx(1.02, abs=0.006)


@pytest.mark.parametrize(
    ("sigma_m", "travelled_m", "scale"), [(0.02, 300.0, 1.005), (0.05, 300.0, 1.007), (0.3, 1000.0, 1.01)]
)
def test_a_rig_that_is_off_in_scale_is_aligned_all_the_same(sigma_m: float, travelled_m: float, scale: float) -> None:
    t = track(units=200, spacing_m=travelled_m / 200, sigma_m=sigma_m)
    t.model_from_rig[:, :3, 3] /= scale
    found = t.align()
    assert isinstance(found, GnssAlignment)
    assert found.scale == pytest.approx(scale, abs=0.002)
    assert found.inlier.mean() > 0.9


@pytest.mark.parametrize(("factor", "units"), [(0.02, 14), (0.1, 14), (0.02, 60)])
def test_positions_of_another_size_are_refused_however_noisy(factor: float, units: int) -> None:
    """Positions in radians instead of degrees lie together: their size is hardly known, and not the trajectory's."""
    t = track(units=units, spacing_m=1.2, sigma_m=1.0)
    small = t.measured_m.mean(axis=0) + factor * (t.measured_m - t.measured_m.mean(axis=0))
    found = replace(t, measured_m=small).align()
    assert isinstance(found, Refusal)
    assert found.is_of_scale


@pytest.mark.parametrize("seed", range(3))
def test_on_a_straight_line_up_decides_the_roll(seed: int) -> None:
    t = track(straight=True, seed=seed)
    found = t.align()
    assert isinstance(found, GnssAlignment)
    up = found.world_from_model[:3, :3] @ t.model_from_rig[:, :3, 2].mean(0)
    assert 1e-4 < np.degrees(np.arccos(up[2] / np.linalg.norm(up))) < 1.0
    position_m, rotation_deg = errors(found, t)
    assert 1e-4 < position_m < 0.15
    assert 1e-3 < rotation_deg < 1.5


@pytest.mark.parametrize("straight", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_a_fifth_of_gross_errors_is_rejected(seed: int, straight: bool) -> None:
    t = track(straight=straight, seed=seed)
    rng = np.random.default_rng(seed)
    wrong = rng.choice(60, 12, replace=False)
    t.measured_m[wrong] += rng.choice([-1.0, 1.0], (12, 3)) * rng.uniform(2, 100, (12, 3))
    found = t.align()
    assert isinstance(found, GnssAlignment)
    assert not found.inlier[wrong].any()
    assert found.inlier.sum() >= 46
    assert 1e-4 < errors(found, t)[0] < 0.15


def test_a_jump_that_stays_is_not_averaged_in() -> None:
    t = track()
    t.measured_m[45:] += [4.0, -3.0, 2.0]
    found = t.align()
    assert isinstance(found, GnssAlignment)
    assert found.inlier[:45].all()
    assert not found.inlier[45:].any()
    assert errors(found, t)[0] < 0.2


@pytest.mark.parametrize("sigma_m", [0.02, 0.05, 0.3, 1.0])
def test_a_scene_that_bends_is_aligned_however_good_the_receiver_is(sigma_m: float) -> None:
    t = track(units=150, sigma_m=sigma_m)
    way = np.arange(150) / 150
    t.model_from_rig[:, :3, 3] += t.model_from_rig[:, :3, 1] * (8.0 * way**2)[:, None]
    found = t.align()
    assert isinstance(found, GnssAlignment)
    assert found.inlier.mean() > 0.95
    assert errors(found, t)[0] < 8.0
    # What the bend leaves is seen where it exceeds the receiver's noise.
    assert found.noise_factor > 5 if sigma_m < 0.1 else found.noise_factor < 5


@pytest.mark.parametrize("pitch_deg", [-1.0, -0.5, 0.5, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_straight_street_that_climbs_is_not_taken_for_its_mirror_image(pitch_deg: float, seed: int) -> None:
    t = track(straight=True, sigma_m=0.02, seed=seed)
    # The model's cameras look up or down by more than the manifest says, and the vehicle with them.
    t.model_from_rig[:, :3, :3] = t.model_from_rig[:, :3, :3] @ se3.exp_so3([0.0, np.radians(pitch_deg), 0.0])
    assert isinstance(t.align(), GnssAlignment)


def test_what_a_bend_made_an_outlier_comes_back_and_a_jump_does_not() -> None:
    rng = np.random.default_rng(0)
    sigma_m = np.full((100, 3), 0.05)
    noise_m = rng.normal(size=(100, 3)) * sigma_m
    bend_m = np.zeros((100, 3))
    bend_m[60:, 0] = np.linspace(0, 1.0, 40) ** 2
    jump_m = np.zeros((100, 3))
    jump_m[20:35, 1] = 3.0
    before = np.arange(100) < 60
    bent, factor = assess_residuals(noise_m + bend_m, sigma_m, before, outlier_sigmas=4.0)
    assert bent.all()
    assert factor < 1.3
    jumped, factor = assess_residuals(noise_m + bend_m + jump_m, sigma_m, before, outlier_sigmas=4.0)
    np.testing.assert_array_equal(jumped, jump_m[:, 1] == 0)
    assert assess_residuals(20 * noise_m, sigma_m, before, outlier_sigmas=4.0)[1] == pytest.approx(20 * factor, rel=0.5)


def test_sigmas_that_promise_too_much_are_found_out() -> None:
    t = track(sigma_m=0.3, units=150)
    t.sigma_m[:] = 0.1
    found = t.align()
    assert isinstance(found, GnssAlignment)
    assert 2.0 < found.noise_factor < 4.0
    assert found.inlier.mean() > 0.95


def test_a_standing_car_gets_a_reason() -> None:
    t = track(spacing_m=1e-4)
    t.model_from_rig[:, :3, 3] += np.random.default_rng(0).normal(size=(60, 3)) * 0.002
    found = t.align()
    assert isinstance(found, Refusal)
    assert "moved by" in found.reason


@pytest.mark.parametrize("flip", ["swapped", "mirrored"])
def test_a_track_of_another_shape_gets_a_reason(flip: str) -> None:
    t = track(units=120, spacing_m=2.0)
    # A long bend: a mirrored one cannot be turned onto it.
    t.measured_m = t.measured_m[:, [1, 0, 2]] if flip == "swapped" else t.measured_m * [-1.0, 1.0, 1.0]
    found = t.align()
    assert isinstance(found, Refusal)
    assert "swapped" in found.reason


@pytest.mark.parametrize("latitude_deg", [10.0, 49.0, 65.0])
def test_swapped_coordinates_are_told_wherever_the_drive_is(latitude_deg: float) -> None:
    """A degree of longitude has another length than one of latitude, where the drive is and where swapped ones are."""
    t = track(units=120, spacing_m=2.0, sigma_m=0.5)
    here, there = np.cos(np.radians([latitude_deg, 8.0]))
    t.measured_m = t.measured_m[:, [1, 0, 2]] * [there, 1.0 / here, 1.0]
    found = t.align()
    assert isinstance(found, Refusal)
    assert "swapped" in found.reason


@pytest.mark.parametrize("units", [0, 1, 2])
def test_too_few_positions_are_a_reason(units: int) -> None:
    t = track(units=max(units, 1))
    cut = Track(t.model_from_rig[:units], t.measured_m[:units], t.sigma_m[:units], t.world_from_model)
    found = cut.align()
    assert isinstance(found, Refusal)
    assert f"only {units} registered" in found.reason
