"""A folder whose files come as they are asked for."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from pathlib import Path

import pytest

from service.storage.on_demand import OnDemandFolder, RemoteFile

FILES = 600
SIZE_BYTES = 10
NAMES = [f"images/{place:04d}.png" for place in range(FILES)]
REMOTE = {name: RemoteFile(f"key-{name}", SIZE_BYTES) for name in NAMES}


class Store:
    """A store that notes what is fetched, by the name of the file."""

    def __init__(self, latency_s: float = 0.0) -> None:
        self.fetched: list[str] = []
        self.broken: set[str] = set()
        self._latency_s = latency_s

    def fetch(self, key: str, target: Path) -> None:
        time.sleep(self._latency_s)
        name = key.removeprefix("key-")
        self.fetched.append(name)
        if name in self.broken:
            raise ConnectionError("away")
        with target.open("xb") as file:
            file.write(name.encode()[-SIZE_BYTES:])


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Callable[..., OnDemandFolder]]:
    """A function that makes a folder over a store."""
    made: list[OnDemandFolder] = []

    def folder(store: Store, room_bytes: int = FILES * SIZE_BYTES) -> OnDemandFolder:
        made.append(OnDemandFolder(tmp_path / "drive", REMOTE, fetch=store.fetch, room_bytes=room_bytes))
        return made[-1]

    yield folder
    for one in made:
        one.__exit__(None, None, None)


def here(tmp_path: Path) -> set[str]:
    return {path.relative_to(tmp_path / "drive").as_posix() for path in (tmp_path / "drive").rglob("*.png")}


def test_every_file_is_there_when_it_is_asked_for(make: Callable[..., OnDemandFolder], tmp_path: Path) -> None:
    store = Store()
    folder = make(store)
    for name in NAMES:
        folder.bring(name)
        assert (tmp_path / "drive" / name).read_bytes() == name.encode()[-SIZE_BYTES:]
    assert sorted(store.fetched) == NAMES, "each once, as all fit"
    folder.raise_error()


def test_files_go_when_others_need_their_place(make: Callable[..., OnDemandFolder], tmp_path: Path) -> None:
    room_files = 200
    store = Store()
    folder = make(store, room_bytes=room_files * SIZE_BYTES)
    most = 0
    for name in NAMES:
        folder.bring(name)
        assert (tmp_path / "drive" / name).exists()
        most = max(most, len(here(tmp_path)))
    assert 150 < most <= room_files
    assert NAMES[0] not in here(tmp_path)
    folder.bring(NAMES[0])
    assert (tmp_path / "drive" / NAMES[0]).read_bytes() == NAMES[0].encode()[-SIZE_BYTES:]


def test_what_is_asked_for_again_stays(make: Callable[..., OnDemandFolder], tmp_path: Path) -> None:
    store = Store()
    folder = make(store, room_bytes=200 * SIZE_BYTES)
    for name in NAMES[1:]:
        folder.bring(NAMES[0])
        folder.bring(name)
    assert store.fetched.count(NAMES[0]) == 1


def test_room_for_too_little_holds_what_is_being_read(make: Callable[..., OnDemandFolder], tmp_path: Path) -> None:
    folder = make(Store(), room_bytes=1)
    for name in NAMES:
        folder.bring(name)
        assert (tmp_path / "drive" / name).exists()
    assert len(here(tmp_path)) < FILES / 2


@pytest.mark.parametrize("step", [1, -1])
def test_files_come_ahead_of_who_goes_along_them(make: Callable[..., OnDemandFolder], step: int) -> None:
    """One after the other they would take a round trip each."""
    latency_s = 0.01
    folder = make(Store(latency_s), room_bytes=1)
    started = time.monotonic()
    for name in NAMES[200:400][::step]:
        folder.bring(name)
    assert time.monotonic() - started < 200 * latency_s / 2


def test_nothing_else_comes_for_samples(make: Callable[..., OnDemandFolder]) -> None:
    store = Store()
    folder = make(store)
    sampled = [*NAMES[50:FILES:100], NAMES[200]]
    for name in sampled:
        folder.bring(name)
    time.sleep(0.1)
    assert sorted(store.fetched) == sorted(sampled)


def test_little_else_comes_for_samples_of_units(make: Callable[..., OnDemandFolder]) -> None:
    """All cameras of a unit are read, of which few units are."""
    store = Store()
    folder = make(store)
    sampled = [NAMES[first + camera] for first in range(50, FILES, 100) for camera in range(6)]
    for name in sampled:
        folder.bring(name)
    time.sleep(0.1)
    assert set(sampled) <= set(store.fetched)
    assert len(store.fetched) <= 2 * len(sampled)


def test_images_come_ahead_between_readings_of_a_mask(make: Callable[..., OnDemandFolder]) -> None:
    """One mask may serve all images of a camera."""
    latency_s = 0.01
    folder = make(Store(latency_s))
    started = time.monotonic()
    for name in NAMES[:200]:
        folder.bring(name)
        folder.bring(NAMES[-1])
    assert time.monotonic() - started < 200 * latency_s / 2


def test_threads_that_ask_for_the_same(make: Callable[..., OnDemandFolder], tmp_path: Path) -> None:
    store = Store(0.002)
    folder = make(store, room_bytes=300 * SIZE_BYTES)
    barrier = threading.Barrier(8)

    def ask() -> bool:
        barrier.wait()
        found = []
        for name in NAMES:
            folder.bring(name)
            found.append((tmp_path / "drive" / name).exists())
        return all(found)

    with ThreadPoolExecutor(8) as pool:
        assert all(future.result() for future in [pool.submit(ask) for _ in range(8)])
    assert sorted(store.fetched) == NAMES


def test_a_file_that_comes_late_stays(tmp_path: Path) -> None:
    """Many others that were asked for while it came do not make it the next one to go."""
    comes = threading.Event()

    def fetch(key: str, target: Path) -> None:
        assert key != REMOTE[NAMES[0]].key or comes.wait(60.0)
        target.touch()

    with OnDemandFolder(tmp_path, REMOTE, fetch=fetch, room_bytes=1) as folder, ThreadPoolExecutor(1) as pool:
        asked = pool.submit(folder.bring, NAMES[0])
        for name in NAMES[100:400]:
            folder.bring(name)
        comes.set()
        asked.result()
        folder.bring(NAMES[500])
        assert (tmp_path / NAMES[0]).exists()


def test_many_files_that_are_here_take_no_time(tmp_path: Path) -> None:
    """Millions of small images fit into the usual room."""
    names = [f"{place}.png" for place in range(8000)]
    files = {name: RemoteFile(name, 1) for name in names}
    with OnDemandFolder(tmp_path, files, fetch=lambda key, target: None, room_bytes=10**9) as folder:
        started = time.monotonic()
        for name in names:
            folder.bring(name)
        assert time.monotonic() - started < 5.0


def test_a_file_that_does_not_come(make: Callable[..., OnDemandFolder], tmp_path: Path) -> None:
    """Whoever asks hears of it, and may ask again; the error is kept for who has to answer for the attempt."""
    store = Store()
    store.broken = {NAMES[300]}
    folder = make(store)
    with pytest.raises(ConnectionError):
        folder.bring(NAMES[300])
    with pytest.raises(ConnectionError, match="away"):
        folder.raise_error()
    store.broken = set()
    folder.bring(NAMES[300])
    assert (tmp_path / "drive" / NAMES[300]).exists()


def test_a_file_that_nobody_asks_for(make: Callable[..., OnDemandFolder]) -> None:
    """It is brought ahead of who might ask, and fails nothing if it does not come."""
    store = Store()
    store.broken = {NAMES[20]}
    folder = make(store)
    for name in NAMES[:20]:
        folder.bring(name)
    time.sleep(0.1)
    assert NAMES[20] in store.fetched
    folder.raise_error()


def test_a_store_that_hangs_holds_up_no_end(tmp_path: Path) -> None:
    """And who waits for a file hears of the end, which is no error of the store."""
    hangs = threading.Event()
    folder = OnDemandFolder(tmp_path, REMOTE, fetch=lambda key, target: hangs.wait(30.0) and None, room_bytes=10**9)
    with ThreadPoolExecutor(40) as pool:
        asked = [pool.submit(folder.bring, name) for name in NAMES[::15]]
        started = time.monotonic()
        with folder:
            time.sleep(0.2)
        assert time.monotonic() - started < 10.0
        hangs.set()
        assert {type(one.exception()) for one in asked} == {type(None), CancelledError}
    folder.raise_error()


def test_a_file_that_the_drive_does_not_have(make: Callable[..., OnDemandFolder]) -> None:
    store = Store()
    folder = make(store)
    with pytest.raises(KeyError):
        folder.bring("../../etc/passwd")
    assert store.fetched == []
