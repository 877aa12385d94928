"""How the service itself is."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum

from pydantic import ConfigDict, Field

from schemas.api.resource import Resource


class Health(StrEnum):
    """Whether everything works."""

    OK = "ok"
    DEGRADED = "degraded"


class WorkerStatus(Resource):
    """A worker as it last reported."""

    name: str
    queues: list[str]
    concurrency: int
    seen_at: datetime
    online: bool


class QueueStatus(Resource):
    """Jobs of all projects."""

    queued: int
    running: int
    stalled: int


class DiskStatus(Resource):
    """Space where uploads are received."""

    free_bytes: int
    total_bytes: int
    accepts_uploads: bool


class ServiceStatus(Resource):
    """Whether the service works, and what is lost where it does not."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "status": "degraded",
                    "reasons": ["the broker does not answer: jobs are accepted and start when it is back"],
                    "version": "0.2.0",
                    "broker": False,
                    "workers": [],
                    "queue": {"queued": 2, "running": 0, "stalled": 0},
                    "disk": {"free_bytes": 80000000000, "total_bytes": 250000000000, "accepts_uploads": True},
                }
            ]
        }
    )

    status: Health
    reasons: list[str] = Field(description="what does not work, and what that means")
    version: str
    broker: bool = Field(description="whether it answers")
    workers: list[WorkerStatus]
    queue: QueueStatus
    disk: DiskStatus


class Ready(Resource):
    """The service takes requests."""

    status: str = Field(examples=["ready"])
