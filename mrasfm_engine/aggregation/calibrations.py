"""Priors on every drive's calibration in a map's last adjustment.

Each drive keeps its own extrinsics. A short drive determines them weakly, and the shape of its scene depends on them:
two scenes whose extrinsics are off by a tenth of a degree in different ways cannot both stay rigid where they share
points, and scale gives way. So extrinsics are refined with the units, only in directions that the drive's own
reconstruction observed, with that reconstruction's uncertainty as prior.
"""

from __future__ import annotations

import numpy as np

from mrasfm_engine.aggregation.assembly import Assembly
from mrasfm_engine.bundle_adjustment.priors import CameraPosePrior
from mrasfm_engine.config import BundleAdjustmentConfig
from mrasfm_engine.scene.state import State
from mrasfm_engine.types import Bools

MAX_COUPLINGS = 500_000  # of cameras that vary with units and with one another: the solver holds some 400 bytes of each


def calibration_priors(
    assembly: Assembly, state: State, free_units: Bools, config: BundleAdjustmentConfig
) -> list[CameraPosePrior]:
    """Make one prior for each drive whose calibration may vary, from the uncertainty that its scenes state.

    They are the drives whose scenes refined it and that have units that vary. A scene's certainty rests on all its
    units; observations of those that vary count in the adjustment anyway, so only the others' share is kept. In a map
    of very many drives calibrations stay as their scenes found them, as they do where the settings hold them.

    Parameters
    ----------
    state
        With the calibrations that the scenes found.
    free_units
        Units (u,) that vary.
    """
    if not config.refine_calibration:
        return []
    priors = []
    for k, scene in enumerate(assembly.scenes):
        units = assembly.scene_of_unit == k
        vary = (free_units & units).sum() / max((assembly.registered & units).sum(), 1)
        if not vary or scene.certainty_of_cameras is None:
            continue
        sigma, observed = scene.certainty_of_cameras
        cameras = scene.drive.cameras
        given = np.column_stack(
            [
                np.radians([camera.sigma_rotation_deg or config.sigma_rotation_deg for camera in cameras]),
                [camera.sigma_translation_m or config.sigma_translation_m for camera in cameras],
            ]
        ).repeat(3, axis=1)
        known = np.minimum(sigma / np.sqrt(max(1.0 - vary, 1e-12)), given)
        number = np.arange(assembly.first_camera[k], assembly.first_camera[k + 1])
        priors.append(
            CameraPosePrior(
                camera=number,
                rotation=state.camera_rotation[number],
                position_m=state.camera_position_m[number],
                sigma=np.where(observed, known, given),
                held=~observed,
            )
        )
    refined = sum(len(prior.camera) for prior in priors)
    return priors if refined * (int(free_units.sum()) + refined) <= MAX_COUPLINGS else []
