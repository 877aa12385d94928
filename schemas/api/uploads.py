"""Resumable uploads (tus 1.0.0): how one looks when it was created."""

from __future__ import annotations

from datetime import datetime

from pydantic import ConfigDict, Field

from schemas.api.resource import EXAMPLE_DRIVE, EXAMPLE_SHA256, Resource, Sha256


class UploadResource(Resource):
    """A resumable upload of one file of a drive, or of an archive of its files."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "id": "upl_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c",
                    "drive_id": EXAMPLE_DRIVE,
                    "path": "front/000000.png",
                    "size_bytes": 73400320,
                    "offset_bytes": 0,
                    "sha256": EXAMPLE_SHA256,
                    "done": False,
                    "created_at": "2026-05-04T09:30:00Z",
                    "expires_at": "2026-05-05T09:30:00Z",
                }
            ]
        }
    )

    id: str
    drive_id: str = Field(description="whose file it becomes")
    path: str | None = Field(None, description="as the manifest names it; null: an archive of files")
    size_bytes: int = Field(description="of the whole, as announced in Upload-Length")
    offset_bytes: int = Field(description="where the next PATCH goes on; all of them: there is nothing to send")
    sha256: Sha256 | None = Field(None, description="of the whole, if it was announced; other bytes are refused")
    done: bool = Field(description="the bytes are the drive's")
    created_at: datetime
    expires_at: datetime = Field(description="when what was sent is dropped; every PATCH moves it on")
