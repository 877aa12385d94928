"""A broker that is down or goes without a word, and a worker whose store is not to be had."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest
from pydantic import SecretStr

from service.database.tables import Project
from service.domain.keys import create_key
from service.job_queue import JobQueue, task_id
from service.settings import Settings
from tests.helpers.live_api import api_process
from tests.helpers.service_world import FAST, TERMINAL, World, environment_of, wait_until


class Proxy:
    """Passes TCP connections on until they are cut: then they stay open, and nothing comes through any more."""

    def __init__(self, port: int) -> None:
        self._target = ("127.0.0.1", port)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self._open: list[socket.socket] = []
        self._cut: set[socket.socket] = set()
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        """What is connected now goes silent; new connections work."""
        self._cut.update(self._open)

    def close(self) -> None:
        for each in (self._listener, *self._open):
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()

    def _accept(self) -> None:
        with suppress(OSError):  # closed
            while True:
                pair = self._listener.accept()[0], socket.create_connection(self._target)
                self._open += pair
                for source, sink in (pair, pair[::-1]):
                    threading.Thread(target=self._pass_on, args=(source, sink), daemon=True).start()

    def _pass_on(self, source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(65536):
                if source not in self._cut:
                    sink.sendall(data)
            if source not in self._cut:
                sink.shutdown(socket.SHUT_WR)


@pytest.fixture
def proxy(world: World) -> Iterator[Proxy]:
    """Between the broker and all who are given the world's settings."""
    port = urlsplit(world.broker.url).port
    assert port is not None
    with closing(Proxy(port)) as made:
        url = world.broker.url.replace(f":{port}/", f":{made.port}/")
        world.settings = world.settings.model_copy(update={"redis_url": SecretStr(url)})
        yield made


@pytest.mark.slow
@pytest.mark.parametrize("at_work", [False, True])
def test_broker_that_goes_without_a_word(world: World, proxy: Proxy, brief_drive: Path, at_work: bool) -> None:
    """As behind a network that was cut: no connection ends, and none ever answers."""
    worker = world.start_worker("checks")
    world.start_reconciler()
    first = check(world, brief_drive) if at_work else ""
    stage = world.hold(first) if at_work else None
    time.sleep(2)  # it waits for messages
    proxy.cut()
    if stage is not None:
        time.sleep(world.settings.visibility_timeout_seconds)
        stage.resume()
        assert world.wait_for_end(first).state == "SUCCEEDED"
        assert world.outcomes(first) == ["succeeded"]
    second = check(world, brief_drive, wake=False)
    took_s = wait_until(lambda: world.job(second).state != "QUEUED", world.log, within_s=60)
    print(f"the next job began after {took_s:.1f} s")  # 12 s on an idle machine
    assert world.wait_for_end(second).state == "SUCCEEDED"
    proxy.cut()
    worker.terminate()
    worker.wait(60)


@pytest.mark.slow
def test_reconstruction_asked_for_while_the_broker_is_down(
    make_world: Callable[..., World], brief_drive: Path, tmp_path: Path
) -> None:
    """Accepted over HTTP, and done when the broker is back, whose every message may be lost."""
    world = make_world(reconcile_seconds=Settings().reconcile_seconds)
    world.start_worker()
    world.start_reconciler()
    drive_id = world.add_drive(brief_drive)
    with world.database.write() as session:
        key = create_key(session, session.get_one(Project, world.project_id), "test")[1]
    with (
        api_process(world.settings, tmp_path, **environment_of(world.settings)) as api,
        httpx.Client(base_url=api.url, headers={"Authorization": f"Bearer {key}"}, timeout=60) as client,
    ):
        world.broker.kill()
        accepted = client.post("/v1/reconstructions", json={"drive_id": drive_id, "settings": FAST})
        assert accepted.status_code == 202, accepted.text
        assert accepted.headers["Retry-After"]
        where = accepted.headers["Location"]
        assert client.get("/v1/status").json()["broker"] is False
        time.sleep(world.settings.lease_seconds)
        assert client.get(where).json()["state"] == "QUEUED"

        world.broker.start()
        job_queue = JobQueue(world.settings)
        job_id = accepted.json()["id"]
        wait_until(
            lambda: world.job(job_id).state != "QUEUED" or task_id(world.job(job_id)) in job_queue.waiting(),
            "its message",
            within_s=30,
        )
        wait_until(lambda: client.get(where).json()["state"] in TERMINAL, world.log, within_s=300)
        job = client.get(where).json()
        assert job["state"] == "SUCCEEDED", job
        assert len(job["attempts"]) == 1
        assert [scene["job_id"] for scene in client.get("/v1/scenes").json()["items"]] == [job_id]


@pytest.mark.slow
@pytest.mark.parametrize("begin", [Path.touch, Path.mkdir], ids=["no folder can be made", "the disk is not mounted"])
def test_store_that_is_not_to_be_had(
    world: World, brief_drive: Path, tmp_path: Path, begin: Callable[[Path], None]
) -> None:
    """A worker without it leaves jobs to the others, and works as soon as it has it."""
    mount = tmp_path / "mount"
    begin(mount)
    settings = world.settings.model_copy(update={"artifacts_url": f"file://{mount}/store"})
    first = check(world, brief_drive)
    without = world.start_worker("checks", settings=settings)
    wait_until(lambda: tries(world) >= 2, world.log)
    assert (world.job(first).state, world.attempts(first)) == ("QUEUED", [])
    other = world.start_worker("checks")
    assert world.wait_for_end(first).state == "SUCCEEDED"
    assert world.outcomes(first) == ["succeeded"]
    other.terminate()
    other.wait(60)

    if mount.is_file():
        mount.unlink()
        mount.mkdir()
    (mount / "store").symlink_to(world.settings.data_dir.resolve() / "artifacts")
    assert world.wait_for_end(check(world, brief_drive)).state == "SUCCEEDED"
    assert without.poll() is None
    assert tries(world) < 10, "it takes its time between two"


def check(world: World, drive: Path, *, wake: bool = True) -> str:
    """Have a drive checked, which takes less time than a reconstruction; the job."""
    _, job_id = world.add_unchecked_drive(drive)
    if wake:
        world.wake(job_id)
    return job_id


def tries(world: World) -> int:
    return world.log().count('"this worker cannot work: ')
