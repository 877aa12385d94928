"""Jumps of a trajectory, as where repeated facades put units one period apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.mapping.impossible_motion import find_jumps, motion_jump_findings
from mrasfm_engine.types import Floats
from tests.unit.mapping.test_road_filter import drive_over_shadows, mapped

PERIOD_M = 12.0


def trajectory(rate_hz: float, *, units: int = 40, noise_m: float = 0.01, seed: int = 0) -> tuple[Floats, Floats]:
    """A vehicle that turns, brakes to a stop by 6 m/s^2 and drives on; times (n,) and positions (n, 3)."""
    time_s = np.arange(units) / rate_hz
    middle_s = time_s[units // 2]
    speed_mps = np.minimum(12.0, 6.0 * np.maximum(np.abs(time_s - middle_s) - 0.5, 0.0))
    way_m = np.concatenate([[0.0], np.cumsum(0.5 * (speed_mps[1:] + speed_mps[:-1]) / rate_hz)])
    heading_rad = way_m / 15.0
    steps_m = np.diff(way_m)[:, None] * np.stack([np.cos(heading_rad), np.sin(heading_rad), 0 * way_m], 1)[1:]
    position_m = np.concatenate([np.zeros((1, 3)), np.cumsum(steps_m, axis=0)])
    return time_s, position_m + np.random.default_rng(seed).normal(0.0, noise_m, position_m.shape)


@pytest.mark.parametrize("rate_hz", [2.0, 5.0, 10.0, 30.0])
@pytest.mark.parametrize("noise_m", [0.0, 0.01, 0.1])
def test_no_vehicle_jumps(rate_hz: float, noise_m: float) -> None:
    for seed in range(5):
        assert not len(find_jumps(*trajectory(rate_hz, noise_m=noise_m, seed=seed)).unit)


@pytest.mark.parametrize("rate_hz", [5.0, 10.0, 30.0])
def test_units_a_period_too_far_back(rate_hz: float) -> None:
    time_s, position_m = trajectory(rate_hz)
    position_m[12:] -= [PERIOD_M, 0.0, 0.0]
    position_m[30:] -= [0.0, PERIOD_M, 0.0]
    found = find_jumps(time_s, position_m)
    assert found.unit.tolist() == [12, 30]
    np.testing.assert_allclose(found.distance_m, PERIOD_M, atol=3.0)


def test_a_gap_in_time_tells_nothing() -> None:
    time_s, position_m = trajectory(10.0)
    time_s[20:] += 60.0
    position_m[20:] += [300.0, 0.0, 0.0]
    assert not len(find_jumps(time_s, position_m).unit)


@pytest.mark.parametrize("units", [0, 1, 2, 4])
def test_few_units_tell_nothing(units: int) -> None:
    assert not len(find_jumps(np.arange(units, dtype=np.float64), 100.0 * np.eye(max(units, 3))[:units, :3]).unit)


def test_a_scene_that_jumps_is_an_error_that_names_the_frames() -> None:
    mapper = mapped(drive_over_shadows(share=0.0)[0])
    assert motion_jump_findings(mapper) == []
    units = np.flatnonzero(mapper.registered)
    mapper.state.unit_position_m[units[len(units) // 2 :]] -= [PERIOD_M, 0.0, 0.0]
    frames = [f.model_copy(update={"source_frame": 100 + f.source_frame}) for f in mapper.drive.manifest.frames]
    mapper.drive = replace(mapper.drive, manifest=mapper.drive.manifest.model_copy(update={"frames": frames}))
    (said,) = motion_jump_findings(mapper)
    assert (said.code, said.severity) == ("impossible-motion", "error")
    assert f"between frames {100 + units[len(units) // 2 - 1]} and {100 + units[len(units) // 2]}" in said.what
