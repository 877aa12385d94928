"""The stream of a project: one connection tells of all its jobs."""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass, field

from fastapi import APIRouter, Request
from fastapi.sse import EventSourceResponse, ServerSentEvent
from sqlalchemy import select
from sqlalchemy.orm import Session

from schemas.api.jobs import JobResource
from schemas.api.resource import example_of
from service.api.context import Context
from service.api.credentials import secret_of
from service.api.dependencies import CallerDep, ContextDep, LastEventId, StreamDep
from service.api.http.responses import gives, problems
from service.api.routes.job_views import count_shown_together, stalled_before_us, views_of
from service.database.connections import clock_us
from service.database.tables import Job, JobEvent, JobMember, JobState
from service.domain.keys import KeyRing

router = APIRouter(prefix="/v1/events", tags=["jobs"])

READY, JOB, END = "ready", "job", "end"
# A transaction that began earlier may end later, and its events have smaller ids than some that were sent: an event
# is final once it is older than any transaction lives. They take milliseconds, and wait for one another for seconds.
_OVERLAP_US = 30_000_000
_EVENTS_AT_ONCE = 5000
_JOBS_AT_ONCE = 50  # fewer where they have many members
_EXAMPLE = JobResource.model_validate(example_of(JobResource)).model_dump_json()
_EVENTS = {
    "text/event-stream": {
        "example": f'event: ready\ndata: {{"after":16}}\nid: 16\n\nevent: job\ndata: {_EXAMPLE}\nid: 17\n\n'
    }
}


@dataclass
class _Position:
    """The place of a reader in the events of its project.

    Attributes
    ----------
    floor
        All events up to this id were sent, and no other will come: the reader goes on here after a break.
    sent
        Ids after the floor that were sent.
    stalled
        Jobs that were shown as such.
    """

    floor: int
    sent: set[int] = field(default_factory=set)
    stalled: frozenset[str] = frozenset()


@dataclass(frozen=True)
class _Reader:
    """The reader of a stream: its functions ask the database, and are called from threads."""

    context: Context
    project_id: str
    secret: str

    def begin(self, last_event_id: int | None) -> _Position:
        """The position after an event; without one, that after all events there are."""
        with self.context.database.read() as session:
            final = JobEvent.created_us < clock_us(session) - _OVERLAP_US
            newest = session.scalar(select(JobEvent.id).where(final).order_by(JobEvent.id.desc()).limit(1)) or 0
            if last_event_id is not None:
                return _Position(min(last_event_id, newest))
            position = _Position(newest)
            self._changed(session, position)
            return position

    def changed(self, position: _Position) -> list[str] | None:
        """Jobs that changed since the position, which moves on; None where the caller may not see them any more."""
        keys: KeyRing = self.context.keys
        if keys.find(self.secret) != self.project_id:
            return None
        with self.context.database.read() as session:
            changed = self._changed(session, position)
            if not changed:
                return []
            # A tree shows its children: what is new of them is new of it.
            changed |= set(session.scalars(select(JobMember.job_id).where(JobMember.child_id.in_(changed))))
            changed |= {job for job in session.scalars(select(Job.parent_id).where(Job.id.in_(changed))) if job}
            mine = (Job.project_id == self.project_id) & Job.id.in_(changed)
            return list(session.scalars(select(Job.id).where(mine).order_by(Job.created_us, Job.id)))

    def views(self, job_ids: Sequence[str]) -> tuple[list[JobResource], Sequence[str]]:
        """The first of these jobs as they are now, without those that were deleted meanwhile, and the ids of the rest.

        Each may have a thousand members: as many are read at one time as a page of jobs shows.
        """
        with self.context.database.read() as session:
            count = count_shown_together(session, job_ids[:_JOBS_AT_ONCE])
            asked = Job.id.in_(job_ids[:count])
            found = session.scalars(select(Job).where(asked).order_by(Job.created_us, Job.id)).all()
            return views_of(session, found, self.context.settings), job_ids[count:]

    def _changed(self, session: Session, position: _Position) -> set[str]:
        changed = self._with_events(session, position)
        silent = Job.heartbeat_us < stalled_before_us(session, self.context.settings)
        running = select(Job.id).where(Job.project_id == self.project_id, Job.state == JobState.RUNNING, silent)
        stalled = frozenset(session.scalars(running))
        changed |= stalled ^ position.stalled
        position.stalled = stalled
        return changed

    def _with_events(self, session: Session, position: _Position) -> set[str]:
        statement = (
            select(JobEvent.id, JobEvent.job_id, JobEvent.created_us)
            .join(Job, JobEvent.job_id == Job.id)
            .where(Job.project_id == self.project_id, JobEvent.id > position.floor)
            .order_by(JobEvent.id)
            .limit(_EVENTS_AT_ONCE)
        )
        changed, final_before_us, is_final = set[str](), clock_us(session) - _OVERLAP_US, True
        for event_id, job_id, created_us in session.execute(statement).all():
            if event_id not in position.sent:
                changed.add(job_id)
                position.sent.add(event_id)
            is_final = is_final and created_us < final_before_us
            if is_final:
                position.floor = event_id
        position.sent = {event_id for event_id in position.sent if event_id > position.floor}
        return changed


@router.get(
    "",
    response_class=EventSourceResponse,
    summary="Follow a project",
    responses={
        **gives(200, "Events as they come", "Cache-Control", "X-Accel-Buffering", content=_EVENTS),
        **problems(401, 422, 429),
    },
)
async def stream_events(
    caller: CallerDep,
    context: ContextDep,
    request: Request,
    stream: StreamDep,
    last_event_id: LastEventId = None,
) -> AsyncIterator[ServerSentEvent]:
    """Jobs of the project as they change, each as `GET /v1/jobs/{id}` shows it.

    `ready` comes first: what is read after it, together with the stream, misses nothing. A reader that comes back with
    `Last-Event-ID` misses nothing either, and may be shown a job again that did not change. `end` comes last, once the
    key or the session has ended.
    """
    reader = _Reader(context, caller.project_id, secret_of(request) or "")
    position = await stream.look(reader.begin, last_event_id)
    yield ServerSentEvent(
        event=READY, id=str(position.floor), data={"after": position.floor}
    )  # browsers drop what has no data
    while not stream.has_ended:
        floor = position.floor
        changed = await stream.look(reader.changed, position)
        if changed is None:
            yield ServerSentEvent(event=END, data={"reason": "the key or the session has ended"})
            return
        left: Sequence[str] = changed
        while left:
            shown, left = await stream.look(reader.views, left)
            for job in shown:
                # Whoever goes away before the last one is shown all of them again.
                is_last = job.id == changed[-1]
                yield ServerSentEvent(event=JOB, id=str(position.floor if is_last else floor), data=job)
        if not changed:
            await stream.pause(context.settings.poll_seconds)
