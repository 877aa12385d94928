"""A worker takes a job, keeps it and loses it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import case, func, or_, select, update
from sqlalchemy.orm import Session

from schemas.api.problems import PROBLEM_TYPE, Problem
from service.database.connections import clock_us
from service.database.tables import Job, JobAttempt, JobState
from service.domain.jobs._blame import LESS_MEMORY, RetryLimits, blame_of_loss
from service.domain.jobs._completion import end, fail
from service.domain.jobs._queries import (
    Claim,
    FencedError,
    change,
    claim_of,
    held_by,
    require,
    tell_progress,
    tell_state,
)
from service.domain.jobs._submaps import tell_parents


@dataclass(frozen=True, kw_only=True)
class ProgressNote:
    """The progress of an attempt.

    Attributes
    ----------
    stage
        Empty before the first one begins.
    done, total, unit
        Of the stage. Unit is None where the stage counts nothing: it was finished before, or has no parts.
    percent
        Of the attempt itself, without the jobs that it waited for; never falls.
    eta_low_s, eta_high_s
        Seconds to the end, at least and at most.
    reused
        Stages whose results were there already, as far as the reports tell; the scene's report has the last word.
    engine_ran
        Whether the engine has begun.
    """

    stage: str = ""
    done: int = 0
    total: int = 0
    unit: str | None = None
    percent: float = 0.0
    eta_low_s: float | None = None
    eta_high_s: float | None = None
    reused: Sequence[str] = ()
    engine_ran: bool = False


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
        "percent": Job.children_percent,  # their part of the work is done
        "stage": None,
        "done": None,
        "total": None,
        "unit": None,
        "eta_low_s": None,
        "eta_high_s": None,
        "reused": [],
        "engine_ran": False,
        "memory_kills": None,
    }
    is_due = (Job.state == JobState.QUEUED) & (Job.not_before_us <= now) & (Job.waiting_for == 0)
    if not change(session, job_id, is_due, values):
        return None
    job = session.get_one(Job, job_id, populate_existing=True)
    session.add(JobAttempt(job_id=job_id, fence=job.fence, attempt=job.attempt, owner=owner))
    tell_state(session, job_id)
    tell_parents(session, job)
    return claim_of(job)


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
        percent = held.children_percent + (1.0 - held.children_percent / 100.0) * note.percent
        values |= {
            "stage": note.stage,
            "done": note.done,
            "total": note.total,
            "unit": note.unit,
            "percent": case((Job.percent > percent, Job.percent), else_=percent),  # never falls within an attempt
            "eta_low_s": note.eta_low_s,
            "eta_high_s": note.eta_high_s,
            "reused": list(note.reused),
            "engine_ran": note.engine_ran,
        }
    require(change(session, held.job_id, held_by(held), values))
    job = session.get_one(Job, held.job_id, populate_existing=True)
    if note is not None:
        tell_progress(session, job)
        tell_parents(session, job)
    return job.cancel_requested_us is not None


def cancel_requested(session: Session, held: Claim) -> bool:
    """Return whether somebody asked to cancel the job; asked between heartbeats, and writes nothing.

    Raises
    ------
    FencedError
        Where the job is not this holder's any more.
    """
    row = session.execute(select(Job.cancel_requested_us).where(Job.id == held.job_id, held_by(held))).one_or_none()
    if row is None:
        raise FencedError
    return row.cancel_requested_us is not None


def has_succeeded(session: Session, held: Claim) -> bool:
    """Return whether this holder, and no other, has ended the job as succeeded, or left it to its sub-maps."""
    is_done = or_(Job.state == JobState.SUCCEEDED, (Job.state == JobState.QUEUED) & (Job.waiting_for > 0))
    by_holder = is_done & (Job.fence == held.fence)
    return session.scalar(select(Job.id).where(Job.id == held.job_id, by_holder)) is not None


def bound_times(session: Session, *, lease_us: int, delay_us: int) -> None:
    """Shorten leases and waits that end later than any that begins now: the clock was set back since they began."""
    now = clock_us(session)
    for condition, column, end_us in (
        (Job.state == JobState.RUNNING, Job.lease_until_us, now + lease_us),
        (Job.state == JobState.QUEUED, Job.not_before_us, now + delay_us),
    ):
        # One that changes at this moment is not waited for: its new time is no longer than it should be.
        late = session.scalars(select(Job.id).where(condition, column > end_us).with_for_update(skip_locked=True)).all()
        shorter = update(Job).where(Job.id.in_(late)).values({column: end_us})
        if late:
            session.execute(shorter.execution_options(synchronize_session=False))


def expire_leases(session: Session, *, limits: RetryLimits, only_ended: bool = False) -> list[str]:
    """Take jobs from workers that have not been heard of: queued again, or ended where no attempt is left.

    Parameters
    ----------
    only_ended
        Only from those that are known to be dead, see `end_lease`.

    Returns
    -------
    list of str
        The jobs taken.
    """
    before_us = 1 if only_ended else clock_us(session)
    lost = select(Job).where(Job.state == JobState.RUNNING, Job.lease_until_us < before_us)
    # A job that changes at this moment has a worker that lives, or is another reconciler's.
    lost = lost.with_for_update(skip_locked=True).execution_options(populate_existing=True)
    taken = []
    for job in session.scalars(lost).all():
        held = claim_of(job)
        if job.cancel_requested_us is not None:
            end(session, held, JobState.CANCELLED, "cancelled", {})
        else:
            blame = blame_of_loss(engine_ran=job.engine_ran, memory_kills=job.memory_kills)
            fail(session, held, _problem_of_loss(job), limits=limits, retry_delay_us=0, blame=blame)
        taken.append(job.id)
    return taken


def _problem_of_loss(job: Job) -> Problem:
    if job.memory_kills:
        return Problem(
            type=PROBLEM_TYPE + "out-of-memory",
            title="Memory ran out",
            detail=f"worker {job.owner} was lost in attempt {job.attempt}, and memory had run out there",
            remedy=LESS_MEMORY,
            stage=job.stage,
            retryable=True,
            job_id=job.id,
        )
    return Problem(
        type=PROBLEM_TYPE + "worker-lost",
        title="The worker was lost",
        detail=f"worker {job.owner} was not heard of any more during attempt {job.attempt}",
        remedy="Check the workers' machines and logs, then retry the job; finished stages are reused.",
        stage=job.stage,
        retryable=True,
        job_id=job.id,
    )


def end_lease(session: Session, job_id: str, fence: int, *, memory_kills: int | None = None) -> bool:
    """End the lease of an attempt whose process is known to be dead: nobody has to wait until it runs out.

    Parameters
    ----------
    memory_kills
        How many processes the kernel killed for lack of memory during the attempt; None where it is not known.

    Returns
    -------
    bool
        Whether the attempt was under way.
    """
    under_way = (Job.state == JobState.RUNNING) & (Job.fence == fence)
    return change(session, job_id, under_way, {"lease_until_us": 0, "memory_kills": memory_kills})


def note_finished_stage(session: Session, held: Claim) -> None:
    """Count lost attempts from here on: a job that comes on in spite of them is not given up."""
    advanced = update(Job).where(Job.id == held.job_id, held_by(held)).values(losses=0)
    session.execute(advanced.execution_options(synchronize_session=False))
