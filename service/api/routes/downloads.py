"""A stored file as an answer: ranges, validators and digests, the same for all results."""

from __future__ import annotations

import re
from collections.abc import AsyncIterator
from typing import Any

from fastapi import Request, Response
from fastapi.responses import StreamingResponse

from schemas.api.resource import EXAMPLE_SHA256
from service.api.context import Context
from service.api.http.ranges import Part, content_disposition, none_match, requested_part, require_match
from service.api.http.responses import gives, precondition_failed
from service.database.tables import Blob
from service.digests import format_digest
from service.errors import store_unavailable

_ETAG = f'"{EXAMPLE_SHA256}"'
_FILE = {"schema": {"type": "string", "format": "binary"}}
_CONTENT = {"application/octet-stream": _FILE}
_HEADERS = (
    "ETag",
    "Repr-Digest",
    "Accept-Ranges",
    "Cache-Control",
    "Content-Disposition",
)
_NOT_MODIFIED = gives(304, "The client has this version", *_HEADERS)
_OTHER_VERSION = precondition_failed("If-Match names another version", "ETag")
DOWNLOADS = {
    **gives(200, "The whole file", *_HEADERS, content=_CONTENT),
    **gives(206, "The range that was asked for", *_HEADERS, "Content-Range", content=_CONTENT),
    **_NOT_MODIFIED,
    **_OTHER_VERSION,
}
HEADS = {**gives(200, "What a download would answer", *_HEADERS, "Content-Length"), **_NOT_MODIFIED, **_OTHER_VERSION}


def _asked(name: str, description: str, example: str) -> dict[str, Any]:
    return {
        "name": name,
        "in": "header",
        "required": False,
        "description": description,
        "schema": {"type": "string"},
        "example": example,
    }


_IF_MATCH = _asked("If-Match", "`ETag` of what you want: 412 where the file is another by now", _ETAG)
_IF_NONE_MATCH = _asked("If-None-Match", "`ETag` of what you have: 304 where the file is still that", _ETAG)
# `openapi_extra` of the routes: `send_file` reads these itself.
HEAD_PARAMETERS = {"parameters": [_IF_MATCH, _IF_NONE_MATCH]}
DOWNLOAD_PARAMETERS = {
    "parameters": [
        _asked("Range", "one part: `bytes=FIRST-LAST`, `bytes=FIRST-` or `bytes=-COUNT`", "bytes=0-1023"),
        _asked("If-Range", "`ETag` of what you have: the whole file where it is another by now", _ETAG),
        _IF_MATCH,
        _IF_NONE_MATCH,
    ]
}


async def send_file(context: Context, request: Request, blob: Blob, *, media_type: str, name: str) -> Response:
    """The bytes of a blob, or the part that is asked for.

    Parameters
    ----------
    name
        What the file is called where it is saved.

    Raises
    ------
    ServiceError
        412 where If-Match names another version, 416 for a range outside the file, 503 where the store misses it.
    """
    etag = f'"{blob.sha256}"'
    headers = {
        "ETag": etag,
        "Repr-Digest": format_digest(blob.sha256),
        "Accept-Ranges": "bytes",
        "Cache-Control": "private, no-cache",
        "Content-Disposition": content_disposition(name),
    }
    # In this order (RFC 9110, 13.2.2).
    require_match(request.headers.getlist("if-match"), etag)
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


def download_name(owner: str, path: str) -> str:
    """The file's name with its owner: a folder of downloads holds many a points.ply."""
    return f"{owner}-{re.sub('/+', '-', path)}"


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
