"""Deletions while other transactions want the same rows."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import psycopg.errors
import pytest
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from schemas.api.drives import DriveState, PreflightState
from service.database.connections import Database
from service.database.tables import Blob, Drive, Job, JobState, new_id
from service.domain import drives, exports, jobs
from service.domain.jobs import _completion
from tests.helpers.live_api import SCENE_FILES, Api, Client
from tests.helpers.tiny_drive import tiny_drive
from tests.service.test_aggregations_at_once import claimed, meanwhile


@pytest.fixture
def check(database: Database, project_id: str) -> jobs.Claim:
    """The check of a drive that was just committed, at work."""
    with database.write() as session:
        blob = Blob(id=new_id("blb"), project_id=project_id, sha256="ab" * 32, size_bytes=1, key="k")
        session.add(blob)
        session.flush()
        drive = Drive(
            id=new_id("drv"), project_id=project_id, name="d", has_gnss=True, manifest_blob_id=blob.id, cameras=2,
            frames=2, files_expected=0,
        )  # fmt: skip
        session.add(drive)
        session.flush()
        job = drives.commit(session, drive, [])
    return claimed(database, job.id)


def test_a_check_ends_while_its_drive_is_deleted(
    database: Database, project_id: str, check: jobs.Claim, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The check holds its job when the deletion begins, and wants the drive."""
    drive_id, succeed = str(check.drive_id), jobs.succeed

    def remove() -> None:
        with database.write() as session:
            drives.remove(session, project_id, drive_id)

    with meanwhile(database, remove) as (session, begin):

        def succeed_and_begin(session: Session, held: jobs.Claim) -> None:
            succeed(session, held)
            begin()

        monkeypatch.setattr(_completion, "succeed", succeed_and_begin)
        jobs.record_findings(session, check, [], sound=True)
        session.flush()
        found = session.get_one(Drive, drive_id)
        assert (found.state, found.preflight_state) == (DriveState.COMMITTED, PreflightState.PASSED)
    with database.read() as session:
        assert session.get(Drive, drive_id) is None
        assert session.get_one(Job, check.job_id).state == JobState.SUCCEEDED


def test_a_check_is_cancelled_with_its_drive(database: Database, project_id: str, check: jobs.Claim) -> None:
    with database.write() as session:
        drives.remove(session, project_id, str(check.drive_id))
    with database.read() as session:
        assert session.get_one(Job, check.job_id).cancel_requested_us is not None


@pytest.fixture
def end_first(api: Api, monkeypatch: pytest.MonkeyPatch) -> Callable[[], list[str]]:
    """A function that lets the database end the next transaction for another one's sake; it is in the list then."""
    write: Callable[..., Any] = Database.write
    ended: list[str] = []

    @contextmanager
    def write_or_end(database: Database, **options: bool) -> Iterator[Session]:
        with write(database, **options) as session:
            yield session
            if not ended:
                ended.append("deadlock")
                raise OperationalError("COMMIT", {}, psycopg.errors.DeadlockDetected())

    def begin() -> list[str]:
        ended.clear()
        monkeypatch.setattr(api.context.database, "write", write_or_end.__get__(api.context.database))
        return ended

    return begin


def test_what_the_database_ends_for_another_ones_sake_is_done_again(
    client: Client, end_first: Callable[[], list[str]]
) -> None:
    open_drive = tiny_drive("open", seed="open")
    open_id, path = client.filled(open_drive), next(iter(open_drive.files))
    drive_id, scene_id, export_id, map_id = made(client)
    webhook = client.post("/v1/webhooks", json={"url": "https://example.org/jobs"}).json()
    for method, url, body, status in (
        ("DELETE", f"drives/{open_id}/files/{path}", None, 204),
        ("PUT", f"maps/{map_id}/current-version", {"version": 1}, 200),
        ("DELETE", f"maps/{map_id}/versions/2", None, 204),
        ("DELETE", f"maps/{map_id}", None, 204),
        ("DELETE", f"exports/{export_id}", None, 204),
        ("DELETE", f"scenes/{scene_id}", None, 204),
        ("DELETE", f"drives/{drive_id}", None, 204),
        ("DELETE", f"webhooks/{webhook['id']}", None, 204),
    ):
        ended = end_first()
        answer = client.request(method, f"/v1/{url}", json=body)
        assert answer.status_code == status, (url, answer.text)
        assert ended == ["deadlock"]
    assert scene_id not in [scene["id"] for scene in client.get("/v1/scenes").json()["items"]]


def made(client: Client) -> tuple[str, str, str, str]:
    """A drive, its scene, an export of that, and a map of two versions."""
    found = [client.frozen(tiny_drive(name, seed=name)) for name in ("one", "two", "three")]
    scenes = [client.publish(client.claim(client.reconstruct(drive_id)["id"]), SCENE_FILES) for drive_id in found]
    job = client.aggregate(scenes=scenes[:2])
    client.publish_map(client.claim(job["id"]), {"report.json": b"{}"})
    job = client.aggregate(map_id=job["map_id"], scenes=scenes[2:])
    client.publish_map(client.claim(job["id"]), {"report.json": b"{}"})
    asked = client.post(f"/v1/scenes/{scenes[0]}/exports", json={"formats": ["kitti"]}).json()
    held = client.claim(asked["job_id"])
    with client.api.database.write() as session:
        exports.publish(session, held, files={}, results=[], expires_us=None)
    return found[0], scenes[0], asked["id"], job["map_id"]
