"""Work in a process of its own: to know the memory that it takes, and to survive it."""

from __future__ import annotations

import math
import multiprocessing
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Generic, TypeVar

from mrasfm_engine.errors import CancelledError, MrasfmError
from mrasfm_engine.types import StageProgress

Result = TypeVar("Result")

ASK_EVERY_S = 0.2
END_S = 10.0  # that a process may take to end after its result is there


@dataclass(frozen=True, kw_only=True)
class ProcessResult(Generic[Result]):
    """Result of a process.

    Attributes
    ----------
    result
        None where the process did not come to its end.
    failure
        Why it did not; empty where it did.
    peak_memory_bytes
        The most that was resident at once, with the interpreter and all libraries; None where nobody knows.
    """

    result: Result | None
    failure: str = ""
    peak_memory_bytes: int | None = None


def run_in_subprocess(
    work: Callable[..., Result],
    *arguments: Any,
    timeout_s: float = math.inf,
    progress: StageProgress = lambda stage, done, total: None,
    cancel: Callable[[], bool] = lambda: False,
) -> ProcessResult[Result]:
    """Run `work(progress, *arguments)` in a fresh process; function, arguments and result (not None) must be picklable.

    An `MrasfmError` of the work is raised here. Whatever else ends it, a crash or the kernel when memory runs out, is
    reported as `failure`.

    Raises
    ------
    MrasfmError
        What the work raised; CancelledError where `cancel` answers True, after the process was killed.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(sender, work, arguments), daemon=True)
    process.start()
    sender.close()
    until = time.monotonic() + timeout_s
    try:
        while True:
            if cancel():
                raise CancelledError
            if time.monotonic() >= until:
                peak = peak_memory_bytes(process.pid)
                return ProcessResult(
                    result=None, failure=f"not finished within {timeout_s:g} s", peak_memory_bytes=peak
                )
            if not receiver.poll(ASK_EVERY_S):
                continue
            try:
                kind, *content = receiver.recv()
            except EOFError:
                process.join()
                return ProcessResult(result=None, failure=_exit_description(process))
            if kind == "progress":
                progress(*content)
            elif kind == "refused":
                error, what, remedy, code = content
                raise error(what, remedy=remedy, code=code)
            else:
                process.join(END_S)
                return ProcessResult(result=content[0], peak_memory_bytes=content[1])
    finally:
        if process.is_alive():
            process.kill()
        process.join()
        receiver.close()


def _work(sender: Connection, work: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of a whole terminal: the parent decides
    try:
        result = work(lambda stage, done, total: sender.send(("progress", stage, done, total)), *arguments)
    except MrasfmError as error:
        sender.send(("refused", type(error), error.what, error.remedy, error.code))
    else:
        sender.send(("done", result, peak_memory_bytes()))


def _exit_description(process: BaseProcess) -> str:
    code = process.exitcode
    if code is None or code >= 0:
        return f"ended with exit code {code}"
    name = signal.Signals(-code).name
    return f"killed by {name}" + (", maybe because memory ran out" if name == "SIGKILL" else "")


def peak_memory_bytes(pid: int | None = None) -> int | None:
    """The most memory that this or another process had resident at once; None where the system does not report it.

    Of Linux not `ru_maxrss`: that begins with what the parent had when it started the process.
    """
    found = _status_bytes(pid, "VmHWM")
    if found is not None or pid is not None or sys.platform in ("linux", "win32"):
        return found
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def memory_bytes() -> int | None:
    """The memory that this process has resident now; None where the system does not report it."""
    return _status_bytes(None, "VmRSS")


def _status_bytes(pid: int | None, name: str) -> int | None:
    try:
        lines = Path(f"/proc/{'self' if pid is None else pid}/status").read_text(encoding="ascii").splitlines()
    except (OSError, UnicodeDecodeError):
        return None
    for line in lines:
        key, _, value = line.partition(":")
        if key == name:
            return 1024 * int(value.split()[0])
    return None
