"""A stored file as an answer: ranges, validators and digests, the same for all results."""

from __future__ import annotations

import re
from collections.abc import AsyncIterator, Callable
from typing import Any, Protocol, TypeVar
from urllib.parse import quote

from fastapi import APIRouter, Request, Response
from fastapi.responses import StreamingResponse
from sqlalchemy import ColumnElement, select
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from schemas.api.exports import ExportFileResource
from schemas.api.maps import MapFileResource
from schemas.api.resource import EXAMPLE_SHA256
from schemas.api.scenes import SceneFileResource
from service.api.context import Context
from service.api.http.ranges import Part, content_disposition, none_match, requested_part, require_match
from service.api.http.responses import gives, precondition_failed, problems
from service.database.tables import Blob, ExportFile, MapFile, SceneFile
from service.digests import format_digest
from service.errors import not_found, store_unavailable

File = TypeVar("File", SceneFile, MapFile, ExportFile)
FileResource = TypeVar("FileResource", SceneFileResource, MapFileResource, ExportFileResource)
Endpoint = TypeVar("Endpoint", bound=Callable[..., Any])
Found = TypeVar("Found")

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
_DOWNLOADS = {
    **gives(200, "The whole file", *_HEADERS, content=_CONTENT),
    **gives(206, "The range that was asked for", *_HEADERS, "Content-Range", content=_CONTENT),
    **_NOT_MODIFIED,
    **_OTHER_VERSION,
}
_HEADS = {**gives(200, "What a download would answer", *_HEADERS, "Content-Length"), **_NOT_MODIFIED, **_OTHER_VERSION}


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
IF_NONE_MATCH = _asked("If-None-Match", "`ETag` of what you have: 304 where the file is still that", _ETAG)
# `send_file` reads these headers itself.
_HEAD_PARAMETERS = {"parameters": [_IF_MATCH, IF_NONE_MATCH]}
_DOWNLOAD_PARAMETERS = {
    "parameters": [
        _asked("Range", "one part: `bytes=FIRST-LAST`, `bytes=FIRST-` or `bytes=-COUNT`", "bytes=0-1023"),
        _asked("If-Range", "`ETag` of what you have: the whole file where it is another by now", _ETAG),
        _IF_MATCH,
        IF_NONE_MATCH,
    ]
}


def download_route(router: APIRouter, path: str, *, summary: str) -> Callable[[Endpoint], Endpoint]:
    """Make an endpoint that is named `download_...` the GET and HEAD route of files."""

    def register(endpoint: Endpoint) -> Endpoint:
        get = router.get(
            path,
            response_class=Response,
            summary=summary,
            responses={**_DOWNLOADS, **problems(401, 404, 416)},
            openapi_extra=_DOWNLOAD_PARAMETERS,
        )
        head = router.head(
            path,
            response_class=Response,
            name=endpoint.__name__.replace("download", "head"),
            summary="Show a download's headers",
            responses={**_HEADS, **problems(401, 404)},
            openapi_extra=_HEAD_PARAMETERS,
        )
        return head(get(endpoint))

    return register


def files_of(
    session: Session, table: type[File], mine: ColumnElement[bool], resource: type[FileResource], url: str
) -> list[FileResource]:
    """Files of a result, by path, as the API shows them.

    Parameters
    ----------
    mine
        Selects the result's rows of the table.
    url
        The result's own.
    """
    statement = select(table, Blob).join(Blob, table.blob_id == Blob.id).where(mine).order_by(table.path)
    return [
        resource(
            path=file.path,
            size_bytes=blob.size_bytes,
            sha256=blob.sha256,
            media_type=file.media_type,
            url=f"{url}/files/{quote(file.path)}",
        )
        for file, blob in session.execute(statement)
    ]


def find_file(
    session: Session, table: type[File], mine: ColumnElement[bool], path: str, *, owner: str
) -> tuple[File, Blob]:
    """File of these with the given name.

    Raises
    ------
    NotFound
    """
    statement = select(table, Blob).join(Blob, table.blob_id == Blob.id).where(mine, table.path == path)
    row = session.execute(statement).first() if path.isprintable() else None
    if row is None:
        raise not_found(f"file in {owner} named", path)
    return row[0], row[1]


async def send_file(
    context: Context,
    request: Request,
    path: str,
    find: Callable[[Session], tuple[str, HasMediaType, Blob]],
) -> Response:
    """The bytes of a file, or the part that is asked for.

    Parameters
    ----------
    find
        Gives the name of the file's owner, under which it is saved, the file, and its blob.

    Raises
    ------
    ServiceError
        412 where If-Match names another version, 416 for a range outside the file, 503 where the store misses it; what
        `find` raises.
    """
    owner, file, blob = await run_in_threadpool(_found, context, find)
    etag = f'"{blob.sha256}"'
    media_type = file.media_type
    headers = {
        "ETag": etag,
        "Repr-Digest": format_digest(blob.sha256),
        "Accept-Ranges": "bytes",
        "Cache-Control": "private, no-cache",
        # With its owner: a folder of downloads holds many a points.ply.
        "Content-Disposition": content_disposition(f"{owner}-{re.sub('/+', '-', path)}"),
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


class HasMediaType(Protocol):
    """File whose kind is known."""

    @property
    def media_type(self) -> str:
        """Content-Type of the download."""


def _found(context: Context, find: Callable[[Session], Found]) -> Found:
    with context.database.read() as session:
        return find(session)


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
