"""Jobs as the API shows them."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence

from sqlalchemy import ColumnElement, func, select
from sqlalchemy.orm import Session

from schemas.api.jobs import JobAttempt as AttemptResource
from schemas.api.jobs import JobKind, JobProgress, JobResource
from schemas.api.jobs import JobMember as MemberResource
from schemas.api.jobs import JobState as ShownState
from schemas.api.jobs import JobSubmap as SubmapResource
from schemas.api.resource import Page
from service.api.dependencies import moment
from service.api.http.paging import count_together, newest, newest_after
from service.database.connections import clock_us
from service.database.tables import Job, JobAttempt, JobMember, JobState
from service.domain import jobs
from service.settings import Settings

RETRY_AFTER_S = 2
CHILDREN_OF_PAGE = 2000  # members and sub-maps that jobs which are read together show, unless one alone has more


def stalled_before_us(session: Session, settings: Settings) -> int:
    """The time of the oldest heartbeat with which a running job is not stalled, on the clock of the heartbeats.

    Asked once for all jobs of an answer: the clock is the database's.
    """
    return clock_us(session) - int(settings.stalled_seconds * 1e6)


def shown_state(job: Job, stalled_us: int) -> ShownState:
    """The job's state; STALLED where it runs and was last heard of before a time, see `stalled_before_us`."""
    if job.state == JobState.RUNNING and (job.heartbeat_us or 0) < stalled_us:
        return ShownState.STALLED
    return ShownState(job.state)


def _is_shown_as(states: Collection[ShownState], stalled_us: int) -> ColumnElement[bool]:
    """The condition that `shown_state` is one of these."""
    is_stalled = func.coalesce(Job.heartbeat_us, 0) < stalled_us
    result = Job.state.in_([JobState(state) for state in states if state is not ShownState.STALLED])
    if ShownState.STALLED in states:
        return result | ((Job.state == JobState.RUNNING) & is_stalled)
    if ShownState.RUNNING in states:
        return result & ((Job.state != JobState.RUNNING) | ~is_stalled)
    return result


def etag_of(job: Job, shown: JobResource) -> str:
    """Changes with everything that a reader can see; also with children, which go on after their parent has ended."""
    children = "".join(child.model_dump_json() for child in (*shown.members, *shown.submaps))
    of_children = f"-{hashlib.sha256(children.encode()).hexdigest()[:16]}" if children else ""
    return f'"{job.revision}-{shown.state.lower()}{of_children}"'


def views_of(session: Session, found: Sequence[Job], settings: Settings) -> list[JobResource]:
    """Jobs as the API shows them."""
    return _views_at(session, found, stalled_before_us(session, settings))


def _views_at(session: Session, found: Sequence[Job], stalled_us: int) -> list[JobResource]:
    """Jobs as the API shows them, STALLED where they run and were last heard of before a time."""
    attempts: dict[str, list[JobAttempt]] = {}
    ids = [job.id for job in found]
    for attempt in session.scalars(select(JobAttempt).where(JobAttempt.job_id.in_(ids)).order_by(JobAttempt.fence)):
        attempts.setdefault(attempt.job_id, []).append(attempt)
    trees = [job.id for job in found if job.kind == JobKind.AGGREGATION]
    members = jobs.members_of(session, trees) if trees else {}
    planned = [job.id for job in found if job.kind == JobKind.RECONSTRUCTION and job.children_percent]
    submaps = jobs.submaps_of(session, planned) if planned else {}
    return [
        _shown(job, attempts.get(job.id, ()), members.get(job.id, ()), submaps.get(job.id, ()), stalled_us)
        for job in found
    ]


def page_of_jobs(
    session: Session,
    project_id: str,
    settings: Settings,
    *,
    cursor: str | None,
    limit: int,
    drive_id: str | None,
    states: Collection[ShownState] = (),
    kinds: Collection[JobKind] = (),
) -> Page[JobResource]:
    """A page of a project's jobs, the newest first; of some states and kinds alone where any are given.

    Each may show a thousand children: the page ends before the limit where they would be too many, and `next` goes on
    with the first job that was left out. Of those that are left out nothing but their places in the list is loaded.
    """
    stalled_us = stalled_before_us(session, settings)
    conditions = [_is_shown_as(states, stalled_us)] if states else []
    if kinds:
        conditions.append(Job.kind.in_(kinds))
    found, following = newest(
        session,
        Job,
        project_id,
        cursor=cursor,
        limit=limit,
        places_only=True,
        conditions=conditions,
        drive_id=drive_id,
    )
    shown = found[: count_shown_together(session, [job.id for job in found])]
    if len(shown) < len(found):
        following = newest_after(shown[-1])
    session.scalars(select(Job).where(Job.id.in_([job.id for job in shown]))).all()  # completes those that are there
    return Page[JobResource](items=_views_at(session, shown, stalled_us), next=following)


def count_shown_together(session: Session, job_ids: Sequence[str]) -> int:
    """Number of the first of these jobs whose children together are not too many; one at least, if there is one."""
    children = jobs.children_of(session, job_ids)
    return count_together((children.get(job_id, 0) for job_id in job_ids), CHILDREN_OF_PAGE)


def view_of(session: Session, job: Job, settings: Settings) -> JobResource:
    """One job as the API shows it."""
    return views_of(session, [job], settings)[0]


def _shown(
    job: Job,
    attempts: Sequence[JobAttempt],
    members: Sequence[tuple[JobMember, Job | None]],
    submaps: Sequence[Job],
    stalled_us: int,
) -> JobResource:
    return JobResource.model_validate(
        {
            "id": job.id,
            "kind": job.kind,
            "drive_id": job.drive_id,
            "state": shown_state(job, stalled_us),
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
            "map_id": job.map_id,
            "map_version": job.map_version,
            "export_id": (job.request or {}).get("export_id") if job.kind == JobKind.EXPORT else None,
            "members": [_shown_member(member, child, stalled_us) for member, child in members],
            "parent_id": job.parent_id,
            "submap": None if job.parent_id is None else jobs.number_of(job),
            "submaps": [_shown_submap(submap, stalled_us) for submap in submaps],
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


def _shown_member(member: JobMember, child: Job | None, stalled_us: int) -> MemberResource:
    is_there = member.scene_id is not None
    return MemberResource.model_validate(
        {
            "name": member.name,
            "drive_id": member.drive_id,
            "job_id": member.child_id,
            "state": None if child is None else shown_state(child, stalled_us),
            "percent": 100.0 if is_there or child is None else child.percent,
            "scene_id": member.scene_id,
            "problem": member.problem,
        }
    )


def _shown_submap(submap: Job, stalled_us: int) -> SubmapResource:
    place = submap.request or {}
    return SubmapResource.model_validate(
        {
            "number": place["number"],
            "job_id": submap.id,
            "first_unit": place["first_unit"],
            "last_unit": place["last_unit"],
            "state": shown_state(submap, stalled_us),
            "percent": submap.percent,
            "problem": submap.problem,
        }
    )
