"""Bytes that nothing needs are deleted, and leave the quota."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import pytest
from sqlalchemy import delete, func, insert, select, update
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from service.database.connections import Database
from service.database.tables import (
    Blob,
    Checkpoint,
    Drive,
    DriveFile,
    Export,
    ExportFile,
    Map,
    MapCheckpoint,
    MapFile,
    MapVersion,
    Project,
    Scene,
    SceneFile,
    new_id,
    now_us,
)
from service.domain.keys import create_project
from service.settings import Settings
from service.storage import blob_writer, blobs, garbage_collection, named_blobs
from service.storage.artifacts import ArtifactStore
from service.storage.blob_writer import BlobWriter, store_file
from service.storage.garbage_collection import Collector, collect_orphans, collect_unused
from service.storage.named_blobs import MAX_NAMED
from service.storage.spool import SpoolWriter
from tests.helpers.live_api import Api, Client, wait_until
from tests.helpers.sqlite_steps import sqlite_steps
from tests.helpers.tiny_drive import tiny_drive
from tests.service.conftest import StartApi

_TWO_HOURS_US = 2 * 3600 * 1_000_000


def _age(api: Api, project_id: str) -> None:
    with api.database.write() as session:
        old = update(Blob).where(Blob.project_id == project_id).values(touched_us=now_us() - _TWO_HOURS_US)
        session.execute(old)


def test_a_deleted_drive_leaves_the_quota_at_once(api: Api, client: Client) -> None:
    drive_id = client.filled()
    assert api.project(client.project_id).used_bytes > 0
    assert api.objects(client.project_id)
    _age(api, client.project_id)
    assert client.delete(f"/v1/drives/{drive_id}").status_code == 204
    wait_until(lambda: api.project(client.project_id).used_bytes == 0, "the quota")
    wait_until(lambda: not api.objects(client.project_id), "the objects' end")


def test_bytes_that_another_drive_needs_stay(api: Api, client: Client) -> None:
    drive = tiny_drive()
    first, second = client.filled(drive), client.filled(drive)
    _age(api, client.project_id)
    before_bytes = api.project(client.project_id).used_bytes
    assert client.delete(f"/v1/drives/{first}").status_code == 204
    other = client.filled(tiny_drive("other", seed="other"))
    _age(api, client.project_id)
    assert client.delete(f"/v1/drives/{other}").status_code == 204
    wait_until(lambda: api.project(client.project_id).used_bytes == before_bytes, "the quota")
    assert client.get(f"/v1/drives/{second}").json()["files_stored"] == len(drive.files)
    assert client.post(f"/v1/drives/{second}:commit").status_code == 200


def test_bytes_that_were_just_used_wait(api: Api, client: Client) -> None:
    drive = tiny_drive("again", seed="again")
    drive_id = client.filled(drive)
    assert client.delete(f"/v1/drives/{drive_id}").status_code == 204
    # Sent a moment ago: another upload may be about to refer to them.
    assert len(api.objects(client.project_id)) >= len(drive.files)


def _many_used_blobs(api: Api, drive_id: str, count: int) -> None:
    """Give a drive this many files."""
    with api.database.write() as session:
        project_id = session.get_one(Drive, drive_id).project_id
        contents = [hashlib.sha256(f"{drive_id}{i}".encode()).hexdigest() for i in range(count)]
        rows = [
            {"id": new_id("blb"), "project_id": project_id, "sha256": sha256, "key": sha256, "size_bytes": 0}
            for sha256 in contents
        ]
        session.execute(insert(Blob), [{**row, "touched_us": 1} for row in rows])
        files = [{"drive_id": drive_id, "path": row["key"], "role": "image", "blob_id": row["id"]} for row in rows]
        session.execute(insert(DriveFile), files)


def test_a_deletion_looks_only_at_what_it_deleted(api: Api, client: Client) -> None:
    large, *small = (client.create(tiny_drive(name)) for name in ("large", "a", "b"))
    _age(api, client.project_id)

    def steps_of_deletion(drive_id: str) -> int:
        used_bytes = api.project(client.project_id).used_bytes
        with sqlite_steps(api.context.database) as steps:
            assert client.delete(f"/v1/drives/{drive_id}").status_code == 204
            wait_until(lambda: api.project(client.project_id).used_bytes < used_bytes, "the quota")
        return steps.count

    alone = steps_of_deletion(small[0])
    _many_used_blobs(api, large, 3000)
    assert steps_of_deletion(small[1]) < alone + 3000, "a blob that is looked at takes dozens"


def test_what_deletions_leave_is_collected_without_the_threads_of_requests(
    start_api: StartApi, monkeypatch: pytest.MonkeyPatch
) -> None:
    api = start_api()
    client = api.client()
    drive_ids = [client.create(tiny_drive(f"drive-{i}")) for i in range(50)]
    _age(api, client.project_id)
    store_answers = threading.Event()
    delete_at_once = api.context.artifacts.delete

    def delete_late(keys: Iterable[str]) -> None:
        assert store_answers.wait(60)
        delete_at_once(keys)

    monkeypatch.setattr(api.context.artifacts, "delete", delete_late)
    client.timeout = httpx.Timeout(10)
    try:
        for drive_id in drive_ids:  # there are 40 threads of requests
            assert client.delete(f"/v1/drives/{drive_id}").status_code == 204
        assert client.get("/v1/drives").json()["items"] == []
    finally:
        store_answers.set()
    wait_until(lambda: api.project(client.project_id).used_bytes == 0, "the quota")


def test_deletions_of_a_project_are_collected_together(
    database: Database, artifacts: ArtifactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One after the other, and of the whole project where they are too many to be named."""
    may_go_on, collected = threading.Event(), list[object]()

    def collect_named(given: Database, store: ArtifactStore, blob_ids: frozenset[str]) -> int:
        collected.append(blob_ids)
        assert may_go_on.wait(60)
        return 0

    def collect_all(given: Database, store: ArtifactStore, *, project_id: str) -> int:
        collected.append(project_id)
        return 0

    monkeypatch.setattr(garbage_collection, "collect_named", collect_named)
    monkeypatch.setattr(garbage_collection, "collect_unused", collect_all)
    collector = Collector(database, artifacts)
    collector.add("first", frozenset("a"))
    wait_until(lambda: collected, "the thread's start")
    for name in "abcd":
        collector.add("first", frozenset(name))
    collector.add("large", frozenset("a"))
    collector.add("large", None)
    collector.add("large", frozenset("b"))
    collector.add("many", frozenset(str(i) for i in range(MAX_NAMED)))
    collector.add("many", frozenset("x"))
    may_go_on.set()
    wait_until(lambda: len(collected) == 4, "the end")
    assert collected == [frozenset("a"), frozenset("abcd"), "large", "many"]
    collector.add("first", frozenset("e"))
    wait_until(lambda: len(collected) == 5, "another thread's start")
    collector.close()


def test_what_a_record_names_is_what_its_deletion_leaves(database: Database, project_id: str) -> None:
    """Also of records that the database deletes with it."""
    with database.write() as session:
        _name_blobs(session, project_id)
    for named, deleted in (
        (partial(named_blobs.of_export, export_id="exp_1"), delete(Export).where(Export.id == "exp_1")),
        (partial(named_blobs.of_version, map_id="map_1", number=1), delete(MapVersion).where(MapVersion.number == 1)),
        (partial(named_blobs.of_map, map_id="map_1"), delete(Map)),
        (partial(named_blobs.of_scene, scene_id="scn_1"), delete(Scene)),
        (partial(named_blobs.of_drive, drive_id="drv_1"), delete(Drive)),
    ):
        with database.write() as session:
            before = set(session.scalars(select(Blob.id).where(blobs.unused())))
            named_by_it = named(session)
            session.execute(deleted)
            after = set(session.scalars(select(Blob.id).where(blobs.unused())))
        assert named_by_it
        assert set(named_by_it) == after - before
    with database.read() as session:
        assert len(after) == session.scalar(select(func.count()).select_from(Blob)) == 13


def _name_blobs(session: Session, project_id: str) -> None:
    """Records of all kinds that name blobs, each one of its own."""

    def blob() -> str:
        made = Blob(id=new_id("blb"), project_id=project_id, sha256=new_id("blb"), size_bytes=1, key=new_id("blb"))
        session.add(made)
        session.flush()
        return made.id

    owned: dict[str, Any] = {"project_id": project_id}
    counts = {"cameras": 1, "frames": 1, "files_expected": 2, "has_gnss": False}
    session.add(Drive(**owned, **counts, id="drv_1", name="d", manifest_blob_id=blob()))
    session.add(Scene(**owned, id="scn_1", job_id="job_1", drive_id="drv_1", name="s", fence=1, summary={}))
    session.add(Map(**owned, id="map_1", name="m", current_version=2, newest_version=2))
    session.flush()
    versions = [{"map_id": "map_1", "number": number} for number in (1, 2)]
    for version in versions:
        session.add(MapVersion(**version, job_id=new_id("job"), fence=1, summary={}))
    session.flush()
    sources: list[dict[str, Any]] = [
        {"scene_id": "scn_1"},
        {"scene_id": "scn_1"},
        {"map_id": "map_1", "map_version": 1},
        {"map_id": "map_1", "map_version": 2},
    ]
    asked = {**owned, "job_id": "job_1", "inputs_sha256": "s", "formats": [], "options": {}}
    for i, source in enumerate(sources, start=1):
        session.add(Export(**asked, id=f"exp_{i}", **source))
    session.flush()
    for i in range(1, len(sources) + 1):
        session.add(ExportFile(export_id=f"exp_{i}", path="p", blob_id=blob(), media_type="m"))
    for version in versions:
        session.add(MapFile(**version, path="p", blob_id=blob(), media_type="m"))
    session.add(MapCheckpoint(**owned, map_id="map_1", inputs_sha256="s", name="n", blob_id=blob()))
    for path in ("p", "q"):
        session.add(SceneFile(scene_id="scn_1", path=path, blob_id=blob(), media_type="m"))
    session.add(Checkpoint(drive_id="drv_1", settings_sha256="s", name="n", blob_id=blob()))
    session.add(DriveFile(drive_id="drv_1", path="missing", role="image"))
    for path in ("p", "q"):
        session.add(DriveFile(drive_id="drv_1", path=path, role="image", blob_id=blob()))


@pytest.fixture
def artifacts(database_settings: Settings, database: Database) -> ArtifactStore:
    return ArtifactStore.open(database_settings, database)


def _put(artifacts: ArtifactStore, tmp_path: Path, key: str) -> str:
    path = tmp_path / "scratch"
    path.write_bytes(b"bytes")
    artifacts.put_file(path, key)
    return key


def test_orphans_are_ours_for_certain(
    database: Database, artifacts: ArtifactStore, project_id: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The bucket may be shared, with anybody and with other installations of this service."""
    assert artifacts.folder is not None
    foreign = [
        _put(artifacts, tmp_path, key)
        for key in (
            "report.pdf",
            "backups/monday.tar",
            "blobs/readme.txt",
            f"blobs/{project_id}/notes.txt",
            blobs.new_key(new_id("prj"), "ab" * 32),
        )
    ]
    named, orphan = (blobs.new_key(project_id, name * 64) for name in "ab")
    for key in (named, orphan):
        _put(artifacts, tmp_path, key)
    begun = _put(artifacts, tmp_path, f"blobs/{project_id}/ab/.0123456789abcdef.partial")
    with database.write() as session:
        blobs.record(session, project_id=project_id, sha256="a" * 64, size_bytes=5, key=named)
    assert collect_orphans(database, artifacts) == 0, "they may be recorded soon"
    monkeypatch.setattr(garbage_collection, "now_us", lambda: now_us() + 25 * 3600 * 1_000_000)
    assert collect_orphans(database, artifacts) == 2
    assert not (artifacts.folder / orphan).exists()
    assert not (artifacts.folder / begun).exists()
    assert all((artifacts.folder / key).exists() for key in (*foreign, named))


def test_all_unused_bytes_of_all_projects_go(
    database: Database, database_settings: Settings, artifacts: ArtifactStore, project_id: str
) -> None:
    """In batches; each is counted off its own project."""
    with database.write() as session:
        other_id = create_project(session, "other", database_settings).id
        for owner, count in ((project_id, 1203), (other_id, 2)):
            contents = [hashlib.sha256(str(i).encode()).hexdigest() for i in range(count)]
            rows = [
                {"project_id": owner, "sha256": sha256, "size_bytes": 3, "key": blobs.new_key(owner, sha256)}
                for sha256 in contents
            ]
            session.execute(insert(Blob), [{"touched_us": 1, **row} for row in rows])
            session.get_one(Project, owner).used_bytes = 3 * count + 1
        young = blobs.new_key(project_id, "a" * 64)
        blobs.record(session, project_id=project_id, sha256="a" * 64, size_bytes=10, key=young)
    assert collect_unused(database, artifacts, project_id=project_id) == 1203
    assert collect_unused(database, artifacts) == 2
    with database.read() as session:
        assert session.scalars(select(Blob.key)).all() == [young]
        assert session.get_one(Project, project_id).used_bytes == 11
        assert session.get_one(Project, other_id).used_bytes == 1


def test_a_stored_file_says_whether_it_was_stored(
    database: Database, artifacts: ArtifactStore, project_id: str, tmp_path: Path
) -> None:
    def store() -> dict[str, object]:
        path = tmp_path / "file"
        path.write_bytes(b"bytes")
        sha256 = hashlib.sha256(b"bytes").hexdigest()
        stored = store_file(database, artifacts, project_id=project_id, path=path, sha256=sha256, size_bytes=5)
        with database.write() as session:
            blobs.record(session, project_id=project_id, **stored.identity)
        return stored.identity

    first, second = store(), store()
    assert (first["is_new"], second["is_new"]) == (True, False)
    assert first["key"] == second["key"]


def test_files_that_take_longer_than_the_grace_are_recorded(
    database: Database,
    artifacts: ArtifactStore,
    database_settings: Settings,
    project_id: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nothing refers to them yet, and they count as just used all the same."""
    writer = SpoolWriter(database_settings.spool_dir, min_free_bytes=0)
    with monkeypatch.context() as earlier:
        earlier.setattr(blob_writer, "clock_us", lambda session: now_us() - _TWO_HOURS_US)
        begun = BlobWriter(database, artifacts, project_id=project_id, durable=False)
        stored = begun.store_all([writer.finish(b"bytes")])
    with begun as store:
        store.record(stored)
        assert collect_unused(database, artifacts) == 0
        store.used()
    with database.read() as session:
        assert session.scalars(select(Blob.key)).all() == [stored[0].key]


@pytest.mark.parametrize("off_us", [_TWO_HOURS_US, -_TWO_HOURS_US])
def test_what_was_just_used_is_told_by_the_database_s_clock(
    postgres_api: Api, set_clock: Callable[[int], None], off_us: int
) -> None:
    """A host whose clock is off would delete what another is about to refer to."""
    database, artifacts = postgres_api.context.database, postgres_api.context.artifacts
    client = postgres_api.client()

    def keep(data: bytes) -> str:
        spooled = SpoolWriter(postgres_api.context.settings.spool_dir, min_free_bytes=0).finish(data)
        with BlobWriter(database, artifacts, project_id=client.project_id, durable=False) as store:
            stored = store.store_all([spooled])
            (recorded,) = store.record(stored).values()
            store.used()
        return recorded.id

    for of_writer, of_collector in ((off_us, 0), (0, off_us)):
        set_clock(of_writer)
        kept = {keep(f"{of_writer} {k}".encode()) for k in range(2)}
        set_clock(of_collector)
        collect_unused(database, artifacts, project_id=client.project_id)
        set_clock(0)
        with database.read() as session:
            assert kept <= set(session.scalars(select(Blob.id).where(Blob.project_id == client.project_id)))


def test_an_object_whose_recording_has_no_answer_stays(
    database: Database, artifacts: ArtifactStore, database_settings: Settings, project_id: str
) -> None:
    """A server may commit after the connection broke: the blob would name an object that is gone."""
    spooled = SpoolWriter(database_settings.spool_dir, min_free_bytes=0).finish(b"bytes")
    writer = BlobWriter(database, artifacts, project_id=project_id, durable=False)
    stored = writer(spooled.path, sha256=spooled.sha256, size_bytes=spooled.size_bytes)
    lost = OperationalError("COMMIT", None, ConnectionResetError(), connection_invalidated=True)
    with pytest.raises(OperationalError), writer:
        raise lost
    with database.write() as session:
        blobs.record(session, project_id=project_id, **stored.identity)
    assert artifacts.sha256_of(stored.key) == spooled.sha256
