"""Dependencies of the routes: the context, the caller, and the idempotent execution of a POST."""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Annotated

from fastapi import BackgroundTasks, Depends, Header, Query, Request, Response
from fastapi.responses import JSONResponse
from fastapi.security import HTTPBearer
from pydantic import BaseModel, StringConstraints
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from schemas.patterns import Pattern
from service.api.context import Context
from service.api.credentials import secret_of
from service.api.http.event_streams import EventStream
from service.api.http.paging import MAX_CURSOR_CHARACTERS, MAX_LIMIT
from service.api.http.query_parameters import refuse_unknown_parameters
from service.api.http.request_bodies import request_sha256
from service.api.middleware.request_log import PROJECT
from service.database.tables import Job
from service.domain import jobs
from service.domain.idempotency import Answer, once
from service.errors import Unauthorized
from service.job_queue import BrokerError

log = logging.getLogger("mrasfm.api")


# Dependencies that do not wait are coroutines: FastAPI would send each to a thread of its own. None asks for another:
# FastAPI solves one anew wherever it is named, and an upload of small files is mostly that.
async def get_context(request: Request) -> Context:
    """The process's resources."""
    context: Context = request.app.state.context
    return context


ContextDep = Annotated[Context, Depends(get_context)]


@dataclass(frozen=True)
class Caller:
    """Whose key the request carries."""

    project_id: str


class _ApiKey(HTTPBearer):
    """FastAPI's, so that the OpenAPI page says which key a route needs; what it gives is the key's owner.

    The console's cookie stands for the key that it was made with.
    """

    async def __call__(self, request: Request) -> Caller:  # type: ignore[override]
        """Identify the caller.

        Raises
        ------
        ServiceError
            401 without a valid key or session, 403 for a write that another site's page made with the cookie, 422 for
            query parameters that the route does not have.
        """
        context = await get_context(request)
        secret, project_id = secret_of(request), None
        if secret is not None:
            project_id = context.keys.remembered(secret) or await run_in_threadpool(context.keys.look_up, secret)
        if project_id is None:
            given = "the API key is not valid" if secret is not None else "the request carries no API key"
            raise Unauthorized(
                given,
                remedy="Send 'Authorization: Bearer KEY' with a key made by 'mrasfm keys create'.",
                headers={"WWW-Authenticate": 'Bearer realm="mrasfm"'},
            )
        request.scope[PROJECT] = project_id
        refuse_unknown_parameters(request)  # not before: a key in the address is none, and answered as that
        return Caller(project_id)


_api_key = _ApiKey(
    auto_error=False, scheme_name="HTTPBearer", description="An API key: `Authorization: Bearer mrasfm_...`"
)
CallerDep = Annotated[Caller, Depends(_api_key)]


async def get_event_stream(context: ContextDep, caller: CallerDep, request: Request) -> AsyncIterator[EventStream]:
    """The event stream that answers this request.

    Raises
    ------
    ServiceError
        429 where the project has as many open as it may.
    """
    async with context.streams.opened(request, caller.project_id) as stream:
        yield stream


StreamDep = Annotated[EventStream, Depends(get_event_stream)]

Limit = Annotated[int, Query(ge=1, le=MAX_LIMIT, description="items a page")]
LastEventId = Annotated[
    int | None,
    Header(alias="Last-Event-ID", ge=0, lt=2**62, description="go on after this event, as a browser does by itself"),
]
Cursor = Annotated[str | None, Query(max_length=MAX_CURSOR_CHARACTERS, description="`next` of the page before")]
_IDEMPOTENCY = (
    "Names this request: repeated under the same key it has its effect once, and the first answer is replayed for a day"
)
_Key = Annotated[
    str,
    StringConstraints(min_length=1, max_length=255),
    Pattern(r"^[\x21-\x7e]+$", words="printable characters of ASCII without spaces"),
]


@dataclass(frozen=True)
class IdempotentRequest:
    """Runs a POST's effect in one transaction, once a key, and wakes workers up for the jobs that it made."""

    context: Context
    caller: Caller
    request: Request
    background: BackgroundTasks
    key: str | None

    def __call__(
        self, effect: Callable[[Session], Answer], raw: bytes = b"", *, prepare: Callable[[], None] | None = None
    ) -> Response:
        """Answer the request; `raw` is its body, `prepare` what takes long and comes before the transaction."""
        answer = once(
            self.context.database,
            effect,
            holds=self.context.holds,
            project_id=self.caller.project_id,
            key=self.key,
            request_sha256=request_sha256(self.request, raw),
            keep_us=int(self.context.settings.idempotency_hours * 3600e6),
            prepare=prepare,
        )
        headers = dict(answer.headers)
        if answer.replayed:
            headers["Idempotent-Replayed"] = "true"
        if answer.jobs:
            # After the answer: a broker that hangs must not hold up a request that is safely recorded.
            self.background.add_task(wake_up, self.context, list(answer.jobs))
        return JSONResponse(answer.body, status_code=answer.status, headers=headers, background=self.background)


async def get_idempotent_request(
    context: ContextDep,
    caller: CallerDep,
    request: Request,
    background: BackgroundTasks,
    idempotency_key: Annotated[_Key | None, Header(alias="Idempotency-Key", description=_IDEMPOTENCY)] = None,
) -> IdempotentRequest:
    """The idempotent execution of this request."""
    return IdempotentRequest(context, caller, request, background, idempotency_key)


IdempotentDep = Annotated[IdempotentRequest, Depends(get_idempotent_request)]


def wake_up(context: Context, waiting: list[Job]) -> None:
    """Tell workers about jobs; where the broker does not answer, the reconciler does it later."""
    try:
        context.job_queue.send(waiting)
    except BrokerError as error:
        log.warning("no worker was woken up", extra={"fields": {"why": str(error), "jobs": len(waiting)}})
        return
    with context.database.write() as session:
        jobs.mark_enqueued(session, [job.id for job in waiting])


def answer(status: int, body: BaseModel, *, waiting: tuple[Job, ...] = (), **headers: str) -> Answer:
    """An answer with a resource as its body; header names are written with underscores."""
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    return Answer(status=status, body=body.model_dump(mode="json"), headers=named, jobs=waiting)


def expiry_us(created_us: int, days: float | None) -> int | None:
    """Time at which a resource is deleted; None: never by itself."""
    return None if days is None else created_us + int(days * 86400e6)


def moment(time_us: int | None) -> datetime | None:
    """A time of the database as the API shows it."""
    return None if time_us is None else datetime.fromtimestamp(time_us / 1e6, UTC)
