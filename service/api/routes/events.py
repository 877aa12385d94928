"""The stream of a project: one connection tells of all its jobs."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from dataclasses import dataclass, field

from fastapi import APIRouter, Request
from fastapi.sse import EventSourceResponse, ServerSentEvent
from sqlalchemy import func, select
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from schemas.api.jobs import JobResource
from schemas.api.resource import example_of
from service.api.context import Context
from service.api.credentials import secret_of
from service.api.dependencies import CallerDep, ContextDep, LastEventId
from service.api.http.responses import gives, problems
from service.api.routes.job_views import views_of
from service.database.tables import Job, JobEvent, JobMember, JobState, now_us

router = APIRouter(prefix="/v1/events", tags=["jobs"])

READY, JOB, END = "ready", "job", "end"
_MOST_S = 1.0  # between two looks: a revoked key ends the stream within this and what a key is remembered for
# Transactions that began earlier may end later, and their events have smaller ids than some that were sent.
_OVERLAP_US = 10_000_000
_LIMIT = 5000
_EXAMPLE = JobResource.model_validate(example_of(JobResource)).model_dump_json()
_EVENTS = {
    "text/event-stream": {
        "example": f'event: ready\ndata: {{"after":16}}\nid: 16\n\nevent: job\ndata: {_EXAMPLE}\nid: 17\n\n'
    }
}


@dataclass
class _Position:
    """The place of a reader in the events of its project."""

    last: int  # greatest id that was sent
    floor: int  # all up to here were sent
    sent: set[int] = field(default_factory=set)  # of those after the floor
    stalled: frozenset[str] = frozenset()  # jobs that were shown as such


@router.get(
    "",
    response_class=EventSourceResponse,
    summary="Follow a project",
    responses={
        **gives(200, "Events as they come", "Cache-Control", "X-Accel-Buffering", content=_EVENTS),
        **problems(401, 422),
    },
)
async def stream_events(
    caller: CallerDep,
    context: ContextDep,
    request: Request,
    last_event_id: LastEventId = None,
) -> AsyncIterator[ServerSentEvent]:
    """Jobs of the project as they change, each as `GET /v1/jobs/{id}` shows it.

    `ready` comes first: what is read after it, together with the stream, misses nothing. `end` comes last, once the key
    or the session has ended.
    """
    secret = secret_of(request) or ""
    newest = await run_in_threadpool(_newest_id, context)
    begun = newest if last_event_id is None else min(last_event_id, newest)
    position = _Position(begun, begun)
    yield ServerSentEvent(event=READY, id=str(begun), data={"after": begun})  # browsers drop events without data
    while True:
        jobs = await run_in_threadpool(_news, context, secret, caller.project_id, position)
        if jobs is None:
            yield ServerSentEvent(event=END, data={"reason": "the key or the session has ended"})
            return
        for job in jobs:
            yield ServerSentEvent(event=JOB, id=str(position.last), data=job)
        if not jobs:
            await asyncio.sleep(min(context.settings.poll_seconds, _MOST_S))


def _newest_id(context: Context) -> int:
    with context.database.read() as session:
        return session.scalar(select(func.max(JobEvent.id))) or 0


def _news(context: Context, secret: str, project_id: str, position: _Position) -> list[JobResource] | None:
    """Jobs that changed since the position, which moves on; None where the caller may not see them any more."""
    if context.keys.find(secret) is None:
        return None
    with context.database.read() as session:
        changed = _changed(session, project_id, position)
        stalled = _stalled(session, project_id, context.settings.stalled_seconds)
        changed |= stalled ^ position.stalled
        position.stalled = stalled
        if not changed:
            return []
        # A tree shows its children: what is new of them is new of it.
        changed |= set(session.scalars(select(JobMember.job_id).where(JobMember.child_id.in_(changed))))
        changed |= {job for job in session.scalars(select(Job.parent_id).where(Job.id.in_(changed))) if job}
        found = session.scalars(select(Job).where(Job.id.in_(changed)).order_by(Job.created_us, Job.id)).all()
        return views_of(session, found, context.settings)


def _changed(session: Session, project_id: str, position: _Position) -> set[str]:
    statement = (
        select(JobEvent.id, JobEvent.job_id, JobEvent.created_us)
        .join(Job, JobEvent.job_id == Job.id)
        .where(Job.project_id == project_id, JobEvent.id > position.floor)
        .order_by(JobEvent.id)
        .limit(_LIMIT)
    )
    changed, final_before_us, is_final = set(), now_us() - _OVERLAP_US, True
    for event_id, job_id, created_us in session.execute(statement).all():
        if event_id not in position.sent:
            changed.add(job_id)
            position.sent.add(event_id)
            position.last = max(position.last, event_id)
        is_final = is_final and created_us < final_before_us
        if is_final:
            position.floor = event_id
    position.sent = {event_id for event_id in position.sent if event_id > position.floor}
    return changed


def _stalled(session: Session, project_id: str, stalled_s: float) -> frozenset[str]:
    silent = Job.heartbeat_us < now_us() - int(stalled_s * 1e6)
    running = select(Job.id).where(Job.project_id == project_id, Job.state == JobState.RUNNING, silent)
    return frozenset(session.scalars(running))
