"""Several who write the files of one project at the same time; on both databases: each has locks of its own."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Callable
from typing import Any

import httpx
import pytest
from sqlalchemy import text, update
from sqlalchemy.exc import DBAPIError

from schemas.drive import DriveManifest
from service.database.connections import Database
from service.database.tables import Project
from service.domain import drive_files, drives
from service.domain.keys import create_project
from service.domain.manifest_facts import facts_of
from service.errors import ServiceError
from service.settings import Settings
from service.storage import blobs
from service.storage.blob_writer import StoredFile
from tests.helpers.live_api import Api, Client
from tests.helpers.tiny_drive import manifest, tiny_drive, zip_of
from tests.helpers.tus_client import begin, patch
from tests.service.test_blobs import in_threads, meet

PATH = "front/000000.png"


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def api(request: pytest.FixtureRequest, api: Api) -> Api:
    """One over each database."""
    served: Api = api if request.param == "sqlite" else request.getfixturevalue("postgres_api")
    return served


def statuses_of(client: Client, *requests: Callable[[Client], httpx.Response]) -> list[int]:
    """Of requests that are made at the same time."""
    barrier = threading.Barrier(len(requests))
    answers: list[httpx.Response] = []

    def make(request: Callable[[Client], httpx.Response]) -> None:
        own = client.api.client_of(client.project_id, client.key)
        own.get("/v1/drives")  # connected
        barrier.wait()
        answers.append(request(own))

    assert in_threads(*(lambda request=request: make(request) for request in requests)) == []
    return sorted(answer.status_code for answer in answers)


@pytest.mark.parametrize("replace", ["true", "false"])
def test_the_same_bytes_twice_at_once(client: Client, replace: str) -> None:
    drive = tiny_drive(seed=f"twice {replace}", frames=3)
    drive_id = client.create(drive)
    for path, data in drive.files.items():
        url = f"/v1/drives/{drive_id}/files/{path}"

        def put(own: Client, url: str = url, data: bytes = data) -> httpx.Response:
            return own.put(url, content=data, params={"replace": replace})

        assert statuses_of(client, put, put) == [200, 201]


def test_the_same_bytes_twice_at_once_as_resumable_uploads(client: Client) -> None:
    drive = tiny_drive(seed="twice resumed")
    drive_id = client.create(drive)
    for path, data in drive.files.items():
        urls = [begin(client, drive_id, path, data) for _ in range(2)]
        requests = [lambda own, url=url, data=data: patch(own, url, 0, data) for url in urls]
        assert statuses_of(client, *requests) == [204, 204]
        assert [client.head(url, headers={"Tus-Resumable": "1.0.0"}).status_code for url in urls] == [200, 200]


def test_a_declaration_while_an_archive_comes(client: Client) -> None:
    drive = tiny_drive(seed="declared", frames=60)
    client.filled(drive)
    backwards = sorted(drive.files, key=lambda path: hashlib.sha256(drive.files[path]).hexdigest(), reverse=True)
    archive = zip_of({path: drive.files[path] for path in backwards})
    for _ in range(3):
        first, second = client.create(drive), client.create(drive)
        declare = f"/v1/drives/{first}/files:declare"
        unpack = f"/v1/drives/{second}/archive"
        assert statuses_of(
            client,
            lambda own, url=declare: own.post(url, json=drive.declaration),
            lambda own, url=unpack: own.put(url, content=archive),
        ) == [200, 200]


# -- on the database alone, step by step


@pytest.fixture
def drive_id(database: Database, project_id: str) -> str:
    facts = facts_of(DriveManifest.model_validate(manifest()))
    with database.write() as session:
        drive = drives.create(
            session,
            project_id=project_id,
            manifest=facts,
            rows=drives.rows_of(facts),
            stored=stored("0", project_id),
            expires_us=None,
        )
        return drive.id


def stored(name: str, project_id: str) -> StoredFile:
    key = blobs.new_key(project_id, name * 64)
    return StoredFile(sha256=name * 64, size_bytes=1, key=key, is_new=True)


@pytest.fixture
def overtaken(database: Database, project_id: str, drive_id: str) -> Callable[[str, str, bool], bool]:
    """Fill a slot that another upload fills after this one has looked at it; whether the bytes were new."""
    if database.engine.dialect.name == "sqlite":
        pytest.skip("writers take turns from the start")

    def fill(first: str, second: str, replace: bool) -> bool:
        with database.write() as session:
            slot = drive_files.find(session, project_id, drive_id, PATH, lock=True)
            with database.write() as other:
                found = drive_files.find(other, project_id, drive_id, PATH, lock=True)
                drive_files.fill(other, found, stored(first, project_id), replace=False)
            return drive_files.fill(session, slot, stored(second, project_id), replace=replace) is not None

    return fill


def content(database: Database, project_id: str, drive_id: str) -> str | None:
    with database.read() as session:
        sha256 = drive_files.find(session, project_id, drive_id, PATH).sha256
    return None if sha256 is None else sha256[0]


@pytest.mark.parametrize("replace", [True, False])
def test_overtaken_by_the_same_bytes(overtaken: Callable[[str, str, bool], bool], replace: bool) -> None:
    assert not overtaken("a", "a", replace)


def test_overtaken_by_others(
    database: Database, project_id: str, drive_id: str, overtaken: Callable[[str, str, bool], bool]
) -> None:
    with pytest.raises(ServiceError, match="a" * 64) as refused:
        overtaken("a", "b", False)
    assert refused.value.code == "file-exists"
    assert content(database, project_id, drive_id) == "a"


def test_overtaken_by_others_they_are_replaced(
    database: Database, project_id: str, drive_id: str, overtaken: Callable[[str, str, bool], bool]
) -> None:
    assert overtaken("a", "b", True)
    assert content(database, project_id, drive_id) == "b"


def test_known_files_are_looked_for_while_others_are_recorded(
    database: Database, project_id: str, drive_id: str
) -> None:
    """Both take the project first, so that neither holds a blob that the other one needs."""
    names = "ab"
    with database.write() as session:
        drive = drives.get(session, project_id, drive_id, lock=True)
        recorded = [blobs.record(session, project_id=project_id, **stored(name, project_id).identity) for name in names]
        paths = (PATH, "rear/000000.png")
        ids = {path: blob.id for path, blob in zip(paths, recorded, strict=True)}
        drive_files.fill_all(session, drive, ids, replace=False)
    both = threading.Barrier(2)

    def record() -> None:
        with database.write() as session:
            blobs.record(session, project_id=project_id, **stored("b", project_id).identity)
            meet(both)
            time.sleep(0.5)  # for the other to take what it wants first
            blobs.record(session, project_id=project_id, **stored("a", project_id).identity)

    def declare() -> None:
        meet(both)
        with database.write() as session:
            assert len(drives.known_files(session, project_id, [name * 64 for name in names])) == 2

    assert in_threads(record, declare) == []


def test_a_deadlock_is_no_error(database: Database, project_id: str, database_settings: Settings) -> None:
    """One of the two is ended by the database, and done once more."""
    with database.write() as session:
        other_id = create_project(session, "other", database_settings).id
    both = threading.Barrier(2)
    runs: list[str] = []

    def rename(first: str, second: str) -> None:
        def work(session: Any) -> None:
            runs.append(first)
            for i, project in enumerate((first, second)):
                session.execute(update(Project).where(Project.id == project).values(max_drives=Project.max_drives + 1))
                if i == 0 and len(runs) <= 2:
                    meet(both)

        database.transact(work)

    assert in_threads(lambda: rename(project_id, other_id), lambda: rename(other_id, project_id)) == []
    if database.engine.dialect.name == "sqlite":
        assert len(runs) == 2
    else:
        assert len(runs) >= 3, "both may be ended, where both look for deadlocks at one moment"
    with database.read() as session:
        before, after = database_settings.project_max_drives, session.get_one(Project, other_id).max_drives
    assert after == before + 2


def test_an_error_does_not_tell_what_was_given(database: Database) -> None:
    with pytest.raises(DBAPIError, match="nowhere") as failed, database.write() as session:
        session.execute(text("SELECT * FROM nowhere WHERE given = :given"), {"given": "secret"})
    assert "secret" not in str(failed.value)
