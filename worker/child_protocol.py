"""Messages between a supervisor and its child process, as files in the attempt's folder.

Only the standard library: the child reads its request before it loads anything else.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any


class Work(StrEnum):
    """Work of a child."""

    RECONSTRUCTION = "reconstruction"
    PREFLIGHT = "preflight"
    AGGREGATION = "aggregation"


class ErrorKind(StrEnum):
    """Kind of the engine's error that ended the child's work."""

    INPUT = "input"
    RECONSTRUCTION = "reconstruction"
    STORAGE = "storage"
    CANCELLED = "cancelled"
    OTHER = "other"  # a scene that contradicts itself, or does not read back as it was written


@dataclass(frozen=True, kw_only=True)
class ChildRequest:
    """Request to one child process.

    Attributes
    ----------
    drive
        Folder with `drive.json`; None for an aggregation.
    out
        Folder of the scene or map; finished stages lie in its `CHECKPOINT_FOLDER`.
    content_sha256
        SHA-256 of the drive's files by name; None for an aggregation.
    settings
        As in the API's `ReconstructionSettings`.
    cancel_file
        The child ends its work where this file exists.
    result_file
        Where the child writes its ChildResult.
    progress_fd
        Inherited descriptor of a pipe that takes lines of progress.
    parent_pid
        The supervisor: without it the child ends.
    scenes, into, remove
        Of an aggregation: folders of scenes by name, folder of the map that they are added to, names of scenes that it
        shall lose.
    failed, members
        Of an aggregation: drives that have no scene, for its report, and what that calls those that have one, by name.
    leave_out
        Of an aggregation: whether a scene that fits into no map does not take the others with it.
    """

    work: Work
    drive: Path | None
    out: Path
    settings: dict[str, Any]
    threads: int
    cancel_file: Path
    result_file: Path
    progress_fd: int
    parent_pid: int
    content_sha256: dict[str, str] | None = None
    scenes: dict[str, Path] = field(default_factory=dict)
    into: Path | None = None
    remove: list[str] = field(default_factory=list)
    failed: list[dict[str, Any]] = field(default_factory=list)
    members: dict[str, dict[str, Any]] = field(default_factory=dict)
    leave_out: bool = False

    def write(self, path: Path) -> None:
        """Put the request where the child reads it."""
        path.write_text(json.dumps(asdict(self), default=str), encoding="utf-8")

    @classmethod
    def read(cls, path: Path) -> ChildRequest:
        """The request in a file."""
        values = json.loads(path.read_text(encoding="utf-8"))
        values["work"] = Work(values["work"])
        for name in ("drive", "into", "out", "cancel_file", "result_file"):
            values[name] = None if values[name] is None else Path(values[name])
        values["scenes"] = {name: Path(folder) for name, folder in values["scenes"].items()}
        return cls(**values)


@dataclass(frozen=True, kw_only=True)
class ChildError:
    """An error of the engine, in its words.

    Attributes
    ----------
    findings
        All that the check of the drive found, where that is what refused it.
    """

    kind: ErrorKind
    code: str
    what: str
    remedy: str
    findings: list[dict[str, str]] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class ChildResult:
    """Result of a child's work: a report, or an error."""

    report: dict[str, Any] | None = None
    error: ChildError | None = None

    def write(self, path: Path) -> None:
        """Write the result whole or not at all: a result that is there is complete."""
        partial = path.with_name(path.name + ".partial")
        with partial.open("w", encoding="utf-8") as file:
            json.dump(asdict(self), file, allow_nan=False)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)

    @classmethod
    def read(cls, path: Path) -> ChildResult | None:
        """The result in a file; None where the child left none."""
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        error = values["error"]
        return cls(
            report=values["report"],
            error=None if error is None else ChildError(**{**error, "kind": ErrorKind(error["kind"])}),
        )
