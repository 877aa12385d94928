"""Resumable uploads: tus 1.0.0 with creation, checksum, expiration and termination."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import anyio.to_thread
from fastapi import APIRouter, Header, Query, Request, Response
from fastapi.routing import APIRoute
from sqlalchemy.orm import Session

from schemas.api.resource import Page, Sha256
from schemas.api.uploads import UploadResource
from service.api.dependencies import CallerDep, ContextDep, Cursor, IdempotentDep, Limit, answer, moment
from service.api.http import tus
from service.api.http.paging import page_of
from service.api.http.responses import gives, problems
from service.api.routes.upload_writing import UploadWriting, current_offset, discard
from service.database.tables import Upload, now_us
from service.domain import drives, uploads
from service.domain.idempotency import Answer
from service.errors import MethodNotAllowed, ServiceError, WrongMediaType, require_size
from service.storage.spool import require_space


class TusRoute(APIRoute):
    """Every answer says which protocol it speaks, refusals too."""

    def get_route_handler(self) -> Callable[[Request], Any]:
        """FastAPI's, with the header."""
        handle = super().get_route_handler()

        async def speak(request: Request) -> Response:
            try:
                response: Response = await handle(request)
            except ServiceError as error:
                error.headers["Tus-Resumable"] = tus.VERSION
                raise
            response.headers["Tus-Resumable"] = tus.VERSION
            return response

        return speak


router = APIRouter(prefix="/v1/drives/{drive_id}/uploads", tags=["uploads"], route_class=TusRoute)

Resumable = Annotated[str | None, Header(alias="Tus-Resumable", description=f"always `{tus.VERSION}`")]
_BYTES = {"schema": {"type": "string", "format": "binary", "description": "the bytes from Upload-Offset on"}}
_PATCH_BODY = {"requestBody": {"required": True, "content": {tus.CONTENT_TYPE: _BYTES}}}


@router.options(
    "",
    status_code=204,
    summary="Show what of tus there is",
    responses={
        **gives(204, "See the headers", "Tus-Version", "Tus-Extension", "Tus-Checksum-Algorithm", "Tus-Max-Size"),
        **problems(401, 404),
    },
)
@router.options("/{upload_id}", status_code=204, include_in_schema=False)
def get_upload_protocol(drive_id: str, caller: CallerDep, context: ContextDep, response: Response) -> None:
    """Version and extensions of tus that this service speaks, and the largest size of an upload."""
    with context.database.read() as session:
        drives.get(session, caller.project_id, drive_id)
    response.headers["Tus-Version"] = tus.VERSION
    response.headers["Tus-Extension"] = tus.EXTENSIONS
    response.headers["Tus-Checksum-Algorithm"] = ",".join(tus.ALGORITHMS)
    response.headers["Tus-Max-Size"] = str(context.settings.max_archive_bytes)


@router.get("", summary="List uploads", responses={**gives(200, "A page of uploads"), **problems(401, 404, 422)})
def list_uploads(
    drive_id: str,
    caller: CallerDep,
    context: ContextDep,
    limit: Limit = 100,
    cursor: Cursor = None,
    sha256: Annotated[Sha256 | None, Query(description="only uploads announced with this digest")] = None,
) -> Page[UploadResource]:
    """Uploads of the drive that take bytes still. A client that has lost an upload's URL finds it by its digest.

    `offset_bytes` is what survives a power cut; HEAD of the upload says where to go on.
    """
    with context.database.read() as session:
        drives.get(session, caller.project_id, drive_id)
        statement = uploads.unfinished(drive_id, sha256=sha256)
        rows, following = page_of(session, statement, Upload.id, cursor=cursor, limit=limit)
    return Page(items=[_shown(upload) for (upload,) in rows], next=following)


@router.post(
    "",
    status_code=201,
    response_model=UploadResource,
    summary="Begin a resumable upload",
    responses={
        **gives(201, "It takes bytes, or is complete already", "Location", "Upload-Offset", "Upload-Expires"),
        **problems(400, 401, 404, 409, 412, 413, 422, 429, 507, sometimes={413: "Tus-Max-Size"}),
    },
)
def create_upload(
    drive_id: str,
    once: IdempotentDep,
    caller: CallerDep,
    context: ContextDep,
    tus_resumable: Resumable = None,
    upload_length: Annotated[str | None, Header(alias="Upload-Length", description="bytes of the whole file")] = None,
    upload_metadata: Annotated[
        str | None,
        Header(
            alias="Upload-Metadata",
            description="`path` with a file's name in the manifest, or `archive` for a zip or tar of files; "
            "`sha256` with the digest of the whole in hexadecimal; `replace` to take the bytes although others are "
            "stored. Values are in base64",
        ),
    ] = None,
    upload_concat: Annotated[str | None, Header(alias="Upload-Concat", description="not supported")] = None,
) -> Response:
    """Begin a resumable upload of one file of an open drive, or of an archive; `Location` takes its bytes.

    Where a drive of the project has the content already (by `sha256`) the upload is complete at once: `Upload-Offset`
    says so.
    """
    tus.require_version(tus_resumable)
    if upload_concat is not None:
        raise tus.malformed("Upload-Concat is not supported", "Send the file as one upload.")
    announced = tus.parse_announced(upload_length, upload_metadata)
    settings = context.settings
    bound = settings.max_archive_bytes if announced.path is None else settings.max_file_bytes
    require_size(announced.size_bytes, bound, what="upload", headers={"Tus-Max-Size": str(bound)})
    settings.spool_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
    require_space(settings.spool_dir, announced.size_bytes, min_free_bytes=settings.min_free_disk_bytes)

    def effect(session: Session) -> Answer:
        upload = uploads.create(
            session,
            project_id=caller.project_id,
            drive_id=drive_id,
            announced=announced,
            expires_us=now_us() + int(settings.upload_hours * 3600e6),
        )
        return answer(
            201,
            _shown(upload),
            Location=f"/v1/drives/{drive_id}/uploads/{upload.id}",
            Upload_Offset=str(upload.kept_bytes),
            Upload_Expires=tus.http_date(upload.expires_us),
        )

    return once(effect, f"{upload_length}\n{upload_metadata}".encode())


@router.head(
    "/{upload_id}",
    response_class=Response,
    summary="Show how far an upload is",
    responses={
        **gives(
            200,
            "How far the upload is",
            "Upload-Offset",
            "Upload-Expires",
            "Upload-Length",
            "Cache-Control",
            sometimes=["Upload-Metadata"],
        ),
        **problems(400, 401, 404, 409, 410, 412, 413, 415, 422, 423, 507),
    },
)
async def get_upload_offset(
    drive_id: str, upload_id: str, caller: CallerDep, context: ContextDep, tus_resumable: Resumable = None
) -> Response:
    """Offset from which to go on. All bytes up to `Upload-Offset` are here, also after a crash of the service or its
    machine. Like every request, this one lets the upload live on until `Upload-Expires`.
    """
    tus.require_version(tus_resumable)
    upload, offset = await current_offset(context, caller.project_id, drive_id, upload_id)
    headers = {**_headers(upload, offset), "Upload-Length": str(upload.size_bytes), "Cache-Control": "no-store"}
    if upload.given_metadata:
        headers["Upload-Metadata"] = upload.given_metadata
    return Response(headers=headers)


@router.patch(
    "/{upload_id}",
    status_code=204,
    response_class=Response,
    summary="Go on with an upload",
    responses={
        **gives(204, "The bytes are here for good", "Upload-Offset", "Upload-Expires"),
        **problems(
            *(400, 401, 404, 408, 409, 410, 412, 413, 415, 422, 423, 460, 507), sometimes={409: "Upload-Offset"}
        ),
    },
    openapi_extra=_PATCH_BODY,
)
async def append_to_upload(
    drive_id: str,
    upload_id: str,
    request: Request,
    caller: CallerDep,
    context: ContextDep,
    tus_resumable: Resumable = None,
    upload_offset: Annotated[
        str | None, Header(alias="Upload-Offset", description="where these bytes begin: what HEAD answered")
    ] = None,
    upload_checksum: Annotated[
        str | None,
        Header(
            alias="Upload-Checksum", description="`sha256 BASE64` or `sha1 BASE64` of these bytes; others are dropped"
        ),
    ] = None,
) -> Response:
    """Go on with an upload. With its last byte it becomes the drive's file, as a PUT of it does.

    What came before a connection broke is kept; with `Upload-Checksum` only what was compared.
    """
    tus.require_version(tus_resumable)
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != tus.CONTENT_TYPE:
        raise WrongMediaType(
            f"Content-Type is {request.headers.get('content-type')!r}", remedy=f"Send Content-Type: {tus.CONTENT_TYPE}."
        )
    writing = UploadWriting(context, caller.project_id, drive_id, upload_id)
    upload, offset = await writing.run(
        request.stream(),
        offset=tus.parse_number("Upload-Offset", upload_offset),
        length=_content_length(request),
        checksum=tus.parse_checksum(upload_checksum),
    )
    return Response(status_code=204, headers=_headers(upload, offset))


@router.delete(
    "/{upload_id}",
    status_code=204,
    summary="End an upload",
    responses={**gives(204, "Its bytes are dropped"), **problems(401, 404, 410, 412, 423)},
)
async def delete_upload(
    drive_id: str, upload_id: str, caller: CallerDep, context: ContextDep, tus_resumable: Resumable = None
) -> None:
    """End an upload and drop its bytes. What has become a file of the drive stays."""
    tus.require_version(tus_resumable)
    await anyio.to_thread.run_sync(discard, context, caller.project_id, drive_id, upload_id)


@router.post("/{upload_id}", include_in_schema=False)
async def override_method(
    drive_id: str,
    upload_id: str,
    request: Request,
    caller: CallerDep,
    context: ContextDep,
    x_http_method_override: Annotated[str | None, Header()] = None,
) -> Response:
    """Take the method from a header, for clients behind what lets no PATCH or DELETE through."""
    headers = request.headers
    resumable = headers.get("tus-resumable")
    match (x_http_method_override or "").upper():
        case "PATCH":
            given = (resumable, headers.get("upload-offset"), headers.get("upload-checksum"))
            return await append_to_upload(drive_id, upload_id, request, caller, context, *given)
        case "DELETE":
            await delete_upload(drive_id, upload_id, caller, context, resumable)
            return Response(status_code=204)
        case "HEAD":
            return await get_upload_offset(drive_id, upload_id, caller, context, resumable)
    raise MethodNotAllowed(
        f"POST {request.url.path} needs X-HTTP-Method-Override: PATCH, DELETE or HEAD",
        remedy="Send PATCH itself, or the header.",
        headers={"Allow": "HEAD, PATCH, DELETE, OPTIONS"},
    )


def _content_length(request: Request) -> int | None:
    given = request.headers.get("content-length")
    return None if given is None else int(given)


def _headers(upload: Upload, offset: int) -> dict[str, str]:
    return {"Upload-Offset": str(offset), "Upload-Expires": tus.http_date(upload.expires_us)}


def _shown(upload: Upload) -> UploadResource:
    return UploadResource.model_validate(
        {
            "id": upload.id,
            "drive_id": upload.drive_id,
            "path": upload.path,
            "size_bytes": upload.size_bytes,
            "offset_bytes": upload.kept_bytes,
            "sha256": upload.sha256,
            "done": upload.is_done,
            "created_at": moment(upload.created_us),
            "expires_at": moment(upload.expires_us),
        }
    )
