"""Jumps of a receiver's error, of which the position stays where it has come to."""

from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.mapping.receiver_jumps import MAX_JUMPS, find_jumps, segment_of

SAMPLES, INTERVAL_S, WANDER_TIME_S = 60, 0.1, 60.0


def off_m(*, scatter_m: float, seed: int = 0) -> np.ndarray:
    return scatter_m * np.random.default_rng(seed).normal(size=(SAMPLES, 3))


def jumps_of(off: np.ndarray, *, sigma_m: float = 0.8, interval_s: float = INTERVAL_S) -> list[int]:
    time_s = interval_s * np.arange(len(off))
    return find_jumps(off, np.full(off.shape, sigma_m), time_s, wander_time_s=WANDER_TIME_S).tolist()


@pytest.mark.parametrize("at", [5, 24, 55])
@pytest.mark.parametrize("size_m", [1.5, 4.0, 20.0])
def test_a_step_is_found_where_it_is(at: int, size_m: float) -> None:
    off = off_m(scatter_m=0.04)
    off[at:] += [0.8 * size_m, -0.6 * size_m, 0.0]
    assert jumps_of(off) == [at]


def test_a_scene_of_another_scale_or_direction_shows_no_jump() -> None:
    """Its residuals follow a straight line, with a step or without."""
    off = off_m(scatter_m=0.04) + np.arange(SAMPLES)[:, None] * [0.12, -0.05, 0.01]
    assert jumps_of(off) == []
    off[30:] += [2.0, 0.0, 0.0]
    assert jumps_of(off) == [30]


def test_a_bend_shows_no_jump() -> None:
    bent_m = 3.0 * (np.arange(SAMPLES) / SAMPLES) ** 2
    assert jumps_of(off_m(scatter_m=0.04) + bent_m[:, None]) == []


@pytest.mark.parametrize("seed", range(20))
def test_an_error_that_scatters_or_wanders_as_modelled_does_not_jump(seed: int) -> None:
    rng = np.random.default_rng(seed)
    alike = np.exp(-INTERVAL_S / WANDER_TIME_S)
    wander = [rng.normal(size=3)]
    for _ in range(SAMPLES - 1):
        wander.append(alike * wander[-1] + np.sqrt(1.0 - alike**2) * rng.normal(size=3))
    assert jumps_of(0.8 * np.array(wander) + off_m(scatter_m=0.04, seed=seed)) == []
    assert jumps_of(off_m(scatter_m=0.8, seed=seed)) == []


def test_a_single_sample_that_sticks_out_is_no_jump() -> None:
    off = off_m(scatter_m=0.04)
    off[30] += [25.0, 3.0, 0.0]
    assert jumps_of(off) == []


def test_a_receiver_of_one_sample_a_second_may_change_by_more() -> None:
    off = off_m(scatter_m=0.04)
    off[30:, 0] += 1.2
    assert jumps_of(off) == [30]
    assert jumps_of(off, interval_s=1.0) == []


def test_several_are_found_in_their_order_and_their_number_is_bounded() -> None:
    off = off_m(scatter_m=0.02)
    off[15:, 0] += 3.0
    off[40:, 1] -= 6.0
    assert jumps_of(off) == [15, 40]
    many = 0.02 * np.random.default_rng(1).normal(size=(600, 3)) + 5.0 * (np.arange(600) // 12 % 2)[:, None]
    assert len(jumps_of(many)) == MAX_JUMPS


def test_samples_that_are_missing_before_a_jump_make_no_other_slope() -> None:
    off = off_m(scatter_m=0.04) + np.arange(SAMPLES)[:, None] * [0.3, 0.0, 0.0]
    off[30:] += [0.0, 4.0, 0.0]
    kept = np.r_[0:24, 30:SAMPLES]
    time_s = INTERVAL_S * np.arange(SAMPLES)
    found = find_jumps(off[kept], np.full((len(kept), 3), 0.8), time_s[kept], wander_time_s=WANDER_TIME_S)
    assert found.tolist() == [24]
    off[30:] -= [0.0, 4.0, 0.0]
    assert len(find_jumps(off[kept], np.full((len(kept), 3), 0.8), time_s[kept], wander_time_s=WANDER_TIME_S)) == 0


@pytest.mark.parametrize("seed", range(5))
def test_a_receiver_that_loses_its_corrections_scatters_more_and_does_not_jump(seed: int) -> None:
    sigma_m = np.where(np.arange(400) < 250, 0.02, 2.0)[:, None] * np.ones(3)
    off = sigma_m * np.random.default_rng(seed).normal(size=(400, 3))
    time_s = INTERVAL_S * np.arange(400)
    assert len(find_jumps(off, sigma_m, time_s, wander_time_s=WANDER_TIME_S)) == 0


@pytest.mark.parametrize("samples", [0, 1, 9])
def test_few_samples_tell_none(samples: int) -> None:
    assert jumps_of(off_m(scatter_m=0.04)[:samples]) == []


def test_samples_that_are_exact_do_no_harm() -> None:
    off = np.zeros((SAMPLES, 3))
    assert jumps_of(off) == []
    off[20:] += 2.0
    assert jumps_of(off) == [20]


def test_segments_are_counted_from_the_units_at_which_they_begin() -> None:
    assert segment_of(np.array([0, 4, 5, 6, 11, 12]), np.array([5, 12])).tolist() == [0, 0, 1, 1, 1, 2]
    assert segment_of(np.array([3, 9]), np.zeros(0, dtype=np.int64)).tolist() == [0, 0]
