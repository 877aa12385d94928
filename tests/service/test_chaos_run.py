"""The chaos benchmark's client, its killer and its verdict: what a run relies on, each alone."""

from __future__ import annotations

import http.server
import random
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from tests.benchmarks.chaos.checks import Findings
from tests.benchmarks.chaos.conversation import Board, CarefulClient, RefusedError, Try
from tests.benchmarks.chaos.drives import Sendable
from tests.benchmarks.chaos.ledger import Ledger
from tests.benchmarks.chaos.processes import Process, Role, identity_of, kill, role_of, tree_of
from tests.benchmarks.chaos.records import Records
from tests.benchmarks.chaos.report import MOST_HELD_S, out_of_bounds, table
from tests.benchmarks.chaos.sending import Sender
from tests.benchmarks.chaos.victims import Attempt, Kill, Purpose, counted, histogram, shares_of, was_near_a_publication
from tests.helpers.live_api import Client, sha256_of
from tests.helpers.tiny_drive import tiny_drive
from tests.service.conftest import StartApi

FILES = {"points.ply": b"ply"}


class _Faltering(http.server.BaseHTTPRequestHandler):
    """Breaks off, says that the request is in flight, asks for patience, and answers in the end."""

    protocol_version = "HTTP/1.1"
    seen: list[tuple[str | None, bytes]]
    answers: list[int]

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.seen.append((self.headers["Idempotency-Key"], body))
        status = self.answers.pop(0)
        if status == 0:
            self.close_connection = True
            return
        said = b'{"type": "urn:mrasfm:problem:request-in-flight"}' if status == 409 else b"{}"
        self.send_response(status)
        self.send_header("Content-Length", str(len(said)))
        self.end_headers()
        self.wfile.write(said)

    def log_message(self, format: str, *arguments: Any) -> None:
        """Nothing."""


@pytest.fixture
def faltering() -> Iterator[tuple[str, type[_Faltering]]]:
    """A server that answers as it is told, and its handler."""
    handler = type("Handler", (_Faltering,), {"seen": [], "answers": []})
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}", handler
        server.shutdown()
        thread.join()


def test_a_request_is_repeated_until_it_is_answered(faltering: tuple[str, type[_Faltering]]) -> None:
    url, handler = faltering
    handler.answers = [0, 409, 409, 503, 201]
    board = Board()
    client = CarefulClient(url, "key", board, threading.Event(), random.Random(1))
    try:
        answer = client.ask("commit", "POST", "/v1/x", headers={"Idempotency-Key": "k"}, data=b"all of it", seconds=0.1)
    finally:
        client.close()
    assert answer.status_code == 201
    assert handler.seen == [("k", b"all of it")] * 5
    assert board.outcomes == {"commit 201": 1, "commit 409": 2, "commit 503": 1, "commit broken": 1}
    assert 0 < board.longest_held_s < 60
    assert (board.held, board.under_way(["commit"])) == (0, [])


def test_a_refusal_is_not_repeated(faltering: tuple[str, type[_Faltering]]) -> None:
    url, handler = faltering
    handler.answers = [422]
    client = CarefulClient(url, "key", Board(), threading.Event(), random.Random(1))
    with pytest.raises(RefusedError, match="422"):
        client.ask("ask", "POST", "/v1/x", data=b"{}")
    client.close()


def test_requests_under_way_are_seen_with_their_connection(faltering: tuple[str, type[_Faltering]]) -> None:
    url, handler = faltering
    handler.answers = [200]
    board, seen = Board(), set()
    client = CarefulClient(url, "key", board, threading.Event(), random.Random(1))
    body = bytes(40_000)
    thread = threading.Thread(target=lambda: client.ask("put", "POST", "/v1/x", data=body, seconds=0.5))
    thread.start()
    while thread.is_alive():
        seen |= {asked.port for asked in board.under_way(["put"])}
        time.sleep(0.01)
    client.close()
    assert len(seen) == 1, "one connection, known while it is used"
    assert next(iter(seen)) > 0


@pytest.mark.parametrize("way", ["_put_files", "_put_archive", "_append_archive", "_append_files"])
def test_every_way_of_sending_brings_all_bytes(client: Client, way: str) -> None:
    tiny = tiny_drive(seed=f"{client.project_id}{way}")
    drive = Sendable(tiny.manifest["name"], tiny.raw, tiny.files)
    careful = CarefulClient(client.api.url, client.key, Board(), threading.Event(), random.Random(2))
    sender = Sender(careful, Ledger(), random.Random(3))
    drive_id = client.create(tiny)
    getattr(sender, way)(drive_id, drive, 0.2)
    careful.close()
    stored = {file["path"]: file["sha256"] for file in client.get(f"/v1/drives/{drive_id}/files").json()["items"]}
    assert stored == {path: sha256_of(data) for path, data in tiny.files.items()}


@pytest.fixture
def sleeper() -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    yield process
    process.kill()
    process.wait()


def seen_as(process: subprocess.Popen[bytes]) -> Process:
    while not (found := tree_of(process.pid)) or "time.sleep(60)" not in " ".join(found[0].command):
        time.sleep(0.01)
    return found[0]


def test_exactly_the_chosen_process_is_killed(sleeper: subprocess.Popen[bytes]) -> None:
    victim = seen_as(sleeper)
    earlier = replace(victim, identity=replace(victim.identity, started=victim.identity.started - 1))
    other = replace(victim, command=("another",))
    assert not kill(earlier), "the number had another process before"
    assert not kill(other)
    assert sleeper.poll() is None
    assert kill(victim)
    assert identity_of(victim.pid) is None
    assert sleeper.wait() == -9
    assert not kill(victim)


def process(role: Role, *command: str) -> Process:
    return Process(identity=identity_of(1), parent=0, command=command, role=role)


WORKER = ("python", "-P", "-m", "worker", "worker", "--queues", "reconstructions", "--concurrency", "2")
CHECKER = ("python", "-P", "-m", "worker", "worker", "--queues", "checks", "--concurrency", "1")


@pytest.mark.parametrize(
    ("parent", "command", "role"),
    [
        (process(Role.SUPERVISOR, "a"), ("python", "-I", "-S", "/x/orphan_reaper.py"), Role.GUARD),
        (process(Role.SUPERVISOR, "a"), ("valkey-server 127.0.0.1:20000",), Role.BROKER),
        (process(Role.SUPERVISOR, "a"), ("python", "-P", "-m", "service", "api"), Role.API),
        (process(Role.SUPERVISOR, "a"), WORKER, Role.WORKER),
        (process(Role.SUPERVISOR, "a"), CHECKER, Role.CHECKER),
        (process(Role.SUPERVISOR, "a"), ("python", "-P", "-m", "worker", "reconciler"), Role.RECONCILER),
        (process(Role.SUPERVISOR, "a"), ("a",), Role.STARTING),
        (process(Role.WORKER, *WORKER), WORKER, Role.WORKER_POOL),
        (process(Role.CHECKER, *CHECKER), CHECKER, Role.CHECKER_POOL),
        (process(Role.WORKER_POOL, *WORKER), WORKER, Role.STARTING),
        (process(Role.WORKER_POOL, *WORKER), ("python", "-P", "-m", "worker.child", "/x"), Role.ENGINE),
        (process(Role.API, "b"), ("python", "-c", "from multiprocessing.spawn import spawn_main"), Role.API_CHILD),
        (process(Role.API, "b"), ("python", "-c", "from multiprocessing.resource_tracker import"), Role.API_TRACKER),
        (process(Role.API_CHILD, "c"), ("python", "-m", "schemas"), Role.MANIFEST_READER),
    ],
)
def test_roles(parent: Process, command: tuple[str, ...], role: Role) -> None:
    assert role_of(command, parent) is role


def test_shares() -> None:
    of_200 = {Purpose.ENGINE: 60, Purpose.API: 60, Purpose.WORKER: 60, Purpose.PUBLICATION: 10, Purpose.OTHER: 10}
    assert shares_of(200) == of_200
    assert list(shares_of(10).values()) == [3, 3, 3, 1, 0]
    assert list(shares_of(1).values()) == [1, 1, 1, 1, 0]


def killed(role: Role, at_s: float, **known: Any) -> Kill:
    return Kill(purpose=Purpose.OTHER, role=role, under_way="preflight", at_s=at_s, **known)


def test_kills_count_for_what_they_were(start_api: StartApi) -> None:
    client = start_api().client()
    job = client.reconstruct(client.frozen())
    held = client.claim(job["id"])
    records = Records(client.api.settings.data_dir)
    before_s = time.time()
    result_s = before_s - 100.0
    attempt = Attempt(job["id"], held.fence, result_s)
    assert was_near_a_publication(killed(Role.WORKER, result_s + 0.9, attempt=attempt), records), "never recorded"
    assert not was_near_a_publication(killed(Role.WORKER, result_s + 1.1, attempt=attempt), records)
    client.publish(held, FILES)
    assert not was_near_a_publication(killed(Role.WORKER, result_s + 0.9, attempt=attempt), records), "recorded later"
    (published_s,) = records.published_s()
    assert before_s < published_s < time.time()
    assert was_near_a_publication(killed(Role.BROKER, published_s - 0.9), records)
    assert not was_near_a_publication(killed(Role.BROKER, published_s - 1.1), records)

    answered = Try("put", began_s=10.0, port=1, ended_s=11.0)
    kills = [
        killed(Role.API, 10.5, request=answered),
        killed(Role.API_CHILD, 11.5, request=answered),
        killed(Role.ENGINE, 10.5),
        killed(Role.CHECKER_POOL, published_s),
    ]
    assert list(counted(kills, records).values()) == [1, 1, 1, 1]
    assert histogram(kills)["engine"] == {"preflight": 1}
    assert "    1 engine\n          1 preflight" in table(histogram(kills))


SOUND = {
    "kills": 10,
    "kills_missing": {},
    "ended_by_itself": [],
    "broken_promises": [],
    "longest_held_s": MOST_HELD_S,
    **dict.fromkeys(vars(Findings()), 0),
}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("kills", 9),
        ("kills_missing", {"engine": 1}),
        ("ended_by_itself", ["error"]),
        ("broken_promises", ["refused"]),
        ("longest_held_s", MOST_HELD_S + 1),
        *((name, 1) for name in vars(Findings())),
    ],
)
def test_any_figure_out_of_bounds_fails_the_run(name: str, value: object) -> None:
    assert out_of_bounds(SOUND, wanted=10) == []
    assert out_of_bounds({**SOUND, name: value}, wanted=10) == [name]
