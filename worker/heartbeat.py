"""Keeps a claimed job alive in the system of record, and learns from there when it is to stop."""

from __future__ import annotations

import contextvars
import logging
import threading
import time
from dataclasses import replace
from types import TracebackType

from sqlalchemy.exc import SQLAlchemyError

from schemas.artifacts import Stage
from service.database.connections import Database
from service.domain import jobs
from service.settings import Settings
from worker.attempt import StopRequest
from worker.progress import Progress
from worker.retry import may_pass

log = logging.getLogger("mrasfm.worker")

_LOOK_EVERY_S = 1.0  # progress that changes is told this often, and so is a request to cancel looked for
_SURE_SHARE = 0.8  # of the lease: after that without an answer, another worker may soon hold the job


class Heartbeat:
    """A thread that renews a job's lease for as long as it is in its `with` block.

    It beats apart from the attempt itself: fetching a large drive or publishing a large scene must not look like death.
    """

    def __init__(self, database: Database, held: jobs.Claim, settings: Settings) -> None:
        self._database = database
        self._held = held
        self._settings = settings
        self._progress = Progress()
        self._told = Progress()
        self._cancel = False
        self._fenced = False
        self._ended = threading.Event()
        self._thread = threading.Thread(
            target=contextvars.copy_context().run, args=(self._run,), name="heartbeat", daemon=True
        )  # in our context: its log lines name the job too

    def __enter__(self) -> Heartbeat:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()

    def tell(self, progress: Progress) -> StopRequest:
        """Say how far the attempt is; never waits.

        Returns
        -------
        StopRequest
            FENCED where the job is not ours any more, CANCEL where somebody asked for its end, else GO_ON.
        """
        self._progress = progress
        if self._fenced:
            return StopRequest.FENCED
        return StopRequest.CANCEL if self._cancel else StopRequest.GO_ON

    def _run(self) -> None:
        try:
            self._beat_until_ended()
        finally:
            self._fenced = not self._ended.is_set()  # without a heartbeat, another worker will soon hold the job

    def _beat_until_ended(self) -> None:
        sure_until_s = time.monotonic() + _SURE_SHARE * self._settings.lease_seconds
        beat_s = time.monotonic()
        while not self._ended.wait(min(_LOOK_EVERY_S, self._settings.heartbeat_seconds)):
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

    def _news(self) -> Progress | None:
        """Progress to tell; None where there is no more than a new guess at the time to the end."""
        progress = self._progress
        return None if replace(progress, eta_s=None) == replace(self._told, eta_s=None) else progress

    def _poll(self) -> None:
        """See whether somebody asked for the job's end: that does not wait for the next heartbeat."""
        with self._database.read() as session:
            self._cancel = jobs.cancel_requested(session, self._held)

    def _beat(self, news: Progress | None) -> None:
        lease_us = int(self._settings.lease_seconds * 1e6)
        with self._database.write() as session:
            self._cancel = jobs.heartbeat(session, self._held, lease_us=lease_us, note=_note(news))
        if news is not None:
            self._told = news


def _note(progress: Progress | None) -> jobs.ProgressNote | None:
    if progress is None:
        return None
    low_s, high_s = progress.eta_s or (None, None)
    return jobs.ProgressNote(
        stage=progress.stage,
        done=progress.done,
        total=progress.total,
        unit=progress.unit,
        percent=round(progress.percent, 2),
        eta_low_s=None if low_s is None else round(low_s, 1),
        eta_high_s=None if high_s is None else round(high_s, 1),
        reused=progress.reused,
        engine_ran=progress.stage not in ("", Stage.FETCH),
    )
