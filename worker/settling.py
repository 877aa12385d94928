"""The last transactions of an attempt: hours of work are not lost to some seconds without the database."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import TypeVar

from sqlalchemy.exc import DBAPIError, InterfaceError, OperationalError
from sqlalchemy.orm import Session

from service.persistence import jobs
from service.persistence.database import Database

log = logging.getLogger("mrasfm.worker")

PATIENCE_S = 120.0

_FIRST_PAUSE_S = 0.2
_LONGEST_PAUSE_S = 5.0

T = TypeVar("T")


def settle(
    database: Database, held: jobs.Claim, transaction: Callable[[Session], T], *, patience_s: float = PATIENCE_S
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

    return patiently(write, patience_s=patience_s)


def patiently(step: Callable[[], T], *, patience_s: float = PATIENCE_S) -> T:
    """Do something that may be done again, until the database takes it or `patience_s` have passed."""
    end_s = time.monotonic() + patience_s
    pause_s = _FIRST_PAUSE_S
    while True:
        try:
            return step()
        except DBAPIError as error:
            if not _may_pass(error) or time.monotonic() + pause_s > end_s:
                raise
            log.warning("the database did not take the end of an attempt", exc_info=True)
        time.sleep(pause_s)
        pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)


def _may_pass(error: DBAPIError) -> bool:
    """Whether the connection, a lock or the server is at fault, and not the statement."""
    return error.connection_invalidated or isinstance(error, (OperationalError, InterfaceError))


def _has_succeeded(database: Database, held: jobs.Claim) -> bool:
    with database.read() as session:
        return jobs.has_succeeded(session, held)
