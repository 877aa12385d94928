"""Maps and their versions: list, show, go back, delete, download."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, BackgroundTasks, Depends, Request, Response
from sqlalchemy import select
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from schemas.api.maps import CurrentVersion, MapFileResource, MapResource, MapVersionResource
from schemas.api.resource import Page
from service.api.context import Context
from service.api.dependencies import CallerDep, ContextDep, Cursor, Limit, moment
from service.api.http.body_reading import json_body
from service.api.http.paging import cursor_of, position_of
from service.api.http.request_bodies import Body, describe
from service.api.http.responses import gives, problems
from service.api.routes.downloads import (
    DOWNLOAD_PARAMETERS,
    DOWNLOADS,
    HEAD_PARAMETERS,
    HEADS,
    download_name,
    send_file,
)
from service.database.tables import Blob, Map, MapFile, MapScene, MapVersion
from service.domain import maps
from service.errors import not_found
from service.storage.garbage_collection import collect_unused

router = APIRouter(prefix="/v1/maps", tags=["maps"])

read_current = json_body(CurrentVersion, lambda settings: settings.max_json_bytes)


@router.get("", summary="List maps", responses={**gives(200, "A page of maps"), **problems(401, 422)})
def list_maps(caller: CallerDep, context: ContextDep, limit: Limit = 50, cursor: Cursor = None) -> Page[MapResource]:
    """Maps of the project, newest first, with their current versions."""
    with context.database.read() as session:
        found = maps.page(session, caller.project_id, after=position_of(cursor, int, str), limit=limit)
        items = [_shown(session, each) for each in found]
    last = found[-1] if len(found) == limit else None
    return Page(items=items, next=None if last is None else cursor_of(last.created_us, last.id))


@router.get("/{map_id}", summary="Show a map", responses={**gives(200, "The map"), **problems(401, 404)})
def get_map(map_id: str, caller: CallerDep, context: ContextDep) -> MapResource:
    """One map and its current version. One without a version is being made, or could not be."""
    with context.database.read() as session:
        return _shown(session, maps.get(session, caller.project_id, map_id))


@router.delete(
    "/{map_id}",
    status_code=204,
    summary="Delete a map",
    responses={**gives(204, "Deleted"), **problems(401, 404, 409)},
)
def delete_map(map_id: str, caller: CallerDep, context: ContextDep, background: BackgroundTasks) -> None:
    """Delete a map with all its versions. Its scenes and drives stay."""
    with context.database.write() as session:
        maps.remove(session, maps.get(session, caller.project_id, map_id, lock=True))
    background.add_task(collect_unused, context.database, context.artifacts, project_id=caller.project_id)


@router.put(
    "/{map_id}/current-version",
    response_model=MapResource,
    summary="Choose a map's current version",
    responses={**gives(200, "The map with this version"), **problems(401, 404, 408, 409, 413, 422)},
    openapi_extra=describe(CurrentVersion),
)
def set_current_version(
    map_id: str,
    caller: CallerDep,
    context: ContextDep,
    body: Annotated[Body[CurrentVersion], Depends(read_current, scope="function")],
) -> MapResource:
    """Make another version the current one, for example to go back. The next aggregation goes on from it."""
    with context.database.write() as session:
        found = maps.get(session, caller.project_id, map_id, lock=True)
        maps.show_version(session, found, body.value.version)
        session.flush()
        return _shown(session, found)


@router.get(
    "/{map_id}/versions",
    summary="List a map's versions",
    responses={**gives(200, "A page of versions"), **problems(401, 404, 422)},
)
def list_map_versions(
    map_id: str, caller: CallerDep, context: ContextDep, limit: Limit = 50, cursor: Cursor = None
) -> Page[MapVersionResource]:
    """Versions of a map, newest first, without their files."""
    after = position_of(cursor, int)
    with context.database.read() as session:
        found = maps.get(session, caller.project_id, map_id)
        statement = select(MapVersion).where(MapVersion.map_id == map_id)
        if after is not None:
            statement = statement.where(MapVersion.number < after[0])
        versions = session.scalars(statement.order_by(MapVersion.number.desc()).limit(limit)).all()
        items = [_shown_version(session, found, version) for version in versions]
    last = versions[-1] if len(versions) == limit else None
    return Page(items=items, next=None if last is None else cursor_of(last.number))


@router.get(
    "/{map_id}/versions/{version}",
    summary="Show a map's version",
    responses={**gives(200, "The version"), **problems(401, 404)},
)
def get_map_version(map_id: str, version: str, caller: CallerDep, context: ContextDep) -> MapVersionResource:
    """One version and its files, by its number or as `current`."""
    with context.database.read() as session:
        found = maps.get(session, caller.project_id, map_id)
        return _shown_version(session, found, maps.version_of(session, found, version), with_files=True)


@router.delete(
    "/{map_id}/versions/{version}",
    status_code=204,
    summary="Delete a map's version",
    responses={**gives(204, "Deleted"), **problems(401, 404, 409)},
)
def delete_map_version(
    map_id: str, version: str, caller: CallerDep, context: ContextDep, background: BackgroundTasks
) -> None:
    """Delete a version that is not the current one. Its scenes stay."""
    with context.database.write() as session:
        maps.remove_version(session, maps.get(session, caller.project_id, map_id, lock=True), version)
    background.add_task(collect_unused, context.database, context.artifacts, project_id=caller.project_id)


@router.head(
    "/{map_id}/versions/{version}/files/{path:path}",
    response_class=Response,
    name="head_map_file",
    summary="Show a download's headers",
    responses={**HEADS, **problems(401, 404)},
    openapi_extra=HEAD_PARAMETERS,
)
@router.get(
    "/{map_id}/versions/{version}/files/{path:path}",
    response_class=Response,
    summary="Download a file of a map",
    responses={**DOWNLOADS, **problems(401, 404, 416)},
    openapi_extra=DOWNLOAD_PARAMETERS,
)
async def download_map_file(
    map_id: str, version: str, path: str, request: Request, caller: CallerDep, context: ContextDep
) -> Response:
    """One file of a map's version. `Range` resumes a download; `ETag` and `Repr-Digest` are its SHA-256."""
    found, file, blob = await run_in_threadpool(_look_up, context, caller.project_id, map_id, version, path)
    name = download_name(f"{found.name}-{file.number}", path)
    return await send_file(context, request, blob, media_type=file.media_type, name=name)


def _look_up(context: Context, project_id: str, map_id: str, version: str, path: str) -> tuple[Map, MapFile, Blob]:
    with context.database.read() as session:
        found = maps.get(session, project_id, map_id)
        number = maps.version_of(session, found, version).number
        mine = (MapFile.map_id == map_id) & (MapFile.number == number) & (MapFile.path == path)
        statement = select(MapFile, Blob).join(Blob, MapFile.blob_id == Blob.id).where(mine)
        row = session.execute(statement).first() if path.isprintable() else None
        if row is None:
            raise not_found(f"file in version {number} of map {map_id} named", path)
        return found, row[0], row[1]


def _shown(session: Session, found: Map) -> MapResource:
    version = None
    if found.current_version is not None:
        version = _shown_version(session, found, maps.version_of(session, found, "current"))
    return MapResource.model_validate(
        {
            "id": found.id,
            "name": found.name,
            "current_version": found.current_version,
            "version": version,
            "job_id": maps.job_under_way(session, found.id),
            "created_at": moment(found.created_us),
            "expires_at": moment(found.expires_us),
        }
    )


def _shown_version(
    session: Session, found: Map, version: MapVersion, *, with_files: bool = False
) -> MapVersionResource:
    mine = (MapScene.map_id == found.id) & (MapScene.number == version.number)
    scenes = session.scalars(select(MapScene).where(mine).order_by(MapScene.name)).all()
    shown = ("name", "drive_id", "scene_id", "connected")
    return MapVersionResource.model_validate(
        {
            "map_id": found.id,
            "number": version.number,
            "is_current": version.number == found.current_version,
            "name": found.name,
            "job_id": version.job_id,
            "summary": version.summary,
            "scenes": [{name: getattr(scene, name) for name in shown} for scene in scenes],
            "unconnected": [scene.name for scene in scenes if not scene.connected],
            "failed": version.failed,
            "files": _files(session, version) if with_files else [],
            "created_at": moment(version.created_us),
        }
    )


def _files(session: Session, version: MapVersion) -> list[MapFileResource]:
    mine = (MapFile.map_id == version.map_id) & (MapFile.number == version.number)
    statement = select(MapFile, Blob).join(Blob, MapFile.blob_id == Blob.id).where(mine).order_by(MapFile.path)
    return [
        MapFileResource(
            path=file.path,
            size_bytes=blob.size_bytes,
            sha256=blob.sha256,
            media_type=file.media_type,
            url=f"/v1/maps/{file.map_id}/versions/{file.number}/files/{file.path}",
        )
        for file, blob in session.execute(statement)
    ]
