"""Is it alive, ready, well: what operators see."""

from __future__ import annotations

import json
import logging
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families
from sqlalchemy import event, insert, text, update

from schemas.api.jobs import JobKind
from service.api.routes import drives as drive_routes
from service.database.tables import Job, Pass, WorkerSeen, new_id, now_us
from service.domain import passes, workers
from service.logs import JsonFormatter, log_fields
from service.settings import Settings
from tests.helpers.live_api import HOST, Api, Client, api_in_thread, free_port, problem_of, wait_until
from tests.helpers.sqlite_steps import sqlite_steps
from tests.helpers.tiny_drive import tiny_drive
from tests.service.conftest import StartApi

QUICK_S = 10.0  # generous: a broker that hangs would cost much more


def metrics_of(api: Api) -> dict[str, float]:
    answer = httpx.get(f"{api.url}/metrics", timeout=60)
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/plain; version=0.0.4")
    samples = (sample for family in text_string_to_metric_families(answer.text) for sample in family.samples)
    return {f"{sample.name}{json.dumps(sample.labels, sort_keys=True)}": sample.value for sample in samples}


def test_metrics_behind_a_token(start_api: StartApi) -> None:
    token = "a-token-of-the-operator/1+2="
    api = start_api(metrics_token=token)
    own_key = api.client().key
    for given in (None, "", "Bearer", f"Bearer {token}x", f"Basic {token}", token, f"Bearer {own_key}", "Bearer \xff"):
        headers = {} if given is None else {"Authorization": given.encode("latin-1")}
        answer = httpx.get(f"{api.url}/metrics", headers=headers)
        problem = problem_of(answer, 401, "unauthorized")
        assert "MRASFM_METRICS_TOKEN" in problem["remedy"]
        assert answer.headers["www-authenticate"].startswith("Bearer ")
        assert "mrasfm_" not in answer.text
    for method in ("GET", "HEAD"):
        answer = httpx.request(method, f"{api.url}/metrics", headers={"Authorization": f"Bearer {token}"})
        assert answer.status_code == 200
        assert httpx.request(method, f"{api.url}/metrics").status_code == 401
    page = httpx.get(f"{api.url}/openapi.json").json()
    shown = page["paths"]["/metrics"]["get"]
    (scheme,) = (name for each in shown["security"] for name in each)
    assert page["components"]["securitySchemes"][scheme]["scheme"] == "bearer"
    assert "401" in shown["responses"]
    assert token not in json.dumps(page)


def test_metrics_without_a_token_are_open(api: Api, page: dict[str, Any]) -> None:
    assert httpx.get(f"{api.url}/metrics").status_code == 200
    assert "security" not in page["paths"]["/metrics"]["get"]


def test_alive_and_ready(api: Api) -> None:
    assert httpx.get(f"{api.url}/livez").json() == {"status": "alive"}
    assert httpx.get(f"{api.url}/readyz").json() == {"status": "ready"}


def test_not_ready_without_the_artifact_store(start_api: StartApi) -> None:
    api = start_api()
    folder = api.settings.data_dir / "artifacts"
    folder.write_bytes(b"")
    problem = problem_of(httpx.get(f"{api.url}/readyz"), 503, "not-ready")
    assert "artifact store" in problem["detail"]
    assert httpx.get(f"{api.url}/livez").status_code == 200


def test_not_ready_with_another_schema(start_api: StartApi) -> None:
    api = start_api()
    with api.database.write() as session:
        session.execute(text("UPDATE alembic_version SET version_num = 'other'"))
    problem = problem_of(httpx.get(f"{api.url}/readyz"), 503, "not-ready")
    assert "mrasfm migrate" in problem["remedy"]


def test_not_ready_where_the_database_lacks_a_table(start_api: StartApi) -> None:
    api = start_api()
    with api.database.write() as session:
        session.execute(text("DROP TABLE workers"))
    assert "database" in problem_of(httpx.get(f"{api.url}/readyz"), 503, "not-ready")["detail"]


def test_not_ready_where_the_database_refuses_writes(database_settings: Settings) -> None:
    with api_in_thread(database_settings) as api:
        engine = api.context.database.engine
        if engine.dialect.name == "postgresql":
            name = engine.url.database
            with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
                connection.execute(text(f'ALTER DATABASE "{name}" SET default_transaction_read_only = on'))
        else:
            event.listen(engine, "connect", lambda connection, record: connection.execute("PRAGMA query_only=ON"))
        engine.dispose()  # connections that are opened from now on cannot write
        assert "database" in problem_of(httpx.get(f"{api.url}/readyz"), 503, "not-ready")["detail"]


def test_connections_to_a_server_that_became_a_standby_are_left(postgres_api: Api) -> None:
    """It answers, so that nothing else tells them apart from good ones: all writes would fail for ever."""
    client, raw = postgres_api.client(), tiny_drive().raw
    engine = postgres_api.context.database.engine
    engine.dispose()
    with engine.connect() as connection:  # the only one in the pool
        connection.execute(text("SET SESSION CHARACTERISTICS AS TRANSACTION READ ONLY"))
        connection.commit()
    problem_of(client.post("/v1/drives", content=raw), 503, "database-unavailable")
    assert client.post("/v1/drives", content=raw).status_code == 201


def test_metrics_go_on_without_a_database(start_api: StartApi) -> None:
    api = start_api()
    assert metrics_of(api)["mrasfm_database_up{}"] == 1
    with api.database.write() as session:
        session.execute(text("DROP TABLE workers"))
    metrics = metrics_of(api)
    assert metrics["mrasfm_database_up{}"] == 0
    assert any(name.startswith("mrasfm_http_requests_total") for name in metrics)


def test_metrics_count(api: Api, client: Client) -> None:
    before = metrics_of(api)
    job = client.reconstruct(client.committed())
    client.get(f"/v1/jobs/{job['id']}")
    after = metrics_of(api)

    def rise(name: str) -> float:
        return after.get(name, 0) - before.get(name, 0)

    assert rise('mrasfm_http_requests_total{"method": "GET", "route": "/v1/jobs/{job_id}", "status": "200"}') == 1
    assert rise('mrasfm_http_request_seconds_count{"method": "POST", "route": "/v1/drives"}') == 1
    assert rise('mrasfm_jobs{"state": "QUEUED"}') == 2
    assert rise("mrasfm_received_bytes_total{}") > 1000
    assert rise("mrasfm_stored_bytes{}") > 1000
    assert job["id"] not in str(after), "ids are no labels"


def test_the_status_is_told_without_the_history_of_jobs(api: Api) -> None:
    client = api.client()
    database = api.context.database

    def steps_of_status() -> int:
        with sqlite_steps(database) as steps:
            assert client.get("/v1/status").status_code == 200
        return steps.count

    before = steps_of_status()
    with api.database.write() as session:
        old = {"project_id": client.project_id, "kind": JobKind.RECONSTRUCTION, "state": "SUCCEEDED", "settings": {}}
        session.execute(insert(Job), [{**old, "id": new_id("job")} for _ in range(2000)])
    assert 0 < steps_of_status() < before + 1000, "a job that is counted takes several"


def test_the_status_says_what_is_missing_and_what_that_means(api: Api, client: Client) -> None:
    shown = client.get("/v1/status").json()
    assert (shown["status"], shown["broker"]) == ("degraded", False)
    assert any("broker" in reason for reason in shown["reasons"])
    assert any("no worker" in reason for reason in shown["reasons"])
    with api.database.write() as session:
        workers.report(session, name="w@test", queues=["checks", "reconstructions"], concurrency=2)
    shown = client.get("/v1/status").json()
    (worker,) = (worker for worker in shown["workers"] if worker["name"] == "w@test")
    assert worker["online"] is True
    assert not any("no worker" in reason for reason in shown["reasons"])


def test_the_status_tells_of_the_reconciler(start_api: StartApi) -> None:
    """Without one all else goes on, and what goes wrong stays so."""
    api = start_api(reconcile_seconds=30.0)
    client = api.client()

    def told() -> tuple[bool, bool]:
        shown = client.get("/v1/status").json()
        return shown["reconciler"], any("no reconciler" in reason for reason in shown["reasons"])

    assert told() == (False, True)
    assert not any("reconciler_pass" in name for name in metrics_of(api))
    with api.database.write() as session:
        passes.note(session, passes.JOBS)
    assert told() == (True, False)
    assert 0 <= metrics_of(api)['mrasfm_reconciler_pass_age_seconds{"pass": "jobs"}'] < 60
    with api.database.write() as session:
        session.get_one(Pass, passes.JOBS).done_us -= 80_000_000
    assert told() == (True, False), "it is busy for a while"
    with api.database.write() as session:
        session.get_one(Pass, passes.JOBS).done_us -= 20_000_000
    assert told() == (False, True)
    assert metrics_of(api)['mrasfm_reconciler_pass_age_seconds{"pass": "jobs"}'] > 99


def test_how_long_jobs_have_waited_for_a_worker(start_api: StartApi) -> None:
    api = start_api()
    client = api.client()

    def waits_s() -> tuple[float, dict[str, float]]:
        metrics, kinds = metrics_of(api), ("RECONSTRUCTION", "PREFLIGHT")
        by_kind = {kind: metrics[f'mrasfm_jobs_due_longest_wait_seconds{{"kind": "{kind}"}}'] for kind in kinds}
        return client.get("/v1/status").json()["queue"]["longest_wait_seconds"], by_kind

    def set_job(**values: Any) -> None:
        with api.database.write() as session:
            session.execute(update(Job).where(Job.id == job_id).values(values))

    assert waits_s() == (0.0, {"RECONSTRUCTION": 0.0, "PREFLIGHT": 0.0})
    job_id = client.reconstruct(client.committed())["id"]
    now = now_us()
    set_job(created_us=now - 900_000_000)
    longest_s, by_kind = waits_s()
    assert 900 <= longest_s < 960
    assert 900 <= by_kind["RECONSTRUCTION"] < 960
    assert by_kind["PREFLIGHT"] < 60
    assert metrics_of(api)['mrasfm_jobs_due{"kind": "RECONSTRUCTION"}'] == 1
    set_job(not_before_us=now - 300_000_000)
    assert 300 <= waits_s()[0] < 360, "before, it waited for something else"
    set_job(not_before_us=now + 300_000_000)
    assert waits_s()[0] < 60, "it waits for its time"
    set_job(not_before_us=0, waiting_for=1)
    assert waits_s()[0] < 60, "it waits for another job"
    set_job(waiting_for=0, state="RUNNING", heartbeat_us=now - 3_600_000_000)
    assert waits_s()[0] < 60
    assert metrics_of(api)["mrasfm_jobs_stalled{}"] == 1


def test_the_request_log_says_who_and_how_much(api: Api, client: Client, caplog: pytest.LogCaptureFixture) -> None:
    drive = tiny_drive()
    with caplog.at_level("INFO", logger="mrasfm.api"):
        created = client.post("/v1/drives", content=drive.raw)
        httpx.get(f"{api.url}/v1/drives")
        wait_until(lambda: len(requests_in(caplog)) == 2, "both lines")
    known, unknown = requests_in(caplog)
    assert (known["project"], known["client"]) == (client.project_id, HOST)
    assert (known["received_bytes"], known["sent_bytes"]) == (len(drive.raw), len(created.content))
    assert (unknown["status"], unknown["project"]) == (401, None)


def requests_in(caplog: pytest.LogCaptureFixture) -> list[dict[str, Any]]:
    return [record.fields for record in caplog.records if record.getMessage() == "request"]  # type: ignore[attr-defined]


@pytest.mark.parametrize("off_us", [3_600_000_000, -3_600_000_000])
def test_workers_are_seen_by_the_database_s_clock(
    postgres_api: Api, set_clock: Callable[[int], None], off_us: int
) -> None:
    """The clock of a worker's host is off, and then that of the host that looks."""
    gone, here = f"gone{off_us}@test", f"here{off_us}@test"
    with postgres_api.database.write() as session:
        workers.report(session, name=gone, queues=["checks"], concurrency=1)
        session.get_one(WorkerSeen, gone).seen_us -= 600_000_000
        before = workers.count_processes(session, "checks")
    online = metrics_of(postgres_api)["mrasfm_workers_online{}"]
    for of_worker, of_api in ((off_us, 0), (0, off_us)):
        set_clock(of_worker)
        for _ in range(2):  # a new one, and one that is known
            with postgres_api.database.write() as session:
                workers.report(session, name=here, queues=["checks"], concurrency=2)
        set_clock(of_api)
        shown = {worker["name"]: worker for worker in postgres_api.client().get("/v1/status").json()["workers"]}
        assert (shown[gone]["online"], shown[here]["online"]) == (False, True)
        assert metrics_of(postgres_api)["mrasfm_workers_online{}"] == online + 1
        with postgres_api.database.read() as session:
            assert workers.count_processes(session, "checks") == before + 2
            assert abs(session.get_one(WorkerSeen, here).seen_us - time.time_ns() // 1000) < 60_000_000
        with postgres_api.database.write() as session:
            session.delete(session.get_one(WorkerSeen, here))


def test_a_log_line_is_one_json_object_with_its_fields() -> None:
    record = logging.LogRecord("mrasfm", logging.ERROR, "f", 1, "two\nlines %s", ("ü\x00",), None)
    record.fields = {"attempt": 2}
    with log_fields(job_id="job_1"):
        (line,) = JsonFormatter().format(record).splitlines()
    shown = json.loads(line)
    assert (shown["message"], shown["job_id"], shown["attempt"], shown["level"]) == (
        "two\nlines ü\0",
        "job_1",
        2,
        "error",
    )


def test_an_error_of_ours_has_an_id_and_no_details(
    api: Api, client: Client, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*arguments: object) -> bytes:
        raise RuntimeError("a detail that is nobody's business")

    monkeypatch.setattr(drive_routes, "stored_manifest", broken)
    answer = client.get(f"/v1/drives/{client.create()}/manifest")
    problem = problem_of(answer, 500, "internal-error")
    assert answer.headers["x-request-id"].startswith("req_")
    assert "business" not in str(problem)
    assert "business" in caplog.text


@contextmanager
def black_hole() -> Iterator[int]:
    """A port that accepts connections and never answers."""
    with socket.socket() as listener:
        listener.bind((HOST, 0))
        listener.listen(100)
        accepted: list[socket.socket] = []

        def accept() -> None:
            try:
                while True:
                    accepted.append(listener.accept()[0])
            except OSError:
                return

        thread = threading.Thread(target=accept)
        thread.start()
        try:
            yield listener.getsockname()[1]
        finally:
            listener.shutdown(socket.SHUT_RDWR)
            thread.join()
            for connection in accepted:
                connection.close()


def accepts_quickly(api: Api) -> None:
    client = api.client()
    drive_id = client.committed()
    for _ in range(5):
        started_s = time.monotonic()
        job = client.reconstruct(drive_id)
        assert time.monotonic() - started_s < QUICK_S
        assert job["state"] == "QUEUED"
    started_s = time.monotonic()
    assert client.get("/v1/status").json()["broker"] is False
    assert time.monotonic() - started_s < QUICK_S
    assert httpx.get(f"{api.url}/readyz").status_code == 200, "uploads go on"
    assert len(client.get("/v1/jobs").json()["items"]) == 6


def test_a_broker_that_is_down_holds_nobody_up(start_api: StartApi) -> None:
    accepts_quickly(start_api(redis_url=f"redis://{HOST}:{free_port()}/0"))


def test_a_broker_that_hangs_holds_nobody_up(start_api: StartApi) -> None:
    with black_hole() as port:
        accepts_quickly(start_api(redis_url=f"redis://{HOST}:{port}/0"))


def test_a_store_that_is_away_is_said_so(start_api: StartApi, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "nobody")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "nothing")
    api = start_api(artifacts_url="s3://bucket", s3_endpoint=f"http://127.0.0.1:{free_port()}")
    client = api.client()
    problem_of(client.post("/v1/drives", content=tiny_drive().raw), 503, "store-unavailable")
    problem_of(client.get("/readyz"), 503, "not-ready")
    assert client.get("/v1/drives").json()["items"] == []


def test_a_service_that_starts_while_its_folder_of_objects_is_away_waits_for_it(
    start_api: StartApi, tmp_path: Path
) -> None:
    """As after a restart of the machine where the disk is mounted later, or not at all."""
    drive = tiny_drive()
    path, data = next(iter(drive.files.items()))
    before = start_api().client()
    drive_id = before.create(drive)
    folder = before.api.settings.data_dir / "artifacts"
    away = folder.rename(tmp_path / "away")
    folder.mkdir()
    client = start_api().client_of(before.project_id, before.key)
    url = f"/v1/drives/{drive_id}/files/{path}"
    problem_of(client.get("/readyz"), 503, "not-ready")
    problem_of(client.put(url, content=data), 503, "store-unavailable")
    problem_of(client.get(f"/v1/drives/{drive_id}/manifest"), 503, "store-unavailable")
    away.rename(folder)
    assert client.get(f"/v1/drives/{drive_id}/manifest").content == drive.raw
    assert client.put(url, content=data).status_code == 201
