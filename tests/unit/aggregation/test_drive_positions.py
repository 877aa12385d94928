"""What receivers and rough poses say of units in the map, and their constant error."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrasfm_engine.aggregation.assembly import Assembly
from mrasfm_engine.aggregation.positions import drive_positions, with_bias
from mrasfm_engine.geometry import se3
from mrasfm_engine.scene.state import State
from tests.helpers.small_scenes import ANTENNA_M, CONFIG, Driven, Street, drive_along, make_street

BIAS_M = (1.4, -0.9, 0.6)
UNITS = 40
MISSING = [3, 4]


@pytest.fixture(scope="module")
def street() -> Street:
    return make_street(length_m=40.0, points=400)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("positions")


@pytest.fixture(scope="module")
def driven(street: Street, folder: Path) -> Driven:
    return drive_along(
        street, folder / "gnss", np.arange(UNITS), bias_m=BIAS_M, missing_units=MISSING, gnss_noise_m=0.05
    )


def believed(driven: Driven) -> np.ndarray:
    """Where the scene's positions put it."""
    return se3.transform(np.eye(3), BIAS_M) @ driven.street_from_scene


def true_state(driven: Driven) -> State:
    return Assembly(scenes=[driven.source]).state(driven.street_from_scene[None])


def test_the_constant_error_of_a_receiver_is_found(driven: Driven) -> None:
    found = drive_positions(driven.source, believed(driven), 100, CONFIG.gnss)
    assert found is not None
    assert found.prior.unit.tolist() == [100 + u for u in range(UNITS) if u not in MISSING]
    own = drive_positions(driven.source, believed(driven), 0, CONFIG.gnss)
    assert own is not None
    antenna = se3.apply(driven.street_from_rig, np.tile(ANTENNA_M, (UNITS, 1, 1)))[own.prior.unit, 0]
    raw = own.prior.position_m - antenna - BIAS_M
    assert 0 < np.abs(raw).max() < 5 * 0.05
    told = with_bias(own, true_state(driven))
    assert 0 < np.abs(told.bias_m - BIAS_M).max() < 0.03
    assert 0 < np.abs((told.prior.position_m - antenna).mean(0)).max() < 0.03
    # Samples of one receiver go wrong together: a second's worth of them counts as fewer.
    assert 0.05 < own.prior.sigma_m[0, 0] < 0.5
    np.testing.assert_allclose(own.prior.sigma_m[:, 2], 2 * own.prior.sigma_m[:, 0])


def test_the_error_is_estimated_anew_and_forgets_where_units_were(driven: Driven) -> None:
    """A start that is bent by metres must not make the receiver less credible once the units are right."""
    found = drive_positions(driven.source, believed(driven), 0, CONFIG.gnss)
    assert found is not None
    truth = true_state(driven)
    rng = np.random.default_rng(0)
    bent = replace(truth, unit_position_m=truth.unit_position_m + rng.normal(0, 2.0, truth.unit_position_m.shape))
    doubted = with_bias(found, bent)
    assert doubted.prior.sigma_m.min() > 3 * found.prior.sigma_m.max() / 2
    again, directly = with_bias(doubted, truth), with_bias(found, truth)
    np.testing.assert_allclose(again.bias_m, directly.bias_m, atol=1e-9)
    np.testing.assert_allclose(again.prior.position_m, directly.prior.position_m, atol=1e-9)
    np.testing.assert_allclose(again.prior.sigma_m, directly.prior.sigma_m)


def test_rough_poses_of_a_common_world(street: Street, folder: Path) -> None:
    driven = drive_along(street, folder / "rough", np.arange(12.0), bias_m=BIAS_M, common_world="survey", seed=1)
    assert driven.source.common_world == "survey"
    found = drive_positions(driven.source, believed(driven), 0, CONFIG.gnss)
    assert found is not None
    # The scene's frame has its origin in the middle of the way, here, and not where the rough poses begin.
    expected = driven.street_from_rig[:, :3, 3] + BIAS_M
    np.testing.assert_allclose(found.prior.position_m, expected, atol=1e-6)
    told = with_bias(found, true_state(driven))
    np.testing.assert_allclose(told.bias_m, BIAS_M, atol=1e-3)


def test_too_few_positions_say_nothing(driven: Driven) -> None:
    gnss = driven.source.manifest.gnss
    assert gnss is not None
    few = driven.source.manifest.model_copy(update={"gnss": gnss.model_copy(update={"samples": gnss.samples[:2]})})
    assert drive_positions(replace(driven.source, manifest=few), believed(driven), 0, CONFIG.gnss) is None
    none = driven.source.manifest.model_copy(update={"gnss": None})
    assert drive_positions(replace(driven.source, manifest=none), believed(driven), 0, CONFIG.gnss) is None
