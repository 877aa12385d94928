"""Messages of webhooks on their way: real sockets, and addresses that must not be reached."""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import httpcore
import pytest

from schemas.api.jobs import JobKind
from schemas.api.webhooks import WebhookRequest
from service.database.connections import Database
from service.database.tables import Job, Webhook, WebhookDelivery, new_id
from service.domain import jobs, webhooks
from service.domain.keys import create_project
from service.settings import Settings
from tests.helpers.migrated import migrated
from tests.helpers.service_world import World, kill, wait_until
from worker import checked_connections, webhook_sender
from worker.checked_connections import CheckedBackend, resolved
from worker.webhook_sender import WebhookSender


class Receiver:
    """An HTTP server that keeps what it gets, and answers as it is told."""

    def __init__(self) -> None:
        self.got: list[tuple[dict[str, str], bytes]] = []
        self.status, self.headers, self.drips = 204, dict[str, str](), False
        self.ended = threading.Event()  # of an answer that drips
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["content-length"]))
                receiver.got.append(({k.lower(): v for k, v in self.headers.items()}, body))
                if receiver.drips:
                    while not receiver.ended.wait(0.1):
                        self.wfile.write(b"H")
                    return
                self.send_response(receiver.status)
                for name, value in receiver.headers.items():
                    self.send_header(name, value)
                self.send_header("content-length", "0")
                self.end_headers()

            def log_message(self, *_: object) -> None:
                return

            do_GET = do_POST

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self._server.handle_error = lambda *_: None
        self.port = self._server.server_address[1]
        self.url = f"http://127.0.0.1:{self.port}/hook"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        self.ended.set()
        self._server.shutdown()
        self._server.server_close()


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    made = Receiver()
    yield made
    made.close()


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    made = Settings(data_dir=tmp_path, webhook_private_addresses=True, webhook_seconds=0.1)
    migrated(made)
    return made


@pytest.fixture
def database(settings: Settings) -> Iterator[Database]:
    opened = Database.from_settings(settings)
    yield opened
    opened.close()


def registered(database: Database, settings: Settings, url: str) -> Webhook:
    """A webhook, and a job that has ended."""
    with database.write() as session:
        project = create_project(session, new_id("test"), settings)
        webhook = webhooks.create(session, project_id=project.id, asked=WebhookRequest(url=url), allow_private=True)
        job = jobs.create(session, project_id=project.id, kind=JobKind.RECONSTRUCTION, drive_id="drv_1")
        jobs.request_cancel(session, job.id)
        return webhook


def delivery_of(database: Database) -> WebhookDelivery:
    with database.read() as session:
        return session.query(WebhookDelivery).one()


def make_due(database: Database) -> None:
    with database.write() as session:
        session.query(WebhookDelivery).one().next_us = 0


def resolve_as(monkeypatch: pytest.MonkeyPatch, resolve: Callable[..., list[str]]) -> None:
    monkeypatch.setattr(webhook_sender, "CheckedBackend", partial(CheckedBackend, resolve=resolve))


def test_a_message_is_signed_and_delivered_once(database: Database, settings: Settings, receiver: Receiver) -> None:
    webhook = registered(database, settings, receiver.url)
    assert WebhookSender(settings, database).send_due() == 1
    assert WebhookSender(settings, database).send_due() == 0
    ((headers, body),) = receiver.got
    delivery = delivery_of(database)
    assert (delivery.state, delivery.status, delivery.attempts) == ("DELIVERED", 204, 1)
    assert headers["webhook-id"] == delivery.id
    assert abs(int(headers["webhook-timestamp"]) - time.time()) < 60
    key = base64.b64decode(webhook.secret.removeprefix("whsec_"))
    content = f"{headers['webhook-id']}.{headers['webhook-timestamp']}.".encode() + body
    expected = base64.b64encode(hmac.new(key, content, hashlib.sha256).digest()).decode()
    assert headers["webhook-signature"] == f"v1,{expected}"
    told = json.loads(body)
    assert (told["type"], told["data"]["state"], told["data"]["drive_id"]) == ("job.cancelled", "CANCELLED", "drv_1")


def test_a_sender_that_is_killed_loses_nothing(database: Database, settings: Settings, receiver: Receiver) -> None:
    """What it had taken is sent by another, under the same id, when its time is over; its own end counts no more."""
    registered(database, settings, receiver.url)
    with database.write() as session:
        (taken,) = webhooks.take(session, limit=10)
    assert WebhookSender(settings, database).send_due() == 0, "it is the first one's for a while"
    make_due(database)
    assert WebhookSender(settings, database).send_due() == 1
    with database.write() as session:
        webhooks.note(session, taken, webhooks.Outcome(error="too late"))
    delivery = delivery_of(database)
    assert (delivery.state, delivery.attempts, delivery.id) == ("DELIVERED", 2, taken.id)


def test_retries_back_off_and_end(database: Database, settings: Settings, receiver: Receiver) -> None:
    registered(database, settings, receiver.url)
    receiver.status = 500
    sender = WebhookSender(settings, database)
    for delay_s in webhooks.DELAYS_S:
        before_us = time.time() * 1e6
        assert sender.send_due() == 1
        delivery = delivery_of(database)
        assert (delivery.state, delivery.status, delivery.error) == ("PENDING", 500, "answered 500")
        waits_s = (delivery.next_us - before_us) / 1e6
        assert delay_s <= waits_s < 1.2 * delay_s + 5
        make_due(database)
    assert sender.send_due() == 1
    assert delivery_of(database).state == "FAILED"
    assert len({headers["webhook-id"] for headers, _ in receiver.got}) == 1
    assert len(receiver.got) == len(webhooks.DELAYS_S) + 1
    make_due(database)
    assert sender.send_due() == 0


def test_redirects_are_not_followed(database: Database, settings: Settings, receiver: Receiver) -> None:
    other = Receiver()
    registered(database, settings, receiver.url)
    receiver.status, receiver.headers = 302, {"location": other.url}
    WebhookSender(settings, database).send_due()
    delivery = delivery_of(database)
    assert (delivery.state, delivery.status, delivery.error) == ("PENDING", 302, "a redirect is not followed")
    assert (len(receiver.got), other.got) == (1, [])
    other.close()


def test_an_address_that_wants_no_more_is_disabled(database: Database, settings: Settings, receiver: Receiver) -> None:
    webhook = registered(database, settings, receiver.url)
    receiver.status = 410
    WebhookSender(settings, database).send_due()
    assert delivery_of(database).state == "FAILED"
    with database.write() as session:
        assert session.get_one(Webhook, webhook.id).disabled_us is not None
        job = jobs.create(session, project_id=webhook.project_id, kind=JobKind.RECONSTRUCTION, drive_id="drv_2")
        jobs.request_cancel(session, job.id)
    assert delivery_of(database).job_id != job.id, "none is added"


@pytest.mark.parametrize("addresses", [["127.0.0.1"], ["8.8.8.8", "127.0.0.1"], ["::1"], []])
def test_names_of_private_addresses_are_told_nothing(
    database: Database, settings: Settings, receiver: Receiver, monkeypatch: pytest.MonkeyPatch, addresses: list[str]
) -> None:
    registered(database, settings, "https://hooks.example.org/hook")
    resolve_as(monkeypatch, lambda *_: addresses)
    strict = settings.model_copy(update={"webhook_private_addresses": False})
    WebhookSender(strict, database).send_due()
    delivery = delivery_of(database)
    assert receiver.got == []
    assert (delivery.state, delivery.status) == ("PENDING", None)
    # The same for a name without an address: else webhooks would tell what names the operator's network has.
    assert delivery.error == "hooks.example.org has no address, or one of a private network"


def test_what_the_operator_does_not_allow_any_more_is_told_nothing(
    database: Database, settings: Settings, receiver: Receiver
) -> None:
    registered(database, settings, "http://hooks.example.org/hook")
    strict = settings.model_copy(update={"webhook_private_addresses": False})
    WebhookSender(strict, database).send_due()
    assert delivery_of(database).error == "the url is not encrypted"


def test_a_name_server_that_does_not_answer_ends_the_look_up(monkeypatch: pytest.MonkeyPatch) -> None:
    answered, free = threading.Event(), threading.BoundedSemaphore(1)
    monkeypatch.setattr(checked_connections, "_LOOK_UPS", free)
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: [] if answered.wait(20) else None)
    for _ in range(2):  # the first look-up goes on, and leaves no place for the second
        began_s = time.monotonic()
        with pytest.raises(httpcore.ConnectTimeout, match=r"slow\.example was not looked up within 0\.2 s"):
            resolved("slow.example", 443, 0.2)
        assert 0.2 <= time.monotonic() - began_s < 20.0, "the name server's own time"
    answered.set()
    assert free.acquire(timeout=20)


def test_an_address_that_hangs_holds_up_its_own_messages_alone(
    database: Database, settings: Settings, receiver: Receiver, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(webhook_sender, "_WITHIN_S", 120.0)  # the test ends the hanging answer
    hanging = Receiver()
    hanging.drips = True
    project_id = registered(database, settings, hanging.url).project_id
    for _ in range(5):
        registered(database, settings, receiver.url)
    sending = threading.Thread(target=WebhookSender(settings, database).send_due)
    sending.start()
    try:
        wait_until(lambda: len(receiver.got) == 5, "the others", within_s=20)
        with database.write() as session:
            asked = WebhookRequest(url=receiver.url)
            webhooks.create(session, project_id=project_id, asked=asked, allow_private=True)
            job = jobs.create(session, project_id=project_id, kind=JobKind.RECONSTRUCTION, drive_id="drv_1")
            jobs.request_cancel(session, job.id)
        wait_until(lambda: len(receiver.got) == 6, "what becomes due meanwhile", within_s=20)
        wait_until(lambda: len(hanging.got) == 1, "the message that hangs", within_s=20)
    finally:
        hanging.close()
        sending.join(20)
    assert not sending.is_alive()


def test_a_sender_that_is_told_to_end_begins_no_more(
    database: Database, settings: Settings, receiver: Receiver
) -> None:
    registered(database, settings, receiver.url)
    ended = threading.Event()
    ended.set()
    assert WebhookSender(settings, database).send_due(ended) == 0
    assert receiver.got == []


def test_the_connection_goes_to_the_address_that_was_checked(
    database: Database, settings: Settings, receiver: Receiver, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A name server that answers differently the second time is not asked a second time."""
    answers = iter([["127.0.0.1"]])
    registered(database, settings, f"http://rebinding.invalid:{receiver.port}/hook")
    resolve_as(monkeypatch, lambda *_: next(answers))
    WebhookSender(settings, database).send_due()
    assert delivery_of(database).state == "DELIVERED"
    ((headers, _),) = receiver.got
    assert headers["host"] == f"rebinding.invalid:{receiver.port}"


def test_an_address_that_drips_ends(
    database: Database, settings: Settings, receiver: Receiver, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(webhook_sender, "_WITHIN_S", 0.6)
    registered(database, settings, receiver.url)
    receiver.drips = True  # until the test ends
    sending = threading.Thread(target=WebhookSender(settings, database).send_due, daemon=True)
    sending.start()
    sending.join(20)
    assert not sending.is_alive()
    assert delivery_of(database).state == "PENDING"


def test_an_address_where_nobody_listens(database: Database, settings: Settings, receiver: Receiver) -> None:
    registered(database, settings, receiver.url)
    receiver.close()
    WebhookSender(settings, database).send_due()
    delivery = delivery_of(database)
    assert (delivery.state, delivery.attempts) == ("PENDING", 1)
    assert "ConnectError" in str(delivery.error)


@pytest.mark.slow
def test_messages_survive_a_kill_of_the_reconciler(tmp_path: Path, receiver: Receiver) -> None:
    """The service is killed between the end of a job and its message, and sends it when it is back."""
    world = World(tmp_path / "world", webhook_private_addresses=True, webhook_seconds=0.2)
    try:
        with world.database.write() as session:
            asked = WebhookRequest(url=receiver.url)
            webhooks.create(session, project_id=world.project_id, asked=asked, allow_private=True)
        receiver.status = 503
        first = world.start_reconciler()
        with world.database.write() as session:
            job = jobs.create(session, project_id=world.project_id, kind=JobKind.RECONSTRUCTION, drive_id="drv_1")
            jobs.request_cancel(session, job.id)
        wait_until(lambda: receiver.got != [], "the first try")
        wait_until(lambda: delivery_of(world.database).status == 503, "its end")
        kill(first.pid)
        first.wait()
        receiver.status = 200
        make_due(world.database)
        world.start_reconciler()
        wait_until(lambda: delivery_of(world.database).state == "DELIVERED", "the message")
        assert len({headers["webhook-id"] for headers, _ in receiver.got}) == 1
        assert json.loads(receiver.got[-1][1])["data"]["job_id"] == job.id
    finally:
        world.close()


def test_old_messages_are_forgotten(database: Database, settings: Settings, receiver: Receiver) -> None:
    registered(database, settings, receiver.url)
    now = int(time.time() * 1e6)
    with database.write() as session:
        assert webhooks.forget_old(session, now + 2 * webhooks.KEPT_US) == 0, "it is pending"
    WebhookSender(settings, database).send_due()
    with database.write() as session:
        assert webhooks.forget_old(session, now) == 0
        assert webhooks.forget_old(session, now + 2 * webhooks.KEPT_US) == 1
        assert session.query(Job).count() == 1
