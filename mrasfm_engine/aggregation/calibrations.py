"""Priors on every drive's calibration in a map's last adjustment.

Each drive keeps its own extrinsics. A short drive determines them weakly, and the shape of its scene depends on them:
two scenes whose extrinsics are off by a tenth of a degree in different ways cannot both stay rigid where they share
points, and scale gives way. So extrinsics are refined with the units, only in directions that the drive's own
reconstruction observed, with that reconstruction's uncertainty as prior. Where other drives of its vehicle tell more,
what they let it expect is the prior (see `vehicles`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from mrasfm_engine.aggregation.assembly import Assembly
from mrasfm_engine.aggregation.association import component_labels
from mrasfm_engine.aggregation.vehicles import LEARNING_SHARE, Expected, Vehicle, corrected
from mrasfm_engine.bundle_adjustment.priors import CameraPosePrior, IntrinsicsPrior
from mrasfm_engine.bundle_adjustment.problem import INTRINSICS
from mrasfm_engine.config import BundleAdjustmentConfig
from mrasfm_engine.scene.state import State
from mrasfm_engine.types import Bools, Floats, Ints

NOTHING_EXPECTED: Mapping[int, Expected] = MappingProxyType({})
MAX_COUPLINGS = 500_000  # of cameras that vary with units and with one another: the solver holds some 400 bytes of each


def calibration_priors(
    assembly: Assembly,
    state: State,
    free_units: Bools,
    config: BundleAdjustmentConfig,
    expected: Mapping[int, Expected] = NOTHING_EXPECTED,
    *,
    told_lengths: Collection[int] = (),
) -> list[CameraPosePrior]:
    """Make one prior for each drive whose calibration may vary, from the uncertainty that its scenes state.

    They are the drives that have units that vary and whose scenes refined it, or of whose vehicle others did. A scene's
    certainty rests on all its units; observations of those that vary count in the adjustment anyway, so only the
    others' share is kept. That of a smaller component rests on the largest one's units, and all of it is kept. In a map
    of very many drives calibrations stay as their scenes found them, as they do where the settings hold them.

    Parameters
    ----------
    state
        With the calibrations that the scenes found.
    free_units
        Units (u,) that vary.
    expected
        What other drives of its vehicle let a scene's cameras expect, by scene.
    told_lengths
        Scenes whose length others know better (see `scenes_of_told_length`).
    """
    priors = _all_priors(assembly, free_units, config, expected, told_lengths)
    return [] if _too_many(priors, free_units) else priors


def _too_many(priors: Sequence[CameraPosePrior], free_units: Bools) -> bool:
    """Return whether the cameras of these priors and the free units (u,) are more than the solver can hold."""
    refined = sum(len(prior.camera) for prior in priors)
    return refined * (int(free_units.sum()) + refined) > MAX_COUPLINGS


def scenes_of_told_length(assembly: Assembly, owner: Ints) -> frozenset[int]:
    """Scenes whose length others tell: those that joined points connect with them and that know their own much better.

    All have positions. Baselines that a scene has not observed, held where they are, would make the others as long.

    Parameters
    ----------
    owner
        The joined point (p,) of the assembly's points, -1 for points of one scene alone.
    """
    count, joined = len(assembly.scenes), np.flatnonzero(owner >= 0)
    pairs = np.unique(np.column_stack([assembly.scene_of_point[joined], count + owner[joined]]), axis=0)
    label = component_labels(count + int(owner.max(initial=-1)) + 1, pairs.tolist())
    best: dict[int, float] = {}
    for k, scene in enumerate(assembly.scenes):
        if scene.is_placed and scene.sigma_scale is not None:
            best[label[k]] = min(best.get(label[k], np.inf), scene.sigma_scale)
    return frozenset(
        k
        for k, scene in enumerate(assembly.scenes)
        if scene.is_placed and scene.sigma_scale is not None and best[label[k]] < LEARNING_SHARE * scene.sigma_scale
    )


def _all_priors(
    assembly: Assembly,
    free_units: Bools,
    config: BundleAdjustmentConfig,
    expected: Mapping[int, Expected],
    told_lengths: Collection[int],
) -> list[CameraPosePrior]:
    """Priors as `calibration_priors` makes them, however many they are."""
    if not config.refine_calibration:
        return []
    priors = []
    for k, scene in enumerate(assembly.scenes):
        told = expected.get(k)
        if not (free_units & (assembly.scene_of_unit == k)).any() or (
            scene.certainty_of_cameras is None and told is None
        ):
            continue
        cameras = scene.drive.cameras
        given = np.column_stack(
            [
                np.radians([camera.sigma_rotation_deg or config.sigma_rotation_deg for camera in cameras]),
                [camera.sigma_translation_m or config.sigma_translation_m for camera in cameras],
            ]
        ).repeat(3, axis=1)
        sigma, observed = scene.certainty_of_cameras or (given, np.zeros(given.shape, dtype=np.bool_))
        left = _share_left(assembly, free_units, k)
        known = np.where(observed, np.minimum(sigma / np.sqrt(left), given), given)
        number = np.arange(assembly.first_camera[k], assembly.first_camera[k + 1])
        poses, held = scene.drive.rig_from_cam, ~observed
        if not scene.is_placed or k in told_lengths:
            held[:, 3:] = False  # other scenes tell its length, and thereby its baselines'
        if told is not None:
            poses, known, held = _with_expected(poses, known, held, told, left)
        priors.append(
            CameraPosePrior(
                camera=number, rotation=poses[:, :3, :3], position_m=poses[:, :3, 3], sigma=known, held=held
            )
        )
    return priors


def _with_expected(
    poses: Floats, sigma: Floats, held: Bools, told: Expected, left: float
) -> tuple[Floats, Floats, Bools]:
    """Means (c, 4, 4), sigmas (c, 6) and held directions of cameras with what the vehicle's other drives say.

    Of directions of which they say nothing, all stays.

    Parameters
    ----------
    left
        Share of the scene's units whose observations do not count in the adjustment anyway.
    """
    mean, own_sigma = _combined(told, left)
    says = np.isfinite(own_sigma[:, :6])
    return corrected(poses, mean[:, :6]), np.where(says, own_sigma[:, :6], sigma), held & ~says


def _combined(told: Expected, left: float) -> tuple[Floats, Floats]:
    """Corrections and sigmas (c, DIRECTIONS) by all images, the drive's own and the others'; infinite where these are
    silent.
    """
    says = np.isfinite(told.sigma)
    own, others = left * told.information, told.sigma**-2.0
    precision = np.where(says, own + others, 1.0)
    mean = np.where(says, (own * told.own + others * told.correction) / precision, 0.0)
    return mean, np.where(says, precision**-0.5, np.inf)


def _focal_prior(
    assembly: Assembly, state: State, free_units: Bools, cameras: Bools, expected: Mapping[int, Expected]
) -> tuple[IntrinsicsPrior, Bools]:
    """Prior of the focal lengths that other drives of a vehicle observed, and of which of the `cameras` (c,).

    The others keep what their scenes found.
    """
    params, sigma = state.camera_params.copy(), np.ones((len(state.camera_params), INTRINSICS))
    observed = np.zeros(len(params), dtype=np.bool_)
    for k, told in expected.items():
        mean, own_sigma = _combined(told, _share_left(assembly, free_units, k))
        rows = np.arange(assembly.first_camera[k], assembly.first_camera[k + 1])
        says = np.isfinite(own_sigma[:, 6]) & cameras[rows]
        params[rows[says], :2] *= np.exp(mean[says, 6:])
        sigma[rows[says], 0] = own_sigma[says, 6]
        observed[rows] = says
    return IntrinsicsPrior(params=params, sigma=sigma), observed


@dataclass(frozen=True, kw_only=True)
class MapCalibrations:
    """Calibrations in a map's last adjustment.

    Attributes
    ----------
    free_units
        (u,) units that vary: those of the map, and all of a scene whose calibration learns from other drives.
    cameras
        (c,) that vary.
    free_intrinsics
        (c, INTRINSICS) of these.
    terms
        Their priors.
    learning
        Indices of the scenes whose calibration learns from other drives.
    too_many
        The cameras and units are too many for the solver: no drive learns from others.
    """

    free_units: Bools
    cameras: Bools
    free_intrinsics: Bools
    terms: Sequence[CameraPosePrior | IntrinsicsPrior]
    learning: tuple[int, ...] = ()
    too_many: bool = False

    def with_looser_places(self) -> list[MapCalibrations]:
        """These, and where places of cameras are held the same with all of their directions varying within priors.

        Images see less of baselines that are held where they are not, the longer a scene is.
        """
        holds = any(isinstance(term, CameraPosePrior) and term.held[:, 3:].any() for term in self.terms)
        return [self, *([replace(self, terms=[_with_free_places(term) for term in self.terms])] if holds else [])]

    def as_found(self) -> MapCalibrations:
        """The same with all cameras as the scenes found them."""
        return replace(
            self,
            cameras=np.zeros_like(self.cameras),
            free_intrinsics=np.zeros_like(self.free_intrinsics),
            terms=(),
            learning=(),
        )

    def at_priors(self, state: State) -> State:
        """The state with cameras where their priors have them: from far off a prior hardly counts."""
        rotation, position_m = state.camera_rotation.copy(), state.camera_position_m.copy()
        params = state.camera_params
        for term in self.terms:
            if isinstance(term, IntrinsicsPrior):
                params = term.params
            else:
                rotation[term.camera], position_m[term.camera] = term.rotation, term.position_m
        return replace(state, camera_rotation=rotation, camera_position_m=position_m, camera_params=params)


def _with_free_places(term: CameraPosePrior | IntrinsicsPrior) -> CameraPosePrior | IntrinsicsPrior:
    if isinstance(term, IntrinsicsPrior):
        return term
    held = term.held.copy()
    held[:, 3:] = False
    return replace(term, held=held)


def map_calibrations(
    assembly: Assembly,
    state: State,
    free_units: Bools,
    vehicles: Sequence[Vehicle],
    config: BundleAdjustmentConfig,
    *,
    told_lengths: Collection[int] = (),
) -> MapCalibrations:
    """Calibrations that vary with units (u,) of a map, by what drives know themselves and of their vehicles.

    Scenes of `told_lengths` let all directions of their cameras' places vary within their priors.
    """
    expected = {k: told for vehicle in vehicles for k, told in vehicle.expected.items()}
    learning = tuple(k for k, told in expected.items() if told.learns)
    more = free_units | (assembly.registered & np.isin(assembly.scene_of_unit, learning))
    priors = _all_priors(assembly, more, config, expected, told_lengths)
    too_many = _too_many(priors, more)
    cameras = np.zeros(len(assembly.camera_kind), dtype=np.bool_)
    intrinsics = np.zeros((len(cameras), INTRINSICS), dtype=np.bool_)
    if too_many or not priors:
        more, priors = free_units, calibration_priors(assembly, state, free_units, config, told_lengths=told_lengths)
        expected, learning = {}, ()
    for prior in priors:
        cameras[prior.camera] = True
    focal, intrinsics[:, 0] = _focal_prior(assembly, state, more, cameras, expected)
    terms: list[CameraPosePrior | IntrinsicsPrior] = [*priors, *([focal] if intrinsics.any() else [])]
    return MapCalibrations(
        free_units=more,
        cameras=cameras,
        free_intrinsics=intrinsics,
        terms=terms,
        learning=learning,
        too_many=too_many,
    )


def _share_left(assembly: Assembly, free_units: Bools, k: int) -> float:
    """Share, above zero, of the units that a scene's calibration rests on that are not among the free ones (u,).

    The calibration of a smaller component is the largest one's and rests on none of the component's own units.
    """
    if assembly.scenes[k].calibration.get("from_component") is not None:
        return 1.0
    units = assembly.scene_of_unit == k
    return max(1.0 - float((free_units & units).sum() / max((assembly.registered & units).sum(), 1)), 1e-12)
