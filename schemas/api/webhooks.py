"""Webhooks: addresses that are told when jobs end."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from typing import Annotated

from pydantic import ConfigDict, Field, StringConstraints
from pydantic.config import JsonDict

from schemas.api.resource import EXAMPLE_JOB, RequestBody, Resource
from schemas.drive import PRINTED_NAME
from schemas.patterns import Pattern

MAX_URL_CHARACTERS = 2000
EXAMPLE_WEBHOOK = "whk_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c"


class WebhookEvent(StrEnum):
    """Events that a webhook can be told of."""

    JOB_SUCCEEDED = "job.succeeded"
    JOB_FAILED = "job.failed"
    JOB_CANCELLED = "job.cancelled"


class DeliveryState(StrEnum):
    """State of a delivery."""

    PENDING = "PENDING"
    DELIVERED = "DELIVERED"
    FAILED = "FAILED"


class WebhookRequest(RequestBody):
    """An address and the events that it wants."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"url": "https://example.org/hooks/mrasfm", "events": ["job.succeeded", "job.failed"]}]
        }
    )

    url: Annotated[
        str,
        StringConstraints(min_length=8, max_length=MAX_URL_CHARACTERS),
        Pattern(
            r"^https?://[\x21-\x7e]+$", words="a URL in ASCII that begins with https:// or http://, without spaces"
        ),
    ] = Field(description="takes POST requests; https, and no address of a private network")
    events: Annotated[list[WebhookEvent], Field(min_length=1, max_length=len(WebhookEvent))] = Field(
        default=list(WebhookEvent), description="that it is told of; by default all"
    )
    description: Annotated[
        str,
        StringConstraints(max_length=200),
        Pattern(r"^[^\x00-\x1f\x7f-\x9f]*$", words=PRINTED_NAME.words),
    ] = Field("", description="for people")


_WEBHOOK: JsonDict = {
    "id": EXAMPLE_WEBHOOK,
    "url": "https://example.org/hooks/mrasfm",
    "events": ["job.succeeded", "job.failed"],
    "description": "",
    "disabled": False,
    "previous_secret_until": None,
    "created_at": "2026-05-04T09:00:00Z",
}


class WebhookResource(Resource):
    """A webhook as the API shows it."""

    model_config = ConfigDict(json_schema_extra={"examples": [_WEBHOOK]})

    id: str
    url: str = Field(description="that takes its messages")
    events: list[WebhookEvent] = Field(description="that it is told of")
    description: str = Field(description="as given")
    disabled: bool = Field(description="true once its address has answered 410: it wants no more")
    previous_secret_until: datetime | None = Field(
        None, description="until then messages are signed with the secret before the last rotation as well"
    )
    created_at: datetime = Field(description="in UTC, as all times")


class WebhookWithSecret(WebhookResource):
    """A webhook with its secret, which is shown when it is made and never again."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{**_WEBHOOK, "secret": "whsec_C2FVsBQIhrscChlQIMV+b5sSYspob7oD"}]}
    )

    secret: str = Field(description="signs its messages as Standard Webhooks says: `whsec_` and base64")


class DeliveryResource(Resource):
    """A message to a webhook, and what became of it."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "id": "msg_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c",
                    "webhook_id": EXAMPLE_WEBHOOK,
                    "event": "job.succeeded",
                    "job_id": EXAMPLE_JOB,
                    "state": "DELIVERED",
                    "attempts": 1,
                    "next_attempt_at": None,
                    "status": 204,
                    "error": None,
                    "created_at": "2026-05-04T09:41:00Z",
                    "delivered_at": "2026-05-04T09:41:01Z",
                }
            ]
        }
    )

    id: str = Field(description="sent as `webhook-id`, the same at every try")
    webhook_id: str = Field(description="whose message it is")
    event: WebhookEvent = Field(description="that it tells of")
    job_id: str = Field(description="that ended")
    state: DeliveryState = Field(description="FAILED is given up: it can be sent again")
    attempts: int = Field(description="tries so far", ge=0)
    next_attempt_at: datetime | None = Field(None, description="of a pending one")
    status: int | None = Field(None, description="of the last answer")
    error: str | None = Field(None, description="why the last try failed")
    created_at: datetime = Field(description="when the job ended")
    delivered_at: datetime | None = Field(None, description="when the address took it")
