"""Errors that all images share: of lens models that are off, and of images that err otherwise."""

from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.config import EngineConfig
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.components import map_drive
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.refinement import refine
from mrasfm_engine.mapping.refinement_result import Refinement
from mrasfm_engine.mapping.systematic_errors import _told_by
from mrasfm_engine.scene.row_bands import RowBands
from mrasfm_engine.triangulation.tracks import Keypoints
from tests.benchmarks.sigmas import camera_errors
from tests.helpers.simulated_drive import SimulatedDrive, make_simulated_drive, true_matches, with_lens_errors

LENS_PX = 0.3


def refined(drive: SimulatedDrive) -> tuple[Mapper, Refinement]:
    keypoints = Keypoints.from_features(drive.drive, drive.features, RowBands.from_drive(drive.drive, compensate=True))
    mapper = map_drive(
        drive.drive, keypoints, true_matches(drive), None, EngineConfig(), absolute=AbsolutePriors()
    )[0].mapper  # fmt: skip
    return mapper, refine(mapper)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize(("cameras", "seed"), [(2, 0), (6, 1)])
def test_sigmas_hold_what_lenses_are_off(cameras: int, seed: int) -> None:
    exact = make_simulated_drive(units=16, cameras=cameras, points=2000, noise_px=0.5, radius_m=60.0, seed=seed)
    drive = with_lens_errors(exact, LENS_PX, seed=seed)
    mapper, result = refined(drive)
    assert result.certainty is not None
    assert result.systematic is not None
    repeatability = result.certainty.sigma_camera[:, :6]
    off = camera_errors(mapper, drive)[:, :3]
    assert rms(off / repeatability[:, :3]) > 3.0, "lens errors do not show in this drive"
    assert 0.4 < rms(off / result.systematic.sigma_camera(repeatability)[:, :3]) < 2.0
    assert LENS_PX / 3 < result.systematic.lens_px < 3 * LENS_PX


@pytest.mark.parametrize("cameras", [2, 6])
def test_right_lenses_add_little(cameras: int) -> None:
    _, result = refined(make_simulated_drive(units=16, cameras=cameras, points=2000, noise_px=0.5, radius_m=60.0))
    assert result.certainty is not None
    assert result.systematic is not None
    repeatability = result.certainty.sigma_camera[:, :6]
    assert (result.systematic.sigma_camera(repeatability) >= repeatability).all()
    assert rms(result.systematic.sigma_camera(repeatability) / repeatability) < 1.3
    assert result.systematic.lens_px < 0.03


@pytest.mark.parametrize(("size", "factor"), [(0.5, 1.0), (0.02, 8.0), (0.5, 8.0), (0.003, 1.0)])
def test_axes_tell_lens_errors_from_others(size: float, factor: float) -> None:
    rng = np.random.default_rng(5)
    information = np.geomspace(1e-2, 1e6, 48)
    error = size * rng.normal(size=48)
    derivatives = -information * error + factor * np.sqrt(information) * rng.normal(size=48)
    told = _told_by(information, derivatives, 1.0)
    assert told is not None
    assert np.sqrt(told.factor2) == pytest.approx(factor, rel=0.5)
    if size > 0.01:
        assert np.sqrt(told.size2) == pytest.approx(size, rel=0.4)
    else:
        assert np.sqrt(told.size2) < 3 * size
    # In axes that images tell well, the error itself is known.
    assert np.sqrt(np.diagonal(told.moments)[-8:]) == pytest.approx(np.abs(error[-8:]), abs=4 * factor * 1e-2)


def test_lenses_that_no_image_tells_say_nothing() -> None:
    assert _told_by(np.zeros(8), np.ones(8), 1.0) is None
