"""Resumable uploads (tus 1.0.0): how one looks when it was created."""

from __future__ import annotations

from datetime import datetime

from pydantic import ConfigDict, Field

from schemas.api.resource import Resource, Sha256


class UploadResource(Resource):
    """A resumable upload of one file of a drive, or of an archive of its files."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "id": "upl_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c",
                    "drive_id": "drv_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c",
                    "path": "front/000000.png",
                    "size_bytes": 73400320,
                    "offset_bytes": 0,
                    "sha256": "ab" * 32,
                    "done": False,
                    "created_at": "2026-05-04T09:30:00Z",
                    "expires_at": "2026-05-05T09:30:00Z",
                }
            ]
        }
    )

    id: str = Field(examples=["upl_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c"])
    drive_id: str = Field(description="whose file it becomes", examples=["drv_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c"])
    path: str | None = Field(None, description="as the manifest names it; null: an archive of files")
    size_bytes: int = Field(description="of the whole, as announced in Upload-Length", examples=[73400320])
    offset_bytes: int = Field(description="where the next PATCH goes on; all of them: there is nothing to send")
    sha256: Sha256 | None = Field(None, description="of the whole, if it was announced; other bytes are refused")
    done: bool = Field(description="the bytes are the drive's")
    created_at: datetime
    expires_at: datetime = Field(description="when what was sent is dropped; every PATCH moves it on")
