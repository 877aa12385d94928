"""Progress for the person who waits: bars on a terminal, lines where nobody watches."""

from __future__ import annotations

import sys
import threading
import time
from types import TracebackType

from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TaskID,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TransferSpeedColumn,
)

from service.client.follow import JobNews

_LINE_EVERY_S = 10.0


class Display:
    """Shows bytes that move and jobs that run, on standard error. A context manager; for many threads."""

    def __init__(self) -> None:
        console = Console(stderr=True)
        self._shown: _Bars | _Lines = _Bars(console) if console.is_terminal else _Lines()

    def __enter__(self) -> Display:
        self._shown.begin()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._shown.end()

    def report(self, stage: str, done_bytes: int, total_bytes: int) -> None:
        """So many bytes of a stage are done."""
        if total_bytes > 0:
            self._shown.bytes_done(stage, done_bytes, total_bytes)

    def tell(self, news: JobNews) -> None:
        """A job has got so far."""
        self._shown.job(news)

    def say(self, line: str) -> None:
        """A line that stays."""
        self._shown.say(line)


class _Bars:
    def __init__(self, console: Console) -> None:
        self._console = console
        self._bytes = Progress(
            TextColumn("{task.description:<9}"), BarColumn(), DownloadColumn(), TransferSpeedColumn(), console=console
        )
        columns = (TextColumn("{task.description:<9}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
        self._job = Progress(*columns, TextColumn("{task.fields[what]}"), console=console)
        self._current: Progress | None = None
        self._tasks: dict[str, TaskID] = {}

    def begin(self) -> None:
        """Nothing is shown before there is something."""

    def end(self) -> None:
        self._show(None)

    def say(self, line: str) -> None:
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)

    def bytes_done(self, stage: str, done_bytes: int, total_bytes: int) -> None:
        self._show(self._bytes)
        if stage not in self._tasks:
            self._tasks[stage] = self._bytes.add_task(stage, total=total_bytes)
        self._bytes.update(self._tasks[stage], completed=done_bytes, total=total_bytes)

    def job(self, news: JobNews) -> None:
        self._show(self._job)
        if "job" not in self._tasks:
            self._tasks["job"] = self._job.add_task("job", total=100.0, what="")
        self._job.update(self._tasks["job"], completed=news.percent, what=described(news))

    def _show(self, wanted: Progress | None) -> None:
        if self._current is wanted:
            return
        if self._current is not None:
            self._current.stop()
        self._current = wanted
        if wanted is not None:
            wanted.start()


class _Lines:
    """A line when something begins or ends, and every ten seconds between."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last_said: tuple[str, ...] = ()
        self._last_said_s = 0.0

    def begin(self) -> None:
        """Lines need no beginning."""

    def end(self) -> None:
        """Lines need no end."""

    def say(self, line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    def bytes_done(self, stage: str, done_bytes: int, total_bytes: int) -> None:
        mark = (stage, "done" if done_bytes >= total_bytes else "")
        self._maybe(mark, f"{stage}: {done_bytes / 1e6:.1f} of {total_bytes / 1e6:.1f} MB")

    def job(self, news: JobNews) -> None:
        self._maybe(("job", news.state, news.stage or "", str(news.attempt)), f"job: {described(news)}")

    def _maybe(self, mark: tuple[str, ...], line: str) -> None:
        with self._lock:
            if mark == self._last_said and time.monotonic() < self._last_said_s + _LINE_EVERY_S:
                return
            self._last_said, self._last_said_s = mark, time.monotonic()
            self.say(line)


def described(news: JobNews) -> str:
    """A job's news in one line.

    Examples
    --------
    >>> described(JobNews("RUNNING", 1, 33.5, "matches", 410, 1902, "pairs", 120.0, 260.0))
    'RUNNING, 33.5 %, matches 410/1902 pairs, 2 to 5 min to go'
    """
    if news.state == "QUEUED":
        return "QUEUED" if news.attempt == 0 else f"QUEUED again after attempt {news.attempt}"
    parts = [news.state, f"{news.percent:.1f} %"]
    if news.stage is not None:
        of = f" {news.done}/{news.total} {news.unit or ''}".rstrip() if news.total else ""
        parts.append(news.stage + of)
    if news.eta_low_s is not None and news.eta_high_s is not None and news.state == "RUNNING":
        parts.append(_remaining(news.eta_low_s, news.eta_high_s))
    return ", ".join(parts)


def _remaining(low_s: float, high_s: float) -> str:
    for unit, seconds in (("s", 1), ("min", 60), ("h", 3600)):
        low, high = int(low_s // seconds), -int(-high_s // seconds)
        if high < 120 or unit == "h":
            break
    return f"{low} to {high} {unit} to go"
