from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from mrasfm_engine.config import EngineConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.gnss_track import GnssTrack
from mrasfm_engine.mapping.incremental_mapping import run_incremental_mapping
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.placement import Placement, ReceiverErrors, receiver_errors
from mrasfm_engine.mapping.refinement import Refinement, refine
from tests.helpers.simulated_drive import SimulatedDrive, make_model, make_simulated_drive, true_matches

ARM_M = np.array([-0.5, 0.2, 1.6])
UNITS = 30


def received(simulated: SimulatedDrive, sigma_m: float, off_m: np.ndarray | float = 0.0) -> GnssTrack:
    """The antenna's true positions with white noise as declared, and what else they are off by."""
    rng = np.random.default_rng(5)
    antenna = simulated.world_from_rig[:, :3, 3] + simulated.world_from_rig[:, :3, :3] @ ARM_M
    return GnssTrack(
        timestamps_us=simulated.drive.timestamps_us,
        position_m=antenna + rng.normal(size=antenna.shape) * sigma_m + off_m,
        sigma_m=np.full(antenna.shape, sigma_m),
        good=np.ones(len(antenna), dtype=np.bool_),
    )


@dataclass
class Refined:
    """A drive of two cameras, one given with another rotation than it has, mapped and refined with a receiver."""

    mapper: Mapper
    result: Refinement
    simulated: SimulatedDrive

    @property
    def errors_m(self) -> np.ndarray:
        return np.linalg.norm(self.mapper.state.unit_position_m - self.simulated.world_from_rig[:, :3, 3], axis=1)


def refined(sigma_m: float, *, turned_deg: float = 0.4, off_m: np.ndarray | float = 0.0) -> Refined:
    def given(rig_from_cam: np.ndarray) -> np.ndarray:
        rig_from_cam[1, :3, :3] = se3.exp_so3([0, 0, np.radians(turned_deg)]) @ rig_from_cam[1, :3, :3]
        return rig_from_cam

    simulated = make_simulated_drive(units=UNITS, cameras=2, points=2000, given=given)
    pairs = true_matches(simulated)
    mapper = make_model(simulated, pairs, EngineConfig(threads=1))
    run_incremental_mapping(mapper, pairs, None)
    gnss = received(simulated, sigma_m, off_m)
    result = refine(mapper, gnss=gnss, antenna_in_rig_m=ARM_M, rough_world_from_rig=None)
    return Refined(mapper, result, simulated)


@pytest.mark.parametrize("sigma_m", [0.02, 0.3])
def test_the_better_the_receiver_the_better_the_scene_however_the_calibration_is_off(sigma_m: float) -> None:
    found = refined(sigma_m)
    assert found.result.georeferenced
    assert found.result.placement is not None
    assert found.result.placement.inlier.sum() >= UNITS - 1
    assert found.result.placement.noise_factor < 1.4
    assert 1e-4 < np.sqrt((found.errors_m**2).mean()) < 0.6 * sigma_m


def test_a_jump_stays_an_outlier_where_the_scene_is_bent_as_well() -> None:
    jump_m = np.zeros((UNITS, 3))
    jump_m[12:18, 0] = 2.0
    found = refined(0.02, off_m=jump_m)
    assert found.result.placement is not None
    np.testing.assert_array_equal(found.result.placement.inlier, jump_m[:, 0] == 0)
    assert np.sqrt((found.errors_m**2).mean()) < 0.03


def errors(off_m: np.ndarray, *, interval_us: float = 100_000.0) -> ReceiverErrors:
    units = len(off_m)
    simulated = make_simulated_drive(units=units, cameras=2, points=10)
    mapper = make_model(simulated, [])
    placement = Placement(
        units=np.arange(units),
        measured_m=np.zeros((units, 3)),
        sigma_m=np.ones((units, 3)),
        inlier=np.ones(units, dtype=np.bool_),
        off_m=off_m,
        interval_us=interval_us,
    )
    return receiver_errors(mapper, placement)


def test_white_noise_counts_sample_by_sample() -> None:
    noise = np.random.default_rng(0).normal(size=(200, 3))
    assert errors(noise) == ReceiverErrors(factor=1.0, common=0.0)
    # A bend of the scene, however large, is no noise and hides none.
    assert errors(noise + 20 * np.linspace(0, 1, 200)[:, None] ** 2) == ReceiverErrors(factor=1.0, common=0.0)


@pytest.mark.parametrize("units", [300, 3000])
def test_what_wanders_says_as_much_of_a_slope_as_a_wandering_receiver_does(units: int) -> None:
    rng, keep = np.random.default_rng(0), np.exp(-0.1 / 60.0)
    tracks = np.empty((units, 400))
    tracks[0] = rng.normal(size=400)
    for i in range(1, units):
        tracks[i] = keep * tracks[i - 1] + np.sqrt(1 - keep**2) * rng.normal(size=400)
    slope = np.arange(units) - (units - 1) / 2
    slopes = slope @ tracks / np.sqrt(slope @ slope)  # of independent samples: as much as one of them
    found = errors(tracks[:, :3])
    assert found.factor == pytest.approx(slopes.std(), rel=0.15)
    assert found.common == pytest.approx(tracks.mean(0).std(), rel=0.15)


def test_what_scatters_in_part_wanders_in_part() -> None:
    noise = np.random.default_rng(0).normal(size=(200, 3))
    wanders = errors(np.zeros((200, 3))).factor
    assert errors(np.sqrt(0.5) * noise).factor == pytest.approx(np.sqrt(0.5 + 0.5 * wanders**2), rel=0.15)


def test_positions_between_samples_count_once_a_sample() -> None:
    seconds, at = np.arange(22), np.arange(200) / 10
    samples = np.random.default_rng(0).normal(size=(22, 3))
    off_m = np.stack([np.interp(at, seconds, samples[:, k]) for k in range(3)], axis=1)
    once_a_second = errors(off_m, interval_us=1e6)
    assert once_a_second.factor == pytest.approx(np.sqrt(10), rel=0.3)
    assert once_a_second.common < errors(off_m, interval_us=1e5).common
