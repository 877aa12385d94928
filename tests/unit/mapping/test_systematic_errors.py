"""Errors that all images share: of lens models that are off, and of images that err otherwise."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mrasfm_engine.config import BundleAdjustmentConfig, EngineConfig
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.components import map_drive
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.refinement import refine
from mrasfm_engine.mapping.refinement_result import Refinement
from mrasfm_engine.mapping.scene_builder import build_scene
from mrasfm_engine.mapping.systematic_errors import _Lenses, _told_by
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory
from mrasfm_engine.scene.row_bands import RowBands
from mrasfm_engine.triangulation.tracks import Keypoints
from tests.benchmarks.sigmas import camera_errors
from tests.helpers.simulated_drive import (
    SimulatedDrive,
    make_simulated_drive,
    true_matches,
    with_cameras,
    with_lens_errors,
)

LENS_PX = 0.3


def refined(drive: SimulatedDrive, config: EngineConfig | None = None) -> tuple[Mapper, Refinement]:
    config = EngineConfig() if config is None else config
    keypoints = Keypoints.from_features(drive.drive, drive.features, RowBands.from_drive(drive.drive, compensate=True))
    mapper = map_drive(
        drive.drive, keypoints, true_matches(drive), None, config, absolute=AbsolutePriors()
    )[0].mapper  # fmt: skip
    return mapper, refine(mapper)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def assert_sigmas_hold_more_than_repeatabilities(result: Refinement, off_rad: np.ndarray) -> None:
    """Sigmas of rotations are about as large as their errors (c, 3), and other drives scatter by much less."""
    assert result.certainty is not None
    assert result.systematic is not None
    repeatability = result.certainty.sigma_camera[:, :6]
    assert rms(off_rad / repeatability[:, :3]) > 3.0, "lens errors do not show in this drive"
    assert 0.4 < rms(off_rad / result.systematic.sigma_camera(repeatability)[:, :3]) < 2.0


@pytest.mark.parametrize(("cameras", "seed"), [(2, 0), (6, 1)])
def test_sigmas_hold_what_lenses_are_off(cameras: int, seed: int) -> None:
    exact = make_simulated_drive(units=16, cameras=cameras, points=2000, noise_px=0.5, radius_m=60.0, seed=seed)
    drive = with_lens_errors(exact, LENS_PX, seed=seed)
    mapper, result = refined(drive)
    assert result.systematic is not None
    assert_sigmas_hold_more_than_repeatabilities(result, camera_errors(mapper, drive)[:, :3])
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


def test_principal_points_may_be_off_by_more_than_the_rest_of_a_lens() -> None:
    exact = make_simulated_drive(units=24, cameras=6, points=2500, noise_px=0.7)
    mapper, result = refined(with_lens_errors(exact, LENS_PX, parameters=[2, 3]))
    assert_sigmas_hold_more_than_repeatabilities(result, camera_errors(mapper, exact)[:, :3])


def test_other_errors_that_all_images_share_widen_sigmas() -> None:
    """Keypoints are drawn aside by a pattern over the image that is none of a lens."""
    exact = make_simulated_drive(units=16, cameras=2, points=2000, noise_px=0.3, radius_m=60.0)
    _, plain = refined(exact)
    features = [
        replace(of, xy_px=(of.xy_px + 0.5 * np.sin(of.xy_px[:, ::-1] / 60.0)).astype(np.float32))
        for of in exact.features
    ]
    _, result = refined(replace(exact, features=features))
    assert plain.systematic is not None
    assert result.systematic is not None
    assert result.certainty is not None
    assert result.systematic.factor > max(1.5, 1.3 * plain.systematic.factor)
    repeatability = result.certainty.sigma_camera[:, :6]
    others = np.sqrt(result.systematic.by_others[:, :6])
    assert rms(others / repeatability) > 1.2
    assert (result.systematic.sigma_camera(repeatability) >= others).all()


SLIGHT_TURN: dict[str, Any] = {"radius_m": 60.0}
STRAIGHT: dict[str, Any] = {"straight": True}


@pytest.mark.parametrize(
    ("shape", "sigma_focal"), [(SLIGHT_TURN, 5e-5), pytest.param(STRAIGHT, 5e-3, marks=pytest.mark.slow)]
)
def test_lenses_that_might_vary_and_are_held_err_as_others(*, shape: dict[str, Any], sigma_focal: float) -> None:
    """Cameras take what is wrong with a lens that is held, however uncertain it is."""
    exact = make_simulated_drive(units=16, cameras=2, points=2000, noise_px=0.5, **shape)
    drive = with_lens_errors(exact, LENS_PX)
    settings = BundleAdjustmentConfig(refine_focal=True, sigma_focal=sigma_focal)
    mapper, result = refined(drive, EngineConfig(bundle_adjustment=settings))
    assert result.intrinsics_are_asked
    assert not result.intrinsics_vary
    assert result.certainty is not None
    assert result.systematic is not None
    off_rad, sigma = camera_errors(mapper, drive)[:, :3], result.certainty.sigma_camera[:, :6]
    assert rms(off_rad / sigma[:, :3]) > 2.0, "lens errors do not show in this drive"
    assert 0.4 < rms(off_rad / result.systematic.sigma_camera(sigma)[:, :3]) < 2.0
    scene = build_scene(mapper, result, drive.features, [], PriorTrajectory(source="none", world_from_rig=None))
    focal_px = [camera.params[0] for camera in drive.drive.cameras]
    found = [camera.sigma_focal_px for camera in scene.calibration]
    np.testing.assert_allclose(found, sigma_focal * np.array(focal_px))


@pytest.mark.parametrize(
    ("shape", "sigma_focal_px"), [(SLIGHT_TURN, 0.05), pytest.param(STRAIGHT, 5.0, marks=pytest.mark.slow)]
)
def test_lenses_of_which_only_the_focal_length_is_held_err_by_what_is_certain(
    *, shape: dict[str, Any], sigma_focal_px: float
) -> None:
    """The rest varies, and the uncertainty of the adjustment has what it is off by."""
    exact = make_simulated_drive(units=16, cameras=2, points=2000, noise_px=0.5, **shape)
    drive = with_lens_errors(exact, LENS_PX, parameters=[2, 3, 4, 5, 6, 7])
    declared = [camera.model_copy(update={"sigma_focal_px": sigma_focal_px}) for camera in drive.drive.cameras]
    mapper, result = refined(with_cameras(drive, declared))
    assert result.intrinsics is not None
    assert not result.intrinsics.free[:, 0].any()
    assert result.intrinsics.free[:, 2:4].all()
    assert result.systematic is None
    assert result.certainty is not None
    off_rad = camera_errors(mapper, drive)[:, :3]
    assert 0.3 < rms(off_rad / result.certainty.sigma_camera[:, :3]) < 2.0
    scene = build_scene(mapper, result, drive.features, [], PriorTrajectory(source="none", world_from_rig=None))
    assert [camera.sigma_focal_px for camera in scene.calibration] == pytest.approx([sigma_focal_px] * 2)


def test_time_offsets_err_by_lenses_too() -> None:
    simulated = make_simulated_drive(
        units=24, cameras=4, points=2500, noise_px=0.5, radius_m=60.0, time_offset_ms=[0, 20, 40, 60],
        travelled_m=1.1 * np.arange(24) + 3.0 * np.sin(np.arange(24) / 4.0),
    )  # fmt: skip
    _, result = refined(with_lens_errors(simulated, LENS_PX))
    assert result.systematic is not None
    assert result.times is not None
    assert (result.systematic.sigma_time_s(result.times.sigma_s) > result.times.sigma_s).any()


def lenses(information: np.ndarray, derivatives: np.ndarray) -> _Lenses:
    size = len(information)
    none = np.zeros((0, 0))
    return _Lenses(
        information=np.diag(information),
        derivatives=derivatives,
        is_principal_point=np.zeros(size, dtype=np.bool_),
        place=np.zeros(0, dtype=np.int64),
        moved=np.zeros((0, size)),
        of_images=none,
        of_terms=none,
    )


@pytest.mark.parametrize(("size", "factor"), [(0.5, 1.0), (0.02, 8.0), (0.5, 8.0), (0.003, 1.0)])
def test_axes_tell_lens_errors_from_others(size: float, factor: float) -> None:
    rng = np.random.default_rng(5)
    information = np.geomspace(1e-2, 1e6, 48)
    error = size * rng.normal(size=48)
    derivatives = -information * error + factor * np.sqrt(information) * rng.normal(size=48)
    told = _told_by(lenses(information, derivatives), 1.0)
    assert told is not None
    assert np.sqrt(told.factor2) == pytest.approx(factor, rel=0.5)
    moments = np.sqrt(np.diagonal(told.moments))
    if size > 0.01:
        assert np.sqrt(told.size2) == pytest.approx(size, rel=0.6)
        assert rms(moments[:8]) == pytest.approx(size, rel=0.6), "axes that nothing tells err as all others do"
    else:
        assert np.sqrt(told.size2) < 3 * size
    if size > 0.1:  # in axes that images tell well, the error itself is known
        assert moments[-8:] == pytest.approx(np.abs(error[-8:]), abs=3 * factor * 1e-2)


def test_noise_is_taken_for_no_lens_error() -> None:
    rng = np.random.default_rng(6)
    information = np.geomspace(1e-2, 1e6, 48)
    told = _told_by(lenses(information, 0.3 * np.sqrt(information) * rng.normal(size=48)), 0.09)
    assert told is not None
    assert np.sqrt(told.factor2) < 1.5
    assert np.sqrt(told.size2) < 0.003


def test_lenses_that_no_image_tells_say_nothing() -> None:
    assert _told_by(lenses(np.zeros(8), np.ones(8)), 1.0) is None
    assert _told_by(lenses(np.zeros(0), np.zeros(0)), 1.0) is None
