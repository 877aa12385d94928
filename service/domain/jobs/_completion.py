"""End of an attempt, and with it perhaps of its job."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy import update
from sqlalchemy.orm import Session

from schemas.api.drives import DriveState, PreflightState
from schemas.api.jobs import JobKind
from schemas.api.problems import PROBLEM_TYPE, Problem
from service.database.connections import clock_us
from service.database.tables import Drive, Job, JobState, now_us
from service.domain.jobs._blame import FULL_BLAME, NO_BLAME, RetryLimits
from service.domain.jobs._dependencies import resolve_child
from service.domain.jobs._queries import Claim, change, close_attempts, held_by, locked, require, tell_state
from service.domain.jobs._submaps import look_at_submaps


def succeed(
    session: Session,
    held: Claim,
    *,
    scene_id: str | None = None,
    map_version: int | None = None,
    reused: Sequence[str] = (),
) -> None:
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
    end(
        session,
        held,
        JobState.SUCCEEDED,
        "succeeded",
        {
            "percent": 100.0,
            "eta_low_s": 0.0,
            "eta_high_s": 0.0,
            "scene_id": scene_id,
            "map_version": map_version,
            "reused": list(reused),
        },
    )


def fail(
    session: Session,
    held: Claim,
    problem: Problem,
    *,
    limits: RetryLimits,
    retry_delay_us: int,
    blame: float = FULL_BLAME,
) -> JobState:
    """End the attempt, and the job where another would not help, none is left or nobody wants it any more.

    A job whose end was asked for ends as cancelled; what its last attempt failed of stays with the attempt.

    Raises
    ------
    FencedError
        Where the job is not this holder's any more.
    """
    described = problem.model_dump(mode="json", exclude_none=True)
    outcome = problem.type.removeprefix(PROBLEM_TYPE)
    job = locked(session, held.job_id)
    if job.cancel_requested_us is not None:
        end(session, held, JobState.CANCELLED, outcome, {}, problem=described)
        return JobState.CANCELLED
    counts = _counts(job, blame)
    if problem.retryable and limits.allow(**counts):
        not_before_us = clock_us(session) + retry_delay_us
        requeue(session, held, outcome, described, not_before_us=not_before_us, values=counts)
        return JobState.QUEUED
    end(session, held, JobState.FAILED, outcome, {"problem": described, **counts}, problem=described)
    return JobState.FAILED


def _counts(job: Job, blame: float) -> dict[str, Any]:
    """Counts against a job after one more attempt."""
    return {"blame": job.blame + blame, "losses": job.losses + (blame == NO_BLAME)}


def cancelled(session: Session, held: Claim) -> None:
    """End the job as cancelled: its stage has stopped.

    Raises
    ------
    FencedError
        Where the job is not this holder's any more.
    """
    end(session, held, JobState.CANCELLED, "cancelled", {})


def release(session: Session, held: Claim) -> None:
    """Give the job back, for another worker: this one was told to stop.

    The attempt is shown as released, and costs none of the job's retries.

    A job whose end was asked for ends here: no other worker may come for it.

    Raises
    ------
    FencedError
        Where the job is not this holder's any more.
    """
    if locked(session, held.job_id).cancel_requested_us is not None:
        cancelled(session, held)
        return
    requeue(session, held, "released", None, not_before_us=clock_us(session), values={})


def record_findings(session: Session, held: Claim, findings: Sequence[Mapping[str, Any]], *, sound: bool) -> None:
    """Add what the check of the images found to the drive's findings, and end the check's job.

    Raises
    ------
    FencedError
        Where the job is not this holder's any more; the caller's session must roll back.
    """
    succeed(session, held)
    drive = session.get(Drive, held.drive_id or "")
    if drive is not None and drive.state == DriveState.COMMITTED:
        drive.findings = [dict(finding) for finding in findings]
        drive.preflight_state = PreflightState.PASSED if sound else PreflightState.REJECTED


def end(
    session: Session,
    held: Claim,
    state: JobState,
    outcome: str,
    values: Mapping[str, Any],
    *,
    problem: Mapping[str, Any] | None = None,
) -> None:
    ended = {"state": state, "finished_us": now_us(), "owner": None, "lease_until_us": None, **values}
    require(change(session, held.job_id, held_by(held), ended))
    close_attempts(session, held.job_id, outcome, problem)
    after_end(session, held.job_id)


def after_end(session: Session, job_id: str) -> None:
    """Tell whoever waits for the job.

    A check that ended without a result leaves its drive's soundness unknown, not pending for ever.
    """
    tell_state(session, job_id)
    job = session.get_one(Job, job_id, populate_existing=True)
    if job.kind == JobKind.RECONSTRUCTION:
        resolve_child(session, job)
    if job.kind == JobKind.SUBMAP and job.parent_id is not None:
        look_at_submaps(session, job.parent_id)
    if job.kind == JobKind.PREFLIGHT and job.state != JobState.SUCCEEDED:
        pending = (Drive.preflight_job_id == job_id) & (Drive.preflight_state == PreflightState.PENDING)
        session.execute(update(Drive).where(pending).values(preflight_state=PreflightState.UNKNOWN))


def requeue(
    session: Session,
    held: Claim,
    outcome: str,
    problem: Mapping[str, Any] | None,
    *,
    not_before_us: int,
    values: Mapping[str, Any],
) -> None:
    """Give the job back to the queue, with more values of its row."""
    queued: dict[str, Any] = {
        "state": JobState.QUEUED,
        "owner": None,
        "lease_until_us": None,
        "not_before_us": not_before_us,
        "enqueued_us": None,
        **values,
    }
    require(change(session, held.job_id, held_by(held), queued))
    close_attempts(session, held.job_id, outcome, problem)
    tell_state(session, held.job_id)
