"""uvicorn's HTTP protocol with bounds on what it leaves open: the time and the bytes of a request's head.

A bound for headers is not among the settings that uvicorn gives its fast parser, and without one anybody, with no key,
could fill the memory of the process. Nor does it end connections that never make a request.
"""

from __future__ import annotations

import asyncio

from uvicorn.config import Config
from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol
from uvicorn.server import ServerState

from service.errors import ServiceError
from service.problem_response import problem_response

MAX_HEAD_BYTES = 64_000
HEAD_WITHIN_S = 30.0
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

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """As uvicorn's."""
        super().connection_made(transport)
        self._wait_for_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """As uvicorn's."""
        self._stop_waiting()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """As uvicorn's; a request whose head has no end is refused."""
        if self.transport.is_closing():
            return  # it was refused, and goes on sending
        self._around_bytes += len(data)
        super().data_received(data)
        if self._around_bytes > MAX_HEAD_BYTES and not self.transport.is_closing():
            self._refuse(
                ServiceError(
                    431,
                    "head-too-large",
                    "The request's head is too large",
                    f"request line, headers and trailers have over {MAX_HEAD_BYTES} bytes",
                    remedy="Send fewer and shorter headers.",
                )
            )

    def on_message_begin(self) -> None:
        """As uvicorn's."""
        super().on_message_begin()
        if self._waiting is None:
            self._wait_for_head()

    def on_headers_complete(self) -> None:
        """As uvicorn's."""
        self._stop_waiting()
        super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        """As uvicorn's."""
        self._around_bytes = max(0, self._around_bytes - len(body) - _FRAME_BYTES)
        super().on_body(body)

    def on_message_complete(self) -> None:
        """As uvicorn's."""
        self._around_bytes = 0
        super().on_message_complete()

    def send_400_response(self, msg: str) -> None:
        """As uvicorn's, as a problem."""
        self._refuse(
            ServiceError(
                400, "malformed-request", "Malformed request", "this is not HTTP/1.1", remedy="Use an HTTP client."
            )
        )

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
        self._refuse(
            ServiceError(
                408,
                "too-slow",
                "The request took too long",
                f"its head was not here within {HEAD_WITHIN_S:g} s",
                remedy="Send it again.",
            )
        )

    def _refuse(self, error: ServiceError) -> None:
        """Answer and hang up, unless another answer is under way."""
        if self.cycle is None or self.cycle.response_complete:
            answer = problem_response(error)
            answer.headers["Connection"] = "close"
            lines = [STATUS_LINE[error.status], *(b"%b: %b\r\n" % header for header in answer.raw_headers), b"\r\n"]
            self.transport.write(b"".join(lines) + bytes(answer.body))
        self.transport.close()
