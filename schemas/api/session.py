"""Session of the web console, and what its key opens."""

from __future__ import annotations

from datetime import datetime

from pydantic import ConfigDict, Field

from schemas.api.resource import Resource


class SessionResource(Resource):
    """The caller as the service knows it: its project, its key, and the session of the console if it is one."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "project": "default",
                    "key_id": "key_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c",
                    "key_name": "first",
                    "key_created_at": "2026-05-04T09:00:00Z",
                    "session_expires_at": "2026-05-04T21:30:00Z",
                    "used_bytes": 41_000_000_000,
                    "max_bytes": 1_000_000_000_000,
                    "max_active_jobs": 1000,
                    "max_drives": 100_000,
                    "console_tiles": None,
                }
            ]
        }
    )

    project: str = Field(description="name of the project that the key opens")
    key_id: str = Field(description="names the key to `mrasfm keys revoke`")
    key_name: str = Field(description="as it was given to `mrasfm keys create`")
    key_created_at: datetime = Field(description="when the key was made")
    session_expires_at: datetime | None = Field(None, description="null where the request carries the key itself")
    used_bytes: int = Field(description="stored bytes of the project")
    max_bytes: int = Field(description="quota of the project")
    max_active_jobs: int = Field(description="quota of queued and running jobs")
    max_drives: int = Field(description="quota of drives")
    console_tiles: str | None = Field(None, description="URL of map tiles for the web console")
