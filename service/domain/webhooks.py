"""Webhooks: registered addresses, messages to them in the database, and their signatures.

A message is recorded in the transaction that ends its job, and stays until it is delivered or given up. Who sends takes
it for a while: a sender that is killed loses nothing. Messages may therefore arrive twice, under one id.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import ipaddress
import json
import random
import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

from sqlalchemy import delete, func, select, update
from sqlalchemy.orm import Session

from schemas.api.jobs import JobKind
from schemas.api.webhooks import DeliveryState, WebhookEvent, WebhookRequest
from service.database.tables import Job, JobState, Project, Webhook, WebhookDelivery, now_us
from service.errors import AddressRefused, DeliveryPending, TooManyWebhooks, not_found

MAX_OF_PROJECT = 20
SECRET_PREFIX = "whsec_"
_SECRET_BYTES = 32
ROTATION_US = 24 * 3600 * 1_000_000  # how long the secret before signs as well
TAKEN_US = 45 * 1_000_000  # how long a message is one sender's, who gives up earlier
KEPT_US = 30 * 24 * 3600 * 1_000_000  # how long a message is listed after its end
# Seconds from one try to the next, as Standard Webhooks proposes; after the last it is given up: 75 hours in all.
DELAYS_S = (5, 300, 1800, 7200, 18_000, 36_000, 50_400, 72_000, 86_400)
_ERROR_CHARACTERS = 300
_EVENTS = {
    JobState.SUCCEEDED: WebhookEvent.JOB_SUCCEEDED,
    JobState.FAILED: WebhookEvent.JOB_FAILED,
    JobState.CANCELLED: WebhookEvent.JOB_CANCELLED,
}


@dataclass(frozen=True, kw_only=True)
class Message:
    """A message that a sender has taken."""

    id: str
    webhook_id: str
    url: str
    body: str
    secrets: Sequence[str]
    attempts: int  # with this one


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """End of one try: the status of the answer, or why there is none."""

    status: int | None = None
    error: str | None = None

    @property
    def is_delivered(self) -> bool:
        """True where the address took the message."""
        return self.error is None and self.status is not None and 200 <= self.status < 300


def create(session: Session, *, project_id: str, asked: WebhookRequest, allow_private: bool) -> Webhook:
    """Register an address, with a new secret.

    Raises
    ------
    ServiceError
        422 where it may not be told anything; 429 where the project has as many as it may.
    """
    require_url(asked.url, allow_private=allow_private)
    session.get_one(Project, project_id, with_for_update=True)  # two requests cannot take the last place together
    count = session.scalar(select(func.count()).select_from(Webhook).where(Webhook.project_id == project_id)) or 0
    if count >= MAX_OF_PROJECT:
        raise TooManyWebhooks(
            f"the project has {count} webhooks, which is the bound", remedy="Delete one that is not needed any more."
        )
    webhook = Webhook(
        project_id=project_id,
        url=asked.url,
        events=sorted(set(asked.events)),
        description=asked.description,
        secret=new_secret(),
    )
    session.add(webhook)
    session.flush()
    return webhook


def require_url(url: str, *, allow_private: bool) -> None:
    """Refuse an address that is never told anything; what its name resolves to is looked at before each message.

    Raises
    ------
    AddressRefused
    """
    try:
        parts = urlsplit(url)
        host, _ = parts.hostname or "", parts.port
    except ValueError as error:
        raise AddressRefused(f"url {url!r} is not one: {error}", remedy="Correct it.") from None
    if not host or parts.username or parts.password or parts.fragment:
        raise AddressRefused(
            "the url has no host, or has a user, a password or a fragment", remedy="Give scheme, host and path alone."
        )
    if parts.scheme != "https" and not allow_private:
        raise AddressRefused("the url is not encrypted", remedy="Give an https url.")
    literal = _address_of(host)
    if not allow_private and (host == "localhost" or (literal is not None and not is_public(host))):
        raise AddressRefused(
            f"{host} is an address of a private network", remedy="Give an address that is reached from the internet."
        )


def is_public(address: str) -> bool:
    """Return whether an address is one of the internet, also where one of IPv4 is written as one of IPv6."""
    found = _address_of(address)
    if found is None or found.is_multicast or not found.is_global:
        return False
    if isinstance(found, ipaddress.IPv6Address):
        inner = [found.ipv4_mapped, found.sixtofour, *(found.teredo or ())]
        if found in _NAT64:
            inner.append(ipaddress.IPv4Address(int(found) & 0xFFFFFFFF))
        return all(is_public(str(address)) for address in inner if address is not None)
    return True


_NAT64 = ipaddress.IPv6Network("64:ff9b::/96")


def _address_of(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return None


def new_secret() -> str:
    """A secret in the form of Standard Webhooks."""
    return SECRET_PREFIX + base64.b64encode(secrets.token_bytes(_SECRET_BYTES)).decode("ascii")


def rotate(webhook: Webhook) -> None:
    """Give a webhook another secret; the one before signs as well for a day."""
    webhook.previous_secret, webhook.previous_until_us = webhook.secret, now_us() + ROTATION_US
    webhook.secret = new_secret()


def record(session: Session, job: Job) -> None:
    """Record the messages that a job has ended, in the transaction in which it ends."""
    event = _EVENTS.get(JobState(job.state))
    if event is None or job.kind == JobKind.SUBMAP:
        return
    mine = (Webhook.project_id == job.project_id) & Webhook.disabled_us.is_(None)
    now = now_us()
    for webhook in session.scalars(select(Webhook).where(mine)):
        if event not in webhook.events:
            continue
        session.add(
            WebhookDelivery(
                webhook_id=webhook.id,
                job_id=job.id,
                event=event,
                body=_body(event, job, now),
                state=DeliveryState.PENDING,
                next_us=now,
                created_us=now,
            )
        )


def _body(event: WebhookEvent, job: Job, now: int) -> str:
    data: dict[str, Any] = {
        "job_id": job.id,
        "kind": job.kind,
        "state": job.state,
        "drive_id": job.drive_id,
        "scene_id": job.scene_id,
        "map_id": job.map_id,
        "map_version": job.map_version,
        "export_id": (job.request or {}).get("export_id") if job.kind == JobKind.EXPORT else None,
    }
    if job.problem is not None:
        data["problem"] = {key: job.problem.get(key) for key in ("type", "title", "detail", "remedy")}
    timestamp = datetime.fromtimestamp(now / 1e6, UTC).isoformat().replace("+00:00", "Z")
    return json.dumps({"type": event, "timestamp": timestamp, "data": data}, separators=(",", ":"))


def is_any_due(session: Session) -> bool:
    """Return whether there is a message to send."""
    due = (WebhookDelivery.state == DeliveryState.PENDING) & (WebhookDelivery.next_us <= now_us())
    return session.scalar(select(WebhookDelivery.id).where(due).limit(1)) is not None


def take(session: Session, *, limit: int) -> list[Message]:
    """Take messages that are due; nobody else gets them for a while."""
    now = now_us()
    due = (WebhookDelivery.state == DeliveryState.PENDING) & (WebhookDelivery.next_us <= now)
    statement = select(WebhookDelivery, Webhook).join(Webhook, Webhook.id == WebhookDelivery.webhook_id).where(due)
    statement = statement.order_by(WebhookDelivery.next_us).limit(limit)
    taken = []
    for delivery, webhook in session.execute(
        statement.with_for_update(skip_locked=True, of=WebhookDelivery).execution_options(populate_existing=True)
    ):
        delivery.attempts += 1
        delivery.next_us = now + TAKEN_US
        taken.append(
            Message(
                id=delivery.id,
                webhook_id=webhook.id,
                url=webhook.url,
                body=delivery.body,
                secrets=_secrets(webhook, now),
                attempts=delivery.attempts,
            )
        )
    return taken


def _secrets(webhook: Webhook, now: int) -> list[str]:
    previous = webhook.previous_secret if now < (webhook.previous_until_us or 0) else None
    return [webhook.secret, *([] if previous is None else [previous])]


def signed_headers(message: Message, *, timestamp_s: int) -> dict[str, str]:
    """Headers of a message as Standard Webhooks has them: with two secrets, two signatures."""
    content = f"{message.id}.{timestamp_s}.{message.body}".encode()
    signatures = [
        base64.b64encode(
            hmac.new(base64.b64decode(secret.removeprefix(SECRET_PREFIX)), content, hashlib.sha256).digest()
        ).decode("ascii")
        for secret in message.secrets
    ]
    return {
        "webhook-id": message.id,
        "webhook-timestamp": str(timestamp_s),
        "webhook-signature": " ".join(f"v1,{signature}" for signature in signatures),
    }


def note(session: Session, message: Message, outcome: Outcome) -> None:
    """Record the end of one try: delivered, to be tried again, or given up. One that another took over stays its."""
    now = now_us()
    values: dict[str, Any] = {"status": outcome.status, "error": (outcome.error or "")[:_ERROR_CHARACTERS] or None}
    gone = outcome.status == HTTPStatus.GONE
    if outcome.is_delivered:
        values |= {"state": DeliveryState.DELIVERED, "delivered_us": now}
    elif gone or message.attempts > len(DELAYS_S):
        values |= {"state": DeliveryState.FAILED}
    else:
        delay_s = DELAYS_S[message.attempts - 1] * random.uniform(1.0, 1.2)  # many do not come back at one moment
        values |= {"next_us": now + int(delay_s * 1e6)}
    mine = (WebhookDelivery.id == message.id) & (WebhookDelivery.attempts == message.attempts)
    session.execute(
        update(WebhookDelivery).where(mine, WebhookDelivery.state == DeliveryState.PENDING).values(**values)
    )
    if gone:
        session.execute(update(Webhook).where(Webhook.id == message.webhook_id).values(disabled_us=now))


def send_again(session: Session, webhook: Webhook, delivery_id: str) -> WebhookDelivery:
    """Make a message pending that was delivered or given up.

    Raises
    ------
    ServiceError
        404 where the webhook has no such message, 409 where it is pending.
    """
    delivery = session.get(WebhookDelivery, delivery_id, with_for_update=True, populate_existing=True)
    if delivery is None or delivery.webhook_id != webhook.id:
        raise not_found(f"delivery of webhook {webhook.id}", delivery_id)
    if delivery.state == DeliveryState.PENDING:
        raise DeliveryPending(f"delivery {delivery_id} is pending", remedy="Wait for its next attempt.")
    delivery.state, delivery.attempts, delivery.next_us = DeliveryState.PENDING, 0, now_us()
    delivery.delivered_us = None
    session.flush()
    return delivery


def forget_old(session: Session, now: int, *, limit: int = 500) -> int:
    """Delete messages that ended a month ago; how many."""
    old = (WebhookDelivery.state != DeliveryState.PENDING) & (WebhookDelivery.created_us < now - KEPT_US)
    some = select(WebhookDelivery.id).where(old).limit(limit)
    dropped = delete(WebhookDelivery).where(WebhookDelivery.id.in_(some))
    return int(session.execute(dropped.execution_options(synchronize_session=False)).rowcount)  # type: ignore[attr-defined]
