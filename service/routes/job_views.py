"""How a job looks from outside."""

from __future__ import annotations

from collections.abc import Sequence

from schemas.api.jobs import JobAttempt as AttemptResource
from schemas.api.jobs import JobProgress, JobResource
from schemas.api.jobs import JobState as ShownState
from service.persistence.tables import Job, JobAttempt, JobState, now_us
from service.routes.dependencies import moment
from service.settings import Settings

RETRY_AFTER_S = 2


def shown_state(job: Job, settings: Settings) -> ShownState:
    """The job's state; STALLED where it runs and has not been heard of for a while."""
    silent_us = now_us() - (job.heartbeat_us or 0)
    if job.state == JobState.RUNNING and silent_us > settings.stalled_seconds * 1e6:
        return ShownState.STALLED
    return ShownState(job.state)


def etag_of(job: Job, settings: Settings) -> str:
    """Changes with everything that a reader can see."""
    return f'"{job.revision}-{shown_state(job, settings).lower()}"'


def shown(job: Job, attempts: Sequence[JobAttempt], settings: Settings) -> JobResource:
    """A job as the API shows it."""
    return JobResource.model_validate(
        {
            "id": job.id,
            "kind": job.kind,
            "drive_id": job.drive_id,
            "state": shown_state(job, settings),
            "settings": job.settings,
            "progress": JobProgress(
                stage=job.stage,
                done=job.done,
                total=job.total,
                unit=job.unit,
                percent=job.percent,
                eta_low_s=job.eta_low_s,
                eta_high_s=job.eta_high_s,
                reused_stages=job.reused,
            ),
            "attempts": [_shown_attempt(attempt) for attempt in attempts],
            "cancel_requested": job.cancel_requested_us is not None,
            "heartbeat_at": moment(job.heartbeat_us),
            "problem": job.problem,
            "scene_id": job.scene_id,
            "retry_of": job.retry_of,
            "created_at": moment(job.created_us),
            "started_at": moment(job.started_us),
            "finished_at": moment(job.finished_us),
            "expires_at": moment(job.expires_us),
        }
    )


def _shown_attempt(attempt: JobAttempt) -> AttemptResource:
    return AttemptResource.model_validate(
        {
            "attempt": attempt.attempt,
            "worker": attempt.owner,
            "started_at": moment(attempt.started_us),
            "finished_at": moment(attempt.finished_us),
            "outcome": attempt.outcome,
            "problem": attempt.problem,
        }
    )
