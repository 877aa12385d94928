"""Keeps a claimed job alive in the system of record, and learns from there when it is to stop."""

from __future__ import annotations

import contextvars
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace

from sqlalchemy.exc import SQLAlchemyError

from service.database.connections import Database
from service.domain import jobs
from service.settings import Settings
from worker.retry import may_pass
from worker.termination import StopReason, StopRequest

log = logging.getLogger("mrasfm.worker")

_POLL_EVERY_S = 1.0  # progress that changes is reported this often, and a request to cancel is asked for
_SURE_SHARE = 0.8  # of the lease: after that without an answer, another worker may soon hold the job


class Heartbeat:
    """A thread that renews a job's lease for as long as it is in its `with` block.

    It beats apart from the attempt itself: fetching a large drive or publishing a large scene must not look like death.

    Parameters
    ----------
    progress
        Says how far the attempt is; called in the thread.
    shutting_down
        Whether the worker was told to stop.
    """

    def __init__(
        self,
        database: Database,
        held: jobs.Claim,
        settings: Settings,
        *,
        progress: Callable[[], jobs.ProgressNote],
        shutting_down: Callable[[], bool] = lambda: False,
    ) -> None:
        self._database = database
        self._held = held
        self._settings = settings
        self._progress = progress
        self._shutting_down = shutting_down
        self._reported = jobs.ProgressNote()
        self._cancel = False
        self._fenced = False
        self._ended = threading.Event()
        self._thread = threading.Thread(
            target=contextvars.copy_context().run, args=(self._run,), name="heartbeat", daemon=True
        )  # in our context: its log lines name the job too

    def __enter__(self) -> Heartbeat:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def check_stop(self) -> None:
        """Go on only where the job is still ours, nobody asked for its end, and the worker goes on; never waits.

        Raises
        ------
        StopRequest
            FENCED, CANCEL or SHUT_DOWN, in this order.
        """
        if self._fenced:
            raise StopRequest(StopReason.FENCED)
        if self._cancel:
            raise StopRequest(StopReason.CANCEL)
        if self._shutting_down():
            raise StopRequest(StopReason.SHUT_DOWN)

    def _run(self) -> None:
        try:
            self._beat_until_ended()
        finally:
            self._fenced = not self._ended.is_set()  # without a heartbeat, another worker will soon hold the job

    def _beat_until_ended(self) -> None:
        sure_until_s = time.monotonic() + _SURE_SHARE * self._settings.lease_seconds
        beat_s = time.monotonic()
        while not self._ended.wait(min(_POLL_EVERY_S, self._settings.heartbeat_seconds)):
            now_s = time.monotonic()
            news = self._news()
            try:
                if news is None and now_s - beat_s < self._settings.heartbeat_seconds:
                    self._poll()
                    continue
                self._beat(news)
            except jobs.FencedError:
                return
            except SQLAlchemyError as error:
                log.warning("the database did not take a heartbeat", exc_info=True)
                # Where it is away or locked, so it may be for all: nobody else takes the job then, and if somebody has,
                # this holder learns of it with its next heartbeat and publishes nothing.
                if not may_pass(error) and time.monotonic() > sure_until_s:
                    return
            else:
                beat_s, sure_until_s = now_s, now_s + _SURE_SHARE * self._settings.lease_seconds

    def _news(self) -> jobs.ProgressNote | None:
        """Progress to report; None where there is no more than a new guess at the time to the end."""
        note = self._progress()
        return None if replace(note, eta_low_s=None, eta_high_s=None) == self._reported else note

    def _poll(self) -> None:
        """See whether somebody asked for the job's end: that does not wait for the next heartbeat."""
        with self._database.read() as session:
            self._cancel = jobs.cancel_requested(session, self._held)

    def _beat(self, news: jobs.ProgressNote | None) -> None:
        lease_us = int(self._settings.lease_seconds * 1e6)
        with self._database.write() as session:
            self._cancel = jobs.heartbeat(session, self._held, lease_us=lease_us, note=news)
        if news is not None:
            self._reported = replace(news, eta_low_s=None, eta_high_s=None)
