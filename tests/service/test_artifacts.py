"""The artifact store, in a folder and in S3."""

from __future__ import annotations

import asyncio
import errno
import hashlib
import os
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import obstore
import pytest
from obstore.exceptions import BaseError

from service.settings import Settings
from service.storage import artifacts
from service.storage.artifacts import ArtifactStore
from service.storage.transfers import fetch_each
from tests.helpers.live_api import HOST, free_port, settings_of
from tests.helpers.s3_server import s3_server, settings_of_bucket
from worker.retry import may_pass, retry

CONTENT = os.urandom(3_000_000)
SHA256 = hashlib.sha256(CONTENT).hexdigest()
KEY = f"blobs/prj_1/{SHA256[:2]}/{SHA256}-0001"


@pytest.fixture(scope="session")
def s3_endpoint() -> Iterator[str]:
    with s3_server() as url:
        yield url


def new_store(settings: Settings) -> ArtifactStore:
    """A store in which nothing has been stored yet."""
    return ArtifactStore(settings, is_new=lambda: True)


@pytest.fixture(params=["folder", "s3"])
def store_settings(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Settings:
    if request.param == "folder":
        return settings_of(tmp_path / "data")
    endpoint = request.getfixturevalue("s3_endpoint")
    return settings_of(tmp_path / "data", **settings_of_bucket(endpoint, tmp_path.name, monkeypatch))


@pytest.fixture
def store(store_settings: Settings) -> ArtifactStore:
    return new_store(store_settings)


@pytest.fixture
def stored(store: ArtifactStore, tmp_path: Path) -> ArtifactStore:
    """A store with one object."""
    put(store, tmp_path / "scratch", CONTENT, KEY)
    return store


def put(store: ArtifactStore, path: Path, content: bytes, key: str) -> None:
    path.write_bytes(content)
    store.put_file(path, key)
    assert not path.exists()


def read(store: ArtifactStore, start: int, stop: int) -> bytes:
    async def collect() -> bytes:
        return b"".join([piece async for piece in store.stream(KEY, start=start, stop=stop)])

    return asyncio.run(collect())


def test_what_was_stored_is_read_again(stored: ArtifactStore) -> None:
    assert stored.read(KEY) == CONTENT
    assert [item.key for item in stored.objects()] == [KEY]


@pytest.mark.parametrize(
    ("start", "stop"), [(0, 1), (0, len(CONTENT)), (1_048_575, 1_048_577), (len(CONTENT) - 1, len(CONTENT)), (5, 5)]
)
def test_parts_are_streamed(stored: ArtifactStore, start: int, stop: int) -> None:
    assert read(stored, start, stop) == CONTENT[start:stop]


def test_a_fetched_file_is_the_object_and_cannot_be_written(stored: ArtifactStore, tmp_path: Path) -> None:
    targets = [tmp_path / "one", tmp_path / "two"]
    for target in targets:
        stored.fetch(KEY, target)
        assert target.read_bytes() == CONTENT
        assert target.stat().st_mode & 0o222 == 0, "a stage cannot change what is stored"
        target.unlink()
    assert stored.read(KEY) == CONTENT


def test_many_objects_are_fetched_at_one_time(store: ArtifactStore, tmp_path: Path) -> None:
    contents = {f"blobs/prj_1/{n:02d}/{n}": os.urandom(10_000 + n) for n in range(40)}
    for key, content in contents.items():
        put(store, tmp_path / "scratch", content, key)
    fetch_each(store.fetch, [(key, tmp_path / "fetched" / Path(key).name) for key in contents])
    for key, content in contents.items():
        assert (tmp_path / "fetched" / Path(key).name).read_bytes() == content


def test_what_is_not_there(store: ArtifactStore, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        store.read(KEY)
    with pytest.raises(artifacts.ObjectMissingError):
        store.fetch(KEY, tmp_path / "x")
    assert not (tmp_path / "x").exists()
    with pytest.raises(artifacts.ObjectMissingError):
        store.fetch(KEY, tmp_path / "no folder" / "x")
    with pytest.raises(FileNotFoundError):
        read(store, 0, 5)
    store.delete([KEY])


def test_a_target_without_a_folder_is_no_missing_object(stored: ArtifactStore, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError) as raised:
        stored.fetch(KEY, tmp_path / "no folder" / "x")
    assert not isinstance(raised.value, artifacts.ObjectMissingError)
    assert stored.read(KEY) == CONTENT


def test_deleted_objects_are_gone(stored: ArtifactStore, tmp_path: Path) -> None:
    put(stored, tmp_path / "b", b"b", "blobs/other")
    stored.delete([KEY, "blobs/never"])
    assert [item.key for item in stored.objects()] == ["blobs/other"]


def test_objects_say_when_they_came(stored: ArtifactStore) -> None:
    (item,) = stored.objects()
    assert item.changed_us > 1_700_000_000_000_000, "not the time that is made of the content"


def test_a_store_that_can_be_written(store: ArtifactStore) -> None:
    store.require_writable()
    assert list(store.objects()) == []


@pytest.fixture
def twenty(tmp_path: Path) -> list[tuple[Path, str]]:
    """Files that are to be objects."""
    files = [(tmp_path / f"{i}", f"blobs/{i}") for i in range(20)]
    for path, key in files:
        path.write_text(key)
    return files


class SlowPuts:
    """`obstore.put`, which takes a while; counts those under way."""

    def __init__(self, failing: str | None = None) -> None:
        self._put, self._failing, self._lock = obstore.put, failing, threading.Lock()
        self.under_way = self.most = 0

    def __call__(self, store: Any, key: str, path: Path, **options: Any) -> None:
        with self._lock:
            self.under_way += 1
            self.most = max(self.most, self.under_way)
        try:
            time.sleep(0.05)
            if key == self._failing:
                raise OSError("the store is away")
            self._put(store, key, path, **options)
        finally:
            with self._lock:
                self.under_way -= 1


def test_many_files_are_put_at_one_time(
    store: ArtifactStore, twenty: list[tuple[Path, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    puts = SlowPuts()
    monkeypatch.setattr(obstore, "put", puts)
    store.put_files(twenty)
    assert {key: store.read(key).decode() for _, key in twenty} == {key: key for _, key in twenty}
    assert not any(path.exists() for path, _ in twenty)
    assert puts.most == (8 if store.folder is None else 0)


@pytest.mark.parametrize("put_at", ["put_file", "put_files"])
def test_few_parts_of_a_large_file_are_in_memory(
    store: ArtifactStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, put_at: str
) -> None:
    """By default 60 MB of each: forty requests that end at one time would hold 2.4 GB."""
    (path := tmp_path / "large").write_bytes(bytes(12 << 20))
    asked: list[dict[str, Any]] = []
    put_now = obstore.put

    def put(*given: Any, **options: Any) -> None:
        asked.append(options)
        put_now(*given, **options)

    monkeypatch.setattr(obstore, "put", put)
    if put_at == "put_file":
        store.put_file(path, KEY)
    else:
        store.put_files([(path, KEY)])
    assert asked == ([] if store.folder is not None else [{"max_concurrency": 2}])
    assert store.sha256_of(KEY) == hashlib.sha256(bytes(12 << 20)).hexdigest()
    assert not path.exists()


def test_a_put_that_fails_leaves_none_under_way(
    store: ArtifactStore, twenty: list[tuple[Path, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who takes back what is there finds all of it."""
    if store.folder is not None:
        twenty[3][0].unlink()
        with pytest.raises(FileNotFoundError):
            store.put_files(twenty)
        return
    puts = SlowPuts(failing=twenty[3][1])
    monkeypatch.setattr(obstore, "put", puts)
    with pytest.raises(OSError, match="the store is away"):
        store.put_files(twenty)
    assert puts.under_way == 0
    store.delete([key for _, key in twenty])
    time.sleep(0.1)
    assert list(store.objects()) == []


@pytest.fixture
def other_disk(tmp_path: Path) -> Iterator[Path]:
    """A folder on another file system than `tmp_path`."""
    other = Path("/dev/shm")
    if not other.is_dir() or other.stat().st_dev == tmp_path.stat().st_dev:
        pytest.skip("no second file system")
    with tempfile.TemporaryDirectory(dir=other) as folder:
        yield Path(folder)


def test_a_folder_on_another_disk(tmp_path: Path, other_disk: Path) -> None:
    """Where a rename is not possible the bytes are copied, and the copy is whole or not there."""
    store = new_store(settings_of(tmp_path / "data"))
    put(store, other_disk / "adopted", CONTENT, KEY)
    assert store.read(KEY) == CONTENT
    assert [item.key for item in store.objects()] == [KEY]
    store.fetch(KEY, other_disk / "fetched")
    assert (other_disk / "fetched").read_bytes() == CONTENT


def test_a_copy_to_another_disk_says_which_of_the_two_is_missing(tmp_path: Path, other_disk: Path) -> None:
    store = new_store(settings_of(tmp_path / "data"))
    put(store, tmp_path / "scratch", CONTENT, KEY)
    with pytest.raises(FileNotFoundError) as raised:
        store.fetch(KEY, other_disk / "no folder" / "x")
    assert not isinstance(raised.value, artifacts.ObjectMissingError)
    with pytest.raises(artifacts.ObjectMissingError):
        store.fetch("blobs/never", other_disk / "x")
    assert list(other_disk.iterdir()) == []


class FailingSync:
    """`os.fsync` of a disk that fails once, at the nth call."""

    def __init__(self, nth: int) -> None:
        self._fsync, self._left = os.fsync, nth

    def __call__(self, descriptor: int) -> None:
        self._left -= 1
        if self._left == 0:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        self._fsync(descriptor)


@pytest.mark.parametrize("nth", [1, 2, 3])
@pytest.mark.parametrize("keys", [[KEY, KEY], [KEY, f"{KEY}-again"]])
@pytest.mark.parametrize("beside", [True, False])
def test_a_disk_that_fails_for_a_moment_loses_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, nth: int, keys: list[str], beside: bool
) -> None:
    """The worker tries again, under another key: what it stores is where it was until then."""
    folder = tmp_path if beside else Path("/dev/shm")
    if not folder.is_dir() or (folder.stat().st_dev == tmp_path.stat().st_dev) != beside:
        pytest.skip("no second file system")
    path, tries = folder / f"result-{os.getpid()}", iter(keys)
    path.write_bytes(CONTENT)
    store = new_store(settings_of(tmp_path / "data"))
    monkeypatch.setattr(os, "fsync", FailingSync(nth))
    try:
        retry(lambda: store.put_file(path, next(tries)), budget_s=5)
        assert not path.exists()
    finally:
        path.unlink(missing_ok=True)
    assert store.read(keys[1]) == CONTENT
    assert [item.key for item in store.objects()] == [keys[1]]


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    settings = settings_of(tmp_path / "data")
    settings.data_dir.mkdir()
    (settings.data_dir / "artifacts").write_bytes(b"a file in its place")
    with pytest.raises(OSError, match="directory"):
        new_store(settings).require_writable()


def leave_nothing(folder: Path) -> None:
    """Move the store away with its folder."""


def leave_mount_point(folder: Path) -> None:
    """Unmount the store's disk."""
    folder.mkdir()


def leave_file(folder: Path) -> None:
    folder.write_bytes(b"")


@pytest.mark.parametrize("leave", [leave_nothing, leave_mount_point, leave_file])
@pytest.mark.parametrize("starts_meanwhile", [False, True])
def test_a_folder_that_is_away_is_not_made_anew(
    tmp_path: Path, leave: Callable[[Path], None], starts_meanwhile: bool
) -> None:
    """What would be stored in a new one is lost when the old one comes back."""
    settings = settings_of(tmp_path / "data")
    contents: list[str] = []
    store = ArtifactStore(settings, is_new=lambda: not contents)
    put(store, tmp_path / "scratch", CONTENT, KEY)
    contents.append(KEY)
    if starts_meanwhile:
        store = ArtifactStore(settings, is_new=lambda: not contents)
    folder = settings.data_dir / "artifacts"
    away = folder.rename(tmp_path / "away")
    leave(folder)
    before = sorted(tmp_path.rglob("*"))
    path = tmp_path / "new"
    path.write_bytes(b"new")
    steps: list[Callable[[], object]] = [
        lambda: store.put_file(path, "blobs/new"),
        lambda: store.fetch(KEY, tmp_path / "fetched"),
        lambda: store.read(KEY),
        lambda: read(store, 0, 5),
        lambda: store.sync(KEY),
        lambda: store.sha256_of(KEY),
        store.require_writable,
    ]
    for step in steps:
        with pytest.raises(artifacts.StoreAwayError) as raised:
            step()
        assert may_pass(raised.value), "a worker waits for it"
    assert sorted(tmp_path.rglob("*")) == sorted([*before, path])
    if folder.is_file():
        folder.unlink()
    away.rename(folder)
    store.put_file(path, "blobs/new")
    assert {item.key for item in store.objects()} == {KEY, "blobs/new"}


def test_only_what_lies_where_blobs_do_is_listed(stored: ArtifactStore, tmp_path: Path) -> None:
    for key in ("report.pdf", "backups/blobs/a", "blobs2/a"):
        put(stored, tmp_path / "foreign", b"foreign", key)
    assert [item.key for item in stored.objects()] == [KEY]
    stored.delete([KEY])
    assert list(stored.objects()) == []


@pytest.fixture
def store_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[int], ArtifactStore]:
    """A function that makes a store in S3 at a port of this machine."""
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")

    def make(port: int) -> ArtifactStore:
        endpoint = f"http://{HOST}:{port}"
        return new_store(settings_of(tmp_path / "data", artifacts_url="s3://bucket", s3_endpoint=endpoint))

    return make


@pytest.fixture
def silent_port() -> Iterator[int]:
    """A server that takes connections and never says anything."""
    with socket.create_server((HOST, 0), backlog=64) as server:
        yield server.getsockname()[1]


def fails_within_s(step: Callable[[], object]) -> float:
    begin_s = time.monotonic()
    with pytest.raises(BaseError):
        step()
    return time.monotonic() - begin_s


def test_a_store_that_is_away(store_at: Callable[[int], ArtifactStore]) -> None:
    """By default it would be tried for minutes, and the thread with it."""
    store = store_at(free_port())
    assert fails_within_s(lambda: store.read(KEY)) < 20
    assert fails_within_s(store.require_writable) < 7


def test_a_silent_store_is_no_ready_store(store_at: Callable[[int], ArtifactStore], silent_port: int) -> None:
    assert fails_within_s(store_at(silent_port).require_writable) < 7


def test_a_silent_store_is_given_up(
    store_at: Callable[[int], ArtifactStore], silent_port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert artifacts._TIMEOUTS["read_timeout"].total_seconds() <= 30
    monkeypatch.setitem(artifacts._TIMEOUTS, "read_timeout", timedelta(milliseconds=300))
    store = store_at(silent_port)
    assert fails_within_s(lambda: store.read(KEY)) < 20
