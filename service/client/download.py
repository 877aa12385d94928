"""Download of a scene or map: resumed where it was interrupted, every byte checked, complete or visibly not."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from pydantic import TypeAdapter, ValidationError

from schemas.api.jobs import JobResource
from schemas.api.maps import MapVersionResource
from schemas.artifacts import REPORT_FILE
from schemas.drive import RelativePath
from service.client.api import Client, Result, ResultFile
from service.client.errors import SceneFolderError
from service.client.parallel import FileMeter, Meter, Report, in_parallel, no_report
from service.client.transport import TroubleError
from service.storage.data_folder import write_private_file

OWN_PREFIX = ".mrasfm-"
MARKER_NAME = f"{OWN_PREFIX}scene.json"  # says which scene the folder is of
PARALLEL = 4
_relative_path = TypeAdapter(RelativePath)


@dataclass(frozen=True)
class Downloaded:
    """Result of a download."""

    bytes_received: int
    files_received: int
    files_skipped: int


def download(
    client: Client, result: Result, out: Path, *, parallel: int = PARALLEL, report: Report = no_report
) -> Downloaded:
    """Bring all files of a scene, an export or of a map's version into `out`.

    Files that are there, whole and unchanged, are not brought again, and one that was interrupted goes on where it was.

    Raises
    ------
    SceneFolderError
        Where `out` holds something else, the file names lead out of it, or what arrives is damaged.
    ApiError
        The result is not there any more.
    UnreachableError
        The service does not answer.
    """
    held = f"{result.map_id}/{result.number}" if isinstance(result, MapVersionResource) else result.id
    require_free(out, held)
    for file in result.files:
        _require_inside(out, file)
    _claim(out, held)
    meter = Meter(report, "download", sum(file.size_bytes for file in result.files))
    brought: list[int | None] = []
    for is_last in (False, True):  # the report: a folder with it is complete, as the engine's own are
        files = [file for file in result.files if (file.path == REPORT_FILE) is is_last]
        brought += in_parallel(
            lambda file: _Download(client, result, file, out, meter).run(), files, threads=parallel, stop=client.stop
        )
    received = [count for count in brought if count is not None]
    return Downloaded(sum(received), len(received), len(brought) - len(received))


def require_free(out: Path, scene_id: str | None) -> None:
    """Refuse a folder that holds something else than this scene; without an id, something else than any scene of ours.

    One that is not there has to be in a folder in which it can be made: jobs take hours.

    Raises
    ------
    SceneFolderError
    """
    try:
        is_empty = not out.exists() or next(out.iterdir(), None) is None
    except OSError as error:
        raise SceneFolderError(f"{out} cannot be read: {error.strerror}. Give another folder.") from error
    if is_empty:
        _require_makable(out)
        return
    held = _scene_in(out)
    if held is None:
        raise SceneFolderError(
            f"{out} is not empty, and holds no scene or map that was downloaded. Give another folder."
        )
    if scene_id is not None and held != scene_id:
        raise SceneFolderError(
            f"{out} holds the {_kind(held)} {held}, not {scene_id}. Give another folder, or remove it."
        )


def _require_makable(out: Path) -> None:
    there = next(path for path in (out, *out.absolute().parents) if path.exists())
    if not there.is_dir():
        raise SceneFolderError(f"{out} cannot be made: {there} is a file. Give another folder.")
    if not os.access(there, os.W_OK | os.X_OK):
        raise SceneFolderError(f"{out} cannot be written: {there} is not yours to write. Give another folder.")


def require_free_for_job(out: Path, known_job: Callable[[], JobResource | None]) -> None:
    """Refuse a folder that holds another result than a job's, before anything is done for that job.

    Parameters
    ----------
    known_job
        Job that is there already; None where a new one will be made. Called only where the folder holds a result.

    Raises
    ------
    SceneFolderError
    """
    held = _scene_in(out)
    if held is None:
        return
    job = known_job()
    expected = None if job is None else job.scene_id
    if job is not None and job.map_version is not None:
        expected = f"{job.map_id}/{job.map_version}"
    if held != expected:
        raise SceneFolderError(
            f"{out} holds the {_kind(held)} {held}, and this gives another one. Give another folder, or remove it."
        )


def _scene_in(out: Path) -> str | None:
    try:
        return str(json.loads((out / MARKER_NAME).read_bytes())["scene_id"])
    except (OSError, ValueError, LookupError, TypeError):
        return None


def _kind(held: str) -> str:
    return "map" if "/" in held else "export" if held.startswith("exp_") else "scene"


def _claim(out: Path, scene_id: str) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        if _scene_in(out) is None:
            write_private_file(out / MARKER_NAME, json.dumps({"scene_id": scene_id}) + "\n")
    except OSError as error:
        raise SceneFolderError(f"{out} cannot be written: {error.strerror}. Give another folder.") from error


def _require_inside(out: Path, file: ResultFile) -> None:
    """Refuse names that would lead out of the folder: a service may be wrong, or not the one it seems to be."""
    try:
        _relative_path.validate_python(file.path)
        is_inside = (out / file.path).parent.resolve().is_relative_to(out.resolve())
    except ValidationError:
        is_inside = False
    if not is_inside or file.path.startswith(OWN_PREFIX):
        raise SceneFolderError(
            f"the service offers a file named {file.path!r}, which does not belong into {out}. Nothing was written; "
            "tell the service's operator."
        )


class _Download:
    """One file of a scene. Its bytes gather under a temporary name until all are there and are the right ones."""

    def __init__(self, client: Client, result: Result, file: ResultFile, out: Path, meter: Meter) -> None:
        self._client = client
        self._result = result
        self._file = file
        self._meter = FileMeter(meter)
        self._target = out / file.path
        name = hashlib.sha256(f"{file.path}\n{file.sha256}".encode()).hexdigest()[:32]
        self._partial = out / f"{OWN_PREFIX}{name}.partial"
        self._received_bytes = 0

    def run(self) -> int | None:
        """Bytes that were received; None where the file was there."""
        try:
            return self._run()
        except OSError as error:
            raise SceneFolderError(
                f"{self._target} cannot be written: {error.strerror}. Correct that, then give the same command again."
            ) from error

    def _run(self) -> int | None:
        if self._is_right(self._target):
            self._meter.set(self._file.size_bytes)
            return None
        self._gather()
        if not self._is_right(self._partial):
            # Perhaps what an earlier run left was damaged: once more, from the first byte.
            self._partial.unlink()
            self._gather()
        if not self._is_right(self._partial):
            self._partial.unlink()
            raise SceneFolderError(
                f"{self._target} arrives damaged: its SHA-256 is not the one that the service states. "
                "Try again; if it stays so, tell the service's operator."
            )
        self._target.parent.mkdir(parents=True, exist_ok=True)
        self._partial.replace(self._target)
        return self._received_bytes

    def _is_right(self, path: Path) -> bool:
        if not path.is_file() or path.stat().st_size != self._file.size_bytes:
            return False
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest() == self._file.sha256

    def _gather(self) -> None:
        """Bring the file under its temporary name up to its size, or to where the service has no more."""
        self._partial.touch()
        with self._partial.open("r+b") as partial:
            there_bytes = partial.seek(0, os.SEEK_END)
            self._meter.set(there_bytes if there_bytes <= self._file.size_bytes else 0)
            budget = self._client.retry_budget()
            while self._meter.done_bytes < self._file.size_bytes:
                before_bytes = self._received_bytes
                try:
                    self._receive(partial)
                    break
                except TroubleError as trouble:
                    if self._received_bytes > before_bytes:
                        budget.renew()
                    budget.pause(trouble)
            partial.truncate(self._meter.done_bytes)

    def _receive(self, partial: BinaryIO) -> None:
        start = self._meter.done_bytes
        with self._client.open_file(self._result, self._file, start=start) as (begins_at, pieces):
            self._meter.set(begins_at)
            partial.seek(begins_at)
            for piece in pieces:
                self._client.require_open("download")
                partial.write(piece)
                self._received_bytes += len(piece)
                self._meter.set(self._meter.done_bytes + len(piece))
                if self._meter.done_bytes > self._file.size_bytes:
                    return  # more than the service stated
