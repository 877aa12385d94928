"""What the service takes of a manifest: what a drive is shown as, and which files it consists of."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import PurePosixPath

from schemas.api.drives import FileRole
from schemas.api.problems import ProblemItem
from schemas.drive import DriveManifest
from service.errors import ServiceError

MANIFEST_NAME = "drive.json"


@dataclass(frozen=True, kw_only=True)
class ManifestFacts:
    """What creating a drive needs.

    Attributes
    ----------
    files
        Paths and roles of all files that the manifest names, by path; they can be gone through several times.
    """

    name: str
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
        422 for what a worker could not lay out as a folder, and for what a database could not hold.
    """
    roles = _roles(manifest)
    if not manifest.name.isprintable():
        raise _unusable("name", "holds control characters", "Give the drive a name that can be printed.")
    _require_storable(roles.keys())
    return ManifestFacts(
        name=manifest.name,
        cameras=len(manifest.rig.cameras),
        frames=len(manifest.frames),
        has_gnss=manifest.gnss is not None,
        files_expected=len(roles),
        # In their order an index of the database grows at its end: half a million of them take a third of the time.
        files=sorted(roles.items()),
    )


def _roles(manifest: DriveManifest) -> dict[str, FileRole]:
    """Of all files. A mask may serve several images, and is one file."""
    roles: dict[str, FileRole] = {}
    for frame in manifest.frames:
        for image in frame.images.values():
            roles[image.file] = FileRole.IMAGE
            if image.mask is not None:
                roles.setdefault(image.mask, FileRole.MASK)
    return roles


def _require_storable(paths: Iterable[str]) -> None:
    files = set(paths)
    folders = _folders(files)
    if MANIFEST_NAME not in files | folders and files.isdisjoint(folders):
        return
    for path in sorted(files):
        if path == MANIFEST_NAME:
            raise _unusable(path, "is the manifest's own name", "Give the image or mask another name.")
        above = next((str(folder) for folder in PurePosixPath(path).parents if str(folder) in files), None)
        if above is not None or path.startswith(MANIFEST_NAME + "/"):
            what = f"lies in a folder that has the name of the file {above or MANIFEST_NAME!r}"
            raise _unusable(path, what, "Give one of the two another name.")


def _folders(paths: Iterable[str]) -> set[str]:
    """All folders that files of these paths lie in, at any depth."""
    folders: set[str] = set()
    for path in paths:
        folder = path.rpartition("/")[0]
        while folder and folder not in folders:
            folders.add(folder)
            folder = folder.rpartition("/")[0]
    return folders


def _unusable(field: str, what: str, remedy: str) -> ServiceError:
    return ServiceError(
        422,
        "invalid-document",
        "The document does not follow its contract",
        f"the manifest cannot be used: {field!r} {what}",
        remedy=remedy,
        errors=[ProblemItem(field=field, detail=what)],
    )
