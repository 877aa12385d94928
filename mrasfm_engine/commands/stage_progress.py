"""Progress of the stages on standard error: bars on a terminal, plain lines elsewhere."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from mrasfm_engine.types import StageProgress

LINE_EVERY_S = 30.0
_TICK_S = 1.0
_WITHOUT_A_BAR = "export"  # it takes a moment


@contextmanager
def stage_progress(console: Console) -> Iterator[StageProgress]:
    """A function to call with stage, done and total; 0 of 0 is a stage's beginning, 1 of 1 its end."""
    with _bars(console) if console.is_terminal else _lines() as update:
        yield update


@contextmanager
def _bars(console: Console) -> Iterator[StageProgress]:
    columns = (TextColumn("{task.description:<11}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    tasks: dict[str, TaskID] = {}
    with Progress(*columns, console=console) as bars:

        def update(stage: str, done: int, total: int) -> None:
            if total == 0 or stage == _WITHOUT_A_BAR:
                return
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total)
            if total > 1 or bars.tasks[tasks[stage]].total == 1:
                bars.update(tasks[stage], completed=done, total=total)
            elif done == total:
                bars.update(tasks[stage], completed=bars.tasks[tasks[stage]].total)

        yield update


@contextmanager
def _lines() -> Iterator[StageProgress]:
    lines = StageLines(_print_line)
    stop = threading.Event()

    def tick() -> None:
        while not stop.wait(_TICK_S):
            lines.tick()

    ticking = threading.Thread(target=tick, name="stage-lines", daemon=True)
    ticking.start()
    try:
        yield lines.update
        lines.finish("done")
    except BaseException:
        lines.finish("stopped")
        raise
    finally:
        stop.set()
        ticking.join()


def _print_line(line: str) -> None:
    # Who reads the lines may have gone; the work goes on.
    with contextlib.suppress(OSError, ValueError):
        print(line, file=sys.stderr, flush=True)


class StageLines:
    """One line when a stage begins, one when it ends, and one now and then between. For many threads.

    Parameters
    ----------
    write
        Takes a line without its end.
    clock_s
        Seconds that only rise.
    """

    def __init__(self, write: Callable[[str], None], clock_s: Callable[[], float] = time.monotonic) -> None:
        self._write = write
        self._clock_s = clock_s
        self._lock = threading.Lock()
        self._begun_s = clock_s()  # of the command
        self._stage: str | None = None  # that goes on
        self._last_ended: str | None = None
        self._stage_begun_s = self._last_line_s = self._begun_s
        self._done = self._total = 0

    def update(self, stage: str, done: int, total: int) -> None:
        """Take in that so much of a stage is done; 0 of 0 is its beginning, 1 of 1 its end, whatever it counts.

        A stage of which only the end is told was finished by an earlier run.
        """
        with self._lock:
            ends = done == total == 1
            if ends and self._stage != stage:
                if self._last_ended != stage:
                    self._end("done")
                    self._last_ended = stage
                    self._say(f"{stage}: reused from an earlier run")
                return
            if self._stage != stage:
                self._end("done")
                self._begin(stage)
            if ends:
                self._end("done")
            elif total > 0:
                self._done, self._total = done, total

    def tick(self) -> None:
        """Write a line if it is time."""
        with self._lock:
            if self._stage is not None and self._clock_s() >= self._last_line_s + LINE_EVERY_S:
                self._say(f"{self._stage}: {self._counted()}{self._took()} so far")

    def finish(self, how: str) -> None:
        """End the stage that goes on: it is "done" or "stopped"."""
        with self._lock:
            self._end(how)

    def _begin(self, stage: str) -> None:
        self._stage, self._done, self._total = stage, 0, 0
        self._stage_begun_s = self._clock_s()
        self._say(f"{stage}: begins")

    def _end(self, how: str) -> None:
        if self._stage is not None:
            self._say(f"{self._stage}: {how}, {self._counted()}{self._took()}")
            self._stage, self._last_ended = None, self._stage

    def _counted(self) -> str:
        return f"{self._done}/{self._total}, " if self._total else ""

    def _took(self) -> str:
        return f"{self._clock_s() - self._stage_begun_s:.1f} s"

    def _say(self, line: str) -> None:
        self._last_line_s = self._clock_s()
        minutes, seconds = divmod(int(self._last_line_s - self._begun_s), 60)
        self._write(f"[{minutes:02d}:{seconds:02d}] {line}")
