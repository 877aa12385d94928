from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.bundle_adjustment.priors import PositionPrior
from mrasfm_engine.bundle_adjustment.solver import SolverOptions
from mrasfm_engine.config import BundleAdjustmentConfig, EngineConfig
from mrasfm_engine.geometry.camera_model import pack_camera, pack_cameras, project_points, unproject_pixels
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.calibration import calibration_prior, take_calibration
from mrasfm_engine.mapping.intrinsics import (
    IntrinsicsDecision,
    assess_intrinsics,
    held_intrinsics,
    intrinsics_prior,
    take_models,
)
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.refinement import refine
from tests.helpers.simulated_drive import (
    SimulatedDrive,
    make_model,
    make_simulated_drive,
    with_cameras,
    with_true_poses,
)
from tests.helpers.slow import slow
from tests.unit.mapping.test_placement import ARM_M, received

SIGMA_FOCAL = 0.02
K1 = 0.01  # that the rectification of a wide lens may well leave
CONFIG = EngineConfig(threads=1, bundle_adjustment=BundleAdjustmentConfig(refine_focal=True, sigma_focal=SIGMA_FOCAL))


def model(*, straight: bool, focal: float = 1.0, cameras: int = 4) -> tuple[Mapper, SimulatedDrive]:
    """A drive at its true poses; its cameras are given with focal lengths so many times as long."""
    simulated = make_simulated_drive(units=30, cameras=cameras, points=2500, straight=straight)
    rig = simulated.drive.manifest.rig
    given = [
        c.model_copy(update={"params": [focal * c.params[0], focal * c.params[1], *c.params[2:]]}) for c in rig.cameras
    ]
    simulated = with_cameras(simulated, given)
    return with_true_poses(make_model(simulated, config=CONFIG), simulated, range(30)), simulated


def all_free(cameras: int) -> IntrinsicsDecision:
    return IntrinsicsDecision(
        free=np.ones((cameras, 8), dtype=np.bool_),
        asked=np.ones(cameras, dtype=np.bool_),
        sigma_focal=np.full(cameras, 1e-3),
        prior_sigma_focal=np.full(cameras, SIGMA_FOCAL),
    )


def decide(mapper: Mapper, simulated: SimulatedDrive) -> IntrinsicsDecision:
    gnss = received(simulated, 0.05)
    positions = PositionPrior(unit=np.arange(30), position_m=gnss.position_m, sigma_m=gnss.sigma_m, lever_arm_m=ARM_M)
    return assess_intrinsics(
        mapper,
        np.ones(len(mapper.camera_kind), dtype=np.bool_),
        free_units=mapper.registered,
        terms=[calibration_prior(mapper), positions],
        options=SolverOptions(),
    )


@pytest.mark.slow
def test_a_turn_observes_focal_lengths_and_frees_what_the_model_has() -> None:
    mapper, simulated = model(straight=False)
    found = decide(mapper, simulated)
    assert (found.sigma_focal < 0.003).all()
    np.testing.assert_array_equal(found.free, np.tile(np.arange(8) < 4, (4, 1)))  # PINHOLE: no distortion
    assert found.findings(mapper) == []


@pytest.mark.parametrize("cameras", [2, *slow(4)])
def test_what_is_not_observed_is_held_and_said(cameras: int) -> None:
    mapper, simulated = model(straight=True, cameras=cameras)
    good = mapper.config.bundle_adjustment.model_copy(update={"sigma_focal": 0.0005})
    mapper.config = mapper.config.model_copy(update={"bundle_adjustment": good})
    found = decide(mapper, simulated)
    assert (found.sigma_focal > 0.0005 / 2).all()
    assert not found.free.any()
    said = found.findings(mapper)
    assert [f.code for f in said] == ["focal-not-observed"] * cameras
    assert "prior says 0.05%" in said[0].what


def test_half_of_the_prior_is_observed() -> None:
    """As for directions of the rig."""
    mapper, simulated = model(straight=False, cameras=2)
    sigma = decide(mapper, simulated).sigma_focal.max()
    for times, is_free in ((2.2, True), (1.5, False)):  # of which the posterior is 0.41 and 0.55, were errors the same
        poor = mapper.config.bundle_adjustment.model_copy(update={"sigma_focal": times * float(sigma)})
        mapper.config = mapper.config.model_copy(update={"bundle_adjustment": poor})
        found = decide(mapper, simulated)
        ratio = found.sigma_focal / found.prior_sigma_focal
        assert ((ratio > 1 / 3) & (ratio < 2 / 3)).all()
        assert found.free[:, 0].tolist() == [is_free] * 2


@pytest.mark.slow
def test_focal_lengths_that_are_given_too_long_are_found() -> None:
    mapper, simulated = model(straight=False, focal=1.01)
    result = refine(mapper, AbsolutePriors(gnss=received(simulated, 0.05), antenna_in_rig_m=ARM_M))
    assert result.intrinsics is not None
    assert result.intrinsics.free[:, :4].all()
    error = mapper.state.camera_params[:, 0] / simulated.truth.camera_params[:, 0] - 1
    assert np.abs(error).max() < 0.003
    assert result.certainty is not None
    assert (np.abs(error) < 3 * result.certainty.sigma_camera[:, 6]).all()


@pytest.mark.parametrize(
    ("refine_focal", "focal"),
    [
        (None, 1.022),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in ((None, 0.978), (True, 1.01), (False, 1.01))),
    ],
)
def test_a_single_camera_by_default(refine_focal: bool | None, focal: float) -> None:
    """Nothing else takes what is wrong with its lens; its place in the rig stays as given."""
    mapper, simulated = model(straight=False, focal=focal, cameras=1)
    settings = BundleAdjustmentConfig(refine_focal=refine_focal)
    mapper.config = EngineConfig(threads=1, bundle_adjustment=settings)
    as_given = mapper.keypoints.rays.copy()
    result = refine(mapper, AbsolutePriors(gnss=received(simulated, 0.05), antenna_in_rig_m=ARM_M))
    error = mapper.state.camera_params[:, 0] / simulated.truth.camera_params[:, 0] - 1
    np.testing.assert_allclose(mapper.state.rig_from_cam, mapper.drive.rig_from_cam, atol=1e-6)
    assert result.certainty is not None
    assert result.directions is None  # of one camera among others
    if refine_focal is False:
        np.testing.assert_allclose(error, focal - 1)
        np.testing.assert_array_equal(mapper.keypoints.rays, as_given)
        return
    assert np.abs(error).max() < 0.003
    assert (np.abs(error) < 3 * result.certainty.sigma_camera[:, 6]).all()
    assert (result.certainty.sigma_camera[:, 6] < 0.004).all()
    through_lens = unproject_pixels(int(mapper.camera_kind[0]), mapper.state.camera_params[0], mapper.keypoints.xy_px)
    np.testing.assert_allclose(mapper.keypoints.rays, through_lens, atol=1e-12)
    count = int(mapper.triangulated.sum())
    mapper.triangulate()
    assert mapper.triangulated.sum() >= count  # what is triangulated anew is seen through the lens that was found


def distorted(simulated: SimulatedDrive, **declared: float) -> SimulatedDrive:
    """A drive whose images have distortion, of which its pinhole cameras say nothing but what is `declared`."""
    cameras = simulated.drive.cameras
    lenses = [pack_camera("OPENCV", [*camera.params, K1, 0.0, 0.0, 0.0]) for camera in cameras]
    pinholes = [pack_camera(camera.model, camera.params) for camera in cameras]
    features = [
        replace(
            f, xy_px=project_points(*lenses[i.camera], unproject_pixels(*pinholes[i.camera], f.xy_px.astype(float)))
        )
        for i, f in zip(simulated.drive.images, simulated.features, strict=True)
    ]
    given = [camera.model_copy(update=declared) for camera in cameras]
    return replace(with_cameras(simulated, given), features=features)


@pytest.mark.parametrize(
    ("cameras", "declared", "straight"),
    [
        (1, {}, False),
        (3, {"sigma_focal_px": 3.0}, False),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (
                (1, {}, True),
                (3, {}, False),
                (3, {"sigma_distortion": 0.01}, False),
                (3, {"sigma_distortion": 0.01}, True),
            )
        ),
    ],
)
def test_distortion_that_is_left_in_images_of_pinhole_cameras(
    cameras: int, declared: dict[str, float], straight: bool
) -> None:
    """It is found where a single camera turns, or intrinsics are declared uncertain; else they stay pinholes."""
    simulated = make_simulated_drive(units=30, cameras=cameras, points=2500, straight=straight)
    simulated = distorted(simulated, **declared)
    mapper = with_true_poses(make_model(simulated, config=EngineConfig(threads=1)), simulated, range(30))
    given = mapper.state.camera_params.copy()
    result = refine(mapper, AbsolutePriors(gnss=received(simulated, 0.05), antenna_in_rig_m=ARM_M))
    found, certainty = mapper.state.camera_params, result.certainty
    if not declared and (straight or cameras > 1):
        assert {camera.model for camera in mapper.drive.cameras} == {"PINHOLE"}
        np.testing.assert_array_equal(found, given)
        return
    assert {camera.model for camera in mapper.drive.cameras} == {"OPENCV"}
    assert mapper.drive.cameras[0].params == [*simulated.drive.cameras[0].params, 0.0, 0.0, 0.0, 0.0]
    np.testing.assert_allclose(found[:, 4], K1, atol=0.15 * K1)
    assert certainty is not None
    off = found[:, 0] / given[:, 0] - 1
    assert np.abs(off).max() < 0.003
    assert (np.abs(off) < 3 * certainty.sigma_camera[:, 6]).all()


def test_distortion_is_found_beside_focal_lengths_that_are_held() -> None:
    """Focal lengths that are known well the drive does not tell better; the rest of the lens it does."""
    simulated = distorted(make_simulated_drive(units=20, cameras=2, points=1500), sigma_focal_px=0.1)
    mapper = with_true_poses(make_model(simulated, config=EngineConfig(threads=1)), simulated, range(20))
    given = mapper.state.camera_params.copy()
    result = refine(mapper, AbsolutePriors(gnss=received(simulated, 0.05), antenna_in_rig_m=ARM_M))
    assert result.intrinsics is not None
    np.testing.assert_array_equal(result.intrinsics.free, np.tile(np.arange(8) > 0, (2, 1)))
    np.testing.assert_array_equal(mapper.state.camera_params[:, 0], given[:, 0])
    np.testing.assert_allclose(mapper.state.camera_params[:, 4], K1, atol=0.15 * K1)
    assert result.certainty is not None
    np.testing.assert_allclose(result.intrinsics.prior_sigma_focal * given[:, 0], 0.1)


def test_a_smaller_component_has_the_lens_models_of_the_largest() -> None:
    simulated = distorted(make_simulated_drive(units=12, cameras=2, points=600))
    whole, part = (with_true_poses(make_model(simulated), simulated, units) for units in (range(8), range(8, 12)))
    take_models(whole, simulated.drive.manifest.rig, np.array([True, False]))
    whole.state.camera_params[0, 4] = K1
    take_calibration(part, whole)
    assert [camera.model for camera in part.drive.cameras] == ["OPENCV", "PINHOLE"]
    np.testing.assert_array_equal(part.camera_kind, pack_cameras(part.drive.cameras)[0])
    np.testing.assert_array_equal(part.state.camera_params, whole.state.camera_params)
    through_lens = unproject_pixels(int(part.camera_kind[0]), part.state.camera_params[0], part.keypoints.xy_px)
    of_first = part.keypoints.camera == 0
    np.testing.assert_allclose(part.keypoints.rays[of_first], through_lens[of_first], atol=1e-12)


@pytest.mark.parametrize("refine_focal", [None, *slow(False)])
def test_cameras_whose_intrinsics_the_manifest_declares_uncertain(refine_focal: bool | None) -> None:
    """By default they vary, and those of the others do not."""
    _, simulated = model(straight=False, cameras=3)
    declared, *others = simulated.drive.cameras
    long = {"params": [1.004 * p for p in declared.params[:2]] + declared.params[2:], "sigma_focal_px": 10.0}
    simulated = with_cameras(simulated, [declared.model_copy(update=long), *others])
    config = EngineConfig(threads=1, bundle_adjustment=BundleAdjustmentConfig(refine_focal=refine_focal))
    mapper = with_true_poses(make_model(simulated, config=config), simulated, range(30))
    given = mapper.state.camera_params.copy()
    result = refine(mapper, AbsolutePriors(gnss=received(simulated, 0.05), antenna_in_rig_m=ARM_M))
    found, certainty = mapper.state.camera_params, result.certainty
    np.testing.assert_array_equal(found[1:], given[1:])
    if refine_focal is False:
        np.testing.assert_array_equal(found, given)
        return
    assert result.intrinsics is not None
    assert result.intrinsics.asked.tolist() == [True, False, False]
    assert certainty is not None
    off = found[0, 0] / declared.params[0] - 1
    assert abs(off) < min(0.001, 3 * certainty.sigma_camera[0, 6])


def test_other_cameras_of_the_rig_that_have_no_images_stay_as_given() -> None:
    simulated = make_simulated_drive(units=12, cameras=1, points=600)
    (camera,) = simulated.drive.manifest.rig.cameras
    idle = camera.model_copy(update={"name": "idle"})
    mapper = make_model(with_cameras(simulated, [camera, idle]), config=EngineConfig(threads=1))
    state, truth = mapper.state, simulated.world_from_rig
    state.unit_rotation[:], state.unit_position_m[:] = truth[:, :3, :3], truth[:, :3, 3]
    mapper.registered[:] = True
    mapper.complete()
    result = refine(mapper, AbsolutePriors(gnss=received(simulated, 0.05), antenna_in_rig_m=ARM_M))
    assert result.georeferenced
    np.testing.assert_allclose(mapper.state.rig_from_cam, mapper.drive.rig_from_cam, atol=1e-5)
    assert np.linalg.norm(mapper.state.unit_position_m - truth[:, :3, 3], axis=1).max() < 0.1


def test_a_single_camera_on_a_straight_street_says_nothing_and_is_not_certain() -> None:
    mapper, simulated = model(straight=True, focal=1.001, cameras=1)
    mapper.config = EngineConfig(threads=1)
    given = mapper.state.camera_params.copy()
    result = refine(mapper, AbsolutePriors(gnss=received(simulated, 0.05), antenna_in_rig_m=ARM_M))
    np.testing.assert_array_equal(mapper.state.camera_params, given)
    assert result.intrinsics is not None
    assert result.intrinsics.findings(mapper) == []
    assert result.certainty is not None
    assert 0.01 / 2 < result.certainty.sigma_camera[0, 6] <= 0.0101


def test_leaving_the_prior_is_a_finding() -> None:
    mapper, _ = model(straight=False, cameras=2)
    mapper.state.camera_params[0, :2] *= 1.1
    decision = all_free(2)
    said = decision.findings(mapper)
    assert [f.code for f in said] == ["focal-beyond-prior"]
    assert "+9.53% off what is given, 5 sigmas" in said[0].what
    assert held_intrinsics(mapper).findings(mapper) == []


def test_terms_of_distortion_that_never_vary_are_said() -> None:
    mapper, simulated = model(straight=False, cameras=2)
    rig = simulated.drive.manifest.rig
    wide = {"model": "FULL_OPENCV", "params": [*rig.cameras[0].params, 0.1, -0.02, 0.0, 0.0, 0.003, 0.0, 0.04, 0.0]}
    plain = {"model": "FULL_OPENCV", "params": [*rig.cameras[1].params, 0.1, -0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]}
    cameras = [camera.model_copy(update=to) for camera, to in zip(rig.cameras, (wide, plain), strict=True)]
    mapper.drive = with_cameras(simulated, cameras).drive
    decision = all_free(2)
    (said,) = decision.findings(mapper)
    assert said.code == "distortion-held"
    assert said.what.startswith(f"k3, k5 of camera {cameras[0].name} are held as given")
    assert replace(decision, free=np.zeros((2, 8), dtype=np.bool_)).findings(mapper)[0].code == "focal-not-observed"
    assert held_intrinsics(mapper).findings(mapper) == []


def test_the_prior_is_the_manifests_where_it_says_one() -> None:
    mapper, simulated = model(straight=False, cameras=2)
    rig = simulated.drive.manifest.rig
    given = {"sigma_focal_px": 3.0, "sigma_principal_point_px": 1.5, "sigma_distortion": 0.01}
    cameras = [rig.cameras[0].model_copy(update=given), rig.cameras[1]]
    mapper.drive = with_cameras(simulated, cameras).drive
    prior = intrinsics_prior(mapper)
    assert prior.sigma[0, 0] == pytest.approx(3.0 / prior.params[0, 0])
    assert prior.sigma[1, 0] == SIGMA_FOCAL
    np.testing.assert_array_equal(prior.sigma[0, 2:4], 1.5)
    np.testing.assert_array_equal(prior.sigma[0, 4:6], 0.01)
    assert (prior.sigma > 0).all()
