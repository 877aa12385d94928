"""The web console at `/`, from files that come with the service. It needs no internet."""

from __future__ import annotations

from pathlib import Path

from fastapi import FastAPI, Request
from starlette.datastructures import MutableHeaders
from starlette.responses import FileResponse
from starlette.staticfiles import StaticFiles
from starlette.types import Message, Receive, Scope, Send

import service
from service.api.middleware.security_headers import CONTENT_SECURITY_POLICY

FILES = "/console/files"
FOLDER = Path(service.__file__).parent / "console" / "static"


def console_policy(tile_origin: str | None = None) -> str:
    """The policy of the console: scripts, pictures and requests of this host only, and none inline.

    Parameters
    ----------
    tile_origin
        Host that the operator takes the tiles of maps from.
    """
    tiles = "" if tile_origin is None else f" {tile_origin}"
    return "; ".join(
        [
            "default-src 'none'",
            "script-src 'self' 'wasm-unsafe-eval'",  # the points are decompressed in WebAssembly
            "style-src 'self'",
            f"img-src 'self' data: blob:{tiles}",
            f"connect-src 'self'{tiles}",
            "worker-src 'self'",
            "base-uri 'none'",
            "form-action 'self'",
            "frame-ancestors 'none'",
        ]
    )


def add_console(app: FastAPI, *, folder: Path = FOLDER, tile_origin: str | None = None) -> None:
    """Serve the console's page at `/` and what it loads below `/console/files`."""
    policy = console_policy(tile_origin)
    app.mount(FILES, _ConsoleFiles(folder, policy), name="console")

    async def console(request: Request) -> FileResponse:
        headers = {CONTENT_SECURITY_POLICY: policy, "Cache-Control": "no-cache", "Referrer-Policy": "no-referrer"}
        return FileResponse(folder / "index.html", headers=headers, media_type="text/html; charset=utf-8")

    app.add_route("/", console, include_in_schema=False)


class _ConsoleFiles:
    """Files of the console; each says under which policy a worker made of it runs."""

    def __init__(self, folder: Path, policy: str) -> None:
        self._files = StaticFiles(directory=folder)
        self._policy = policy

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_policy(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.setdefault(CONTENT_SECURITY_POLICY, self._policy)
                headers.setdefault(
                    "Cache-Control", "no-cache"
                )  # asked again with their ETag: a new version is seen at once
            await send(message)

        await self._files(scope, receive, send_with_policy)
