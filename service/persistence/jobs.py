"""Jobs: the only statements that change a job's state.

    QUEUED -> RUNNING -> SUCCEEDED | FAILED | CANCELLED

and back from RUNNING to QUEUED when an attempt failed in a way that may pass, when its worker died, or when its worker
was told to stop. A worker holds a job by a lease that it renews with every heartbeat, and by a fencing number that
rises with every claim. All that it writes is conditional on that number: a worker that was believed dead and comes
back writes nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, Select, delete, func, or_, select, tuple_, update
from sqlalchemy.orm import Session, load_only

from schemas.api.drives import DriveState, PreflightState
from schemas.api.jobs import JobKind
from schemas.api.problems import PROBLEM_TYPE, Problem
from service.errors import ServiceError
from service.persistence.database import clock_us
from service.persistence.tables import (
    TERMINAL,
    Drive,
    Job,
    JobAttempt,
    JobEvent,
    JobState,
    Project,
    new_id,
    now_us,
)

_ACTIVE = (JobState.QUEUED, JobState.RUNNING)


class FencedError(Exception):
    """The job is not this holder's any more: it was given to another worker, or has ended."""


@dataclass(frozen=True, kw_only=True)
class Claim:
    """A job that a worker holds, and what it needs to know to do it."""

    job_id: str
    fence: int
    attempt: int
    project_id: str
    kind: JobKind
    drive_id: str
    settings: dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class ProgressNote:
    """How far an attempt is; `percent` is of the whole job."""

    stage: str
    done: int
    total: int
    unit: str | None
    percent: float
    eta_low_s: float | None
    eta_high_s: float | None
    reused: Sequence[str] = ()


def create(
    session: Session,
    *,
    project_id: str,
    kind: JobKind,
    drive_id: str,
    settings: Mapping[str, Any] | None = None,
    retry_of: str | None = None,
    expires_us: int | None = None,
) -> Job:
    """Record a new job; it exists once the session commits.

    Raises
    ------
    ServiceError
        429 where the project has as many active jobs as its quota allows.
    """
    if kind is not JobKind.PREFLIGHT:  # a drive's check is part of committing it
        _require_place(session, project_id)
    job = Job(
        id=new_id("job"),
        project_id=project_id,
        kind=kind,
        drive_id=drive_id,
        settings=dict(settings or {}),
        retry_of=retry_of,
        expires_us=expires_us,
    )
    session.add(job)
    session.flush()
    _tell_state(session, job.id)
    return job


def _require_place(session: Session, project_id: str) -> None:
    # Locked, so that two requests cannot take the last place together.
    project = session.get_one(Project, project_id, with_for_update=True)
    mine = (Job.project_id == project_id) & (Job.kind != JobKind.PREFLIGHT) & Job.state.in_(_ACTIVE)
    active = session.scalar(select(func.count()).select_from(Job).where(mine)) or 0
    if active >= project.max_active_jobs:
        raise ServiceError(
            429,
            "too-many-jobs",
            "Too many jobs",
            f"the project has {active} jobs queued or running, its quota is {project.max_active_jobs}",
            remedy="Wait until some have ended, or cancel some.",
            headers={"Retry-After": "60"},
        )


def claim(session: Session, job_id: str, *, owner: str, lease_us: int) -> Claim | None:
    """Take a queued job.

    Returns
    -------
    Claim or None
        None where there is nothing to do: another worker has it, it has ended, or it is not due yet. A message that
        leads here may be dropped; the reconciler sends another when the job is due.
    """
    now = clock_us(session)
    values = {
        "state": JobState.RUNNING,
        "fence": Job.fence + 1,
        "attempt": Job.attempt + 1,
        "owner": owner,
        "lease_until_us": now + lease_us,
        "heartbeat_us": now,
        "started_us": func.coalesce(Job.started_us, now),
        "percent": 0.0,
        "stage": None,
        "done": None,
        "total": None,
        "unit": None,
        "eta_low_s": None,
        "eta_high_s": None,
        "reused": [],
    }
    due = (Job.state == JobState.QUEUED) & (Job.not_before_us <= now)
    if not _change(session, job_id, due, values):
        return None
    job = session.get_one(Job, job_id, populate_existing=True)
    session.add(JobAttempt(job_id=job_id, fence=job.fence, attempt=job.attempt, owner=owner))
    _tell_state(session, job_id)
    return Claim(
        job_id=job_id,
        fence=job.fence,
        attempt=job.attempt,
        project_id=job.project_id,
        kind=JobKind(job.kind),
        drive_id=job.drive_id,
        settings=job.settings,
    )


def heartbeat(session: Session, held: Claim, *, lease_us: int, note: ProgressNote | None = None) -> bool:
    """Renew the lease, and say how far the attempt is.

    Returns
    -------
    bool
        Whether somebody asked to cancel the job.

    Raises
    ------
    FencedError
        Where the job is not this holder's any more.
    """
    now = clock_us(session)
    values: dict[str, Any] = {"lease_until_us": now + lease_us, "heartbeat_us": now}
    if note is not None:
        values |= {
            "stage": note.stage,
            "done": note.done,
            "total": note.total,
            "unit": note.unit,
            "percent": note.percent,
            "eta_low_s": note.eta_low_s,
            "eta_high_s": note.eta_high_s,
            "reused": list(note.reused),
        }
    _require(_change(session, held.job_id, _held(held), values))
    job = session.get_one(Job, held.job_id, populate_existing=True)
    if note is not None:
        _drop_progress(session, job.id)
        shown = ("stage", "done", "total", "unit", "percent", "eta_low_s", "eta_high_s")
        data = {"attempt": job.attempt, **{name: getattr(job, name) for name in shown}}
        session.add(JobEvent(job_id=job.id, kind="progress", data=data))
    return job.cancel_requested_us is not None


def cancel_requested(session: Session, held: Claim) -> bool:
    """Whether somebody asked to cancel the job; asked between heartbeats, and writes nothing.

    Raises
    ------
    FencedError
        Where the job is not this holder's any more.
    """
    row = session.execute(select(Job.cancel_requested_us).where(Job.id == held.job_id, _held(held))).one_or_none()
    if row is None:
        raise FencedError
    return row.cancel_requested_us is not None


def has_succeeded(session: Session, held: Claim) -> bool:
    """Whether this holder, and no other, has ended the job as succeeded."""
    by_holder = (Job.state == JobState.SUCCEEDED) & (Job.fence == held.fence)
    return session.scalar(select(Job.id).where(Job.id == held.job_id, by_holder)) is not None


def succeed(session: Session, held: Claim, *, scene_id: str | None = None, reused: Sequence[str] = ()) -> None:
    """End the job; what it made is written in the same session.

    A job whose end was asked for ends so too: what was finished first wins.

    Parameters
    ----------
    reused
        Stages whose results were there already: all of them, where progress told of those it had time for.

    Raises
    ------
    FencedError
        Where the job is not this holder's any more; the caller's session must roll back.
    """
    _end(
        session,
        held,
        JobState.SUCCEEDED,
        "succeeded",
        {"percent": 100.0, "eta_low_s": 0.0, "eta_high_s": 0.0, "scene_id": scene_id, "reused": list(reused)},
    )


def fail(session: Session, held: Claim, problem: Problem, *, max_attempts: int, retry_delay_us: int) -> JobState:
    """End the attempt, and the job where another would not help, none is left or nobody wants it any more.

    A job whose end was asked for ends as cancelled; what its last attempt failed of stays with the attempt.

    Raises
    ------
    FencedError
        Where the job is not this holder's any more.
    """
    described = problem.model_dump(mode="json", exclude_none=True)
    outcome = problem.type.removeprefix(PROBLEM_TYPE)
    job = _locked(session, held.job_id)
    if job.cancel_requested_us is not None:
        _end(session, held, JobState.CANCELLED, outcome, {}, problem=described)
        return JobState.CANCELLED
    if problem.retryable and held.attempt < max_attempts:
        _requeue(session, held, outcome, described, not_before_us=clock_us(session) + retry_delay_us)
        return JobState.QUEUED
    _end(session, held, JobState.FAILED, outcome, {"problem": described}, problem=described)
    return JobState.FAILED


def cancelled(session: Session, held: Claim) -> None:
    """End the job as cancelled: its stage has stopped.

    Raises
    ------
    FencedError
        Where the job is not this holder's any more.
    """
    _end(session, held, JobState.CANCELLED, "cancelled", {})


def release(session: Session, held: Claim) -> None:
    """Give the job back, for another worker: this one was told to stop. The attempt is not counted.

    A job whose end was asked for ends here: no other worker may come for it.

    Raises
    ------
    FencedError
        Where the job is not this holder's any more.
    """
    if _locked(session, held.job_id).cancel_requested_us is not None:
        cancelled(session, held)
        return
    _requeue(session, held, "released", None, not_before_us=0, counted=False)


def request_cancel(session: Session, job_id: str) -> None:
    """Ask for the job's end. At once where no worker holds it; a worker that does sees it soon.

    Raises
    ------
    ServiceError
        409 where the job has ended otherwise.
    """
    job = _locked(session, job_id)  # else the job could pass from one state to the other between two conditions
    now = clock_us(session)
    unheld = or_(
        Job.state == JobState.QUEUED, (Job.state == JobState.RUNNING) & (func.coalesce(Job.lease_until_us, 0) < now)
    )
    ended = {"state": JobState.CANCELLED, "finished_us": now, "cancel_requested_us": now, "owner": None}
    if _change(session, job_id, unheld, ended):
        _close_attempts(session, job_id, "cancelled")
        _after_end(session, job_id)
        return
    running = (Job.state == JobState.RUNNING) & Job.cancel_requested_us.is_(None)
    if _change(session, job_id, running, {"cancel_requested_us": now}):
        _tell_state(session, job_id)
        return
    if job.state in (JobState.SUCCEEDED, JobState.FAILED):
        raise ServiceError(
            409,
            "job-ended",
            "The job has ended",
            f"job {job_id} has {job.state.lower()} and cannot be cancelled",
            remedy="Delete its scene if the result is not wanted." if job.scene_id else "Nothing is left to do.",
        )


def retry(session: Session, job: Job, *, expires_us: int | None) -> Job:
    """A new job that does the same as one that failed or was cancelled.

    Raises
    ------
    ServiceError
        409 where the job has not ended, has succeeded, its drive was deleted or needs no other check; 429 as
        `create`.
    """
    if job.state not in (JobState.FAILED, JobState.CANCELLED):
        raise ServiceError(
            409,
            "job-not-failed",
            "The job did not fail",
            f"job {job.id} is {job.state}: only a job that failed or was cancelled can be retried",
            remedy="Wait for its end, or ask for a new reconstruction.",
        )
    drive = session.get(Drive, job.drive_id, with_for_update=True, populate_existing=True)
    if drive is None:
        raise ServiceError(
            409,
            "drive-deleted",
            "The drive was deleted",
            f"drive {job.drive_id} of job {job.id} was deleted",
            remedy="Create the drive again and ask for its reconstruction.",
        )
    kind = JobKind(job.kind)
    if kind is JobKind.PREFLIGHT:
        _require_unchecked(session, drive)
    new = create(
        session,
        project_id=job.project_id,
        kind=kind,
        drive_id=job.drive_id,
        settings=job.settings,
        retry_of=job.id,
        expires_us=expires_us,
    )
    if kind is JobKind.PREFLIGHT:
        values = {"preflight_job_id": new.id, "preflight_state": PreflightState.PENDING}
        session.execute(update(Drive).where(Drive.id == job.drive_id).values(**values))
    return new


def _require_unchecked(session: Session, drive: Drive) -> None:
    """Checks are not counted against a quota, so a drive has one at a time, and no other after its result."""
    active = session.scalars(active_of_drive(drive.id).where(Job.kind == JobKind.PREFLIGHT)).first()
    if active is not None:
        what = f"drive {drive.id} is being checked already, by job {active.id}"
    elif drive.preflight_state in (PreflightState.PASSED, PreflightState.REJECTED):
        what = f"drive {drive.id} was checked already: it is {drive.preflight_state}"
    else:
        return
    raise ServiceError(
        409,
        "check-active",
        "The drive has its check",
        what,
        remedy="Look at the drive: it shows its findings, and the job that checks it.",
    )


def expire_leases(session: Session, *, max_attempts: int) -> list[str]:
    """Take jobs from workers that have not been heard of: queued again, or ended where no attempt is left.

    Returns
    -------
    list of str
        The jobs taken.
    """
    lost = select(Job).where(Job.state == JobState.RUNNING, Job.lease_until_us < clock_us(session))
    # A job that changes at this moment has a worker that lives, or is another reconciler's.
    lost = lost.with_for_update(skip_locked=True).execution_options(populate_existing=True)
    taken = []
    for job in session.scalars(lost).all():
        held = _claim_of(job)
        problem = Problem(
            type=PROBLEM_TYPE + "worker-lost",
            title="The worker was lost",
            detail=f"worker {job.owner} was not heard of any more during attempt {job.attempt}",
            remedy="Check the workers' machines and logs, then retry the job; finished stages are reused.",
            stage=job.stage,
            retryable=True,
            job_id=job.id,
        )
        described = problem.model_dump(mode="json", exclude_none=True)
        if job.cancel_requested_us is not None:
            _end(session, held, JobState.CANCELLED, "cancelled", {})
        elif job.attempt < max_attempts:
            _requeue(session, held, "worker-lost", described, not_before_us=0)
        else:
            _end(session, held, JobState.FAILED, "worker-lost", {"problem": described}, problem=described)
        taken.append(job.id)
    return taken


def end_lease(session: Session, job_id: str, fence: int) -> bool:
    """End the lease of an attempt whose process is known to be dead: nobody has to wait until it runs out.

    Returns
    -------
    bool
        Whether the attempt was under way.
    """
    under_way = (Job.state == JobState.RUNNING) & (Job.fence == fence)
    return _change(session, job_id, under_way, {"lease_until_us": 0})


def due(session: Session, *, after: Job | None = None, limit: int = 1000) -> list[Job]:
    """Queued jobs that a worker may take now, oldest first; only what their messages need is loaded.

    Parameters
    ----------
    after
        The last job of the page before.
    """
    statement = select(Job).where(Job.state == JobState.QUEUED, Job.not_before_us <= clock_us(session))
    if after is not None:
        statement = statement.where(tuple_(Job.created_us, Job.id) > (after.created_us, after.id))
    shown = load_only(Job.id, Job.kind, Job.fence, Job.created_us, raiseload=True)
    return list(session.scalars(statement.options(shown).order_by(Job.created_us, Job.id).limit(limit)))


def all_due(session: Session) -> Iterator[Job]:
    """All jobs that are due, page by page."""
    page = due(session)
    while page:
        yield from page
        page = due(session, after=page[-1])


def mark_enqueued(session: Session, job_ids: Sequence[str]) -> None:
    """Note that messages were sent."""
    session.execute(update(Job).where(Job.id.in_(job_ids)).values(enqueued_us=now_us()))


def events_after(session: Session, job_id: str, last_id: int, *, limit: int = 500) -> list[JobEvent]:
    """What happened to a job after an event, in order."""
    statement = select(JobEvent).where(JobEvent.job_id == job_id, JobEvent.id > last_id)
    return list(session.scalars(statement.order_by(JobEvent.id).limit(limit)))


def active_of_drive(drive_id: str) -> Select[Job]:
    """Jobs of a drive that have not ended."""
    return select(Job).where(Job.drive_id == drive_id, Job.state.in_(_ACTIVE))


def _held(held: Claim) -> ColumnElement[bool]:
    return (Job.state == JobState.RUNNING) & (Job.fence == held.fence)


def _locked(session: Session, job_id: str) -> Job:
    """The job, which nobody else changes until the session ends: a request to cancel it comes before or after."""
    return session.get_one(Job, job_id, populate_existing=True, with_for_update=True)


def _claim_of(job: Job) -> Claim:
    return Claim(
        job_id=job.id,
        fence=job.fence,
        attempt=job.attempt,
        project_id=job.project_id,
        kind=JobKind(job.kind),
        drive_id=job.drive_id,
        settings=job.settings,
    )


def _require(changed: bool) -> None:
    if not changed:
        raise FencedError


def _change(session: Session, job_id: str, condition: ColumnElement[bool], values: Mapping[str, Any]) -> bool:
    statement = update(Job).where(Job.id == job_id, Job.state.not_in(TERMINAL), condition)
    statement = statement.values(**values, revision=Job.revision + 1).execution_options(synchronize_session=False)
    return bool(session.execute(statement).rowcount)  # type: ignore[attr-defined]


def _end(
    session: Session,
    held: Claim,
    state: JobState,
    outcome: str,
    values: Mapping[str, Any],
    *,
    problem: Mapping[str, Any] | None = None,
) -> None:
    ended = {"state": state, "finished_us": now_us(), "owner": None, "lease_until_us": None, **values}
    _require(_change(session, held.job_id, _held(held), ended))
    _close_attempts(session, held.job_id, outcome, problem)
    _after_end(session, held.job_id)


def _after_end(session: Session, job_id: str) -> None:
    """A check that ended without a result leaves its drive's soundness unknown, not pending for ever."""
    _tell_state(session, job_id)
    job = session.get_one(Job, job_id, populate_existing=True)
    if job.kind == JobKind.PREFLIGHT and job.state != JobState.SUCCEEDED:
        pending = (Drive.preflight_job_id == job_id) & (Drive.preflight_state == PreflightState.PENDING)
        session.execute(update(Drive).where(pending).values(preflight_state=PreflightState.UNKNOWN))


def _requeue(
    session: Session,
    held: Claim,
    outcome: str,
    problem: Mapping[str, Any] | None,
    *,
    not_before_us: int,
    counted: bool = True,
) -> None:
    values: dict[str, Any] = {
        "state": JobState.QUEUED,
        "owner": None,
        "lease_until_us": None,
        "not_before_us": not_before_us,
        "enqueued_us": None,
    }
    if not counted:
        values["attempt"] = Job.attempt - 1
    _require(_change(session, held.job_id, _held(held), values))
    _close_attempts(session, held.job_id, outcome, problem)
    _tell_state(session, held.job_id)


def _close_attempts(session: Session, job_id: str, outcome: str, problem: Mapping[str, Any] | None = None) -> None:
    still_open = (JobAttempt.job_id == job_id) & JobAttempt.finished_us.is_(None)
    values = {"finished_us": now_us(), "outcome": outcome, "problem": None if problem is None else dict(problem)}
    session.execute(update(JobAttempt).where(still_open).values(**values))


def _drop_progress(session: Session, job_id: str) -> None:
    """Of progress only the newest is kept: a long job would else leave a row a second, and every reader get them."""
    session.execute(delete(JobEvent).where(JobEvent.job_id == job_id, JobEvent.kind == "progress"))


def _tell_state(session: Session, job_id: str) -> None:
    """Add the job's state to its event stream."""
    job = session.get_one(Job, job_id, populate_existing=True)
    data: dict[str, Any] = {"state": job.state, "attempt": job.attempt, "percent": job.percent}
    if job.cancel_requested_us is not None:
        data["cancel_requested"] = True
    if job.problem is not None:
        data["problem"] = job.problem
    if job.scene_id is not None:
        data["scene_id"] = job.scene_id
    session.add(JobEvent(job_id=job_id, kind="state", data=data))


def record_findings(session: Session, held: Claim, findings: Sequence[Mapping[str, Any]], *, sound: bool) -> None:
    """Add what the check of the images found to the drive's findings, and end the check's job.

    Raises
    ------
    FencedError
        Where the job is not this holder's any more; the caller's session must roll back.
    """
    succeed(session, held)
    drive = session.get(Drive, held.drive_id)
    if drive is not None and drive.state == DriveState.COMMITTED:
        drive.findings = [dict(finding) for finding in findings]
        drive.preflight_state = PreflightState.PASSED if sound else PreflightState.REJECTED
