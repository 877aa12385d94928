"""Holds of idempotency keys: a request under way owns its key for as long as its process lives."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from sqlalchemy import ColumnElement, update
from sqlalchemy.exc import SQLAlchemyError

from service.database.connections import Database, clock_us
from service.database.tables import IdempotencyKey

log = logging.getLogger("mrasfm.api")

# A hold outlives its process by less than ten seconds. Three renewals may fail or come late before a live one loses it.
HELD_FOR_S = 8.0
RENEW_EVERY_S = 2.0


@dataclass(frozen=True)
class Hold:
    """One request's claim to a key; `holder` is an id of its own."""

    project_id: str
    key: str
    holder: str

    def is_mine(self) -> ColumnElement[bool]:
        """Return whether a row of the table is held by this request."""
        return (
            (IdempotencyKey.project_id == self.project_id)
            & (IdempotencyKey.key == self.key)
            & (IdempotencyKey.holder == self.holder)
        )


class HoldKeeper:
    """A thread that renews the holds of this process's requests.

    The event loop would not do: while it is busy the process lives, and while it is idle a request's own thread may
    wait for minutes. The thread begins with the first hold, so that it exists in the process that serves.

    Parameters
    ----------
    held_for_s
        How long a hold lasts from its beginning and from each renewal.
    renew_every_s
        Requests that take less cost no renewal.
    """

    def __init__(
        self, database: Database, *, held_for_s: float = HELD_FOR_S, renew_every_s: float = RENEW_EVERY_S
    ) -> None:
        self.held_for_us = int(held_for_s * 1e6)
        self._database = database
        self._renew_every_s = renew_every_s
        self._holds: set[Hold] = set()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._closed = threading.Event()

    @contextmanager
    def renewed(self, hold: Hold) -> Iterator[None]:
        """Renew a hold until the block ends."""
        with self._lock:
            self._holds.add(hold)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="request-holds", daemon=True)
                self._thread.start()
        try:
            yield
        finally:
            with self._lock:
                self._holds.discard(hold)

    def close(self) -> None:
        """End the thread; holds that remain end by themselves."""
        self._closed.set()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        renewable: set[Hold] = set()
        while not self._closed.wait(self._renew_every_s):
            with self._lock:
                current = set(self._holds)
            for hold in renewable & current:
                self._renew(hold)
            renewable = current

    def _renew(self, hold: Hold) -> None:
        """Renew a hold that is still this request's; one that another request took over stays lost."""
        try:
            with self._database.write(durable=False) as session:
                until_us = clock_us(session) + self.held_for_us
                open_hold = hold.is_mine() & IdempotencyKey.status.is_(None)
                session.execute(update(IdempotencyKey).where(open_hold).values(held_until_us=until_us))
        except SQLAlchemyError:
            log.warning("the hold of an idempotency key was not renewed", exc_info=True)
