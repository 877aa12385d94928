"""Statements that a database is given, to count them and to see what they read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sqlalchemy import event

from service.database.connections import Database


@contextmanager
def statements_of(database: Database) -> Iterator[list[str]]:
    """SQL of all statements that are executed meanwhile, in their order."""
    statements: list[str] = []

    def executed(connection: Any, cursor: Any, statement: str, *_: object) -> None:
        statements.append(statement)

    event.listen(database.engine, "after_cursor_execute", executed)
    try:
        yield statements
    finally:
        event.remove(database.engine, "after_cursor_execute", executed)
