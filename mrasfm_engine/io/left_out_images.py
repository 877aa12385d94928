"""Findings on images that are not used: some of their pixels are missing or corrupt, or they are the one before."""

from __future__ import annotations

from collections.abc import Mapping

from mrasfm_engine.errors import InputError
from mrasfm_engine.scene.drive import LeftOut
from schemas.findings import Finding, error, listed, warning

NAMED = 20  # files that a finding names; the report names all
REPEATED_REMEDY = (
    "Record again where poses are missing: a reconstruction leaves such images out, as they show where the vehicle was "
    "before. The camera, or what records it, repeats its last image when it gets no new one."
)
_REMEDIES = dict.fromkeys(LeftOut, "Copy them again from their source and reconstruct again.") | {
    LeftOut.REPEATED: REPEATED_REMEDY
}
_STATES = {reason: str(reason) for reason in LeftOut} | {LeftOut.REPEATED: "copies of the one before them"}

CODES = frozenset(f"{reason}-images" for reason in LeftOut)


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
    """Findings about the images, by file, that a reconstruction of so many left out."""
    return [
        warning(
            f"{reason}-images",
            f"{len(files)} of {images} images are {_STATES[reason]} and left out: {listed(files, NAMED)}",
            _REMEDIES[reason],
        )
        for reason, files in _by_reason(why).items()
    ]


def nothing_left(why: Mapping[str, LeftOut]) -> InputError:
    """The error where all images, by file, were left out."""
    reasons = " or ".join(_STATES[reason] for reason in _by_reason(why))
    return InputError(
        f"all {len(why)} images of the drive are {reasons}: {listed(list(why))}",
        remedy="Copy the drive's images again from their source.",
        code="no-complete-image",
    )


def _by_reason(why: Mapping[str, LeftOut]) -> dict[LeftOut, list[str]]:
    found: dict[LeftOut, list[str]] = {}
    for file, reason in why.items():
        found.setdefault(reason, []).append(file)
    return found
