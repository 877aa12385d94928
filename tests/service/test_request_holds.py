"""A hold of an idempotency key lives as long as its process: renewed by a thread, free soon after a kill."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import httpx
import pytest
from sqlalchemy import update
from sqlalchemy.orm import Session

from service.database.connections import Database, clock_us
from service.database.tables import Drive, IdempotencyKey, Project, now_us
from service.domain.idempotency import Answer, once
from service.domain.request_holds import HELD_FOR_S, RENEW_EVERY_S, HoldKeeper
from service.errors import ServiceError
from tests.helpers.live_api import DEADLINE_S, ApiProcess, Client, api_process, problem_of, settings_of

TRIES = 5
FREE_WITHIN_S = 10.0
SOON_S = 0.3
HELD_S = 10 * SOON_S  # a loaded machine may renew seconds late


@pytest.fixture
def keeper(database: Database) -> Iterator[HoldKeeper]:
    made = HoldKeeper(database, held_for_s=HELD_S, renew_every_s=SOON_S)
    yield made
    made.close()


class Request:
    """A request of one project under one key, whose preparation ends when it is told to."""

    def __init__(self, database: Database, project_id: str, holds: HoldKeeper) -> None:
        self.database, self.project_id, self.holds = database, project_id, holds
        self.prepared, self.go_on = threading.Event(), threading.Event()
        self.answers: list[Answer | ServiceError] = []
        self.thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        try:
            self.answers.append(self.post(self._prepare))
        except ServiceError as error:
            self.answers.append(error)

    def _prepare(self) -> None:
        self.prepared.set()
        assert self.go_on.wait(DEADLINE_S)

    def post(self, prepare: Callable[[], None] | None = None) -> Answer:
        def effect(session: Session) -> Answer:
            session.execute(update(Project).values(max_drives=Project.max_drives + 1))
            return Answer(status=201, body={})

        request = {"project_id": self.project_id, "key": "k", "request_sha256": "r"}
        return once(self.database, effect, holds=self.holds, **request, keep_us=2**50, prepare=prepare)


@pytest.fixture
def slow(database: Database, project_id: str, keeper: HoldKeeper) -> Iterator[Request]:
    request = Request(database, project_id, keeper)
    request.thread.start()
    assert request.prepared.wait(DEADLINE_S)
    yield request
    request.go_on.set()
    request.thread.join()


def effects(database: Database, project_id: str, before: int) -> int:
    with database.read() as session:
        return session.get_one(Project, project_id).max_drives - before


@pytest.fixture
def places(database: Database, project_id: str) -> int:
    with database.read() as session:
        return session.get_one(Project, project_id).max_drives


def test_a_hold_is_renewed_while_its_request_goes_on(
    database: Database, project_id: str, places: int, slow: Request
) -> None:
    end_s = time.monotonic() + 1.5 * HELD_S
    while time.monotonic() < end_s:
        with pytest.raises(ServiceError) as refused:
            slow.post()
        assert refused.value.code == "request-in-flight"
        time.sleep(SOON_S / 3)
    slow.go_on.set()
    slow.thread.join()
    assert [answer.replayed for answer in slow.answers if isinstance(answer, Answer)] == [False]
    assert slow.post().replayed
    assert effects(database, project_id, places) == 1


def test_a_hold_stays_that_is_renewed_while_another_request_waits_for_its_row(
    database: Database, keeper: HoldKeeper, slow: Request
) -> None:
    refused: list[ServiceError] = []

    def post() -> None:
        with pytest.raises(ServiceError) as problem:
            slow.post()
        refused.append(problem.value)

    other = threading.Thread(target=post)
    with database.write() as session:
        session.execute(update(IdempotencyKey).values(created_us=IdempotencyKey.created_us))  # the row is locked
        other.start()
        time.sleep(2 * SOON_S)
        session.execute(update(IdempotencyKey).values(held_until_us=clock_us(session) + keeper.held_for_us))
    other.join()
    assert [error.code for error in refused] == ["request-in-flight"]


def test_a_request_that_lost_its_hold_commits_nothing(
    database: Database, project_id: str, places: int, slow: Request
) -> None:
    with database.write() as session:  # as where its process was stopped until another request took the key over
        session.execute(update(IdempotencyKey).values(held_until_us=now_us() - 1))
    assert not slow.post().replayed
    time.sleep(2 * SOON_S)
    slow.go_on.set()
    slow.thread.join()
    (late,) = slow.answers
    assert isinstance(late, Answer)
    assert late.replayed, "it has the answer of the other"
    assert effects(database, project_id, places) == 1


def test_a_request_that_lost_its_hold_to_one_under_way_is_refused(
    database: Database, project_id: str, places: int, slow: Request
) -> None:
    with database.write() as session:
        taken_over = {"holder": "idk_another", "held_until_us": now_us() + 60_000_000}
        session.execute(update(IdempotencyKey).values(**taken_over))
    slow.go_on.set()
    slow.thread.join()
    (refused,) = slow.answers
    assert isinstance(refused, ServiceError)
    assert refused.code == "request-in-flight"
    assert effects(database, project_id, places) == 0


def test_a_hold_is_renewed_in_time() -> None:
    """Three renewals may fail before a live process loses its hold, and a dead one's is free in time."""
    assert 3 * RENEW_EVERY_S < HELD_FOR_S < FREE_WITHIN_S


# -- real processes


def held(api: ApiProcess) -> bool:
    with api.database.read() as session:
        return session.query(IdempotencyKey).filter(IdempotencyKey.status.is_(None)).count() > 0


@contextmanager
def committing(client: Client) -> Iterator[tuple[str, list[httpx.Response]]]:
    """A drive whose commit is under way and its hold there, and the answers to it once it ends.

    The check of the manifest keeps the API between hold and effect; a commit that passes before the hold is seen, as
    on a busy machine, is followed by that of another drive.
    """
    assert isinstance(client.api, ApiProcess)
    for _ in range(TRIES):
        drive_id, answers = client.filled(), list[httpx.Response]()
        thread = threading.Thread(target=_commit, args=(client, drive_id, answers))
        thread.start()
        while thread.is_alive():
            if held(client.api):
                yield drive_id, answers
                thread.join()
                return
        assert [answer.status_code for answer in answers] == [200]
    raise AssertionError(f"each of {TRIES} commits was answered before anything could happen to it")


def _commit(client: Client, drive_id: str, answers: list[httpx.Response]) -> None:
    with suppress(httpx.TransportError):
        answers.append(client.post(f"/v1/drives/{drive_id}:commit", headers=key_of(drive_id)))


def key_of(drive_id: str) -> dict[str, str]:
    return {"Idempotency-Key": f"commit-{drive_id}"}


def repeated_until_answered(client: Client, drive_id: str) -> httpx.Response:
    """The answer to the same commit, and only refusals as in flight before."""
    begin_s = time.monotonic()
    while True:
        answer = client.post(f"/v1/drives/{drive_id}:commit", headers=key_of(drive_id))
        if answer.status_code != 409:
            assert time.monotonic() - begin_s < FREE_WITHIN_S + SLACK_S
            return answer
        problem_of(answer, 409, "request-in-flight")
        time.sleep(0.2)


SLACK_S = 10.0  # of a busy machine, for the check of the manifest itself


def check_committed_once(client: Client, drive_id: str, answer: httpx.Response) -> None:
    assert answer.status_code == 200, answer.text
    assert answer.json()["state"] == "COMMITTED"
    assert [job["drive_id"] for job in client.get("/v1/jobs").json()["items"]].count(drive_id) == 1
    with client.api.database.read() as session:
        assert session.get_one(Drive, drive_id).preflight_job_id == answer.json()["preflight_job_id"]


@pytest.mark.slow
def test_a_kill_between_hold_and_effect(tmp_path: Path) -> None:
    with api_process(settings_of(tmp_path / "data"), tmp_path) as api:
        client = api.client()
        with committing(client) as (drive_id, _):
            api.kill()
        api.start()
        check_committed_once(client, drive_id, repeated_until_answered(client, drive_id))


@pytest.mark.slow
def test_an_owner_that_is_stopped_and_continued(tmp_path: Path, postgres_database: str) -> None:
    """Two hosts on one PostgreSQL: while one is stopped for 15 s, the other does what was asked; the first does not."""
    with two_hosts(tmp_path, postgres_database) as (first, second):
        client = first.client()
        other = second.client_of(client.project_id, client.key)
        with committing(client) as (drive_id, answers):
            assert first.process is not None
            os.kill(first.process.pid, signal.SIGSTOP)
            try:
                begin_s = time.monotonic()
                taken_over = repeated_until_answered(other, drive_id)
                time.sleep(max(0.0, 15.0 - (time.monotonic() - begin_s)))
            finally:
                os.kill(first.process.pid, signal.SIGCONT)
        check_committed_once(other, drive_id, taken_over)
        assert answers[0].headers["idempotent-replayed"] == "true"
        assert answers[0].json() == taken_over.json()


@pytest.mark.slow
def test_a_live_host_keeps_its_hold_and_a_dead_one_does_not(tmp_path: Path, postgres_database: str) -> None:
    with two_hosts(tmp_path, postgres_database) as (first, second):
        client = first.client()
        other = second.client_of(client.project_id, client.key)
        with committing(client) as (drive_id, _):
            problem_of(other.post(f"/v1/drives/{drive_id}:commit", headers=key_of(drive_id)), 409, "request-in-flight")
            first.kill()
        check_committed_once(other, drive_id, repeated_until_answered(other, drive_id))


@contextmanager
def two_hosts(tmp_path: Path, url: str) -> Iterator[tuple[ApiProcess, ApiProcess]]:
    """Two APIs with folders of their own, over one database and one artifact store."""
    store = f"file://{tmp_path}/store"
    shared = {"MRASFM_DATABASE_URL": url, "MRASFM_ARTIFACTS_URL": store}
    first, second = tmp_path / "first", tmp_path / "second"
    for folder in (first, second, tmp_path / "store"):
        folder.mkdir()
    given = {"database_url": url, "artifacts_url": store}
    with (
        api_process(settings_of(first / "data", **given), first, **shared) as one,
        api_process(settings_of(second / "data", **given), second, **shared) as two,
    ):
        yield one, two
