"""Blobs: bytes in the artifact store, their owners, and the records that still need them."""

from __future__ import annotations

import re
import secrets
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, bindparam, delete, func, select, update
from sqlalchemy import exists as sql_exists
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session, aliased

from service.database.connections import Database, clock_expression, clock_us
from service.database.tables import (
    Blob,
    Checkpoint,
    Drive,
    DriveFile,
    ExportFile,
    MapCheckpoint,
    MapFile,
    Project,
    SceneFile,
    new_id,
)
from service.errors import QuotaFull, ServiceError, StorageChanged


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """A blob's identity."""

    id: str
    key: str
    size_bytes: int


@dataclass(frozen=True)
class UnusedPage:
    """The unused among some blobs, by id, and the last content that was looked at; None after the last page."""

    blob_ids: list[str]
    last_sha256: str | None


# A blob's object, or a copy of it that was begun.
_KEY = re.compile(r"blobs/(prj_[0-9a-f]+)/[0-9a-f]{2}/(?:[0-9a-f]{64}-[0-9a-f]{8}|\.[0-9a-f]{16}\.partial)")
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
_LOCK_PROJECT = select(Project.id).where(Project.id == bindparam("project")).with_for_update(key_share=True)
_TAKE_SPACE_WITHIN_QUOTA = _TAKE_SPACE.where(Project.used_bytes + bindparam("size") <= Project.max_bytes)


def new_key(project_id: str, sha256: str) -> str:
    """Make the key in the artifact store of a content that is not stored yet."""
    return f"blobs/{project_id}/{sha256[:2]}/{sha256}-{secrets.token_hex(4)}"


def project_of(key: str) -> str | None:
    """The project that a key was made for; None where it was not made by us."""
    made = _KEY.fullmatch(key)
    return None if made is None else made[1]


def exists(session: Session, project_id: str, sha256: str) -> bool:
    """Return whether the project has this content."""
    found = select(Blob.id).where(Blob.project_id == project_id, Blob.sha256 == sha256)
    return session.scalar(found) is not None


def none_is_recorded(database: Database) -> bool:
    """Return whether no project has any content yet, or none any more."""
    with database.read() as session:
        return session.scalar(select(Blob.id).limit(1)) is None


def is_drive_file(blob: type[Blob] = Blob) -> ColumnElement[bool]:
    """The condition that a drive has a blob as a file. What else a project stores was not checked to be an image."""
    return sql_exists().where(DriveFile.blob_id == blob.id)


def lock_project(session: Session, project_id: str) -> None:
    """Take a project's turn, before the first of its blobs is changed.

    Two transactions with the same contents in another order would otherwise wait for each other, one for the blob, one
    for the project's space. SQLite's writers take turns anyway.
    """
    connection = session.connection()
    if connection.dialect.name == "postgresql":
        connection.execute(_LOCK_PROJECT, {"project": project_id})


def find(session: Session, project_id: str, sha256: str) -> Blob | None:
    """The project's blob of this content, kept from being collected for a while."""
    blob = session.scalar(select(Blob).where(Blob.project_id == project_id, Blob.sha256 == sha256))
    if blob is not None:
        session.execute(update(Blob).where(Blob.id == blob.id).values(touched_us=clock_expression(session)))
    return blob


def record(
    session: Session,
    *,
    project_id: str,
    sha256: str,
    size_bytes: int,
    key: str,
    is_new: bool = True,
    written_in_boot: str | None = None,
    within_quota: bool = True,
) -> Recorded:
    """The project's blob of a content that was stored under `key`.

    Where the content was there already the older blob is returned, whose key differs: the caller deletes what it
    stored.

    Parameters
    ----------
    is_new
        Whether the caller has stored the object. Else it was found, and must still be there: an object of a blob that
        is gone is deleted.
    written_in_boot
        Where a power cut could still take the bytes: see `durability`.
    within_quota
        Whether the quota may refuse it. Results may exceed it: hours of work are not thrown away for it.

    Raises
    ------
    ServiceError
        413 where the project's quota would be exceeded, 503 where the object that was found has been collected since.
    """
    lock_project(session, project_id)
    connection = session.connection()
    if not is_new:
        return _recorded_before(session, project_id, sha256)
    content = {"sha256": sha256, "size_bytes": size_bytes, "key": key, "written_in_boot": written_in_boot}
    row = _row(project_id, content, clock_us(session))
    if connection.execute(_INSERT[connection.dialect.name], row).first() is not None:
        _take_space(session, project_id, size_bytes, within_quota=within_quota)
        return Recorded(id=row["id"], key=key, size_bytes=size_bytes)
    return _recorded_before(session, project_id, sha256)


def record_all(
    session: Session, project_id: str, contents: Sequence[Mapping[str, Any]], *, touched_us: int
) -> dict[str, Recorded]:
    """The project's blobs of some hundred contents that were stored anew, by digest; as `record`.

    Parameters
    ----------
    contents
        As `StoredFile.identity` has them; no two alike.
    touched_us
        When, and what `rollback` knows them by.

    Raises
    ------
    ServiceError
        413 where the project's quota would be exceeded.
    """
    lock_project(session, project_id)
    connection = session.connection()
    rows = [_row(project_id, content, touched_us) for content in contents]
    inserted = set(connection.scalars(_INSERT[connection.dialect.name], rows))
    recorded = {
        row["sha256"]: Recorded(id=row["id"], key=row["key"], size_bytes=row["size_bytes"])
        for row in rows
        if row["id"] in inserted
    }
    if recorded:
        _take_space(session, project_id, sum(blob.size_bytes for blob in recorded.values()), within_quota=True)
    known = (Blob.project_id == project_id) & Blob.sha256.in_(
        row["sha256"] for row in rows if row["id"] not in inserted
    )
    touched = update(Blob).where(known).values(touched_us=clock_expression(session))
    session.execute(touched.execution_options(synchronize_session=False))
    for blob in session.scalars(select(Blob).where(known)):
        recorded[blob.sha256] = Recorded(id=blob.id, key=blob.key, size_bytes=blob.size_bytes)
    return recorded


def rollback(session: Session, project_id: str, blob_ids: Sequence[str], *, touched_us: int) -> None:
    """Forget some hundred blobs that `record_all` recorded for nothing.

    Those that another request has found since stay: it relies on them for a while.
    """
    lock_project(session, project_id)
    _forget(session, Blob.id.in_(blob_ids) & (Blob.touched_us == touched_us) & unused())


def _row(project_id: str, content: Mapping[str, Any], touched_us: int) -> dict[str, Any]:
    names = ("sha256", "size_bytes", "key", "written_in_boot")
    told = {name: content[name] for name in names}
    return {"id": new_id("blb"), "project_id": project_id, "touched_us": touched_us, **told}


def _recorded_before(session: Session, project_id: str, sha256: str) -> Recorded:
    blob = find(session, project_id, sha256)
    if blob is None:
        raise _storage_changed(sha256)
    return Recorded(id=blob.id, key=blob.key, size_bytes=blob.size_bytes)


def _storage_changed(sha256: str) -> ServiceError:
    return StorageChanged(
        f"the bytes with SHA-256 {sha256} were there when this began, and have been deleted since as unused",
        remedy="Repeat it from the start: the bytes are stored anew then.",
        headers={"Retry-After": "1"},
    )


def _take_space(session: Session, project_id: str, size_bytes: int, *, within_quota: bool) -> None:
    statement = _TAKE_SPACE_WITHIN_QUOTA if within_quota else _TAKE_SPACE
    if session.connection().execute(statement, {"project": project_id, "size": size_bytes}).rowcount:
        return
    project = session.get_one(Project, project_id)
    raise quota_full(project, size_bytes)


def quota_full(project: Project, size_bytes: int, *, coming_bytes: int = 0) -> ServiceError:
    """413: what is to be stored does not fit the project's quota; `coming_bytes` are announced by open uploads."""
    coming = f", {coming_bytes} are being uploaded" if coming_bytes else ""
    return QuotaFull(
        f"{size_bytes} bytes do not fit: {project.used_bytes} of {project.max_bytes} bytes are used{coming}",
        remedy="Delete drives or scenes that are not needed any more, or ask the operator for a larger quota "
        "('mrasfm projects set').",
    )


def unused(blob: type[Blob] = Blob) -> ColumnElement[bool]:
    """The condition that nothing refers to a blob."""
    return ~(
        sql_exists().where(Drive.manifest_blob_id == blob.id)
        | is_drive_file(blob)
        | sql_exists().where(SceneFile.blob_id == blob.id)
        | sql_exists().where(Checkpoint.blob_id == blob.id)
        | sql_exists().where(MapFile.blob_id == blob.id)
        | sql_exists().where(MapCheckpoint.blob_id == blob.id)
        | sql_exists().where(ExportFile.blob_id == blob.id)
    )


def find_unused(
    session: Session, project_id: str, *, untouched_since_us: int, after_sha256: str = "", look_at: int
) -> UnusedPage:
    """Some of a project's blobs in the order of their contents, as far as nothing refers to them.

    Parameters
    ----------
    after_sha256
        The last content of the page before.
    look_at
        How many blobs are looked at. Of a project of millions a statement without this bound would read all, to find
        the few that are unused, and run out of its time.

    Returns
    -------
    UnusedPage
        With what `forget_unused` may be given.
    """
    of_project = select(Blob).where(Blob.project_id == project_id, Blob.sha256 > after_sha256)
    page = aliased(Blob, of_project.order_by(Blob.sha256).limit(look_at).subquery())
    last = session.scalar(select(func.max(page.sha256)))
    return UnusedPage(list(session.scalars(select(page.id).where(_ripe(untouched_since_us, page)))), last)


def unused_among(session: Session, blob_ids: Sequence[str], *, untouched_since_us: int) -> list[str]:
    """Ids of some hundred blobs that nothing refers to; what `forget_unused` may be given."""
    return list(session.scalars(select(Blob.id).where(Blob.id.in_(blob_ids), _ripe(untouched_since_us))))


def forget_unused(session: Session, *, untouched_since_us: int, blob_ids: Sequence[str] | None = None) -> list[str]:
    """Drop blobs that nothing refers to, and give their space back to their projects.

    Parameters
    ----------
    blob_ids
        Of these only, some hundreds; by default of all.

    Returns
    -------
    list of str
        Keys of objects to delete from the artifact store once this is committed.
    """
    ripe = _ripe(untouched_since_us)  # asked again: another transaction may have begun to use one
    if blob_ids is not None:
        ripe &= Blob.id.in_(blob_ids)
    # The projects first, as `lock_project` does, and always in one order.
    owners = select(Project.id).where(Project.id.in_(select(Blob.project_id).where(ripe))).order_by(Project.id)
    session.execute(owners.with_for_update(key_share=True))
    return _forget(session, ripe)


def _forget(session: Session, condition: ColumnElement[bool]) -> list[str]:
    dropped = delete(Blob).where(condition).returning(Blob.project_id, Blob.size_bytes, Blob.key)
    rows = session.execute(dropped.execution_options(synchronize_session=False)).all()
    freed: Counter[str] = Counter()
    for row in rows:
        freed[row.project_id] += row.size_bytes
    for project_id, size_bytes in freed.items():
        left = Project.used_bytes - size_bytes
        session.execute(update(Project).where(Project.id == project_id).values(used_bytes=left))
    return [row.key for row in rows]


def _ripe(untouched_since_us: int, blob: type[Blob] = Blob) -> ColumnElement[bool]:
    return unused(blob) & (blob.touched_us < untouched_since_us)


def lose(session: Session, blob_id: str) -> None:
    """Note that a file's bytes did not survive: no drive has the file any more, and its space is free.

    What is left of the object is named by no blob then, and collected like all such.
    """
    session.execute(update(DriveFile).where(DriveFile.blob_id == blob_id).values(blob_id=None, stored_us=None))
    session.execute(update(Blob).where(Blob.id == blob_id).values(touched_us=0))
    forget_unused(session, untouched_since_us=1, blob_ids=[blob_id])


def known_keys(session: Session, keys: list[str]) -> set[str]:
    """The keys that belong to a blob."""
    return set(session.scalars(select(Blob.key).where(Blob.key.in_(keys))))


def orphans(session: Session, keys: Sequence[str]) -> set[str]:
    """The keys that were made for projects of this database, and that no blob names.

    Others share the bucket or the folder: what is not certainly ours is not an orphan.
    """
    owner = {key: project_id for key in keys if (project_id := project_of(key)) is not None}
    ours = set(session.scalars(select(Project.id).where(Project.id.in_(set(owner.values())))))
    known = known_keys(session, list(owner))
    return {key for key, project_id in owner.items() if project_id in ours} - known
