"""Findings on what the refinement could not finish: weights that go on changing, and sigmas of too many unknowns."""

from __future__ import annotations

from mrasfm_engine.bundle_adjustment.marginal_covariances import MAX_UNKNOWNS_FOR_COVARIANCE
from mrasfm_engine.bundle_adjustment.problem import UNIT_DOF
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.refinement_result import Refinement
from schemas.findings import Finding, warning

MOST_UNITS = 9 * MAX_UNKNOWNS_FOR_COVARIANCE // (10 * UNIT_DOF)  # and room for the cameras


def unfinished_findings(mapper: Mapper, refinement: Refinement) -> list[Finding]:
    """Warn of a scene that is less than its report lets one expect."""
    findings = []
    if not refinement.is_steady:
        findings.append(
            warning(
                "refinement-unsteady",
                f"{len(refinement.adjustments)} adjustments have not settled how much positions weigh and when cameras "
                "took their images: poses may be off by more than their sigmas",
                "See gnss in report.json, and time_offset_us in calibration.json: declare sigmas that cover the errors "
                "of positions, and the times of cameras.",
            )
        )
    settings = mapper.config.bundle_adjustment
    if refinement.certainty is None and settings.priors and settings.camera_set_adjustment:
        findings.append(
            warning(
                "sigmas-unknown",
                f"{int(mapper.registered.sum())} units are too many for their covariance: poses and cameras have no "
                "sigmas, intrinsics stay as given, and a wrong size of the scene is not looked for",
                f"Cut the drive into several of at most {MOST_UNITS} units, and aggregate them.",
            )
        )
    return findings
