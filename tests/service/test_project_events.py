"""The stream of a project: all its jobs, each as it is, and the end with the key."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.api.routes import job_views
from service.database.tables import Job, JobEvent, now_us
from service.domain.keys import revoke_key
from tests.helpers.executed_statements import statements_of
from tests.helpers.job_history import job_history
from tests.helpers.live_api import GRACE_S, Api, Client, api_in_thread, problem_of, settings_of, wait_until
from tests.helpers.tiny_drive import tiny_drive
from tests.service.conftest import StartApi

Event = tuple[str, str, Any]  # its name, its id, its data


@contextmanager
def stream(client: httpx.Client, **headers: str) -> Iterator[Iterator[Event]]:
    with client.stream("GET", "/v1/events", headers=headers) as answer:
        assert answer.status_code == 200, answer.read()
        assert answer.headers["content-type"].startswith("text/event-stream")
        yield _events(answer)


def _events(answer: httpx.Response) -> Iterator[Event]:
    fields: dict[str, str] = {}
    for line in answer.iter_lines():
        if line and not line.startswith(":"):
            name, _, value = line.partition(": ")
            fields[name] = value
        elif not line and fields:
            yield fields["event"], fields.get("id", ""), json.loads(fields.get("data", "null"))
            fields = {}


def test_changes_of_every_job_come_as_the_jobs_are_shown(api: Api, client: Client) -> None:
    with stream(client) as events:
        assert next(events)[0] == "ready"
        job = client.reconstruct(client.frozen(tiny_drive("a", seed="a")))
        name, first_id, data = next(events)
        while data["id"] != job["id"]:  # the check of the drive's images
            name, first_id, data = next(events)
        assert (name, data["state"]) == ("job", "QUEUED")
        client.claim(job["id"])
        name, _, data = next(events)
        assert (data["id"], data["state"]) == (job["id"], "RUNNING")
        assert data == client.get(f"/v1/jobs/{job['id']}").json()
    with stream(client, **{"Last-Event-ID": first_id}) as again:
        assert next(again)[0] == "ready"
        seen = {}
        while job["id"] not in seen:
            data = next(again)[2]
            seen[data["id"]] = data["state"]
        assert seen[job["id"]] == "RUNNING"


def test_foreign_jobs_do_not_come(api: Api, client: Client) -> None:
    other = api.client()
    with stream(client) as events:
        next(events)
        theirs = other.reconstruct(other.frozen(tiny_drive("b", seed="b")))
        mine = client.reconstruct(client.frozen(tiny_drive("c", seed="c")))
        seen = set()
        while mine["id"] not in seen:
            seen.add(next(events)[2]["id"])
        assert theirs["id"] not in seen


def test_what_is_new_of_a_child_is_new_of_its_tree(api: Api, client: Client) -> None:
    drives = [client.frozen(tiny_drive(f"tree-{i}", seed=f"tree-{i}")) for i in range(2)]
    tree = client.aggregate(drives=drives)
    child = tree["members"][0]["job_id"]
    with stream(client) as events:
        next(events)
        client.claim(child)
        changed: dict[str, Any] = {}
        while not {child, tree["id"]} <= changed.keys():
            data = next(events)[2]
            changed[data["id"]] = data
    states = {member["job_id"]: member["state"] for member in changed[tree["id"]]["members"]}
    assert states[child] == "RUNNING"


def test_jobs_with_many_members_are_read_in_parts(api: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    """All come, in their order, and no more members are held at one time than a page of jobs shows."""
    monkeypatch.setattr(job_views, "CHILDREN_OF_PAGE", 10)
    client = api.client()
    with stream(client) as events:
        next(events)
        made = job_history(client, 0, 4, 4, 0, 4, 11, 12, 0)
        with statements_of(api.context.database) as statements:
            with api.database.write() as session:
                session.add_all(JobEvent(job_id=job_id, kind="state", data={}, created_us=now_us()) for job_id in made)
            shown = [next(events)[2] for _ in made]
    assert [job["id"] for job in shown] == made[::-1]
    assert [len(job["members"]) for job in shown] == [0, 12, 11, 4, 0, 4, 4, 0]
    assert sum("job_members.name" in statement for statement in statements) == 4, "of 12, 11, 4 + 4 and 4 members"


def add_event(api: Api, job_id: str, *, before: int = 0, age_s: float = 0.0) -> int:
    """An event of a transaction that began before others and ends now; ids are given before a transaction ends."""
    with api.database.write() as session:
        newest = max(session.query(JobEvent.id).all())[0]
        event_id = newest - before if before else newest + 10
        created_us = now_us() - int(age_s * 1e6)
        session.add(JobEvent(id=event_id, job_id=job_id, kind="state", data={}, created_us=created_us))
        return int(event_id)


def two_jobs(client: Client, name: str) -> tuple[str, str]:
    early, late = (client.reconstruct(client.frozen(tiny_drive(n, seed=n)))["id"] for n in (f"{name}-1", f"{name}-2"))
    return early, late


def test_an_event_of_a_transaction_that_ended_late_is_not_missed(api: Api, client: Client) -> None:
    early, late = two_jobs(client, "late")
    with stream(client) as events:
        next(events)
        add_event(api, early)
        assert next(events)[2]["id"] == early
        add_event(api, late, before=5)
        assert next(events)[2]["id"] == late


def test_an_event_from_before_the_stream_that_ends_late_is_not_missed(api: Api, client: Client) -> None:
    """The page is read after `ready`, and without what that transaction writes."""
    early, late = two_jobs(client, "before")
    add_event(api, early)
    with stream(client) as events:
        assert next(events)[0] == "ready"
        add_event(api, late, before=5)
        assert next(events)[2]["id"] == late


def test_a_reader_that_comes_back_misses_nothing(api: Api, client: Client) -> None:
    """Neither an event that ends late, nor the rest of what came at one time."""
    early, late = two_jobs(client, "back")
    with stream(client) as events:
        next(events)
        add_event(api, early)
        _, last_id, data = next(events)
        assert data["id"] == early
    add_event(api, late, before=5)
    with stream(client, **{"Last-Event-ID": last_id}) as events:
        next(events)
        _, last_id, first = next(events)
    with stream(client, **{"Last-Event-ID": last_id}) as events:
        next(events)
        seen = [next(events)[2]["id"] for _ in range(4)]  # two checks of drives are among them
    assert {early, late, first["id"]} <= set(seen)


def test_what_was_sent_long_ago_does_not_come_again(api: Api, client: Client) -> None:
    early, late = two_jobs(client, "ago")
    with api.database.write() as session:
        session.query(JobEvent).update({"created_us": now_us() - 3600 * 1_000_000})
    add_event(api, early, age_s=3600)
    with stream(client, **{"Last-Event-ID": "0"}) as events:
        next(events)
        ids = [next(events)[1] for _ in range(4)]
        assert ids[:3] == ["0"] * 3, "whoever goes away here is shown all again"
    with stream(client, **{"Last-Event-ID": ids[-1]}) as events:
        next(events)
        add_event(api, late)
        assert next(events)[2]["id"] == late


def test_streams_of_a_project_are_bounded(start_api: StartApi) -> None:
    api = start_api(max_event_streams=1)
    client, other = api.client(), api.client()
    with stream(client) as events:
        next(events)
        refused = problem_of(client.get("/v1/events"), 429, "too-many-streams")
        assert "GET /v1/jobs" in refused["remedy"]
        with stream(other) as others:
            next(others)
    wait_until(lambda: api.context.streams.open_streams == 0, "the end of the streams")
    with stream(client) as events:
        next(events)
    told = client.get("/metrics").text
    assert 'mrasfm_http_requests_total{method="GET",route="/v1/events",status="200"}' in told
    assert 'mrasfm_http_request_seconds_count{method="GET",route="/v1/events"} 1' in told, "of the refusal alone"


def test_streams_end_with_the_server(tmp_path: Path) -> None:
    """It would wait for them, in vain, and cut them off."""
    with httpx.Client(timeout=20) as browser, ExitStack() as opened:
        with api_in_thread(settings_of(tmp_path)) as api:
            browser.base_url = httpx.URL(api.url)
            browser.headers["Authorization"] = f"Bearer {api.new_key()[1]}"
            events = opened.enter_context(stream(browser))
            assert next(events)[0] == "ready"
            began_s = time.monotonic()
        assert time.monotonic() - began_s < GRACE_S
        assert list(events) == []


def test_a_job_that_stalls_is_told_although_nobody_writes_it(api: Api, client: Client) -> None:
    job = client.reconstruct(client.frozen(tiny_drive("stalls", seed="stalls")))
    client.claim(job["id"])
    with stream(client) as events:
        next(events)
        with api.database.write() as session:
            session.get_one(Job, job["id"]).heartbeat_us = now_us() - 3600 * 1_000_000
        assert next(events)[2]["state"] == "STALLED"


def test_a_revoked_key_ends_the_stream_in_time(api: Api, client: Client) -> None:
    key_id = client.get("/v1/session").json()["key_id"]
    client.post("/v1/session")
    browser = api.anonymous()
    browser.cookies.update(client.cookies)
    client.cookies.clear()
    with stream(browser) as events:
        assert next(events)[0] == "ready"
        with api.database.write() as session:
            revoke_key(session, key_id)
        revoked_s = time.monotonic()
        name, _, data = next(events)
        assert name == "end"
        assert "ended" in data["reason"]
        assert time.monotonic() - revoked_s < 5.0
        with pytest.raises(StopIteration):
            next(events)
    assert browser.get("/v1/events").status_code == 401


def test_polling_a_list_that_has_not_changed_costs_no_body(api: Api, client: Client) -> None:
    job = client.reconstruct(client.frozen(tiny_drive("poll", seed="poll")))
    answer = client.get("/v1/jobs")
    unchanged = client.get("/v1/jobs", headers={"If-None-Match": answer.headers["etag"]})
    assert (unchanged.status_code, unchanged.content) == (304, b"")
    client.claim(job["id"])
    assert client.get("/v1/jobs", headers={"If-None-Match": answer.headers["etag"]}).status_code == 200


def test_a_drives_image_is_downloaded_with_the_cookie(api: Api, client: Client) -> None:
    drive = tiny_drive("images", seed="images")
    drive_id = client.filled(drive)
    path, data = next(iter(drive.files.items()))
    answer = client.get(f"/v1/drives/{drive_id}/files/{path}")
    assert (answer.status_code, answer.content) == (200, data)
    assert answer.headers["content-type"] == "image/png"
    part = client.get(f"/v1/drives/{drive_id}/files/{path}", headers={"Range": "bytes=0-3"})
    assert (part.status_code, part.content) == (206, data[:4])
    assert client.get(f"/v1/drives/{drive_id}/files/none.png").status_code == 404
    assert api.client().get(f"/v1/drives/{drive_id}/files/{path}").status_code == 404
