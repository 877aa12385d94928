"""Re-reads every file of a result before it is put in place, with other code than wrote it.

A table says of every file how it is read (`readers`) and what it must say (`comparisons`). A file that no line of the
table covers is refused as well: nothing is published unread.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, NoReturn

from mrasfm_engine.errors import MrasfmError
from mrasfm_engine.export import colmap_io, comparisons, readers
from mrasfm_engine.export.comparisons import Rows
from mrasfm_engine.export.file_contents import sha256
from mrasfm_engine.export.picture_files import LargeFile, PictureFiles
from mrasfm_engine.scene.scene import Scene
from schemas.artifacts import PICTURES_FOLDER, REPORT_FILE


@dataclass(frozen=True)
class Check:
    """A line of the table.

    Parameters
    ----------
    file
        Path below the result's folder; of a folder, all files directly in it are meant.
    read
        Reader of the file, by its path.
    compare
        What it says beside what it must say, of what was read.
    """

    file: str
    read: Callable[[Path], Any]
    compare: Callable[[Any], Rows]


def binary_model_checks(
    scene: Scene, read: Callable[[Path], colmap_io.ModelRead] = colmap_io.read_binary
) -> list[Check]:
    """Checks of the binary model, which COLMAP reads by `read`; the text model is made of it."""
    return [
        Check("model/images.bin", readers.images_binary, partial(comparisons.images, scene)),
        Check("model", read, partial(comparisons.model, scene)),
    ]


def common_checks(scene: Scene) -> list[Check]:
    """Checks of the other files that scenes and maps have alike, but for those of `completing_checks`."""
    return [
        Check("points.ply", readers.ply, partial(comparisons.ply, scene)),
        Check("frame.json", readers.json_object, partial(comparisons.frame, scene)),
        Check("poses.json", readers.json_object, partial(comparisons.poses, scene)),
    ]


def completing_checks(pictures: PictureFiles) -> list[Check]:
    """Checks of the files that come last: the report and the pictures."""
    return [
        Check(REPORT_FILE, readers.json_object, comparisons.nothing),
        *(_picture_check(f"{PICTURES_FOLDER}/{name}", data) for name, data in pictures.items()),
    ]


def _picture_check(name: str, data: bytes | LargeFile) -> Check:
    if isinstance(data, LargeFile):
        return Check(name, sha256, partial(comparisons.content, data.sha256))
    return Check(name, Path.read_bytes, partial(comparisons.content, data))


class ReadBack:
    """The files of one folder, as far as they have been read back; several threads may read different ones."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._covered: set[str] = set()
        self._contents: dict[str, str] = {}

    def expect(self, digests: Mapping[str, str]) -> None:
        """Let files have these contents, byte by byte: SHA-256 by their paths below the folder.

        They are compared before a check reads the file: what it says is then compared in whole numbers and within
        tolerances, and a count that is off cannot make a reader of others fill the memory.
        """
        self._contents |= digests

    def check(self, checks: Iterable[Check]) -> None:
        """Read files and compare them with what they must say.

        Raises
        ------
        MrasfmError
            Where one is missing, cannot be read or says something else.
        """
        for check in checks:
            path = self._folder / check.file
            try:
                fault = self.fault(check)
            except OSError as error:
                fault = f"{type(error).__name__}: {error}"
            if fault is not None:
                _refuse(path, fault)

    def fault(self, check: Check) -> str | None:
        """The fault of a file in words; None where it says what it must say.

        Raises
        ------
        OSError
            Where a file that is there cannot be read.
        """
        self._covered.add(check.file)
        try:
            for name in self._expected_in(check.file):
                if sha256(self._folder / name) != self._contents.pop(name):
                    return f"{name} is not what was written" if name != check.file else "it is not what was written"
            for row in check.compare(check.read(self._folder / check.file)):
                if not row.agrees:
                    return row.difference
        except FileNotFoundError:
            return "it is missing"
        except (MrasfmError, OSError):
            raise
        except Exception as error:
            return f"{type(error).__name__}: {error}"
        return None

    def _expected_in(self, file: str) -> list[str]:
        """Files with a content that is not yet compared which a check of a file or folder reads."""
        return [name for name in list(self._contents) if file in (name, PurePosixPath(name).parent.as_posix())]

    def require_all(self) -> None:
        """Refuse a folder that holds a file which no check has read.

        Raises
        ------
        MrasfmError
            Where there is one.
        """
        for path in sorted(p for p in self._folder.rglob("*") if p.is_file()):
            name = path.relative_to(self._folder)
            if not {name.as_posix(), name.parent.as_posix()} & self._covered:
                _refuse(path, "no check covers it")


def _refuse(path: Path, what: str) -> NoReturn:
    raise MrasfmError(
        f"{path.name} was written but does not read back: {what}; nothing was published",
        remedy="Check that the disk is not full and run again; if it happens again, report it as a defect of mrasfm.",
        code="export-check-failed",
    )
