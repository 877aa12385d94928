"""The Celery application of the workers."""

from __future__ import annotations

import logging
import mmap
import os
import time
from collections.abc import Callable
from typing import Any

from celery import Celery, signals
from celery.exceptions import Reject

from service.job_queue import TASK, celery_options
from service.logs import configure
from service.pdeathsig import end_with_parent
from service.settings import Settings
from worker.job_execution import Runner
from worker.lease import RenewLeases, ReportPresence, report_leaving

log = logging.getLogger("mrasfm.worker")

_FIRST_DELAY_S = 1.0  # before a message goes back where this process cannot work; doubles with each
_LONGEST_DELAY_S = 30.0
_POOL_START_S = 120.0  # a pool process first removes what others left behind; by default it would be killed after 4 s


class ShutdownFlag:
    """One byte that a worker's main process shares with its pool processes.

    Memory without a lock: an event with one would hang the main process for ever if a pool process were killed while
    it held the lock.
    """

    def __init__(self) -> None:
        self._byte = mmap.mmap(-1, 1)

    def set(self) -> None:
        """The worker was told to stop."""
        self._byte[0] = 1

    def is_set(self) -> bool:
        """Return whether the worker was told to stop."""
        return self._byte[0] == 1


class LazyRunner:
    """A pool process's runner: made as the process begins, and again with each message until it could be made.

    Celery logs what is raised as a pool process begins, and gives it work all the same.
    """

    def __init__(self, settings: Settings, shutting_down: Callable[[], bool]) -> None:
        self._settings = settings
        self._shutting_down = shutting_down
        self._runner: Runner | None = None
        self._failures = 0

    def prepare(self) -> bool:
        """Open database and store where that is still to do; whether they are open."""
        if self._runner is not None:
            return True
        try:
            runner = Runner(self._settings, shutting_down=self._shutting_down)
            runner.sweep_scratch()
        except Exception:  # whatever it is, it may pass
            log.exception("this worker cannot work: its database, artifact store or scratch folder is not to be had")
            self._failures += 1
            return False
        self._runner, self._failures = runner, 0
        return True

    def run(self, job_id: str) -> None:
        """Do a job; where this process cannot, give its message to whoever can."""
        if self.prepare():
            assert self._runner is not None
            self._runner.run(job_id)
            return
        end_s = time.monotonic() + min(_FIRST_DELAY_S * 2 ** min(self._failures - 1, 10), _LONGEST_DELAY_S)
        while time.monotonic() < end_s and not self._shutting_down():
            time.sleep(0.1)
        raise Reject("this worker cannot work", requeue=True)


def make_app(settings: Settings, *, log_level: str = "INFO") -> Celery:
    """The application that `mrasfm worker` runs; its pool processes are forked from it."""
    app = Celery("mrasfm", set_as_current=False)
    app.conf.update(celery_options(settings))
    app.conf.update(
        worker_hijack_root_logger=False,
        worker_redirect_stdouts=False,
        worker_send_task_events=False,
        worker_proc_alive_timeout=_POOL_START_S,
    )
    app.mrasfm_settings = settings  # type: ignore[attr-defined]
    app.steps["consumer"].add(RenewLeases)
    app.steps["consumer"].add(ReportPresence)
    flag = ShutdownFlag()
    main_pid = os.getpid()
    runner = LazyRunner(settings, flag.is_set)

    @signals.setup_logging.connect(weak=False)
    def _log(**_: Any) -> None:
        configure(log_level)
        logging.getLogger("celery.app.trace").setLevel("WARNING")

    @signals.worker_shutting_down.connect(weak=False)
    def _stop(**_: Any) -> None:
        flag.set()

    @signals.worker_shutdown.connect(weak=False)
    def _leave(sender: Any, **_: Any) -> None:
        report_leaving(settings, sender.hostname)

    @signals.worker_process_init.connect(weak=False)
    def _begin(**_: Any) -> None:
        end_with_parent(main_pid)  # and its stage with it
        runner.prepare()

    @app.task(name=TASK)
    def run_job(job_id: str) -> None:
        runner.run(job_id)

    return app
