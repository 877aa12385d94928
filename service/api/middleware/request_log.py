"""Every request is given an id, logged and counted."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping

from starlette.datastructures import MutableHeaders
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.api.metrics import Metrics
from service.database.tables import new_id
from service.logs import log_fields

log = logging.getLogger("mrasfm.api")

PROJECT = "mrasfm.project"  # in the scope of a request whose key or session is valid


class RequestLog:
    """ASGI middleware; it touches no body, so that uploads and downloads stream past it.

    Parameters
    ----------
    failed
        What answers a request that raised: here, so that the answer has the request's id, and its log too.
    """

    def __init__(self, app: ASGIApp, metrics: Metrics, failed: Callable[[], Response]) -> None:
        self._app = app
        self._metrics = metrics
        self._failed = failed

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request_id, started_s, status, received_bytes, sent_bytes = new_id("req"), time.perf_counter(), 0, 0, 0
        is_stream = False

        async def counted_receive() -> Message:
            nonlocal received_bytes
            message = await receive()
            received_bytes += len(message.get("body", b""))
            return message

        async def send_with_id(message: Message) -> None:
            nonlocal status, sent_bytes, is_stream
            if message["type"] == "http.response.start":
                status, headers = message["status"], MutableHeaders(scope=message)
                is_stream = headers.get("content-type", "").startswith("text/event-stream")
                headers["X-Request-Id"] = request_id
            await send(message)
            sent_bytes += len(message.get("body", b""))

        with log_fields(request_id=request_id):
            try:
                await self._app(scope, counted_receive, send_with_id)
            except Exception:
                log.exception("the service failed")
                if status:
                    raise  # the answer has begun: the server breaks the connection off
                await self._failed()(scope, counted_receive, send_with_id)
            finally:
                self._metrics.received_bytes.inc(received_bytes)
                self._metrics.sent_bytes.inc(sent_bytes)
                transferred = {"received_bytes": received_bytes, "sent_bytes": sent_bytes}
                self._note(scope, status, time.perf_counter() - started_s, transferred, is_stream=is_stream)

    def _note(
        self, scope: Scope, status: int, elapsed_s: float, transferred: Mapping[str, int], *, is_stream: bool
    ) -> None:
        # The route, not the path, is a label: paths are as many as files.
        route = getattr(scope.get("route"), "path", "none")
        self._metrics.requests.labels(scope["method"], route, status).inc()
        if not is_stream:  # how long somebody listened is no time to answer
            self._metrics.seconds.labels(scope["method"], route).observe(elapsed_s)
        client = scope.get("client") or (None, None)  # of a socket in the file system there is none
        fields = {
            "method": scope["method"],
            "route": route,
            "path": scope["path"],
            "status": status,
            "project": scope.get(PROJECT),
            "client": client[0],
            **transferred,
            "seconds": round(elapsed_s, 4),
        }
        log.info("request", extra={"fields": fields})
