"""Messages between a supervisor and its child process, as files in the attempt's folder.

Only the standard library: the child reads its request before it loads anything else.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any


class Work(StrEnum):
    """The kinds of work of a child."""

    RECONSTRUCTION = "reconstruction"
    PREFLIGHT = "preflight"
    AGGREGATION = "aggregation"
    SUBMAP = "submap"
    EXPORT = "export"


@dataclass(frozen=True, kw_only=True)
class FileAddress:
    """Port of the loopback interface where the supervisor is asked for files, and the word that shows who may ask."""

    port: int
    token: str


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """The work of one attempt.

    Attributes
    ----------
    drive
        Folder with `drive.json` and the files it names; None for an aggregation or an export.
    content_sha256
        SHA-256 of these files by name: what finished stages are found again by.
    files
        Where the drive's files are asked for; None where all that are needed are in its folder.
    settings
        As in the API's `ReconstructionSettings`.
    name
        Of an aggregation: the map's, for its report.
    scenes, into, remove
        Of an aggregation: folders of scenes by name, folder of the map that they are added to, names of scenes that it
        shall lose.
    failed, members
        Of an aggregation: drives that have no scene, for its report, and what that calls those that have one, by name.
    leave_out
        Of an aggregation: whether a scene that fits into no map, or a component, does not take the others with it.
    submap_workers
        Of a reconstruction: number of workers that a long drive is cut for. With less than 2 it is not cut: the child
        does all of it.
    submap
        Number of the sub-map that is mapped.
    source, drives, formats, options
        Of an export: folder of the scene or map, folders of drives by the names of scenes, names of formats, and
        options as the API's `ExportRequest` has them.
    """

    work: Work
    settings: Mapping[str, Any]
    drive: Path | None = None
    content_sha256: Mapping[str, str] | None = None
    files: FileAddress | None = None
    name: str = ""
    scenes: Mapping[str, Path] = field(default_factory=dict)
    into: Path | None = None
    remove: Sequence[str] = field(default_factory=list)
    failed: Sequence[Mapping[str, Any]] = field(default_factory=list)
    members: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    leave_out: bool = False
    submap_workers: int = 0
    submap: int = 0
    source: Path | None = None
    drives: Mapping[str, Path] = field(default_factory=dict)
    formats: Sequence[str] = field(default_factory=list)
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class ChildRequest(Attempt):
    """An attempt with all that one child process needs for it.

    Attributes
    ----------
    out
        Folder of the scene or map; finished stages lie in its `CHECKPOINT_FOLDER`.
    cancel_file
        The child ends its work where this file exists.
    result_file
        The file for the child's ChildResult.
    progress_fd
        Inherited descriptor of a pipe that takes lines of progress.
    parent_pid
        The supervisor: without it the child ends.
    """

    out: Path
    threads: int
    cancel_file: Path
    result_file: Path
    progress_fd: int
    parent_pid: int

    def write(self, path: Path) -> None:
        """Put the request where the child reads it."""
        path.write_text(json.dumps(asdict(self), default=lambda given: str(given.resolve())), encoding="utf-8")

    @classmethod
    def read(cls, path: Path) -> ChildRequest:
        """The request in a file."""
        values = json.loads(path.read_text(encoding="utf-8"))
        values["work"] = Work(values["work"])
        for name in ("drive", "into", "source", "out", "cancel_file", "result_file"):
            values[name] = None if values[name] is None else Path(values[name])
        values["files"] = None if values["files"] is None else FileAddress(**values["files"])
        for name in ("scenes", "drives"):
            values[name] = {key: Path(folder) for key, folder in values[name].items()}
        return cls(**values)


@dataclass(frozen=True, kw_only=True)
class ChildError:
    """An error of the engine, in its words.

    Attributes
    ----------
    retryable
        Whether another attempt may succeed.
    is_storage
        Whether a disk failed.
    findings
        All that the check of the drive found, where that is what refused it.
    """

    code: str
    what: str
    remedy: str
    retryable: bool
    is_storage: bool = False
    findings: list[dict[str, Any]] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class SubmapPlan:
    """Plan of a drive that was cut into sub-maps.

    Attributes
    ----------
    total
        Sub-maps of the drive.
    unfinished
        Number, first and last unit of those that are still to be mapped.
    """

    total: int
    unfinished: list[tuple[int, int, int]]


@dataclass(frozen=True, kw_only=True)
class ChildResult:
    """The end of a child's work: a report, a plan of what others have to do first, or an error."""

    report: dict[str, Any] | None = None
    plan: SubmapPlan | None = None
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
        plan, error = values["plan"], values["error"]
        return cls(
            report=values["report"],
            plan=None if plan is None else SubmapPlan(**plan),
            error=None if error is None else ChildError(**error),
        )
