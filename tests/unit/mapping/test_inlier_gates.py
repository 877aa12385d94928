from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.config import BundleAdjustmentConfig, EngineConfig
from mrasfm_engine.mapping.inlier_gates import gates_px, robust_sigma, widest_gates_px
from mrasfm_engine.mapping.mapper import Mapper
from tests.helpers.simulated_drive import enlarged, make_model, make_simulated_drive

NOISE_PX = 4.0  # of an observation at most, by the settings


def model(*, factor: int = 1, sigma_deg: float = 2.0) -> Mapper:
    simulated = enlarged(make_simulated_drive(units=3, cameras=2, points=200), factor)
    config = EngineConfig(threads=1, bundle_adjustment=BundleAdjustmentConfig(sigma_rotation_deg=sigma_deg))
    return make_model(simulated, config=config)


def test_the_widest_gate_grows_with_the_focal_length_and_the_prior() -> None:
    gate, twice, surer = (model(**v) for v in ({}, {"factor": 2}, {"sigma_deg": 1.0}))
    assert 8.0 < widest_gates_px(gate)[0] < 14.0  # 660 px of focal length
    assert 1.8 < widest_gates_px(twice)[0] / widest_gates_px(gate)[0] < 2.0
    by_calibration = [np.sqrt(widest_gates_px(m)[0] ** 2 - NOISE_PX**2) for m in (gate, surer)]
    assert by_calibration[0] == pytest.approx(2.0 * by_calibration[1])


def test_the_widest_gate_is_no_smaller_than_noise_and_lets_no_chance_decide() -> None:
    assert NOISE_PX < widest_gates_px(model(sigma_deg=1e-3))[0] < 1.001 * NOISE_PX
    loose = model(sigma_deg=60.0)
    hit_by_chance = np.pi * widest_gates_px(loose)[0] ** 2 / np.prod(loose.image_size_px[0])
    assert hit_by_chance == pytest.approx(0.01 * loose.config.mapping.min_pnp_inlier_ratio)


@pytest.mark.parametrize("factor", [1, 2])
def test_a_gate_is_the_chi_square_limit_of_what_residuals_are(factor: int) -> None:
    mapper, rng = model(factor=factor), np.random.default_rng(0)
    camera = rng.integers(0, 2, 4000)
    right = factor * np.linalg.norm(rng.normal(size=(4000, 2)) * 2.0, axis=1)
    gates = gates_px(mapper, right, camera)
    np.testing.assert_allclose(gates, factor * 2.0 * 3.035, rtol=0.05)
    assert 0.985 < (right < gates[camera]).mean() < 0.995
    mixed = np.where(rng.random(4000) < 0.3, factor * rng.uniform(30.0, 300.0, 4000), right)
    np.testing.assert_allclose(gates_px(mapper, mixed, camera), gates, rtol=0.05)


def test_a_gate_is_never_wider_than_calibration_explains_nor_narrower_than_noise() -> None:
    mapper, rng = model(), np.random.default_rng(0)
    camera = np.zeros(1000, dtype=np.int64)
    for sigma_px, expected in ((0.5, NOISE_PX), (20.0, widest_gates_px(mapper)[0])):
        errors = np.linalg.norm(rng.normal(size=(1000, 2)) * sigma_px, axis=1)
        assert gates_px(mapper, errors, camera)[0] == pytest.approx(expected)
    np.testing.assert_array_equal(gates_px(mapper, np.full(1000, np.inf), camera), widest_gates_px(mapper))


def test_the_robust_sigma_is_that_of_a_coordinate() -> None:
    errors = np.linalg.norm(np.random.default_rng(0).normal(size=(5000, 2)) * 0.7, axis=1)
    errors[:200] = 1e3
    assert 0.68 < robust_sigma(errors) < 0.76
