"""Pages of lists, and the cursors by which a list goes on."""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Iterable, Sequence
from itertools import accumulate
from typing import Any, TypeVar

from sqlalchemy import ColumnElement, Row, Select, select, tuple_
from sqlalchemy.orm import InstrumentedAttribute, Session, load_only

from schemas.drive import MAX_PATH_CHARACTERS
from service.database.tables import Drive, Export, Job, Map, Scene, Webhook
from service.errors import BadCursor

Paged = TypeVar("Paged", Drive, Export, Job, Map, Scene, Webhook)

MAX_LIMIT = 1000
# Of the longest position, a path: four bytes a character in UTF-8, and four characters of base64 for three bytes.
MAX_CURSOR_CHARACTERS = 4 * (4 * MAX_PATH_CHARACTERS + len('[""]') + 2) // 3


def page_of(
    session: Session,
    statement: Select[*tuple[Any, ...]],
    *keys: InstrumentedAttribute[Any],
    cursor: str | None,
    limit: int,
    is_rising: bool = False,
) -> tuple[Sequence[Row[*tuple[Any, ...]]], str | None]:
    """Read a page of rows.

    Parameters
    ----------
    statement
        Selects the rows, whose first entity has the keys.
    keys
        Order the rows, and are unique together.
    is_rising
        Whether the smallest comes first.

    Returns
    -------
    rows, next
        The cursor of the next page is None where there is none.

    Raises
    ------
    BadCursor
    """
    after = position_of(cursor, *(key.type.python_type for key in keys))
    if after is not None:
        here = tuple_(*keys)
        statement = statement.where(here > after if is_rising else here < after)
    order = (key.asc() if is_rising else key.desc() for key in keys)
    rows = session.execute(statement.order_by(*order).limit(limit)).all()
    following = None if len(rows) < limit else cursor_of(*(getattr(rows[-1][0], key.key) for key in keys))
    return rows, following


def newest(
    session: Session,
    table: type[Paged],
    project_id: str,
    *,
    cursor: str | None,
    limit: int,
    places_only: bool = False,
    conditions: Sequence[ColumnElement[bool]] = (),
    **where: Any,
) -> tuple[list[Paged], str | None]:
    """Read a page of a project's rows, the newest first, of those that have the values of `where` that are not None.

    Parameters
    ----------
    places_only
        Whether nothing of the rows is loaded but their places in the list.
    conditions
        Further ones, all of which the rows meet.
    """
    statement = select(table).where(table.project_id == project_id, *conditions)
    if places_only:
        statement = statement.options(load_only(table.id, table.created_us))
    statement = statement.filter_by(**{name: value for name, value in where.items() if value is not None})
    rows, following = page_of(session, statement, table.created_us, table.id, cursor=cursor, limit=limit)
    return [row for (row,) in rows], following


def newest_after(row: Drive | Export | Job | Map | Scene | Webhook) -> str:
    """The cursor of the page of `newest` that goes on after a row."""
    return cursor_of(row.created_us, row.id)


def count_together(children: Iterable[int], most: int) -> int:
    """Number of the first items that have no more than so many children together; one at least, if there is one.

    Parameters
    ----------
    children
        Number of the children of each item, in the items' order.
    """
    until = list(accumulate(children))
    return max(sum(count <= most for count in until), min(1, len(until)))


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
