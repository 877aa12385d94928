"""Exports: asked for, published whole or not at all, found again where the same is asked for, deleted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy import ColumnElement, Select, delete, or_, select
from sqlalchemy.orm import Session

from schemas.api.exports import ExportRequest
from schemas.api.jobs import JobKind
from service.database.tables import (
    TERMINAL,
    Drive,
    Export,
    ExportFile,
    Job,
    JobState,
    MapVersion,
    Scene,
    new_id,
    now_us,
)
from service.domain import jobs
from service.domain.export_inputs import ExportInputs, drive_deleted
from service.domain.scenes import media_type
from service.errors import ExportActive, ExportDeleted, UsedByJob
from service.storage import blobs, named_blobs
from service.storage.blob_writer import StoredFile
from service.storage.named_blobs import Named


class ExportGoneError(Exception):
    """The export was deleted."""


def create(
    session: Session,
    *,
    project_id: str,
    subject: Scene | MapVersion,
    asked: ExportRequest,
    job_expires_us: int | None,
) -> tuple[Export, Job | None]:
    """Record an export of a scene or version, which the caller has locked, and its job.

    Returns
    -------
    export, job
        The job is None where the same is there, or under way, already.

    Raises
    ------
    ServiceError
        409 where a drive whose images are needed was deleted; 422 where the scene or map has no such component, or
        lacks what a format needs; 413 and 429 as for all jobs.
    """
    inputs = ExportInputs.from_request(subject, asked)
    inputs.require(session)
    known = _same(session, project_id, inputs.sha256)
    if known is not None:
        return known, None
    export_id = new_id("exp")
    job = jobs.create(
        session,
        project_id=project_id,
        kind=JobKind.EXPORT,
        # A drive that a job names is not deleted meanwhile; those of a map are not, anyway.
        drive_id=inputs.drives(session).get(""),
        expires_us=job_expires_us,
        request={"export_id": export_id},
    )
    export = Export(
        id=export_id,
        project_id=project_id,
        job_id=job.id,
        inputs_sha256=inputs.sha256,
        formats=list(inputs.formats),
        options=dict(inputs.options),
        **inputs.source,
    )
    session.add(export)
    session.flush()
    return export, job


def retry(session: Session, job: Job, *, expires_us: int | None) -> Job:
    """A new job for an export whose job failed or was cancelled.

    Raises
    ------
    ServiceError
        409 where the export or a drive was deleted, another job makes it, or the job did not fail; 413 and 429.
    """
    jobs.require_failed(job)
    export = session.get(Export, _export_id(job.request), with_for_update=True, populate_existing=True)
    if export is None:
        raise ExportDeleted(f"the export of job {job.id} was deleted", remedy="Ask for it anew.")
    if export.job_id != job.id:
        raise ExportActive(f"job {export.job_id} makes export {export.id}", remedy="Look at that job.")
    if job.drive_id is not None and session.get(Drive, job.drive_id, with_for_update=True) is None:
        raise drive_deleted(job.drive_id)
    new = jobs.create(
        session,
        project_id=job.project_id,
        kind=JobKind.EXPORT,
        drive_id=job.drive_id,
        retry_of=job.id,
        expires_us=expires_us,
        request=dict(job.request or {}),
    )
    export.job_id = new.id
    return new


def inputs_of(session: Session, held: jobs.Claim) -> ExportInputs:
    """The inputs of an export that is being made.

    Raises
    ------
    ExportGoneError
        Where it was deleted.
    """
    export = session.get(Export, _export_id(held.request))
    if export is None:
        raise ExportGoneError(_export_id(held.request))
    return ExportInputs.from_export(session, export)


def publish(
    session: Session,
    held: jobs.Claim,
    *,
    files: Mapping[str, StoredFile],
    results: Sequence[Mapping[str, Any]],
    expires_us: int | None,
) -> str:
    """Put stored files, by path, into the job's export, and end the job; the export's id.

    Raises
    ------
    FencedError
        Where the job is not this holder's any more; the caller's session must roll back.
    """
    export_id = _export_id(held.request)
    jobs.succeed(session, held)  # first: it sees whether the job is still held
    export = session.get_one(Export, export_id, with_for_update=True, populate_existing=True)
    export.fence, export.results, export.expires_us = held.fence, [dict(result) for result in results], expires_us
    session.flush()
    for path, file in files.items():
        blob = blobs.record(session, project_id=held.project_id, within_quota=False, **file.identity)
        session.add(ExportFile(export_id=export_id, path=path, blob_id=blob.id, media_type=media_type(path)))
    return export_id


def remove(session: Session, export: Export) -> Named:
    """Delete an export, which the caller has locked.

    Returns
    -------
    Named
        Blobs that it named.

    Raises
    ------
    ServiceError
        409 while it is being made.
    """
    job = session.get(Job, export.job_id)
    if job is not None and job.state not in TERMINAL:
        raise ExportActive(
            f"job {job.id} is making export {export.id}",
            remedy="Wait for its end, or cancel it.",
        )
    named = named_blobs.of_export(session, export.id)
    session.execute(delete(Export).where(Export.id == export.id))
    return named


def require_none_active(session: Session, *, what: str, mine: ColumnElement[bool]) -> None:
    """Refuse to delete what is being exported.

    Parameters
    ----------
    mine
        Selects the exports of what is to be deleted.

    Raises
    ------
    ServiceError
        409 with the job's id.
    """
    job_id = session.scalar(_active().where(mine).limit(1))
    if job_id is not None:
        raise UsedByJob(f"{what} is being exported by job {job_id}", remedy="Wait for its end, or cancel it.")


def is_exported(mine: ColumnElement[bool]) -> ColumnElement[bool]:
    """The condition that a job exports what `mine` selects the exports of."""
    return _active().where(mine).exists()


def forget_expired(session: Session, now: int, *, limit: int = 20) -> int:
    """Delete exports that have passed their retention dates, and those that were never made and have no job any more.

    Returns
    -------
    int
        How many were deleted; 0 where none is left.
    """
    of_job = select(Job.id).where(Job.id == Export.job_id)
    active = of_job.where(Job.state.not_in(TERMINAL)).exists()
    ripe = or_((Export.expires_us < now) & ~active, Export.results.is_(None) & ~of_job.exists())
    found = session.scalars(select(Export.id).where(ripe).order_by(Export.id).limit(limit).with_for_update()).all()
    # Asked again under the locks: one that is retried at this moment has a job by now.
    dropped = delete(Export).where(Export.id.in_(found), ripe).execution_options(synchronize_session=False)
    return int(session.execute(dropped).rowcount)  # type: ignore[attr-defined]


def _active() -> Select[str]:
    return select(Job.id).join(Export, Export.job_id == Job.id).where(Job.state.not_in(TERMINAL))


def _export_id(request: Mapping[str, Any] | None) -> str:
    return str((request or {})["export_id"])


def _same(session: Session, project_id: str, inputs: str) -> Export | None:
    """An export of the same that is there with all formats, or will be; not one that is deleted at any moment."""
    same = (Export.project_id == project_id) & (Export.inputs_sha256 == inputs)
    same &= Export.expires_us.is_(None) | (Export.expires_us > now_us())
    for export in session.scalars(select(Export).where(same).order_by(Export.created_us.desc())):
        if export.results is not None:
            if not any(result.get("withheld") for result in export.results):
                return export
            continue
        job = session.get(Job, export.job_id)
        if job is not None and job.state in (JobState.QUEUED, JobState.RUNNING) and job.cancel_requested_us is None:
            return export
    return None
