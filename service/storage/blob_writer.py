"""A file on this machine becomes an object in the artifact store and a blob in the database."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy.exc import DBAPIError, InterfaceError, OperationalError
from sqlalchemy.orm import Session

from service.database.connections import Database, clock_us
from service.database.tables import Blob
from service.storage import blobs
from service.storage.artifacts import ArtifactStore
from service.storage.durability import boot_id
from service.storage.spool import Spooled

_CHUNK_BYTES = 1 << 20
_BATCH = 500


@dataclass(frozen=True, kw_only=True)
class StoredFile:
    """An object that is in the artifact store, and not necessarily in the database yet."""

    sha256: str
    size_bytes: int
    key: str
    is_new: bool  # else it was there already, and may be collected before it is recorded
    written_in_boot: str | None = None  # where a power cut could still take it

    @property
    def identity(self) -> dict[str, Any]:
        """Arguments of `blobs.record`."""
        return {
            "sha256": self.sha256,
            "size_bytes": self.size_bytes,
            "key": self.key,
            "is_new": self.is_new,
            "written_in_boot": self.written_in_boot,
        }


def file_sha256(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()


def store_file(
    database: Database, artifacts: ArtifactStore, *, project_id: str, path: Path, sha256: str, size_bytes: int
) -> StoredFile:
    """Put a file into the artifact store, unless the project has its content already; the file is gone afterwards.

    The caller records the blob together with what refers to it, in one transaction, within the hour: what nothing
    refers to is collected then, and recording it is refused.
    """
    known = _find(database, project_id, sha256)
    if known is not None:
        path.unlink()
        return StoredFile(sha256=sha256, size_bytes=known.size_bytes, key=known.key, is_new=False)
    key = blobs.new_key(project_id, sha256)
    return _put(artifacts, path, key, sha256=sha256, size_bytes=size_bytes, durable=True)


def _put(artifacts: ArtifactStore, path: Path, key: str, *, sha256: str, size_bytes: int, durable: bool) -> StoredFile:
    boot = _boot_of(artifacts, durable=durable)
    artifacts.put_file(path, key, durable=boot is None)
    return StoredFile(sha256=sha256, size_bytes=size_bytes, key=key, is_new=True, written_in_boot=boot)


def _boot_of(artifacts: ArtifactStore, *, durable: bool) -> str | None:
    """The start of the machine in which objects are written that a power cut could take; else None."""
    return None if durable or artifacts.folder is None else boot_id()


def _find(database: Database, project_id: str, sha256: str) -> Blob | None:
    """The project's blob of this content. Most contents are new, and these need not wait for the writers' turn."""
    with database.read() as session:
        if not blobs.exists(session, project_id, sha256):
            return None
    with database.write() as session:
        return blobs.find(session, project_id, sha256)


def _may_be_recorded_yet(error: BaseException | None) -> bool:
    """Return whether a block ended because the database gave no answer, perhaps to a commit that goes on there."""
    if not isinstance(error, DBAPIError):
        return False
    return error.connection_invalidated or isinstance(error, (OperationalError, InterfaceError))


class BlobWriter:
    """Stores files that are recorded within its block, and takes back at its end what was not recorded.

    A request that is refused after its bytes were stored, for a quota or a conflict, leaves nothing behind. Where the
    database went away, all stays: a server may commit what it was sent after the connection broke.

    Parameters
    ----------
    durable
        Whether the bytes survive a power cut at once; else `durability.secure_drive` has to follow.
    """

    def __init__(self, database: Database, artifacts: ArtifactStore, *, project_id: str, durable: bool) -> None:
        self._durable = durable
        self._database = database
        self._artifacts = artifacts
        self._project_id = project_id
        self._new: set[str] = set()
        self._recorded_us = 0
        self._unused: list[blobs.Recorded] = []

    def __enter__(self) -> BlobWriter:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if _may_be_recorded_yet(error):
            return  # the reconciler collects them, once it is known that nothing names them
        with contextlib.suppress(Exception):  # else the reconciler collects them
            self._rollback()

    def __call__(self, path: Path, *, sha256: str, size_bytes: int) -> StoredFile:
        """Make a file of the spool an object; the file is gone afterwards.

        Whether the project has the content already is not asked: clients declare what they have before they send it.
        Where it has, recording it returns the older blob, and this object is taken back.
        """
        key = blobs.new_key(self._project_id, sha256)
        self._new.add(key)
        return _put(self._artifacts, path, key, sha256=sha256, size_bytes=size_bytes, durable=self._durable)

    def store_all(self, files: Sequence[Spooled]) -> list[StoredFile]:
        """Make many files of the spool objects, some of them at one time; as a call for each."""
        boot = _boot_of(self._artifacts, durable=self._durable)
        stored = [
            StoredFile(
                sha256=file.sha256,
                size_bytes=file.size_bytes,
                key=blobs.new_key(self._project_id, file.sha256),
                is_new=True,
                written_in_boot=boot,
            )
            for file in files
        ]
        self._new.update(file.key for file in stored)
        paths = ((spooled.path, file.key) for spooled, file in zip(files, stored, strict=True))
        self._artifacts.put_files(paths, durable=boot is None)
        return stored

    def recorded(self, key: str) -> None:
        """Note that a transaction that has committed names this object."""
        self._new.discard(key)

    def record(self, files: Sequence[StoredFile]) -> dict[str, blobs.Recorded]:
        """Blobs of stored files, by digest, before anything refers to them.

        In several short transactions, so that others write in between. What is recorded is taken back at the block's
        end, unless `used` says that it is needed; where the process is killed before, it is collected later. Once in a
        block.

        Raises
        ------
        ServiceError
            413 where the project's quota would be exceeded.
        """
        found: dict[str, blobs.Recorded] = {}
        # Not the block's begin: the bytes may have taken longer than unused ones are kept.
        self._recorded_us = self._database.query(clock_us)
        unlike = list({file.sha256: file for file in files}.values())
        for i in range(0, len(unlike), _BATCH):
            contents = [file.identity for file in unlike[i : i + _BATCH]]

            def batch(session: Session, contents: list[dict[str, Any]] = contents) -> dict[str, blobs.Recorded]:
                return blobs.record_all(session, self._project_id, contents, touched_us=self._recorded_us)

            recorded = self._database.transact(batch, durable=False)
            self._unused += [blob for blob in recorded.values() if blob.key in self._new]
            found.update(recorded)
        return found

    def used(self) -> None:
        """Note that a transaction that has committed refers to all that was recorded."""
        self._new.difference_update(blob.key for blob in self._unused)
        self._unused = []

    def _rollback(self) -> None:
        """Forget what was recorded for nothing, and remove objects that no blob names: nobody else knows their keys."""
        for i in range(0, len(self._unused), _BATCH):
            ids = [blob.id for blob in self._unused[i : i + _BATCH]]
            with self._database.write(durable=False) as session:
                blobs.rollback(session, self._project_id, ids, touched_us=self._recorded_us)
        new = sorted(self._new)
        for i in range(0, len(new), _BATCH):
            keys = new[i : i + _BATCH]
            with self._database.read() as session:
                known = blobs.known_keys(session, keys)
            self._artifacts.delete(set(keys) - known)
