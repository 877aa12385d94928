"""One attempt: the engine in a child process, watched from here."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from mrasfm_engine.config import EngineConfig
from schemas.artifacts import CHECKPOINT_FOLDER
from service.settings import Settings
from worker.child_output import ChildOutput
from worker.child_protocol import ChildRequest, ChildResult, Work
from worker.oom import kills_since, memory_kills
from worker.outcomes import Ending, Outcome, outcome_of
from worker.process import ChildProcess
from worker.progress import Progress, ProgressMeter
from worker.termination import StopReason, Termination

TICK_S = 0.25

# Of the environment a child gets what it runs with. The rest may hold the worker's secrets, and the child decodes
# images from outside.
_KEPT = frozenset(
    {"PATH", "HOME", "USER", "LANG", "TZ", "LD_LIBRARY_PATH", "VIRTUAL_ENV", "MRASFM_MODELS", "CUDA_VISIBLE_DEVICES"}
)
_KEPT_PREFIXES = ("LC_", "PYTHON", "NUMBA_", "PROJ_", "XDG_")
_THREADS = (
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"
)  # fmt: skip

Command = Callable[[int], Sequence[str]]


class StopRequest(StrEnum):
    """Request to stop an attempt under way."""

    GO_ON = "go on"
    CANCEL = "cancel"
    SHUT_DOWN = "shut down"
    FENCED = "fenced"


_STOPS = {
    StopRequest.CANCEL: StopReason.CANCEL,
    StopRequest.SHUT_DOWN: StopReason.SHUT_DOWN,
    StopRequest.FENCED: StopReason.FENCED,
}

Tick = Callable[[Progress], StopRequest]


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """Description of an attempt.

    Attributes
    ----------
    drive
        Folder with `drive.json` and the files it names; None for an aggregation.
    content_sha256
        SHA-256 of these files by name: what finished stages are found again by.
    settings
        As in the API's `ReconstructionSettings`.
    scenes, into, remove, failed, members, leave_out
        Of an aggregation, see ChildRequest.
    """

    work: Work
    settings: Mapping[str, Any]
    drive: Path | None = None
    content_sha256: Mapping[str, str] | None = None
    scenes: Mapping[str, Path] = field(default_factory=dict)
    into: Path | None = None
    remove: Sequence[str] = ()
    failed: Sequence[Mapping[str, Any]] = ()
    members: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    leave_out: bool = False


@dataclass(frozen=True)
class AttemptFolder:
    """The layout of an attempt's folder."""

    root: Path

    @property
    def out(self) -> Path:
        """The scene's folder."""
        return self.root / "scene"

    @property
    def finished_stages(self) -> Path:
        """Folder of finished stages, one `NAME.npz` each: put there before to be reused, taken from there after."""
        return self.out / CHECKPOINT_FOLDER

    @property
    def request(self) -> Path:
        """File with the child's request."""
        return self.root / "request.json"

    @property
    def result(self) -> Path:
        """File with the child's result."""
        return self.root / "result.json"

    @property
    def cancel(self) -> Path:
        """Asks it to stop."""
        return self.root / "cancel"

    @property
    def memory_kills(self) -> Path:
        """The kernel's count as the attempt began, see `MemoryKills`."""
        return self.root / "memory-kills.json"

    @property
    def output(self) -> Path:
        """File with the child's output."""
        return self.root / "child.log"


def run_attempt(attempt: Attempt, *, scratch: Path, tick: Tick, meter: ProgressMeter, settings: Settings) -> Outcome:
    """Run the engine in a child process until it ends or is stopped; nothing of it is left running.

    Parameters
    ----------
    scratch
        An existing folder of this attempt alone, see AttemptFolder.
    tick
        Called about four times a second with the progress; says whether to go on. What it raises ends the child and is
        passed on. While it does not return, neither timeout nor cancel are looked at.
    meter
        Counts the progress; of the attempt's kind of work.
    settings
        Of them: timeouts and threads.

    Raises
    ------
    OSError
        Where the child cannot be started or `scratch` cannot be written.
    """
    folder = AttemptFolder(scratch.resolve())
    threads = settings.engine_threads or EngineConfig().threads

    def command(progress_fd: int) -> Sequence[str]:
        ChildRequest(
            work=attempt.work,
            drive=None if attempt.drive is None else attempt.drive.resolve(),
            out=folder.out,
            settings=dict(attempt.settings),
            threads=threads,
            cancel_file=folder.cancel,
            result_file=folder.result,
            progress_fd=progress_fd,
            parent_pid=os.getpid(),
            scenes={name: scene.resolve() for name, scene in attempt.scenes.items()},
            into=None if attempt.into is None else attempt.into.resolve(),
            remove=list(attempt.remove),
            failed=[dict(drive) for drive in attempt.failed],
            members={name: dict(member) for name, member in attempt.members.items()},
            leave_out=attempt.leave_out,
        ).write(folder.request)
        # -P: the working directory holds files from outside and is no place to import from.
        return [sys.executable, "-P", "-m", "worker.child", str(folder.request)]

    return supervise(command, folder=folder, threads=threads, tick=tick, meter=meter, settings=settings)


def supervise(
    command: Command, *, folder: AttemptFolder, threads: int, tick: Tick, meter: ProgressMeter, settings: Settings
) -> Outcome:
    """Run a command that behaves as `worker.child` does; see `run_attempt`."""
    for stale in (folder.result, folder.cancel, folder.output):
        stale.unlink(missing_ok=True)
    output = ChildOutput(folder.output)
    kills_before = memory_kills()
    with ChildProcess(
        command, folder=folder.root, environment=_environment(threads, folder.root), output=output
    ) as child:
        termination = Termination(child.send, folder.cancel, settings)
        _watch(child, termination, tick=tick, meter=meter, timeout_s=settings.job_timeout_seconds)
        returncode, reports = child.close()
    for report in reports:
        meter.update(*report)
    return outcome_of(
        Ending(
            returncode=returncode,
            stopped_for=termination.reason,
            result=ChildResult.read(folder.result),
            stage=meter.stage,
            log_tail=output.tail(),
            memory_kills=kills_since(kills_before),
            out=folder.out,
            timeout_s=settings.job_timeout_seconds,
        )
    )


def _watch(
    child: ChildProcess, termination: Termination, *, tick: Tick, meter: ProgressMeter, timeout_s: float
) -> None:
    """Follow the child until it has ended, and stop it where somebody or the time asks for it."""
    parent = os.getppid()
    now_s = time.monotonic()
    ends_s, tick_s = now_s + timeout_s, now_s
    while not child.has_exited():
        for report in child.pump(max(0.0, min(TICK_S, tick_s - now_s))):
            meter.update(*report)
        now_s = time.monotonic()
        if now_s >= tick_s:
            tick_s = now_s + TICK_S
            verdict = tick(meter.at(now_s))
            now_s = time.monotonic()
            if verdict is not StopRequest.GO_ON:
                termination.stop(_STOPS[verdict], now_s)
            if os.getppid() != parent:
                termination.stop(StopReason.ORPHANED, now_s)
            if now_s >= ends_s:
                termination.stop(StopReason.TIMEOUT, now_s)
        termination.advance(now_s)


def _environment(threads: int, scratch: Path) -> dict[str, str]:
    kept = {name: value for name, value in os.environ.items() if name in _KEPT or name.startswith(_KEPT_PREFIXES)}
    return {**kept, "TMPDIR": str(scratch), **dict.fromkeys(_THREADS, str(threads))}
