"""Jobs are asked for, cancelled, and asked for again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, TypedDict, Unpack

from sqlalchemy import func, or_, select, update
from sqlalchemy.orm import Session

from schemas.api.drives import PreflightState
from schemas.api.jobs import JobKind
from schemas.api.resource import Finding
from service.database.connections import clock_us
from service.database.tables import Drive, Job, JobState, Project, new_id
from service.domain.jobs._completion import after_end
from service.domain.jobs._dependencies import orphans
from service.domain.jobs._queries import ACTIVE, active_of_drive, change, close_attempts, locked, tell_state
from service.errors import (
    CheckActive,
    DriveDeleted,
    JobEnded,
    JobNotFailed,
    JobOfTree,
    QuotaFull,
    RetryActive,
    TooManyJobs,
    drive_rejected,
)

# A drive's check is part of committing it, and a sub-map of its reconstruction.
_UNCOUNTED = (JobKind.PREFLIGHT, JobKind.SUBMAP)


class OfTree(TypedDict, total=False):
    """Fields of a job in a tree."""

    map_id: str
    request: dict[str, Any]
    is_child: bool
    parent_id: str
    waiting_for: int


def create(
    session: Session,
    *,
    project_id: str,
    kind: JobKind,
    drive_id: str | None,
    settings: Mapping[str, Any] | None = None,
    retry_of: str | None = None,
    expires_us: int | None = None,
    has_place: bool = False,
    **of_tree: Unpack[OfTree],
) -> Job:
    """Record a new job; it exists once the session commits.

    Parameters
    ----------
    drive_id
        None for an aggregation, which has a map.
    has_place
        Whether this transaction has asked `require_places` for it, together with others: all that is active would
        else be counted anew for each of them.
    of_tree
        Of a job that waits for others, and of a job that another one needs.

    Raises
    ------
    ServiceError
        429 where the project has as many active jobs as its quota allows, 413 where it has no space left.
    """
    if kind not in _UNCOUNTED and not has_place:
        require_places(session, project_id, 1)
    job = Job(
        id=new_id("job"),
        project_id=project_id,
        kind=kind,
        drive_id=drive_id,
        settings=dict(settings or {}),
        retry_of=retry_of,
        expires_us=expires_us,
        **of_tree,
    )
    session.add(job)
    session.flush()
    tell_state(session, job.id)
    return job


def require_places(session: Session, project_id: str, count: int) -> None:
    """Refuse jobs that the project's quota has no room for now.

    Parameters
    ----------
    count
        How many come at one time.

    Raises
    ------
    ServiceError
        429 for the count; 413 where the project's space is used up: results may exceed it, but each job adds to them.
    """
    # Locked, so that two requests cannot take the last place together. Not its key: each row that names the project
    # holds that, and two transactions that have written such a row would wait for each other.
    project = session.get_one(Project, project_id, with_for_update={"key_share": True})
    if project.used_bytes >= project.max_bytes:
        raise QuotaFull(
            f"{project.used_bytes} of {project.max_bytes} bytes are used: there is no space for what a job makes",
            remedy="Delete drives, scenes or maps that are not needed any more (their space is free within about an "
            "hour), or ask the operator for a larger quota.",
        )
    mine = (Job.project_id == project_id) & Job.kind.not_in(_UNCOUNTED) & Job.state.in_(ACTIVE)
    active = session.scalar(select(func.count()).select_from(Job).where(mine)) or 0
    if active + count > project.max_active_jobs:
        wanted = f", and this needs {count} more at one time" if count > 1 else ""
        raise TooManyJobs(
            f"the project has {active} jobs queued or running, its quota is {project.max_active_jobs}{wanted}",
            remedy="Wait until some have ended, or cancel some, or ask the operator for a larger quota "
            "('mrasfm projects set').",
            headers={"Retry-After": "60"},
        )


def request_cancel(session: Session, job_id: str) -> None:
    """Ask for the job's end. At once where no worker holds it; a worker that does sees it soon.

    Raises
    ------
    ServiceError
        409 where the job has ended otherwise.
    """
    job = locked(session, job_id)  # else the job could pass from one state to the other between two conditions
    now = clock_us(session)
    unheld = or_(
        Job.state == JobState.QUEUED, (Job.state == JobState.RUNNING) & (func.coalesce(Job.lease_until_us, 0) < now)
    )
    ended = {"state": JobState.CANCELLED, "finished_us": now, "cancel_requested_us": now, "owner": None}
    if change(session, job_id, unheld, ended):
        close_attempts(session, job_id, "cancelled")
        after_end(session, job_id)
        return
    running = (Job.state == JobState.RUNNING) & Job.cancel_requested_us.is_(None)
    if change(session, job_id, running, {"cancel_requested_us": now}):
        tell_state(session, job_id)
        return
    if job.state in (JobState.SUCCEEDED, JobState.FAILED):
        raise JobEnded(
            f"job {job_id} has {job.state.lower()} and cannot be cancelled",
            remedy="Delete its scene if the result is not wanted." if job.scene_id else "Nothing is left to do.",
        )


def cancel_orphan(session: Session, job_id: str) -> bool:
    """End a job that was made for another one, unless one has come to wait for it; whether it was ended."""
    locked(session, job_id)  # who begins to wait for it holds this row, too
    if not orphans(session, among=[job_id]):
        return False
    request_cancel(session, job_id)
    return True


def retry(session: Session, job: Job, *, expires_us: int | None) -> Job:
    """A new job that does the same as one that failed or was cancelled; `aggregations.retry` for an aggregation.

    Raises
    ------
    ServiceError
        409 where the job has not ended, has succeeded, is a sub-map's, is being done again already, its drive was
        deleted or needs no other check; 422 where the drive was rejected; 413 and 429 as `create`.
    """
    require_failed(job)
    if job.parent_id is not None:
        raise JobOfTree(
            f"job {job.id} maps a piece of a drive for reconstruction {job.parent_id}, which has ended with it",
            remedy=f"Retry that one, POST /v1/jobs/{job.parent_id}:retry: finished stages are reused.",
        )
    drive = session.get(Drive, job.drive_id or "", with_for_update=True, populate_existing=True)
    if drive is None:
        raise DriveDeleted(
            f"drive {job.drive_id} of job {job.id} was deleted",
            remedy="Create the drive again and ask for its reconstruction.",
        )
    kind = JobKind(job.kind)
    if kind is JobKind.PREFLIGHT:
        _require_unchecked(session, drive)
    else:
        require_not_rejected(drive)
        _require_not_retried(session, job)
    new = create(
        session,
        project_id=job.project_id,
        kind=kind,
        drive_id=drive.id,
        settings=job.settings,
        retry_of=job.id,
        expires_us=expires_us,
    )
    if kind is JobKind.PREFLIGHT:
        values = {"preflight_job_id": new.id, "preflight_state": PreflightState.PENDING}
        session.execute(update(Drive).where(Drive.id == job.drive_id).values(**values))
    return new


def require_not_rejected(drive: Drive) -> None:
    """Refuse to reconstruct a drive whose check found errors.

    Raises
    ------
    ServiceError
        422 with the findings.
    """
    if drive.preflight_state == PreflightState.REJECTED:
        raise drive_rejected(drive.id, [Finding.model_validate(finding) for finding in drive.findings])


def _require_not_retried(session: Session, job: Job) -> None:
    """Refuse to do a job's hours of work twice at one time. The caller has locked the drive, as other retries do."""
    for active in session.scalars(active_of_drive(job.drive_id or "").where(Job.retry_of.is_not(None))):
        if job.id in _retried_by(session, active):
            raise RetryActive(
                f"job {job.id} is being done again already, by job {active.id}",
                remedy=f"Look at that job, GET /v1/jobs/{active.id}, or cancel it first.",
            )


def _retried_by(session: Session, job: Job) -> Iterator[str]:
    """The job that this one is a retry of, and in turn what that one is a retry of."""
    retry_of = job.retry_of
    while retry_of is not None:
        yield retry_of
        retry_of = session.scalar(select(Job.retry_of).where(Job.id == retry_of))


def require_failed(job: Job) -> None:
    """Refuse to repeat a job that may still succeed, or did.

    Raises
    ------
    ServiceError
        409.
    """
    if job.state not in (JobState.FAILED, JobState.CANCELLED):
        raise JobNotFailed(
            f"job {job.id} is {job.state}: only a job that failed or was cancelled can be retried",
            remedy="Wait for its end, or ask for a new one.",
        )


def _require_unchecked(session: Session, drive: Drive) -> None:
    """Checks are not counted against a quota, so a drive has one at a time, and no other after its result."""
    active = session.scalars(active_of_drive(drive.id).where(Job.kind == JobKind.PREFLIGHT)).first()
    if active is not None:
        what = f"drive {drive.id} is being checked already, by job {active.id}"
    elif drive.preflight_state in (PreflightState.PASSED, PreflightState.REJECTED):
        what = f"drive {drive.id} was checked already: it is {drive.preflight_state}"
    else:
        return
    raise CheckActive(what, remedy="Look at the drive: it shows its findings, and the job that checks it.")
