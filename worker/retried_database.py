"""The transactions with which an attempt begins, again where the database is away: that is not the job's fault."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeVar

from sqlalchemy.orm import Session

from service.database.connections import Database
from worker.retry import retry
from worker.termination import CheckStop

T = TypeVar("T")


class RetriedDatabase:
    """Transactions that are tried again for some time, as `service.database.connections.Transactions`.

    Parameters
    ----------
    budget_s
        Of each transaction: after that, what the database said is raised.
    check_stop
        Called between two tries; what it raises ends the waiting.
    """

    def __init__(self, database: Database, *, budget_s: float, check_stop: CheckStop) -> None:
        self._database = database
        self._retry = partial(retry, budget_s=budget_s, check_stop=check_stop)

    def query(self, work: Callable[[Session], T]) -> T:
        """The result of `work`, which reads one state of the database."""
        return self._retry(lambda: self._database.query(work))

    def transact(self, work: Callable[[Session], T]) -> T:
        """The result of `work`, whose changes are made; it must take being repeated, as an answer may be lost."""
        return self._retry(lambda: self._database.transact(work))
