"""One attempt: the engine in a child process, watched from here."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from mrasfm_engine.config import EngineConfig
from schemas.artifacts import CHECKPOINT_FOLDER
from service.settings import Settings
from worker.child_output import ChildOutput
from worker.child_protocol import Attempt, ChildRequest, ChildResult
from worker.oom import kills_since, memory_kills
from worker.outcomes import Ending, Outcome, outcome_of
from worker.process import ChildProcess
from worker.progress import ProgressMeter
from worker.termination import CheckStop, StopReason, StopRequest, Termination

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


class AttemptFolder:
    """The layout of an attempt's folder.

    Attributes
    ----------
    out
        The scene's folder.
    finished_stages
        Folder of finished stages, one `NAME.npz` each: put there before to be reused, taken from there after.
    request, result
        The child's ChildRequest and ChildResult.
    cancel
        Asks the child to stop.
    memory_kills
        The kernel's count as the attempt began, see `MemoryKills`.
    output
        The child's standard output.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.out = root / "scene"
        self.finished_stages = self.out / CHECKPOINT_FOLDER
        self.request = root / "request.json"
        self.result = root / "result.json"
        self.cancel = root / "cancel"
        self.memory_kills = root / "memory-kills.json"
        self.output = root / "child.log"


def run_attempt(
    attempt: Attempt, *, scratch: Path, check_stop: CheckStop, meter: ProgressMeter, settings: Settings
) -> Outcome:
    """Run the engine in a child process until it ends or is stopped; nothing of it is left running.

    Parameters
    ----------
    scratch
        An existing folder of this attempt alone, see AttemptFolder.
    check_stop
        Called about four times a second. Errors other than StopRequest end the child too, and are passed on.
    meter
        Counts the progress; of the attempt's kind of work.
    settings
        Of them: timeouts and threads.

    Raises
    ------
    StopRequest
        Where the attempt was stopped for another reason than its timeout.
    OSError
        Where the child cannot be started or `scratch` cannot be written.
    """
    folder = AttemptFolder(scratch.resolve())
    threads = settings.engine_threads or EngineConfig().threads

    def command(progress_fd: int) -> Sequence[str]:
        ChildRequest(
            **vars(attempt),
            out=folder.out,
            threads=threads,
            cancel_file=folder.cancel,
            result_file=folder.result,
            progress_fd=progress_fd,
            parent_pid=os.getpid(),
        ).write(folder.request)
        # -P: the working directory holds files from outside and is no place to import from.
        return [sys.executable, "-P", "-m", "worker.child", str(folder.request)]

    return supervise(command, folder=folder, threads=threads, check_stop=check_stop, meter=meter, settings=settings)


def supervise(
    command: Command,
    *,
    folder: AttemptFolder,
    threads: int,
    check_stop: CheckStop,
    meter: ProgressMeter,
    settings: Settings,
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
        _watch(child, termination, check_stop=check_stop, meter=meter, timeout_s=settings.job_timeout_seconds)
        returncode, reports = child.close()
    for report in reports:
        meter.update(*report)
    if termination.reason not in (None, StopReason.TIMEOUT):
        raise StopRequest(termination.reason)
    return outcome_of(
        Ending(
            returncode=returncode,
            timeout_s=None if termination.reason is None else settings.job_timeout_seconds,
            result=ChildResult.read(folder.result),
            stage=meter.stage,
            log_tail=output.tail(),
            memory_kills=kills_since(kills_before),
            out=folder.out,
        )
    )


def _watch(
    child: ChildProcess, termination: Termination, *, check_stop: CheckStop, meter: ProgressMeter, timeout_s: float
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
            try:
                check_stop()
            except StopRequest as request:
                termination.stop(request.reason, now_s)
            if os.getppid() != parent:
                termination.stop(StopReason.ORPHANED, now_s)
            if now_s >= ends_s:
                termination.stop(StopReason.TIMEOUT, now_s)
        termination.advance(now_s)


def _environment(threads: int, scratch: Path) -> dict[str, str]:
    kept = {name: value for name, value in os.environ.items() if name in _KEPT or name.startswith(_KEPT_PREFIXES)}
    return {**kept, "TMPDIR": str(scratch), **dict.fromkeys(_THREADS, str(threads))}
