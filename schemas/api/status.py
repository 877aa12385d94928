"""Status of the service itself."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from typing import Literal

from pydantic import ConfigDict, Field
from pydantic.config import JsonDict

from schemas.api.resource import Resource


class Health(StrEnum):
    """Health of the service."""

    OK = "ok"
    DEGRADED = "degraded"


_WORKER: JsonDict = {
    "name": "reconstructions@host",
    "queues": ["reconstructions"],
    "concurrency": 1,
    "seen_at": "2026-05-04T09:33:40Z",
    "online": True,
}
_QUEUE: JsonDict = {"queued": 2, "running": 1, "stalled": 0, "longest_wait_seconds": 12.5}
_DISK: JsonDict = {"free_bytes": 80_000_000_000, "total_bytes": 250_000_000_000, "accepts_uploads": True}


class WorkerStatus(Resource):
    """A worker as it last reported."""

    model_config = ConfigDict(json_schema_extra={"examples": [_WORKER]})

    name: str
    queues: list[str] = Field(description="whose jobs it does")
    concurrency: int = Field(description="jobs that it does at one time")
    seen_at: datetime = Field(description="when it last reported")
    online: bool = Field(description="whether that was within the last minute")


class QueueStatus(Resource):
    """Jobs of all projects."""

    model_config = ConfigDict(json_schema_extra={"examples": [_QUEUE]})

    queued: int = Field(description="jobs that wait")
    running: int = Field(description="jobs that a worker holds, stalled ones too")
    stalled: int = Field(description="running jobs without a recent heartbeat")
    longest_wait_seconds: float = Field(
        description="how long the oldest of the jobs that wait for nothing but a worker has waited; 0 without one"
    )


class DiskStatus(Resource):
    """Space where uploads are received."""

    model_config = ConfigDict(json_schema_extra={"examples": [_DISK]})

    free_bytes: int = Field(description="of the file system")
    total_bytes: int = Field(description="of the file system")
    accepts_uploads: bool = Field(description="false: so little is free that uploads are refused with 507")


class ServiceStatus(Resource):
    """Status of the service, and what is lost where a part does not work."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "status": "degraded",
                    "reasons": ["the broker does not answer: jobs are accepted and start when it is back"],
                    "version": "0.2.0",
                    "broker": False,
                    "reconciler": True,
                    "workers": [_WORKER],
                    "queue": _QUEUE,
                    "disk": _DISK,
                }
            ]
        }
    )

    status: Health = Field(description="degraded: some of it does not work; the reasons say what")
    reasons: list[str] = Field(description="what does not work, and what that means")
    version: str = Field(description="of the service")
    broker: bool = Field(description="whether it answers")
    reconciler: bool = Field(description="whether one has looked after the jobs within the last minute")
    workers: list[WorkerStatus] = Field(
        description="that reported within the last day; one that was told to stop is not among them"
    )
    queue: QueueStatus = Field(description="jobs of all projects")
    disk: DiskStatus = Field(description="where uploads are received")


class Ready(Resource):
    """The service takes requests."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"status": "ready"}]})

    status: Literal["alive", "ready"]
