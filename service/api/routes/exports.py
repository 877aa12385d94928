"""Exports of scenes and maps: ask, list, show, delete, download."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Annotated

from fastapi import APIRouter, Depends, Request, Response
from obstore.exceptions import BaseError as StoreError
from sqlalchemy import select
from sqlalchemy.orm import Session

from schemas.api.exports import ExportFileResource, ExportRequest, ExportResource
from schemas.api.jobs import JobState
from schemas.api.resource import Page
from schemas.artifacts import road_not_drawn
from service.api.context import Context
from service.api.dependencies import CallerDep, ContextDep, Cursor, IdempotentDep, Limit, answer, expiry_us, moment
from service.api.http.body_reading import json_body
from service.api.http.paging import newest
from service.api.http.request_bodies import Body, describe
from service.api.http.responses import gives, problems
from service.api.routes.downloads import download_route, files_of, find_file, send_file
from service.api.routes.job_views import RETRY_AFTER_S, shown_state, stalled_before_us
from service.database.tables import Blob, Export, ExportFile, Job, MapVersion, Scene, now_us
from service.domain import exports, maps
from service.domain.access import require
from service.domain.idempotency import Answer
from service.errors import FilesMissing
from service.settings import Settings
from service.storage.named_blobs import Named

router = APIRouter(prefix="/v1", tags=["exports"])

read_request = json_body(ExportRequest, lambda settings: settings.max_json_bytes)
BodyDep = Annotated[Body[ExportRequest], Depends(read_request, scope="function")]
_ASKED = {
    **gives(200, "The same was exported before, or is being exported", "Location", sometimes=["Retry-After"]),
    **gives(202, "The job is recorded and will run", "Location", "Retry-After"),
    **problems(401, 404, 408, 409, 413, 422, 429),
}


@router.post(
    "/scenes/{scene_id}/exports",
    status_code=202,
    response_model=ExportResource,
    summary="Export a scene",
    responses=_ASKED,
    openapi_extra=describe(ExportRequest),
)
def create_scene_export(
    scene_id: str, once: IdempotentDep, caller: CallerDep, context: ContextDep, body: BodyDep
) -> Response:
    """Ask for a scene, or one of its components, in formats of other programs, as a job.

    Scenes never change: the same formats with the same options are exported once, and answered with 200 from then on.
    """

    def effect(session: Session) -> Answer:
        scene = require(session, Scene, caller.project_id, scene_id, lock=True)
        return _asked(session, context, caller.project_id, scene, body.value)

    try:
        return once(effect, body.raw)
    except FilesMissing as missing:
        # After the transaction: a store that does not answer must hold no lock.
        reason = _reason_in_report(context, missing.report_key)
        if reason is None:
            raise
        raise FilesMissing(
            f"{missing.problem.detail}: {reason}",
            remedy="Leave the format out, or correct what the reason names and reconstruct the drive again.",
        ) from None


@router.post(
    "/maps/{map_id}/versions/{version}/exports",
    status_code=202,
    response_model=ExportResource,
    summary="Export a map's version",
    responses=_ASKED,
    openapi_extra=describe(ExportRequest),
)
def create_map_export(
    map_id: str, version: str, once: IdempotentDep, caller: CallerDep, context: ContextDep, body: BodyDep
) -> Response:
    """Ask for a version of a map in formats of other programs, as of a scene."""

    def effect(session: Session) -> Answer:
        found = maps.get(session, caller.project_id, map_id, lock=True)
        return _asked(session, context, caller.project_id, maps.version_of(session, found, version), body.value)

    return once(effect, body.raw)


@router.get(
    "/scenes/{scene_id}/exports",
    summary="List a scene's exports",
    responses={**gives(200, "A page of exports"), **problems(401, 404, 422)},
)
def list_scene_exports(
    scene_id: str, caller: CallerDep, context: ContextDep, limit: Limit = 50, cursor: Cursor = None
) -> Page[ExportResource]:
    """Exports of a scene, newest first, without their files."""
    with context.database.read() as session:
        require(session, Scene, caller.project_id, scene_id)
        found, following = newest(session, Export, caller.project_id, cursor=cursor, limit=limit, scene_id=scene_id)
        return Page(items=_listed(session, found, context.settings), next=following)


@router.get(
    "/maps/{map_id}/versions/{version}/exports",
    summary="List the exports of a map's version",
    responses={**gives(200, "A page of exports"), **problems(401, 404, 422)},
)
def list_map_exports(
    map_id: str, version: str, caller: CallerDep, context: ContextDep, limit: Limit = 50, cursor: Cursor = None
) -> Page[ExportResource]:
    """Exports of a version, newest first, without their files."""
    with context.database.read() as session:
        number = maps.version_of(session, maps.get(session, caller.project_id, map_id), version).number
        found, following = newest(
            session, Export, caller.project_id, cursor=cursor, limit=limit, map_id=map_id, map_version=number
        )
        return Page(items=_listed(session, found, context.settings), next=following)


@router.get("/exports", summary="List exports", responses={**gives(200, "A page of exports"), **problems(401, 422)})
def list_exports(
    caller: CallerDep, context: ContextDep, limit: Limit = 50, cursor: Cursor = None
) -> Page[ExportResource]:
    """Exports of the project, newest first, without their files."""
    with context.database.read() as session:
        found, following = newest(session, Export, caller.project_id, cursor=cursor, limit=limit)
        return Page(items=_listed(session, found, context.settings), next=following)


@router.get(
    "/exports/{export_id}", summary="Show an export", responses={**gives(200, "The export"), **problems(401, 404)}
)
def get_export(export_id: str, caller: CallerDep, context: ContextDep) -> ExportResource:
    """One export and its files. Its job tells how far it is."""
    with context.database.read() as session:
        export = require(session, Export, caller.project_id, export_id)
        return _shown(session, export, context.settings)


@router.delete(
    "/exports/{export_id}",
    status_code=204,
    summary="Delete an export",
    responses={**gives(204, "Deleted"), **problems(401, 404, 409)},
)
def delete_export(export_id: str, caller: CallerDep, context: ContextDep) -> None:
    """Delete an export and its files. One that is being made is cancelled first, at its job."""

    def remove(session: Session) -> Named:
        return exports.remove(session, require(session, Export, caller.project_id, export_id, lock=True))

    context.collector.add(caller.project_id, context.database.transact(remove))


@download_route(router, "/exports/{export_id}/files/{path:path}", summary="Download a file of an export")
async def download_export_file(
    export_id: str, path: str, request: Request, caller: CallerDep, context: ContextDep
) -> Response:
    """One file of an export. `Range` resumes a download; `ETag` and `Repr-Digest` are its SHA-256."""

    def find(session: Session) -> tuple[str, ExportFile, Blob]:
        require(session, Export, caller.project_id, export_id)
        mine = ExportFile.export_id == export_id
        return export_id, *find_file(session, ExportFile, mine, path, owner=f"export {export_id}")

    return await send_file(context, request, path, find)


def _reason_in_report(context: Context, key: str | None) -> str | None:
    """The reason in a stored report for a picture that was not drawn; None without a readable one."""
    try:
        return None if key is None else road_not_drawn(json.loads(context.artifacts.read(key)))
    except (OSError, StoreError, ValueError, LookupError, TypeError, AttributeError):
        return None


def _asked(
    session: Session, context: Context, project_id: str, subject: Scene | MapVersion, asked: ExportRequest
) -> Answer:
    export, job = exports.create(
        session,
        project_id=project_id,
        subject=subject,
        asked=asked,
        job_expires_us=expiry_us(now_us(), context.settings.job_retention_days),
    )
    location = f"/v1/exports/{export.id}"
    shown = _shown(session, export, context.settings)
    if job is None and export.results is not None:
        return answer(200, shown, Location=location)
    status = 200 if job is None else 202
    return answer(
        status, shown, waiting=() if job is None else (job,), Location=location, Retry_After=str(RETRY_AFTER_S)
    )


def _listed(session: Session, found: Sequence[Export], settings: Settings) -> list[ExportResource]:
    """Exports without their files."""
    of_jobs = select(Job).where(Job.id.in_([export.job_id for export in found]))
    by_id = {job.id: job for job in session.scalars(of_jobs)}
    stalled_us = stalled_before_us(session, settings)
    return [_resource(export, by_id.get(export.job_id), [], stalled_us) for export in found]


def _shown(session: Session, export: Export, settings: Settings) -> ExportResource:
    """One export with its files."""
    mine, url = ExportFile.export_id == export.id, f"/v1/exports/{export.id}"
    files = files_of(session, ExportFile, mine, ExportFileResource, url)
    return _resource(export, session.get(Job, export.job_id), files, stalled_before_us(session, settings))


def _resource(export: Export, job: Job | None, files: list[ExportFileResource], stalled_us: int) -> ExportResource:
    if export.results is not None:
        state = JobState.SUCCEEDED
    else:
        state = JobState.FAILED if job is None else shown_state(job, stalled_us)
    return ExportResource.model_validate(
        {
            "id": export.id,
            "scene_id": export.scene_id,
            "map_id": export.map_id,
            "map_version": export.map_version,
            "formats": export.formats,
            "image_size_px": export.options.get("image_size_px"),
            "crs": export.options.get("crs"),
            "component": export.options.get("component"),
            "job_id": export.job_id,
            "state": state,
            "problem": None if job is None else job.problem,
            "results": export.results or [],
            "files": files,
            "created_at": moment(export.created_us),
            "expires_at": moment(export.expires_us),
        }
    )
