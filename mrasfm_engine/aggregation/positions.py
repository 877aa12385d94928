"""A drive's GNSS positions in the map's frame, with the offset that all of them share."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mrasfm_engine.aggregation.source import SourceScene
from mrasfm_engine.bundle_adjustment.priors import PositionPrior
from mrasfm_engine.config import GnssConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.averaging import geometric_median
from mrasfm_engine.matching.prior_trajectory import prior_trajectory
from mrasfm_engine.scene.state import State
from mrasfm_engine.types import Floats

MIN_POSITIONS = 3
USUAL_LENGTH = 1.54  # median length of a standard normal 3-vector
ROUGH_CORRELATION = 4.0  # neighbouring rough poses share most of their error


@dataclass(frozen=True, kw_only=True)
class DrivePositions:
    """Measured positions of one drive in the map's frame, with the constant error that is taken from them."""

    measured: PositionPrior  # units as the assembly numbers them; positions and sigmas as given
    prior: PositionPrior  # with the bias taken off, and sigmas as large as what is left
    bias_m: Floats  # (3,) measured minus adjusted
    up: Floats  # (3,) at the drive's place, in the map: far from the map's origin it is not the map's z axis


def drive_positions(
    scene: SourceScene, map_from_scene: Floats, first_unit: int, config: GnssConfig
) -> DrivePositions | None:
    """The positions of a drive as a prior of its units; None where there are too few.

    Parameters
    ----------
    map_from_scene
        By positions alone (4, 4): the scene's frame is the one in which its receiver's positions are.
    """
    known = prior_trajectory(scene.drive, config, use_gnss=scene.common_world is None)
    if known.gnss is not None and known.antenna_in_rig_m is not None and known.georeference is not None:
        # The prior's frame is the scene's: both have their origin in the middle of the track.
        scene_from_track = se3.inverse(scene.ecef_from_local) @ known.georeference.ecef_from_local
        lever = np.asarray(known.antenna_in_rig_m)
        measured, sigma = known.gnss.at(
            scene.drive.timestamps_us,
            max_gap_us=round(config.max_time_gap_s * 1e6),
            way_m=se3.apply(se3.inverse(scene_from_track), _antenna_m(scene, lever)),
        )
        measured = se3.apply(map_from_scene @ scene_from_track, measured)
        step_s = float(np.median(np.diff(scene.drive.timestamps_us))) / 1e6 if len(measured) > 1 else np.inf
        correlated = max(1.0, config.correlation_time_s / max(step_s, 1e-6))
    elif known.rough_world_from_rig is not None and scene.manifest.rough_poses is not None:
        assert known.rough_world_from_local is not None
        scene_from_rough = se3.inverse(scene.ecef_from_local) @ known.rough_world_from_local
        measured = se3.apply(map_from_scene @ scene_from_rough, known.rough_world_from_rig[:, :3, 3])
        sigma = np.full(measured.shape, scene.manifest.rough_poses.sigma_translation_m)
        lever, correlated = np.zeros(3), ROUGH_CORRELATION
    else:
        return None
    units = np.flatnonzero(scene.unit_registered & np.isfinite(measured).all(axis=1))
    if len(units) < MIN_POSITIONS:
        return None
    prior = PositionPrior(
        unit=units + first_unit,
        position_m=measured[units],
        sigma_m=sigma[units] * np.sqrt(correlated),
        lever_arm_m=lever,
    )
    return DrivePositions(measured=prior, prior=prior, bias_m=np.zeros(3), up=map_from_scene[:3, 2])


def _antenna_m(scene: SourceScene, lever_arm_m: Floats) -> Floats:
    """Places (u, 3) of the antenna in the scene's frame, NaN at units that are not registered."""
    result: Floats = se3.apply(scene.world_from_rig, lever_arm_m[None])[:, 0]
    result[~scene.unit_registered] = np.nan
    return result


def with_bias(positions: DrivePositions, state: State) -> DrivePositions:
    """The positions with their constant error estimated anew from where the drive's units are."""
    given = positions.measured
    antenna = state.unit_position_m[given.unit] + state.unit_rotation[given.unit] @ given.lever_arm_m
    bias = geometric_median(given.position_m - antenna)
    whitened = np.linalg.norm((given.position_m - bias - antenna) / given.sigma_m, axis=1)
    factor = max(1.0, float(np.median(whitened)) / USUAL_LENGTH)
    prior = replace(given, position_m=given.position_m - bias, sigma_m=given.sigma_m * factor)
    return replace(positions, prior=prior, bias_m=bias)
