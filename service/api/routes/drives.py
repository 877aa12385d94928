"""Drives: create, list, show, delete, commit, and what their check found."""

from __future__ import annotations

from functools import partial
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Response
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from schemas.api.drives import DriveResource, DriveState, PreflightResource, PreflightState
from schemas.api.resource import Finding, Page
from schemas.drive import DriveManifest, Vehicle
from service.api.context import Context
from service.api.dependencies import CallerDep, ContextDep, Cursor, IdempotentDep, Limit, answer, expiry_us, moment
from service.api.http.body_reading import parsed_body
from service.api.http.paging import newest
from service.api.http.request_bodies import BODY, Body, describe, json_content
from service.api.http.responses import gives, problems
from service.api.manifests.manifest_check import checked_manifest, stored_manifest
from service.api.manifests.reading import read_manifest
from service.database.tables import Blob, Drive, now_us
from service.domain import drives
from service.domain.drives import Stored
from service.domain.idempotency import Answer
from service.domain.manifest_facts import ManifestFacts
from service.errors import drive_rejected
from service.storage.blob_writer import BlobWriter, StoredFile
from service.storage.durability import secure_drive
from service.storage.spool import SpoolWriter

router = APIRouter(prefix="/v1/drives", tags=["drives"])

read_facts = parsed_body(partial(read_manifest, what=BODY), lambda settings: settings.max_manifest_bytes)


@router.post(
    "",
    status_code=201,
    response_model=DriveResource,
    summary="Create a drive",
    responses={**gives(201, "The drive is open", "Location"), **problems(401, 408, 409, 413, 422, 429, 507)},
    openapi_extra=describe(DriveManifest),
)
async def create_drive(
    once: IdempotentDep,
    caller: CallerDep,
    context: ContextDep,
    body: Annotated[Body[ManifestFacts], Depends(read_facts, scope="function")],
) -> Response:
    """Create a drive from its manifest, `drive.json`. Then upload the files that it names, and commit."""

    def create() -> Response:
        rows = drives.rows_of(body.value)
        with BlobWriter(context.database, context.artifacts, project_id=caller.project_id, durable=True) as store:
            stored = _store_manifest(context, store, body.raw)

            def effect(session: Session) -> Answer:
                drive = drives.create(
                    session,
                    project_id=caller.project_id,
                    manifest=body.value,
                    rows=rows,
                    stored=stored,
                    expires_us=expiry_us(now_us(), context.settings.drive_retention_days),
                )
                return answer(201, shown(drive, Stored(0, 0)), Location=f"/v1/drives/{drive.id}")

            return once(effect, body.raw)

    return await run_in_threadpool(create)


def _store_manifest(context: Context, store: BlobWriter, raw: bytes) -> StoredFile:
    writer = SpoolWriter(context.settings.spool_dir, min_free_bytes=context.settings.min_free_disk_bytes)
    try:
        spooled = writer.finish(raw)
        return store(spooled.path, sha256=spooled.sha256, size_bytes=spooled.size_bytes)
    finally:
        writer.discard()


@router.get("", summary="List drives", responses={**gives(200, "A page of drives"), **problems(401, 422)})
def list_drives(
    caller: CallerDep,
    context: ContextDep,
    limit: Limit = 50,
    cursor: Cursor = None,
    vehicle: Annotated[Vehicle | None, Query(description="only of this vehicle")] = None,
    preflight: Annotated[
        list[PreflightState] | None,
        Query(max_length=len(PreflightState), description="only with this state of the check; may be repeated"),
    ] = None,
) -> Page[DriveResource]:
    """Drives of the project, newest first."""
    with context.database.read() as session:
        found, following = newest(
            session,
            Drive,
            caller.project_id,
            cursor=cursor,
            limit=limit,
            conditions=[Drive.preflight_state.in_(preflight)] if preflight else (),
            vehicle=vehicle,
        )
        stored = drives.stored_of(session, found)
    return Page(items=[shown(drive, stored[drive.id]) for drive in found], next=following)


@router.get("/{drive_id}", summary="Show a drive", responses={**gives(200, "The drive"), **problems(401, 404)})
def get_drive(drive_id: str, caller: CallerDep, context: ContextDep) -> DriveResource:
    """One drive."""
    with context.database.read() as session:
        return _shown(session, drives.get(session, caller.project_id, drive_id))


@router.get(
    "/{drive_id}/manifest",
    response_class=Response,
    summary="Show a drive's manifest",
    responses={**gives(200, "The manifest", content=json_content(DriveManifest)), **problems(401, 404, 503)},
)
def get_drive_manifest(drive_id: str, caller: CallerDep, context: ContextDep) -> Response:
    """The drive's manifest, byte for byte as it was sent."""
    with context.database.read() as session:
        drive = drives.get(session, caller.project_id, drive_id)
        key = session.get_one(Blob, drive.manifest_blob_id).key
    return Response(stored_manifest(context, key), media_type="application/json")


@router.delete(
    "/{drive_id}",
    status_code=204,
    summary="Delete a drive",
    responses={**gives(204, "Deleted"), **problems(401, 404, 409)},
)
def delete_drive(drive_id: str, caller: CallerDep, context: ContextDep) -> None:
    """Delete a drive and its files. Scenes that were made of it stay.

    Bytes that nothing else needs leave the quota at once, or an hour after they were last used.
    """
    named = context.database.transact(lambda session: drives.remove(session, caller.project_id, drive_id))
    context.collector.add(caller.project_id, named)


@router.post(
    "/{drive_id}:commit",
    response_model=DriveResource,
    summary="Commit a drive",
    responses={
        **gives(200, "The drive is frozen, and the check of its images begins"),
        **problems(401, 404, 409, 422, 429, 503),
    },
)
async def commit_drive(drive_id: str, once: IdempotentDep, caller: CallerDep, context: ContextDep) -> Response:
    """Freeze a drive whose files are all there, check its manifest, and start the check of its images.

    A drive whose manifest has errors stays open; nothing of it is lost.
    """
    found: list[Finding] = []

    def prepare() -> None:
        with context.database.read() as session:
            drive = drives.get(session, caller.project_id, drive_id)
            key = session.get_one(Blob, drive.manifest_blob_id).key
            if drive.state == DriveState.OPEN:
                drives.require_complete(session, drive)
        if drive.state == DriveState.OPEN:
            found.extend(checked_manifest(context, key))
            secure_drive(context.database, context.artifacts, drive_id)

    def effect(session: Session) -> Answer:
        drive = drives.get(session, caller.project_id, drive_id, lock=True)
        if any(finding.severity == "error" for finding in found):
            drives.require_complete(session, drive)  # what is missing is said first; bytes may prove to be lost
            raise drive_rejected(drive_id, found)
        job = drives.commit(
            session,
            drive,
            [finding.model_dump() for finding in found],
            job_expires_us=expiry_us(now_us(), context.settings.job_retention_days),
        )
        return answer(200, _shown(session, drive), waiting=(job,))

    return await context.commits.run(caller.project_id, partial(once, effect, prepare=prepare))


@router.get(
    "/{drive_id}/preflight",
    summary="Show what the check of a drive found",
    responses={**gives(200, "What is known so far"), **problems(401, 404)},
)
def get_preflight(drive_id: str, caller: CallerDep, context: ContextDep) -> PreflightResource:
    """Findings of the check of the drive: of the manifest at once, of the images when its job is done."""
    with context.database.read() as session:
        drive = drives.get(session, caller.project_id, drive_id)
    return PreflightResource(
        state=drive.preflight_state,
        job_id=drive.preflight_job_id,
        findings=[Finding.model_validate(finding) for finding in drive.findings],
    )


def _shown(session: Session, drive: Drive) -> DriveResource:
    return shown(drive, drives.stored_of(session, [drive])[drive.id])


def shown(drive: Drive, stored: Stored) -> DriveResource:
    """A drive as the API shows it."""
    findings = [Finding.model_validate(finding) for finding in drive.findings]
    counts = {name: sum(f.count for f in findings if f.severity == name) for name in ("error", "warning")}
    return DriveResource.model_validate(
        {
            "id": drive.id,
            "name": drive.name,
            "vehicle": drive.vehicle,
            "state": drive.state,
            "cameras": drive.cameras,
            "frames": drive.frames,
            "has_gnss": drive.has_gnss,
            "files_expected": drive.files_expected,
            "files_stored": stored.files,
            "bytes_stored": stored.size_bytes,
            "preflight": drive.preflight_state,
            "preflight_errors": counts["error"],
            "preflight_warnings": counts["warning"],
            "preflight_job_id": drive.preflight_job_id,
            "created_at": moment(drive.created_us),
            "committed_at": moment(drive.committed_us),
            "expires_at": moment(drive.expires_us),
        }
    )
