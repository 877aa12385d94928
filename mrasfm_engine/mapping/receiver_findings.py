"""Findings on a receiver: why it is not used, jumps of its error, and a rig whose scale it contradicts.

Rough poses may contradict that, too, or the scene's shape.
"""

from __future__ import annotations

import numpy as np

from mrasfm_engine.mapping.calibration import scale_of_baselines
from mrasfm_engine.mapping.georeferencing import rigid_motions
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.receiver_fit import Placement, antenna_places_m
from mrasfm_engine.mapping.receiver_jumps import AROUND
from mrasfm_engine.types import Floats
from schemas.findings import Finding, error, warning

MAX_SCALE_DISAGREEMENT = 0.05  # rigs are better known, whatever the default prior says; and as many of the receiver's
SCALE_DISAGREEMENT_SIGMAS = 3.0


def refusal_findings(placement: Placement) -> list[Finding]:
    """The finding that the receiver's positions take no part, and why.

    Where they contradict the rig's lengths alone, one of both is wrong, and the scene has the rig's: an error.
    """
    if placement.prior is not None or not placement.reason:
        return []
    what = f"positions of the receiver are not used, and the scene is not georeferenced: {placement.reason}"
    if placement.is_of_another_scale:
        remedy = (
            "Check the units of rig.cameras (metres) and of gnss.samples (degrees, metres): all lengths of the scene "
            "are those of the rig, and as wrong as it is."
        )
        return [error("gnss-contradicts-rig", what, remedy)]
    usual = "Check gnss.samples: their clock, the order of latitude and longitude, and the stated sigmas."
    return [warning("gnss-not-used", what, placement.remedy or usual)]


def jump_findings(mapper: Mapper, placement: Placement) -> list[Finding]:
    """The finding that the receiver's error jumps, with where it does so most."""
    if not len(placement.jumps):
        return []
    good = np.flatnonzero(placement.inlier)
    at = np.searchsorted(placement.units[good], placement.jumps)
    off_m = placement.off_m[good]
    sizes_m = [_step_m(off_m, k) for k in at.tolist()]
    largest = int(np.argmax(sizes_m))
    times_us = mapper.drive.timestamps_us[placement.jumps]
    return [
        warning(
            "gnss-error-jumps",
            f"positions of the receiver jump by about {sizes_m[largest]:.1f} m at {times_us[largest]} us and stay there"
            + (f"; there are {len(times_us)} such places" if len(times_us) > 1 else ""),
            "Nothing needs to be done: errors before and after it are taken as independent. Receivers that lose their "
            "fix do this; where the scene lies is less certain.",
        )
    ]


def outlier_findings(placement: Placement) -> list[Finding]:
    """The finding that most positions contradict the scene, which lies where the few others say."""
    judged = placement.inlier[~np.isin(placement.units, placement.blended)]
    used = int(judged.sum())
    if placement.prior is None or 2 * used >= len(judged):
        return []
    return [
        warning(
            "gnss-mostly-outliers",
            f"{len(judged) - used} of {len(judged)} positions of the receiver contradict the scene, which lies where "
            f"the other {used} say",
            "Scene or receiver are wrong, and the sigmas hold for neither: look at the units without a pose and at the "
            "path in report.html, check gnss.samples, or compare with a run that ignores GNSS.",
        )
    ]


def _step_m(off_m: Floats, k: int) -> float:
    """Distance between the residuals (n, 3) before sample k and those from it on."""
    before, after = off_m[max(0, k - AROUND) : k], off_m[k : k + AROUND]
    return float(np.linalg.norm(np.median(after, axis=0) - np.median(before, axis=0))) if 0 < k < len(off_m) else 0.0


def rig_scale_findings(mapper: Mapper, placement: Placement) -> list[Finding]:
    """The finding that the receiver contradicts the rig's scale."""
    if not contradicts_rig(mapper, placement, placement.scale_of_rig):
        return []
    return [
        warning(
            "scale-disagreement",
            f"GNSS makes {_length_beside_rig(mapper, placement.scale_of_rig)}",
            "Check the baselines in rig.cameras (metres), gnss.antenna_in_rig_m (too far aside it makes a turn longer "
            "or shorter), and the receiver's positions (are latitude and longitude swapped?). "
            "Declare sigma_translation_m of the cameras.",
        )
    ]


def rough_scale_findings(mapper: Mapper, scale_of_rig: float | None) -> list[Finding]:
    """The finding that rough poses contradict the rig's scale, where they do; see `Refinement.scale_of_rough_poses`."""
    if scale_of_rig is None:
        return []
    return [
        warning(
            "scale-disagreement",
            f"rough_poses make {_length_beside_rig(mapper, scale_of_rig)}: the scene has their scale",
            "Check that positions in rough_poses and baselines in rig.cameras are metres, and declare "
            "sigma_translation_m of both. Leave poses out that have no metric scale.",
        )
    ]


def rough_shape_findings(fault: str) -> list[Finding]:
    """The finding that rough poses do not have the shape of the scene, where they do not; see `shape_fault`."""
    if not fault:
        return []
    return [
        warning(
            "rough-poses-contradict",
            f"rough_poses are not used, as they do not have the shape of the trajectory: {fault}",
            "Give world_from_rig, not its inverse, of the rig and not of another body, in rig.body_axes, at the "
            "images' times; declare the sigmas that poses and rotations have.",
        )
    ]


def contradicts_rig(mapper: Mapper, placement: Placement, scale_of_rig: float) -> bool:
    """Return whether positions give the rig's lengths as given another scale, beyond what they leave open of it."""
    positions = placement.prior
    assert positions is not None
    antenna_m = antenna_places_m(mapper, positions.unit, positions.lever_arm_m)
    centred_m = antenna_m - antenna_m.mean(0)
    known = positions.information_given(centred_m, rigid_motions(centred_m))
    sigma = 1.0 / np.sqrt(max(known, 1e-12))
    return bool(abs(scale_of_rig - 1.0) > max(MAX_SCALE_DISAGREEMENT, SCALE_DISAGREEMENT_SIGMAS * sigma))


def _length_beside_rig(mapper: Mapper, scale_of_rig: float) -> str:
    return (
        f"the way {scale_of_rig:.3g} times as long as the rig as given does, whose baselines are taken to be known to "
        f"{scale_of_baselines(mapper)[1]:.1%}"
    )
