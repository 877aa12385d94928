"""A POST under an Idempotency-Key has its effect once, whatever is killed."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from sqlalchemy import update
from sqlalchemy.orm import Session

from service.database.connections import Database
from service.database.tables import IdempotencyKey, Project, now_us
from service.domain.idempotency import Answer, once
from service.domain.keys import create_project
from service.domain.request_holds import HELD_FOR_S, HoldKeeper
from service.errors import ServiceError, not_found
from service.settings import Settings
from tests.helpers.live_api import DEADLINE_S, Client, problem_of
from tests.helpers.tiny_drive import tiny_drive
from tests.service.conftest import StartApi

HOUR_US = 3_600_000_000
KEY = {"Idempotency-Key": "first-try"}


def test_the_answer_is_replayed(client: Client) -> None:
    raw = tiny_drive().raw
    first = client.post("/v1/drives", content=raw, headers=KEY)
    again = client.post("/v1/drives", content=raw, headers=KEY)
    assert (first.status_code, again.status_code) == (201, 201)
    assert again.content == first.content
    assert again.headers["location"] == first.headers["location"]
    assert again.headers["idempotent-replayed"] == "true"
    assert "idempotent-replayed" not in first.headers
    assert len(client.get("/v1/drives").json()["items"]) == 1


def test_every_post_is_replayed(client: Client) -> None:
    drive_id = client.filled()
    commit = [client.post(f"/v1/drives/{drive_id}:commit", headers=KEY).json() for _ in range(2)]
    assert commit[0] == commit[1]
    ask = {"Idempotency-Key": "ask"}
    (job, again) = (client.reconstruct(drive_id, **ask) for _ in range(2))
    assert job == again
    url = f"/v1/jobs/{job['id']}"
    for action in ("cancel", "retry"):
        answers = [client.post(f"{url}:{action}", headers={"Idempotency-Key": action}) for _ in range(2)]
        assert [answer.status_code for answer in answers] == [202, 202]
        assert answers[0].json() == answers[1].json()
    assert len(client.get("/v1/jobs", params={"drive_id": drive_id}).json()["items"]) == 3


def test_another_request_under_the_key_is_refused(client: Client) -> None:
    drive_id = client.frozen()
    job = client.reconstruct(drive_id, **KEY)
    other_body = client.post("/v1/reconstructions", json={"drive_id": drive_id, "settings": {"seed": 1}}, headers=KEY)
    problem_of(other_body, 422, "idempotency-key-reused")
    other_path = client.post(f"/v1/jobs/{job['id']}:cancel", headers=KEY)
    problem_of(other_path, 422, "idempotency-key-reused")
    assert client.get(f"/v1/jobs/{job['id']}").json()["state"] == "QUEUED"


def test_a_key_is_of_one_project(client: Client) -> None:
    other = client.api.client()
    assert client.create(**KEY) != other.create(**KEY)


def test_a_key_is_free_after_an_error(client: Client) -> None:
    drive = tiny_drive()
    drive_id = client.create(drive)
    problem_of(client.post(f"/v1/drives/{drive_id}:commit", headers=KEY), 409, "drive-incomplete")
    client.send_files(drive_id, drive)
    assert client.post(f"/v1/drives/{drive_id}:commit", headers=KEY).status_code == 200


@pytest.mark.parametrize("key", ["", "a b", "x" * 256, "schlüssel"])
def test_keys_that_are_refused(client: Client, key: str) -> None:
    answer = client.post("/v1/drives", content=tiny_drive().raw, headers={"Idempotency-Key": key.encode()})
    problem = problem_of(answer, 422, "invalid-request")
    assert problem["errors"][0]["field"] == "header.Idempotency-Key"


def test_two_requests_at_once_have_one_effect(client: Client) -> None:
    raw = tiny_drive().raw
    barrier = threading.Barrier(6)
    answers: list[Any] = []

    def post() -> None:
        own = client.api.client_of(client.project_id, client.key)
        barrier.wait()
        answers.append(own.post("/v1/drives", content=raw, headers=KEY))

    threads = [threading.Thread(target=post) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    created = {answer.json()["id"] for answer in answers if answer.status_code == 201}
    refused = [answer for answer in answers if answer.status_code != 201]
    for answer in refused:
        problem_of(answer, 409, "request-in-flight")
        assert answer.headers["retry-after"] == "1"
    assert len(created) == 1
    assert [drive["id"] for drive in client.get("/v1/drives").json()["items"]] == list(created)


def test_a_key_is_forgotten_after_its_time(start_api: StartApi) -> None:
    client = start_api(idempotency_hours=1 / 3600 / 10).client()
    first = client.create(**KEY)
    threading.Event().wait(0.2)
    assert client.create(**KEY) != first


@pytest.fixture
def project(database: Database, database_settings: Settings) -> Project:
    with database.write() as session:
        return create_project(session, "test", database_settings)


@pytest.fixture
def holds(database: Database) -> Iterator[HoldKeeper]:
    keeper = HoldKeeper(database)
    yield keeper
    keeper.close()


Run = Callable[..., Answer]


@pytest.fixture
def run(database: Database, project: Project, holds: HoldKeeper) -> Run:
    """`once` with an effect that renames the project."""

    def call(effect: Callable[[Session], Any] = lambda session: None, request: str = "r") -> Answer:
        def named(session: Session) -> Answer:
            effect(session)
            session.execute(update(Project).values(max_drives=Project.max_drives + 1))
            return Answer(status=201, body={"n": 1}, headers={"Location": "/x"})

        request_of = {"project_id": project.id, "key": "k", "request_sha256": request}
        return once(database, named, holds=holds, **request_of, keep_us=24 * HOUR_US)

    return call


def effects(database: Database, project: Project) -> int:
    with database.read() as session:
        return session.get_one(Project, project.id).max_drives - project.max_drives


def test_a_request_in_flight_on_both_databases(database: Database, project: Project, run: Run) -> None:
    inside, go_on = threading.Event(), threading.Event()

    def slow(session: Session) -> None:
        inside.set()
        assert go_on.wait(DEADLINE_S)

    # SQLite has one writer: there, the second request can only wait for the first one's transaction.
    waits = database.engine.dialect.name == "sqlite"
    first: list[Answer] = []
    thread = threading.Thread(target=lambda: first.append(run(slow)))
    thread.start()
    assert inside.wait(DEADLINE_S)
    if waits:
        go_on.set()
        thread.join()
        assert run().replayed
    else:
        with pytest.raises(ServiceError) as refused:
            run()
        assert (refused.value.status, refused.value.code) == (409, "request-in-flight")
        go_on.set()
        thread.join()
        assert run().replayed
    assert first[0].body == {"n": 1}
    assert effects(database, project) == 1


def test_the_answer_and_the_effect_are_one_transaction(database: Database, project: Project, run: Run) -> None:
    class Killed(BaseException):
        pass

    def dies(session: Session) -> None:
        session.execute(update(Project).values(name="half done"))
        raise Killed

    with pytest.raises(Killed):
        run(dies)
    assert effects(database, project) == 0
    assert not run().replayed
    assert effects(database, project) == 1
    answer = run()
    assert (answer.replayed, answer.status, answer.body, answer.headers) == (True, 201, {"n": 1}, {"Location": "/x"})
    assert effects(database, project) == 1


def test_a_preparation_runs_under_the_key_and_outside_the_transaction(
    database: Database, project: Project, holds: HoldKeeper
) -> None:
    prepared: list[str | None] = []

    def prepare() -> None:
        with database.write() as session:  # would wait for ever within the transaction
            prepared.append(session.get_one(IdempotencyKey, (project.id, "k")).holder)
        if len(prepared) == 1:
            raise not_found("drive", "x")

    def effect(session: Session) -> Answer:
        return Answer(status=200, body={})

    def run_prepared() -> Answer:
        request = {"project_id": project.id, "key": "k", "request_sha256": "r"}
        return once(database, effect, holds=holds, **request, keep_us=24 * HOUR_US, prepare=prepare)

    with pytest.raises(ServiceError):
        run_prepared()
    assert [run_prepared().replayed for _ in range(2)] == [False, True]
    assert len(set(prepared)) == 2


def test_an_error_frees_the_key_for_any_request(database: Database, project: Project, run: Run) -> None:
    def refused(session: Session) -> None:
        raise not_found("drive", "x")

    with pytest.raises(ServiceError):
        run(refused)
    assert not run(request="another").replayed


def test_a_holder_that_died_is_succeeded_after_a_while(database: Database, project: Project, run: Run) -> None:
    row = {"project_id": project.id, "key": "k", "request_sha256": "r", "holder": "idk_dead"}
    with database.write() as session:
        session.add(IdempotencyKey(**row, held_until_us=now_us() + int(HELD_FOR_S * 1e6)))
    with pytest.raises(ServiceError) as refused:
        run()
    assert refused.value.code == "request-in-flight"
    with database.write() as session:
        session.execute(update(IdempotencyKey).values(held_until_us=now_us() - 1))
    assert not run().replayed
    assert effects(database, project) == 1


def test_a_hold_from_before_the_clock_was_set_back_is_none(database: Database, project: Project, run: Run) -> None:
    row = {"project_id": project.id, "key": "k", "request_sha256": "r", "holder": "idk_dead"}
    with database.write() as session:
        session.add(IdempotencyKey(**row, held_until_us=now_us() + HOUR_US))
    assert not run().replayed
    assert effects(database, project) == 1


def test_a_holder_that_was_succeeded_has_no_effect(database: Database, project: Project, run: Run) -> None:
    def slow(session: Session) -> None:
        session.execute(update(IdempotencyKey).values(holder="idk_another"))

    with pytest.raises(ServiceError) as refused:
        run(slow)
    assert refused.value.code == "request-in-flight"
    assert effects(database, project) == 0


def test_an_old_key_is_new_again(database: Database, project: Project, run: Run) -> None:
    run()
    with database.write() as session:
        session.execute(update(IdempotencyKey).values(created_us=now_us() - 24 * HOUR_US - 1))
    assert not run(request="another").replayed
    assert effects(database, project) == 2
