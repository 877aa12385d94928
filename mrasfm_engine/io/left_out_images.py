"""Findings on images that were not used, as some of their pixels are missing or corrupt."""

from __future__ import annotations

from collections.abc import Mapping

from mrasfm_engine.errors import InputError
from mrasfm_engine.scene.drive import INCOMPLETE, LeftOut
from schemas.findings import Finding, error, listed, warning

NAMED = 20  # files that a finding names; the report names all
REMEDY = "Copy them again from their source and reconstruct again."

# Images that are those before them are not among these: the preflight looks at all images for them.
CODES = frozenset(f"{reason}-images" for reason in INCOMPLETE)


def sample_findings(why: Mapping[str, LeftOut], looked_at: int) -> list[Finding]:
    """Findings about incomplete images, by file, among so many that were decoded: errors where all of them are."""
    everything = len(why) == looked_at
    return [
        (error if everything else warning)(
            f"{reason}-images",
            f"{len(files)} of {looked_at} images looked at are {reason}: {listed(files, NAMED)}",
            "Copy the drive's images again from their source."
            if everything
            else "Copy them again from their source; a reconstruction leaves them and others like them out.",
        )
        for reason, files in _by_reason(why).items()
    ]


def left_out_findings(why: Mapping[str, LeftOut], images: int) -> list[Finding]:
    """Findings about the incomplete images, by file, among so many of a reconstruction."""
    return [
        warning(
            f"{reason}-images",
            f"{len(files)} of {images} images are {reason} and left out: {listed(files, NAMED)}",
            REMEDY,
        )
        for reason, files in _by_reason(why).items()
    ]


def nothing_left(why: Mapping[str, LeftOut]) -> InputError:
    """The error where all images, by file, were left out."""
    reasons = " or ".join(_by_reason(why))
    return InputError(
        f"all {len(why)} images of the drive are {reasons}: {listed(list(why))}",
        remedy="Copy the drive's images again from their source.",
        code="no-complete-image",
    )


def _by_reason(why: Mapping[str, LeftOut]) -> dict[LeftOut, list[str]]:
    found: dict[LeftOut, list[str]] = {}
    for file, reason in why.items():
        if reason in INCOMPLETE:
            found.setdefault(reason, []).append(file)
    return found
