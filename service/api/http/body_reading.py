"""Request bodies that are read whole: within bounds; large ones at a bearable rate and in the turn of their project."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack
from dataclasses import dataclass
from typing import TypeVar

import anyio
from fastapi import Request
from pydantic import BaseModel
from starlette.concurrency import run_in_threadpool

from schemas.parsing import DocumentError, parse_document
from service.api.context import DOCUMENT_WITHIN_S, Context
from service.api.dependencies import CallerDep
from service.api.http.request_bodies import BODY, Body, refuse_form
from service.api.manifests.bounded_process import LARGE_BYTES
from service.errors import InvalidDocument, ServiceError, TooSlow, invalid_document, require_size
from service.settings import Settings

Model = TypeVar("Model", bound=BaseModel)
Value = TypeVar("Value")

# The slowest DSL uplinks have 0.5 Mbit/s, 56 kB/s of payload. Whoever has less cannot send a drive anyway: to a
# manifest of 9 MB belong 25 GB of images, six days at this rate.
_MIN_RATE_BYTES_S = 50_000
_WITHIN_S = 600.0  # at any rate: others may wait for the place
_GRACE_S = 10.0  # an uplink that is lost for a moment, a sender that begins slowly
_PLACE_WITHIN_S = 60.0


def json_body(
    model: type[Model], max_bytes: Callable[[Settings], int]
) -> Callable[[Request, CallerDep], AsyncIterator[Body[Model]]]:
    """A dependency that reads a JSON body as `model`.

    FastAPI's own parsing would hold a body of any size in memory, and takes NaN and repeated keys.
    """

    def parse(context: Context, raw: bytes) -> Model:
        try:
            return parse_document(raw, model)
        except DocumentError as error:
            raise invalid_document(error, what=BODY) from None

    return parsed_body(parse, max_bytes)


def parsed_body(
    parse: Callable[[Context, bytes], Value], max_bytes: Callable[[Settings], int]
) -> Callable[[Request, CallerDep], AsyncIterator[Body[Value]]]:
    """A dependency that reads a body and what `parse`, which may block, makes of it.

    Few large bodies are held at one time, and one of them is parsed and recorded: it takes ten times its size until it
    is answered. The caller is known before a byte is read. Routes depend on it with `scope="function"`: a place ends
    with the request's effect, and not only when its client has taken the answer.
    """

    async def read(request: Request, caller: CallerDep) -> AsyncIterator[Body[Value]]:
        context: Context = request.app.state.context
        async with AsyncExitStack() as held:
            turns = _Turns(context, caller.project_id, held)
            raw = await _read(request, max_bytes(context.settings), turns)
            try:
                value = await run_in_threadpool(parse, context, raw)
            except ServiceError as error:
                if error.code == InvalidDocument.code:
                    remedy = "Send the document alone: with curl --data-binary @FILE, not -F."
                    refuse_form(request, InvalidDocument, what="the document", remedy=remedy)
                raise
            yield Body(value, raw)

    return read


@dataclass(frozen=True)
class _Turns:
    """The places that a large body holds until its request is answered."""

    context: Context
    project_id: str
    held: AsyncExitStack

    async def of_body(self) -> None:
        """Wait to be held in memory; raises as `FairPlaces.place`."""
        place = self.context.large_bodies.place(self.project_id, within_s=_PLACE_WITHIN_S)
        await self.held.enter_async_context(place)

    async def of_document(self) -> None:
        """Wait to be parsed; raises as `FairPlaces.place`."""
        place = self.context.large_documents.place(self.project_id, within_s=DOCUMENT_WITHIN_S)
        await self.held.enter_async_context(place)


async def _read(request: Request, bound: int, turns: _Turns) -> bytes:
    """The request's body, which waits for its turns once it proves to be large.

    Raises
    ------
    ServiceError
        413 as soon as it is known to be larger than `bound`, 408 where a large one comes too slowly, 429 or 503 where
        its turn does not come.
    """
    require_size(int(request.headers.get("content-length", 0)), bound)
    stream = request.stream()
    parts = [part async for part in _until(stream, min(bound, LARGE_BYTES))]
    if sum(map(len, parts)) > LARGE_BYTES:
        # Only now: who announces a large body and sends none shall not hold up those who do.
        await turns.of_body()
        parts += [part async for part in _until(_at_bearable_rate(stream), bound - sum(map(len, parts)))]
        await turns.of_document()
    require_size(sum(map(len, parts)), bound)
    return b"".join(parts)


async def _until(stream: AsyncIterator[bytes], enough_bytes: int) -> AsyncIterator[bytes]:
    """Parts of a stream until there are more bytes than these, or no more."""
    size_bytes = 0
    async for part in stream:
        yield part
        size_bytes += len(part)
        if size_bytes > enough_bytes:
            return


async def _at_bearable_rate(stream: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    """Parts of a stream that, since now and after a grace, comes at the least rate on average.

    Raises
    ------
    ServiceError
        408 as soon as it falls behind.
    """
    started_s, size_bytes = anyio.current_time(), 0
    while True:
        due_s = started_s + min(_GRACE_S + size_bytes / _MIN_RATE_BYTES_S, _WITHIN_S)
        try:
            with anyio.fail_after(due_s - anyio.current_time()):
                part = await anext(stream, b"")
        except TimeoutError:
            raise _slow(size_bytes, anyio.current_time() - started_s) from None
        if not part:
            return
        size_bytes += len(part)
        yield part


def _slow(size_bytes: int, elapsed_s: float) -> ServiceError:
    return TooSlow(
        f"{size_bytes} bytes of the body came in the {elapsed_s:.0f} s since its turn: large ones have to come at "
        f"{_MIN_RATE_BYTES_S // 1000} kB/s on average and within {_WITHIN_S:g} s, as others wait for their place",
        remedy="Repeat it over a faster connection or with fewer uploads beside it, or split the drive.",
        headers={"Connection": "close"},
    )
