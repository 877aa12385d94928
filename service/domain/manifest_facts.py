"""Facts of a manifest that the service uses: the drive's summary, and its files."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from schemas.api.drives import FileRole
from schemas.api.problems import ProblemItem
from schemas.drive import DriveManifest
from service.errors import InvalidDocument, ServiceError


@dataclass(frozen=True, kw_only=True)
class ManifestFacts:
    """Facts for the creation of a drive.

    Attributes
    ----------
    files
        Paths and roles of all files that the manifest names, by path; they can be gone through several times.
    """

    name: str
    vehicle: str | None
    cameras: int
    frames: int
    has_gnss: bool
    files_expected: int
    files: Iterable[tuple[str, FileRole]]


def facts_of(manifest: DriveManifest) -> ManifestFacts:
    """The facts of a manifest.

    Raises
    ------
    ServiceError
        422 for what a database could not hold.
    """
    roles = _roles(manifest)
    if not manifest.name.isprintable():
        raise _unusable("name", "holds control characters", "Give the drive a name that can be printed.")
    return ManifestFacts(
        name=manifest.name,
        vehicle=manifest.vehicle,
        cameras=len(manifest.rig.cameras),
        frames=len(manifest.frames),
        has_gnss=manifest.gnss is not None,
        files_expected=len(roles),
        # In their order an index of the database grows at its end: half a million of them take a third of the time.
        files=sorted(roles.items()),
    )


def _roles(manifest: DriveManifest) -> dict[str, FileRole]:
    """Roles of all files. A mask may serve several images, and is one file."""
    roles: dict[str, FileRole] = {}
    for frame in manifest.frames:
        for image in frame.images.values():
            roles[image.file] = FileRole.IMAGE
            if image.mask is not None:
                roles.setdefault(image.mask, FileRole.MASK)
    return roles


def _unusable(field: str, what: str, remedy: str) -> ServiceError:
    return InvalidDocument(
        f"the manifest cannot be used: {field!r} {what}", remedy=remedy, errors=[ProblemItem(field=field, detail=what)]
    )
