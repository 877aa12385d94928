"""Webhooks: register, list, show, rotate, delete, and what was sent."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Response
from sqlalchemy import select
from sqlalchemy.orm import Session

from schemas.api.resource import Page
from schemas.api.webhooks import (
    DeliveryResource,
    DeliveryState,
    WebhookRequest,
    WebhookResource,
    WebhookWithSecret,
)
from service.api.dependencies import CallerDep, ContextDep, Cursor, IdempotentDep, Limit, answer, moment
from service.api.http.body_reading import json_body
from service.api.http.paging import newest, page_of
from service.api.http.request_bodies import Body, describe
from service.api.http.responses import gives, problems
from service.database.tables import Webhook, WebhookDelivery
from service.domain import webhooks
from service.domain.access import require
from service.domain.idempotency import Answer

router = APIRouter(prefix="/v1/webhooks", tags=["webhooks"])

read_request = json_body(WebhookRequest, lambda settings: settings.max_json_bytes)


@router.post(
    "",
    status_code=201,
    response_model=WebhookWithSecret,
    summary="Register a webhook",
    responses={**gives(201, "The webhook with its secret", "Location"), **problems(401, 408, 409, 413, 422, 429)},
    openapi_extra=describe(WebhookRequest),
)
def create_webhook(
    once: IdempotentDep,
    caller: CallerDep,
    context: ContextDep,
    body: Annotated[Body[WebhookRequest], Depends(read_request, scope="function")],
) -> Response:
    """Register an address that is told when jobs end.

    Messages are signed as Standard Webhooks says, with the secret that only this answer shows. They are sent until the
    address answers with 2xx, for three days, and may arrive twice under one `webhook-id`.
    """

    def effect(session: Session) -> Answer:
        webhook = webhooks.create(
            session,
            project_id=caller.project_id,
            asked=body.value,
            allow_private=context.settings.webhook_private_addresses,
        )
        return answer(201, _with_secret(session, webhook), Location=f"/v1/webhooks/{webhook.id}")

    return once(effect, body.raw)


@router.get("", summary="List webhooks", responses={**gives(200, "A page of webhooks"), **problems(401, 422)})
def list_webhooks(
    caller: CallerDep, context: ContextDep, limit: Limit = 50, cursor: Cursor = None
) -> Page[WebhookResource]:
    """Webhooks of the project, newest first, without their secrets."""
    with context.database.read() as session:
        found, following = newest(session, Webhook, caller.project_id, cursor=cursor, limit=limit)
        items = [WebhookResource.model_validate(fields) for fields in _fields(session, found)]
    return Page(items=items, next=following)


@router.get("/{webhook_id}", summary="Show a webhook", responses={**gives(200, "The webhook"), **problems(401, 404)})
def get_webhook(webhook_id: str, caller: CallerDep, context: ContextDep) -> WebhookResource:
    """One webhook, without its secret."""
    with context.database.read() as session:
        (fields,) = _fields(session, [require(session, Webhook, caller.project_id, webhook_id)])
    return WebhookResource.model_validate(fields)


@router.delete(
    "/{webhook_id}",
    status_code=204,
    summary="Delete a webhook",
    responses={**gives(204, "Deleted"), **problems(401, 404)},
)
def delete_webhook(webhook_id: str, caller: CallerDep, context: ContextDep) -> None:
    """Delete a webhook and its messages, also those that were not sent."""

    def remove(session: Session) -> None:
        session.delete(require(session, Webhook, caller.project_id, webhook_id, lock=True))

    context.database.transact(remove)


@router.post(
    "/{webhook_id}:rotate",
    response_model=WebhookWithSecret,
    summary="Rotate a webhook's secret",
    responses={**gives(200, "The webhook with its new secret"), **problems(401, 404, 409, 422)},
)
def rotate_webhook(webhook_id: str, once: IdempotentDep, caller: CallerDep, context: ContextDep) -> Response:
    """Give a webhook another secret. For a day messages have a signature of the secret before as well.

    Each rotation is good for a day of its own, also where others follow.
    """

    def effect(session: Session) -> Answer:
        webhook = require(session, Webhook, caller.project_id, webhook_id, lock=True)
        webhooks.rotate(session, webhook)
        session.flush()
        return answer(200, _with_secret(session, webhook))

    return once(effect)


@router.get(
    "/{webhook_id}/deliveries",
    summary="List a webhook's messages",
    responses={**gives(200, "A page of messages"), **problems(401, 404, 422)},
)
def list_deliveries(
    webhook_id: str, caller: CallerDep, context: ContextDep, limit: Limit = 50, cursor: Cursor = None
) -> Page[DeliveryResource]:
    """Messages to a webhook, newest first: pending, delivered, and given up; for a month after their end."""
    with context.database.read() as session:
        require(session, Webhook, caller.project_id, webhook_id)
        statement = select(WebhookDelivery).where(WebhookDelivery.webhook_id == webhook_id)
        keys = (WebhookDelivery.created_us, WebhookDelivery.id)
        rows, following = page_of(session, statement, *keys, cursor=cursor, limit=limit)
        return Page(items=[_shown(delivery) for (delivery,) in rows], next=following)


@router.post(
    "/{webhook_id}/deliveries/{delivery_id}:retry",
    status_code=202,
    response_model=DeliveryResource,
    summary="Send a message again",
    responses={**gives(202, "It will be sent"), **problems(401, 404, 409, 422)},
)
def retry_delivery(
    webhook_id: str, delivery_id: str, once: IdempotentDep, caller: CallerDep, context: ContextDep
) -> Response:
    """Send a message again that was given up, or that was delivered and lost there."""

    def effect(session: Session) -> Answer:
        webhook = require(session, Webhook, caller.project_id, webhook_id, lock=True)
        return answer(202, _shown(webhooks.send_again(session, webhook, delivery_id)))

    return once(effect)


def _with_secret(session: Session, webhook: Webhook) -> WebhookWithSecret:
    (fields,) = _fields(session, [webhook])
    return WebhookWithSecret.model_validate({**fields, "secret": webhook.secret})


def _fields(session: Session, found: Sequence[Webhook]) -> list[dict[str, Any]]:
    until_us = webhooks.old_secrets_until(session, found)
    return [
        {
            "id": webhook.id,
            "url": webhook.url,
            "events": webhook.events,
            "description": webhook.description,
            "disabled": webhook.disabled_us is not None,
            "previous_secret_until": moment(until_us.get(webhook.id)),
            "created_at": moment(webhook.created_us),
        }
        for webhook in found
    ]


def _shown(delivery: WebhookDelivery) -> DeliveryResource:
    return DeliveryResource.model_validate(
        {
            "id": delivery.id,
            "webhook_id": delivery.webhook_id,
            "event": delivery.event,
            "job_id": delivery.job_id,
            "state": delivery.state,
            "attempts": delivery.attempts,
            "next_attempt_at": moment(delivery.next_us) if delivery.state == DeliveryState.PENDING else None,
            "status": delivery.status,
            "error": delivery.error,
            "created_at": moment(delivery.created_us),
            "delivered_at": moment(delivery.delivered_us),
        }
    )
