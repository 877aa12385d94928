"""Jobs that wait for a worker."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from sqlalchemy import ColumnElement, Select, case, func, or_, select, tuple_, update
from sqlalchemy.orm import Session, load_only

from schemas.api.jobs import JobKind
from service.database.connections import clock_us
from service.database.tables import Job, JobMember, JobState, now_us


def due(session: Session, *, after: Job | None = None, limit: int = 1000) -> list[Job]:
    """Queued jobs that a worker may take now, oldest first; only what their messages need is loaded.

    Parameters
    ----------
    after
        The last job of the page before.
    """
    statement = _due(session)
    if after is not None:
        statement = statement.where(tuple_(Job.created_us, Job.id) > (after.created_us, after.id))
    return list(session.scalars(statement.limit(limit)))


def all_due(session: Session) -> Iterator[Job]:
    """All jobs that are due, page by page."""
    page = due(session)
    while page:
        yield from page
        page = due(session, after=page[-1])


def due_after(session: Session, job_id: str) -> list[Job]:
    """Jobs that the end of another one's attempt may have let begin: those made for it, and those that waited for it.

    Parameters
    ----------
    job_id
        The other one.
    """
    parent = select(Job.parent_id).where(Job.id == job_id)
    ended = or_(JobMember.child_id == job_id, JobMember.child_id.in_(parent))  # a sub-map's failure is its parent's
    aggregations = select(JobMember.job_id).where(ended)
    related = or_(Job.parent_id == job_id, Job.id.in_(parent), Job.id.in_(aggregations))
    return list(session.scalars(_due(session).where(related)))


def _due(session: Session) -> Select[Job]:
    shown = load_only(Job.id, Job.kind, Job.fence, Job.created_us, raiseload=True)
    return select(Job).where(_is_due(session)).options(shown).order_by(Job.created_us, Job.id)


def _is_due(session: Session) -> ColumnElement[bool]:
    return (Job.state == JobState.QUEUED) & (Job.not_before_us <= clock_us(session)) & (Job.waiting_for == 0)


class Backlog(NamedTuple):
    """Jobs of a kind that a worker could take now."""

    jobs: int
    longest_wait_us: int


def backlogs(session: Session) -> dict[JobKind, Backlog]:
    """Jobs that wait for nothing but a worker, of each kind of which there are any."""
    since_us = case((Job.not_before_us > Job.created_us, Job.not_before_us), else_=Job.created_us)
    counted = select(Job.kind, func.count(), func.min(since_us)).where(_is_due(session)).group_by(Job.kind)
    rows, now = session.execute(counted).all(), clock_us(session)
    return {JobKind(kind): Backlog(jobs, max(0, now - first_us)) for kind, jobs, first_us in rows}


def count_stalled(session: Session, *, stalled_s: float) -> int:
    """Number of running jobs whose worker was not heard of for a time."""
    silent = (Job.state == JobState.RUNNING) & (Job.heartbeat_us < clock_us(session) - int(1e6 * stalled_s))
    return session.scalar(select(func.count()).select_from(Job).where(silent)) or 0


def mark_enqueued(session: Session, job_ids: Sequence[str]) -> None:
    """Note that messages were sent."""
    session.execute(update(Job).where(Job.id.in_(job_ids)).values(enqueued_us=now_us()))
