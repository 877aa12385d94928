"""Cursors: where a list goes on."""

from __future__ import annotations

import base64
import binascii
import json
from typing import Any

from schemas.drive import MAX_PATH_CHARACTERS
from service.errors import (
    BadCursor,
)

MAX_LIMIT = 1000
# Of the longest position, a path: four bytes a character in UTF-8, and four characters of base64 for three bytes.
MAX_CURSOR_CHARACTERS = 4 * (4 * MAX_PATH_CHARACTERS + len('[""]') + 2) // 3


def cursor_of(*position: Any) -> str:
    """A cursor that holds a position."""
    return base64.urlsafe_b64encode(json.dumps(position, ensure_ascii=False).encode()).decode().rstrip("=")


def position_of(cursor: str | None, *kinds: type) -> tuple[Any, ...] | None:
    """The position in a cursor; None at the start.

    Raises
    ------
    ServiceError
        422 where the cursor is not one of ours.
    """
    if cursor is None:
        return None
    try:
        raw = base64.urlsafe_b64decode(cursor.encode("ascii") + b"=" * (-len(cursor) % 4))
        position = json.loads(raw)
        if not isinstance(position, list) or [type(value) for value in position] != list(kinds):
            raise ValueError
        if any(isinstance(value, int) and not 0 <= value < 2**62 for value in position):
            raise ValueError
        if not all(str(value).isprintable() for value in position):
            raise ValueError  # databases refuse NUL and halves of surrogate pairs in a parameter
    except (ValueError, binascii.Error, RecursionError):
        raise BadCursor(
            "the query parameter 'cursor' was not given by this service",
            remedy="Give 'next' of the page before, unchanged, or nothing for the first page.",
        ) from None
    return tuple(position)
