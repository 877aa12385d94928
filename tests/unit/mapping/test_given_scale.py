from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mrasfm_engine.bundle_adjustment.priors import ScalePrior
from mrasfm_engine.config import BundleAdjustmentConfig, EngineConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.alignment import align_similarity
from mrasfm_engine.mapping import adjustment_rounds, given_scale
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.given_scale import ROTATION_SIGMA_PX
from mrasfm_engine.mapping.lens_errors import LENS_SIGMA_PX
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.mapping_report import scale_findings
from mrasfm_engine.mapping.receiver_fit import Placement
from mrasfm_engine.mapping.refinement import refine
from mrasfm_engine.mapping.refinement_result import Refinement, solver_options
from schemas import Gnss, GnssSample
from tests.benchmarks.sigmas import camera_errors
from tests.helpers.simulated_drive import (
    SimulatedDrive,
    make_model,
    make_simulated_drive,
    with_cameras,
    with_true_poses,
)
from tests.unit.mapping.test_placement import ARM_M, received

UNITS = 20


def lens_errors(xy: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Sum (n, 2) of what parameters of a lens model do, with an RMS of one each times its size (6,).

    Calibrations find rotations and lens models together: what is left turns no camera.
    """
    (x, y), r2 = xy.T, (xy**2).sum(1)
    tangential = [np.stack([2 * x * y, r2 + 2 * y**2], 1), np.stack([r2 + 2 * x**2, 2 * x * y], 1)]
    fields = [xy, np.stack([0 * y, y], 1), xy * r2[:, None], xy * r2[:, None] ** 2, *tangential]
    result: np.ndarray = np.sum([k * f / np.sqrt((f**2).sum(1).mean()) for k, f in zip(sizes, fields, strict=True)], 0)
    return (result - result.mean(0)).astype(np.float32)


def drive(
    seed: int,
    *,
    lens_px: float = LENS_SIGMA_PX,
    turned_px: float = ROTATION_SIGMA_PX,
    units: int = UNITS,
) -> SimulatedDrive:
    """A straight street and two cameras whose lens models and rotations are off by what calibrations leave."""
    rng = np.random.default_rng([seed, 1])
    simulated = make_simulated_drive(units=units, cameras=2, points=1500, straight=True, noise_px=0.2, seed=seed)
    focal_px = float(simulated.truth.camera_params[0, 0])

    features, sizes = [], rng.normal(size=(2, 6))
    for image, found in zip(simulated.drive.images, simulated.features, strict=True):
        xy = (found.xy_px - simulated.truth.camera_params[image.camera, 2:4]) / focal_px
        features.append(replace(found, xy_px=found.xy_px + (lens_px * lens_errors(xy, sizes[image.camera]))))
    cameras = []
    for camera in simulated.drive.manifest.rig.cameras:
        turn = se3.exp_so3(rng.normal(0, turned_px / focal_px, 3))
        x, y, z, w = camera.rig_from_cam.rotation_xyzw
        given = turn @ se3.rotation_from_quaternion(np.array([x, y, z, w]))
        rotation = se3.quaternion_from_rotation(given).tolist()
        pose = camera.rig_from_cam.model_copy(update={"rotation_xyzw": rotation})
        cameras.append(camera.model_copy(update={"rig_from_cam": pose}))
    return replace(with_cameras(simulated, cameras), features=features)


def refined(simulated: SimulatedDrive, *, free: bool = True) -> tuple[float, Refinement]:
    """Error of the logarithm of the scale, and the refinement."""
    settings = BundleAdjustmentConfig(refine_calibration=free)
    mapper = with_true_poses(
        make_model(simulated, config=EngineConfig(threads=1, bundle_adjustment=settings)),
        simulated,
        range(len(simulated.world_from_rig)),
    )
    result = refine(mapper)
    return log_scale_error(mapper, simulated), result


def log_scale_error(mapper: Mapper, simulated: SimulatedDrive) -> float:
    return float(np.log(align_similarity(mapper.state.unit_position_m, simulated.world_from_rig[:, :3, 3]).scale))


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.slow
def test_scale_is_better_known_than_by_either_and_as_well_as_is_stated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors of lens models and of rotations show in no residual."""
    drives = [drive(seed) for seed in range(24)]
    both, sigmas = [], []
    for one in drives:
        error, result = refined(one)
        assert result.calibration.free
        assert result.given_scale is not None
        both.append(error)
        sigmas.append(result.given_scale.sigma_scale)
    held = [refined(one, free=False)[0] for one in drives]
    monkeypatch.setattr(adjustment_rounds, "scale_of_given_rotations", lambda *_, **__: None)
    free = [refined(one)[0] for one in drives]
    assert 1e-4 < rms(both) < min(rms(held), rms(free))
    assert 0.5 < rms((np.array(both) / sigmas).tolist()) < 2.0


def test_cameras_are_as_certain_as_the_rotations_that_they_are_asked_to_come_to() -> None:
    """Rotations that were measured by hand say where the scale lies, and turn cameras by what they err."""
    in_sigmas = []
    for seed in range(4):
        rng = np.random.default_rng(seed)

        def turned(rig_from_cam: np.ndarray, rng: np.random.Generator = rng) -> np.ndarray:
            turn = se3.exp_so3(rng.normal(0, np.radians(0.3), (len(rig_from_cam), 3)))
            return np.asarray(se3.transform(turn @ rig_from_cam[:, :3, :3], rig_from_cam[:, :3, 3]))

        simulated = make_simulated_drive(units=UNITS, cameras=3, points=1500, given=turned, seed=seed)
        model = make_model(simulated, config=EngineConfig(threads=1))
        mapper = with_true_poses(model, simulated, range(UNITS))
        result = refine(mapper)
        assert result.given_scale is not None
        assert result.certainty is not None
        in_sigmas.append(camera_errors(mapper, simulated)[:, :3] / result.certainty.sigma_camera[:, :3])
    assert 0.4 < rms(np.ravel(in_sigmas).tolist()) < 1.5


def test_lenses_of_which_nothing_is_known_leave_all_digits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Images then say nothing of the scale, and cameras are as certain as with lenses of which hardly anything is."""
    simulated, sigmas = make_simulated_drive(units=UNITS, cameras=3, points=1000, seed=1), []
    for lens_px in (5e2, 5e5):
        monkeypatch.setattr(given_scale, "LENS_SIGMA_PX", lens_px)
        mapper = with_true_poses(make_model(simulated, config=EngineConfig(threads=1)), simulated, range(UNITS))
        certainty = refine(mapper).certainty
        assert certainty is not None
        sigmas.append(certainty.sigma_camera[:, :6])
    np.testing.assert_allclose(*sigmas, rtol=0.02)


def test_images_weigh_less_for_errors_of_lenses_and_the_residual_keeps_its_share() -> None:
    """What lens models leave is the same in image after image; in pixels the robust loss stays as it is."""
    simulated = drive(1)
    mapper = with_true_poses(make_model(simulated, config=EngineConfig(threads=1)), simulated, range(UNITS))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(adjustment_rounds, "problem_of_all_unknowns", lambda *_: None)
        unweighed = refined(simulated)[1]
    assert unweighed.sigma_factor == 1.0
    result = refine(mapper)
    assert 1.5 < result.sigma_factor < 4.0
    assert result.given_scale is not None
    assert unweighed.given_scale is not None
    assert result.given_scale.sigma == pytest.approx(unweighed.given_scale.sigma * result.sigma_factor)
    assert result.given_scale.sigma_scale == pytest.approx(unweighed.given_scale.sigma_scale)
    options = solver_options(mapper, result)
    assert options.sigma_px == pytest.approx(result.sigma_px * result.sigma_factor)
    in_px = mapper.config.bundle_adjustment.loss_scale * result.sigma_px
    assert options.loss_scale * options.sigma_px == pytest.approx(in_px)


def test_images_of_a_short_drive_weigh_less_beside_a_receiver_too() -> None:
    """Eight units tell as well as many that their observations share errors."""
    simulated = drive(1, units=8)
    mapper = with_true_poses(make_model(simulated, config=EngineConfig(threads=1)), simulated, range(8))
    result = refine(mapper, AbsolutePriors(gnss=received(simulated, 0.02), antenna_in_rig_m=ARM_M))
    assert result.georeferenced
    assert 1.2 < result.sigma_factor < 5.0
    assert 1e-5 < abs(log_scale_error(mapper, simulated)) < 1e-3


@pytest.mark.parametrize(("off_px", "least", "most"), [(0.2, 0.5, 1.001), (30.0, 0.0, 0.001)])
def test_rotations_that_images_contradict_say_nothing_of_the_scale(
    off_px: float, least: float, most: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Parts of the way to them that the scale is asked to go."""
    asked = []

    def hear(mapper: Mapper, **arguments: Any) -> ScalePrior | None:
        prior = given_scale.scale_of_given_rotations(mapper, **arguments)
        assert prior is not None
        is_asked = np.isfinite(prior.sigma)
        asked.append(1.0 - prior.log_scale / prior.log_scale_of(mapper.state) if is_asked else 0.0)
        return prior

    monkeypatch.setattr(adjustment_rounds, "scale_of_given_rotations", hear)
    error, _ = refined(drive(1, lens_px=0.0, turned_px=off_px))
    assert abs(error) < 0.02
    assert len(asked) == 1
    assert least <= asked[0] < most


@pytest.mark.parametrize(("off_px", "least", "most"), [(0.1, 0.5, 1.5), (3.0, 0.8, 1.25), (30.0, 0.8, 1.25)])
def test_a_drive_tells_how_well_rotations_are_known(off_px: float, least: float, most: float) -> None:
    """Of calibrations it is known what they err by, of rigs that were measured by hand it is not."""
    rng = np.random.default_rng(0)
    found = []
    for _ in range(200):
        moved_px = rng.normal(scale=off_px, size=(4, 3))
        found.append(given_scale._rotation_sigma_px(moved_px - moved_px.mean(axis=0), rng.normal(size=(4, 3))))
    assert least < np.median(found) / max(off_px, ROTATION_SIGMA_PX) < most


def test_given_rotations_are_asked_once_images_have_found_the_scale(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before that, derivatives are those of another scene: the scale would be pulled where nobody wants it."""
    done = []
    adjust = adjustment_rounds.adjust

    def adjusted(*values: Any, **arguments: Any) -> None:
        done.append("adjusted")
        adjust(*values, **arguments)

    def heard(mapper: Mapper, **arguments: Any) -> ScalePrior | None:
        done.append("heard")
        return given_scale.scale_of_given_rotations(mapper, **arguments)

    monkeypatch.setattr(adjustment_rounds, "adjust", adjusted)
    monkeypatch.setattr(adjustment_rounds, "scale_of_given_rotations", heard)
    refined(drive(1))
    assert done[:3] == ["adjusted", "heard", "adjusted"]
    assert done.count("heard") == 1


def test_a_scale_that_the_drive_hardly_observes_is_a_finding() -> None:
    """A straight street, with cameras mounted to a millimetre and to half a metre of their distance of a metre."""
    said = {}
    for sigma_m in (0.001, 0.5):
        simulated = make_simulated_drive(units=8, cameras=2, points=400, straight=True, noise_px=0.2)
        cameras = [c.model_copy(update={"sigma_translation_m": sigma_m}) for c in simulated.drive.cameras]
        simulated = with_cameras(simulated, cameras)
        mapper = with_true_poses(make_model(simulated), simulated, range(8))
        said[sigma_m] = [finding.code for finding in scale_findings(mapper, refine(mapper))]
    assert said == {0.001: [], 0.5: ["scale-uncertain"]}


def test_a_scale_of_which_no_sigma_is_known_is_said_to_be_uncertain() -> None:
    simulated = make_simulated_drive(units=8, cameras=2, points=600)
    mapper = with_true_poses(make_model(simulated), simulated, range(8))
    result = refine(mapper)
    assert result.certainty is not None
    result.certainty = replace(result.certainty, sigma_scale=np.inf)
    (said,) = scale_findings(mapper, result)
    assert (said.code, "not known" in said.what) == ("scale-uncertain", True)
    assert said.remedy.startswith("Give GNSS positions, or declare sigma_translation_m")
    # Drives with GNSS that is ignored, that was refused, and that is used.
    sample = GnssSample(
        timestamp_us=0, latitude_deg=49, longitude_deg=8, height_m=0, sigma_horizontal_m=1, sigma_vertical_m=1
    )
    gnss = Gnss(height_datum="ellipsoidal", antenna_in_rig_m=[0, 0, 0], samples=[sample])
    manifest = mapper.drive.manifest.model_copy(update={"gnss": gnss})
    mapper.drive = replace(mapper.drive, manifest=manifest)
    used: Any = object()
    for words, placement in (
        ("told to ignore", None),
        ("are not used; another finding says why", Placement(reason="its positions jump")),
        ("those of the drive are used", Placement(prior=used)),
    ):
        result.absolute = AbsolutePriors(placement=placement)
        (said,) = scale_findings(mapper, result)
        assert words in said.remedy
        assert not said.remedy.startswith("Give GNSS positions,")
