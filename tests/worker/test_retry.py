"""An artifact store that is away, slow or has lost something: what becomes of an attempt in this process."""

from __future__ import annotations

import errno
import logging
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from obstore.exceptions import GenericError, PermissionDeniedError
from sqlalchemy import update

import worker.checkpoints
from service.database.tables import Blob, Checkpoint, Job, Project, now_us
from service.domain import checkpoints, jobs
from service.domain.checkpoints import DriveShelf, MapShelf, Shelf, settings_sha256
from service.storage.artifacts import ArtifactStore
from service.storage.blob_writer import StoredFile, file_sha256, store_file
from service.storage.process_folder import process_folder
from tests.helpers.service_world import World, wait_until
from worker.checkpoints import CheckpointKeeper
from worker.job_execution import Runner
from worker.retry import may_pass, watched
from worker.termination import StopReason, StopRequest

SHELF = "0" * 64
REFUSED = GenericError("connection refused")


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    """Records and files alone; messages are not needed."""
    made = World(tmp_path)
    yield made
    made.close()


def break_store(monkeypatch: pytest.MonkeyPatch, method: str, errors: list[Exception]) -> None:
    """Make the store fail so, call after call, before it works again."""
    real = getattr(ArtifactStore, method)

    def broken(*args: Any, **options: Any) -> Any:
        if errors:
            raise errors.pop(0)
        return real(*args, **options)

    monkeypatch.setattr(ArtifactStore, method, broken)


def never(monkeypatch: pytest.MonkeyPatch, error: Exception) -> list[bool]:
    """Make the store fail whenever it is asked for an object; grows with every time."""
    asked: list[bool] = []

    def away(*args: Any, **options: Any) -> None:
        asked.append(True)
        raise error

    monkeypatch.setattr(ArtifactStore, "fetch", away)
    return asked


@pytest.mark.slow
def test_store_that_is_away_for_seconds(world: World, brief_drive: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """While the drive is brought, and when hours of work are published."""
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    fetching: list[Exception] = [REFUSED, OSError(errno.ENOSPC, "full"), REFUSED]
    storing: list[Exception] = [REFUSED, TimeoutError(), REFUSED, REFUSED]
    break_store(monkeypatch, "fetch", fetching)
    break_store(monkeypatch, "put_file", storing)
    Runner(world.settings).run(job_id)
    assert (fetching, storing) == ([], [])
    assert world.outcomes(job_id) == ["succeeded"]
    assert world.job(job_id).attempt == 1


def test_store_that_is_away_for_long(world: World, brief_drive: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each further attempt waits longer for it."""
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    never(monkeypatch, REFUSED)
    settings = world.settings.model_copy(update={"storage_patience_seconds": 0.01, "retry_delay_seconds": 2.0})
    delays_s = []
    for _ in range(2):
        Runner(settings).run(job_id)
        delays_s.append((world.job(job_id).not_before_us - now_us()) / 1e6)
        with world.database.write() as session:
            session.get_one(Job, job_id).not_before_us = 0
    assert 0 < delays_s[0] <= 2 < 20 < delays_s[1] <= 30
    Runner(settings).run(job_id)
    assert (world.job(job_id).state, world.outcomes(job_id)) == ("FAILED", ["storage"] * 3)


def test_cancel_while_the_store_is_away(world: World, brief_drive: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    asked = never(monkeypatch, REFUSED)
    thread = threading.Thread(target=Runner(world.settings).run, args=(job_id,))
    thread.start()
    wait_until(lambda: len(asked) > 1, "another try")
    world.cancel(job_id)
    thread.join(30)
    assert (world.job(job_id).state, world.outcomes(job_id)) == ("CANCELLED", ["cancelled"])


@pytest.mark.parametrize("during", ["fetch", "restore"])
def test_stop_while_the_store_hangs(
    world: World, brief_drive: Path, monkeypatch: pytest.MonkeyPatch, during: str
) -> None:
    """It took the connection and says nothing: for half a minute no call to it returns."""
    drive_id = world.add_drive(brief_drive)
    job_id = world.ask(drive_id, wake=False)
    hangs, go_on, stop = threading.Event(), threading.Event(), threading.Event()
    if during == "restore":
        shelf = DriveShelf(drive_id, checkpoints.settings_sha256(world.job(job_id).settings))
        keep(world, shelf, "features.npz", b"a finished stage")
    real = ArtifactStore.fetch

    def fetch(store: ArtifactStore, key: str, target: Path, **options: Any) -> None:
        if during == "fetch" or target.suffix == ".npz":
            hangs.set()
            go_on.wait(60)
        real(store, key, target, **options)

    monkeypatch.setattr(ArtifactStore, "fetch", fetch)
    thread = threading.Thread(target=Runner(world.settings, shutting_down=stop.is_set).run, args=(job_id,))
    thread.start()
    assert hangs.wait(60)
    stop.set()
    thread.join(15)
    ended = not thread.is_alive()
    go_on.set()
    thread.join(60)
    assert ended
    assert (world.job(job_id).state, world.outcomes(job_id)) == ("QUEUED", ["released"])
    wait_until(lambda: not list(world.settings.scratch_dir.iterdir()), "nothing is left behind")


def test_failure_of_a_worker_that_stops(world: World, brief_drive: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As its machine goes down, so does what it needs: the job has not failed."""
    job_id = world.ask(world.add_drive(brief_drive), wake=False)
    stop = threading.Event()

    def fails(*args: Any, **options: Any) -> None:
        stop.set()
        raise PermissionDeniedError("no credentials any more")

    monkeypatch.setattr(ArtifactStore, "fetch", fails)
    Runner(world.settings, shutting_down=stop.is_set).run(job_id)
    job = world.job(job_id)
    assert (job.state, job.blame, world.outcomes(job_id)) == ("QUEUED", 0, ["released"])


def test_what_passes() -> None:
    assert may_pass(REFUSED)
    assert may_pass(OSError(errno.ENOSPC, "full"))
    assert may_pass(ConnectionRefusedError())
    for final in (PermissionDeniedError("no"), FileNotFoundError(errno.ENOENT, "gone"), ValueError("wrong")):
        assert not may_pass(final)


def test_watched_step_has_its_own_result() -> None:
    assert watched(lambda: 3, lambda: None) == 3
    with pytest.raises(TimeoutError, match="its own"):
        watched(lambda: raise_(TimeoutError("its own")), lambda: None)


def raise_(error: Exception) -> None:
    raise error


def store(world: World, data: bytes) -> StoredFile:
    path = world.settings.spool_dir / "a"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return store_file(
        world.database,
        world.artifacts,
        project_id=world.project_id,
        path=path,
        sha256=file_sha256(path),
        size_bytes=len(data),
    )


def keep(world: World, shelf: DriveShelf, name: str, data: bytes) -> StoredFile:
    stored = store(world, data)
    with world.database.write() as session:
        checkpoints.keep(session, shelf, {name: stored})
    return stored


def test_lost_checkpoint(world: World, brief_drive: Path, tmp_path: Path) -> None:
    """The stage is done again, and kept again: the record of its lost bytes is not taken for them."""
    shelf = DriveShelf(world.add_drive(brief_drive), SHELF)
    with world.database.read() as session:
        used_bytes = session.get_one(Project, world.project_id).used_bytes
    lost = keep(world, shelf, "features.npz", b"features")
    keep(world, shelf, "matches.npz", b"the matches")
    world.artifacts.delete([lost.key])

    def restore(folder: str) -> list[str]:
        return checkpoints.restore(world.database, shelf, tmp_path / folder, fetch=world.artifacts.fetch)

    assert restore("first") == ["matches.npz"]
    with world.database.read() as session:
        assert [row.name for row in session.query(Checkpoint)] == ["matches.npz"]
        assert session.query(Blob).filter_by(sha256=lost.sha256).count() == 0
        assert session.get_one(Project, world.project_id).used_bytes == used_bytes + len(b"the matches")
    assert keep(world, shelf, "features.npz", b"features").key != lost.key
    assert sorted(restore("second")) == ["features.npz", "matches.npz"]


def test_stop_while_finished_stages_are_restored(world: World, brief_drive: Path) -> None:
    """The copy ends after the attempt's folder is gone: its stages are in the store, and another attempt finds them."""
    shelf = DriveShelf(world.add_drive(brief_drive), SHELF)
    names = ["features.npz", "matches.npz"]
    stored = [keep(world, shelf, name, name.encode()) for name in names]
    copies, go_on = threading.Event(), threading.Event()
    threads: list[threading.Thread] = []

    def fetch(key: str, target: Path) -> None:
        threads.append(threading.current_thread())
        copies.set()
        go_on.wait(60)
        world.artifacts.fetch(key, target)

    def check_stop() -> None:
        if copies.is_set():
            raise StopRequest(StopReason.SHUT_DOWN)

    with pytest.raises(StopRequest), process_folder(world.settings.scratch_dir, "job_stopped.1") as root:
        watched(lambda: checkpoints.restore(world.database, shelf, root / "scene", fetch=fetch), check_stop)
    go_on.set()
    threads[0].join(60)
    with world.database.read() as session:
        assert sorted(row.name for row in session.query(Checkpoint)) == names
        assert all(session.query(Blob).filter_by(key=file.key).count() == 1 for file in stored)
    with process_folder(world.settings.scratch_dir, "job_stopped.2") as root:
        brought = checkpoints.restore(world.database, shelf, root / "scene", fetch=world.artifacts.fetch)
        assert sorted(brought) == names


def test_checkpoint_that_cannot_be_kept(
    world: World,
    brief_drive: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Tried again less and less often, and hashed once; at the end once more, whatever the pause."""
    monkeypatch.setattr(worker.checkpoints, "_POLL_EVERY_S", 0.01)
    hashed: list[Path] = []
    monkeypatch.setattr(worker.checkpoints, "file_sha256", lambda path: (hashed.append(path), file_sha256(path))[1])
    errors: list[Exception] = [REFUSED, REFUSED]
    (tmp_path / "stages").mkdir()
    (tmp_path / "stages" / "features.npz").write_bytes(b"features")
    shelf = DriveShelf(world.add_drive(brief_drive), SHELF)
    break_store(monkeypatch, "put_file", errors)
    with caplog.at_level(logging.WARNING, "mrasfm.worker"), keeper(world, shelf, tmp_path):
        wait_until(lambda: len(errors) == 1, "the first try")
        time.sleep(0.5)
        assert len(errors) == 1, "not again at every poll"
        errors.clear()
    assert len(hashed) == 1
    assert [record.exc_info is not None for record in caplog.records] == [True]
    with world.database.read() as session:
        assert [row.name for row in session.query(Checkpoint)] == ["features.npz"]
        assert session.query(Job).filter_by(kind="RECONSTRUCTION").one().losses == 0, "since the last stage"


def test_checkpoint_that_nobody_finds_again_is_no_progress(world: World, brief_drive: Path, tmp_path: Path) -> None:
    """The map was deleted meanwhile, say: such a job must not be tried for ever."""
    (tmp_path / "stages").mkdir()
    (tmp_path / "stages" / "features.npz").write_bytes(b"features")
    drive_id = world.add_drive(brief_drive)
    gone = MapShelf("map_gone", world.project_id, {}, settings_sha256({}))
    with keeper(world, gone, tmp_path, drive_id=drive_id):
        pass
    with world.database.read() as session:
        assert session.query(Job).filter_by(kind="RECONSTRUCTION").one().losses == 7


def keeper(world: World, shelf: Shelf, folder: Path, *, drive_id: str | None = None) -> CheckpointKeeper:
    """As of an attempt that lost some before it."""
    job_id = world.ask(drive_id or getattr(shelf, "drive_id", ""), wake=False)
    with world.database.write() as session:
        held = jobs.claim(session, job_id, owner="w", lease_us=3600 * 1_000_000)
        session.execute(update(Job).values(losses=7))
    assert held is not None
    return CheckpointKeeper(
        world.database,
        world.artifacts,
        shelf,
        held=held,
        folder=folder / "stages",
        spare=folder / "spare",
    )


def test_pauses_grow(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock: list[float] = [0.0]
    tries: list[float] = []
    monkeypatch.setattr("worker.checkpoints.time.monotonic", lambda: clock[0])
    made = keeper(world, DriveShelf("drv_0", SHELF), tmp_path)
    fails: Callable[..., None] = lambda *_: (tries.append(clock[0]), raise_(REFUSED))[1]  # noqa: E731
    monkeypatch.setattr(made, "_keep", fails)
    (tmp_path / "stages").mkdir()
    (tmp_path / "stages" / "features.npz").write_bytes(b"features")
    for second in range(1300):
        clock[0] = float(second)
        made._poll()
    assert tries == [0.0, 2.0, 6.0, 14.0, 30.0, 62.0, 126.0, 254.0, 510.0, 810.0, 1110.0]


def test_checkpoints_of_the_last_few_settings(world: World, brief_drive: Path) -> None:
    """And of those that a job may still need."""
    drive_id = world.add_drive(brief_drive)
    waiting = checkpoints.settings_sha256(world.job(world.ask(drive_id, wake=False)).settings)
    for i, settings in enumerate((waiting, *("abcde"))):
        keep(world, DriveShelf(drive_id, settings), "features.npz", f"features {i}".encode())
        time.sleep(0.002)
    with world.database.read() as session:
        assert {row.settings_sha256 for row in session.query(Checkpoint)} == {waiting, "c", "d", "e"}
