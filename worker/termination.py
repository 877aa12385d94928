"""Requests to stop an attempt, and the steps by which its child is stopped: first by asking, then by signals."""

from __future__ import annotations

import signal
from collections.abc import Callable
from contextlib import suppress
from enum import IntEnum
from functools import partial
from pathlib import Path

from service.settings import Settings

SHUT_DOWN_GRACE_S = 3.0


class StopReason(IntEnum):
    """Reason to stop an attempt. A higher one takes the place of a lower one."""

    CANCEL = 1
    TIMEOUT = 2
    SHUT_DOWN = 3  # this worker ends; another one goes on
    FENCED = 4  # another worker has the job already
    ORPHANED = 5  # who started this supervisor is gone


class StopRequest(Exception):
    """The attempt is not to go on. A child is terminated for it; a step of the worker's own ends by raising it."""

    def __init__(self, reason: StopReason) -> None:
        super().__init__(reason)
        self.reason = reason


CheckStop = Callable[[], None]
"""Raises StopRequest where the attempt is not to go on; never waits."""

_GRACEFUL = (StopReason.CANCEL, StopReason.TIMEOUT)


class Termination:
    """The steps by which a child is stopped, each in its time.

    Parameters
    ----------
    send
        Sends a signal to the child's group.
    cancel_file
        Asks the child to end its work.
    """

    def __init__(self, send: Callable[[signal.Signals], None], cancel_file: Path, settings: Settings) -> None:
        self.reason: StopReason | None = None
        self._send = send
        self._cancel_file = cancel_file
        self._settings = settings
        self._steps: list[tuple[float, Callable[[], None]]] = []

    def stop(self, reason: StopReason, now_s: float) -> None:
        """Begin to stop the child, if it is not being stopped for at least as good a reason."""
        if self.reason is not None and (reason <= self.reason or reason in _GRACEFUL):
            return
        self.reason = reason
        self._steps = sorted(((now_s + after_s, step) for after_s, step in self._plan(reason)), key=lambda s: s[0])

    def advance(self, now_s: float) -> None:
        """Do the steps that are due."""
        while self._steps and self._steps[0][0] <= now_s:
            self._steps.pop(0)[1]()

    def _plan(self, reason: StopReason) -> list[tuple[float, Callable[[], None]]]:
        terminate, kill = partial(self._send, signal.SIGTERM), partial(self._send, signal.SIGKILL)
        if reason in _GRACEFUL:
            times_s = self._settings.terminate_after_seconds, self._settings.kill_after_seconds
            return [(0.0, self._ask), (times_s[0], terminate), (times_s[1], kill)]
        return [(0.0, self._ask), (SHUT_DOWN_GRACE_S, kill)] if reason is StopReason.SHUT_DOWN else [(0.0, kill)]

    def _ask(self) -> None:
        with suppress(OSError):  # a full disk: the signals follow
            self._cancel_file.touch()
