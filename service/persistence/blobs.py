"""Which bytes are in the artifact store, whose they are, and what still needs them."""

from __future__ import annotations

import secrets
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, bindparam, delete, select, update
from sqlalchemy import exists as sql_exists
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from service.errors import ServiceError
from service.persistence.tables import Blob, Checkpoint, Drive, DriveFile, Project, SceneFile, new_id, now_us


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """A blob's identity."""

    id: str
    key: str
    size_bytes: int


_INSERT: dict[str, Any] = {
    name: dialect.insert(Blob).on_conflict_do_nothing().returning(Blob.id)
    for name, dialect in (("postgresql", postgresql), ("sqlite", sqlite))
}
_TAKE_SPACE = (
    update(Project)
    .where(Project.id == bindparam("project"))
    .values(used_bytes=Project.used_bytes + bindparam("size"))
    .execution_options(synchronize_session=False)
)
_TAKE_SPACE_WITHIN_QUOTA = _TAKE_SPACE.where(Project.used_bytes + bindparam("size") <= Project.max_bytes)


def new_key(project_id: str, sha256: str) -> str:
    """Where a content that is not stored yet goes in the artifact store."""
    return f"blobs/{project_id}/{sha256[:2]}/{sha256}-{secrets.token_hex(4)}"


def exists(session: Session, project_id: str, sha256: str) -> bool:
    """Whether the project has this content."""
    found = select(Blob.id).where(Blob.project_id == project_id, Blob.sha256 == sha256)
    return session.scalar(found) is not None


def find(session: Session, project_id: str, sha256: str) -> Blob | None:
    """The project's blob of this content, kept from being collected for a while."""
    blob = session.scalar(select(Blob).where(Blob.project_id == project_id, Blob.sha256 == sha256))
    if blob is not None:
        session.execute(update(Blob).where(Blob.id == blob.id).values(touched_us=now_us()))
    return blob


def record(
    session: Session,
    *,
    project_id: str,
    sha256: str,
    size_bytes: int,
    key: str,
    written_in_boot: str | None = None,
    within_quota: bool = True,
) -> Recorded:
    """The project's blob of a content that was just stored under `key`.

    Where the content was there already the older blob is returned, whose key differs: the caller deletes what it
    stored.

    Parameters
    ----------
    written_in_boot
        Where a power cut could still take the bytes: see `durability`.
    within_quota
        Whether the quota may refuse it. Results may exceed it: hours of work are not thrown away for it.

    Raises
    ------
    ServiceError
        413 where the project's quota would be exceeded.
    """
    values = {
        "id": new_id("blb"),
        "project_id": project_id,
        "sha256": sha256,
        "size_bytes": size_bytes,
        "key": key,
        "written_in_boot": written_in_boot,
        "touched_us": now_us(),
    }
    connection = session.connection()
    if connection.execute(_INSERT[connection.dialect.name], values).first() is not None:
        _take_space(session, project_id, size_bytes, within_quota=within_quota)
        return Recorded(id=str(values["id"]), key=key, size_bytes=size_bytes)
    blob = find(session, project_id, sha256)
    assert blob is not None
    return Recorded(id=blob.id, key=blob.key, size_bytes=blob.size_bytes)


def _take_space(session: Session, project_id: str, size_bytes: int, *, within_quota: bool) -> None:
    statement = _TAKE_SPACE_WITHIN_QUOTA if within_quota else _TAKE_SPACE
    if session.connection().execute(statement, {"project": project_id, "size": size_bytes}).rowcount:
        return
    project = session.get_one(Project, project_id)
    raise quota_full(project, size_bytes)


def quota_full(project: Project, size_bytes: int) -> ServiceError:
    """413: what is to be stored does not fit the project's quota."""
    return ServiceError(
        413,
        "quota-full",
        "The project's storage quota is full",
        f"{size_bytes} bytes do not fit: {project.used_bytes} of {project.max_bytes} bytes are used",
        remedy="Delete drives or scenes that are not needed any more, or ask the operator for a larger quota.",
    )


def unused() -> ColumnElement[bool]:
    """The condition that nothing refers to a blob."""
    return ~(
        sql_exists().where(Drive.manifest_blob_id == Blob.id)
        | sql_exists().where(DriveFile.blob_id == Blob.id)
        | sql_exists().where(SceneFile.blob_id == Blob.id)
        | sql_exists().where(Checkpoint.blob_id == Blob.id)
    )


def forget_unused(
    session: Session, *, untouched_since_us: int, project_id: str | None = None, limit: int = 500
) -> list[str]:
    """Drop blobs that nothing refers to, and give their space back to their projects.

    Parameters
    ----------
    project_id
        Of this project only; by default of all.

    Returns
    -------
    list of str
        Keys of objects to delete from the artifact store once this is committed.
    """
    ripe = unused() & (Blob.touched_us < untouched_since_us)
    if project_id is not None:
        ripe &= Blob.project_id == project_id
    keys = []
    for blob in session.scalars(select(Blob).where(ripe).limit(limit)).all():
        # Asked again: another transaction may have begun to use it.
        if session.execute(delete(Blob).where(Blob.id == blob.id, ripe)).rowcount:  # type: ignore[attr-defined]
            freed = Project.used_bytes - blob.size_bytes
            session.execute(update(Project).where(Project.id == blob.project_id).values(used_bytes=freed))
            keys.append(blob.key)
    return keys


def lose(session: Session, blob_id: str) -> None:
    """Note that a file's bytes did not survive: no drive has the file any more, and its space is free.

    What is left of the object is named by no blob then, and collected like all such.
    """
    session.execute(update(DriveFile).where(DriveFile.blob_id == blob_id).values(blob_id=None, stored_us=None))
    session.execute(update(Blob).where(Blob.id == blob_id).values(touched_us=0))
    forget_unused(session, untouched_since_us=1)


def known_keys(session: Session, keys: list[str]) -> set[str]:
    """Those of the keys that belong to a blob."""
    return set(session.scalars(select(Blob.key).where(Blob.key.in_(keys))))
