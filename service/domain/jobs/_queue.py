"""Jobs that wait for a worker."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from sqlalchemy import select, tuple_, update
from sqlalchemy.orm import Session, load_only

from service.database.connections import clock_us
from service.database.tables import Job, JobState, now_us


def due(session: Session, *, after: Job | None = None, limit: int = 1000) -> list[Job]:
    """Queued jobs that a worker may take now, oldest first; only what their messages need is loaded.

    Parameters
    ----------
    after
        The last job of the page before.
    """
    is_due = (Job.state == JobState.QUEUED) & (Job.not_before_us <= clock_us(session)) & (Job.waiting_for == 0)
    statement = select(Job).where(is_due)
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
