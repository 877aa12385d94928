"""Downloads: byte ranges and validators of RFC 9110, digests of RFC 9530."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from urllib.parse import quote

from service.errors import PreconditionFailed, RangeOutside

_RANGE = re.compile(r"bytes\s*=\s*(\d{0,19})\s*-\s*(\d{0,19})", re.ASCII | re.IGNORECASE)

_ENTITY_TAG = re.compile(r'(?:W/)?"[^"]*"')


@dataclass(frozen=True)
class Part:
    """Bytes `start` up to, not including, `stop`."""

    start: int
    stop: int


def requested_part(headers: Mapping[str, str], *, size_bytes: int, etag: str) -> Part | None:
    """The part of a file that a request asks for; None for all of it.

    Several ranges in one request, units other than bytes and an If-Range that does not match are answered with the
    whole file, as RFC 9110 allows.

    Raises
    ------
    ServiceError
        416 where the range lies outside the file.
    """
    given = headers.get("range")
    if given is None or headers.get("if-range", etag) != etag:
        return None
    match = _RANGE.fullmatch(given.strip())
    if match is None or match.groups() == ("", ""):
        return None
    first, last = match.groups()
    if first == "":
        start, stop = max(0, size_bytes - int(last)), size_bytes
    else:
        start, stop = int(first), size_bytes if last == "" else min(int(last) + 1, size_bytes)
        if last and int(last) < int(first):
            return None  # malformed: to be ignored
    if start >= size_bytes or start >= stop:
        raise RangeOutside(
            f"the file has {size_bytes} bytes, asked for is {given!r}",
            remedy="Ask for bytes that exist, or leave the header Range out.",
            headers={"Content-Range": f"bytes */{size_bytes}"},
        )
    return Part(start, stop)


def none_match(if_none_match: Sequence[str] | None, etag: str) -> bool:
    """Return whether the client has this version already, by all lines of the header."""
    tags = [tag.strip().removeprefix("W/") for line in if_none_match or () for tag in line.split(",")]
    return etag in tags or "*" in tags


def require_match(if_match: Sequence[str], etag: str) -> None:
    """Refuse a request that is meant for another version, by all lines of the header.

    Weak tags match nothing: RFC 9110 compares strongly here.

    Raises
    ------
    ServiceError
        412 where the header is there and names no version that the file has.
    """
    if not if_match:
        return
    tags = [tag for line in if_match for tag in _ENTITY_TAG.findall(line)]
    if etag in tags or any(line.strip() == "*" for line in if_match):
        return
    raise PreconditionFailed(
        f"If-Match asks for another version than {etag}, which the file has",
        remedy="Read the file's ETag anew, and begin the download again.",
        headers={"ETag": etag},
    )


def content_disposition(name: str) -> str:
    """An attachment's name, readable in every client: ASCII, and RFC 8187 where that is not enough."""
    plain = re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.") or "file"
    encoded = "" if plain == name else f"; filename*=UTF-8''{quote(name, safe='')}"
    return f'attachment; filename="{plain}"{encoded}'
