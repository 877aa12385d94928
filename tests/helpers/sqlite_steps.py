"""Counting the work of SQLite, which grows with the rows that a statement reads."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from sqlalchemy import event

from service.database.connections import Database

_AT_ONCE = 20


@dataclass
class Steps:
    """Instructions of SQLite's virtual machine, to within some dozens a statement."""

    count: int = 0

    def add(self) -> int:
        self.count += _AT_ONCE
        return 0  # else the statement would be interrupted


@contextmanager
def sqlite_steps(database: Database) -> Iterator[Steps]:
    """Count the steps of all statements on connections that are taken from the pool meanwhile."""
    steps = Steps()

    def taken(connection: sqlite3.Connection, *given: Any) -> None:
        connection.set_progress_handler(steps.add, _AT_ONCE)

    def returned(connection: sqlite3.Connection | None, *given: Any) -> None:
        if connection is not None:
            connection.set_progress_handler(None, 0)

    event.listen(database.engine, "checkout", taken)
    event.listen(database.engine, "checkin", returned)
    try:
        yield steps
    finally:
        event.remove(database.engine, "checkout", taken)
        event.remove(database.engine, "checkin", returned)
