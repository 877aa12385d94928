"""Finished stages are kept in the artifact store while the attempt goes on: what kills it does not undo them."""

from __future__ import annotations

import contextvars
import logging
import os
import threading
from pathlib import Path
from types import TracebackType

from service.persistence import checkpoints
from service.persistence.artifacts import ArtifactStore
from service.persistence.checkpoints import Shelf
from service.persistence.database import Database
from service.persistence.storing import file_sha256, store_file

log = logging.getLogger("mrasfm.worker")

_LOOK_EVERY_S = 1.0


class CheckpointKeeper:
    """A thread that stores every finished stage that appears in a folder, for as long as it is in its `with` block.

    A stage's file appears under its name when it is complete, so whatever is there can be taken.
    """

    def __init__(
        self, database: Database, artifacts: ArtifactStore, shelf: Shelf, *, project_id: str, folder: Path, spare: Path
    ) -> None:
        self._database = database
        self._artifacts = artifacts
        self._shelf = shelf
        self._project_id = project_id
        self._folder = folder
        self._spare = spare
        self._kept: dict[str, tuple[int, int]] = {}
        self._ended = threading.Event()
        self._thread = threading.Thread(
            target=contextvars.copy_context().run, args=(self._run,), name="checkpoints", daemon=True
        )

    def restore(self) -> None:
        """Bring what earlier attempts and jobs have finished into the folder."""
        for name in checkpoints.restore(self._database, self._artifacts, self._shelf, self._folder):
            self._kept[name] = _identity(self._folder / name)

    def __enter__(self) -> CheckpointKeeper:
        self._spare.mkdir(mode=0o700)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(_LOOK_EVERY_S):
            self._look()
        self._look()

    def _look(self) -> None:
        for path in sorted(self._folder.glob("*.npz")):
            try:
                identity = _identity(path)
                if self._kept.get(path.name) != identity:
                    self._keep(path)
                    self._kept[path.name] = _identity(path)
            except Exception:  # a checkpoint that is not kept costs time, not the job
                log.warning("a finished stage could not be kept", exc_info=True, extra={"fields": {"stage": path.stem}})

    def _keep(self, path: Path) -> None:
        link = self._spare / path.name
        link.unlink(missing_ok=True)
        os.link(path, link)
        stored = store_file(
            self._database,
            self._artifacts,
            project_id=self._project_id,
            path=link,
            sha256=file_sha256(link),
            size_bytes=link.stat().st_size,
        )
        with self._database.write() as session:
            checkpoints.keep(session, self._shelf, {path.name: stored})


def _identity(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_ino, status.st_size
