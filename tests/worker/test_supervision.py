"""Children that misbehave, as small programs of their own."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from service.settings import Settings
from tests.worker.conftest import go_on, is_gone, meter_of, settings_with, stop_once_it_works, wait_until
from worker.attempt import AttemptFolder, Command, supervise
from worker.child_output import FILE_BYTES, TAIL_BYTES
from worker.outcomes import Failed, Outcome
from worker.progress import ProgressMeter
from worker.termination import CheckStop, StopReason, StopRequest

STUBBORN = """
import os, signal, sys, time
def note(word):
    with open("notes", "a") as file:
        print(word, file=file)
signal.signal(signal.SIGTERM, lambda *_: note("SIGTERM"))
note(f"pid {os.getpid()}")
os.write(int(sys.argv[1]), b'["mapping", 3, 10]\\n')
asked = False
while True:
    if os.path.exists("cancel") and not asked:
        asked = True
        note("asked")
    time.sleep(0.02)
"""

FINISHED = """
import os, sys, time
with open("result.json", "w") as file:
    file.write('{"report": {"sound": true}, "error": null}')
os.write(int(sys.argv[1]), b'["export", 1, 1]\\n')
while not os.path.exists("cancel"):
    time.sleep(0.02)
"""

PARENT = """
import os, subprocess, sys
grandchild = subprocess.Popen(["sleep", "1000"])
with open("notes", "w") as file:
    print("pid", grandchild.pid, file=file)
"""

SUPERVISOR = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[3])
from tests.worker.conftest import go_on, meter_of, settings_with
from worker.child_protocol import Attempt, Work
from worker.attempt import AttemptFolder, run_attempt, supervise
from worker.termination import StopRequest
scratch, what = Path(sys.argv[1]), sys.argv[2]
common = dict(check_stop=go_on, meter=meter_of(), settings=settings_with(scratch))
if what == "drive":
    attempt = Attempt(work=Work.RECONSTRUCTION, drive=Path(sys.argv[4]), settings={})
    outcome = run_attempt(attempt, scratch=scratch, **common)
else:
    program = lambda fd: [sys.executable, "-c", what, str(fd)]
    try:
        outcome = supervise(program, folder=AttemptFolder(scratch), threads=1, **common)
    except StopRequest as stop:
        outcome = stop
(scratch / "outcome").write_text(repr(outcome))
"""


def program(source: str) -> Command:
    def command(progress_fd: int) -> Sequence[str]:
        return [sys.executable, "-c", source, str(progress_fd)]

    return command


def run(
    source: str,
    scratch: Path,
    settings: Settings,
    check_stop: CheckStop = go_on,
    meter: ProgressMeter | None = None,
) -> Outcome:
    return supervise(
        program(source),
        folder=AttemptFolder(scratch),
        threads=3,
        check_stop=check_stop,
        meter=meter or meter_of(),
        settings=settings,
    )


def notes(scratch: Path) -> list[str]:
    path = scratch / "notes"
    return path.read_text(encoding="utf-8").splitlines() if path.exists() else []


def noted_pid(scratch: Path) -> int:
    """The process id that a program has noted; waits for it."""
    wait_until(lambda: notes(scratch) != [], "the program's start")
    return int(notes(scratch)[0].removeprefix("pid "))


def test_stubborn_child_is_stopped_step_by_step(scratch: Path, tmp_path: Path) -> None:
    """Asked, then told, then killed."""
    impatient = settings_with(tmp_path, terminate_after_seconds=1.0, kill_after_seconds=2.0)
    stopped_s: list[float] = []
    meter = meter_of()

    def check_stop() -> None:
        if meter.stage == "mapping":
            stopped_s.append(time.monotonic())
            raise StopRequest(StopReason.CANCEL)

    with pytest.raises(StopRequest) as stopped:
        run(STUBBORN, scratch, impatient, check_stop, meter)
    assert stopped.value.reason is StopReason.CANCEL
    assert notes(scratch)[1:] == ["asked", "SIGTERM"]
    assert is_gone(noted_pid(scratch))
    assert time.monotonic() - stopped_s[0] >= 2.0


def test_stubborn_child_runs_out_of_time(scratch: Path, tmp_path: Path) -> None:
    impatient = settings_with(tmp_path, job_timeout_seconds=1.0, terminate_after_seconds=0.5, kill_after_seconds=1.0)
    outcome = run(STUBBORN, scratch, impatient)
    assert isinstance(outcome, Failed)
    assert outcome.code == "timeout"
    assert notes(scratch)[1:] == ["asked", "SIGTERM"]
    assert is_gone(noted_pid(scratch))


def test_fenced_attempt_is_killed_at_once(scratch: Path, settings: Settings) -> None:
    meter = meter_of()
    with pytest.raises(StopRequest) as stopped:
        run(STUBBORN, scratch, settings, stop_once_it_works(meter, StopReason.FENCED), meter)
    assert stopped.value.reason is StopReason.FENCED
    assert notes(scratch)[1:] == []
    assert is_gone(noted_pid(scratch))


@pytest.mark.parametrize("reason", [StopReason.CANCEL, StopReason.SHUT_DOWN, StopReason.FENCED])
def test_stopped_whatever_it_left(scratch: Path, settings: Settings, reason: StopReason) -> None:
    """A result that came too late is none."""
    meter = meter_of()
    with pytest.raises(StopRequest) as stopped:
        run(FINISHED, scratch, settings, stop_once_it_works(meter, reason), meter)
    assert stopped.value.reason is reason
    assert AttemptFolder(scratch).result.exists()


def test_shut_down_overtakes_a_cancel(scratch: Path, settings: Settings) -> None:
    """Killed a few seconds after it was asked, not after the 40 s of a cancel."""
    meter = meter_of()
    reasons = iter([StopReason.CANCEL])

    def check_stop() -> None:
        if meter.stage:
            raise StopRequest(next(reasons, StopReason.SHUT_DOWN))

    begun_s = time.monotonic()
    with pytest.raises(StopRequest) as stopped:
        run(STUBBORN, scratch, settings, check_stop, meter)
    assert stopped.value.reason is StopReason.SHUT_DOWN
    assert notes(scratch)[1:] == ["asked"]
    assert time.monotonic() - begun_s < 30.0


def test_check_that_fails_leaves_no_child(scratch: Path, settings: Settings) -> None:
    meter = meter_of()

    def check_stop() -> None:
        if meter.stage:
            raise ConnectionError("the database is gone")

    with pytest.raises(ConnectionError):
        run(STUBBORN, scratch, settings, check_stop, meter)
    assert is_gone(noted_pid(scratch))


def test_grandchild_does_not_survive(scratch: Path, settings: Settings) -> None:
    outcome = run(PARENT, scratch, settings)
    assert isinstance(outcome, Failed)
    assert "without a result" in outcome.what
    grandchild = noted_pid(scratch)
    wait_until(lambda: is_gone(grandchild), "the grandchild's end")


@pytest.mark.parametrize(
    ("source", "code", "words"),
    [
        ("import os; os.abort()", "engine-abort", "SIGABRT"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "engine-abort", "SIGSEGV"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGTERM)", "engine-abort", "SIGTERM"),
        ("raise SystemExit(70)", "engine-abort", "exit code 70"),
        ("raise SystemExit(71)", "out-of-memory", "memory ran out before its first stage"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "engine-killed", "was killed"),
    ],
)
def test_ends_without_a_result(scratch: Path, settings: Settings, source: str, code: str, words: str) -> None:
    outcome = run(source, scratch, settings)
    assert isinstance(outcome, Failed)
    assert (outcome.code, outcome.retryable, outcome.stage) == (code, True, "")
    assert words in outcome.what
    assert len(outcome.remedy) > 10


@pytest.mark.slow
def test_output_is_bounded_and_its_end_is_kept(scratch: Path, settings: Settings) -> None:
    source = "import sys\nfor i in range(1_000_000): print(f'line {i:07d}')\nsys.stderr.write('the \\0end\\xff\\n')"
    outcome = run(source, scratch, settings)
    assert isinstance(outcome, Failed)
    assert outcome.log_tail.endswith("line 0999999\nthe endÿ\n")
    assert TAIL_BYTES - 20 < len(outcome.log_tail.encode()) <= TAIL_BYTES
    file = AttemptFolder(scratch).output
    assert file.stat().st_size == FILE_BYTES
    assert file.read_bytes().startswith(b"line 0000000\n")


def test_what_is_reported_last_is_not_lost(scratch: Path, settings: Settings) -> None:
    """The child ends right after its report."""
    meter = meter_of()
    source = 'import os, sys; os.write(int(sys.argv[1]), b\'["matches", 7, 10]\\n["mapp\'); os.abort()'
    outcome = run(source, scratch, settings, meter=meter)
    assert isinstance(outcome, Failed)
    assert outcome.stage == "matches"
    assert (meter.at(0.0).done, meter.at(0.0).total) == (7, 10)


def test_child_that_closes_its_pipes_is_still_watched(scratch: Path, settings: Settings) -> None:
    checks_s: list[float] = []
    check_stop = lambda: checks_s.append(time.monotonic())  # noqa: E731
    run("import os, time; os.closerange(0, 100); time.sleep(1.5)", scratch, settings, check_stop)
    assert 3 <= len(checks_s) <= 40


def test_environment_holds_threads_and_no_secrets(
    scratch: Path, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MRASFM_DATABASE_URL", "postgresql://worker:hush@db/mrasfm")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "hush")
    outcome = run("import os\nfor item in os.environ.items(): print(*item)", scratch, settings)
    assert isinstance(outcome, Failed)
    assert "hush" not in outcome.log_tail
    assert "OMP_NUM_THREADS 3" in outcome.log_tail
    assert "NUMBA_NUM_THREADS 3" in outcome.log_tail


def supervisor(scratch: Path, *arguments: object) -> list[str]:
    root = Path(__file__).parents[2]
    first, *rest = arguments
    return [sys.executable, "-c", SUPERVISOR, str(scratch), str(first), str(root), *map(str, rest)]


def test_child_dies_with_its_supervisor(brief_drive: Path, scratch: Path) -> None:
    """A real child, and the supervisor has no time to say good-bye."""
    process = subprocess.Popen(supervisor(scratch, "drive", brief_drive))
    request = AttemptFolder(scratch).request
    try:
        wait_until(lambda: children_with(request) != [], "the child's start")
        (child,) = children_with(request)
    finally:
        process.kill()
        process.wait()
    wait_until(lambda: is_gone(child), "the child's end")
    assert not AttemptFolder(scratch).result.exists()


def children_with(request: Path) -> list[int]:
    """Processes that were started with this request."""
    import psutil

    found = []
    for process in psutil.process_iter(["cmdline"]):
        command = process.info["cmdline"] or []
        if command[-1:] == [str(request)]:
            found.append(process.pid)
    return found


def test_orphaned_supervisor_kills_its_child(scratch: Path) -> None:
    """Its own parent is gone: the attempt belongs to nobody."""
    source = "import subprocess, sys; subprocess.Popen(sys.argv[1:]).wait()"
    outer = subprocess.Popen([sys.executable, "-c", source, *supervisor(scratch, STUBBORN)])
    try:
        child = noted_pid(scratch)
        wait_until(lambda: os.path.exists(f"/proc/{child}/fd/1"), "the child's start")
    finally:
        outer.kill()
        outer.wait()
    wait_until((scratch / "outcome").exists, "the supervisor's end")
    assert is_gone(child)
    wait_until(lambda: "ORPHANED" in (scratch / "outcome").read_text(encoding="utf-8"), "the outcome")
