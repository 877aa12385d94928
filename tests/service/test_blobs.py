"""Which bytes belong to whom, how many they are, and when they may go; on both databases."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import insert, select, update

from service.database.connections import Database
from service.database.tables import Blob, Checkpoint, Drive, DriveFile, Job, Project, Scene, SceneFile, now_us
from service.domain.keys import create_project
from service.errors import ServiceError
from service.settings import Settings
from service.storage import blobs
from tests.helpers.live_api import settings_of
from tests.helpers.migrated import migrated
from tests.helpers.sqlite_steps import sqlite_steps

EVER_US = 2**62


@pytest.fixture
def project_id(database: Database, database_settings: Settings) -> str:
    with database.write() as session:
        project = create_project(session, "test", database_settings)
        project.max_bytes = 100
        return project.id


def record(database: Database, project_id: str, name: str, size_bytes: int = 10, **options: Any) -> str:
    with database.write() as session:
        key = blobs.new_key(project_id, name * 64)
        blob = blobs.record(session, project_id=project_id, sha256=name * 64, size_bytes=size_bytes, key=key, **options)
        return blob.id


def used(database: Database, project_id: str) -> int:
    with database.read() as session:
        return session.get_one(Project, project_id).used_bytes


def forget(database: Database, before_us: int = EVER_US) -> int:
    with database.write() as session:
        return len(blobs.forget_unused(session, untouched_since_us=before_us))


def test_a_content_is_counted_once(database: Database, project_id: str) -> None:
    assert record(database, project_id, "a") == record(database, project_id, "a")
    assert used(database, project_id) == 10


def test_the_quota_holds_to_the_byte(database: Database, project_id: str) -> None:
    record(database, project_id, "a", 90)
    with pytest.raises(ServiceError) as refused:
        record(database, project_id, "b", 11)
    assert (refused.value.status, refused.value.code) == (413, "quota-full")
    assert used(database, project_id) == 90
    record(database, project_id, "c", 10)
    record(database, project_id, "a", 90)
    record(database, project_id, "d", 5, within_quota=False)
    assert used(database, project_id) == 105


def test_the_last_bytes_are_given_once(database: Database, project_id: str) -> None:
    results: list[object] = []

    def take(name: str) -> None:
        try:
            results.append(record(database, project_id, name, 60))
        except ServiceError as error:
            results.append(error.status)

    threads = [threading.Thread(target=take, args=(name,)) for name in "abcdef"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(map(str, results))[:5] == ["413"] * 5
    assert used(database, project_id) == 60


def test_forgetting_gives_the_space_back(database: Database, project_id: str) -> None:
    for name in "abc":
        record(database, project_id, name)
    assert forget(database, now_us() - 3_600_000_000) == 0, "touched lately"
    assert forget(database) == 3
    assert used(database, project_id) == 0
    assert forget(database) == 0


def test_what_is_referred_to_is_never_forgotten(database: Database, project_id: str) -> None:
    manifest, file, scene_file, checkpoint = (record(database, project_id, name) for name in "abcd")
    with database.write() as session:
        drive = Drive(
            project_id=project_id,
            name="d",
            manifest_blob_id=manifest,
            cameras=1,
            frames=1,
            files_expected=1,
            has_gnss=False,
        )
        job = Job(project_id=project_id, kind="RECONSTRUCTION", drive_id="drv_0")
        session.add_all([drive, job])
        session.flush()
        scene = Scene(project_id=project_id, job_id=job.id, drive_id=drive.id, name="s", fence=1, summary={})
        session.add(scene)
        session.flush()
        session.add(DriveFile(drive_id=drive.id, path="a", role="image", blob_id=file))
        session.add(SceneFile(scene_id=scene.id, path="a", blob_id=scene_file, media_type="x/y"))
        session.add(Checkpoint(drive_id=drive.id, settings_sha256="0" * 64, name="n", blob_id=checkpoint))
    record(database, project_id, "e")
    assert forget(database) == 1
    with database.read() as session:
        assert set(session.scalars(select(Blob.id))) == {manifest, file, scene_file, checkpoint}
    with database.write() as session:
        session.delete(session.get_one(Drive, drive.id))
    assert forget(database) == 3, "the drive's file and checkpoint went with it"
    with database.write() as session:
        session.delete(session.get_one(Scene, scene.id))
    assert forget(database) == 1
    assert used(database, project_id) == 0


def test_a_content_that_is_found_is_not_forgotten_meanwhile(database: Database, project_id: str) -> None:
    record(database, project_id, "a")
    with database.write() as session:
        session.execute(update(Blob).values(touched_us=1))
    with database.write() as session:
        assert blobs.find(session, project_id, "a" * 64) is not None
    assert forget(database, now_us() - 3_600_000_000) == 0


def test_many_store_one_content_at_once(database: Database, project_id: str) -> None:
    found: list[str] = []
    threads = [threading.Thread(target=lambda: found.append(record(database, project_id, "a"))) for _ in range(10)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 10
    assert len(set(found)) == 1
    assert used(database, project_id) == 10


def in_threads(*steps: Callable[[], object]) -> list[Exception]:
    """Run all at the same time; what they raised."""
    raised: list[Exception] = []

    def run(step: Callable[[], object]) -> None:
        try:
            step()
        except Exception as error:
            raised.append(error)

    threads = [threading.Thread(target=run, args=(step,)) for step in steps]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return raised


def test_the_same_contents_in_another_order_at_once(database: Database, project_id: str) -> None:
    """Neither waits for the other while the other waits for it."""
    both = threading.Barrier(2)

    def store(first: str, second: str) -> None:
        with database.write() as session:
            for name in (first, second):
                key = blobs.new_key(project_id, name * 64)
                blobs.record(session, project_id=project_id, sha256=name * 64, size_bytes=1, key=key)
                if name == first:
                    meet(both)

    assert in_threads(lambda: store("a", "b"), lambda: store("b", "a")) == []
    assert used(database, project_id) == 2


def meet(both: threading.Barrier) -> None:
    """Wait for the other, unless it cannot come: where writers take turns only one is here."""
    with contextlib.suppress(threading.BrokenBarrierError):
        both.wait(1.0)


def test_recording_while_others_are_forgotten(database: Database, project_id: str) -> None:
    """Both take the project first, so that neither holds a blob that the other one needs."""
    record(database, project_id, "a")
    both = threading.Barrier(2)

    def store() -> None:
        with database.write() as session:
            for name in "ba":
                key = blobs.new_key(project_id, name * 64)
                blobs.record(session, project_id=project_id, sha256=name * 64, size_bytes=10, key=key)
                if name == "b":
                    meet(both)
                    time.sleep(0.5)  # for the other to take what it wants first

    def forget_it() -> None:
        meet(both)
        forget(database)

    assert in_threads(store, forget_it) == []
    with database.read() as session:
        left = session.scalars(select(Blob.sha256)).all()
    assert used(database, project_id) == 10 * len(left)


def test_a_content_that_was_found_and_is_gone(database: Database, project_id: str) -> None:
    """Its object is deleted: no row may name it again."""
    found: dict[str, Any] = {"project_id": project_id, "sha256": "a" * 64, "size_bytes": 10, "is_new": False}
    record(database, project_id, "a")
    with database.write() as session:
        (key,) = blobs.forget_unused(session, untouched_since_us=EVER_US)
    with pytest.raises(ServiceError) as refused, database.write() as session:
        blobs.record(session, key=key, **found)
    assert (refused.value.status, refused.value.code) == (503, "storage-changed")
    assert refused.value.problem.remedy
    with database.read() as session:
        assert session.scalars(select(Blob.key)).all() == []
    anew = record(database, project_id, "a")
    with database.write() as session:
        again = blobs.record(session, key=key, **found)
    assert again.id == anew
    assert again.key != key


def test_only_the_blobs_that_are_named_are_forgotten(database: Database, project_id: str) -> None:
    first, second, _ = (record(database, project_id, name, 7) for name in "abc")
    with database.write() as session:
        assert len(blobs.forget_unused(session, untouched_since_us=EVER_US, blob_ids=[first, second])) == 2
    assert used(database, project_id) == 7


def test_unused_blobs_are_found_page_by_page(database: Database, project_id: str) -> None:
    for name in "edcba":
        record(database, project_id, name)
    with database.read() as session:
        name_of = {blob.id: blob.sha256[0] for blob in session.scalars(select(Blob))}
    pages: list[str] = []
    last: str | None = ""
    while last is not None:
        with database.read() as session:
            page = blobs.find_unused(session, project_id, untouched_since_us=EVER_US, after_sha256=last, look_at=2)
        last = page.last_sha256
        pages.append("".join(sorted(name_of[blob_id] for blob_id in page.blob_ids)))
    assert pages == ["ab", "cd", "e", ""]


def test_a_page_reads_no_more_blobs_than_it_may(tmp_path: Path) -> None:
    """Where one in a million is unused, a statement that went on until it had its fill would read all of them."""
    settings = settings_of(tmp_path)
    migrated(settings)
    database = Database.from_settings(settings)
    with database.write() as session:
        project_id = create_project(session, "test", settings).id
        blob = {"project_id": project_id, "size_bytes": 0, "touched_us": 0}
        session.execute(insert(Blob), [{**blob, "sha256": f"{i:064}", "key": f"{i}"} for i in range(4000)])
        drive = {"project_id": project_id, "name": "d", "cameras": 1, "frames": 1, "files_expected": 1, "has_gnss": 0}
        of_blobs = session.scalars(select(Blob.id)).all()
        session.execute(insert(Drive), [{**drive, "manifest_blob_id": blob_id} for blob_id in of_blobs])

    def steps_of_page(look_at: int) -> int:
        with sqlite_steps(database) as steps, database.read() as session:
            page = blobs.find_unused(session, project_id, untouched_since_us=EVER_US, look_at=look_at)
        assert page == blobs.UnusedPage([], f"{look_at - 1:064}")
        return steps.count

    assert 0 < steps_of_page(40) < steps_of_page(4000) / 20
    database.close()


@pytest.mark.parametrize(
    ("key", "project"),
    [
        (f"blobs/prj_0a/ab/{'ab' * 32}-01234567", "prj_0a"),
        ("blobs/prj_0a/ab/.0123456789abcdef.partial", "prj_0a"),
        (f"blobs/prj_0a/ab/{'ab' * 32}-0123456", None),
        (f"blobs/prj_0a/ab/{'ab' * 32}-01234567.bak", None),
        (f"old/blobs/prj_0a/ab/{'ab' * 32}-01234567", None),
        (f"blobs/team/ab/{'ab' * 32}-01234567", None),
        ("blobs/report.pdf", None),
    ],
)
def test_keys_say_whose_they_are(key: str, project: str | None) -> None:
    assert blobs.project_of(key) == project


def test_a_new_key_says_whose_it_is(project_id: str) -> None:
    assert blobs.project_of(blobs.new_key(project_id, "ab" * 32)) == project_id
