"""The calibration that a synthetic drive's manifest gives, which need not be the true one."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.scene.drive import pose_from_matrix
from mrasfm_engine.synthetic.options import SynthOptions
from mrasfm_engine.synthetic.rigs import TrueCamera
from mrasfm_engine.types import Floats
from schemas import Camera

_TIGHT_DEG, _TIGHT_M = 0.01, 0.001


def _direction(rng: np.random.Generator) -> Floats:
    v = rng.normal(size=3)
    return v / float(np.linalg.norm(v))


def given_cameras(options: SynthOptions, cameras: list[TrueCamera], rng: np.random.Generator) -> list[Camera]:
    """The manifest's cameras: rotations and translations off by the asked norms in random directions.

    Sigmas, where they are declared, are per axis: the norm divided by the square root of 3.
    """
    rotation_sigma = translation_sigma = None
    if options.tight:
        rotation_sigma, translation_sigma = _TIGHT_DEG, _TIGHT_M
    elif options.declare_sigmas:
        rotation_sigma = max(_TIGHT_DEG, options.perturb_rotation_deg / np.sqrt(3))
        translation_sigma = max(_TIGHT_M, options.perturb_translation_m / np.sqrt(3))
    result = []
    for camera in cameras:
        rotation = np.radians(options.perturb_rotation_deg) * _direction(rng)
        translation = options.perturb_translation_m * _direction(rng)
        given = camera.rig_from_cam.copy()
        given[:3, :3] = given[:3, :3] @ se3.exp_so3(rotation)
        given[:3, 3] += translation
        wrong = np.radians(options.miscalibrated_by_deg) * _direction(rng)
        if camera.name == options.miscalibrated_camera:
            given[:3, :3] = given[:3, :3] @ se3.exp_so3(wrong)
        result.append(
            Camera(
                name=camera.name,
                model=camera.model,
                width=camera.width,
                height=camera.height,
                params=list(camera.params),
                rig_from_cam=pose_from_matrix(given),
                sigma_rotation_deg=rotation_sigma,
                sigma_translation_m=translation_sigma,
                sigma_focal_px=None,
                readout_us=round(options.readout_ms * 1000) or None,
            )
        )
    return result
