"""Calibrations of one vehicle over its drives: what each drive may expect of its cameras from the others.

The calibrations of a camera in the drives of one vehicle deviate from a common one by little: temperature, load, a
mount that gives way. Direction by direction (rotation about and translation along the rig's x, y, z, logarithm of the
focal length)

    common ~ N(given, sigma_given^2),  of a drive ~ N(common, deviation^2),  as its images say ~ N(of the drive, 1 / w)

with w the information of the drive's images alone: that of its scene's posterior without the prior's. A drive expects
the common pose as the others' images say, weighed by their information, within its own uncertainty and the deviation
[a random-effects model; DerSimonian and Laird, Meta-analysis in clinical trials, 1986]. Its own images are no part of
that, so that they may be added. The deviation follows from how much drives of the vehicle differ beyond their
uncertainties. A camera that differs by more than `GATE_SIGMAS` was knocked, or is another one: it neither tells the
others anything nor is told.

Drives may have found a camera with different lenses: one lets intrinsics vary, another one does not observe them. All
are compared as behind one lens, that of one of the manifests (see `lenses`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from mrasfm_engine.aggregation.lenses import Lens, turn_and_length
from mrasfm_engine.aggregation.significance import in_sigmas
from mrasfm_engine.aggregation.source import SourceScene
from mrasfm_engine.config import BundleAdjustmentConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.types import Bools, Floats
from schemas.artifacts import drive_of_scene

GATE_SIGMAS = 4.0
ROTATION, TRANSLATION, FOCAL = slice(0, 3), slice(3, 6), slice(6, 7)
DIRECTIONS = 7
# Cameras on a frame of metal: no two drives agree better than that.
LEAST_DEVIATION_RAD, LEAST_DEVIATION_M, LEAST_DEVIATION_FOCAL = np.radians(0.01), 0.001, 0.0002
# What is expected before any drives were compared; it counts as so many differences.
USUAL_DEVIATION_RAD, USUAL_DEVIATION_M, USUAL_DEVIATION_FOCAL = np.radians(0.03), 0.003, 0.0005
USUAL_COUNTS = 4.0
DEVIATIONS = 60  # of which the likeliest is taken
OUTLIER_DOF = 8.0  # of Student's t: single knocked cameras hardly widen the deviation
NOTHING_OBSERVED = 0.9  # share of the prior's sigma: as in a scene, what leaves more of it says nothing
LEARNING_SHARE = 0.5  # of a drive's own sigma: where others know that much better, all of its units vary
COMMON_STEPS = 10


@dataclass(frozen=True, kw_only=True)
class DriveCalibration:
    """Calibration of one drive as its scene found it, as corrections (c, DIRECTIONS) from a reference.

    Attributes
    ----------
    found
        Rotation vectors (rad) and translations (m) in rig axes, and logarithms of focal lengths; all behind one lens.
    by_images
        What the images alone say; NaN where they say nothing.
    information
        Of `by_images`; 0 where they say nothing.
    given, sigma_given
        The manifest's calibration and its sigma.
    """

    scene: int  # index of the scene that stands for the drive
    names: tuple[str, ...]  # of cameras
    found: Floats
    by_images: Floats
    information: Floats
    given: Floats
    sigma_given: Floats


@dataclass(frozen=True, kw_only=True)
class Expected:
    """Expectation of a drive's cameras from other drives of its vehicle, as corrections (c, DIRECTIONS) of its scene's.

    Attributes
    ----------
    correction, sigma
        Infinite sigma and zero correction where the others say nothing.
    own, information
        What the drive's own images say, likewise, and its information.
    own_sigma
        Of the scene's calibration, with the prior.
    """

    correction: Floats
    sigma: Floats
    own: Floats
    information: Floats
    own_sigma: Floats

    @property
    def learns(self) -> bool:
        """Some direction is told much better by the others than by the drive itself."""
        return bool((self.sigma < LEARNING_SHARE * self.own_sigma).any())


@dataclass(frozen=True, kw_only=True)
class Knocked:
    """A camera whose pose in one drive contradicts that in the vehicle's other drives.

    Attributes
    ----------
    scenes
        Where it does; of several, each may be the odd one.
    sigmas
        As a normal variable as unlikely.
    """

    camera: str
    scenes: tuple[int, ...]
    sigmas: float


Left = frozenset[tuple[int, str]]  # scenes and cameras that tell nothing and are told nothing


@dataclass(kw_only=True)
class Vehicle:
    """Drives of one vehicle."""

    name: str
    scenes: list[int]
    deviation_rad: float
    deviation_m: float
    deviation_focal: float  # relative
    expected: dict[int, Expected] = field(default_factory=dict)  # by scene
    knocked: list[Knocked] = field(default_factory=list)


def vehicles_of(scenes: Sequence[SourceScene], config: BundleAdjustmentConfig) -> list[Vehicle]:
    """The vehicles that several drives name, and what each drive may expect of its cameras."""
    named: dict[str, dict[str, list[int]]] = {}
    for k, scene in enumerate(scenes):
        if scene.manifest.vehicle is not None:
            named.setdefault(scene.manifest.vehicle, {}).setdefault(drive_of_scene(scene.name), []).append(k)
    return [_vehicle(name, list(drives.values()), scenes, config) for name, drives in named.items() if len(drives) > 1]


def _vehicle(
    name: str, drives: Sequence[Sequence[int]], scenes: Sequence[SourceScene], config: BundleAdjustmentConfig
) -> Vehicle:
    """One vehicle; components of a drive have one calibration, that of the first of them."""
    reference = {
        camera.name: (pose, lens)
        for k, *_ in drives
        for camera, pose, lens in zip(
            scenes[k].drive.cameras, scenes[k].drive.rig_from_cam, scenes[k].given_lenses, strict=True
        )
    }
    found = [_calibration(k, scenes[k], reference, config) for k, *_ in drives]
    deviation = np.repeat([USUAL_DEVIATION_RAD, USUAL_DEVIATION_M, USUAL_DEVIATION_FOCAL], [3, 3, 1])
    for _ in range(2):  # the common motion depends on the deviation a little
        found = _in_one_frame(found, reference, deviation)
        deviation = _deviation(found)
    vehicle = Vehicle(
        name=name,
        scenes=[k for drive in drives for k in drive],
        deviation_rad=float(deviation[0]),
        deviation_m=float(deviation[3]),
        deviation_focal=float(deviation[6]),
    )
    vehicle.knocked = [
        one
        for camera in dict.fromkeys(n for one in found for n in one.names)
        for one in _knocked(camera, found, deviation)
    ]
    left_out = frozenset((scene, one.camera) for one in vehicle.knocked for scene in one.scenes)
    for drive, one in zip(drives, found, strict=True):
        expected = _expected(one, found, deviation, left_out)
        vehicle.expected.update({k: _of_component(expected, scenes[k], scenes[one.scene]) for k in drive})
    return vehicle


def _calibration(
    k: int, scene: SourceScene, reference: Mapping[str, tuple[Floats, Lens]], config: BundleAdjustmentConfig
) -> DriveCalibration:
    cameras = scene.drive.cameras
    names = tuple(camera.name for camera in cameras)
    base, lenses = np.stack([reference[name][0] for name in names]), [reference[name][1] for name in names]
    # In the manifest's units, which of a MEI camera are others than at the axis.
    manifest_focal_px = np.array([c.params[0] for c in cameras])
    known = [None if c.sigma_focal_px is None else c.sigma_focal_px / c.params[0] for c in cameras]
    sigma_given = np.column_stack(
        [
            np.radians([camera.sigma_rotation_deg or config.sigma_rotation_deg for camera in cameras]),
            [camera.sigma_translation_m or config.sigma_translation_m for camera in cameras],
            [config.sigma_focal if sigma is None else sigma for sigma in known],
        ]
    ).repeat([3, 3, 1], axis=1)
    rig_from_cam, given_rig, shift_m = scene.drive.rig_from_cam, scene.given_rig_from_cam, _shift_by_scaling(scene)
    by_adjustment = np.column_stack(
        [corrections(rig_from_cam, base) - corrections(given_rig, base), -np.log(scene.focal_given_of_found)]
    )
    found = _behind(lenses, rig_from_cam, [Lens.from_camera(camera) for camera in cameras], base)
    given = _behind(lenses, given_rig, scene.given_lenses, base)
    for some in (by_adjustment, found):
        some[:, TRANSLATION] -= shift_m
    sigma = sigma_given.copy()
    if scene.certainty_of_cameras is not None:
        sigma[:, :6] = scene.certainty_of_cameras[0]
    may_vary = [config.intrinsics_may_vary(camera, is_single=len(cameras) == 1) for camera in cameras]
    observed = np.isfinite(scene.sigma_focal_px) & may_vary
    sigma[observed, 6] = (scene.sigma_focal_px / manifest_focal_px)[observed]
    says = sigma < NOTHING_OBSERVED * sigma_given
    information = np.where(says, sigma**-2.0 - sigma_given**-2.0, 0.0)
    without_prior = by_adjustment / (sigma_given**2 * np.where(says, information, np.inf))
    return DriveCalibration(
        scene=k,
        names=names,
        found=found,
        by_images=np.where(says, found + without_prior, np.nan),
        information=information,
        given=given,
        sigma_given=sigma_given,
    )


def _behind(references: Sequence[Lens], rig_from_cam: Floats, lenses: Sequence[Lens], base: Floats) -> Floats:
    """Corrections (c, DIRECTIONS) from `base` of cameras as they are behind reference lenses.

    What turns all of them is no turn of cameras: no image shows it.
    """
    of_lens = np.stack([turn_and_length(own, reference) for own, reference in zip(lenses, references, strict=True)])
    turn = np.einsum("cij,cj->ci", rig_from_cam[:, :3, :3], of_lens[:, :3])
    place_m = rig_from_cam[:, :3, 3] - rig_from_cam[:, :3, 3].mean(0)
    common = np.concatenate([turn.mean(0), np.zeros(3)])
    moved = corrected(rig_from_cam, np.concatenate([turn, np.zeros(turn.shape)], axis=1))
    moved = corrected(moved, -_moved_by(common, place_m)[:, :6])
    return np.column_stack([corrections(moved, base), of_lens[:, 3]])


def _shift_by_scaling(scene: SourceScene) -> Floats:
    """Common motion (3,) of a scene's cameras where the scene was scaled: about the rig's origin. No image shows it."""
    factor = scene.report.get("scale", {}).get("factor", 1.0)
    result: Floats = (1.0 - 1.0 / factor) * scene.drive.rig_from_cam[:, :3, 3].mean(0)
    return result


def _of_component(expected: Expected, component: SourceScene, first: SourceScene) -> Expected:
    """Expectation of the drive's cameras as corrections of a component's; it may be scaled by itself."""
    off = np.zeros(expected.correction.shape)
    off[:, TRANSLATION] = component.drive.rig_from_cam[:, :3, 3] - _shift_by_scaling(component)
    off[:, TRANSLATION] -= first.drive.rig_from_cam[:, :3, 3] - _shift_by_scaling(first)
    return replace(
        expected,
        correction=np.where(np.isfinite(expected.sigma), expected.correction - off, 0.0),
        own=np.where(expected.information > 0, expected.own - off, 0.0),
    )


def corrections(rig_from_cam: Floats, base: Floats) -> Floats:
    """Rotation vectors (rad) and translations (m) of cameras (c, 6) from `base` (c, 4, 4), in rig axes."""
    turn = se3.log_so3(rig_from_cam[:, :3, :3] @ np.swapaxes(base[:, :3, :3], 1, 2))
    return np.concatenate([turn, rig_from_cam[:, :3, 3] - base[:, :3, 3]], axis=1)


def corrected(rig_from_cam: Floats, correction: Floats) -> Floats:
    """Poses (c, 4, 4) of cameras after corrections (c, 6), the inverse of `corrections`."""
    turned = se3.exp_so3(correction[:, :3]) @ rig_from_cam[:, :3, :3]
    return se3.transform(turned, rig_from_cam[:, :3, 3] + correction[:, 3:])


def _in_one_frame(
    found: Sequence[DriveCalibration], reference: Mapping[str, tuple[Floats, Lens]], deviation: Floats
) -> list[DriveCalibration]:
    """The drives without motions of all cameras together against the first one: images do not show these.

    In its scene each drive's cameras have no mean correction from the given calibration. So the given ones tell the
    motion, exactly where they are the same, and else with an error that images correct.
    """
    first, result = found[0], [found[0]]
    for one in found[1:]:
        rows, others = _shared(one, first)
        if not rows:
            result.append(one)
            continue
        place_m = np.stack([reference[one.names[row]][0][:3, 3] for row in rows])
        off = (one.given[rows] - first.given[others])[:, :6]
        by_given = _common_motion(off, np.ones(off.shape), place_m, np.zeros(6), np.full(6, 1e-9))
        spread = ((off - _moved_by(by_given, place_m)[:, :6]) ** 2).mean(0) + deviation[:6] ** 2
        seen = (one.information[rows] > 0) & (first.information[others] > 0)
        off = np.where(seen, one.by_images[rows] - first.by_images[others], 0.0)[:, :6]
        variance = _variance(one.information[rows]) + _variance(first.information[others]) + 2 * deviation**2
        motion = _common_motion(off, 1.0 / variance[:, :6], place_m, by_given, len(rows) / spread)
        moved = _moved_by(motion, np.stack([reference[name][0][:3, 3] for name in one.names]))
        result.append(replace(one, found=one.found - moved, by_images=one.by_images - moved, given=one.given - moved))
    return result


def _common_motion(off: Floats, weight: Floats, place_m: Floats, prior: Floats, prior_weight: Floats) -> Floats:
    """Turn and shift (6,) that cameras at places (c, 3) have in common, robustly, near a prior."""
    design = np.zeros((len(off), 6, 6))
    design[:, :3, :3] = design[:, 3:, 3:] = np.eye(3)
    design[:, 3:, :3] = -se3.skew(place_m)
    motion = prior
    for _ in range(COMMON_STEPS):
        usual = max(float(np.median((weight * (off - design @ motion) ** 2).sum(1))), 1e-30)
        robust = weight / (1.0 + (weight * (off - design @ motion) ** 2).sum(1) / (6.0 * usual))[:, None]
        square = np.einsum("cki,ck,ckj->ij", design, robust, design) + np.diag(prior_weight)
        motion = np.linalg.solve(square, np.einsum("cki,ck,ck->i", design, robust, off) + prior_weight * prior)
    return motion


def _moved_by(motion: Floats, place_m: Floats) -> Floats:
    """Corrections (c, DIRECTIONS) of cameras at places (c, 3) by a motion of all together."""
    turn = np.tile(motion[:3], (len(place_m), 1))
    return np.concatenate([turn, motion[3:] + np.cross(turn, place_m), np.zeros((len(place_m), 1))], axis=1)


def _variance(information: Floats) -> Floats:
    return 1.0 / np.where(information > 0, information, np.inf) + np.where(information > 0, 0.0, np.inf)


def _shared(one: DriveCalibration, other: DriveCalibration) -> tuple[list[int], list[int]]:
    """Rows of the cameras that both have."""
    pairs = [(row, other.names.index(name)) for row, name in enumerate(one.names) if name in other.names]
    return [a for a, _ in pairs], [b for _, b in pairs]


def _deviation(found: Sequence[DriveCalibration]) -> Floats:
    """Standard deviations (DIRECTIONS,) of drives from the common calibration, one each for rotations, translations and
    focal lengths.

    The likeliest ones for the differences of all pairs of drives, which have heavy tails, and for what is usual.
    """
    result = np.zeros(DIRECTIONS)
    for kind, usual, least in (
        (ROTATION, USUAL_DEVIATION_RAD, LEAST_DEVIATION_RAD),
        (TRANSLATION, USUAL_DEVIATION_M, LEAST_DEVIATION_M),
        (FOCAL, USUAL_DEVIATION_FOCAL, LEAST_DEVIATION_FOCAL),
    ):
        squares, variances = np.zeros(0), np.zeros(0)
        for one, other in combinations(found, 2):
            rows, others = _shared(one, other)
            seen = (one.information[rows, kind] > 0) & (other.information[others, kind] > 0)
            off = one.by_images[rows, kind] - other.by_images[others, kind]
            variance = _variance(one.information[rows, kind]) + _variance(other.information[others, kind])
            squares = np.concatenate([squares, off[seen] ** 2])
            variances = np.concatenate([variances, variance[seen]])
        tried = np.geomspace(least, 100.0 * usual, DEVIATIONS)
        share = 1.0 / max(len(found) - 1, 1)  # of a pair: each drive is in so many
        total = variances[:, None] + 2.0 * tried**2
        tails = (OUTLIER_DOF + 1.0) * np.log1p(squares[:, None] / total / OUTLIER_DOF)
        cost = share * (np.log(total) + tails).sum(0) + USUAL_COUNTS * (np.log(tried**2) + (usual / tried) ** 2)
        result[kind] = tried[int(np.argmin(cost))]
    return result


def _told(
    one: DriveCalibration, camera: str, found: Sequence[DriveCalibration], deviation: Floats, left_out: Left
) -> tuple[Floats, Floats, Bools]:
    """Common calibration (DIRECTIONS,) of a camera by the images of other drives and the given one, its variance, and
    the directions of which the images say something.
    """
    row = one.names.index(camera)
    precision, weighted = one.sigma_given[row] ** -2.0, one.given[row] / one.sigma_given[row] ** 2
    says = np.zeros(DIRECTIONS, dtype=np.bool_)
    for other in found:
        if other.scene == one.scene or camera not in other.names or (other.scene, camera) in left_out:
            continue
        k = other.names.index(camera)
        known = other.information[k] > 0
        weight = np.where(known, 1.0 / (_variance(other.information[k]) + deviation**2), 0.0)
        precision = precision + weight
        weighted = weighted + weight * np.where(known, other.by_images[k], 0.0)
        says |= known
    return weighted / precision, 1.0 / precision, says


def _knocked(camera: str, found: Sequence[DriveCalibration], deviation: Floats) -> Iterator[Knocked]:
    """Drives in which a camera's pose is not that of the others, one after the other.

    Where leaving out any of several drives makes the others agree, each of them may be the odd one.
    """
    left_out: Left = frozenset()
    while True:
        sigmas = _contradictions(camera, found, deviation, left_out)
        odd = {scene: value for scene, value in sigmas.items() if value > GATE_SIGMAS}
        if not odd:
            return
        worst = max(odd, key=lambda scene: odd[scene])
        enough = [
            scene
            for scene in odd
            if max(_contradictions(camera, found, deviation, left_out | {(scene, camera)}).values(), default=0.0)
            <= GATE_SIGMAS
        ]
        suspects = tuple(sorted({worst, *enough}))
        yield Knocked(camera=camera, scenes=suspects, sigmas=odd[worst])
        left_out |= {(scene, camera) for scene in suspects}


def _contradictions(
    camera: str, found: Sequence[DriveCalibration], deviation: Floats, left_out: Left
) -> dict[int, float]:
    """Sigmas by scene between what a drive's images say of a camera and what the others say."""
    result = {}
    for one in found:
        if camera not in one.names or (one.scene, camera) in left_out:
            continue
        row = one.names.index(camera)
        common, variance, says = _told(one, camera, found, deviation, left_out)
        both = says & (one.information[row] > 0)
        if both.any():
            total = variance + _variance(one.information[row]) + deviation**2
            squared = float(((one.by_images[row] - common)[both] ** 2 / total[both]).sum())
            result[one.scene] = in_sigmas(squared, int(both.sum()))
    return result


def _expected(
    one: DriveCalibration,
    found: Sequence[DriveCalibration],
    deviation: Floats,
    left_out: Left,
) -> Expected:
    correction, sigma = np.zeros(one.found.shape), np.full(one.found.shape, np.inf)
    for row, camera in enumerate(one.names):
        if (one.scene, camera) in left_out:
            continue
        common, variance, says = _told(one, camera, found, deviation, left_out)
        correction[row] = np.where(says, common - one.found[row], 0.0)
        sigma[row] = np.where(says, np.sqrt(variance + deviation**2), np.inf)
    own = np.where(one.information > 0, one.by_images - one.found, 0.0)
    own_sigma = 1.0 / np.sqrt(one.information + one.sigma_given**-2.0)
    return Expected(correction=correction, sigma=sigma, own=own, information=one.information, own_sigma=own_sigma)
