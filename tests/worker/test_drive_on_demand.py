"""A drive that is larger than a worker's disk: its files come from the artifact store as the engine needs them."""

from __future__ import annotations

import json
import pickle
import socket
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import count
from pathlib import Path

import pytest
from sqlalchemy import select

from mrasfm_engine.errors import StorageError
from service.database.tables import Blob, DriveFile, Job, SceneFile
from service.domain.drive_checkout import check_out
from service.storage.on_demand import OnDemandFolder, RemoteFile
from tests.helpers.s3_server import s3_server, settings_of_bucket
from tests.helpers.service_world import World
from worker import file_server
from worker.child_protocol import FileAddress
from worker.file_client import FilesOnDemand
from worker.file_server import FileServer
from worker.job_execution import Runner


@pytest.fixture(scope="module")
def s3_endpoint() -> Iterator[str]:
    with s3_server() as url:
        yield url


@pytest.fixture
def make_cloud(
    make_world: Callable[..., World], s3_endpoint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., World]:
    """A function that makes an installation with an artifact store in S3."""

    number = count()

    def make(**changed: object) -> World:
        bucket = f"{next(number)}-{tmp_path.name}"
        return make_world(**settings_of_bucket(s3_endpoint, bucket, monkeypatch), **changed)

    return make


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the files that children have asked for so far."""
    result = list[str]()
    brought = file_server._brought
    monkeypatch.setattr(file_server, "_brought", lambda folder, file: result.append(file) or brought(folder, file))
    return result


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[FileAddress, Path]]:
    """The address of a server for two files, of which the second one does not come."""

    def fetch(key: str, target: Path) -> None:
        if key == "away":
            raise ConnectionError("https://user:secret@store/away")
        target.write_text(key, encoding="utf-8")

    files = {"images/a.png": RemoteFile("there", 5), "images/b.png": RemoteFile("away", 5)}
    folder = tmp_path / "drive"
    with OnDemandFolder(folder, files, fetch=fetch, room_bytes=1000) as on_demand, FileServer(on_demand) as server:
        yield server.address, folder


def test_a_file_is_asked_for_from_any_process(served: tuple[FileAddress, Path]) -> None:
    address, folder = served
    ask = pickle.loads(pickle.dumps(FilesOnDemand(address)))
    ask("images/a.png")
    assert (folder / "images/a.png").read_text(encoding="utf-8") == "there"


def test_a_file_that_does_not_come_is_named(served: tuple[FileAddress, Path]) -> None:
    """And nothing of the store is: its errors may hold what is secret."""
    ask = FilesOnDemand(served[0])
    for file, why in (("images/b.png", "ConnectionError"), ("../drive.json", "KeyError")):
        with pytest.raises(StorageError, match=f"{file}.*{why}") as raised:
            ask(file)
        assert "secret" not in raised.value.what


def test_who_does_not_know_the_word_gets_nothing(served: tuple[FileAddress, Path]) -> None:
    address, folder = served
    with pytest.raises(StorageError):
        FilesOnDemand(FileAddress(port=address.port, token="0" * 64))("images/a.png")
    for request in (b"", b"\n", b"GET / HTTP/1.1\r\n\r\n", b"[]\n", b"{}\n", b"\xff\xfe\n", b"x" * 100_000):
        with socket.create_connection(("127.0.0.1", address.port)) as connection:
            connection.sendall(request)
            with suppress(OSError):  # it was not read to its end, and the server is gone already
                connection.shutdown(socket.SHUT_WR)
            with suppress(ConnectionResetError):  # likewise
                assert connection.recv(100) == b""
    assert list((folder / "images").iterdir()) == []


def test_a_supervisor_that_is_gone(served: tuple[FileAddress, Path]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(StorageError, match="ConnectionRefusedError"):
        FilesOnDemand(FileAddress(port=port, token="x"))("images/a.png")


def run(world: World, job_id: str) -> Job:
    Runner(world.settings).run(job_id)
    return world.job(job_id)


def summary_of(world: World, job: Job) -> dict[str, object]:
    assert job.state == "SUCCEEDED", job.problem
    with world.database.read() as session:
        scene = select(Blob.key).join(SceneFile).where(SceneFile.scene_id == job.scene_id)
        key = session.scalars(scene.where(SceneFile.path == "report.json")).one()
    found: dict[str, object] = json.loads(world.artifacts.read(key))["summary"]
    return found


@pytest.mark.slow
def test_the_same_scene(make_cloud: Callable[..., World], brief_drive: Path, asked: list[str]) -> None:
    """From a check to the scene, as where all files are laid out before."""
    large, small = make_cloud(drive_room_bytes=1000), make_cloud()
    jobs = {}
    for world in (large, small):
        drive_id, check = world.add_unchecked_drive(brief_drive)
        checked = run(world, check)
        assert checked.state == "SUCCEEDED", checked.problem
        jobs[world] = run(world, world.ask(drive_id, wake=False))
        if world is large:
            with world.database.read() as session:
                files = set(session.scalars(select(DriveFile.path)))
            assert set(asked) == files
            asked.clear()
    assert asked == []
    first, second = (summary_of(world, job) for world, job in jobs.items())
    assert first == second
    assert list(large.settings.scratch_dir.iterdir()) == []


@pytest.mark.slow
def test_a_check_compares_no_contents(make_cloud: Callable[..., World], long_drive: Path, asked: list[str]) -> None:
    """Copies among images are known from the digests of their uploads: images that are not sampled are read once."""
    world = make_cloud(drive_room_bytes=1000)
    _, check = world.add_unchecked_drive(long_drive)
    checked = run(world, check)
    assert checked.state == "SUCCEEDED", checked.problem
    assert any(file.startswith("images/") and times == 1 for file, times in Counter(asked).items())


@pytest.mark.slow
def test_the_join_of_sub_maps_reads_no_image_twice(
    make_cloud: Callable[..., World], long_drive: Path, asked: list[str]
) -> None:
    """It needs them for pictures: the plan has checked all of them, the sub-maps have extracted what they show."""
    world = make_cloud(drive_room_bytes=1000, submap_workers=2)
    job_id = world.ask(world.add_drive(long_drive), wake=False, submaps=2)
    assert run(world, job_id).waiting_for == 2
    with world.database.read() as session:
        assert set(asked) == set(session.scalars(select(DriveFile.path)))
        submaps = session.scalars(select(Job.id).where(Job.parent_id == job_id)).all()
    for submap in submaps:
        assert run(world, submap).state == "SUCCEEDED"
    asked.clear()
    joined = run(world, job_id)
    assert len(asked) == len(set(asked))
    assert summary_of(world, joined)["registered_units"] == 41


@pytest.mark.slow
def test_a_store_that_loses_a_file(make_cloud: Callable[..., World], brief_drive: Path) -> None:
    """The job says so: no scene lacks what an image would have shown."""
    world = make_cloud(drive_room_bytes=1000, storage_patience_seconds=1.0, max_attempts=1)
    drive_id = world.add_drive(brief_drive)
    with world.database.read() as session:
        key = session.scalars(select(Blob.key).join(DriveFile, DriveFile.blob_id == Blob.id)).first()
    world.artifacts.delete([key])
    job = run(world, world.ask(drive_id, wake=False))
    assert job.state == "FAILED"
    assert job.problem is not None
    assert "storage" in job.problem["type"], job.problem


def test_a_pass_over_masks_meets_no_images(make_world: Callable[..., World], long_drive: Path, tmp_path: Path) -> None:
    """Files that are read in one pass follow one another, as those are brought ahead that come next."""
    world = make_world()
    drive_id = world.add_drive(long_drive)
    drive = check_out(world.database, drive_id, tmp_path / "drive", fetch=world.artifacts.fetch)
    folders = [name.partition("/")[0] for name in drive.files]
    assert folders == ["images"] * 82 + ["masks"] * 82


def test_a_folder_store_lays_all_out(
    make_world: Callable[..., World], brief_drive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There files are not copied, however large the drive is."""
    monkeypatch.setattr(file_server, "_brought", lambda folder, file: "asked for")
    world = make_world(drive_room_bytes=1000)
    _, check = world.add_unchecked_drive(brief_drive)
    job = run(world, check)
    assert job.state == "SUCCEEDED", job.problem
