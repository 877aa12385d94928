"""The embedded broker, with the real server and the real clients."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import kombu
import psutil
import pytest
import redis
from redis.backoff import NoBackoff
from redis.retry import Retry

from service.standalone import broker
from service.standalone.child_log import TAIL_LINES
from service.storage.data_folder import DataFolderError

Start = Callable[[broker.EmbeddedBroker], subprocess.Popen[bytes]]


@pytest.fixture
def start() -> Iterator[Start]:
    """A function that starts a broker and waits until it answers; all are killed in the end."""
    started: list[subprocess.Popen[bytes]] = []

    def run(prepared: broker.EmbeddedBroker) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(prepared.argv, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        started.append(process)
        deadline_s = time.monotonic() + 60
        while not broker.is_up(prepared.url):
            assert process.poll() is None, "the server ended"
            assert time.monotonic() < deadline_s, "the server does not answer"
            time.sleep(0.05)
        return process

    yield run
    for process in started:
        process.kill()
        process.wait()


def kill(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGKILL)
    process.wait()


def put(url: str) -> None:
    with redis.Redis.from_url(url) as client:
        client.rpush("plain", "one", "two")
    with kombu.Connection(url) as connection, closing(connection.SimpleQueue("jobs")) as queue:
        queue.put({"job": "job_1"})
    # While the disk is slow to sync, the server holds writes back for up to two seconds. Jobs among them would be
    # enqueued again by the reconciler; here it is what was written that counts.
    with redis.Redis.from_url(url) as client:
        deadline_s = time.monotonic() + 30
        while client.info("persistence")["aof_buffer_length"]:
            assert time.monotonic() < deadline_s, "the server does not write"
            time.sleep(0.05)


def what_is_there(url: str) -> tuple[list[bytes], dict[str, str]]:
    with redis.Redis.from_url(url) as client:
        plain = client.lrange("plain", 0, -1)
    with kombu.Connection(url) as connection, closing(connection.SimpleQueue("jobs")) as queue:
        message = queue.get(timeout=30)
        payload = message.payload
        message.requeue()
    return plain, payload


def test_queued_messages_survive_a_killed_server(tmp_path: Path, start: Start) -> None:
    before = broker.prepare(tmp_path / "broker")
    process = start(before)
    put(before.url)
    kill(process)
    assert not broker.is_up(before.url)

    after = broker.prepare(tmp_path / "broker")
    start(after)
    assert after == before  # clients that are still running reconnect by the same URL
    assert what_is_there(after.url) == ([b"one", b"two"], {"job": "job_1"})


def test_a_half_written_last_command_does_not_stop_the_server(tmp_path: Path, start: Start) -> None:
    prepared = broker.prepare(tmp_path / "broker")
    process = start(prepared)
    put(prepared.url)
    kill(process)
    (journal,) = (tmp_path / "broker").rglob("*.incr.aof")
    with journal.open("ab") as file:
        file.write(b"*3\r\n$5\r\nRPUSH\r\n$5\r\npla")
    start(prepared)
    assert what_is_there(prepared.url) == ([b"one", b"two"], {"job": "job_1"})


def half_a_block(files: Path) -> None:
    """What a power cut leaves of a file whose size was written before its data."""
    (journal,) = files.glob("*.incr.aof")
    with journal.open("ab") as file:
        file.write(bytes(512))


def overwritten(files: Path) -> None:
    (journal,) = files.glob("*.incr.aof")
    journal.write_bytes(b"*2\r\n$7\r\nNONSENSE\r\n" + journal.read_bytes()[20:])


def base_lost(files: Path) -> None:
    (base,) = files.glob("*.base.*")
    base.unlink()


def manifest_overwritten(files: Path) -> None:
    (manifest,) = files.glob("*.manifest")
    manifest.write_bytes(bytes(manifest.stat().st_size))


@pytest.mark.parametrize("damage", [half_a_block, overwritten, base_lost, manifest_overwritten])
def test_a_damaged_journal_is_moved_out_of_the_way(
    tmp_path: Path, start: Start, damage: Callable[[Path], None]
) -> None:
    folder = tmp_path / "broker"
    for _ in range(2):  # the copy of the first damage makes way for that of the second
        prepared = broker.prepare(folder)
        process = start(prepared)
        put(prepared.url)
        kill(process)
        damage(folder / broker.JOURNAL)
        ended = subprocess.run(prepared.argv, capture_output=True, text=True, timeout=60, check=False)
        assert ended.returncode > 0
        done = broker.set_damaged_journal_aside(folder, ended.stdout.splitlines()[-TAIL_LINES:])
        assert done is not None, ended.stdout
        assert str(folder / broker.JOURNAL_SET_ASIDE) in done
        assert any((folder / broker.JOURNAL_SET_ASIDE).iterdir())
        process = start(prepared)
        with redis.Redis.from_url(prepared.url) as client:
            assert client.keys() == []
        kill(process)


@pytest.mark.parametrize(
    "last_line",
    [
        "",
        "Failed listening on port 6379 (tcp), aborting.",
        "Can't open or create append-only dir appendonlydir: No space left on device",
    ],
)
def test_a_sound_journal_stays(tmp_path: Path, start: Start, last_line: str) -> None:
    prepared = broker.prepare(tmp_path / "broker")
    process = start(prepared)
    put(prepared.url)
    kill(process)
    assert broker.set_damaged_journal_aside(tmp_path / "broker", [last_line]) is None
    start(prepared)
    assert what_is_there(prepared.url) == ([b"one", b"two"], {"job": "job_1"})


def test_nothing_is_dropped_and_everything_is_written_down(tmp_path: Path, start: Start) -> None:
    prepared = broker.prepare(tmp_path / "broker")
    start(prepared)
    with redis.Redis.from_url(prepared.url, decode_responses=True) as client:
        names = ("appendonly", "appendfsync", "maxmemory-policy", "save", "aof-load-truncated", "dir")
        values = client.config_get(*names)
    assert values == {
        "appendonly": "yes",
        "appendfsync": "everysec",
        "maxmemory-policy": "noeviction",
        "save": "",
        "aof-load-truncated": "yes",
        "dir": str(tmp_path / "broker"),
    }


def test_only_who_knows_the_password_is_let_in(tmp_path: Path, start: Start) -> None:
    prepared = broker.prepare(tmp_path / "broker")
    start(prepared)
    for password in ("wrong", None):
        with (
            redis.Redis(host=broker.HOST, port=prepared.port, password=password, retry=Retry(NoBackoff(), 0)) as client,
            pytest.raises(redis.AuthenticationError),
        ):
            client.ping()
    assert not broker.is_up(f"redis://:wrong@{broker.HOST}:{prepared.port}/0")


def test_the_password_shows_nowhere(tmp_path: Path, start: Start) -> None:
    prepared = broker.prepare(tmp_path / "broker")
    process = psutil.Process(start(prepared).pid)
    password = (tmp_path / "broker" / "password").read_text(encoding="ascii")
    assert len(password) >= 40
    assert password in prepared.url
    assert password not in repr(prepared)
    assert password not in " ".join([*prepared.argv, *process.cmdline(), *process.environ().values()])
    for path in (tmp_path / "broker").iterdir():
        if path.is_file():
            assert path.stat().st_mode & 0o077 == 0, path
    assert (tmp_path / "broker").stat().st_mode & 0o777 == 0o700


def test_passwords_differ_between_folders(tmp_path: Path) -> None:
    for name in ("one", "two"):
        broker.prepare(tmp_path / name)
    assert (tmp_path / "one" / "password").read_bytes() != (tmp_path / "two" / "password").read_bytes()


def test_it_listens_on_loopback_alone(tmp_path: Path, start: Start) -> None:
    process = psutil.Process(start(broker.prepare(tmp_path / "broker")).pid)
    listening = [c.laddr for c in process.net_connections("all") if c.status in (psutil.CONN_LISTEN, psutil.CONN_NONE)]
    assert [address.ip for address in listening] == [broker.HOST]


def test_a_port_that_another_program_took_is_replaced_and_kept(tmp_path: Path, start: Start) -> None:
    before = broker.prepare(tmp_path / "broker")
    with closing(socket.create_server((broker.HOST, before.port))):
        after = broker.prepare(tmp_path / "broker")
        assert after.port != before.port
    assert after.port in broker.PORTS
    assert broker.prepare(tmp_path / "broker").port == after.port
    start(after)


@pytest.mark.parametrize("content", ["", "no number", "80", "999999"])
def test_a_spoilt_port_file_is_replaced(tmp_path: Path, content: str) -> None:
    broker.prepare(tmp_path / "broker")
    (tmp_path / "broker" / "port").write_text(content, encoding="ascii")
    assert broker.prepare(tmp_path / "broker").port in broker.PORTS


@pytest.mark.parametrize("name", ['with space, "quotes" and \\', "Straße", "long" * 40])
def test_any_folder_name_works(tmp_path: Path, start: Start, name: str) -> None:
    prepared = broker.prepare(tmp_path / name)
    start(prepared)
    put(prepared.url)
    assert any((tmp_path / name).rglob("*.aof"))


def test_an_installed_server_is_preferred(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    packaged = broker.find_server()
    assert packaged.name == "valkey-server"
    assert packaged.parent != tmp_path
    for name in ("redis-server", "valkey-server"):  # the later one wins over the earlier
        (tmp_path / name).symlink_to(packaged)
        assert broker.find_server() == tmp_path / name


def test_without_any_server_the_message_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(broker, "files", lambda name: None)  # as where the package lists no files
    with pytest.raises(broker.BrokerServerError, match=r"Install one of them, or set MRASFM_REDIS_URL"):
        broker.prepare(tmp_path / "broker")


def test_a_file_in_the_folder_s_place_is_named(tmp_path: Path) -> None:
    (tmp_path / "broker").write_text("", encoding="ascii")
    with pytest.raises(DataFolderError, match=str(tmp_path / "broker")):
        broker.prepare(tmp_path / "broker")


def test_no_half_written_file_stays(tmp_path: Path) -> None:
    broker.prepare(tmp_path / "broker")
    assert sorted(os.listdir(tmp_path / "broker")) == ["broker.conf", "password", "port"]
