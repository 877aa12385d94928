"""Waiting for what is away: seconds without the database, the artifact store or a free disk fail no attempt."""

from __future__ import annotations

import contextvars
import errno
import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import TypeVar

from obstore import exceptions as store
from sqlalchemy.exc import DBAPIError, InterfaceError, OperationalError

from worker.termination import CheckStop

log = logging.getLogger("mrasfm.worker")

RETRY_BUDGET_S = 120.0

_FIRST_PAUSE_S = 0.2
_LONGEST_PAUSE_S = 5.0
_CHECK_EVERY_S = 0.25
_ENDS_WITHIN_S = 2.0  # a step that is not wanted any more and does not hang

# Of disks that are full or shared, and of networks.
_PASSING = frozenset(
    {
        *(errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.ESTALE, errno.EAGAIN, errno.EBUSY, errno.EINTR, errno.ENOMEM),
        *(errno.EMFILE, errno.ENFILE, errno.EHOSTDOWN, errno.EHOSTUNREACH, errno.ENETDOWN, errno.ENETUNREACH),
        *(errno.ENETRESET, errno.ENOTCONN, errno.ETIMEDOUT),
    }
)
# Said by a store that is there.
_FINAL = (
    store.NotFoundError,
    store.InvalidPathError,
    store.NotSupportedError,
    store.AlreadyExistsError,
    store.PreconditionError,
    store.PermissionDeniedError,
    store.UnauthenticatedError,
    store.UnknownConfigurationKeyError,
)

T = TypeVar("T")


def retry(step: Callable[[], T], *, budget_s: float = RETRY_BUDGET_S, check_stop: CheckStop = lambda: None) -> T:
    """Do something that may be done again, until it is taken or `budget_s` have passed.

    Parameters
    ----------
    check_stop
        Called before each try, and several times a second between two; what it raises ends the waiting.
    """
    end_s = time.monotonic() + budget_s
    pause_s = _FIRST_PAUSE_S
    while True:
        check_stop()
        try:
            return step()
        except Exception as error:
            if not may_pass(error) or time.monotonic() + pause_s > end_s:
                raise
            log.warning("what a step needs is away; it is tried again", exc_info=True)
        again_s = time.monotonic() + pause_s
        while (left_s := again_s - time.monotonic()) > 0:
            check_stop()
            time.sleep(min(left_s, _CHECK_EVERY_S))
        pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)


def may_pass(error: Exception) -> bool:
    """True where a connection, a lock, a server or a full disk is at fault, and not what was asked of it."""
    if isinstance(error, DBAPIError):
        return error.connection_invalidated or isinstance(error, (OperationalError, InterfaceError))
    if isinstance(error, OSError):
        return isinstance(error, (ConnectionError, TimeoutError)) or error.errno in _PASSING
    return isinstance(error, store.BaseError) and not isinstance(error, _FINAL)


def watched(step: Callable[[], T], check_stop: CheckStop) -> T:
    """Do something that may hang, and check meanwhile whether it is still wanted.

    What `check_stop` raises is passed on. The step is left to itself then: it checks too where it can, and
    else ends with what it hangs on, or with the process.
    """
    future: Future[T] = Future()

    def run() -> None:
        try:
            future.set_result(step())
        except BaseException as error:
            future.set_exception(error)

    thread = threading.Thread(target=contextvars.copy_context().run, args=(run,), name="watched", daemon=True)
    thread.start()
    try:
        while not wait([future], _CHECK_EVERY_S).done:
            check_stop()
    except BaseException:
        thread.join(_ENDS_WITHIN_S)
        raise
    return future.result()
