"""Webhooks over HTTP: registered, told of jobs that end, rotated, listed, and what is refused."""

from __future__ import annotations

import base64
import json
import re
import threading
from typing import Any

import pytest
from sqlalchemy import false, update
from sqlalchemy.orm import Session

from schemas.api.jobs import JobKind
from schemas.api.webhooks import WebhookRequest
from service.database.connections import Database
from service.database.tables import Export, Job, Scene, Webhook, WebhookDelivery, WebhookOldSecret, now_us
from service.domain import exports, jobs, maps, webhooks
from service.domain.keys import create_project
from service.domain.webhook_addresses import is_public
from service.settings import Settings
from tests.helpers.live_api import Client, problem_of

URL = "https://example.org/hooks/mrasfm?from=us"


def register(client: Client, **more: Any) -> dict[str, Any]:
    answer = client.post("/v1/webhooks", json={"url": URL, **more})
    assert answer.status_code == 201, answer.text
    return dict(answer.json())


def messages(client: Client, webhook_id: str) -> list[dict[str, Any]]:
    answer = client.get(f"/v1/webhooks/{webhook_id}/deliveries")
    assert answer.status_code == 200, answer.text
    return list(answer.json()["items"])


def test_a_webhook_is_registered_shown_and_deleted(client: Client) -> None:
    made = register(client, description="of the depot")
    assert made["secret"].startswith("whsec_")
    assert len(base64.b64decode(made["secret"].removeprefix("whsec_"))) == 32
    shown = client.get(f"/v1/webhooks/{made['id']}").json()
    assert shown == {name: value for name, value in made.items() if name != "secret"}
    assert client.get("/v1/webhooks").json()["items"] == [shown]
    assert shown["events"] == ["job.cancelled", "job.failed", "job.succeeded"]
    other = client.api.client()
    for url in (f"/v1/webhooks/{made['id']}", f"/v1/webhooks/{made['id']}/deliveries"):
        problem_of(other.get(url), 404, "not-found")
    problem_of(other.post(f"/v1/webhooks/{made['id']}:rotate"), 404, "not-found")
    assert client.delete(f"/v1/webhooks/{made['id']}").status_code == 204
    problem_of(client.get(f"/v1/webhooks/{made['id']}"), 404, "not-found")


def test_jobs_that_end_leave_one_message_each(client: Client) -> None:
    wanted, other = register(client, events=["job.succeeded"]), register(client, events=["job.cancelled"])
    scene_id = client.scene({"points.ply": b"ply"})
    (message,) = (m for m in messages(client, wanted["id"]) if m["event"] == "job.succeeded")
    assert (message["state"], message["attempts"], message["job_id"][:4]) == ("PENDING", 0, "job_")
    with client.api.database.read() as session:
        body = json.loads(session.get_one(WebhookDelivery, message["id"]).body)
    assert body["type"] == "job.succeeded"
    assert (body["data"]["scene_id"], body["data"]["kind"]) == (scene_id, "RECONSTRUCTION")
    assert body["data"]["job_id"] == message["job_id"]
    # The check of the drive's images was cancelled nowhere; a reconstruction is, now.
    drive_id = client.get(f"/v1/scenes/{scene_id}").json()["drive_id"]
    job = client.reconstruct(drive_id)
    for _ in range(2):
        assert client.post(f"/v1/jobs/{job['id']}:cancel").status_code == 202
    assert [m["job_id"] for m in messages(client, other["id"])] == [job["id"]]
    assert len(messages(client, wanted["id"])) == 1
    (pending,) = re.findall(
        r'^mrasfm_webhook_messages{state="PENDING"} (\d+)', client.get("/metrics").text, re.MULTILINE
    )
    assert int(pending) >= 2


def test_a_message_is_rolled_back_with_its_transaction(client: Client) -> None:
    made = register(client)
    job = client.reconstruct(client.frozen())

    def cancel_and_fail(session: Session) -> None:
        jobs.request_cancel(session, job["id"])
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        client.api.database.transact(cancel_and_fail)
    assert messages(client, made["id"]) == []


def secrets_of_message(client: Client, webhook_id: str) -> list[str]:
    """The secrets that sign a message now."""
    client.post(f"/v1/jobs/{client.reconstruct(client.frozen())['id']}:cancel")
    with client.api.database.write() as session:
        (taken,) = [message for message in webhooks.take(session, limit=100) if message.webhook_id == webhook_id]
        webhooks.note(session, taken, webhooks.Outcome(status=204))
    assert len(webhooks.signed_headers(taken, timestamp_s=1)["webhook-signature"].split(" ")) == len(taken.secrets)
    return list(taken.secrets)


def test_rotating_keeps_the_secret_before_for_a_day(client: Client) -> None:
    made = register(client)
    rotated = client.post(f"/v1/webhooks/{made['id']}:rotate").json()
    assert rotated["secret"] != made["secret"]
    assert rotated["previous_secret_until"] is not None
    assert secrets_of_message(client, made["id"]) == [rotated["secret"], made["secret"]]
    age_secrets(client, made["id"], webhooks.ROTATION_US)
    assert secrets_of_message(client, made["id"]) == [rotated["secret"]]
    assert client.get(f"/v1/webhooks/{made['id']}").json()["previous_secret_until"] is None
    with client.api.database.write() as session:
        webhooks.forget_old_secrets(session)
        assert session.query(WebhookOldSecret).filter_by(webhook_id=made["id"]).count() == 0


def age_secrets(client: Client, webhook_id: str, by_us: int) -> None:
    """Let the time pass in which old secrets sign."""
    with client.api.database.write() as session:
        older = update(WebhookOldSecret).where(WebhookOldSecret.webhook_id == webhook_id)
        session.execute(older.values(until_us=WebhookOldSecret.until_us - by_us))


def test_rotating_again_leaves_each_secret_its_day(client: Client) -> None:
    """A receiver that has the first secret is not cut off by the second rotation."""
    made = register(client)
    url = f"/v1/webhooks/{made['id']}:rotate"
    first = client.post(url).json()["secret"]
    age_secrets(client, made["id"], webhooks.ROTATION_US // 2)
    second = client.post(url).json()
    assert secrets_of_message(client, made["id"]) == [second["secret"], first, made["secret"]]
    shown = client.get("/v1/webhooks").json()["items"][0]
    assert shown["previous_secret_until"] == second["previous_secret_until"]
    age_secrets(client, made["id"], webhooks.ROTATION_US // 2)
    with client.api.database.write() as session:
        webhooks.forget_old_secrets(session)
    assert secrets_of_message(client, made["id"]) == [second["secret"], first]


def test_secrets_that_sign_are_bounded(client: Client) -> None:
    url = f"/v1/webhooks/{register(client)['id']}:rotate"
    for _ in range(webhooks.MAX_OLD_SECRETS):
        assert client.post(url).status_code == 200
    refused = client.post(url)
    problem_of(refused, 409, "too-many-secrets")
    assert 0 < int(refused.headers["retry-after"]) <= webhooks.ROTATION_US // 1_000_000 + 1


def test_the_signature_is_that_of_standard_webhooks() -> None:
    """The example of the specification's libraries."""
    message = webhooks.Message(
        id="msg_p5jXN8AQM9LWM0D4loKWxJek",
        webhook_id="",
        project_id="",
        url="",
        body='{"test": 2432232314}',
        secrets=["whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"],
        attempts=1,
    )
    signed = webhooks.signed_headers(message, timestamp_s=1614265330)
    assert signed["webhook-signature"] == "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE="


@pytest.mark.parametrize(
    "url",
    [
        "http://example.org/hook",
        "https://user:secret@example.org/",
        "https://127.0.0.1/",
        "https://localhost/",
        "https://10.1.2.3:8443/",
        "https://169.254.169.254/latest/meta-data",
        "https://[::1]/",
        "https://[::ffff:192.168.1.1]/",
        "https://[64:ff9b::a00:1]/",
        "https://[fe80::1]/",
        "https://example.org/#part",
        "https://:443/",
        "https://127.1/",
        "https://2130706433/",
        "https://0x7f000001/",
        "https://hooks.localhost./",
        "https://[::127.0.0.1]/",
        "https://192.0.0.192/",
        "https://@example.org/",
        "https://example.org\\@10.0.0.1/",
        "https://example.org:99999/",
    ],
)
def test_addresses_that_are_refused(client: Client, url: str) -> None:
    problem_of(client.post("/v1/webhooks", json={"url": url}), 422, "address-refused")


@pytest.mark.parametrize("wrong", [{}, {"url": "ftp://example.org/"}, {"url": URL, "events": ["job.began"]}])
def test_requests_that_are_none(client: Client, wrong: dict[str, Any]) -> None:
    problem_of(client.post("/v1/webhooks", json=wrong), 422, "invalid-document")


def test_a_project_has_a_bound(client: Client) -> None:
    for number in range(webhooks.MAX_OF_PROJECT):
        register(client, description=str(number))
    problem_of(client.post("/v1/webhooks", json={"url": URL}), 429, "too-many-webhooks")


@pytest.mark.parametrize(
    ("address", "public"),
    [
        ("8.8.8.8", True), ("2606:4700::1111", True), ("127.0.0.1", False), ("0.0.0.0", False), ("100.64.0.1", False),
        ("224.0.0.1", False), ("192.0.2.1", False), ("::", False), ("fd00::1", False), ("::ffff:8.8.8.8", True),
        ("::ffff:10.0.0.1", False), ("2002:0a00:0001::1", False), ("64:ff9b::7f00:1", False), ("fe80::1%eth0", False),
        ("64:ff9b::8.8.8.8", True), ("64:ff9b:1::a00:1", False), ("::127.0.0.1", False), ("::ffff:0:10.0.0.1", False),
        ("fec0::1", False), ("3fff::1", False), ("5f00::1", False), ("2001:0:a00:1::", False),
        ("2002:808:808::", False), ("192.0.0.192", False),
        ("192.88.99.1", False), ("169.254.169.254", False), ("fd00:ec2::254", False),
    ],
)  # fmt: skip
def test_addresses_of_the_internet(address: str, public: bool) -> None:
    assert is_public(address) is public


def ended_job(database: Database, project_id: str) -> str:
    with database.write() as session:
        job = jobs.create(session, project_id=project_id, kind=JobKind.RECONSTRUCTION, drive_id="drv_1")
        jobs.request_cancel(session, job.id)
        return job.id


def new_webhook(database: Database, project_id: str) -> str:
    with database.write() as session:
        return webhooks.create(session, project_id=project_id, asked=WebhookRequest(url=URL), allow_private=False).id


def taken(database: Database, **bounds: Any) -> list[webhooks.Message]:
    with database.write() as session:
        return webhooks.take(session, **{"limit": 8, **bounds})


def test_messages_are_taken_once_in_every_database(database: Database, project_id: str) -> None:
    """Two senders at one time get different messages, the older one first."""
    new_webhook(database, project_id)
    ended = [ended_job(database, project_id) for _ in range(3)]
    with database.read() as session:
        assert webhooks.is_any_due(session)
    found = [message for _ in range(4) for message in taken(database)]
    assert [json.loads(message.body)["data"]["job_id"] for message in found] == ended
    with database.write() as session:
        for message in found[:2]:
            webhooks.note(session, message, webhooks.Outcome(status=200))
        webhooks.note(session, found[2], webhooks.Outcome(status=410, error="answered 410"))
    with database.write() as session:
        assert webhooks.forget_old(session, now_us() + 2 * webhooks.KEPT_US) == 3
        assert not webhooks.is_any_due(session)


@pytest.mark.parametrize(("attempts", "most_s"), [(0, 0), (1, 45), (2, 360), (9, 103_680), (10, 45)])
def test_waits_that_the_clock_made_long(database: Database, project_id: str, attempts: int, most_s: int) -> None:
    """No message waits longer than one that begins to wait now, after as many attempts."""
    new_webhook(database, project_id)
    late, on_time, ended = (ended_job(database, project_id) for _ in range(3))
    before_us, week_us, second_us = now_us(), 7 * 86_400_000_000, 1_000_000
    ends = {late: before_us + week_us, on_time: before_us + most_s * second_us - second_us, ended: before_us + week_us}
    with database.write() as session:
        for message in session.query(WebhookDelivery):
            message.attempts, message.next_us = attempts, ends[message.job_id]
            message.state = "DELIVERED" if message.job_id == ended else "PENDING"
    with database.write() as session:
        webhooks.bound_times(session)
    with database.read() as session:
        found = {message.job_id: message.next_us for message in session.query(WebhookDelivery)}
    assert before_us <= found[late] - most_s * second_us <= now_us()
    assert (found[on_time], found[ended]) == (ends[on_time], ends[ended])


def test_a_message_that_another_holds_is_not_waited_for(database: Database, project_id: str) -> None:
    if database.engine.dialect.name == "sqlite":
        pytest.skip("its writers take turns")
    new_webhook(database, project_id)
    for _ in range(2):
        ended_job(database, project_id)
    with database.write() as session:
        session.query(WebhookDelivery).update({"next_us": now_us() + 86_400_000_000})
    with database.write() as other:
        held = other.query(WebhookDelivery).limit(1).with_for_update().one()
        with database.write() as session:
            webhooks.bound_times(session)
            free = session.query(WebhookDelivery).filter(WebhookDelivery.id != held.id).one()
            assert free.next_us <= now_us()


def test_a_webhook_that_is_slow_holds_up_neither_others_nor_other_projects(
    database: Database, database_settings: Settings, project_id: str
) -> None:
    slow = [new_webhook(database, project_id) for _ in range(5)]
    for _ in range(3):
        ended_job(database, project_id)
    with database.write() as session:
        other_id = create_project(session, "other", database_settings).id
    new_webhook(database, other_id)
    ended_job(database, other_id)
    first = taken(database, of_project=2)
    assert [message.project_id for message in first].count(project_id) == 2
    assert [message.project_id for message in first].count(other_id) == 1
    assert len({message.webhook_id for message in first}) == 3
    assert taken(database, of_project=2, under_way=first) == []
    one = taken(database, of_project=2, under_way=first[1:])
    assert [(message.project_id, message.webhook_id in slow) for message in one] == [(project_id, True)]


def test_a_webhook_that_is_deleted_while_it_is_told_leaves_nothing(database: Database, project_id: str) -> None:
    webhook_id = new_webhook(database, project_id)
    ended_job(database, project_id)
    (message,) = taken(database)
    _delete_webhook(database, webhook_id)
    with database.write() as session:
        webhooks.note(session, message, webhooks.Outcome(status=410, error="answered 410"))
        webhooks.note(session, message, webhooks.Outcome(status=200))
    with database.read() as session:
        assert session.query(Webhook).count() == session.query(WebhookDelivery).count() == 0


def test_messages_of_a_webhook_are_bounded(
    database: Database, project_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(webhooks, "MAX_PENDING", 2)
    new_webhook(database, project_id)
    ended = [ended_job(database, project_id) for _ in range(3)]
    with database.read() as session:
        found = {message.job_id: message for message in session.query(WebhookDelivery)}
    assert [found[job_id].state for job_id in ended] == ["PENDING", "PENDING", "FAILED"]
    assert found[ended[2]].error == "2 messages were pending"


def test_an_address_that_wants_no_more_gets_no_more(database: Database, project_id: str) -> None:
    webhook_id = new_webhook(database, project_id)
    for _ in range(2):
        ended_job(database, project_id)
    (message,) = taken(database)
    with database.write() as session:
        webhooks.note(session, message, webhooks.Outcome(status=410, error="answered 410"))
    assert taken(database) == []
    with database.read() as session:
        assert session.get_one(Webhook, webhook_id).disabled_us is not None
        assert {found.state for found in session.query(WebhookDelivery)} == {"FAILED"}


def test_a_webhook_that_is_deleted_as_a_job_ends_fails_no_job(
    database: Database, project_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Deleted between the look at the webhooks and the record of the message: the job ends all the same."""
    webhook_id, body_of = new_webhook(database, project_id), webhooks._body
    deleting = threading.Thread(target=_delete_webhook, args=(database, webhook_id))

    def body_while_deleted(*given: Any) -> str:
        deleting.start()
        deleting.join(0.3)
        return body_of(*given)

    monkeypatch.setattr(webhooks, "_body", body_while_deleted)
    job_id = ended_job(database, project_id)
    deleting.join()
    with database.read() as session:
        assert session.get_one(Job, job_id).state == "CANCELLED"
        assert session.query(Webhook).count() == session.query(WebhookDelivery).count() == 0


def _delete_webhook(database: Database, webhook_id: str) -> None:
    with database.write() as session:
        session.delete(session.get_one(Webhook, webhook_id, with_for_update=True))


def test_retention_in_every_database(database: Database, project_id: str) -> None:
    """Exports that were never made and whose job has gone, and scenes that are being exported."""
    with database.write() as session:
        job = jobs.create(
            session, project_id=project_id, kind=JobKind.EXPORT, drive_id=None, request={"export_id": "exp_1"}
        )
        scene = {"project_id": project_id, "drive_id": "drv_1", "name": "s", "fence": 1, "summary": {}, "expires_us": 1}
        session.add_all([Scene(id="scn_1", job_id="job_1", **scene), Scene(id="scn_2", job_id="job_2", **scene)])
        session.flush()
        common = {"project_id": project_id, "inputs_sha256": "0" * 64, "formats": [], "options": {}}
        session.add(Export(id="exp_1", scene_id="scn_1", job_id=job.id, **common))
        session.add(Export(id="exp_2", scene_id="scn_1", job_id="job_gone", **common))
    with database.write() as session:
        assert exports.forget_expired(session, 2) == 1
        is_exported = exports.is_exported(Export.scene_id == Scene.id)
        assert maps.forget_expired(session, 2, unless=lambda table: is_exported if table is Scene else false()) == 1
    with database.read() as session:
        assert session.get(Scene, "scn_1") is not None
        assert session.get(Scene, "scn_2") is None
        assert session.get(Export, "exp_2") is None
