from __future__ import annotations

import dataclasses
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

import mrasfm_engine
from mrasfm_engine.errors import InputError, MrasfmError, ReconstructionError, StorageError
from schemas.artifacts import Stage
from tests.worker.conftest import settings_with
from worker.child import EXIT_OUT_OF_MEMORY
from worker.child_output import TAIL_BYTES, ChildOutput
from worker.child_protocol import ChildError, ChildRequest, ChildResult, Work
from worker.engine import described
from worker.engine_settings import engine_config
from worker.log_paths import LogPaths
from worker.oom import MemoryKills, memory_kills
from worker.outcomes import Ending, Failed, Succeeded, outcome_of
from worker.termination import SHUT_DOWN_GRACE_S, StopReason, Termination

GOOD = ChildResult(report={"sound": True})


def ending(**fields: object) -> Ending:
    plain = Ending(
        returncode=0,
        timeout_s=None,
        result=None,
        stage="mapping",
        log_tail="the end\n",
        memory_kills=0,
        out=Path("scene"),
    )
    return dataclasses.replace(plain, **fields)


def failed(**fields: object) -> Failed:
    outcome = outcome_of(ending(**fields))
    assert isinstance(outcome, Failed)
    assert outcome.log_tail == "the end\n"
    return outcome


def error(*, retryable: bool = False, is_storage: bool = False) -> ChildResult:
    words = {"code": "some-code", "what": "it is bad", "remedy": "Make it good."}
    return ChildResult(error=ChildError(**words, retryable=retryable, is_storage=is_storage))


def test_result_decides_however_the_child_ended() -> None:
    """A crash while native libraries are unloaded spoils nothing."""
    for code in (0, -signal.SIGSEGV):
        assert outcome_of(ending(result=GOOD, returncode=code)) == Succeeded(report={"sound": True}, out=Path("scene"))


def test_late_result_is_better_than_a_timeout() -> None:
    assert isinstance(outcome_of(ending(result=GOOD, timeout_s=60.0)), Succeeded)
    late = failed(result=error(), timeout_s=60.0)
    assert (late.code, late.retryable) == ("timeout", False)
    assert "60 s" in late.what


@pytest.mark.parametrize(
    ("problem", "retryable", "is_storage"),
    [
        (InputError("it is bad", remedy="Make it good."), False, False),
        (ReconstructionError("it is bad", remedy="Make it good."), False, False),
        (StorageError("it is bad", remedy="Make it good."), True, True),
        (MrasfmError("it is bad", remedy="Make it good."), True, False),
    ],
)
def test_errors_of_the_engine_keep_their_words(
    tmp_path: Path, problem: MrasfmError, retryable: bool, is_storage: bool
) -> None:
    outcome = failed(result=ChildResult(error=described(problem, request_in(tmp_path))))
    assert (outcome.code, outcome.what, outcome.remedy) == (problem.code, "it is bad", "Make it good.")
    assert (outcome.retryable, outcome.is_storage, outcome.stage) == (retryable, is_storage, "mapping")


def test_kernel_that_says_so_makes_it_certain() -> None:
    risen = failed(returncode=-signal.SIGKILL, memory_kills=1)
    assert (risen.code, risen.what, risen.blame) == ("out-of-memory", "memory ran out in stage 'mapping'", 1.0)
    unchanged = failed(returncode=-signal.SIGKILL, memory_kills=0)
    assert (unchanged.code, unchanged.blame) == ("engine-killed", 0.0)
    assert "was killed in stage 'mapping', and not by the kernel" in unchanged.what
    unknown = failed(returncode=-signal.SIGKILL, memory_kills=None)
    assert (unknown.code, unknown.blame) == ("engine-killed", 0.5)
    assert "was killed in stage 'mapping', most often because memory ran out" in unknown.what


@pytest.mark.parametrize("returncode", [-signal.SIGSEGV, -signal.SIGABRT, -signal.SIGTERM, 1, 0, EXIT_OUT_OF_MEMORY])
def test_other_ends_count_against_the_job(returncode: int) -> None:
    assert failed(returncode=returncode).blame == 1.0


def test_stages_of_the_worker_have_names_like_the_engines() -> None:
    what = failed(returncode=1, stage=Stage.FETCH).what
    assert what == "the engine's process ended in stage 'fetch' with an unexpected error (exit code 1)"


def test_real_time_signal_has_no_name() -> None:
    assert "with signal 47" in failed(returncode=-47).what


def test_termination_takes_its_steps_in_time(tmp_path: Path) -> None:
    sent: list[signal.Signals] = []
    termination = Termination(
        sent.append, tmp_path / "cancel", settings_with(tmp_path, terminate_after_seconds=10, kill_after_seconds=30)
    )
    termination.advance(5.0)
    assert not (tmp_path / "cancel").exists()
    termination.stop(StopReason.CANCEL, 100.0)
    termination.advance(100.0)
    assert (tmp_path / "cancel").exists()
    termination.stop(StopReason.CANCEL, 105.0)  # asked again at every tick: the clock runs on
    termination.stop(StopReason.TIMEOUT, 105.0)
    assert termination.reason is StopReason.CANCEL
    termination.advance(109.9)
    assert sent == []
    termination.advance(110.0)
    assert sent == [signal.SIGTERM]
    termination.advance(129.9)
    termination.advance(130.0)
    termination.advance(200.0)
    assert sent == [signal.SIGTERM, signal.SIGKILL]


def test_stronger_reasons_take_over(tmp_path: Path) -> None:
    sent: list[signal.Signals] = []
    termination = Termination(sent.append, tmp_path / "cancel", settings_with(tmp_path))
    termination.stop(StopReason.TIMEOUT, 100.0)
    termination.stop(StopReason.SHUT_DOWN, 101.0)
    termination.advance(101.0 + SHUT_DOWN_GRACE_S - 0.1)
    assert sent == []
    termination.stop(StopReason.FENCED, 102.0)
    termination.stop(StopReason.SHUT_DOWN, 102.0)
    termination.advance(102.0)
    assert (termination.reason, sent) == (StopReason.FENCED, [signal.SIGKILL])


def test_termination_on_a_full_disk_goes_on_to_signals(tmp_path: Path) -> None:
    sent: list[signal.Signals] = []
    termination = Termination(sent.append, tmp_path / "no-folder" / "cancel", settings_with(tmp_path))
    termination.stop(StopReason.CANCEL, 0.0)
    termination.advance(25.0)
    assert sent == [signal.SIGTERM]


def test_output_is_decoded_leniently(tmp_path: Path) -> None:
    output = ChildOutput(tmp_path / "child.log")
    output.add(b"one\xff\r\ntw\0o \x1b[31mred\n\xe2\x82")
    assert output.tail() == "one\ntwo [31mred\n"
    output.add(b"\xac\n")
    assert output.tail() == "one\ntwo [31mred\n€\n"


def tail_of(folder: Path, text: str) -> str:
    output = ChildOutput(folder / "child.log")
    output.add(text.encode())
    return output.tail()


def test_the_tail_shows_no_paths_of_this_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/worker")
    attempt = tmp_path / "scratch" / "job_1.2"
    attempt.mkdir(parents=True)
    engine, numpy_file = Path(mrasfm_engine.__file__), Path(np.__file__)
    library = f"python{sys.version_info.major}.{sys.version_info.minor}"
    lines = {
        f'  File "{engine}", line 3, in run': '  File "mrasfm_engine/__init__.py", line 3, in run',
        f'  File "{numpy_file}", line 3': '  File "numpy/__init__.py", line 3',
        f'  File "{threading.__file__}", line 3': f'  File "{library}/threading.py", line 3',
        f"{numpy_file.parent}.libs/libopenblas.so(+0x1f) [0x7f]": "numpy.libs/libopenblas.so(+0x1f) [0x7f]",
        f"cannot read {attempt}/drive/images/a.png": "cannot read drive/images/a.png",
        f"cannot read {attempt.parent}/job_2.1/a": "cannot read job_2.1/a",
        f"in {attempt}: file://{attempt}/x": "in job_1.2: file://x",
        "no model /home/worker/models/a.onnx": "no model ~/models/a.onnx",
        "/home/workers/a /mnt/home/worker/a": "/home/workers/a /mnt/home/worker/a",
        "/lib/x86_64-linux-gnu/libc.so.6 /usr/bin/x": "/lib/x86_64-linux-gnu/libc.so.6 /usr/bin/x",
    }
    assert tail_of(attempt, "\n".join(lines)).split("\n") == list(lines.values())


def test_the_tail_of_a_traceback(tmp_path: Path) -> None:
    """As the interpreter of the child prints it."""
    code = "import json, numpy, mrasfm_engine.errors as e; numpy.linalg.inv(json.loads('[[0,0],[0,0]]'))"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=False)
    assert sys.prefix in done.stderr or str(Path(np.__file__).parents[1]) in done.stderr
    tail = tail_of(tmp_path, done.stderr)
    assert 'File "numpy/linalg/' in tail
    assert "LinAlgError" in tail
    for path in re.findall(r'File "(.*?)"', tail):
        assert not path.startswith("/"), path


def test_a_home_that_is_the_root_hides_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/")
    assert tail_of(tmp_path, "/etc/hosts and /") == "/etc/hosts and /"


def test_logs_of_a_user_without_a_home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", homeless)
    assert LogPaths([tmp_path]).shorten(f"{tmp_path}/x.py") == "x.py"


def test_one_endless_line_has_a_tail(tmp_path: Path) -> None:
    output = ChildOutput(tmp_path / "no-folder" / "child.log")  # nor does a file that cannot be written hurt
    output.add(b"x" * 100_000)
    assert output.tail() == "x" * TAIL_BYTES


def test_memory_kills_of_both_control_group_versions(tmp_path: Path) -> None:
    proc, mounts = tmp_path / "proc", tmp_path / "mounts"

    def count() -> int | None:
        found = memory_kills(proc=proc, mounts=mounts)
        return None if found is None else found.count

    (proc / "self").mkdir(parents=True)
    group = proc / "self/cgroup"
    group.write_text("9:name=systemd:/\n4:memory,hugetlb:/jobs/one\n0::/\n", encoding="utf-8")
    assert count() is None
    (mounts / "memory/jobs/one").mkdir(parents=True)
    (mounts / "memory/jobs/one/memory.oom_control").write_text(
        "oom_kill_disable 0\nunder_oom 0\noom_kill 3\n", encoding="utf-8"
    )
    assert count() == 3
    # In a container: one hierarchy, and the path is the host's.
    group.write_text("0::/docker/abc\n", encoding="utf-8")
    (mounts / "memory.events").write_text("low 0\noom 7\noom_kill 5\noom_group_kill 0\n", encoding="utf-8")
    assert count() == 5
    group.unlink()
    assert count() is None
    (proc / "vmstat").write_text("nr_free_pages 1\noom_kill 2\n", encoding="utf-8")
    assert count() == 2, "without a control group, the machine's"


def test_memory_kills_are_compared_within_one_counter(tmp_path: Path) -> None:
    before, now = MemoryKills("group", 3), MemoryKills("group", 5)
    assert now.since(before) == 2
    assert now.since(None) is None
    assert now.since(MemoryKills("another", 3)) is None
    assert before.since(now) is None, "a counter that fell began anew"
    path = tmp_path / "kills.json"
    assert MemoryKills.read(path) is None
    now.write(path)
    assert MemoryKills.read(path) == now
    for damaged in ("", "[1]", '{"counter": 1, "count": "x"}', '{"counter": "group"}'):
        path.write_text(damaged, encoding="utf-8")
        assert MemoryKills.read(path) is None


def request_in(folder: Path) -> ChildRequest:
    return ChildRequest(
        work=Work.PREFLIGHT,
        drive=folder / "drive",
        out=folder / "scene",
        settings={"use_gnss": False, "seed": None},
        threads=2,
        cancel_file=folder / "cancel",
        result_file=folder / "result.json",
        progress_fd=5,
        parent_pid=77,
    )


def test_messages_come_back_as_they_were(tmp_path: Path) -> None:
    request = request_in(tmp_path)
    request.write(tmp_path / "request.json")
    assert ChildRequest.read(tmp_path / "request.json") == request
    assert ChildResult.read(tmp_path / "result.json") is None
    for result in (GOOD, error(retryable=True, is_storage=True)):
        result.write(tmp_path / "result.json")
        assert ChildResult.read(tmp_path / "result.json") == result
    assert sorted(path.name for path in tmp_path.iterdir()) == ["request.json", "result.json"]


@pytest.mark.parametrize("settings", [{"max_keypoints": 0}, {"seed": -1}, {"seed": "x"}, {"threads": 4}])
def test_settings_out_of_range(settings: dict[str, object]) -> None:
    with pytest.raises(InputError, match=next(iter(settings))) as caught:
        engine_config(settings, threads=1)
    assert caught.value.code == "bad-settings"
