"""The files of a drive: one by one, or all in one archive."""

from __future__ import annotations

from collections.abc import AsyncIterator
from functools import partial
from typing import Annotated, TypedDict

import anyio
import anyio.from_thread
import anyio.to_thread
from fastapi import APIRouter, Depends, Header, Query, Request, Response
from sqlalchemy import select
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect

from schemas.api.drives import DeclaredFiles, DeclareFiles, DriveFileResource, StoredFiles
from schemas.api.resource import Page
from service.api.context import Context
from service.api.dependencies import CallerDep, ContextDep, Cursor, IdempotentDep, Limit, answer
from service.api.http.body_reading import json_body
from service.api.http.paging import page_of
from service.api.http.request_bodies import Body, describe, describe_bytes, refuse_form
from service.api.http.responses import gives, problems
from service.api.routes.file_ingest import archive_watch, keep_archive, keep_file, require_room, require_wanted
from service.database.tables import Blob, DriveFile
from service.digests import parse_digest
from service.domain import drive_files, drives
from service.domain.idempotency import Answer
from service.errors import ImageRefused, NotAnArchive, PartialBody, ServiceError, WrongDigest
from service.storage.spool import receive, receive_into

router = APIRouter(prefix="/v1/drives/{drive_id}", tags=["files"])

_DRAINED_BYTES = 16 << 20
_ASK_FIRST_BYTES = 4 << 20  # from here on a file that is not wanted is refused before its bytes come
# Of a body that is a whole file as it is, both are the same.
_DIGEST_FIELDS = ("content-digest", "repr-digest")
read_declaration = json_body(DeclareFiles, lambda settings: settings.max_json_bytes)

ContentDigest = Annotated[
    str | None,
    Header(
        alias="Content-Digest",
        max_length=2000,
        description="`sha-256=:BASE64:` of the body (RFC 9530). Bytes with another digest are refused and discarded. "
        "`Repr-Digest` is taken too",
    ),
]
Replace = Annotated[bool, Query(description="take the bytes although others are stored under this name")]


@router.get("/files", summary="List files", responses={**gives(200, "A page of files"), **problems(401, 404, 422)})
def list_files(
    drive_id: str,
    caller: CallerDep,
    context: ContextDep,
    limit: Limit = 1000,
    cursor: Cursor = None,
    stored: Annotated[bool | None, Query(description="only files that are here, or only those that are not")] = None,
) -> Page[DriveFileResource]:
    """Files that the manifest names, by path."""
    with context.database.read() as session:
        drive = drives.get(session, caller.project_id, drive_id)
        statement = select(DriveFile, Blob).outerjoin(Blob, DriveFile.blob_id == Blob.id)
        statement = statement.where(DriveFile.drive_id == drive.id)
        if stored is not None:
            statement = statement.where(DriveFile.blob_id.is_not(None) if stored else DriveFile.blob_id.is_(None))
        rows, following = page_of(session, statement, DriveFile.path, cursor=cursor, limit=limit, is_rising=True)
    return Page(items=[_shown(file, blob) for file, blob in rows], next=following)


@router.post(
    "/files:declare",
    response_model=DeclaredFiles,
    summary="Learn which files must be sent",
    responses={**gives(200, "What is here and what is not"), **problems(401, 404, 408, 409, 413, 422)},
    openapi_extra=describe(DeclareFiles),
)
def declare_files(
    drive_id: str,
    once: IdempotentDep,
    caller: CallerDep,
    body: Annotated[Body[DeclareFiles], Depends(read_declaration, scope="function")],
) -> Response:
    """Say which files you have, and learn which of them must be sent.

    A content that the project has stored already, in this drive or another, is not sent again.
    """

    def effect(session: Session) -> Answer:
        drive = drives.get(session, caller.project_id, drive_id, lock=True)
        stored, to_send = drives.declare(session, drive, body.value.files)
        return answer(200, DeclaredFiles(stored=stored, to_send=to_send))

    return once(effect, body.raw)


@router.put(
    "/files/{path:path}",
    response_model=DriveFileResource,
    summary="Send a file",
    responses={
        **gives(200, "These bytes were stored before"),
        **gives(201, "Stored", model=DriveFileResource),
        **problems(400, 401, 404, 409, 413, 422, 507),
    },
    openapi_extra=describe_bytes("the file's bytes"),
)
async def put_file(
    drive_id: str,
    path: str,
    request: Request,
    response: Response,
    caller: CallerDep,
    context: ContextDep,
    content_digest: ContentDigest = None,
    replace: Replace = False,
) -> DriveFileResource:
    """Store one file of an open drive, whole or not at all. Sending the same bytes again changes nothing."""
    stream = request.stream()
    try:
        announced = _announced(request, context)
        size_bytes, sha256 = announced["expected_bytes"], announced["expected_sha256"]
        if size_bytes is None or size_bytes >= _ASK_FIRST_BYTES:
            of_file = partial(require_wanted, sha256=sha256, size_bytes=size_bytes)
            await run_in_threadpool(of_file, context, caller.project_id, drive_id, path)
        new, shown = await receive_into(
            lambda spooled: keep_file(context, caller.project_id, drive_id, path, spooled, replace),
            stream,
            context.settings.spool_dir,
            max_bytes=context.settings.max_file_bytes,
            **announced,
        )
    except ServiceError as error:
        await _drain(request, stream)
        _refuse_form(request, error)
        raise
    response.status_code = 201 if new else 200
    return shown


@router.delete(
    "/files/{path:path}",
    status_code=204,
    summary="Forget a file",
    responses={**gives(204, "Its bytes are not here any more"), **problems(401, 404, 409, 422)},
)
def delete_file(drive_id: str, path: str, caller: CallerDep, context: ContextDep) -> None:
    """Forget the bytes of one file of an open drive."""

    def forget(session: Session) -> None:
        drive_files.empty(session, drive_files.find(session, caller.project_id, drive_id, path, lock=True))

    context.database.transact(forget)


@router.put(
    "/archive",
    summary="Send an archive of files",
    responses={**gives(200, "All its files are stored"), **problems(400, 401, 404, 409, 413, 415, 422, 507)},
    openapi_extra=describe_bytes(
        "a zip, tar, tar.gz, tar.bz2 or tar.xz of files under the names that the manifest gives"
    ),
)
async def put_archive(
    drive_id: str,
    request: Request,
    caller: CallerDep,
    context: ContextDep,
    content_digest: ContentDigest = None,
    replace: Replace = False,
) -> StoredFiles:
    """Store all files of an archive in an open drive, or none of them. One folder around them is taken off.

    A name that is none of the drive's is refused as soon as it comes, where the kind of archive shows it.
    """
    stream = request.stream()
    try:
        announced = _announced(request, context)
        room = partial(require_room, context, caller.project_id, drive_id, announced["expected_bytes"])
        max_bytes = await run_in_threadpool(room)
        watch = await run_in_threadpool(archive_watch, context, caller.project_id, drive_id)
        archive = await receive(
            stream,
            context.settings.spool_dir,
            max_bytes=max_bytes,
            look=watch.look,
            **announced,
        )
    except ServiceError as error:
        await _drain(request, stream)
        _refuse_form(request, error)
        raise
    with archive:
        unpacking = partial(keep_archive, context, caller.project_id, drive_id, archive, replace)
        try:
            return await context.unpacking.run(caller.project_id, unpacking)
        except ServiceError as error:
            _refuse_form(request, error)
            raise


class _Announced(TypedDict):
    expected_bytes: int | None
    expected_sha256: str | None
    min_free_bytes: int
    on_disk: anyio.CapacityLimiter


def _announced(request: Request, context: Context) -> _Announced:
    """Properties of a body that are known before it comes, and how it may be written."""
    if "content-range" in request.headers:
        raise PartialBody(
            "the request has a Content-Range, and a PUT stores whole files",
            remedy="Send the whole file, or its parts as a resumable upload: POST /v1/drives/{id}/uploads.",
        )
    length = request.headers.get("content-length")
    digests = [line for name in _DIGEST_FIELDS for line in request.headers.getlist(name)]
    return {
        "expected_bytes": None if length is None else int(length),
        "expected_sha256": parse_digest(*digests),
        "min_free_bytes": context.settings.min_free_disk_bytes,
        "on_disk": context.disk,
    }


def _refuse_form(request: Request, error: ServiceError) -> None:
    """Refuse a form in place of a file, as `refuse_form` does."""
    if isinstance(error, ImageRefused | NotAnArchive | WrongDigest):
        remedy = "Send the file's bytes alone: with curl --data-binary @FILE or -T FILE, not -F."
        refuse_form(request, type(error), what="the file", remedy=remedy, code=error.code)


async def _drain(request: Request, stream: AsyncIterator[bytes]) -> None:
    """Read on a little after a refusal: most clients look at the answer only once they have sent everything."""
    left = _DRAINED_BYTES
    if int(request.headers.get("content-length", 0)) > left or "expect" in request.headers:  # it waits for our word
        return
    try:
        async for part in stream:
            left -= len(part)
            if left < 0:
                return
    except (ClientDisconnect, ServiceError, RuntimeError):  # RuntimeError: the stream has been read to its end
        return


def _shown(file: DriveFile, blob: Blob | None) -> DriveFileResource:
    return DriveFileResource.model_validate(
        {
            "path": file.path,
            "role": file.role,
            "stored": blob is not None,
            "size_bytes": None if blob is None else blob.size_bytes,
            "sha256": None if blob is None else blob.sha256,
        }
    )
