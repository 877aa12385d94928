"""The check of a drive that takes seconds and comes before hours of work."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from mrasfm_engine.errors import InputError
from mrasfm_engine.io.heights import ellipsoidal_heights
from mrasfm_engine.preflight.image_files import check_images
from mrasfm_engine.preflight.lenses import lens_findings
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.types import CountProgress
from schemas import DriveManifest
from schemas.findings import Finding, Severity, error, more_errors
from schemas.manifest_check import check_manifest, errors_first


class UnsoundDriveError(InputError):
    """The check of a drive found errors: says the first, and how many more there are.

    Parameters
    ----------
    findings
        All that the check found, errors first.
    """

    def __init__(self, findings: Sequence[Finding]) -> None:
        errors = [finding for finding in findings if finding.severity is Severity.ERROR]
        more = more_errors([finding.count for finding in errors])
        super().__init__(errors[0].what + more, remedy=errors[0].remedy, code=errors[0].code)
        self.findings = tuple(findings)


def check_drive(
    drive: Drive,
    *,
    use_gnss: bool = True,
    progress: CountProgress | None = None,
    content_sha256: Mapping[str, str] | None = None,
) -> list[Finding]:
    """List the errors and oddities of a drive, from its manifest and its files' headers.

    Parameters
    ----------
    use_gnss
        The reconstruction will use the drive's GNSS.
    progress
        Called with how many of how many files are checked.
    content_sha256
        SHA-256 of the drive's files by name, where it is known.

    Returns
    -------
    list of Finding
        Errors first. With any error the drive cannot be reconstructed.
    """
    found = check_manifest_here(drive.manifest, use_gnss=use_gnss)
    return errors_first([*found, *check_images(drive, progress, content_sha256=content_sha256)])


def check_manifest_here(manifest: DriveManifest, *, use_gnss: bool = True) -> list[Finding]:
    """List the findings of `check_manifest`, of lenses, and of GNSS heights that this machine cannot convert."""
    found = [*check_manifest(manifest, use_gnss=use_gnss), *lens_findings(manifest)]
    if use_gnss and manifest.gnss is not None:
        try:
            ellipsoidal_heights(manifest.gnss)
        except InputError as problem:
            found.insert(0, error(problem.code, problem.what, problem.remedy))
    return found


def is_sound(findings: Sequence[Finding]) -> bool:
    """Return whether no finding is an error."""
    return all(finding.severity is not Severity.ERROR for finding in findings)


def require_sound(findings: list[Finding]) -> None:
    """Raise the first error among the findings, with the number of further ones.

    Raises
    ------
    UnsoundDriveError
        If any finding is an error.
    """
    if not is_sound(findings):
        raise UnsoundDriveError(findings)
