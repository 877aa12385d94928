"""Rules for the body of every request: it is sent as it is, and it keeps coming."""

from __future__ import annotations

import asyncio

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.api.http.problem_response import problem_response
from service.errors import EncodedBody, ServiceError, TooSlow


class BodyRules:
    """ASGI middleware; it holds nothing back, so that uploads stream past it.

    Parameters
    ----------
    idle_s
        A body of which nothing comes for so long ends with 408, raised where it is read: a client that is gone
        without a word would hold its connection and its file for ever.
    """

    def __init__(self, app: ASGIApp, idle_s: float) -> None:
        self._app = app
        self._idle_s = idle_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        encoding = Headers(scope=scope).get("content-encoding", "identity").strip().lower()
        if encoding not in ("", "identity"):
            await problem_response(_encoded(encoding))(scope, receive, send)
            return
        coming, silent = True, False

        async def timed_receive() -> Message:
            nonlocal coming, silent
            if silent:
                raise _silent(self._idle_s)
            if not coming:  # what is awaited now is the client's leaving
                return await receive()
            try:
                async with asyncio.timeout(self._idle_s):
                    message = await receive()
            except TimeoutError:
                silent = True
                raise _silent(self._idle_s) from None
            coming = message["type"] == "http.request" and message.get("more_body", False)
            return message

        await self._app(scope, timed_receive, send)


def _silent(idle_s: float) -> ServiceError:
    return TooSlow(
        f"no byte of the body came for {idle_s:g} s",
        remedy="Send it again; a resumable upload goes on at the offset that HEAD gives.",
        headers={"Connection": "close"},
    )


def _encoded(encoding: str) -> ServiceError:
    return EncodedBody(
        f"Content-Encoding {encoding[:40]!r} is not taken: digests and lengths are those of the bytes sent",
        remedy="Send the bytes as they are, without Content-Encoding.",
        headers={"Accept-Encoding": "identity"},
    )
