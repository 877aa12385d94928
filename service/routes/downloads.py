"""A stored file as an answer: ranges, validators and digests, the same for all results."""

from __future__ import annotations

import re
from collections.abc import AsyncIterator
from typing import Any

from fastapi import Request, Response
from fastapi.responses import StreamingResponse

from service.context import Context
from service.errors import store_unavailable
from service.persistence.tables import Blob
from service.routes.ranges import Part, content_disposition, none_match, requested_part
from service.uploads.digests import format_digest

_FILE = {"schema": {"type": "string", "format": "binary"}}
DOWNLOADS: dict[int | str, dict[str, Any]] = {
    200: {"description": "The whole file", "content": {"application/octet-stream": _FILE}},
    206: {"description": "The range that was asked for", "content": {"application/octet-stream": _FILE}},
    304: {"description": "The client has this version"},
}
HEADS: dict[int | str, dict[str, Any]] = {
    200: {"description": "What a download would answer"},
    304: DOWNLOADS[304],
}


async def send_file(context: Context, request: Request, blob: Blob, *, media_type: str, name: str) -> Response:
    """The bytes of a blob, or the part that is asked for.

    Parameters
    ----------
    name
        What the file is called where it is saved.
    """
    etag = f'"{blob.sha256}"'
    headers = {
        "ETag": etag,
        "Repr-Digest": format_digest(blob.sha256),
        "Accept-Ranges": "bytes",
        "Cache-Control": "private, no-cache",
        "Content-Disposition": content_disposition(name),
        "X-Content-Type-Options": "nosniff",
    }
    if none_match(request.headers.getlist("if-none-match"), etag):
        return Response(status_code=304, headers=headers)
    asked = None
    if request.method == "GET":
        asked = requested_part(request.headers, size_bytes=blob.size_bytes, etag=etag)
    part = asked or Part(0, blob.size_bytes)
    headers["Content-Length"] = str(part.stop - part.start)
    if asked is not None:
        headers["Content-Range"] = f"bytes {part.start}-{part.stop - 1}/{blob.size_bytes}"
    if request.method == "HEAD":
        return Response(headers=headers, media_type=media_type)
    pieces = await _begun(context.artifacts.stream(blob.key, start=part.start, stop=part.stop))
    return StreamingResponse(pieces, status_code=200 if asked is None else 206, headers=headers, media_type=media_type)


def download_name(of: str, path: str) -> str:
    """Says what the file is of: a folder of downloads holds many a points.ply."""
    return f"{of}-{re.sub('/+', '-', path)}"


async def _begun(pieces: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    """The pieces, the first of which is there: once an answer has begun, it cannot become an error any more."""
    try:
        first = await anext(pieces, b"")
    except FileNotFoundError:
        raise store_unavailable() from None

    async def all_pieces() -> AsyncIterator[bytes]:
        yield first
        async for piece in pieces:
            yield piece

    return all_pieces()
