"""uvicorn's HTTP protocol with bounds on what it leaves open: the time and the bytes of a request's head.

A bound for headers is not among the settings that uvicorn gives its fast parser, and without one anybody, with no key,
could fill the memory of the process. Nor does it end connections that never make a request.
"""

from __future__ import annotations

import asyncio
import socket
from typing import TYPE_CHECKING, cast

from starlette.responses import Response
from uvicorn.config import Config
from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol
from uvicorn.server import ServerState

from service.api.http.event_streams import end_stream
from service.api.http.problem_response import problem_response
from service.api.middleware.security_headers import add_security_headers
from service.errors import HeadTooLarge, MalformedRequest, ServiceError, TooSlow

if TYPE_CHECKING:
    from uvicorn._types import ASGI3Application

MAX_HEAD_BYTES = 64_000
HEAD_WITHIN_S = 30.0
UNTAKEN_WITHIN_S = 120.0  # for so long a client may take nothing of what is sent to it
# Chunks of a body come with their lengths, and may come with signatures.
_FRAME_BYTES = 256


class BoundedHttpProtocol(HttpToolsProtocol):
    """One connection. What surrounds bodies is counted: request line, headers, frames of chunks and trailers."""

    def __init__(
        self,
        config: Config,
        server_state: ServerState,
        app_state: dict[str, object],
        _loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        super().__init__(config, server_state, app_state, _loop)
        self._around_bytes = 0
        self._waiting: asyncio.TimerHandle | None = None
        self._in_body = False  # between a request's head and its end
        self._refused = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Extend uvicorn's method of this name."""
        super().connection_made(transport)
        self._bound_sending(transport.get_extra_info("socket"))
        self._wait_for_head()

    @staticmethod
    def _bound_sending(connection: socket.socket) -> None:
        """End a connection whose answer nobody takes: it would be held for ever, with its file and what was read of it.

        Only Linux, and only TCP, has such a bound.
        """
        if connection.family in (socket.AF_INET, socket.AF_INET6) and hasattr(socket, "TCP_USER_TIMEOUT"):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(1000 * UNTAKEN_WITHIN_S))

    def connection_lost(self, exc: Exception | None) -> None:
        """Extend uvicorn's method of this name."""
        self._stop_waiting()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take data in; a request whose head has no end is refused. Overrides uvicorn's."""
        if self._refused or self.transport.is_closing():
            return  # it goes on sending
        self._around_bytes += len(data)
        super().data_received(data)
        if self._around_bytes > MAX_HEAD_BYTES and not (self._refused or self.transport.is_closing()):
            self._refuse(
                HeadTooLarge(
                    f"request line, headers and trailers have over {MAX_HEAD_BYTES} bytes",
                    remedy="Send fewer and shorter headers.",
                )
            )

    def shutdown(self) -> None:
        """Extend uvicorn's method of this name: it waits for answers to end, which event streams do not."""
        super().shutdown()
        if self.cycle is not None:
            end_stream(self.cycle.scope)

    def on_message_begin(self) -> None:
        """Extend uvicorn's method of this name."""
        super().on_message_begin()
        if self._waiting is None:
            self._wait_for_head()

    def on_headers_complete(self) -> None:
        """Extend uvicorn's method of this name."""
        self._stop_waiting()
        super().on_headers_complete()
        self._in_body = True

    def on_body(self, body: bytes) -> None:
        """Extend uvicorn's method of this name."""
        self._around_bytes = max(0, self._around_bytes - len(body) - _FRAME_BYTES)
        super().on_body(body)

    def on_message_complete(self) -> None:
        """Extend uvicorn's method of this name."""
        self._around_bytes = 0
        self._in_body = False
        super().on_message_complete()

    def send_400_response(self, msg: str) -> None:
        """Send 400 as a problem; overrides uvicorn's."""
        self._refuse(MalformedRequest("this is not HTTP/1.1", remedy="Use an HTTP client."))

    def _wait_for_head(self) -> None:
        self._waiting = self.loop.call_later(HEAD_WITHIN_S, self._too_slow)

    def _stop_waiting(self) -> None:
        if self._waiting is not None:
            self._waiting.cancel()
            self._waiting = None

    def _too_slow(self) -> None:
        self._waiting = None
        if self.transport.is_closing():
            return
        if self._around_bytes == 0:  # it never said anything
            self.transport.close()
            return
        self._refuse(TooSlow(f"its head was not here within {HEAD_WITHIN_S:g} s", remedy="Send it again."))

    def _refuse(self, error: ServiceError) -> None:
        """Answer the request that is at fault and hang up; complete requests before it are answered first."""
        self._refused = True
        self._stop_waiting()
        answer = problem_response(error)
        answer.headers["Connection"] = "close"
        add_security_headers(answer.headers)
        if self._in_body:
            self._refuse_body(answer)
        elif self.cycle is None or self.cycle.response_complete:
            self._write(answer)
            self.transport.close()
        else:
            self.cycle.keep_alive = False  # the request is complete; uvicorn hangs up behind its answer

    def _refuse_body(self, answer: Response) -> None:
        """Answer the request whose body is at fault; where its answer has begun, that is broken off."""
        if self.pipeline:
            cycle, _ = self.pipeline[0]  # the latest, which waits for those before it
            cycle.keep_alive = False
            self.pipeline[0] = (cycle, cast("ASGI3Application", answer))
            return
        if not self.cycle.response_started:
            self._write(answer)
            # What closing tells the application comes only once the client has taken the answer.
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        self.transport.close()

    def _write(self, answer: Response) -> None:
        lines = [STATUS_LINE[answer.status_code], *(b"%b: %b\r\n" % header for header in answer.raw_headers), b"\r\n"]
        self.transport.write(b"".join(lines) + bytes(answer.body))
