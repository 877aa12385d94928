"""Names of a drive's files: a folder on any system can hold them all, each as a file of its own."""

from __future__ import annotations

import unicodedata
from collections.abc import Collection, Iterator

MANIFEST_NAME = "drive.json"
TRUTH_NAME = "truth.tum"  # true poses, beside the manifest
UPLOAD_RECORD_NAME = ".mrasfm-upload.json"  # state of an upload of the drive, beside the manifest
_BESIDE_MANIFEST = frozenset(
    {
        UPLOAD_RECORD_NAME,
        TRUTH_NAME,
        "truth_calibration.json",
        "truth_cameras.json",
        "truth_moving",
        "truth_own_car",
        "truth_world.json",
    }
)  # files and folders that imports, renderings and uploads leave in a drive's folder

_LEFT_BY_SYSTEMS = frozenset({".DS_Store", "Thumbs.db", "desktop.ini"})
_FOLDER_OF_MACOS = "__MACOSX"


def is_ignored(path: str) -> bool:
    """Return whether an operating system or its file manager put the file there, and nobody misses it."""
    parts = path.split("/")
    return _FOLDER_OF_MACOS in parts or parts[-1] in _LEFT_BY_SYSTEMS or parts[-1].startswith("._")


def is_beside_manifest(path: str) -> bool:
    """Return whether a path in a drive's folder is a true value of an import or rendering, or an upload's record."""
    return path.partition("/")[0] in _BESIDE_MANIFEST


def composed(path: str) -> str:
    """The path with every character in one piece (NFC): macOS writes 'ü' as two."""
    return path if path.isascii() else unicodedata.normalize("NFC", path)


def portable_key(path: str) -> str:
    """The same for all paths that some system takes for one file: they differ in case or composition alone."""
    key = composed(composed(path).casefold())
    return path if key == path else key  # the same object: manifests have half a million


def name_problems(paths: Collection[str]) -> Iterator[tuple[str, str]]:
    """Paths that cannot lie in one folder with the others and the manifest, and what is wrong with each.

    Parameters
    ----------
    paths
        Of a drive's files, each once.
    """
    files = {portable_key(path) for path in paths}
    if len(files) == len(paths) and MANIFEST_NAME not in files and not _any_is_a_folder(files):
        return
    first: dict[str, str] = {}
    for path in sorted(paths):
        key = portable_key(path)
        other = first.setdefault(key, path)
        if key == MANIFEST_NAME:
            yield path, "is the manifest's own name: give the image or mask another one"
        elif other is not path:
            yield path, f"is one file with {_told_apart(other, path)} on many systems: {_RENAME}"
    first.setdefault(MANIFEST_NAME, MANIFEST_NAME)
    for path in sorted(paths):
        above = next((folder for folder in _above(portable_key(path)) if folder in first), None)
        if above is not None:
            yield path, f"lies in a folder that has the name of the file {first[above]!r}: {_RENAME}"


_RENAME = "give one of the two a name that differs in more than case and composition of characters"


def _told_apart(path: str, other: str) -> str:
    """A path as text; where the other one looks the same, with what is different about it."""
    return ascii(path) if composed(path) == composed(other) else repr(path)


def _any_is_a_folder(files: Collection[str]) -> bool:
    """Return whether one of these paths, or the manifest's, is a folder of another.

    Only the innermost folders are kept: all of them together may take a hundred times the memory of the paths.
    """
    innermost = {path.rpartition("/")[0] for path in files} - {""}
    return any(folder in files or folder == MANIFEST_NAME for path in innermost for folder in (path, *_above(path)))


def _above(path: str) -> Iterator[str]:
    """The folders around a file, the innermost first."""
    folder = path.rpartition("/")[0]
    while folder:
        yield folder
        folder = folder.rpartition("/")[0]
