"""Progress for the person who waits: bars on a terminal, lines where nobody watches."""

from __future__ import annotations

import sys
import threading
import time

from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    ProgressColumn,
    TaskID,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TransferSpeedColumn,
)

from service.client.job_watcher import ENDED, JobNews

_LINE_EVERY_S = 10.0
_NAME = "{task.description:<9}"
_CHILDREN = ("reconstructions", "submaps")  # stages of a job that waits for others


def _byte_columns() -> tuple[ProgressColumn, ...]:
    return (TextColumn(_NAME), BarColumn(), DownloadColumn(), TransferSpeedColumn())


def _job_columns() -> tuple[ProgressColumn, ...]:
    what = TextColumn("{task.fields[what]}")
    return (TextColumn(_NAME), BarColumn(), TaskProgressColumn(), TimeElapsedColumn(), what)


class Display:
    """Shows bytes that move and jobs that run, on standard error. A context manager; for many threads."""

    def __init__(self) -> None:
        console = Console(stderr=True)
        self._shown: _Bars | _Lines = _Bars(console) if console.is_terminal else _Lines()

    def __enter__(self) -> Display:
        self._shown.begin()
        return self

    def __exit__(self, *_: object) -> None:
        self._shown.end()

    def report(self, stage: str, done_bytes: int, total_bytes: int) -> None:
        """Show how many bytes of a stage are done."""
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
        self._lock = threading.Lock()
        self._bars: Progress | None = None
        self._shows_job = False
        self._tasks: dict[str, TaskID] = {}

    def begin(self) -> None:
        """Show nothing before there is something."""

    def end(self) -> None:
        with self._lock:
            self._end_bars()

    def say(self, line: str) -> None:
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)

    def bytes_done(self, stage: str, done_bytes: int, total_bytes: int) -> None:
        with self._lock:
            bars = self._bars_for(job=False)
            if stage not in self._tasks:
                self._tasks[stage] = bars.add_task(stage, total=total_bytes)
            bars.update(self._tasks[stage], completed=done_bytes, total=total_bytes)
            if done_bytes >= total_bytes:
                del self._tasks[stage]  # the next of this name is another's

    def job(self, news: JobNews) -> None:
        with self._lock:
            bars = self._bars_for(job=True)
            if "job" not in self._tasks:
                self._tasks["job"] = bars.add_task("job", total=100.0, what="")
            bars.update(self._tasks["job"], completed=news.percent, what=described(news))

    def _bars_for(self, *, job: bool) -> Progress:
        """Bars of this kind: those that are shown, or new ones below."""
        if self._bars is None or self._shows_job is not job:
            self._end_bars()
            self._bars = Progress(*(_job_columns() if job else _byte_columns()), console=self._console)
            self._shows_job = job
            self._bars.start()
        return self._bars

    def _end_bars(self) -> None:
        if self._bars is not None:
            self._bars.stop()
        self._bars = None
        self._tasks.clear()


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
        stage = "" if news.state in ENDED else news.stage or ""
        self._maybe(("job", news.state, stage, str(news.attempt)), f"job: {described(news)}")

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
    if news.state == "QUEUED" and news.stage not in _CHILDREN:
        return "QUEUED" if news.attempt == 0 else f"QUEUED again after attempt {news.attempt}"
    if news.state in ENDED:
        return news.state
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
