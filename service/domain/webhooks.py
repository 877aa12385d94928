"""Webhooks: registered addresses, messages to them in the database, and their signatures.

A message is recorded in the transaction that ends its job, and stays until it is delivered or given up. Who sends takes
it for a while: a sender that is killed loses nothing. Messages may therefore arrive twice, under one id.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import random
import secrets
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from http import HTTPStatus
from typing import Any

from sqlalchemy import BigInteger, ColumnElement, Select, case, delete, func, literal, select, update
from sqlalchemy.orm import Session

from schemas.api.jobs import JobKind
from schemas.api.webhooks import DeliveryState, WebhookEvent, WebhookRequest
from service.database.connections import clock_us
from service.database.tables import Job, JobState, Project, Webhook, WebhookDelivery, WebhookOldSecret
from service.domain.webhook_addresses import require_url
from service.errors import DeliveryPending, TooManySecrets, TooManyWebhooks, not_found

MAX_OF_PROJECT = 20
MAX_PENDING = 10_000  # messages of one webhook: what does not answer for days shall not fill the database
SECRET_PREFIX = "whsec_"
_SECRET_BYTES = 32
ROTATION_US = 24 * 3600 * 1_000_000  # how long the secret before signs as well
MAX_OLD_SECRETS = 8  # of a webhook, that sign beside its own
TAKEN_US = 45 * 1_000_000  # how long a message is one sender's, who gives up earlier
KEPT_US = 30 * 24 * 3600 * 1_000_000  # how long a message is listed after its end
# Seconds from one try to the next, as Standard Webhooks proposes; after the last it is given up: 75 hours in all.
DELAYS_S = (5, 300, 1800, 7200, 18_000, 36_000, 50_400, 72_000, 86_400)
_SPREAD = 1.2  # a wait is up to so many times as long: many do not come back at one moment
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
    project_id: str
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
    # Locked, so that two requests cannot take the last place together. Not its key, which each new row holds.
    session.get_one(Project, project_id, with_for_update={"key_share": True})
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


def new_secret() -> str:
    """A secret in the form of Standard Webhooks."""
    return SECRET_PREFIX + base64.b64encode(secrets.token_bytes(_SECRET_BYTES)).decode("ascii")


def rotate(session: Session, webhook: Webhook) -> None:
    """Give a webhook, which the caller has locked, another secret; the one before signs as well for a day.

    Raises
    ------
    ServiceError
        409 where as many old ones sign as may: each makes every message longer.
    """
    now = clock_us(session)
    old = session.scalars(_signing(now).where(WebhookOldSecret.webhook_id == webhook.id)).all()
    if len(old) >= MAX_OLD_SECRETS:
        wait_s = (old[-1].until_us - now) // 1_000_000 + 1
        raise TooManySecrets(
            f"{len(old)} secrets of webhook {webhook.id} were replaced within a day, and sign still",
            remedy=f"Rotate it in {wait_s} s, or register another webhook in its place.",
            headers={"Retry-After": str(wait_s)},
        )
    session.add(WebhookOldSecret(webhook_id=webhook.id, secret=webhook.secret, until_us=now + ROTATION_US))
    webhook.secret = new_secret()


def _signing(now: int) -> Select[WebhookOldSecret]:
    """Old secrets that sign still, the one that was replaced last first."""
    return select(WebhookOldSecret).where(WebhookOldSecret.until_us > now).order_by(WebhookOldSecret.until_us.desc())


def old_secrets_until(session: Session, found: Sequence[Webhook]) -> dict[str, int]:
    """Time at which the last old secret of a webhook signs no more, by the ids of those that have some."""
    signing = WebhookOldSecret.webhook_id.in_([webhook.id for webhook in found])
    until = select(WebhookOldSecret.webhook_id, func.max(WebhookOldSecret.until_us)).where(signing)
    until = until.where(WebhookOldSecret.until_us > clock_us(session)).group_by(WebhookOldSecret.webhook_id)
    return {webhook_id: int(until_us) for webhook_id, until_us in session.execute(until)}


def forget_old_secrets(session: Session) -> None:
    """Delete secrets that sign no more."""
    session.execute(delete(WebhookOldSecret).where(WebhookOldSecret.until_us <= clock_us(session)))


def record(session: Session, job: Job) -> None:
    """Record the messages that a job has ended, in the transaction in which it ends."""
    event = _EVENTS.get(JobState(job.state))
    if event is None or job.kind == JobKind.SUBMAP:
        return
    mine = (Webhook.project_id == job.project_id) & Webhook.disabled_us.is_(None)
    # One that is deleted at this moment is gone, or waits: else the message, and with it the job's end, would fail.
    found = session.scalars(select(Webhook).where(mine).with_for_update(read=True, key_share=True)).all()
    wanting = [webhook for webhook in found if event in webhook.events]
    if not wanting:
        return
    now = clock_us(session)
    body = _body(event, job, now)
    for webhook in wanting:
        is_full = _is_full(session, webhook)
        session.add(
            WebhookDelivery(
                webhook_id=webhook.id,
                job_id=job.id,
                event=event,
                body=body,
                state=DeliveryState.FAILED if is_full else DeliveryState.PENDING,
                error=f"{MAX_PENDING} messages were pending" if is_full else None,
                next_us=now,
                created_us=now,
            )
        )


def _is_full(session: Session, webhook: Webhook) -> bool:
    pending = (WebhookDelivery.webhook_id == webhook.id) & (WebhookDelivery.state == DeliveryState.PENDING)
    some = select(WebhookDelivery.id).where(pending).limit(MAX_PENDING).subquery()
    return session.scalar(select(func.count()).select_from(some)) == MAX_PENDING


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
    return session.scalar(select(WebhookDelivery.id).where(_due(clock_us(session))).limit(1)) is not None


def _due(now: int) -> ColumnElement[bool]:
    return (WebhookDelivery.state == DeliveryState.PENDING) & (WebhookDelivery.next_us <= now)


def take(
    session: Session, *, limit: int, of_project: int = MAX_OF_PROJECT, under_way: Sequence[Message] = ()
) -> list[Message]:
    """Take messages that are due, one of each webhook; nobody else gets them for a while.

    Parameters
    ----------
    limit
        How many at most.
    of_project
        How many of one project at most, with those under way.
    under_way
        What the caller is sending: their webhooks wait.
    """
    now = clock_us(session)
    of_projects = Counter(message.project_id for message in under_way)
    waiting = (
        select(Webhook.id, Webhook.project_id)
        .join(WebhookDelivery, WebhookDelivery.webhook_id == Webhook.id)
        .where(_due(now), Webhook.id.not_in([message.webhook_id for message in under_way]))
        .group_by(Webhook.id, Webhook.project_id)
        .order_by(func.min(WebhookDelivery.next_us))
    )
    taken: list[Message] = []
    for webhook_id, project_id in session.execute(waiting).all():
        if len(taken) == limit:
            break
        message = _take_first(session, webhook_id, now) if of_projects[project_id] < of_project else None
        if message is not None:
            of_projects[project_id] += 1
            taken.append(message)
    return taken


def _take_first(session: Session, webhook_id: str, now: int) -> Message | None:
    statement = (
        select(WebhookDelivery, Webhook)
        .join(Webhook, Webhook.id == WebhookDelivery.webhook_id)
        .where(_due(now), WebhookDelivery.webhook_id == webhook_id)
        .order_by(WebhookDelivery.next_us, WebhookDelivery.id)
        .limit(1)
        .with_for_update(skip_locked=True, of=WebhookDelivery)
        .execution_options(populate_existing=True)
    )
    row = session.execute(statement).first()
    if row is None:
        return None
    delivery, webhook = row[0], row[1]
    delivery.attempts += 1
    delivery.next_us = now + TAKEN_US
    return Message(
        id=delivery.id,
        webhook_id=webhook.id,
        project_id=webhook.project_id,
        url=webhook.url,
        body=delivery.body,
        secrets=_secrets(session, webhook, now),
        attempts=delivery.attempts,
    )


def _secrets(session: Session, webhook: Webhook, now: int) -> list[str]:
    old = session.scalars(_signing(now).where(WebhookOldSecret.webhook_id == webhook.id))
    return [webhook.secret, *(replaced.secret for replaced in old)]


def signed_headers(message: Message, *, timestamp_s: int) -> dict[str, str]:
    """Headers of a message as Standard Webhooks has them: with several secrets, as many signatures."""
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
    now = clock_us(session)
    values: dict[str, Any] = {"status": outcome.status, "error": (outcome.error or "")[:_ERROR_CHARACTERS] or None}
    gone = outcome.status == HTTPStatus.GONE
    if gone:
        _disable(session, message, now)
    if outcome.is_delivered:
        values |= {"state": DeliveryState.DELIVERED, "delivered_us": now}
    elif gone or message.attempts > len(DELAYS_S):
        values |= {"state": DeliveryState.FAILED}
    else:
        delay_s = DELAYS_S[message.attempts - 1] * random.uniform(1.0, _SPREAD)
        values |= {"next_us": now + int(delay_s * 1e6)}
    mine = (WebhookDelivery.id == message.id) & (WebhookDelivery.attempts == message.attempts)
    session.execute(
        update(WebhookDelivery).where(mine, WebhookDelivery.state == DeliveryState.PENDING).values(**values)
    )


def _disable(session: Session, message: Message, now: int) -> None:
    """Tell an address nothing more. The webhook is locked before its messages, as where it is deleted."""
    session.execute(update(Webhook).where(Webhook.id == message.webhook_id).values(disabled_us=now))
    others = (WebhookDelivery.webhook_id == message.webhook_id) & (WebhookDelivery.id != message.id)
    session.execute(
        update(WebhookDelivery)
        .where(others, WebhookDelivery.state == DeliveryState.PENDING)
        .values(state=DeliveryState.FAILED, error="the address answered 410 to another message", next_us=now)
    )


def bound_times(session: Session) -> None:
    """Shorten waits of messages that end later than any that begins now: the clock was set back since they began."""
    now = clock_us(session)
    waits_us = _longest_wait_us()
    is_late = (WebhookDelivery.next_us > now) & (WebhookDelivery.next_us > now + waits_us)  # the first has an index
    pending = WebhookDelivery.state == DeliveryState.PENDING
    # One that changes at this moment is not waited for: its new time is no longer than it should be.
    late = select(WebhookDelivery.id).where(pending, is_late).with_for_update(skip_locked=True)
    shorter = update(WebhookDelivery).where(WebhookDelivery.id.in_(late)).values(next_us=now + waits_us)
    session.execute(shorter.execution_options(synchronize_session=False))


def _longest_wait_us() -> ColumnElement[int]:
    """The longest wait of a message after as many attempts: for its next one, or for the end of the one under way."""
    waits_us = {0: 0} | {
        attempts: max(TAKEN_US, int(delay_s * _SPREAD * 1e6)) for attempts, delay_s in enumerate(DELAYS_S, 1)
    }
    return case(
        {attempts: literal(wait_us, BigInteger) for attempts, wait_us in waits_us.items()},
        value=WebhookDelivery.attempts,
        else_=literal(TAKEN_US, BigInteger),
    )


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
    delivery.state, delivery.attempts, delivery.next_us = DeliveryState.PENDING, 0, clock_us(session)
    delivery.delivered_us = None
    session.flush()
    return delivery


def forget_old(session: Session, now: int, *, limit: int = 500) -> int:
    """Delete messages that ended a month ago; how many."""
    # Nobody changes the time of the next try once there is none.
    ended = WebhookDelivery.state.in_((DeliveryState.DELIVERED, DeliveryState.FAILED))
    some = select(WebhookDelivery.id).where(ended, WebhookDelivery.next_us < now - KEPT_US).limit(limit)
    dropped = delete(WebhookDelivery).where(WebhookDelivery.id.in_(some))
    return int(session.execute(dropped.execution_options(synchronize_session=False)).rowcount)  # type: ignore[attr-defined]
