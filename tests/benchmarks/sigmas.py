"""Line 19: stated sigmas, of halves of real drives against one another and of simulated drives against the truth."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mrasfm_engine.config import BundleAdjustmentConfig, EngineConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.alignment import align_similarity
from mrasfm_engine.geometry.gnss_track import GnssTrack
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.calibration import calibration_prior
from mrasfm_engine.mapping.components import map_drive
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.refinement import refine
from mrasfm_engine.mapping.refinement_result import Refinement
from mrasfm_engine.scene.drive import matrix_from_pose
from mrasfm_engine.scene.row_bands import RowBands
from mrasfm_engine.triangulation.tracks import Keypoints
from schemas import Pose
from tests.benchmarks.commands import mrasfm
from tests.benchmarks.real_drives import DRIVES, imported
from tests.benchmarks.table import Figure
from tests.benchmarks.true_information import SIGMA_PX, ExactScene, camera_information
from tests.helpers.simulated_drive import SimulatedDrive, make_simulated_drive, true_matches, with_lens_errors

LEAST_RMS, MOST_RMS = 0.5, 1.5  # of halves
MANY_CAMERAS, LEAST_DIRECTIONS = 6, 6

SIMULATED, UNITS, POINTS, NOISE_PX = 50, 24, 2500, 0.7
CAMERAS = (6, 2)  # in turn
SIMULATED_WITH_WRONG_LENSES = 20
SIMULATED_WITHOUT_GNSS, UNITS_WITHOUT_GNSS, CAMERAS_WITHOUT_GNSS = 20, 20, (6, 3)
LENSES_OFF_PX = 0.2  # RMS over an image of what each of the eight parameters of a lens is off by
OFF_DEG, OFF_M = 0.3, 0.02  # what the calibration is off by and declared to be, for each axis
GNSS_M = np.array([0.3, 0.3, 0.45])
ANTENNA_M = np.array([-0.5, 0.2, 1.5])
LEAST_SIMULATED, MOST_SIMULATED = 0.7, 1.4
MOST_OF_EXACT = 1.5
GAUGE_INFORMATION = 1e9


def halves(data: Path, work: Path) -> Iterator[Figure]:
    """Line 19a: the calibrations that odd and even units of a drive find agree within their sigmas."""
    for real in DRIVES:
        drive = imported(data, real.name, work, *real.options)
        found = [
            _calibration(_half(drive, which, work), work / f"{real.name}, half {which}, scene") for which in (0, 1)
        ]
        settings, manifest = BundleAdjustmentConfig(), json.loads((drive / "drive.json").read_text(encoding="utf-8"))
        in_sigmas = []
        for camera in manifest["rig"]["cameras"]:
            (pose_a, sigma_a), (pose_b, sigma_b) = (of[camera["name"]] for of in found)
            turn = se3.log_so3(pose_a[:3, :3] @ pose_b[:3, :3].T)
            off = np.concatenate([np.degrees(turn), pose_a[:3, 3] - pose_b[:3, 3]])
            prior = np.repeat(
                [
                    camera.get("sigma_rotation_deg") or settings.sigma_rotation_deg,
                    camera.get("sigma_translation_m") or settings.sigma_translation_m,
                ],
                3,
            )
            known = np.maximum(sigma_a, sigma_b) < 0.5 * prior
            in_sigmas += (off / np.hypot(sigma_a, sigma_b))[known].tolist()
        many = len(manifest["rig"]["cameras"]) >= MANY_CAMERAS
        yield Figure(
            line="19a",
            what=f"{real.name}: directions known to half of their prior",
            value=len(in_sigmas),
            above=LEAST_DIRECTIONS - 1 if many else 0,
            most=6 * len(manifest["rig"]["cameras"]),
        )
        yield Figure(
            line="19a",
            what=f"{real.name}: differences of the halves over their sigmas, RMS",
            value=_rms(np.array(in_sigmas)),
            above=LEAST_RMS,
            most=MOST_RMS,
        )


def _half(drive: Path, which: int, work: Path) -> Path:
    """The drive with every other unit."""
    half = work / f"{drive.name}, half {which}"
    shutil.copytree(drive, half, copy_function=os.link)
    manifest = json.loads((drive / "drive.json").read_text(encoding="utf-8"))
    manifest["frames"] = manifest["frames"][which::2]
    (half / "drive.json").unlink()  # a link to the whole drive's
    (half / "drive.json").write_text(json.dumps(manifest), encoding="utf-8")
    return half


def _calibration(drive: Path, scene: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Refined `rig_from_cam` (4, 4) of each camera with its repeatability (6,) in degrees and metres.

    Halves have the same lenses, whose errors are in the sigmas and not in the differences. A half that estimates them
    has no repeatability, and its sigmas are what it knows.
    """
    mrasfm("reconstruct", drive, "--out", scene)
    cameras: dict[str, Any] = json.loads((scene / "calibration.json").read_text(encoding="utf-8"))["cameras"]
    found = {}
    for name, camera in cameras.items():
        stated = camera.get("repeatability") or camera["sigma"]
        sigma = np.concatenate([stated["rotation_deg"], stated["translation_m"]])
        found[name] = (matrix_from_pose(Pose(**camera["refined"]["rig_from_cam"])), sigma)
    return found


def without_positions(data: Path, work: Path) -> Iterator[Figure]:
    """Line 19c: calibrations of short simulated drives without GNSS, whose given rotations tell the scale as well."""
    del data, work  # there are no files
    number = CAMERAS_WITHOUT_GNSS
    drives = (_drive(seed, number[seed % len(number)], UNITS_WITHOUT_GNSS) for seed in range(SIMULATED_WITHOUT_GNSS))
    yield from _errors_of_cameras(
        "19c", f"{SIMULATED_WITHOUT_GNSS} simulated drives without GNSS", drives, with_gnss=False
    )


def with_wrong_lenses(data: Path, work: Path) -> Iterator[Figure]:
    """Line 19d: calibrations of simulated drives whose lens models are off, with and without GNSS."""
    del data, work  # there are no files
    for with_gnss, gnss in ((True, "with GNSS"), (False, "without GNSS")):
        title = f"{SIMULATED_WITH_WRONG_LENSES} simulated drives with lenses off, {gnss}"
        yield from _errors_of_cameras("19d", title, _drives_with_wrong_lenses(), with_gnss=with_gnss)


def _drives_with_wrong_lenses() -> Iterator[tuple[SimulatedDrive, np.random.Generator]]:
    for seed in range(SIMULATED_WITH_WRONG_LENSES):
        drive, rng = _drive(seed, CAMERAS[seed % len(CAMERAS)], UNITS)
        yield with_lens_errors(drive, LENSES_OFF_PX, seed=seed), rng


def _errors_of_cameras(
    line: str, title: str, drives: Iterator[tuple[SimulatedDrive, np.random.Generator]], *, with_gnss: bool
) -> Iterator[Figure]:
    """Errors of all cameras' rotations and of their translations over their sigmas."""
    found = []
    for drive, rng in drives:
        mapper, refinement = _adjusted(drive, rng, with_gnss=with_gnss)
        found.append((camera_errors(mapper, drive) / _stated_sigmas(refinement)).reshape(-1, 2, 3))
    for k, what in enumerate(("rotations", "translations")):
        yield _rms_in_sigmas(line, f"{title}: {what}", [one[:, k] for one in found])


def _stated_sigmas(refinement: Refinement) -> np.ndarray:
    """Sigmas (c, 6) of the cameras' rotations (rad) and positions (m) as a scene states them."""
    assert refinement.certainty is not None
    assert refinement.systematic is not None
    return refinement.systematic.sigma_camera(refinement.certainty.sigma_camera[:, :6])


def _rms_in_sigmas(line: str, title: str, errors: list[np.ndarray]) -> Figure:
    """Errors over their sigmas of all simulated drives together."""
    values = np.concatenate([np.ravel(one) for one in errors])
    return Figure(
        line=line,
        what=f"{title}, errors over their sigmas, RMS",
        value=_rms(values),
        above=LEAST_SIMULATED,
        most=MOST_SIMULATED,
    )


@dataclass(frozen=True, kw_only=True)
class InSigmas:
    """Errors of one simulated drive over their stated sigmas, and sigmas of cameras over the exact ones.

    The exact ones know the lenses, as repeatability does; what is stated also has what lenses may be off by.
    """

    scale: float
    positions: np.ndarray
    rotations: np.ndarray
    translations: np.ndarray
    repeatability_of_exact: float
    stated_of_exact: float


def simulated(data: Path, work: Path) -> Iterator[Figure]:
    """Line 19b: errors over sigmas on simulated drives with GNSS, whose calibration is off as it is declared."""
    del data, work  # there are no files
    found = [_in_sigmas(seed, CAMERAS[seed % len(CAMERAS)]) for seed in range(SIMULATED)]
    for what in ("scale", "positions", "rotations", "translations"):
        yield _rms_in_sigmas("19b", f"{SIMULATED} simulated drives: {what}", [getattr(one, what) for one in found])
    yield Figure(
        line="19b",
        what=f"{SIMULATED} simulated drives: repeatability of cameras over that of the exact geometry, worst drive",
        value=max(one.repeatability_of_exact for one in found),
        most=MOST_OF_EXACT,
    )
    yield Figure(
        line="19b",
        what=f"{SIMULATED} simulated drives: sigmas of cameras over those of the exact geometry, RMS",
        value=_rms(np.array([one.stated_of_exact for one in found])),
        most=MOST_OF_EXACT,
    )
    yield Figure(
        line="19b",
        what=f"{SIMULATED} simulated drives: sigmas of cameras over those of the exact geometry, worst drive",
        value=max(one.stated_of_exact for one in found),
    )


def _in_sigmas(seed: int, cameras: int) -> InSigmas:
    drive, rng = _drive(seed, cameras, UNITS)
    mapper, refinement = _adjusted(drive, rng, with_gnss=True)
    certainty, state = refinement.certainty, mapper.state
    assert certainty is not None
    truth_m = drive.world_from_rig[:, :3, 3]
    scale = align_similarity(state.unit_position_m, truth_m).scale
    sigma, exact = _stated_sigmas(refinement), _exact_sigmas(mapper, drive)
    off = camera_errors(mapper, drive) / sigma
    return InSigmas(
        scale=float(np.log(scale)) / certainty.sigma_scale,
        positions=(state.unit_position_m - truth_m) / certainty.sigma_unit_position_m,
        rotations=off[:, :3],
        translations=off[:, 3:],
        repeatability_of_exact=_rms(certainty.sigma_camera[:, :6] / exact),
        stated_of_exact=_rms(sigma / exact),
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _drive(seed: int, cameras: int, units: int) -> tuple[SimulatedDrive, np.random.Generator]:
    """A drive whose calibration is off as it is declared, and the generator of what else is random about it."""
    rng = np.random.default_rng(seed)
    given = lambda rig: _moved(rig, rng)  # noqa: E731
    drive = make_simulated_drive(
        units=units, cameras=cameras, points=POINTS, noise_px=NOISE_PX, given=given, seed=seed
    )  # fmt: skip
    return drive, rng


def _moved(rig_from_cam: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    turn = se3.exp_so3(rng.normal(0, np.radians(OFF_DEG), (len(rig_from_cam), 3)))
    place = rig_from_cam[:, :3, 3] + rng.normal(0, OFF_M, (len(rig_from_cam), 3))
    return np.asarray(se3.transform(turn @ rig_from_cam[:, :3, :3], place))


def _adjusted(drive: SimulatedDrive, rng: np.random.Generator, *, with_gnss: bool) -> tuple[Mapper, Refinement]:
    settings = BundleAdjustmentConfig(sigma_rotation_deg=OFF_DEG, sigma_translation_m=OFF_M)
    bands = RowBands.from_drive(drive.drive, compensate=True)
    keypoints = Keypoints.from_features(drive.drive, drive.features, bands)
    track = _track(drive, rng) if with_gnss else None
    mapper = map_drive(
        drive.drive,
        keypoints,
        true_matches(drive),
        None,
        EngineConfig(bundle_adjustment=settings),
        absolute=AbsolutePriors(gnss=track, antenna_in_rig_m=ANTENNA_M),
    )[0].mapper
    return mapper, refine(mapper, AbsolutePriors(gnss=track, antenna_in_rig_m=ANTENNA_M))


def _track(drive: SimulatedDrive, rng: np.random.Generator) -> GnssTrack:
    antenna_m = se3.apply(drive.world_from_rig, ANTENNA_M[None])[:, 0]
    return GnssTrack(
        timestamps_us=drive.drive.timestamps_us,
        position_m=antenna_m + rng.normal(size=antenna_m.shape) * GNSS_M,
        sigma_m=np.tile(GNSS_M, (len(antenna_m), 1)),
        good=np.ones(len(antenna_m), dtype=np.bool_),
    )


def camera_errors(mapper: Mapper, drive: SimulatedDrive) -> np.ndarray:
    """Errors (c, 6) of the cameras' rotations (rad) and positions, without a motion that all have in common."""
    prior, true = calibration_prior(mapper), drive.truth.rig_from_cam
    assert prior.gauge_weights is not None
    weights = prior.gauge_weights / prior.gauge_weights.sum()
    common = se3.exp_so3(-weights @ se3.log_so3(true[:, :3, :3] @ np.swapaxes(prior.rotation, 1, 2)))
    as_held = replace(
        mapper.state, camera_rotation=common @ true[:, :3, :3], camera_position_m=true[:, :3, 3] @ common.T
    )
    off = prior.corrections(mapper.state) - prior.corrections(as_held)
    result: np.ndarray = off - weights @ off
    return result


def _exact_sigmas(mapper: Mapper, drive: SimulatedDrive) -> np.ndarray:
    """Sigmas (c, 6) of the cameras' poses by the exact geometry of all observations, and the priors."""
    truth = drive.truth
    scene = ExactScene(
        world_from_rig=truth.world_from_rig,
        rig_from_cam=truth.rig_from_cam,
        focal_px=truth.camera_params[:, :2],
        centre_px=truth.camera_params[:, 2:],
        unit=truth.unit,
        camera=truth.camera,
        point=truth.point,
        xy_px=truth.xy_px,
    )
    worse = NOISE_PX / SIGMA_PX
    information = camera_information(scene, ANTENNA_M, GNSS_M / worse) / worse**2
    sigma = np.tile(np.repeat([np.radians(OFF_DEG), OFF_M], 3), len(truth.rig_from_cam))
    mean = np.tile(np.eye(6), (1, len(truth.rig_from_cam))) / sigma
    posterior = np.linalg.inv(information + np.diag(sigma**-2) + GAUGE_INFORMATION * mean.T @ mean)
    result: np.ndarray = np.sqrt(np.diagonal(calibration_prior(mapper).without_gauge(posterior))).reshape(-1, 6)
    return result
