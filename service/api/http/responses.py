"""Responses of the routes for the OpenAPI page: statuses, and the headers that come with them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from schemas.api.problems import MEDIA_TYPE
from schemas.api.resource import EXAMPLE_JOB

Responses = dict[int | str, dict[str, Any]]

_DATE = "Tue, 05 May 2026 09:30:00 GMT"
_DIGEST = "q6urq6urq6urq6urq6urq6urq6urq6urq6urq6urq6s="  # of the SHA-256 in all examples


def _text(description: str, example: str) -> dict[str, Any]:
    return {"description": description, "schema": {"type": "string"}, "example": example}


def _number(description: str, example: int) -> dict[str, Any]:
    return {"description": description, "schema": {"type": "integer", "minimum": 0}, "example": example}


_HEADERS: dict[str, dict[str, Any]] = {
    "Accept-Encoding": _text("how bodies are taken", "identity"),
    "Accept-Ranges": _text("parts can be asked for with `Range`", "bytes"),
    "Cache-Control": _text("what a cache may do with the answer", "no-cache"),
    "Content-Disposition": _text("the file's name where it is saved", 'attachment; filename="ring-road-points.ply"'),
    "Content-Length": _number("bytes of the file", 1387264),
    "Content-Security-Policy": _text(
        "a browser shall run, load and frame nothing of the answer", "default-src 'none'; frame-ancestors 'none'"
    ),
    "Content-Range": _text("which bytes these are, and how many there are", "bytes 0-1023/1387264"),
    "ETag": _text("names this version: give it back as `If-None-Match`", '"12-running"'),
    "Idempotent-Replayed": _text("the answer is the one that the first request under this key got", "true"),
    "Location": _text("where it is, relative to the server", f"/v1/jobs/{EXAMPLE_JOB}"),
    "Repr-Digest": _text("SHA-256 of the whole file, in base64 (RFC 9530)", f"sha-256=:{_DIGEST}:"),
    "Retry-After": _number("seconds to wait until asking again", 2),
    "Set-Cookie": _text(
        "the session's cookie, or its end",
        "mrasfm_session=...; HttpOnly; Max-Age=43200; Path=/; SameSite=strict",
    ),
    "Tus-Checksum-Algorithm": _text("what `Upload-Checksum` may name", "sha1,sha256"),
    "Tus-Extension": _text("what of tus there is", "creation,checksum,expiration,termination"),
    "Tus-Max-Size": _number("bytes that an upload may have", 1_000_000_000_000),
    "Tus-Resumable": _text("the protocol's version", "1.0.0"),
    "Tus-Version": _text("the versions of the protocol that are spoken", "1.0.0"),
    "Upload-Expires": _text("when what was sent is dropped; every PATCH moves it on", _DATE),
    "Upload-Length": _number("bytes of the whole file", 73400320),
    "Upload-Metadata": _text("as it was given", "path ZnJvbnQvMDAwMDAwLnBuZw=="),
    "Upload-Offset": _number("how many bytes are here for good: where the next PATCH goes on", 1048576),
    "Want-Content-Digest": _text("which digest is compared", "sha-256=10"),
    "WWW-Authenticate": _text("how to say who calls", 'Bearer realm="mrasfm"'),
    "X-Accel-Buffering": _text("keeps nginx from holding events back", "no"),
    "X-Content-Type-Options": _text("a browser shall not guess what the answer is", "nosniff"),
    "X-Request-Id": _text("names the request in the service's log", "req_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c"),
}
_EVERY_ANSWER = ("Content-Security-Policy", "X-Content-Type-Options", "X-Request-Id")
COMPONENTS = {"headers": {name: {**_HEADERS[name], "required": True} for name in _EVERY_ANSWER}}

_PROBLEMS = {
    400: "The request is malformed",
    401: "No valid API key",
    403: "A page of another site asked for it with the console's cookie",
    404: "There is no such thing in this project",
    408: "The body came too slowly",
    409: "The resource is not in the right state; the problem says what to do",
    410: "Its time is over, and its bytes were dropped",
    412: "Another version of the protocol",
    413: "Too large, or the storage quota is full",
    415: "The bytes are of no kind that is taken here",
    416: "The range lies outside the file",
    422: "The request or the drive is at fault; all defects are listed",
    423: "Another request is writing it",
    429: "A quota is full; try later",
    460: "The checksum of the request's bytes is another; they were dropped",
    503: "Database, artifact store or another part does not answer; try again",
    507: "The disk is full",
}
_ALWAYS = {
    401: ["WWW-Authenticate"],
    412: ["Tus-Version"],
    416: ["Content-Range"],
    423: ["Retry-After"],
    460: ["Upload-Offset"],
    503: ["Retry-After"],
}
_SOMETIMES = {
    400: ["Want-Content-Digest"],
    409: ["Retry-After"],
    415: ["Accept-Encoding"],
    429: ["Retry-After"],
}


def gives(status: int, what: str, *headers: str, sometimes: Iterable[str] = (), **more: Any) -> Responses:
    """`responses` of a route: one that is no problem.

    Parameters
    ----------
    headers, sometimes
        Names of headers that it always has, and of those that it has at times.
    more
        Content, where FastAPI cannot know it.
    """
    return {status: {"description": what, "headers": _described(headers, sometimes), **more}}


def precondition_failed(what: str, *headers: str) -> Responses:
    """`responses` of a route whose 412 is not the resumable protocol's: what it means and which headers it has."""
    return {412: {**problems(412)[412], "description": what, "headers": _described(headers, ())}}


def problems(*statuses: int, sometimes: Mapping[int, str] | None = None) -> Responses:
    """`responses` of a route: which problems it answers with; `sometimes` is a header that one may have besides."""
    content = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    more = {status: [name] for status, name in (sometimes or {}).items()}
    return {
        status: {
            "description": _PROBLEMS[status],
            "headers": _described(_ALWAYS.get(status, ()), [*_SOMETIMES.get(status, ()), *more.get(status, ())]),
            "content": content,
        }
        for status in statuses
    }


def add_common_headers(operation: dict[str, Any]) -> None:
    """Headers that whole kinds of answers have: of a request that may have a key, of the resumable protocol, of all."""
    replays = any(given["name"] == "Idempotency-Key" for given in operation.get("parameters", ()))
    for status, response in operation["responses"].items():
        is_success = status < "400"
        headers = response.setdefault("headers", {})
        if replays and is_success:
            headers |= _described((), ["Idempotent-Replayed"])
        if "uploads" in operation["tags"]:
            names = ["Tus-Resumable"]
            headers |= _described(names if is_success else (), names)
        headers |= {name: {"$ref": f"#/components/headers/{name}"} for name in _EVERY_ANSWER}


def _described(always: Iterable[str], sometimes: Iterable[str]) -> dict[str, Any]:
    described = {name: _HEADERS[name] for name in sometimes}
    return described | {name: {**_HEADERS[name], "required": True} for name in always}
