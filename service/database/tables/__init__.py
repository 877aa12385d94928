"""The database's tables.

Times are integer microseconds since 1970 (UTC), as everywhere in the product: SQLite has no type for them, and
comparing integers is the same in every database. Ids are random; foreign ids cannot be guessed.
"""

from __future__ import annotations

from service.database.tables._base import Base, new_id, now_us
from service.database.tables._drives import Checkpoint, Drive, DriveFile, Upload
from service.database.tables._jobs import TERMINAL, Job, JobAttempt, JobEvent, JobMember, JobState
from service.database.tables._projects import ApiKey, Blob, Project
from service.database.tables._results import (
    Export,
    ExportFile,
    Map,
    MapCheckpoint,
    MapFile,
    MapScene,
    MapVersion,
    Scene,
    SceneFile,
)
from service.database.tables._service import IdempotencyKey, Pass, WorkerSeen
from service.database.tables._sessions import ConsoleSession
from service.database.tables._webhooks import Webhook, WebhookDelivery, WebhookOldSecret

__all__ = [
    "TERMINAL",
    "ApiKey",
    "Base",
    "Blob",
    "Checkpoint",
    "ConsoleSession",
    "Drive",
    "DriveFile",
    "Export",
    "ExportFile",
    "IdempotencyKey",
    "Job",
    "JobAttempt",
    "JobEvent",
    "JobMember",
    "JobState",
    "Map",
    "MapCheckpoint",
    "MapFile",
    "MapScene",
    "MapVersion",
    "Pass",
    "Project",
    "Scene",
    "SceneFile",
    "Upload",
    "Webhook",
    "WebhookDelivery",
    "WebhookOldSecret",
    "WorkerSeen",
    "new_id",
    "now_us",
]
