from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest

from mrasfm_engine.config import EngineConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.gnss_track import GnssTrack
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.calibration import scale_scene
from mrasfm_engine.mapping.incremental_mapping import run_incremental_mapping
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.placement import place_by_gnss
from mrasfm_engine.mapping.receiver_findings import refusal_findings
from mrasfm_engine.mapping.receiver_fit import Placement, ReceiverErrors, most_likely_errors, receiver_errors
from mrasfm_engine.mapping.refinement import refine
from mrasfm_engine.mapping.refinement_result import Refinement
from mrasfm_engine.mapping.scene_builder import build_scene
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory
from tests.helpers.simulated_drive import (
    SimulatedDrive,
    make_model,
    make_simulated_drive,
    true_matches,
    with_true_poses,
)
from tests.helpers.slow import slow

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


def turned(rig_from_cam: np.ndarray, by_deg: float = 0.4) -> np.ndarray:
    rig_from_cam[1, :3, :3] = se3.exp_so3([0, 0, np.radians(by_deg)]) @ rig_from_cam[1, :3, :3]
    return rig_from_cam


def refined(
    sigma_m: float, *, turned_deg: float = 0.4, off_m: np.ndarray | float = 0.0, while_mapping: bool = True
) -> Refined:
    given = partial(turned, by_deg=turned_deg)
    simulated = make_simulated_drive(units=UNITS, cameras=2, points=2000, given=given)
    pairs = true_matches(simulated)
    mapper = make_model(simulated, pairs, EngineConfig(threads=1))
    gnss = received(simulated, sigma_m, off_m)
    known = {"gnss": gnss, "antenna_in_rig_m": ARM_M}
    run_incremental_mapping(mapper, pairs, None, absolute=AbsolutePriors(**known) if while_mapping else None)
    result = refine(mapper, AbsolutePriors(**known))
    return Refined(mapper, result, simulated)


def test_heights_that_nobody_knows_leave_all_else_known() -> None:
    """A receiver without heights, all of which are zero with a sigma of ten kilometres."""
    simulated = make_simulated_drive(units=UNITS, cameras=2, points=2000)
    mapper = with_true_poses(make_model(simulated), simulated, range(UNITS))
    mapper.complete()
    track = received(simulated, 0.1)
    level = track.position_m * [1.0, 1.0, 0.0] + [0.0, 0.0, 1500.0]
    sigma_m = np.tile([0.1, 0.1, 1e4], (UNITS, 1))
    gnss = replace(track, position_m=level, sigma_m=sigma_m)
    result = refine(mapper, AbsolutePriors(gnss=gnss, antenna_in_rig_m=ARM_M))
    assert result.georeferenced
    assert result.certainty is not None
    assert 0.0 < result.certainty.sigma_scale < 0.02
    sigma_m = result.certainty.sigma_unit_position_m
    assert 0.01 < sigma_m[:, :2].min() < sigma_m[:, :2].max() < 1.0
    assert 3e3 < sigma_m[:, 2].min() < sigma_m[:, 2].max() < 3e4


@pytest.mark.parametrize("while_mapping", [True, False])
@pytest.mark.parametrize("sigma_m", [0.02, *slow(0.3)])
def test_the_better_the_receiver_the_better_the_scene_however_the_calibration_is_off(
    sigma_m: float, while_mapping: bool
) -> None:
    found = refined(sigma_m, while_mapping=while_mapping)
    assert found.result.georeferenced
    assert found.result.placement is not None
    assert found.result.placement.inlier.sum() >= UNITS - 1
    assert found.result.placement.noise_factor < 1.4
    assert found.result.placement.clock is None  # a scene that bends is no clock that is wrong
    assert 1e-4 < np.sqrt((found.errors_m**2).mean()) < 0.6 * sigma_m


def test_a_jump_is_one_where_the_scene_is_bent_as_well() -> None:
    jump_m = np.zeros((UNITS, 3))
    jump_m[12:18, 0] = 2.0
    found = refined(0.02, off_m=jump_m)
    assert found.result.placement is not None
    assert found.result.placement.jumps.tolist() == [12, 18]
    np.testing.assert_allclose(found.result.placement.level_m, [[0, 0, 0], [-2, 0, 0], [0, 0, 0]], atol=0.05)
    assert np.sqrt((found.errors_m**2).mean()) < 0.03


def test_a_receiver_whose_samples_are_all_left_out_is_refused_with_their_number() -> None:
    """As one that declares a tenth of its noise: the scene does have positions at its times."""
    simulated = make_simulated_drive(units=12, cameras=2, points=300)
    mapper = with_true_poses(make_model(simulated), simulated, range(12))
    gnss = received(simulated, 0.3)
    good = np.arange(12) < 2
    refused = place_by_gnss(mapper, replace(gnss, good=good), ARM_M)
    assert refused.prior is None
    assert refused.reason.startswith("only 2 registered units have a position at their time, 3 are needed; 10 of 12 ")
    held = place_by_gnss(mapper, replace(gnss, good=good, held=~good), ARM_M)
    assert held.reason.endswith("3 are needed")


def errors(
    off_m: np.ndarray, *, interval_us: float = 100_000.0, likely: bool = False, noise_factor: float = 1.0
) -> ReceiverErrors:
    """Sizes of errors from residuals (units, 3) in the declared sigmas of a metre."""
    units = len(off_m)
    simulated = make_simulated_drive(units=units, cameras=2, points=10)
    mapper = make_model(simulated, [])
    mapper.state.unit_position_m[:, 0] = np.arange(units)
    placement = Placement(
        known_m=np.zeros((units, 3)),
        known_sigma_m=np.ones((units, 3)),
        units=np.arange(units),
        inlier=np.ones(units, dtype=np.bool_),
        off_m=off_m,
        interval_us=interval_us,
        noise_factor=noise_factor,
    )
    return most_likely_errors(mapper, placement) if likely else receiver_errors(mapper, placement)


def wandering(units: int, rng: np.random.Generator) -> np.ndarray:
    """Errors (units, 3) of a metre that wander in 60 s; units are 0.1 s apart."""
    keep = np.exp(-0.1 / 60.0)
    result = np.empty((units, 3))
    result[0] = rng.normal(size=3)
    for i in range(1, units):
        result[i] = keep * result[i - 1] + np.sqrt(1 - keep**2) * rng.normal(size=3)
    return result


def test_white_noise_counts_sample_by_sample() -> None:
    noise = np.random.default_rng(0).normal(size=(200, 3))
    # A bend of the scene, however large, is no noise and hides none.
    bent = noise + 20 * np.linspace(0, 1, 200)[:, None] ** 2
    for found in (errors(noise), errors(bent)):
        assert (found.white, found.wander, found.positions_a_sample) == (1.0, 0.0, 1)
        assert found.unseen < 0.45  # two standard deviations of how these scatter


def test_few_positions_that_scatter_by_less_may_share_an_error() -> None:
    """Twenty samples do not say that anything wanders, and scatter by two thirds of what the receiver declares."""
    found = [errors(0.64 * np.random.default_rng(seed).normal(size=(20, 3))) for seed in range(9)]
    few = [one for one in found if one.wander == 0.0]
    assert len(few) > 6
    assert all(one.white == 1.0 for one in few)  # they weigh no less in the adjustment
    assert np.median([one.unseen for one in few]) == pytest.approx(np.sqrt(1.0 - 0.64**2), rel=0.2)


def test_the_scenes_stated_place_holds_an_error_that_all_positions_share() -> None:
    simulated = make_simulated_drive(units=20, cameras=2, points=400)
    mapper = with_true_poses(make_model(simulated, true_matches(simulated)), simulated, range(20))
    shared_m = np.array([0.38, -0.3, 0.4])
    gnss = replace(received(simulated, 0.32, shared_m), sigma_m=np.full((20, 3), 0.5))
    result = refine(mapper, AbsolutePriors(gnss=gnss, antenna_in_rig_m=ARM_M))
    assert result.placement is not None
    assert result.placement.errors.wander == 0.0
    known = PriorTrajectory(source="none", world_from_rig=None, gnss=gnss, antenna_in_rig_m=ARM_M)
    scene = build_scene(mapper, result, simulated.features, true_matches(simulated), known)
    off_m = scene.world_from_rig[:, :3, 3] - simulated.world_from_rig[:, :3, 3]
    assert np.abs(off_m.mean(0)).min() > 0.2
    in_sigmas = off_m / scene.sigma_position_m
    assert 0.4 < np.sqrt((in_sigmas**2).mean()) < 1.6


def test_what_scatters_in_part_wanders_in_part() -> None:
    noise = np.random.default_rng(0).normal(size=(200, 3))
    found = errors(np.sqrt(0.5) * noise)
    assert found.white**2 == pytest.approx(0.5, rel=0.15)
    assert found.wander**2 == pytest.approx(0.5, rel=0.15)
    assert errors(np.zeros((200, 3))).wander == pytest.approx(1.0)


def test_positions_between_samples_count_once_a_sample() -> None:
    seconds, at = np.arange(22), np.arange(200) / 10
    samples = np.random.default_rng(0).normal(size=(22, 3))
    off_m = np.stack([np.interp(at, seconds, samples[:, k]) for k in range(3)], axis=1)
    assert errors(off_m, interval_us=1e6).positions_a_sample == 10
    assert errors(off_m, interval_us=1e6).white > 2 * errors(off_m, interval_us=1e5).white


@pytest.mark.parametrize(("white", "wander"), [(0.05, 0.3), (0.1, 0.9), (0.4, 1.0), (1.0, 0.1)])
def test_sizes_of_both_errors_are_found_wherever_the_scene_lies(white: float, wander: float) -> None:
    found = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        off_m = white * rng.normal(size=(150, 3)) + wander * wandering(150, rng)
        # Where the scene lies and how large it is has nothing to do with the receiver's errors.
        off_m += [3.0, -1.0, 2.0] + 0.05 * np.arange(150)[:, None] * np.array([1.0, 0.0, 0.0])
        found.append(errors(off_m, likely=True))
    assert np.median([f.white for f in found]) == pytest.approx(white, rel=0.25)
    if wander >= 0.3:
        assert np.median([f.wander for f in found]) == pytest.approx(wander, rel=0.35)
    else:  # positions that scatter by what is declared do not wander as well
        assert np.median([f.wander for f in found]) < 0.5


def test_what_wanders_is_at_most_what_residuals_exceed_their_sigmas_by() -> None:
    """A scene that errs by itself looks like a receiver that wanders."""
    rng = np.random.default_rng(0)
    off_m = 0.3 * rng.normal(size=(100, 3)) + 2.0 * np.linspace(-1, 1, 100)[:, None] ** 2 * [0.0, 1.0, 0.0]
    assert errors(off_m, likely=True).wander == pytest.approx(1.0)
    assert 1.5 < errors(off_m, likely=True, noise_factor=4.0).wander <= 4.0


@pytest.mark.parametrize("sigma_m", [0.5, *slow(0.02)])
def test_positions_take_part_while_the_scene_grows(sigma_m: float) -> None:
    """A calibration that is off bends a scene that grows without them, and hardly one that grows with them."""
    simulated = make_simulated_drive(units=UNITS, cameras=2, points=2000, given=turned)
    pairs = true_matches(simulated)
    known = AbsolutePriors(gnss=received(simulated, sigma_m), antenna_in_rig_m=ARM_M)
    mapper = make_model(simulated, pairs, EngineConfig(threads=1))
    log = run_incremental_mapping(mapper, pairs, None, absolute=known)
    assert log.absolute.positions is not None
    assert len(log.absolute.positions.unit) > UNITS / 2
    # The antenna's, before any refinement: the camera that is given turned turns the rig's frame about it.
    antenna_m = mapper.state.unit_position_m + mapper.state.unit_rotation @ ARM_M
    errors_m = np.linalg.norm(antenna_m - received(simulated, 0.0).position_m, axis=1)
    assert 1e-4 < np.sqrt((errors_m**2).mean()) < sigma_m


@pytest.mark.parametrize("factor", [0.02, 50.0])
def test_a_scale_that_images_do_not_tell_is_the_receivers(factor: float) -> None:
    simulated = make_simulated_drive(units=UNITS, cameras=2, points=600)
    mapper = with_true_poses(make_model(simulated), simulated, range(UNITS))
    scale_scene(mapper, factor)
    gnss, before = received(simulated, 0.02), mapper.state.unit_position_m.copy()
    assert place_by_gnss(mapper, gnss, ARM_M, sigma_scale=0.03).prior is None  # images know it: one of both is wrong
    np.testing.assert_array_equal(mapper.state.unit_position_m, before)
    assert place_by_gnss(mapper, gnss, ARM_M, sigma_scale=0.2).prior is not None
    off_m = np.linalg.norm(mapper.state.unit_position_m - simulated.world_from_rig[:, :3, 3], axis=1)
    assert 0.0 < np.median(off_m) < 0.05


@pytest.mark.parametrize("factor", [1.5, 3.0])
def test_a_receiver_that_contradicts_the_rigs_lengths_is_an_error_that_is_said(factor: float) -> None:
    simulated = make_simulated_drive(units=UNITS, cameras=2, points=600)
    mapper = with_true_poses(make_model(simulated), simulated, range(UNITS))
    scale_scene(mapper, factor)
    refused = place_by_gnss(mapper, received(simulated, 0.02), ARM_M)
    (said,) = refusal_findings(refused)
    assert (said.severity, said.code) == ("error", "gnss-contradicts-rig")
    times = float(said.what.split(" times as long")[0].split()[-1])
    assert times == pytest.approx(1 / factor, rel=0.02)


def test_a_receiver_of_another_route_changes_nothing() -> None:
    simulated = make_simulated_drive(units=UNITS, cameras=2, points=600)
    mapper = with_true_poses(make_model(simulated), simulated, range(UNITS))
    before = mapper.state.unit_position_m.copy()
    elsewhere_m = np.random.default_rng(2).normal(size=(UNITS, 3)) * 20.0
    placement = place_by_gnss(mapper, received(simulated, 0.02, elsewhere_m), ARM_M, sigma_scale=0.2)
    assert placement.prior is None
    assert [(f.severity, f.code) for f in refusal_findings(placement)] == [("warning", "gnss-not-used")]
    assert placement.reason
    np.testing.assert_allclose(mapper.state.unit_position_m, before, atol=1e-9)


def test_a_way_that_is_short_against_the_noise_is_no_fault_of_the_positions() -> None:
    simulated = make_simulated_drive(units=UNITS, cameras=2, points=300)
    mapper = with_true_poses(make_model(simulated), simulated, range(UNITS))
    (said,) = refusal_findings(place_by_gnss(mapper, received(simulated, 50.0), ARM_M))
    assert "too little against the receiver's noise" in said.what
    assert said.remedy.startswith("Give a longer piece of the drive")


@pytest.mark.parametrize("start", [0, 3])
def test_between_the_samples_of_a_slow_receiver_positions_follow_the_scene(start: int) -> None:
    """Chords between its samples cut bends: at the units between them its positions would be off by what they cut."""
    simulated = make_simulated_drive(units=UNITS, cameras=2, points=600, travelled_m=4.0 * np.arange(UNITS))
    mapper = with_true_poses(make_model(simulated), simulated, range(UNITS))
    gnss, antenna = received(simulated, 0.001), received(simulated, 0.0).position_m
    slow_one = replace(gnss, good=np.arange(UNITS) % 5 == start)
    chords = slow_one.at(simulated.drive.timestamps_us, max_gap_us=2_000_000)[0]
    known = np.isfinite(chords[:, 0])
    assert np.linalg.norm(chords - antenna, axis=1)[known].max() > 0.1
    placement = place_by_gnss(mapper, slow_one, ARM_M)
    assert placement.prior is not None
    off_m = np.linalg.norm(placement.known_m - antenna, axis=1)
    assert np.nanmax(off_m) < 0.01
    assert placement.noise_factor < 2.0


def test_a_gap_that_is_long_for_a_receiver_has_no_positions() -> None:
    """They would say what its ends say, and look exact: a third of all positions that scatter about nothing."""
    simulated = make_simulated_drive(units=UNITS, cameras=2, points=600)
    mapper = with_true_poses(make_model(simulated), simulated, range(UNITS))
    inside = (np.arange(UNITS) > 9) & (np.arange(UNITS) < 20)
    with_gap = replace(received(simulated, 0.1), good=~inside)
    placement = place_by_gnss(mapper, with_gap, ARM_M)
    np.testing.assert_array_equal(placement.units, np.flatnonzero(~inside))
    errors = most_likely_errors(mapper, placement)
    assert 0.7 < errors.white < 1.4
    short = replace(received(simulated, 0.1), good=~inside | (np.arange(UNITS) % 3 == 0))
    np.testing.assert_array_equal(place_by_gnss(mapper, short, ARM_M).units, np.arange(UNITS))


def test_errors_of_which_no_scatter_is_seen_scatter() -> None:
    simulated = make_simulated_drive(units=UNITS, cameras=2, points=600)
    mapper = with_true_poses(make_model(simulated), simulated, range(UNITS))
    seldom = replace(received(simulated, 0.1), good=np.isin(np.arange(UNITS), [0, UNITS - 1]))
    found = receiver_errors(mapper, place_by_gnss(mapper, seldom, ARM_M))
    assert (found.wander, found.white >= 1.0) == (0.0, True)


@pytest.mark.parametrize("wrong", [[4], [2, 4]])
def test_gross_errors_of_a_slow_receiver_are_told_by_the_scene(wrong: list[int]) -> None:
    """Interpolated, one wrong sample is a ramp over all units between its neighbours."""
    simulated = make_simulated_drive(units=61, cameras=1, points=600, travelled_m=0.8 * np.arange(61))
    mapper = with_true_poses(make_model(simulated), simulated, range(61))
    gnss = received(simulated, 0.3)
    position = gnss.position_m.copy()
    position[10 * np.array(wrong)] += [7.0, 9.0, 0.0]
    slow_one = replace(gnss, position_m=position, good=np.arange(61) % 10 == 0)
    placement = place_by_gnss(mapper, slow_one, ARM_M)
    assert placement.prior is not None
    known_m = placement.known_m[placement.prior.unit]
    assert np.abs(known_m - received(simulated, 0.0).position_m[placement.prior.unit]).max() < 1.5
    assert len(placement.prior.unit) >= 40
    assert placement.errors.white == pytest.approx(1.0, abs=0.5)
    assert placement.errors.wander == 0.0
