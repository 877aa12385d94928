from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.gnss_track import GnssTrack, find_gross_errors, find_held, rough_trajectory

ARM_M = np.array([-0.5, 0.2, 1.8])


def times_us(count: int, step_s: float = 0.1) -> np.ndarray:
    return 1_700_000_000_000_000 + np.round(np.arange(count) * step_s * 1e6).astype(np.int64)


def bend(t_us: np.ndarray, speed_mps: float = 8.0) -> tuple[np.ndarray, np.ndarray]:
    """Positions and headings on a circle of 40 m radius."""
    heading = (t_us - t_us[0]) / 1e6 * speed_mps / 40.0
    return 40.0 * np.stack([np.sin(heading), 1 - np.cos(heading), 0 * heading], 1), heading


def track(t_us: np.ndarray, position: np.ndarray, sigma_m: float = 0.05, good: np.ndarray | None = None) -> GnssTrack:
    return GnssTrack(
        timestamps_us=t_us,
        position_m=position,
        sigma_m=np.full((len(t_us), 3), sigma_m),
        good=np.ones(len(t_us), dtype=np.bool_) if good is None else good,
    )


@pytest.mark.parametrize("seed", range(3))
def test_gross_errors_are_found_and_only_those(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t = times_us(120)
    position, _ = bend(t)
    position += rng.normal(size=position.shape) * 0.1
    wrong = np.arange(8, 115, 13) + rng.integers(-3, 4, 9)
    position[wrong] += rng.choice([-1.0, 1.0], (9, 3)) * rng.uniform(5, 300, (9, 3))
    bad = find_gross_errors(t, position, np.full((120, 3), 0.1), outlier_sigmas=4.0)
    assert sorted(np.flatnonzero(bad)) == sorted(wrong)


@pytest.mark.parametrize("seed", range(3))
def test_gross_errors_in_bursts_are_all_found(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t = times_us(120)
    position, _ = bend(t)
    position += rng.normal(size=position.shape) * 0.1
    wrong = rng.choice(120, 10, replace=False)
    position[wrong] += rng.choice([-1.0, 1.0], (10, 3)) * rng.uniform(5, 300, (10, 3))
    bad = find_gross_errors(t, position, np.full((120, 3), 0.1), outlier_sigmas=4.0)
    assert bad[wrong].all()
    # Between several wrong neighbours a good sample may be lost with them.
    assert bad.sum() - 10 <= 1


def test_wrong_samples_do_not_take_the_ends_of_a_short_drive_with_them() -> None:
    t = times_us(8)
    position = np.outer(np.arange(8.0), [1.1, 0.4, 0.0]) + np.random.default_rng(0).normal(size=(8, 3)) * 0.4
    position[2] += [0.0, 55.0, 0.0]
    position[5] -= [0.0, 55.0, 0.0]
    bad = find_gross_errors(t, position, np.full((8, 3), 0.5), outlier_sigmas=4.0)
    assert list(np.flatnonzero(bad)) == [2, 5]


def test_a_jump_that_stays_costs_no_more_than_its_edge() -> None:
    t = times_us(100)
    position, _ = bend(t)
    position[50:] += [0.0, 0.0, 30.0]
    bad = find_gross_errors(t, position, np.full((100, 3), 0.1), outlier_sigmas=4.0)
    assert bad.sum() <= 10
    assert not bad[:45].any()
    assert not bad[55:].any()


def test_a_sharp_turn_and_a_stop_are_no_gross_errors() -> None:
    t = times_us(80)
    along = np.minimum(np.arange(80) * 0.5, 20.0)  # 5 m/s, then standing
    position = np.stack([along, np.where(along > 10, along - 10, 0.0), 0 * along], 1)
    assert not find_gross_errors(t, position, np.full((80, 3), 0.02), outlier_sigmas=4.0).any()


def test_interpolation_is_linear_and_keeps_the_larger_sigma() -> None:
    t = times_us(5, step_s=1.0)
    gnss = GnssTrack(
        timestamps_us=t,
        position_m=np.arange(5.0)[:, None] * [1.0, 2.0, 3.0],
        sigma_m=np.array([0.1, 0.1, 0.5, 0.1, 0.1])[:, None] * [1.0, 1.0, 2.0],
        good=np.ones(5, dtype=np.bool_),
    )
    position, sigma = gnss.at(t[[0, 1, 1, 4]] + np.array([0, 250_000, 0, 0]), max_gap_us=2_000_000)
    np.testing.assert_allclose(position, np.array([0.0, 1.25, 1.0, 4.0])[:, None] * [1.0, 2.0, 3.0], atol=1e-9)
    np.testing.assert_allclose(sigma[1], [0.5, 0.5, 1.0])
    np.testing.assert_allclose(sigma[0], [0.1, 0.1, 0.2])


def test_interpolation_over_gaps_and_outside_is_nan() -> None:
    t = times_us(10, step_s=1.0)
    good = np.ones(10, dtype=np.bool_)
    good[4:7] = False  # 4 s between good samples
    gnss = track(t, np.arange(10.0)[:, None] * np.ones(3), good=good)
    asked = np.array([t[0] - 1, t[9] + 1, t[5], t[3], t[7], t[2] + 500_000])
    position, sigma = gnss.at(asked, max_gap_us=2_000_000)
    assert np.isnan(position[:3]).all()
    assert np.isnan(sigma[:3]).all()
    np.testing.assert_allclose(position[3:, 0], [3.0, 7.0, 2.5], atol=1e-9)
    wide, _ = gnss.at(asked, max_gap_us=5_000_000)
    assert wide[2, 0] == pytest.approx(5.0)


@pytest.mark.parametrize("samples", [0, 1])
def test_a_track_of_hardly_any_samples_answers_all_the_same(samples: int) -> None:
    t = times_us(3)
    good = np.zeros(3, dtype=np.bool_)
    good[:samples] = True
    position, _ = track(t, np.ones((3, 3)), good=good).at(t, max_gap_us=2_000_000)
    assert np.isfinite(position).all(1).sum() == samples


def test_the_rough_trajectory_applies_the_lever_arm() -> None:
    rng = np.random.default_rng(0)
    t = times_us(100)
    rig, heading = bend(t)
    rotation = se3.exp_so3(heading[:, None] * [0.0, 0.0, 1.0])
    antenna = rig + rotation @ ARM_M + rng.normal(size=rig.shape) * 0.02
    found = rough_trajectory(track(t, antenna, 0.02), t, ARM_M)
    assert found is not None
    poses = found.world_from_rig
    inner = slice(10, 90)
    off = np.linalg.norm(poses[inner, :3, 3] - rig[inner], axis=1)
    assert 1e-4 < np.sqrt((off**2).mean()) < 0.15
    assert 0.01 < se3.rotation_angle_deg(np.swapaxes(rotation, 1, 2) @ poses[:, :3, :3])[inner].max() < 6.0
    np.testing.assert_allclose(poses[:, 2, :3], np.tile([0.0, 0.0, 1.0], (100, 1)), atol=1e-12)


@pytest.mark.parametrize("drift", [False, True])
@pytest.mark.parametrize("sigma_m", [0.05, 1.0])
def test_a_standing_car_keeps_the_heading_it_came_with(sigma_m: float, drift: bool) -> None:
    rng = np.random.default_rng(1)
    t = times_us(400)
    along = np.minimum(np.arange(400) * 0.5, 50.0)  # 5 m/s north-east for 10 s, then 30 s at a light
    noise = rng.normal(size=(400, 3)) * sigma_m
    if drift:  # receivers' errors change slowly, which looks like driving
        for k in range(1, 400):
            noise[k] = 0.98 * noise[k - 1] + 0.2 * noise[k]
    antenna = along[:, None] * np.array([0.6, 0.8, 0.0]) + noise
    found = rough_trajectory(track(t, antenna, sigma_m), t, np.zeros(3))
    assert found is not None
    poses = found.world_from_rig
    heading = np.degrees(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))
    expected = np.degrees(np.arctan2(0.8, 0.6))
    assert 0.01 < np.abs((heading - expected + 180) % 360 - 180).max() < (12.0 if sigma_m < 0.1 else 40.0)
    assert np.linalg.norm(poses[-1, :3, 3] - [30.0, 40.0, 0.0]) < max(0.3, 4 * sigma_m)


def test_gross_errors_are_left_out_of_the_rough_trajectory() -> None:
    t = times_us(60)
    rig, _ = bend(t)
    antenna = rig.copy()
    antenna[20] += [100.0, 0.0, 0.0]
    good = np.ones(60, dtype=np.bool_)
    good[20] = False
    found = rough_trajectory(track(t, antenna, good=good), t, np.zeros(3))
    assert found is not None
    poses = found.world_from_rig
    assert np.linalg.norm(poses[:, :3, 3] - rig, axis=1).max() < 0.5


@pytest.mark.parametrize("count", [2, 40])
def test_no_direction_no_rough_trajectory(count: int) -> None:
    noise = np.random.default_rng(2).normal(size=(count, 3)) * 0.02
    assert rough_trajectory(track(times_us(count), noise), times_us(count), np.zeros(3)) is None


def held_of(position_m: np.ndarray, *, sigma_m: float = 0.5, step_s: float = 0.1) -> list[int]:
    t = times_us(len(position_m), step_s)
    return np.flatnonzero(find_held(t, position_m, np.full(position_m.shape, sigma_m))).tolist()


def driven(samples: int = 40, speed_mps: float = 10.0) -> np.ndarray:
    position_m, _ = bend(times_us(samples), speed_mps)
    return position_m


def test_a_position_that_is_repeated_while_the_vehicle_drives_on_is_held() -> None:
    position_m = driven()
    position_m[12:25] = position_m[11]
    assert held_of(position_m) == list(range(12, 25))
    assert held_of(driven()) == []


@pytest.mark.parametrize("speed_mps", [1.0, 3.0, 30.0])
def test_a_log_that_writes_each_position_of_a_slow_receiver_several_times_keeps_the_first(speed_mps: float) -> None:
    position_m = np.repeat(driven(8, speed_mps=10.0 * speed_mps), 10, axis=0)  # of a second each
    assert held_of(position_m, sigma_m=0.8)[:27] == [k for k in range(30) if k % 10]


@pytest.mark.parametrize("sigma_m", [0.05, 0.3])
def test_a_receiver_that_is_held_to_the_end_is_found_as_no_vehicle_stops_at_once(sigma_m: float) -> None:
    position_m = driven(speed_mps=15.0)
    position_m[30:] = position_m[29]
    assert held_of(position_m, sigma_m=sigma_m) == list(range(30, 40))


def test_a_vehicle_that_stands_moves_off_from_where_it_stood() -> None:
    way_m = np.cumsum(np.concatenate([np.linspace(1.0, 0.0, 20), np.zeros(20), np.linspace(0.02, 1.0, 20)]))
    position_m = np.stack([way_m, 0 * way_m, 0 * way_m], axis=1)
    assert held_of(position_m) == []
    assert held_of(position_m[:40]) == []  # and is still there at the end
    # Once a second, it is a metre away when it is seen again.
    way_m = np.array([*(8.0 * np.arange(5)), 38.0, *[40.0] * 20, 41.0, 44.0, 49.0, 56.0])
    assert held_of(np.stack([way_m, 0 * way_m, 0 * way_m], axis=1), sigma_m=0.02, step_s=1.0) == []


def hard_way(t_us: np.ndarray) -> np.ndarray:
    """Positions of a car that brakes from 14 to 6 m/s within 2 s, and turns by 90 degrees on a radius of 12 m."""
    t = np.arange(0.0, (t_us[-1] - t_us[0]) / 1e6 + 0.011, 0.01)
    travelled = np.cumsum(0.01 * np.interp(t, [4.0, 6.0], [14.0, 6.0]))
    heading = np.clip((travelled - travelled[900]) / 12.0, 0.0, np.pi / 2)
    xy = np.cumsum(np.diff(travelled, prepend=0.0)[:, None] * np.stack([np.cos(heading), np.sin(heading)], 1), axis=0)
    place = np.clip(np.round((t_us - t_us[0]) / 1e4).astype(int), 0, len(t) - 1)
    return np.concatenate([xy[place], np.zeros((len(t_us), 1))], axis=1)


@pytest.mark.parametrize("rate_hz", [1, 2, 5, 10])
@pytest.mark.parametrize("seed", range(3))
def test_hard_braking_and_turns_are_no_gross_errors_at_any_rate(rate_hz: int, seed: int) -> None:
    t = times_us(20 * rate_hz, 1.0 / rate_hz)
    rng, sigma = np.random.default_rng(seed), np.full((len(t), 3), 0.3)
    position = hard_way(t) + rng.normal(size=(len(t), 3)) * sigma
    assert not find_gross_errors(t, position, sigma, outlier_sigmas=4.0).any()
    position[len(t) // 2] += [30.0, -40.0, 0.0]
    found = np.flatnonzero(find_gross_errors(t, position, sigma, outlier_sigmas=4.0))
    assert len(t) // 2 in found
    assert len(found) <= 2


def test_between_samples_positions_follow_the_way_and_elsewhere_a_bend_makes_them_uncertain() -> None:
    every = times_us(180)
    way = hard_way(every)
    off_m = np.array([3.0, 4.0, 5.0])
    gnss = track(every[::10], way[::10] + off_m, sigma_m=0.02)
    on_chords, sigma = gnss.at(every, max_gap_us=2_000_000)
    inside = np.isfinite(on_chords[:, 0])
    assert inside.sum() == 171
    cut_m = np.linalg.norm(on_chords[inside] - way[inside] - off_m, axis=1)
    assert cut_m.max() > 0.3
    assert (cut_m <= 0.02 + np.linalg.norm(sigma[inside], axis=1)).all()
    unknown = np.where((np.arange(180) < 7)[:, None], np.nan, way)
    following, sigma = gnss.at(every, max_gap_us=2_000_000, way_m=unknown)
    np.testing.assert_allclose(following[10:171], way[10:171] + off_m, atol=1e-9)
    np.testing.assert_allclose(sigma[10:171], 0.02)
    np.testing.assert_array_equal(following[:10], on_chords[:10])  # the first sample is before all that is known


def test_a_way_with_gaps_as_long_as_those_of_the_receiver_is_not_followed() -> None:
    every = times_us(41)
    way, _ = bend(every)
    gnss = track(every[::10], way[::10])
    seldom = np.where((np.arange(41) % 15 == 0)[:, None], way, np.nan)
    np.testing.assert_array_equal(
        gnss.at(every, max_gap_us=10**7, way_m=seldom)[0], gnss.at(every, max_gap_us=10**7)[0]
    )


@pytest.mark.parametrize("units_hz", [10.0, 2.0, 1.2])
def test_a_way_of_few_units_bends_between_them_as_well(units_hz: float) -> None:
    every, samples = times_us(round(18 * units_hz), 1.0 / units_hz), times_us(17, 1.0) + 370_000
    fine = times_us(1800, 0.01)
    way = hard_way(fine)

    def true_m(t_us: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(t_us, fine, way[:, k]) for k in range(3)], axis=1)

    gnss = track(samples, true_m(samples), sigma_m=0.02)
    following, sigma = gnss.at(every, max_gap_us=2_000_000, way_m=true_m(every))
    inside = np.isfinite(following[:, 0])
    off_m = np.linalg.norm(following - true_m(every), axis=1)[inside]
    assert (off_m <= 0.02 + sigma[inside, 0]).all()
    assert units_hz > 5.0 or off_m.max() > 0.05
    assert units_hz < 5.0 or sigma[inside].max() < 0.04


def test_noise_of_many_samples_is_no_bend() -> None:
    t = times_us(400, 0.01)
    rng = np.random.default_rng(0)
    position = 14.0 * (t - t[0])[:, None] / 1e6 * [1.0, 0.0, 0.0] + rng.normal(size=(400, 3)) * 0.3
    good = (np.arange(400) < 150) | (np.arange(400) >= 250)
    _, sigma = track(t, position, sigma_m=0.3, good=good).at(t, max_gap_us=2_000_000)
    assert sigma[150:250].min() >= 0.3
    assert sigma[150:250].max() < 1.35  # a vehicle that brakes as hard as it can is 1.25 m off within such a gap
