"""Common part of all statements on jobs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import ColumnElement, Select, delete, select, update
from sqlalchemy.orm import Session

from schemas.api.jobs import JobKind
from service.database.connections import clock_expression
from service.database.tables import TERMINAL, Job, JobAttempt, JobEvent, JobState, now_us
from service.domain import webhooks

ACTIVE = (JobState.QUEUED, JobState.RUNNING)


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
    drive_id: str | None
    map_id: str | None
    settings: dict[str, Any]
    children_percent: float = 0.0
    blame: float = 0.0  # of the attempts before
    request: Mapping[str, Any] = field(default_factory=dict)

    @property
    def has_submaps(self) -> bool:
        """Return whether the sub-maps of a reconstruction were made, by jobs of their own."""
        return self.kind is JobKind.RECONSTRUCTION and self.children_percent > 0.0


def claim_of(job: Job) -> Claim:
    return Claim(
        job_id=job.id,
        fence=job.fence,
        attempt=job.attempt,
        project_id=job.project_id,
        kind=JobKind(job.kind),
        drive_id=job.drive_id,
        map_id=job.map_id,
        settings=job.settings,
        children_percent=job.children_percent,
        blame=job.blame,
        request=job.request or {},
    )


def held_by(held: Claim) -> ColumnElement[bool]:
    return (Job.state == JobState.RUNNING) & (Job.fence == held.fence)


def locked(session: Session, job_id: str) -> Job:
    """The job, which nobody else changes until the session ends: a request to cancel it comes before or after."""
    return session.get_one(Job, job_id, populate_existing=True, with_for_update=True)


def require(changed: bool) -> None:
    if not changed:
        raise FencedError


def change(session: Session, job_id: str, condition: ColumnElement[bool], values: Mapping[str, Any]) -> bool:
    if "state" in values:  # an estimate is of the state before: nothing goes on that has ended, or waits again
        values = {"eta_low_s": None, "eta_high_s": None, **values}
    statement = update(Job).where(Job.id == job_id, Job.state.not_in(TERMINAL), condition)
    statement = statement.values(**values, revision=Job.revision + 1).execution_options(synchronize_session=False)
    return bool(session.execute(statement).rowcount)  # type: ignore[attr-defined]


def close_attempts(session: Session, job_id: str, outcome: str, problem: Mapping[str, Any] | None = None) -> None:
    still_open = (JobAttempt.job_id == job_id) & JobAttempt.finished_us.is_(None)
    values = {"finished_us": now_us(), "outcome": outcome, "problem": None if problem is None else dict(problem)}
    session.execute(update(JobAttempt).where(still_open).values(**values))


def drop_progress(session: Session, job_id: str) -> None:
    """Drop all progress but the newest: a long job would else leave a row per second, and every reader get them."""
    session.execute(delete(JobEvent).where(JobEvent.job_id == job_id, JobEvent.kind == "progress"))


def tell_state(session: Session, job_id: str) -> None:
    """Add the job's state to its event stream, and where that is an end, to the project's webhooks."""
    job = session.get_one(Job, job_id, populate_existing=True)
    data: dict[str, Any] = {"state": job.state, "attempt": job.attempt, "percent": job.percent}
    if job.cancel_requested_us is not None:
        data["cancel_requested"] = True
    if job.problem is not None:
        data["problem"] = job.problem
    if job.scene_id is not None:
        data["scene_id"] = job.scene_id
    if job.map_version is not None:
        data |= {"map_id": job.map_id, "map_version": job.map_version}
    if job.kind == JobKind.EXPORT:
        data["export_id"] = (job.request or {})["export_id"]
    session.add(JobEvent(job_id=job_id, kind="state", data=data, created_us=clock_expression(session)))
    webhooks.record(session, job)


def tell_progress(session: Session, job: Job) -> None:
    """Add the job's progress to its event stream, in place of what was said before."""
    drop_progress(session, job.id)
    shown = ("stage", "done", "total", "unit", "percent", "eta_low_s", "eta_high_s")
    data = {"attempt": job.attempt, **{name: getattr(job, name) for name in shown}}
    session.add(JobEvent(job_id=job.id, kind="progress", data=data, created_us=clock_expression(session)))


def events_after(session: Session, job_id: str, last_id: int, *, limit: int = 500) -> list[JobEvent]:
    """Events of a job after one of them, in order."""
    statement = select(JobEvent).where(JobEvent.job_id == job_id, JobEvent.id > last_id)
    return list(session.scalars(statement.order_by(JobEvent.id).limit(limit)))


def active_of_drive(drive_id: str) -> Select[Job]:
    """Jobs of a drive that have not ended."""
    return select(Job).where(Job.drive_id == drive_id, Job.state.in_(ACTIVE))
