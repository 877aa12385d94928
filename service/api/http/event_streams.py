"""Event streams: answers without an end of their own. They end with the server, and a project has a bound of them."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager, suppress
from typing import Any, TypeVar, TypeVarTuple

import anyio
import anyio.to_thread
from starlette.requests import Request

from service.errors import TooManyStreams

_KEY = "mrasfm_event_stream"  # in the state of the request
_RETRY_AFTER_S = 30
_THREADS = 8

Given = TypeVarTuple("Given")
News = TypeVar("News")


class EventStream:
    """One open stream. It ends by itself where the server stops: uvicorn would wait for it, and cut it off."""

    def __init__(self, threads: anyio.CapacityLimiter) -> None:
        self._ended = asyncio.Event()
        self._threads = threads

    async def look(self, function: Callable[[*Given], News], *given: *Given) -> News:
        """The result of a function that asks the database, in a thread."""
        return await anyio.to_thread.run_sync(function, *given, limiter=self._threads)

    async def pause(self, pause_s: float) -> None:
        """Wait before the next look for news, no longer than the server goes on."""
        with suppress(TimeoutError):
            async with asyncio.timeout(pause_s):
                await self._ended.wait()

    @property
    def has_ended(self) -> bool:
        """True once the server stops."""
        return self._ended.is_set()

    def end(self) -> None:
        """Tell the stream to end."""
        self._ended.set()


class EventStreams:
    """Open streams of one process, for its event loop alone.

    Parameters
    ----------
    per_project
        Streams of one project that are open at one time. Each asks the database every second, which takes 1 ms: 100
        of them a tenth of a core. Without a bound one key could keep the process from answering others.
    """

    def __init__(self, per_project: int) -> None:
        self._per_project = per_project
        self._open: Counter[str] = Counter()
        # Of their own: a database that does not answer would else let streams take the threads of all other requests.
        self._threads = anyio.CapacityLimiter(_THREADS)

    @property
    def open_streams(self) -> int:
        """Number of streams that are open."""
        return self._open.total()

    @asynccontextmanager
    async def opened(self, request: Request, project_id: str) -> AsyncIterator[EventStream]:
        """A stream that is open until the block ends.

        Raises
        ------
        TooManyStreams
        """
        if self._open[project_id] >= self._per_project:
            raise TooManyStreams(
                f"the project has {self._per_project} event streams open, which is the bound",
                remedy="Close some, or poll: GET /v1/jobs with If-None-Match.",
                headers={"Retry-After": str(_RETRY_AFTER_S)},
            )
        stream = EventStream(self._threads)
        setattr(request.state, _KEY, stream)
        self._open[project_id] += 1
        try:
            yield stream
        finally:
            self._open[project_id] -= 1
            if not self._open[project_id]:
                del self._open[project_id]


def end_stream(scope: Mapping[str, Any]) -> None:
    """End the event stream that answers a request; nothing where it is answered otherwise."""
    stream = scope.get("state", {}).get(_KEY)
    if stream is not None:
        stream.end()
