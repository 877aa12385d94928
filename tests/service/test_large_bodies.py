"""Large bodies: one project does not keep the others out, and none holds a place without sending."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress

import anyio
import httpx
import pytest
from starlette.types import Message

from service.api.app import create_app
from service.api.http import body_reading
from service.api.manifests.bounded_process import LARGE_BYTES
from tests.helpers.live_api import Api, Client, problem_of, wait_until
from tests.helpers.tiny_drive import tiny_drive

LARGE = tiny_drive().raw + b" " * LARGE_BYTES
ANNOUNCED_BYTES = 9_000_000


class SlowBody:
    """A large body that came in part, and hardly goes on."""

    def __init__(self, client: Client) -> None:
        head = f"POST /v1/drives HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {client.key}\r\n"
        self._connection = socket.create_connection((client.base_url.host, client.base_url.port or 80), timeout=30)
        self._connection.sendall(f"{head}Content-Length: {ANNOUNCED_BYTES}\r\n\r\n".encode() + LARGE)

    def drip(self) -> None:
        """Send one byte, if it is still taken."""
        with suppress(OSError):
            self._connection.send(b" ")

    def answer(self) -> httpx.Response:
        received = b""
        try:
            while data := self._connection.recv(65536):
                received += data
        except ConnectionResetError:
            assert received, "no answer"
        head, _, body = received.partition(b"\r\n\r\n")
        status, *lines = head.decode().split("\r\n")
        headers = [(name, value) for name, _, value in (line.partition(": ") for line in lines)]
        return httpx.Response(int(status.split()[1]), headers=headers, content=body)

    def close(self) -> None:
        self._connection.close()


@contextmanager
def dripping(bodies: list[SlowBody]) -> Iterator[None]:
    """All of them send a byte now and then."""
    over = threading.Event()

    def drip() -> None:
        while not over.wait(0.05):
            for body in bodies:
                body.drip()

    thread = threading.Thread(target=drip)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@contextmanager
def slow_bodies(*clients: Client) -> Iterator[list[SlowBody]]:
    """One of each client; all hold a place or wait for one, in this order."""
    places = clients[0].api.context.large_bodies
    with ExitStack() as stack:
        bodies = []
        for client in clients:
            here = len(bodies) + 1
            bodies.append(SlowBody(client))
            stack.callback(bodies[-1].close)
            wait_until(lambda here=here: places.held + places.waiting == here, "the body's beginning")
        yield bodies
    wait_until(lambda: (places.held, places.waiting) == (0, 0), "the end of their turns")


def seconds_of_a_large_one(client: Client, timeout_s: float) -> float:
    started_s = time.perf_counter()
    assert client.post("/v1/drives", content=LARGE, timeout=timeout_s).status_code == 201
    return time.perf_counter() - started_s


@pytest.mark.slow
def test_slow_bodies_of_one_key_hold_up_no_other_project(api: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    alone_s = seconds_of_a_large_one(api.client(), 60)
    monkeypatch.setattr(body_reading, "_GRACE_S", 600.0)
    places = api.context.large_bodies
    slow = api.client()
    with slow_bodies(*[slow] * 12) as bodies, dripping(bodies):
        assert places.held <= 2
        assert seconds_of_a_large_one(api.client(), 30) < 5 * alone_s + 2
        assert places.waiting == 10, "the slow ones were there all the time"
        monkeypatch.setattr(body_reading, "_GRACE_S", 0.4)
        monkeypatch.setattr(body_reading, "_MIN_RATE_BYTES_S", 100_000_000)
        for body in bodies:
            problem = problem_of(body.answer(), 408, "too-slow")
            assert "100000 kB/s" in problem["detail"]
            assert "faster connection" in problem["remedy"]
    assert slow.get("/v1/drives").json()["items"] == []


def test_a_slow_body_that_comes_fast_enough_is_taken(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    """The rate is an average: a pause after a burst is fine, and so is a pause at the beginning."""
    monkeypatch.setattr(body_reading, "_GRACE_S", 0.3)
    monkeypatch.setattr(body_reading, "_MIN_RATE_BYTES_S", 1_000_000)

    def in_bursts() -> Iterator[bytes]:
        yield LARGE
        yield b" " * 1_000_000
        time.sleep(0.6)
        yield b" "

    assert client.post("/v1/drives", content=in_bursts()).status_code == 201


def test_waiting_for_a_place_does_not_count_as_slowness(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    places = client.api.context.large_bodies
    with slow_bodies(client, client) as holding:
        monkeypatch.setattr(body_reading, "_GRACE_S", 0.5)
        monkeypatch.setattr(body_reading, "_MIN_RATE_BYTES_S", 1_000_000_000)
        with ThreadPoolExecutor(1) as pool:
            answer = pool.submit(client.post, "/v1/drives", content=LARGE + b" " * 1_000_000)
            wait_until(lambda: places.waiting == 1, "the third")
            time.sleep(0.8)
            holding[0].close()
            assert answer.result().status_code == 201, answer.result().text


def test_who_waits_too_long_is_told_when_to_come_again(api: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(body_reading, "_PLACE_WITHIN_S", 0.2)
    one, other = api.client(), api.client()
    with slow_bodies(one, one):
        answer = one.post("/v1/drives", content=LARGE)
        problem_of(answer, 429, "too-many-large-bodies")
        assert int(answer.headers["retry-after"]) > 0
        with ExitStack() as stack:
            for _ in range(2):
                stack.callback(SlowBody(other).close)
            wait_until(lambda: api.context.large_bodies.held == 4, "four bodies")
            answer = api.client().post("/v1/drives", content=LARGE)
        problem_of(answer, 503, "busy")
        assert int(answer.headers["retry-after"]) > 0


def test_without_a_key_no_place_is_asked_for(api: Api) -> None:
    answer = httpx.post(f"{api.url}/v1/drives", content=LARGE)
    problem_of(answer, 401, "unauthorized")
    assert api.context.large_bodies.held == 0


def test_who_does_not_read_answers_holds_no_place(api: Api) -> None:
    """An answer waits until its client takes it; the place of the body does not."""
    client = api.client()
    app = create_app(api.settings)
    places = app.state.context.large_bodies
    held: list[tuple[int, int]] = []

    async def receive() -> Message:
        return {"type": "http.request", "body": LARGE, "more_body": False}

    async def send(message: Message) -> None:
        if message["type"] == "http.response.start":
            assert message["status"] == 201
            held.append((places.held, app.state.context.large_documents.held))

    scope = {
        "type": "http",
        "http_version": "1.1",
        "method": "POST",
        "path": "/v1/drives",
        "raw_path": b"/v1/drives",
        "query_string": b"",
        "headers": [(b"authorization", f"Bearer {client.key}".encode())],
        "app": app,
    }
    anyio.run(app, scope, receive, send)
    app.state.context.close()
    assert held == [(0, 0)]


def test_no_body_holds_a_place_without_end(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(body_reading, "_WITHIN_S", 0.3)
    with slow_bodies(client) as (body,), dripping([body]):
        problem_of(body.answer(), 408, "too-slow")
