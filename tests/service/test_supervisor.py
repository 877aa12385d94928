"""The supervisor, with real processes: each test runs one as a program of its own and treats it as the world does."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import pytest

from service.standalone import orphan_reaper
from service.standalone.supervisor import ChildSpec, Supervisor
from service.storage.data_folder import DataFolderError, exclusive_use
from tests.helpers.process_tree import children_of

TIMEOUT_S = 60.0

SUPERVISOR = """
import json, sys
from pathlib import Path
from service.storage.data_folder import DataFolderError, exclusive_use
from service.standalone.liveness_probe import Pulse
from service.standalone.supervisor import ChildSpec, Supervisor, SupervisorError

def say(line):
    print(line, flush=True)

def spec_of(document):
    ready_file = document.pop("ready_file", None)
    is_ready = None if ready_file is None else Path(ready_file).exists
    ask_at = document.pop("ask_at", None)
    ask = None if ask_at is None else lambda: Pulse("127.0.0.1", ask_at, "/livez")
    mend = document.pop("mend", None)
    repair = None if mend is None else lambda lines: Path(mend).touch() or f"mended: {lines[-1]}"
    return ChildSpec(is_ready=is_ready, ask=ask, repair=repair, **document)

folder = Path(sys.argv[1])
specs = [spec_of(document) for document in json.loads(sys.argv[2])]
try:
    with exclusive_use(folder) as lock:
        Supervisor(
            specs, log_folder=folder / "logs", say=say, on_ready=lambda: say("ready"), kept_descriptors=[lock]
        ).run()
except (DataFolderError, SupervisorError) as error:
    say(error)
    sys.exit(3)
"""

# Tells of its start and of SIGTERM; {reaction} is what it does then.
CHILD = """
import os, signal, sys, time
from pathlib import Path
name, folder = "{name}", Path("{folder}")

def tell(what):
    descriptor = os.open(folder / "events", os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    os.write(descriptor, (name + " " + what + "\\n").encode())

def terminated(number, frame):
    tell("terminated")
    {reaction}

signal.signal(signal.SIGTERM, terminated)
signal.signal(signal.SIGINT, lambda number, frame: tell("interrupted"))
print("hello from", name, flush=True)
(folder / (name + ".pid.new")).write_text(str(os.getpid()))
os.replace(folder / (name + ".pid.new"), folder / (name + ".pid"))
tell("started")
{body}
while True:
    time.sleep(60)
"""


def wait_for(what: Callable[[], Any]) -> Any:
    """What it returns once that is true."""
    deadline_s = time.monotonic() + TIMEOUT_S
    while not (value := what()):
        assert time.monotonic() < deadline_s, "waited in vain"
        time.sleep(0.02)
    return value


def is_gone(pid: int) -> bool:
    try:
        return bool(psutil.Process(pid).status() == psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return True


def guards_of(pid: int) -> list[psutil.Process]:
    return children_of(pid, "orphan_reaper")


@dataclass
class World:
    """One folder, and the supervisors that were started in it."""

    folder: Path
    supervisors: list[subprocess.Popen[bytes]]

    def child(self, name: str, *, reaction: str = "sys.exit(0)", body: str = "", **spec: Any) -> dict[str, Any]:
        source = CHILD.format(name=name, folder=self.folder, reaction=reaction, body=body)
        document = {"name": name, "argv": [sys.executable, "-I", "-S", "-c", source]}
        return {**document, "ready_file": str(self.folder / f"{name}.pid"), **spec}

    def start(self, *children: dict[str, Any]) -> subprocess.Popen[bytes]:
        for child in children:
            self.pid_file(child["name"]).unlink(missing_ok=True)
        with (self.folder / "console").open("ab") as console:
            supervisor = subprocess.Popen(
                [sys.executable, "-c", SUPERVISOR, str(self.folder), json.dumps(children)],
                stdout=console,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # so that a signal to its group does not reach pytest
            )
        self.supervisors.append(supervisor)
        return supervisor

    def start_ready(self, *children: dict[str, Any]) -> subprocess.Popen[bytes]:
        before = self.console().count("ready\n")
        supervisor = self.start(*children)
        wait_for(lambda: self.console().count("ready\n") > before or supervisor.poll() is not None)
        assert supervisor.poll() is None, self.console()
        return supervisor

    def console(self) -> str:
        path = self.folder / "console"
        return path.read_text(encoding="utf-8") if path.exists() else ""

    def events(self) -> list[str]:
        path = self.folder / "events"
        return path.read_text(encoding="utf-8").splitlines() if path.exists() else []

    def pid_file(self, name: str) -> Path:
        return self.folder / f"{name}.pid"

    def pid(self, name: str) -> int:
        wait_for(self.pid_file(name).exists)
        return int(self.pid_file(name).read_text(encoding="ascii"))

    def guard(self, supervisor: subprocess.Popen[bytes]) -> psutil.Process:
        (guard,) = wait_for(lambda: guards_of(supervisor.pid))
        assert isinstance(guard, psutil.Process)
        return guard


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    world = World(folder=tmp_path, supervisors=[])
    yield world
    for supervisor in world.supervisors:
        supervisor.kill()
        supervisor.wait()
    for pid_file in tmp_path.glob("*.pid"):  # nothing lives here any more, unless the test failed
        with suppress(ProcessLookupError):
            os.kill(int(pid_file.read_text(encoding="ascii")), signal.SIGKILL)


def stop(supervisor: subprocess.Popen[bytes], number: int = signal.SIGTERM) -> int:
    supervisor.send_signal(number)
    return supervisor.wait(TIMEOUT_S)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_children_start_in_order_and_stop_in_reverse(world: World, number: int) -> None:
    supervisor = world.start_ready(
        world.child("broker"), world.child("api", depends_on=["broker"]), world.child("worker", depends_on=["api"])
    )
    assert world.events() == ["broker started", "api started", "worker started"]
    assert stop(supervisor, number) == 0
    assert world.events()[3:] == ["worker terminated", "api terminated", "broker terminated"]
    assert all(is_gone(world.pid(name)) for name in ("broker", "api", "worker"))


def test_a_child_without_a_probe_holds_nothing_up(world: World) -> None:
    supervisor = world.start_ready(world.child("worker", ready_file=None), world.child("api", depends_on=["worker"]))
    assert stop(supervisor) == 0


def test_a_killed_child_starts_again_later_each_time_and_the_console_says_so(world: World) -> None:
    supervisor = world.start_ready(world.child("broker"), world.child("worker"))
    untouched = world.pid("broker")
    for delay in ("0.5 s", "1 s"):
        killed = world.pid("worker")
        os.kill(killed, signal.SIGKILL)
        wait_for(lambda killed=killed: world.pid("worker") != killed)
        assert f"worker was ended by SIGKILL; starting it again in {delay}." in world.console()
    assert "  worker | hello from worker" in world.console()
    assert str(world.folder / "logs" / "worker.log") in world.console()
    assert "  broker |" not in world.console()
    assert world.pid("broker") == untouched
    assert stop(supervisor) == 0


def test_what_a_dead_child_leaves_behind_goes_before_it_starts_again(world: World) -> None:
    body = f"""
import subprocess
if not Path("{world.folder}/left.pid").exists():
    left = subprocess.Popen([sys.executable, "-I", "-S", "-c", "import time; time.sleep(600)"])
    Path("{world.folder}/left.pid").write_text(str(left.pid))
    sys.exit(7)
"""
    supervisor = world.start(world.child("worker", body=body))
    left = world.pid("left")
    wait_for(lambda: world.events().count("worker started") == 2)
    assert is_gone(left)
    assert "worker ended with exit code 7" in world.console()
    assert stop(supervisor) == 0


def test_ctrl_c_in_the_terminal_reaches_the_supervisor_alone(world: World) -> None:
    supervisor = world.start_ready(world.child("api"))
    os.killpg(supervisor.pid, signal.SIGINT)  # what a terminal does
    assert supervisor.wait(TIMEOUT_S) == 0
    assert world.events() == ["api started", "api terminated"]


def test_a_second_ctrl_c_kills_at_once(world: World) -> None:
    supervisor = world.start_ready(world.child("worker", reaction="pass", grace_s=600))
    supervisor.send_signal(signal.SIGINT)
    wait_for(lambda: "worker terminated" in world.events())
    assert supervisor.poll() is None
    assert stop(supervisor, signal.SIGINT) == 0
    assert is_gone(world.pid("worker"))


def test_a_child_that_does_not_end_is_killed_after_its_grace(world: World) -> None:
    supervisor = world.start_ready(world.child("worker", reaction="pass", grace_s=0.3), world.child("api"))
    assert stop(supervisor) == 0
    assert "worker did not end within 0.3 s and is killed" in world.console()
    assert is_gone(world.pid("worker"))


def test_a_taken_port_is_named_before_anything_starts(world: World) -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as taken:
        port = taken.getsockname()[1]
        supervisor = world.start(
            world.child("broker"), world.child("api", listens_on=["127.0.0.1", port], port_remedy="Take another.")
        )
        assert supervisor.wait(TIMEOUT_S) == 3
    assert f"api cannot start: port {port} on 127.0.0.1 is in use by another program. Take another." in world.console()
    assert world.events() == []


def test_an_address_of_another_machine_is_named(world: World) -> None:
    supervisor = world.start(world.child("api", listens_on=["192.0.2.1", 8000]))
    assert supervisor.wait(TIMEOUT_S) == 3
    assert "api cannot start: port 8000 on 192.0.2.1 cannot be had" in world.console()


@pytest.mark.parametrize("ready_file", ["/nowhere/ready", None])
def test_a_child_that_never_starts_ends_everything_with_its_last_words(world: World, ready_file: str | None) -> None:
    broken = world.child("api", body="sys.exit('no such table: jobs')", ready_file=ready_file)
    supervisor = world.start(world.child("broker"), broken)
    assert supervisor.wait(TIMEOUT_S) == 3
    assert world.events().count("api started") == 3
    assert "api cannot start: it ended with exit code 1, 3 times." in world.console()
    assert world.console().rstrip().endswith("  api | no such table: jobs")
    assert world.events()[-1] == "broker terminated"


def test_a_program_that_is_not_there_is_named(world: World) -> None:
    supervisor = world.start(world.child("broker"), world.child("api", argv=["/nowhere/api"], depends_on=["broker"]))
    assert supervisor.wait(TIMEOUT_S) == 3
    assert "api cannot start: /nowhere/api: No such file or directory" in world.console()
    assert is_gone(world.pid("broker"))


def test_a_child_that_hangs_at_its_start_ends_everything(world: World) -> None:
    supervisor = world.start(world.child("api", ready_file=str(world.folder / "never"), start_timeout_s=0.5))
    assert supervisor.wait(TIMEOUT_S) == 3
    assert "api runs but is not ready after 0.5 s" in world.console()
    with exclusive_use(world.folder, timeout_s=0):  # every child holds the lock as long as it lives
        pass


GRANDCHILD = """
import subprocess
left = subprocess.Popen([sys.executable, "-I", "-S", "-c", "import time; time.sleep(600)"])
(folder / "grandchild.pid").write_text(str(left.pid))
"""


@pytest.mark.parametrize("also_the_guard", [False, True])
def test_a_killed_supervisor_takes_its_children_along(world: World, also_the_guard: bool) -> None:
    supervisor = world.start_ready(world.child("worker", body=GRANDCHILD), world.child("api", reaction="pass"))
    pids = [world.pid(name) for name in ("worker", "api", "grandchild")]
    guard = world.guard(supervisor)
    if also_the_guard:
        if sys.platform != "linux":
            pytest.skip("only Linux's kernel ends a child with its parent")
        pids.pop()  # the guard alone knows of it
        supervisor.send_signal(signal.SIGSTOP)  # so that it does not start another
        guard.kill()
    supervisor.kill()
    supervisor.wait()
    for pid in pids:
        wait_for(lambda pid=pid: is_gone(pid))
    wait_for(lambda: is_gone(guard.pid))
    if also_the_guard:
        os.kill(world.pid("grandchild"), signal.SIGKILL)


def test_a_killed_guard_is_replaced_and_knows_what_to_do(world: World) -> None:
    supervisor = world.start_ready(world.child("worker", body=GRANDCHILD))
    pids = [world.pid(name) for name in ("worker", "grandchild")]  # what was not begun cannot be left over
    first = world.guard(supervisor)
    first.kill()
    wait_for(lambda: is_gone(first.pid))
    second = wait_for(lambda: world.guard(supervisor))
    assert second.pid != first.pid
    supervisor.kill()
    supervisor.wait()
    for pid in pids:
        wait_for(lambda pid=pid: is_gone(pid))


def test_a_guard_knows_the_groups_it_is_started_with_before_it_is_told_any() -> None:
    waiting = [sys.executable, "-I", "-S", "-c", "input()"]
    with subprocess.Popen(waiting, stdin=subprocess.PIPE, process_group=0) as left:
        argv = [sys.executable, "-I", "-S", orphan_reaper.__file__, str(left.pid)]
        subprocess.run(argv, stdin=subprocess.DEVNULL, check=True, timeout=TIMEOUT_S)
        assert left.wait(TIMEOUT_S) == -signal.SIGKILL


def test_without_its_logs_it_goes_on(world: World) -> None:
    supervisor = world.start_ready(world.child("worker"))
    logs = world.folder / "logs"
    (logs / "worker.log").unlink()
    first = world.pid("worker")
    os.kill(first, signal.SIGKILL)
    wait_for(lambda: world.pid("worker") != first)
    assert "hello from worker" in wait_for((logs / "worker.log").read_text)
    shutil.rmtree(logs)
    logs.touch()  # no folder can be made in its place
    second = world.pid("worker")
    os.kill(second, signal.SIGKILL)
    wait_for(lambda: world.pid("worker") != second)
    assert stop(supervisor) == 0


def test_a_program_that_is_away_for_a_moment_is_started_when_it_is_back(world: World) -> None:
    """As while another version of it is installed."""
    child = world.child("worker")
    program = world.folder / "program"
    program.symlink_to(sys.executable)
    supervisor = world.start_ready({**child, "argv": [str(program), *child["argv"][1:]]})
    program.unlink()
    first = world.pid("worker")
    os.kill(first, signal.SIGKILL)
    wait_for(lambda: f"worker cannot start: {program}: No such file or directory; trying again" in world.console())
    program.symlink_to(sys.executable)
    wait_for(lambda: world.pid("worker") != first)
    assert stop(supervisor) == 0


def test_a_passing_lack_of_processes_ends_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the guard's too, whose first two starts fail here."""
    real, refused, said = subprocess.Popen, [], []

    def scarce(argv: list[str], **options: Any) -> subprocess.Popen[bytes]:
        if orphan_reaper.__file__ in argv and len(refused) < 2:
            refused.append(argv)
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        return real(argv, **options)

    monkeypatch.setattr("service.standalone.supervisor.subprocess.Popen", scarce)
    spec = ChildSpec(name="worker", argv=[sys.executable, "-I", "-S", "-c", "import time; time.sleep(600)"])

    def end() -> None:
        try:
            wait_for(lambda: len(guards_of(os.getpid())) == 1)
        finally:  # else the supervisor would run on
            os.kill(os.getpid(), signal.SIGTERM)

    ending = threading.Thread(target=end)
    Supervisor([spec], log_folder=tmp_path, say=said.append, on_ready=ending.start).run()
    ending.join()
    assert len(refused) == 2
    assert said == []


def test_what_keeps_a_child_from_starting_is_put_right(world: World) -> None:
    mend = world.folder / "mended"
    body = f"""
if not Path("{mend}").exists():
    print("the journal is damaged", flush=True)
    sys.exit(1)
"""
    never_before = world.folder / "ready"
    supervisor = world.start(
        world.child(
            "broker", body=body + f"Path('{never_before}').touch()", ready_file=str(never_before), mend=str(mend)
        )
    )
    wait_for(lambda: "ready\n" in world.console())
    assert "broker ended with exit code 1 at its start; mended: the journal is damaged" in world.console()
    assert stop(supervisor) == 0


ANSWERING = """
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer

class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def do_GET(self):
        self.send_response(200 if self.path == "/livez" else 404)
        self.send_header("Content-Length", "0")
        self.end_headers()

HTTPServer.allow_reuse_address = True
server = HTTPServer(("127.0.0.1", {port}), Handler)
threading.Thread(target=server.serve_forever, daemon=True).start()
(folder / "answers").touch()
"""


@pytest.mark.slow
def test_a_child_that_hangs_is_killed_and_starts_again(world: World) -> None:
    with closing(socket.socket()) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
    asked = {"ask_at": port, "ask_every_s": 1.0, "answer_within_s": 0.8, "ready_file": str(world.folder / "answers")}
    supervisor = world.start_ready(world.child("api", body=ANSWERING.format(port=port), **asked))
    first = world.pid("api")
    time.sleep(8)
    assert world.pid("api") == first
    os.kill(first, signal.SIGSTOP)
    wait_for(lambda: world.pid("api") != first)
    assert "api runs but has not answered 4 times, and is killed" in world.console()
    assert "api was ended by SIGKILL; starting it again" in world.console()
    assert stop(supervisor) == 0


def test_two_do_not_share_a_folder(world: World) -> None:
    first = world.start_ready(world.child("worker"))
    with (
        pytest.raises(DataFolderError, match=rf"in use by another .*process {first.pid}\).*another folder"),
        exclusive_use(world.folder, timeout_s=0.2),
    ):
        pass
    assert stop(first) == 0
    with exclusive_use(world.folder, timeout_s=0):
        pass


def test_a_new_one_starts_where_a_killed_one_was(world: World) -> None:
    first = world.start_ready(world.child("worker"))
    before = world.pid("worker")
    first.kill()
    first.wait()
    second = world.start_ready(world.child("worker"))
    assert world.pid("worker") != before
    assert is_gone(before)
    assert stop(second) == 0


def test_the_folder_stays_locked_while_anything_of_a_killed_run_lives(tmp_path: Path) -> None:
    with exclusive_use(tmp_path) as lock:
        left = subprocess.Popen([sys.executable, "-S", "-c", "import time; time.sleep(600)"], pass_fds=[lock])
    try:
        with pytest.raises(DataFolderError, match="in use"), exclusive_use(tmp_path, timeout_s=0.2):
            pass
    finally:
        left.kill()
        left.wait()
    with exclusive_use(tmp_path, timeout_s=0):
        pass
