"""Aggregations that are asked for while jobs end and retention dates pass, on both databases."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress

import pytest
from sqlalchemy import select, text, update
from sqlalchemy.orm import Session

from schemas.api.aggregations import AggregationRequest
from schemas.api.drives import DriveState
from schemas.api.jobs import JobKind
from service.database.connections import Database
from service.database.tables import Blob, Drive, Job, JobMember, JobState, Map, Scene, new_id, now_us
from service.domain import aggregations, jobs, maps, scenes
from service.domain.checkpoints import settings_sha256
from service.settings import Settings
from service.storage import blobs
from tests.helpers.live_api import SUMMARY, wait_until
from worker.reconciler import Reconciler

LEASE_US = 60_000_000


@pytest.fixture
def drives(database: Database, project_id: str) -> list[str]:
    """Two drives that are committed."""
    with database.write() as session:
        blob = Blob(id=new_id("blb"), project_id=project_id, sha256="ab" * 32, size_bytes=1, key="k")
        session.add(blob)
        session.flush()
        made = [
            Drive(
                id=new_id("drv"), project_id=project_id, name=f"drive-{i}", state=DriveState.COMMITTED, has_gnss=True,
                manifest_blob_id=blob.id, cameras=2, frames=2, files_expected=4,
            )
            for i in range(2)
        ]  # fmt: skip
        session.add_all(made)
        return [drive.id for drive in made]


def claimed(database: Database, job_id: str) -> jobs.Claim:
    with database.write() as session:
        held = jobs.claim(session, job_id, owner="w", lease_us=LEASE_US)
    assert held is not None
    return held


def reconstructing(database: Database, project_id: str, drive_id: str) -> jobs.Claim:
    settings = AggregationRequest().settings.model_dump(mode="json", exclude_none=True)
    with database.write() as session:
        job = jobs.create(
            session, project_id=project_id, kind=JobKind.RECONSTRUCTION, drive_id=drive_id, settings=settings
        )
    return claimed(database, job.id)


def ask(database: Database, project_id: str, **asked: object) -> Job:
    with database.write() as session:
        request = AggregationRequest.model_validate(asked)
        return aggregations.create(session, project_id=project_id, asked=request, job_expires_us=None)[0]


def publish(database: Database, held: jobs.Claim) -> str:
    with database.write() as session:
        return scenes.publish(session, held, files={}, summary=SUMMARY, expires_us=None)


@contextmanager
def meanwhile(database: Database, step: Callable[[], object]) -> Iterator[tuple[Session, Callable[[], None]]]:
    """A transaction, and what begins a step beside it and waits until that waits for a lock.

    The step has ended, and raised nothing, where the block has.
    """
    errors: list[BaseException] = []

    def run() -> None:
        try:
            step()
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=run)

    def begin() -> None:
        thread.start()
        wait_for_lock(database)

    with database.write() as session:
        yield session, begin
    thread.join()
    assert errors == []


def wait_for_lock(database: Database) -> None:
    """Until another transaction waits for what this one holds."""
    if database.engine.dialect.name == "sqlite":
        time.sleep(0.2)  # it waits for its turn to write
        return
    statement = text(
        "SELECT count(*) FROM pg_stat_activity WHERE datname = current_database() AND wait_event_type = 'Lock'"
    )

    def waits() -> bool:
        with database.engine.connect() as connection:
            return bool(connection.scalar(statement))

    wait_until(waits, "a wait for a lock")


def test_a_reconstruction_ends_while_it_is_asked_for(database: Database, project_id: str, drives: list[str]) -> None:
    """Its scene is taken: nothing is made twice, and neither transaction waits for the other for ever."""
    held = reconstructing(database, project_id, drives[0])
    asked: list[Job] = []
    with meanwhile(database, lambda: asked.append(ask(database, project_id, drives=drives))) as (session, begin):
        jobs.succeed(session, held, scene_id="scn_1")
        begin()
        summary = SUMMARY.model_dump(mode="json")
        digest = settings_sha256(held.settings)
        session.add(
            Scene(
                id="scn_1", project_id=project_id, job_id=held.job_id, drive_id=drives[0], name="s", fence=held.fence,
                settings_sha256=digest, summary=summary,
            )
        )  # fmt: skip
        session.flush()
        blobs.record(session, project_id=project_id, sha256="cd" * 32, size_bytes=1, key="l")
    with database.read() as session:
        member = session.get_one(JobMember, (asked[0].id, drives[0]))
        assert (member.scene_id, member.child_id) == ("scn_1", None)


def test_two_reconstructions_end_at_one_time(database: Database, project_id: str, drives: list[str]) -> None:
    """The second sees that the first has ended: the aggregation begins at once."""
    first, second = (reconstructing(database, project_id, drive) for drive in drives)
    job = ask(database, project_id, drives=drives)
    with meanwhile(database, lambda: publish(database, second)) as (session, begin):
        scenes.publish(session, first, files={}, summary=SUMMARY, expires_us=None)
        begin()
    with database.read() as session:
        assert job.id in {due.id for due in jobs.all_due(session)}


def test_a_retention_date_passes_while_it_is_asked_for(database: Database, project_id: str, drives: list[str]) -> None:
    """What the aggregation needs from now on stays."""
    made = [publish(database, reconstructing(database, project_id, drive)) for drive in drives]
    with database.write() as session:
        session.execute(update(Scene).values(expires_us=1))
        session.add(Map(id="map_1", project_id=project_id, name="m", expires_us=1))

    def forget() -> None:
        with database.write() as session:
            maps.forget_expired(session, now_us())

    with meanwhile(database, forget) as (session, begin):
        request = AggregationRequest(scenes=made, map_id="map_1")
        aggregations.create(session, project_id=project_id, asked=request, job_expires_us=1)
        begin()
    with database.read() as session:
        assert session.get(Map, "map_1") is not None
        assert {scene.id for scene in session.scalars(select(Scene))} == set(made)
    with database.write() as session:
        session.execute(update(Job).values(state=JobState.CANCELLED))
    forget()
    with database.read() as session:
        assert session.get(Map, "map_1") is None
        assert session.scalars(select(Scene)).all() == []


def test_a_drive_that_an_aggregation_waits_with_stays(
    database: Database, database_settings: Settings, project_id: str, drives: list[str]
) -> None:
    """Its reconstruction has ended, and the map that will name it is not there yet."""
    held = reconstructing(database, project_id, drives[0])
    job = ask(database, project_id, drives=drives)
    publish(database, held)
    with database.write() as session:
        session.execute(update(Drive).values(expires_us=1))
    sweep(database_settings)
    with database.read() as session:
        assert session.get(Drive, drives[0]) is not None
    cancelled = [job.id, *(str(m.child_id) for m, _ in _members(database, job.id) if m.scene_id is None)]
    for job_id in cancelled:
        with database.write() as session:
            jobs.request_cancel(session, job_id)
    sweep(database_settings)
    with database.read() as session:
        assert session.get(Drive, drives[0]) is None


def sweep(settings: Settings) -> None:
    with closing(Reconciler(settings)) as reconciler:
        reconciler.sweep()


def _members(database: Database, job_id: str) -> list[tuple[JobMember, Job | None]]:
    with database.read() as session:
        return jobs.members_of(session, [job_id])[job_id]


def test_two_new_maps_are_asked_for_at_one_time(
    database: Database, project_id: str, drives: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both have recorded their map when the first of them takes its places in the project's quota."""
    made = [publish(database, reconstructing(database, project_id, drive)) for drive in drives]
    require_places, both = jobs.require_places, threading.Barrier(2)

    def require_places_together(session: Session, project_id: str, count: int) -> None:
        with suppress(threading.BrokenBarrierError):  # SQLite's writers take turns
            both.wait(0.5)
        require_places(session, project_id, count)

    monkeypatch.setattr(jobs, "require_places", require_places_together)
    with ThreadPoolExecutor(2) as pool:
        asked = list(pool.map(lambda _: ask(database, project_id, scenes=made), range(2)))
    assert len({job.map_id for job in asked}) == 2
