"""The antenna's place in the rig: told from the shape of the way, and corrected where it is clearly wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.alignment import align_similarity
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.lever_arm import LeverArm, lever_arm, lever_arm_findings, ways_of_antenna
from mrasfm_engine.mapping.mapping_report import describe_refinement
from mrasfm_engine.mapping.refinement import refine
from mrasfm_engine.mapping.refinement_result import Refinement
from tests.helpers.simulated_drive import make_model, make_simulated_drive, with_true_poses
from tests.unit.mapping.test_placement import ARM_M, received
from tests.unit.mapping.test_receiver_clock import UNITS, measured

TIMES_S = np.arange(80) * 0.2
HERE = np.zeros(3)


def turning(radius_m: float = 30.0) -> tuple[np.ndarray, np.ndarray]:
    """Places and rotations of a vehicle that turns by some 150 degrees, after a straight."""
    heading = np.maximum(0.0, 8.0 * (TIMES_S - 5.0)) / radius_m
    velocity = 8.0 * np.stack([np.cos(heading), np.sin(heading), 0 * heading], 1)
    place_m = np.cumsum(velocity, axis=0) * 0.2
    return place_m, se3.exp_so3(np.stack([0 * heading, 0 * heading, heading], 1))


def found_by(
    offset_m: tuple[float, float, float], *, white_m: float = 0.05, straight: bool = False, **known: float
) -> LeverArm:
    """The lever arm of an antenna that is elsewhere by so much than was given."""
    place_m, rotation = turning(radius_m=1e9 if straight else 30.0)
    noise_m = white_m * np.random.default_rng(0).normal(size=place_m.shape)
    positions = measured(place_m + rotation @ np.array(offset_m) + noise_m, TIMES_S, white_m=white_m, wander_m=0.0)
    ways = ways_of_antenna(place_m, rotation, TIMES_S, times_vary=False)
    return lever_arm(positions.position_m - place_m, ways, positions, assumed_m=HERE, **known)[0]


@pytest.mark.parametrize("offset_m", [(0.0, 0.6, 0.0), (0.0, -0.6, 0.0), (1.2, 0.0, 0.0), (-0.5, 0.4, 0.0)])
def test_an_antenna_elsewhere_is_told_with_its_sign(offset_m: tuple[float, float, float]) -> None:
    found = found_by(offset_m)
    assert found.is_wrong
    np.testing.assert_allclose(found.offset_m[:2], offset_m[:2], atol=4 * found.sigma_m[:2].max())
    assert 0.005 < found.sigma_m[:2].max() < 0.12
    assert found.sigma_m[2] > 0.9  # a higher antenna is a higher world


def test_an_antenna_that_is_where_it_was_given_stays_there() -> None:
    found = found_by((0.0, 0.0, 0.0))
    assert not found.may_be_wrong
    assert found.sigma_before_m == 0.0
    np.testing.assert_array_equal(found.offset_m, np.zeros(3))


def test_an_antenna_cannot_be_told_on_a_straight_way() -> None:
    assert not found_by((0.5, 0.8, 0.3), straight=True).is_wrong
    found = found_by((0.5, 0.8, 0.3), straight=True, sigma_given_m=1.0)
    np.testing.assert_allclose(found.offset_m, 0.0, atol=0.05)
    np.testing.assert_allclose(found.sigma_m, 1.0, atol=0.05)


def test_a_scale_that_is_known_otherwise_tells_the_antenna_better() -> None:
    """A turn is wider by an antenna farther out, and by a scene that is larger."""
    free, known = (found_by((0.0, 0.6, 0.0), white_m=0.3, sigma_factor=sigma) for sigma in (np.inf, 1e-4))
    assert known.sigma_m[1] < 0.8 * free.sigma_m[1]
    assert known.is_wrong


@pytest.mark.parametrize("sigma_given_m", [0.05, 0.3, 2.0])
def test_a_place_that_is_known_somewhat_is_estimated(sigma_given_m: float) -> None:
    """It is as given where nothing else is said, and never less well known."""
    right, off = (found_by((0.0, by_m, 0.0), sigma_given_m=sigma_given_m) for by_m in (0.0, sigma_given_m))
    for found, by_m in ((right, 0.0), (off, sigma_given_m)):
        assert found.sigma_before_m > 0.0
        assert not found.is_wrong
        assert found.offset_m[1] == pytest.approx(by_m, abs=4 * found.sigma_m[1])
        assert (found.sigma_m <= sigma_given_m * (1.0 + 1e-9)).all()
    straight = found_by((0.0, 0.5, 0.0), straight=True, sigma_given_m=sigma_given_m)
    np.testing.assert_allclose(straight.sigma_m, sigma_given_m, rtol=0.05)


def test_a_place_that_is_known_well_may_be_wrong_all_the_same() -> None:
    found = found_by((0.0, 0.9, 0.0), sigma_given_m=0.02)
    assert found.is_wrong
    assert found.sigma_before_m == 1.0
    assert found.offset_m[1] == pytest.approx(0.9, abs=4 * found.sigma_m[1])


def test_a_better_guess_leads_to_the_same_place() -> None:
    """The odds are those against where the antenna was given, wherever it is taken to be."""
    place_m, rotation = turning()
    at_m = np.array([0.4, -0.7, 0.0])
    noise_m = 0.05 * np.random.default_rng(2).normal(size=place_m.shape)
    positions = measured(place_m + rotation @ at_m + noise_m, TIMES_S, white_m=0.05, wander_m=0.0)
    found = []
    for assumed_m in (HERE, at_m):
        antenna_m = place_m + rotation @ assumed_m
        ways = ways_of_antenna(antenna_m, rotation, TIMES_S, times_vary=False)
        found.append(lever_arm(positions.position_m - antenna_m, ways, positions, assumed_m=assumed_m)[0])
    np.testing.assert_allclose(found[0].offset_m, found[1].offset_m, atol=0.02)
    assert found[0].log_odds == pytest.approx(found[1].log_odds, rel=0.05)
    assert found[0].is_as(found[1])
    assert not found[0].is_as(LeverArm.unknown())


def refined(wrong_by_m: Sequence[float], sigma_antenna_m: float) -> tuple[Refinement, dict[str, Any], float]:
    """A drive through a bend whose antenna is given wrongly; what the report says of it, and the scale's error."""
    simulated = make_simulated_drive(units=UNITS, cameras=2, points=2000)
    mapper = with_true_poses(make_model(simulated), simulated, range(UNITS))
    mapper.complete()
    given_m, track = ARM_M + np.array(wrong_by_m), received(simulated, 0.02)
    result = refine(mapper, AbsolutePriors(gnss=track, antenna_in_rig_m=given_m, sigma_antenna_m=sigma_antenna_m))
    scale = align_similarity(mapper.state.unit_position_m, simulated.world_from_rig[:, :3, 3]).scale
    return result, describe_refinement(mapper, result)["gnss"], scale - 1.0


def codes(result: Refinement) -> list[str]:
    assert result.placement is not None
    return [finding.code for finding in result.placement.findings]


@pytest.mark.parametrize("wrong_by_m", [(0.0, 0.0, 0.0), (0.0, 0.9, 0.0), (0.0, -0.9, 0.0)])
def test_a_wrong_lever_arm_is_said_to_be_wrong(wrong_by_m: tuple[float, float, float]) -> None:
    """The scene leaves it as it is, and its scale is as uncertain as that makes it."""
    result, report, scale_error = refined(wrong_by_m, 0.0)
    assert result.certainty is not None
    assert abs(scale_error) < 3 * result.certainty.sigma_scale
    if not any(wrong_by_m):
        assert codes(result) == []
        assert "antenna" not in report
        assert result.certainty.sigma_scale < 0.005
        return
    assert codes(result) == ["antenna-position"]
    np.testing.assert_allclose(report["antenna"]["used_in_rig_m"], ARM_M + wrong_by_m)
    sigma_m = np.array(report["antenna"]["sigma_m"])
    np.testing.assert_allclose(report["antenna"]["offset_m"][:2], -np.array(wrong_by_m)[:2], atol=4 * sigma_m[:2].max())
    assert sigma_m[:2].max() < 0.3
    assert 0.5 * abs(scale_error) < result.certainty.sigma_scale < 0.1


@pytest.mark.parametrize("wrong_by_m", [(0.0, 0.9, 0.0), (-0.8, -0.4, 0.0)])
def test_a_lever_arm_of_which_little_is_known_is_estimated(wrong_by_m: tuple[float, float, float]) -> None:
    result, report, scale_error = refined(wrong_by_m, 0.5)
    assert result.certainty is not None
    assert abs(scale_error) < 3 * result.certainty.sigma_scale
    assert 1e-5 < result.certainty.sigma_scale < 0.01
    sigma_m = np.array(report["antenna"]["sigma_m"])
    np.testing.assert_allclose(report["antenna"]["used_in_rig_m"][:2], ARM_M[:2], atol=4 * sigma_m[:2].max())
    given_m = ARM_M + wrong_by_m
    np.testing.assert_allclose(np.add(given_m, report["antenna"]["offset_m"]), report["antenna"]["used_in_rig_m"])
    assert sigma_m[:2].max() < 0.2


def test_a_declared_sigma_makes_the_antenna_an_unknown() -> None:
    """And what the scene's scale is uncertain by because of it is in its sigma."""
    sigmas = []
    for sigma_antenna_m in (0.0, 0.5):
        simulated = make_simulated_drive(units=UNITS, cameras=2, points=2000)
        mapper = with_true_poses(make_model(simulated), simulated, range(UNITS))
        mapper.complete()
        given_m = ARM_M + np.array([0.0, 0.3, 0.0])
        track = received(simulated, 0.3)
        known = AbsolutePriors(gnss=track, antenna_in_rig_m=given_m, sigma_antenna_m=sigma_antenna_m)
        result = refine(mapper, known)
        assert result.certainty is not None
        assert result.placement is not None
        assert [f.code for f in result.placement.findings] == []
        report = describe_refinement(mapper, result)["gnss"]
        assert ("antenna" in report) is (sigma_antenna_m > 0)
        sigmas.append(result.certainty.sigma_scale)
        scale = align_similarity(mapper.state.unit_position_m, simulated.world_from_rig[:, :3, 3]).scale
    assert abs(scale - 1.0) < 3 * sigmas[1]
    assert 1.1 * sigmas[0] < sigmas[1] < 0.1


def test_the_finding_says_what_is_told() -> None:
    known = {"sigma_before_m": 1.0, "log_odds": 9.0}
    lever = LeverArm(offset_m=np.array([-0.31, 0.72, 0.4]), sigma_m=np.array([0.05, 0.04, 0.97]), **known)
    (finding,) = lever_arm_findings(lever, is_taken=True)
    assert "0.31 m behind (sigma 0.05 m) and 0.72 m to the left of (sigma 0.04 m) where" in finding.what
    assert "above" not in finding.what
    (left,) = lever_arm_findings(replace(lever, longer=-0.0213), is_taken=False)
    assert "the scene leaves it where it was given, and would be 2.1% shorter with it there" in left.what
    assert "gnss.sigma_antenna_m" in left.remedy
    unsure = LeverArm(offset_m=np.array([0.3, 2.9, 0.0]), sigma_m=np.array([0.7, 0.8, 0.99]), **known)
    assert "is 2.90 m to the left of (sigma 0.80 m) where" in lever_arm_findings(unsure, is_taken=True)[0].what
    assert lever_arm_findings(None, is_taken=True) == []
    as_given = LeverArm(offset_m=np.zeros(3), sigma_m=np.full(3, 0.1), sigma_before_m=0.2, log_odds=-3.0)
    assert lever_arm_findings(as_given, is_taken=True) == []
