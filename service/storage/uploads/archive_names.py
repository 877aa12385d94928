"""Names of archive entries: which are safe, which are ignored, and which file of the drive each one is."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence

from schemas.file_names import MANIFEST_NAME, composed, is_beside_manifest, portable_key
from service.errors import EmptyArchive, ServiceError, UnexpectedFile, UnsafeArchive
from service.storage.uploads.archive_errors import shown

_MAX_NAME_BYTES = 1024  # the manifest's paths have up to 512 characters, and a top folder may come before them
_SHOWN_NAMES = 5
_DRIVE_LETTER = re.compile(r"[A-Za-z]:")


def safe_name(raw: bytes, *, is_folder: bool = False) -> str:
    """An entry's path, without './' before and '/' behind it; empty for the archive's own top folder.

    Raises
    ------
    ServiceError
        422 `unsafe-archive`, if the name could mean a place outside the drive, or not the same on every system.
    """
    if not raw:
        raise UnsafeArchive(
            "an entry of the archive has an empty name", remedy="Make the archive again with another tool."
        )
    if len(raw) > _MAX_NAME_BYTES:
        raise _unsafe(raw, f"has a name of {len(raw)} bytes, the bound is {_MAX_NAME_BYTES}", "Give it a shorter name.")
    try:
        name = raw.decode("utf-8")
    except UnicodeDecodeError:
        remedy = "Make the archive with UTF-8 names (7-Zip: -mcu=on), or rename the file."
        raise _unsafe(raw, "has a name that is not UTF-8", remedy) from None
    problem = _problem(name)
    if problem is not None:
        raise _unsafe(raw, problem, "Make the archive from inside the drive's folder, with relative names.")
    name = name.removeprefix("./") if name != "." else ""
    if is_folder:
        name = name.removesuffix("/")
    parts = name.split("/")
    if (name or not is_folder) and not all(part not in ("", ".") for part in parts):
        raise _unsafe(raw, "has an empty part or '.' in its path", "Make the archive again with plain relative names.")
    return name


class EntryNames:
    """Collects the names of an archive's files and finds which file of the drive each one is.

    Parameters
    ----------
    expected
        The files of the manifest.
    """

    def __init__(self, expected: Collection[str]) -> None:
        self._exact = frozenset(expected)
        # macOS stores 'ü' as two characters: the name in the manifest is found all the same.
        self._composed = {composed(name): name for name in expected if not name.isascii()}
        self._names: list[str] = []
        self._keys: dict[str, str] = {}

    def add(self, name: str) -> bool:
        """Note one more file; whether it may be one of the drive's, so that unpacking it makes sense.

        Raises
        ------
        ServiceError
            422 `unsafe-archive`, if there is such a name already.
        """
        key = portable_key(name)
        first = self._keys.setdefault(key, name)
        if len(self._keys) == len(self._names):
            how = "twice" if first == name else f"beside {shown(first)}, which many systems take for the same file"
            remedy = "Make the archive again with each file once, under names that differ in more than case."
            raise UnsafeArchive(f"entry {shown(name)} is in the archive {how}", remedy=remedy)
        self._names.append(name)
        return self._file(name) is not None or (
            not is_beside_manifest(name) and self._file(without_top(name)) is not None
        )

    def resolve(self) -> dict[str, str]:
        """The drive's file for each name that was added and is one: what imports, renderings and uploads leave is none.

        Raises
        ------
        ServiceError
            422 `unexpected-file` if one is of no drive's folder, 422 `empty-archive` if none is the drive's.
        """
        paths = self._paths()
        files = {name: file for name, path in paths.items() if (file := self._file(path)) is not None}
        strange = [name for name, path in paths.items() if name not in files and not is_beside_manifest(path)]
        if strange:
            raise unexpected_files(strange, len(self._exact))
        if not files:
            raise EmptyArchive("the archive holds no file", remedy="Put the drive's images into it.")
        return files

    def _paths(self) -> dict[str, str]:
        """Each entry's path in the drive's folder: one common top folder does not count."""
        whole = {name: name for name in self._names}
        if all(map(self._file, whole)) or not self._has_common_top():
            return whole
        stripped = {name: without_top(name) for name in self._names}
        return stripped if any(map(self._file, stripped.values())) else whole

    def _file(self, name: str) -> str | None:
        if name in self._exact or name == MANIFEST_NAME:
            return name
        return None if name.isascii() else self._composed.get(composed(name))

    def _has_common_top(self) -> bool:
        tops = {name.partition("/")[0] for name in self._names}
        return len(tops) == 1 and all("/" in name and not is_beside_manifest(name) for name in self._names)


def may_be_manifest(name: str) -> bool:
    """Return whether the entry can be the drive's manifest, at the root or in one top folder."""
    return MANIFEST_NAME in (name, without_top(name))


def without_top(name: str) -> str:
    """The name without its first folder; empty where it has none."""
    return name.partition("/")[2]


def _problem(name: str) -> str | None:
    if not name.isprintable():
        return "has control or invisible characters in its name"
    if "\\" in name:
        return "has a backslash in its name"
    if name.startswith("/"):
        return "has an absolute name"
    if _DRIVE_LETTER.match(name):
        return "has a drive letter in its name"
    if ".." in name.split("/"):
        return "leaves the drive's folder with '..'"
    return None


def _unsafe(name: bytes, problem: str, remedy: str) -> ServiceError:
    return UnsafeArchive(f"entry {shown(name)} of the archive {problem}", remedy=remedy)


def unexpected_files(names: Sequence[str], expected: int, *, is_whole: bool = True) -> ServiceError:
    """The archive holds files that the manifest does not name.

    Parameters
    ----------
    expected
        How many files the manifest names.
    is_whole
        Whether the archive was read to its end, so that these are all.
    """
    more = f" and {len(names) - _SHOWN_NAMES} more" if len(names) > _SHOWN_NAMES else ""
    listed = ", ".join(shown(name) for name in names[:_SHOWN_NAMES])
    count = f"{len(names)} files" if is_whole else "files"
    return UnexpectedFile(
        f"{count} of the archive are none of the {expected} files of the drive's manifest: {listed}{more}",
        remedy="Leave them out, or name them as the manifest does; one top folder around all files is fine.",
    )
