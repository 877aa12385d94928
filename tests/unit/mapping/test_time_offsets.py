from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mrasfm_engine.bundle_adjustment.solver import SolverOptions
from mrasfm_engine.config import BundleAdjustmentConfig, EngineConfig
from mrasfm_engine.geometry.alignment import align_similarity
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.pose_adjustment import adjust_poses
from mrasfm_engine.mapping.refinement import refine
from mrasfm_engine.mapping.refinement_result import Refinement
from mrasfm_engine.mapping.time_offsets import assess_times, offsets_are_steady, time_prior, times_may_vary
from tests.benchmarks.sigmas import camera_errors
from tests.helpers.simulated_drive import (
    SimulatedDrive,
    make_model,
    make_simulated_drive,
    metric_errors_m,
    rmse,
    with_cameras,
    with_true_poses,
)
from tests.helpers.slow import slow
from tests.unit.mapping.test_placement import ARM_M, received

UNITS = 30
APART_MS = [0, 30, -20, 40]
LATE_MS = [4, -6, 3, -1]
# From 4 to 18 m/s and back: at one speed a camera that is late looks like one that is mounted elsewhere.
TRAVELLED_M = 1.1 * np.arange(UNITS) - 2.5 * np.sin(2 * np.pi * np.arange(UNITS) / UNITS)


def model(
    late_ms: list[int],
    config: EngineConfig | None = None,
    *,
    apart: bool = True,
    taken_ms: list[int] | None = None,
    cameras: int = 4,
    **camera: Any,
) -> tuple[Mapper, SimulatedDrive]:
    """A drive at its true poses, whose cameras take images so much later than their timestamps."""
    simulated = make_simulated_drive(
        units=UNITS,
        cameras=cameras,
        points=2500,
        travelled_m=TRAVELLED_M,
        time_offset_ms=taken_ms or (APART_MS if apart else late_ms),
        late_ms=late_ms,
    )
    rig = simulated.drive.manifest.rig
    given = [c.model_copy(update={"readout_us": 0, "sigma_time_offset_us": 5000.0, **camera}) for c in rig.cameras]
    simulated = with_cameras(simulated, given)
    return with_true_poses(make_model(simulated, config=config), simulated, range(UNITS)), simulated


def refined(mapper: Mapper, simulated: SimulatedDrive, sigma_m: float | None = None) -> Refinement:
    gnss = None if sigma_m is None else received(simulated, sigma_m)
    return refine(mapper, AbsolutePriors(gnss=gnss, antenna_in_rig_m=ARM_M))


@pytest.fixture(scope="module")
def late() -> tuple[Mapper, SimulatedDrive, Refinement]:
    """The drive of cameras that are late, refined; tests only read it."""
    mapper, simulated = model(LATE_MS)
    return mapper, simulated, refined(mapper, simulated)


@pytest.mark.parametrize("apart", [False, *slow(True)])
def test_time_offsets_are_found_to_what_is_stated_of_them(apart: bool, request: pytest.FixtureRequest) -> None:
    if apart:
        mapper, _, result = request.getfixturevalue("late")
    else:
        mapper, simulated = model(LATE_MS, apart=False)
        result = refined(mapper, simulated)
    assert result.times is not None
    assert result.times.observed.all()
    weights = time_prior(mapper, mean_varies=False).gauge_weights
    assert weights is not None
    off_s = mapper.state.camera_time_offset_s - 1e-3 * (np.array(LATE_MS) - np.average(LATE_MS, weights=weights))
    assert np.abs(off_s).max() < (0.001 if apart else 0.0003)
    assert (np.abs(off_s) < 3 * result.times.sigma_s).all()
    assert result.late_cameras == []


@pytest.mark.slow
def test_a_camera_that_is_late_no_longer_bends_the_trajectory(late: tuple[Mapper, SimulatedDrive, Refinement]) -> None:
    config = EngineConfig(threads=1, bundle_adjustment=BundleAdjustmentConfig(refine_time_offsets=False))
    mapper, simulated = model(LATE_MS, config)
    assert refined(mapper, simulated).times is None
    assert late[2].times is not None
    assert rmse(metric_errors_m(*late[:2])) < 0.5 * rmse(metric_errors_m(mapper, simulated))
    assert not mapper.state.camera_time_offset_s.any()


@pytest.mark.slow
def test_the_mean_is_that_of_most_cameras_unless_positions_tell_it() -> None:
    for sigma_m, expected_ms in ((None, [0, 0, 0, 4]), (0.04, [0, 0, 0, 4]), (0.005, [4, 4, 4, 8])):
        mapper, simulated = model([4, 4, 4, 8])
        result = refined(mapper, simulated, sigma_m)
        assert result.times is not None
        assert result.mean_time_varies == (sigma_m == 0.005)
        off_s = mapper.state.camera_time_offset_s - 1e-3 * np.array(expected_ms)
        assert np.abs(off_s).max() < 0.0025
        assert (np.abs(off_s) < 3 * result.times.sigma_s).all()


def of_readouts(readout_ms: int, *, declared: bool) -> tuple[np.ndarray, np.ndarray, Refinement]:
    """Errors (4, 6) of the cameras' poses over their sigmas, those of offsets over theirs, and the refinement."""
    simulated = make_simulated_drive(
        units=20, cameras=4, points=1500, time_offset_ms=APART_MS, late_ms=LATE_MS, readout_ms=readout_ms
    )
    readout_us = 1000 * readout_ms if declared else None
    cameras = [
        c.model_copy(update={"readout_us": readout_us, "sigma_time_offset_us": 5000.0}) for c in simulated.drive.cameras
    ]
    simulated = with_cameras(simulated, cameras)
    mapper = with_true_poses(make_model(simulated, config=EngineConfig(threads=1)), simulated, range(20))
    result = refine(mapper)
    assert result.certainty is not None
    assert result.times is not None
    weights = time_prior(mapper, mean_varies=False).gauge_weights
    assert weights is not None
    off_s = mapper.state.camera_time_offset_s - 1e-3 * (np.array(LATE_MS) - np.average(LATE_MS, weights=weights))
    of_cameras = camera_errors(mapper, simulated) / result.certainty.sigma_camera[:, :6]
    return of_cameras, off_s / result.times.sigma_s, result


def test_a_shutter_of_which_nothing_is_declared_counts_as_it_shows() -> None:
    """Images of a global shutter show that no row is late, and those of a rolling one that rows are."""
    known, unknown, rolling = (of_readouts(ms, declared=of) for ms, of in ((0, True), (0, False), (20, False)))
    sigmas = []
    for of_cameras, of_times, result in (known, unknown, rolling):
        assert 0.3 < rmse(of_cameras.ravel()) < 1.6
        assert 0.2 < rmse(of_times) < 2.5
        assert result.certainty is not None
        sigmas.append(result.certainty.sigma_camera[:, :3])
    assert (sigmas[1] < 1.5 * sigmas[0]).all()
    assert (sigmas[2] > 1.5 * sigmas[0]).any()


def test_leaving_the_prior_is_a_finding() -> None:
    mapper, simulated = model([0, 0, 15, 0], sigma_time_offset_us=2000.0)
    (said,) = refined(mapper, simulated).late_cameras
    assert said.code == "time-offset-beyond-prior"
    assert simulated.drive.cameras[2].name in said.what
    assert "sigma_time_offset_us" in said.remedy


def test_a_camera_that_is_late_by_more_than_an_interval_is_found_and_said_to_be() -> None:
    """Its images stand beyond the units before and after, far from where its prior has them."""
    mapper, simulated = model([0, 0, -60, 0], taken_ms=[0, 30, -130, 40], sigma_time_offset_us=2000.0)
    result = refined(mapper, simulated, 0.02)
    assert [said.code for said in result.late_cameras] == ["time-offset-beyond-prior"]
    assert mapper.state.camera_time_offset_s[2] == pytest.approx(-0.06, abs=0.003)
    assert rmse(metric_errors_m(mapper, simulated)) < 0.03

    assert result.certainty is not None
    of_prior = np.diag(np.full(4, 0.0019) ** 2)
    nothing_known = replace(result.certainty, times_s2=of_prior, times_of_independent_errors_s2=of_prior)
    prior = time_prior(mapper, mean_varies=True)
    found = assess_times(prior, nothing_known, np.zeros(4), np.array([0.0, 0.001, -0.1, 0.0]))
    assert found is not None
    assert found.observed.tolist() == [False, False, True, False]
    assert found.to_hold.tolist() == [True, True, False, True]


def test_offsets_are_steady_until_one_moves_among_the_others_by_more_than_its_prior_allows() -> None:
    mapper, _ = model([0] * 4, sigma_time_offset_us=2000.0)
    for moved_ms, steady in (
        ([0, 0, 0, 0], True),
        ([50, 50, 50, 50], True),
        ([0, 7, 0, 0], True),
        ([0, 9, 0, 0], False),
    ):
        mapper.state.camera_time_offset_s[:] = 1e-3 * np.array(moved_ms)
        assert offsets_are_steady(mapper, np.zeros(4)) == steady


def test_a_late_camera_does_not_make_the_receiver_contradict_the_rig() -> None:
    """As long as its times are as given, the pair makes the scene larger or smaller than its baseline is."""
    mapper, simulated = model([0, 20], taken_ms=[0, 20], cameras=2)
    adjust_poses(mapper, np.arange(UNITS) > 0, options=SolverOptions())  # as a scene grows, its cameras held
    grown = align_similarity(mapper.state.unit_position_m, simulated.world_from_rig[:, :3, 3]).scale
    assert 0.05 < abs(grown - 1.0) < 0.3
    result = refined(mapper, simulated, 0.02)
    assert result.georeferenced
    assert result.placement is not None
    assert 0.0 < abs(result.placement.scale_of_rig - 1.0) < 0.03
    assert "scale-disagreement" not in {finding.code for finding in result.placement.findings}


def test_cameras_that_are_simultaneous_have_no_offset_unless_the_manifest_says_so() -> None:
    exact, _ = model([0] * 4, apart=False, sigma_time_offset_us=None)
    assert exact.state.simultaneous
    assert not times_may_vary(exact)
    declared, _ = model([0] * 4, apart=False)
    assert times_may_vary(declared)
    np.testing.assert_allclose(time_prior(declared, mean_varies=False).sigma_s, 0.005)
