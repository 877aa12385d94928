"""Runs a set of child processes as one program: starts them in order, restarts them, and leaves none behind.

Single-threaded on purpose: every child is forked by the main thread, so that code may run between fork and exec
(`preexec_fn`), and the kernel's parent-death signal, which is tied to the forking *thread*, means this process.
"""

from __future__ import annotations

import errno
import math
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import FrameType

from service.pdeathsig import end_with_parent
from service.standalone import orphan_reaper
from service.standalone.child_log import ChildLog
from service.standalone.liveness_probe import Pulse
from service.storage.data_folder import make_private_folder

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
FIRST_DELAY_S = 0.5  # before a restart; doubles with each failure
LONGEST_DELAY_S = 10.0
STABLE_AFTER_S = 60.0  # a child that lived this long starts again without waiting longer than the first time
PROVEN_AFTER_S = 10.0  # a child without a probe has proven by then that it can start
MAX_FAILED_STARTS = 3  # of a child that has never proven so; then it is not a crash but something to correct
PROBE_INTERVAL_S = 0.2
MAX_SILENT = 4  # questions in a row; a machine that was suspended or is very busy leaves one or two unanswered
LOG_CHECK_INTERVAL_S = 60.0


class SupervisorError(Exception):
    """The children cannot run as they should; all are stopped. The message says why and what to do."""


@dataclass(frozen=True, kw_only=True)
class ChildSpec:
    """One program to keep running."""

    name: str  # of its log file, and in messages
    argv: Sequence[str]
    environment: Mapping[str, str] = field(default_factory=dict, repr=False)  # added to ours; may hold secrets
    depends_on: Sequence[str] = ()  # children that are ready before it starts, and end after it
    is_ready: Callable[[], bool] | None = None  # quick; without it, a child is ready when it runs
    # Given the last lines of a life that ended in an error before it was ready: what it put right, if anything.
    repair: Callable[[Sequence[str]], str | None] | None = None
    ask: Callable[[], Pulse] | None = None  # whether it lives, once it has been ready
    ask_every_s: float = 15.0
    answer_within_s: float = 5.0
    listens_on: tuple[str, int] | None = None  # checked to be free before anything starts
    port_remedy: str = "Stop the other program."  # where it is not
    start_timeout_s: float = 120.0
    grace_s: float = 10.0  # from SIGTERM to SIGKILL


class Supervisor:
    """Keeps children running until a signal says stop.

    Each child has a session of its own, so that Ctrl-C in the terminal reaches the supervisor alone. SIGINT, SIGTERM
    and SIGHUP stop the children in reverse order of dependence; a second one kills them at once. If the supervisor
    itself is killed, the kernel (Linux) and a guard process (everywhere, and for the children's own children) kill
    them.

    Parameters
    ----------
    specs
        In the order of starting, dependencies first.
    log_folder
        Where `NAME.log` of every child goes.
    say
        Takes a line for the person at the terminal.
    on_ready
        Called once, when all are ready for the first time.
    kept_descriptors
        Descriptors that every child inherits.
    """

    def __init__(
        self,
        specs: Sequence[ChildSpec],
        *,
        log_folder: Path,
        say: Callable[[str], None],
        on_ready: Callable[[], None],
        kept_descriptors: Sequence[int] = (),
    ) -> None:
        self._log_folder = log_folder
        self._say = say
        self._on_ready = on_ready
        self._guard = _Guard(kept_descriptors)
        self._children = {
            spec.name: _Child(spec, ChildLog(log_folder / f"{spec.name}.log"), self._guard, kept_descriptors)
            for spec in specs
        }
        self._announced = False
        self._stops_asked = 0
        self._next_log_check_s = 0.0

    def run(self) -> None:
        """Run until a stop signal.

        Raises
        ------
        SupervisorError
            Where a child cannot be started. Everything is stopped by then.
        """
        make_private_folder(self._log_folder)
        for child in self._children.values():
            _require_free_port(child.spec)
        with _waking_signals(self._ask_stop) as wakeup:
            try:
                self._keep_running(wakeup)
            finally:
                self._stop_all(wakeup)
                self._guard.close()

    def _ask_stop(self) -> None:
        self._stops_asked += 1

    def _keep_running(self, wakeup: int) -> None:
        while not self._stops_asked:
            for child in self._children.values():
                self._attend(child)
            if not self._announced and all(child.ready for child in self._children.values()):
                self._announced = True
                self._on_ready()
            self._bound_logs()
            self._guard.keep_alive()
            _sleep(wakeup, self._next_event_s())

    def _attend(self, child: _Child) -> None:
        if child.process is None:
            if self._may_start(child) and time.monotonic() >= child.start_at_s:
                self._start(child)
        elif child.process.poll() is not None:
            self._after_death(child)
        elif not (child.ready and child.proven):
            child.probe()
        elif child.spec.ask is not None and not child.is_alive(child.spec.ask):
            self._say(f"{child.spec.name} runs but has not answered {MAX_SILENT} times, and is killed")
            child.kill()

    def _may_start(self, child: _Child) -> bool:
        return all(self._children[name].was_ready for name in child.spec.depends_on)

    def _start(self, child: _Child) -> None:
        try:
            child.start()
        except (OSError, subprocess.SubprocessError) as error:
            why = f"{child.spec.argv[0]}: {error.strerror if isinstance(error, OSError) else error}"
            if not child.proven:
                raise SupervisorError(f"{child.spec.name} cannot start: {why}") from error
            child.note_failure()  # it could before: the machine is short of something, or a new version is put in place
            self._say(f"{child.spec.name} cannot start: {why}; trying again in {child.delay_s:g} s")

    def _after_death(self, child: _Child) -> None:
        was_ready = child.ready
        ending = child.collect()
        lines = child.log.tail()
        if child.spec.repair is not None and not was_ready and child.failed:
            repaired = child.spec.repair(lines)
            if repaired is not None:
                self._say(f"{child.spec.name} {ending} at its start; {repaired}")
                return
        tail = "".join(f"\n  {child.spec.name} | {line}" for line in lines)
        if child.gave_up:
            raise SupervisorError(
                f"{child.spec.name} cannot start: it {ending}, {child.failures} times. "
                f"Its last lines say why; all of them are in {child.log.path}.{tail}"
            )
        self._say(
            f"{child.spec.name} {ending}; starting it again in {child.delay_s:g} s. "
            f"Its last lines, all in {child.log.path}:{tail}"
        )

    def _bound_logs(self) -> None:
        if time.monotonic() >= self._next_log_check_s:
            self._next_log_check_s = time.monotonic() + LOG_CHECK_INTERVAL_S
            for child in self._children.values():
                child.log.rotate_if_large()

    def _next_event_s(self) -> float:
        """Seconds until something is to be done that no signal announces."""
        running = [child for child in self._children.values() if child.process is not None]
        if not all(child.ready and child.proven for child in running):
            return PROBE_INTERVAL_S
        waiting = [child for child in self._children.values() if child.process is None and self._may_start(child)]
        events = [self._next_log_check_s, self._guard.start_at_s]
        events += [child.start_at_s for child in waiting]
        events += [child.ask_at_s for child in running if child.spec.ask is not None]
        return max(0.0, min(events) - time.monotonic())

    def _stop_all(self, wakeup: int) -> None:
        while running := [child for child in self._children.values() if child.process is not None]:
            for child in running:
                if child.process is not None and child.process.poll() is not None:
                    child.collect()
                elif self._stops_asked > 1:
                    child.kill()
                elif not any(child.spec.name in other.spec.depends_on for other in running):
                    self._stop_in_order(child)
            _sleep(wakeup, PROBE_INTERVAL_S)

    def _stop_in_order(self, child: _Child) -> None:
        if child.kill_at_s is None:
            child.terminate()
        elif time.monotonic() > child.kill_at_s:
            self._say(f"{child.spec.name} did not end within {child.spec.grace_s:g} s and is killed")
            child.kill()


class _Child:
    """A child over all of its lives."""

    def __init__(self, spec: ChildSpec, log: ChildLog, guard: _Guard, kept_descriptors: Sequence[int]) -> None:
        self.spec = spec
        self.log = log
        self.process: subprocess.Popen[bytes] | None = None
        self.ready = False  # in this life
        self.proven = False  # that it can start; without a probe, by having run for a while
        self.failures = 0  # one after the other
        self.delay_s = 0.0
        self.start_at_s = 0.0
        self.kill_at_s: float | None = None
        self.failed = False  # its latest life ended in an error, and by itself
        self.ask_at_s = 0.0  # or look for the answer
        self._asked: Pulse | None = None
        self._silent = 0  # questions in a row
        self._started_at_s = 0.0
        self._guard = guard
        self._kept_descriptors = tuple(kept_descriptors)

    @property
    def was_ready(self) -> bool:
        return self.ready or self.proven

    @property
    def gave_up(self) -> bool:
        return not self.proven and self.failures >= MAX_FAILED_STARTS

    def start(self) -> None:
        """Begin a life.

        Raises
        ------
        OSError, subprocess.SubprocessError
            Where no process can be made, or not of this program.
        """
        self._started_at_s = time.monotonic()
        output = self.log.open_for_child()
        try:
            self.process = subprocess.Popen(
                self.spec.argv,
                env={**os.environ, **self.spec.environment},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                pass_fds=self._kept_descriptors,
                preexec_fn=partial(end_with_parent, os.getpid()),  # single-threaded: see the module
            )
        finally:
            os.close(output)
        self.ready = self.spec.is_ready is None
        self._guard.watch(self.process.pid)

    def probe(self) -> None:
        """See whether it is ready by now."""
        age_s = time.monotonic() - self._started_at_s
        if self.spec.is_ready is None:
            self.proven = age_s >= PROVEN_AFTER_S
            return
        self.ready = self.spec.is_ready()
        self.proven = self.proven or self.ready
        if not self.proven and age_s > self.spec.start_timeout_s:
            raise SupervisorError(
                f"{self.spec.name} runs but is not ready after {self.spec.start_timeout_s:g} s. "
                f"What it is doing is in {self.log.path}."
            )

    def is_alive(self, ask: Callable[[], Pulse]) -> bool:
        """Ask now and then whether it lives; False once it has left too many questions unanswered."""
        now_s = time.monotonic()
        if now_s < self.ask_at_s:
            return True
        if self._asked is None:
            self._asked = ask()
            self.ask_at_s = now_s + self.spec.answer_within_s
            return True
        answered, self._asked = self._asked.end(), None
        self._silent = 0 if answered else self._silent + 1
        self.ask_at_s = now_s + self.spec.ask_every_s - self.spec.answer_within_s
        return self._silent < MAX_SILENT

    def note_failure(self) -> None:
        """Decide when it starts again."""
        lived_s = time.monotonic() - self._started_at_s
        self.failures = 1 if lived_s >= STABLE_AFTER_S else self.failures + 1
        self.delay_s = min(FIRST_DELAY_S * 2 ** min(self.failures - 1, 10), LONGEST_DELAY_S)
        self.start_at_s = time.monotonic() + self.delay_s

    def collect(self) -> str:
        """Clean up after its death, decide when it starts again, and tell how it ended."""
        assert self.process is not None
        self.kill()  # what it started and left
        self._guard.forget(self.process.pid)
        self.note_failure()
        ending = _exit_text(self.process.returncode)
        self.failed = self.process.returncode > 0
        self.process, self.ready = None, False
        if self._asked is not None:
            self._asked.end()
        self._asked, self._silent, self.ask_at_s = None, 0, 0.0
        return ending

    def terminate(self) -> None:
        assert self.process is not None
        self.kill_at_s = time.monotonic() + self.spec.grace_s
        self.process.terminate()

    def kill(self) -> None:
        assert self.process is not None
        with suppress(ProcessLookupError, PermissionError):  # gone already; macOS says EPERM for a dead group
            os.killpg(self.process.pid, signal.SIGKILL)


class _Guard:
    """The process of `orphan_reaper`, started again with what it has to know should it die."""

    def __init__(self, kept_descriptors: Sequence[int]) -> None:
        self._kept_descriptors = tuple(kept_descriptors)
        self._groups: set[int] = set()
        self._process: subprocess.Popen[bytes] | None = None
        self.start_at_s = math.inf  # where it could not be started

    def watch(self, group: int) -> None:
        self._groups.add(group)
        self.keep_alive()
        self._tell(f"+{group}\n")

    def forget(self, group: int) -> None:
        self._groups.discard(group)
        self._tell(f"-{group}\n")

    def keep_alive(self) -> None:
        if self._process is not None and self._process.poll() is None:
            return
        self._release()
        self._process, self.start_at_s = None, math.inf
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-S", orphan_reaper.__file__, *map(str, self._groups)],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
                pass_fds=self._kept_descriptors,
                bufsize=0,
            )
        except OSError:  # the machine is short of something; until it is there, the kernel alone watches over us
            self.start_at_s = time.monotonic() + FIRST_DELAY_S

    def close(self) -> None:
        """Release the reaper; it kills what is still in its list, which after an orderly stop is nothing."""
        if self._process is not None:
            self._release()
            self._process.wait()

    def _tell(self, line: str) -> None:
        if self._process is not None and self._process.stdin is not None:
            with suppress(BrokenPipeError):  # died; keep_alive starts another
                self._process.stdin.write(line.encode())

    def _release(self) -> None:
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()


def _require_free_port(spec: ChildSpec) -> None:
    if spec.listens_on is None:
        return
    host, port = spec.listens_on
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with closing(socket.socket(family, socket.SOCK_STREAM)) as listener:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
    except OSError as error:
        why = "is in use by another program" if error.errno == errno.EADDRINUSE else f"cannot be had ({error})"
        raise SupervisorError(f"{spec.name} cannot start: port {port} on {host} {why}. {spec.port_remedy}") from error


@contextmanager
def _waking_signals(ask_stop: Callable[[], None]) -> Iterator[int]:
    """Handle stop signals and the end of children; yields the descriptor that becomes readable with each."""

    def stop(number: int, frame: FrameType | None) -> None:
        ask_stop()

    def note(number: int, frame: FrameType | None) -> None:
        """Do nothing: it counts that the signal came."""

    reading, writing = os.pipe()
    for descriptor in (reading, writing):
        os.set_blocking(descriptor, False)
    earlier_wakeup = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    earlier = {number: signal.signal(number, stop) for number in STOP_SIGNALS}
    earlier[signal.SIGCHLD] = signal.signal(signal.SIGCHLD, note)
    try:
        yield reading
    finally:
        for number, handler in earlier.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(earlier_wakeup)
        os.close(reading)
        os.close(writing)


def _sleep(wakeup: int, timeout_s: float) -> None:
    """Sleep until a signal comes, at most so long."""
    readable, _, _ = select.select([wakeup], [], [], timeout_s)
    if readable:
        with suppress(BlockingIOError):
            os.read(wakeup, 4096)


def _exit_text(returncode: int) -> str:
    if returncode >= 0:
        return f"ended with exit code {returncode}"
    try:
        return f"was ended by {signal.Signals(-returncode).name}"
    except ValueError:
        return f"was ended by signal {-returncode}"
