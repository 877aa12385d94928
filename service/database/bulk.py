"""Many rows in one statement: the databases take a JSON text apart much faster than parameters, row by row."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from typing import Any

from sqlalchemy import String, Subquery, bindparam, column, text
from sqlalchemy.orm import Session

_BATCH = 10_000  # rows; their text is some megabyte
_UNPACK = {
    "sqlite": ("json_extract(value, '$[{}]')", "json_each(:rows)"),
    "postgresql": ("value->>{}", "json_array_elements(CAST(:rows AS json))"),
}


def given(session: Session, *names: str) -> Subquery:
    """The rows of a batch as a table with these columns, all of them text; the batch is the parameter `rows`."""
    value, rows = _UNPACK[session.get_bind().dialect.name]
    values = ", ".join(f"{value.format(i)} AS {name}" for i, name in enumerate(names))
    statement = text(f"SELECT {values} FROM {rows}").bindparams(bindparam("rows", type_=String))
    return statement.columns(*(column(name, String) for name in names)).subquery("given")


def batches(rows: Iterable[Sequence[Any]]) -> Iterator[str]:
    """The rows in batches, each of them the parameter `rows` of a statement with `given`."""
    left = iter(rows)
    while batch := list(islice(left, _BATCH)):
        yield json.dumps(batch)
