"""Download of a drive's own files: its images and masks, as they were sent."""

from __future__ import annotations

from dataclasses import dataclass
from urllib.parse import quote

from fastapi import APIRouter, Request, Response
from sqlalchemy import select
from sqlalchemy.orm import Session

from service.api.dependencies import CallerDep, ContextDep
from service.api.routes.downloads import download_route, send_file
from service.database.tables import Blob, DriveFile
from service.domain import drives
from service.domain.scenes import media_type
from service.errors import NotFound

router = APIRouter(prefix="/v1/drives/{drive_id}", tags=["files"])


@dataclass(frozen=True)
class _Kind:
    media_type: str


@download_route(router, "/files/{path:path}", summary="Download a file of a drive")
async def download_drive_file(
    drive_id: str, path: str, request: Request, caller: CallerDep, context: ContextDep
) -> Response:
    """One image or mask of a drive, byte for byte as it was sent."""

    def find(session: Session) -> tuple[str, _Kind, Blob]:
        drive = drives.get(session, caller.project_id, drive_id)
        statement = select(DriveFile, Blob).outerjoin(Blob, DriveFile.blob_id == Blob.id)
        statement = statement.where(DriveFile.drive_id == drive.id, DriveFile.path == path)
        row = session.execute(statement).first() if path.isprintable() else None
        if row is None:
            raise NotFound(
                f"the manifest of drive {drive.id} names no file {path!r}",
                remedy=f"Give a path of those that GET /v1/drives/{drive.id}/files lists.",
            )
        blob = row.Blob
        if blob is None:
            raise NotFound(
                f"file {path!r} of drive {drive.id} is not uploaded yet",
                remedy=f"Send it with PUT /v1/drives/{drive.id}/files/{quote(path)}, or as a resumable upload.",
            )
        return drive.name, _Kind(media_type(path)), blob

    return await send_file(context, request, path, find)
