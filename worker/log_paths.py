"""Paths in logs that users see: relative to the package or folder that they are in, and not to this machine."""

from __future__ import annotations

import re
import site
import sys
import sysconfig
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

# Folders that every machine has say nothing, and much else lies in them.
_EVERYWHERE = frozenset(map(Path, ("/", "/usr", "/usr/local", "/opt", "/home", "/tmp", "/var")))
_BEFORE = r"(?<![\w.~-])"  # not in the middle of another path
_BEHIND = r"(?:(?P<inside>/)|(?![\w.-]))"


class LogPaths:
    """Shortens the paths of a log.

    Parameters
    ----------
    folders
        Whose files are shown by their paths in them.

    Notes
    -----
    Files of Python packages, of this interpreter as of this installation, are shown from the package on
    (`mrasfm_engine/pipeline.py`), those of its standard library from `python3.11/` on, and all others of the home
    folder from `~/` on.
    """

    def __init__(self, folders: Iterable[Path]) -> None:
        shown = dict(_shown_as([*folders, *_package_folders()], lambda path: ("", path.name)))
        shown |= dict(_shown_as(_library_folders(), lambda path: (f"{path.name}/", path.name)))
        home = dict(_shown_as(_home(), lambda path: ("~/", "~")))
        self._shown: Mapping[str, tuple[str, str]] = home | shown
        longest_first = sorted(self._shown, key=len, reverse=True)
        self._expression = re.compile(f"{_BEFORE}(?P<folder>{'|'.join(map(re.escape, longest_first))}){_BEHIND}")

    def shorten(self, text: str) -> str:
        """The text with these paths shortened."""
        return self._expression.sub(self._short, text)

    def _short(self, match: re.Match[str]) -> str:
        inside, itself = self._shown[match["folder"]]
        return inside if match["inside"] else itself


def _home() -> list[Path]:
    """The home folder; a user without an entry in the system's table has none."""
    try:
        return [Path.home()]
    except RuntimeError:
        return []


def _shown_as(folders: Iterable[Path], how: Callable[[Path], tuple[str, str]]) -> Iterator[tuple[str, tuple[str, str]]]:
    """Each folder as it is named and as it really is, with what stands for it before a path in it, and for itself."""
    for folder in folders:
        for path in {folder.absolute(), folder.resolve()}:
            if path not in _EVERYWHERE:
                yield str(path), how(folder)


def _package_folders() -> list[Path]:
    """Folders of installed packages, ours among them; then the environment around them."""
    installed = [*site.getsitepackages(), site.getusersitepackages(), *map(sysconfig.get_path, ("purelib", "platlib"))]
    ours = Path(__file__).parents[1]
    return [ours, *map(Path, [*installed, sys.prefix, sys.base_prefix])]


def _library_folders() -> list[Path]:
    return [Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib")]
