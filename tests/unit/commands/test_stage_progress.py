"""Plain lines where standard error is no terminal, on a clock of the test's; bars as ever where it is one."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from mrasfm_engine.commands.stage_progress import LINE_EVERY_S, StageLines, stage_progress


class Lines:
    """What was written, and the clock."""

    def __init__(self) -> None:
        self.now_s = 1000.0
        self.written: list[str] = []
        self.stages = StageLines(self.written.append, lambda: self.now_s)

    def wait(self, seconds: float) -> None:
        """As the thread that looks every second."""
        for _ in range(int(seconds)):
            self.now_s += 1.0
            self.stages.tick()


def test_beginning_and_end_with_time_and_counts() -> None:
    lines = Lines()
    lines.stages.update("features", 0, 0)
    lines.wait(5)
    lines.stages.update("features", 3, 40)
    lines.stages.update("features", 40, 40)
    lines.wait(2)
    lines.stages.update("features", 1, 1)
    lines.stages.update("matches", 0, 0)
    lines.wait(3)
    lines.stages.update("matches", 1, 1)
    assert lines.written == [
        "[00:00] features: begins",
        "[00:07] features: done, 40/40, 7.0 s",
        "[00:07] matches: begins",
        "[00:10] matches: done, 3.0 s",
    ]


def test_a_line_every_half_minute() -> None:
    """Also while nothing is told, and not more often however much is."""
    lines = Lines()
    lines.stages.update("mapping", 0, 0)
    for done in range(1, 71):
        lines.stages.update("mapping", done, 400)
        lines.wait(1)
    lines.wait(50)
    lines.stages.update("mapping", 1, 1)
    assert LINE_EVERY_S == 30.0
    assert lines.written == [
        "[00:00] mapping: begins",
        "[00:30] mapping: 30/400, 30.0 s so far",
        "[01:00] mapping: 60/400, 60.0 s so far",
        "[01:30] mapping: 70/400, 90.0 s so far",
        "[02:00] mapping: 70/400, 120.0 s so far",
        "[02:00] mapping: done, 70/400, 120.0 s",
    ]
    lines.wait(100)
    assert len(lines.written) == 6  # nothing goes on


def test_reused_stages_say_so() -> None:
    lines = Lines()
    lines.stages.update("preflight", 0, 0)
    lines.stages.update("preflight", 1, 1)
    lines.stages.update("features", 1, 1)
    lines.stages.update("matches", 1, 1)
    assert lines.written[2:] == [
        "[00:00] features: reused from an earlier run",
        "[00:00] matches: reused from an earlier run",
    ]


def test_a_stage_that_counts_one_thing_ends_once() -> None:
    lines = Lines()
    for done, total in ((0, 0), (1, 1), (1, 1)):
        lines.stages.update("pictures", done, total)
    assert lines.written == ["[00:00] pictures: begins", "[00:00] pictures: done, 0.0 s"]


def test_what_goes_on_at_an_error_was_stopped(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match="broken"), stage_progress(Console(stderr=True)) as update:  # noqa: PT012
        update("features", 2, 9)
        raise ValueError("broken")
    begins, stopped = capfd.readouterr().err.splitlines()
    assert begins.endswith("features: begins")
    assert "features: stopped, 2/9, " in stopped


def test_a_terminal_has_bars(capfd: pytest.CaptureFixture[str]) -> None:
    shown = io.StringIO()
    with stage_progress(Console(file=shown, force_terminal=True, width=100)) as update:
        update("features", 0, 0)
        for done in range(1, 6):
            update("features", done, 5)
        update("features", 1, 1)
        update("export", 0, 0)
        update("export", 1, 1)
    assert "5/5" in shown.getvalue()
    assert "begins" not in shown.getvalue()
    assert "export" not in shown.getvalue()
    assert capfd.readouterr().err == ""
