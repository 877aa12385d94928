"""Jobs: list, show, cancel, retry, and the stream of their events."""

from __future__ import annotations

import hashlib
from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import APIRouter, BackgroundTasks, Depends, Header, Query, Request, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent
from sqlalchemy import select
from sqlalchemy.orm import Session

from schemas.api.jobs import JobKind, JobResource
from schemas.api.jobs import JobState as ShownState
from schemas.api.resource import Id, Page
from service.api.context import Context
from service.api.credentials import secret_of
from service.api.dependencies import (
    CallerDep,
    ContextDep,
    Cursor,
    IdempotentDep,
    LastEventId,
    Limit,
    StreamDep,
    answer,
    expiry_us,
)
from service.api.http.ranges import none_match
from service.api.http.responses import gives, problems
from service.api.routes.aggregations import ACCEPTED, accepted
from service.api.routes.downloads import IF_NONE_MATCH
from service.api.routes.job_views import RETRY_AFTER_S, etag_of, page_of_jobs, view_of
from service.database.tables import TERMINAL, Job, JobEvent, JobState, now_us
from service.domain import aggregations, exports, job_trees, jobs
from service.domain.access import require
from service.domain.idempotency import Answer

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])

_EVENTS = {
    "text/event-stream": {
        "example": 'event: state\ndata: {"state":"RUNNING","attempt":1,"percent":0.0}\nid: 2\n\n'
        'event: progress\ndata: {"attempt":1,"stage":"matches","done":410,"total":1902,"unit":"pairs","percent":33.5,'
        '"eta_low_s":120.0,"eta_high_s":260.0}\nid: 17\n\n'
    }
}


@router.get(
    "",
    response_model=Page[JobResource],
    summary="List jobs",
    responses={
        **gives(200, "A page of jobs", "ETag", "Cache-Control"),
        **gives(304, "Nothing has changed since If-None-Match", "ETag", "Cache-Control"),
        **problems(401, 422),
    },
    openapi_extra={"parameters": [IF_NONE_MATCH]},
)
def list_jobs(
    caller: CallerDep,
    context: ContextDep,
    request: Request,
    limit: Limit = 50,
    cursor: Cursor = None,
    drive_id: Annotated[Id | None, Query(description="only of this drive")] = None,
    state: Annotated[
        list[ShownState] | None, Query(max_length=len(ShownState), description="only in this state; may be repeated")
    ] = None,
    kind: Annotated[
        list[JobKind] | None, Query(max_length=len(JobKind), description="only of this kind; may be repeated")
    ] = None,
) -> Response:
    """Jobs of the project, newest first. A page ends before `limit` where its jobs have thousands of members."""
    with context.database.read() as session:
        page = page_of_jobs(
            session,
            caller.project_id,
            context.settings,
            cursor=cursor,
            limit=limit,
            drive_id=drive_id,
            states=state or (),
            kinds=kind or (),
        )
    body = page.model_dump_json().encode()
    etag = f'"{hashlib.sha256(body).hexdigest()[:32]}"'
    headers = {"ETag": etag, "Cache-Control": "no-cache"}
    if none_match(request.headers.getlist("if-none-match"), etag):
        return Response(status_code=304, headers=headers)
    return Response(body, headers=headers, media_type="application/json")


@router.get(
    "/{job_id}",
    response_model=JobResource,
    summary="Show a job",
    responses={
        **gives(200, "The job as it is now", "ETag", "Cache-Control", sometimes=["Retry-After"]),
        **gives(304, "Nothing has changed since If-None-Match", "ETag", "Cache-Control", sometimes=["Retry-After"]),
        **problems(401, 404),
    },
)
def get_job(
    job_id: str,
    caller: CallerDep,
    context: ContextDep,
    response: Response,
    if_none_match: Annotated[
        list[str] | None, Header(alias="If-None-Match", description="`ETag` of an answer before")
    ] = None,
) -> Response | JobResource:
    """One job: poll this every `Retry-After` seconds, with `If-None-Match`, or read its events."""
    with context.database.read() as session:
        job = require(session, Job, caller.project_id, job_id)
        shown = view_of(session, job, context.settings)
    etag = etag_of(job, shown)
    headers = {"ETag": etag, "Cache-Control": "no-cache"}
    if job.state not in TERMINAL:
        headers["Retry-After"] = str(RETRY_AFTER_S)
    if none_match(if_none_match, etag):
        return Response(status_code=304, headers=headers)
    response.headers.update(headers)
    return shown


@router.post(
    "/{job_id}:cancel",
    status_code=202,
    response_model=JobResource,
    summary="Cancel a job",
    responses={**gives(202, "It has ended, or will", "Location"), **problems(401, 404, 409, 422)},
)
def cancel_job(
    job_id: str, once: IdempotentDep, caller: CallerDep, context: ContextDep, background: BackgroundTasks
) -> Response:
    """Ask for a job's end. One that waits ends at once; one that runs is told to stop, and killed if it does not.

    With an aggregation, the reconstructions end that were made for it and that nobody else waits for; with a
    reconstruction, its sub-maps. A sub-map that is cancelled fails its reconstruction.
    """

    def effect(session: Session) -> Answer:
        require(session, Job, caller.project_id, job_id)
        jobs.request_cancel(session, job_id)
        job = session.get_one(Job, job_id, populate_existing=True)
        return answer(202, view_of(session, job, context.settings), Location=f"/v1/jobs/{job_id}")

    background.add_task(job_trees.end_orphans, context.database)
    return once(effect)


@router.post(
    "/{job_id}:retry",
    status_code=202,
    response_model=JobResource,
    summary="Do a job again",
    responses={**ACCEPTED, **problems(401, 404, 409, 413, 422, 429)},
)
def retry_job(job_id: str, once: IdempotentDep, caller: CallerDep, context: ContextDep) -> Response:
    """Do again what failed or was cancelled, as a new job. Finished stages are reused.

    One retry of a job is active at a time: another one is refused with the active job's id.
    A sub-map is not retried alone: the retry of its reconstruction maps those again that are not finished.
    """

    def effect(session: Session) -> Answer:
        expires_us = expiry_us(now_us(), context.settings.job_retention_days)
        job = require(session, Job, caller.project_id, job_id)
        if job.kind == JobKind.AGGREGATION:
            return accepted(session, context, *aggregations.retry(session, job, expires_us=expires_us))
        if job.kind == JobKind.EXPORT:
            again = exports.retry(session, job, expires_us=expires_us)
            return accepted(session, context, again, [again])
        new = jobs.retry(session, job, expires_us=expires_us)
        return accepted(session, context, new, [new])

    return once(effect)


def _existing(job_id: str, caller: CallerDep, context: ContextDep) -> str:
    """Asked before the stream begins: a stream cannot answer 404 any more."""
    with context.database.read() as session:
        return require(session, Job, caller.project_id, job_id).id


@router.get(
    "/{job_id}/events",
    response_class=EventSourceResponse,
    summary="Follow a job",
    responses={
        **gives(200, "Events as they come", "Cache-Control", "X-Accel-Buffering", content=_EVENTS),
        **problems(401, 404, 422, 429),
    },
)
async def stream_job_events(
    job_id: Annotated[str, Depends(_existing)],
    context: ContextDep,
    request: Request,
    stream: StreamDep,
    last_event_id: LastEventId = None,
) -> AsyncIterator[ServerSentEvent]:
    """The job's changes of state, from the beginning, and its newest progress, until it or the key has ended."""
    last, secret = last_event_id or 0, secret_of(request) or ""
    while not stream.has_ended:
        ended, events = await stream.look(_news, context, secret, job_id, last)
        for event in events:
            last = event.id
            yield ServerSentEvent(id=str(event.id), event=event.kind, data=event.data)
        if ended and not events:
            return
        if not events:
            await stream.pause(context.settings.poll_seconds)


def _news(context: Context, secret: str, job_id: str, last: int) -> tuple[bool, list[JobEvent]]:
    if context.keys.find(secret) is None:
        return True, []  # revoked since the stream began
    with context.database.read() as session:
        state = session.scalar(select(Job.state).where(Job.id == job_id))
        ended = state is None or JobState(state) in TERMINAL
        return ended, jobs.events_after(session, job_id, last)
