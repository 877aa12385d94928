"""The last transactions of an attempt: hours of work are not lost to some seconds without the database."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

from sqlalchemy.orm import Session

from service.database.connections import Database
from service.domain import jobs
from worker.retry import RETRY_BUDGET_S, retry

log = logging.getLogger("mrasfm.worker")

T = TypeVar("T")


def commit_with_retry(
    database: Database, held: jobs.Claim, transaction: Callable[[Session], T], *, budget_s: float = RETRY_BUDGET_S
) -> T | None:
    """Write how an attempt ended, again where the database did not take it.

    It may be tried even when the lease has ended: the transaction itself sees whether the job is still this holder's.

    Returns
    -------
    T or None
        What the transaction returns. None where it was committed and the database's answer was lost.

    Raises
    ------
    FencedError
        Where the job is not this holder's any more.
    """
    tries = 0

    def write() -> T | None:
        nonlocal tries
        tries += 1
        try:
            with database.write() as session:
                return transaction(session)
        except jobs.FencedError:
            if tries == 1 or not _has_succeeded(database, held):
                raise
            log.info("the end was recorded already; only the database's answer was lost")
            return None

    return retry(write, budget_s=budget_s)


def _has_succeeded(database: Database, held: jobs.Claim) -> bool:
    with database.read() as session:
        return jobs.has_succeeded(session, held)
