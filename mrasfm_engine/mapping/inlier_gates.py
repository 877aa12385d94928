"""Reprojection errors up to which image points agree with a unit's pose, from noise, calibration and residuals.

While a unit is registered, calibration may be off by as much as its prior allows. A camera's rotation error turns the
points that it triangulated as well, so residuals show no more of it than its product with the angle by which viewing
rays turn between units. This, with the noise of observations, gives the widest gate of a camera: it grows with the
focal length in pixels. The residuals within it have a robust spread, and its chi-square limit is the gate: it narrows
by itself once the calibration has been adjusted.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import chdtri

from mrasfm_engine.errors import ReconstructionError
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.matching.simultaneous import calibration_sigmas
from mrasfm_engine.types import Floats, Ints

MISSED = 0.01  # share of right image points that a gate takes for wrong
TURN_RAD = 0.15  # of viewing rays, between units that see a point: a step of some metres past points 10 to 20 m away
CHANCE_SHARE = 0.01  # of the inliers that a pose must have, those that any pose has by chance at most
LIMIT_SIGMAS = math.sqrt(chdtri(2, MISSED))
SIGMA_PX_RANGE = (0.1, 2.0)  # below, keypoints are hardly localised; above, most are wrong
MIN_REDUNDANCY = 0.1  # of an observation's two numbers, the share that its point leaves


def widest_gates_px(mapper: Mapper) -> Floats:
    """Largest errors (c,) of right image points of every camera, if its calibration is off as its prior allows.

    Not so large that image points anywhere in the image fit by chance.
    """
    sigma_rad = calibration_sigmas(mapper.drive, mapper.config.bundle_adjustment)[0]
    focal_px = mapper.state.camera_params[:, :2].mean(1)
    by_calibration = LIMIT_SIGMAS * TURN_RAD * sigma_rad * focal_px
    by_chance = CHANCE_SHARE * mapper.config.mapping.min_pnp_inlier_ratio * mapper.image_size_px.prod(1) / math.pi
    noise = observation_gate_px(mapper)
    result: Floats = np.clip(np.hypot(noise, by_calibration), noise, np.maximum(noise, np.sqrt(by_chance)))
    return result


def observation_gate_px(mapper: Mapper) -> float:
    """Largest error of an observation of the scene: no pose is refused for errors that the scene accepts."""
    return mapper.triangulator.max_error_px


def gates_px(mapper: Mapper, errors_px: Floats, camera: Ints) -> Floats:
    """Largest errors (c,) that agree with a pose under which image points of cameras (n,) have such errors (n,)."""
    widest = widest_gates_px(mapper)
    relative = errors_px / widest[camera]
    near = relative < 1.0
    if not near.any():
        return widest
    narrowed = LIMIT_SIGMAS * robust_sigma(relative[near]) * widest
    result: Floats = np.clip(narrowed, observation_gate_px(mapper), widest)
    return result


def observation_sigma_px(mapper: Mapper) -> float:
    """Standard deviation of an image coordinate, from the median error and the redundancy of the points."""
    rows = np.flatnonzero(mapper.is_inlier)
    if not len(rows):
        raise ReconstructionError(
            "no point of the scene is left after filtering",
            remedy="Check the cameras' intrinsics, and that the images belong to them.",
            code="nothing-left",
        )
    tracks = mapper.tracks.of_keypoint[rows]
    errors = mapper.triangulator.errors_px(mapper.state, rows, mapper.state.points_m, tracks)
    points = np.count_nonzero(np.bincount(tracks))
    redundancy = max(MIN_REDUNDANCY, 1.0 - 3.0 * points / (2.0 * len(rows)))
    return float(np.clip(robust_sigma(errors) / math.sqrt(redundancy), *SIGMA_PX_RANGE))


def robust_sigma(errors: Floats) -> float:
    """Standard deviation of a coordinate, from lengths (n,) of errors in the image."""
    # The squared length of a 2D normal error has the median 2 ln 2 sigma^2.
    return float(np.median(errors) / math.sqrt(2.0 * math.log(2.0)))
