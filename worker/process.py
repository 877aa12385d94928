"""A child process in a group of its own, with pipes for its progress and its output."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Self

from worker.child_output import ChildOutput
from worker.progress_pipe import ProgressReader, StageReport

_PIECE_BYTES = 65536


class ChildProcess:
    """Runs from construction to `close`, which leaves nothing of its group alive.

    Parameters
    ----------
    command
        Makes the command from the descriptor, inherited by the child, that takes its progress.
    folder
        Where it runs.
    environment
        All of it: nothing is inherited.
    output
        Takes what the child prints.

    Notes
    -----
    Start it from a thread that lives as long as the child shall: on Linux a child that follows its parent follows the
    thread that made it.
    """

    def __init__(
        self,
        command: Callable[[int], Sequence[str]],
        *,
        folder: Path,
        environment: Mapping[str, str],
        output: ChildOutput,
    ) -> None:
        self._output = output
        self._reader = ProgressReader()
        self._progress, progress_in = os.pipe()
        try:
            self._process = subprocess.Popen(
                command(progress_in),
                cwd=folder,
                env=dict(environment),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                bufsize=0,
                pass_fds=(progress_in,),
                start_new_session=True,
            )
        except BaseException:
            os.close(self._progress)
            raise
        finally:
            os.close(progress_in)
        assert self._process.stdout is not None
        self._printed = self._process.stdout.fileno()
        self._open = {self._progress, self._printed}
        for descriptor in self._open:
            os.set_blocking(descriptor, False)

    @property
    def pid(self) -> int:
        """Id of the child, and of its process group."""
        return self._process.pid

    def pump(self, timeout_s: float) -> list[StageReport]:
        """Wait for output and take it in; the reports that came.

        Reads one piece from each pipe: a child that prints without end is held up and not followed.
        """
        poll = select.poll()
        for descriptor in self._open:
            poll.register(descriptor, select.POLLIN)
        if not self._open:
            time.sleep(timeout_s)  # it closed its pipes and lives on
        ready = [descriptor for descriptor, _ in poll.poll(timeout_s * 1000)] if self._open else []
        return [report for descriptor in ready for report in self._take(descriptor)]

    def _take(self, descriptor: int) -> list[StageReport]:
        try:
            data = os.read(descriptor, _PIECE_BYTES)
        except BlockingIOError:
            return []
        if not data:
            self._open.discard(descriptor)
        if descriptor == self._progress:
            return self._reader.feed(data)
        self._output.add(data)
        return []

    def has_exited(self) -> bool:
        """The child is a zombie. It stays one until `close`: so its group's id names no other processes."""
        try:
            return os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None
        except ChildProcessError:
            return True

    def send(self, number: signal.Signals) -> None:
        """Send a signal to the child's whole group."""
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, number)

    def close(self) -> tuple[int, list[StageReport]]:
        """Kill what is left of the group, and read what is left in the pipes.

        Returns
        -------
        returncode : int
            As in `subprocess`: negative for a signal.
        reports : list of StageReport
            That had not been pumped.
        """
        self.send(signal.SIGKILL)
        returncode = self._process.wait()
        reports: list[StageReport] = []
        # A pipe holds 64 kB; one that gives more is written to by a process that has left the group.
        for _ in range(4):
            reports += self.pump(0) if self._open else []
        for descriptor in (self._progress, self._printed):
            self._open.discard(descriptor)
        os.close(self._progress)
        assert self._process.stdout is not None
        self._process.stdout.close()
        return returncode, reports

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.returncode is None:
            self.close()
