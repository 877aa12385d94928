"""Finished stages are kept in the artifact store while the attempt goes on: what kills it does not undo them."""

from __future__ import annotations

import contextvars
import logging
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from service.database.connections import Database, Transactions
from service.domain import checkpoints, jobs
from service.domain.checkpoints import Shelf
from service.storage.artifacts import ArtifactStore, Fetch
from service.storage.blob_writer import file_sha256, store_file

log = logging.getLogger("mrasfm.worker")

_POLL_EVERY_S = 1.0
_FIRST_PAUSE_S = 2.0
_LONGEST_PAUSE_S = 300.0
_ENDS_WITHIN_S = 10.0  # a store that hangs holds up neither a stop nor what is to be published

_Identity = tuple[int, int]


@dataclass
class _Trouble:
    """A file that could not be kept."""

    identity: _Identity
    sha256: str | None = None
    pause_s: float = 0.0
    again_s: float = 0.0


class CheckpointKeeper:
    """A thread that stores every finished stage that appears in a folder, for as long as it is in its `with` block.

    A stage's file appears under its name when it is complete, so whatever is there can be taken.
    """

    def __init__(
        self, database: Database, artifacts: ArtifactStore, shelf: Shelf, *, held: jobs.Claim, folder: Path, spare: Path
    ) -> None:
        self._database = database
        self._artifacts = artifacts
        self._shelf = shelf
        self._held = held
        self._folder = folder
        self._spare = spare
        self._kept: dict[str, _Identity] = {}
        self._troubles: dict[str, _Trouble] = {}
        self._lock = threading.Lock()  # held while a file is stored
        self._ended = threading.Event()
        self._thread = threading.Thread(
            target=contextvars.copy_context().run, args=(self._run,), name="checkpoints", daemon=True
        )

    def restore(
        self, records: Transactions, fetch: Fetch, is_wanted: Callable[[str], bool] = lambda name: True
    ) -> None:
        """Bring what earlier attempts and jobs have finished into the folder, where the name of its file is wanted."""
        for name in checkpoints.restore(records, self._shelf, self._folder, fetch=fetch, is_wanted=is_wanted):
            self._kept[name] = _identity(self._folder / name)

    def keep_all(self) -> None:
        """Store every finished stage that is not stored yet.

        Raises
        ------
        Exception
            Where database or artifact store do not take one; it may be tried again.
        """
        for path in self._finished():
            with self._lock:
                identity = _identity(path)
                if self._kept.get(path.name) != identity:
                    self._keep(path, _Trouble(identity))
                    self._kept[path.name] = identity

    def _finished(self) -> list[Path]:
        return sorted(self._folder.glob("*.npz"))

    def __enter__(self) -> CheckpointKeeper:
        self._spare.mkdir(mode=0o700)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join(_ENDS_WITHIN_S)

    def _run(self) -> None:
        while not self._ended.wait(_POLL_EVERY_S):
            self._poll()
        self._poll(is_last=True)

    def _poll(self, *, is_last: bool = False) -> None:
        for path in self._finished():
            with self._lock, suppress(FileNotFoundError):  # the attempt's folder is being removed
                identity = _identity(path)
                if self._kept.get(path.name) != identity:
                    self._try(path, identity, is_last=is_last)

    def _try(self, path: Path, identity: _Identity, *, is_last: bool) -> None:
        trouble = self._troubles.get(path.name)
        if trouble is None or trouble.identity != identity:
            trouble = self._troubles[path.name] = _Trouble(identity)
        if time.monotonic() < trouble.again_s and not is_last:
            return
        try:
            self._keep(path, trouble)
        except Exception as error:  # a checkpoint that is not kept costs time, not the job
            is_first = trouble.pause_s == 0.0
            trouble.pause_s = _FIRST_PAUSE_S if is_first else min(2 * trouble.pause_s, _LONGEST_PAUSE_S)
            trouble.again_s = time.monotonic() + trouble.pause_s
            fields = {"stage": path.stem, "again_in_s": trouble.pause_s, "why": type(error).__name__}
            log.warning("a finished stage could not be kept", exc_info=is_first, extra={"fields": fields})
        else:
            del self._troubles[path.name]
            self._kept[path.name] = identity

    def _keep(self, path: Path, trouble: _Trouble) -> None:
        link = self._spare / path.name
        link.unlink(missing_ok=True)
        os.link(path, link)
        if _identity(link) != trouble.identity:  # the stage was done again meanwhile: looked at next time
            raise OSError("the file was replaced")
        if trouble.sha256 is None:
            trouble.sha256 = file_sha256(link)
        stored = store_file(
            self._database,
            self._artifacts,
            project_id=self._held.project_id,
            path=link,
            sha256=trouble.sha256,
            size_bytes=link.stat().st_size,
        )
        with self._database.write() as session:
            if checkpoints.keep(session, self._shelf, {path.name: stored}):
                jobs.note_finished_stage(session, self._held)


def _identity(path: Path) -> _Identity:
    status = path.stat()
    return status.st_ino, status.st_size
