"""Bytes that nothing needs are deleted, and leave the quota."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
from sqlalchemy import insert, select, update

from service.database.connections import Database
from service.database.tables import Blob, Project, new_id, now_us
from service.domain.keys import create_project
from service.settings import Settings
from service.storage import blob_writer, blobs, garbage_collection
from service.storage.artifacts import ArtifactStore
from service.storage.blob_writer import BlobWriter, store_file
from service.storage.garbage_collection import collect_orphans, collect_unused
from service.storage.spool import SpoolWriter
from tests.helpers.live_api import Api, Client, wait_until
from tests.helpers.tiny_drive import tiny_drive

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


@pytest.fixture
def artifacts(database_settings: Settings) -> ArtifactStore:
    return ArtifactStore(database_settings)


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
        earlier.setattr(blob_writer, "now_us", lambda: now_us() - _TWO_HOURS_US)
        begun = BlobWriter(database, artifacts, project_id=project_id, durable=False)
        stored = begun.store_all([writer.finish(b"bytes")])
    with begun as store:
        store.record(stored)
        assert collect_unused(database, artifacts) == 0
        store.used()
    with database.read() as session:
        assert session.scalars(select(Blob.key)).all() == [stored[0].key]
