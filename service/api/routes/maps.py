"""Maps and their versions: list, show, go back, delete, download."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Request, Response
from sqlalchemy import ColumnElement, select
from sqlalchemy.orm import Session

from schemas.api.maps import CurrentVersion, MapFileResource, MapResource, MapVersionResource
from schemas.api.resource import Page
from service.api.dependencies import CallerDep, ContextDep, Cursor, Limit, moment
from service.api.http.body_reading import json_body
from service.api.http.paging import newest, page_of
from service.api.http.request_bodies import Body, describe
from service.api.http.responses import gives, problems
from service.api.routes.downloads import download_route, files_of, find_file, send_file
from service.database.tables import Blob, Export, Map, MapFile, MapScene, MapVersion
from service.domain import exports, maps
from service.storage.named_blobs import Named

router = APIRouter(prefix="/v1/maps", tags=["maps"])

read_current = json_body(CurrentVersion, lambda settings: settings.max_json_bytes)


@router.get("", summary="List maps", responses={**gives(200, "A page of maps"), **problems(401, 422)})
def list_maps(caller: CallerDep, context: ContextDep, limit: Limit = 50, cursor: Cursor = None) -> Page[MapResource]:
    """Maps of the project, newest first, with their current versions."""
    with context.database.read() as session:
        found, following = newest(session, Map, caller.project_id, cursor=cursor, limit=limit)
        return Page(items=[_shown(session, each) for each in found], next=following)


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
def delete_map(map_id: str, caller: CallerDep, context: ContextDep) -> None:
    """Delete a map with all its versions. Its scenes and drives stay."""

    def remove(session: Session) -> Named:
        found = maps.get(session, caller.project_id, map_id, lock=True)
        exports.require_none_active(session, what=f"map {map_id}", mine=Export.map_id == map_id)
        return maps.remove(session, found)

    context.collector.add(caller.project_id, context.database.transact(remove))


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

    def choose(session: Session) -> MapResource:
        found = maps.get(session, caller.project_id, map_id, lock=True)
        maps.show_version(session, found, body.value.version)
        session.flush()
        return _shown(session, found)

    return context.database.transact(choose)


@router.get(
    "/{map_id}/versions",
    summary="List a map's versions",
    responses={**gives(200, "A page of versions"), **problems(401, 404, 422)},
)
def list_map_versions(
    map_id: str, caller: CallerDep, context: ContextDep, limit: Limit = 50, cursor: Cursor = None
) -> Page[MapVersionResource]:
    """Versions of a map, newest first, without their files."""
    with context.database.read() as session:
        found = maps.get(session, caller.project_id, map_id)
        statement = select(MapVersion).where(MapVersion.map_id == map_id)
        rows, following = page_of(session, statement, MapVersion.number, cursor=cursor, limit=limit)
        return Page(items=[_shown_version(session, found, version) for (version,) in rows], next=following)


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
def delete_map_version(map_id: str, version: str, caller: CallerDep, context: ContextDep) -> None:
    """Delete a version that is not the current one. Its scenes stay."""

    def remove(session: Session) -> Named:
        found = maps.get(session, caller.project_id, map_id, lock=True)
        number = maps.version_of(session, found, version).number
        mine = (Export.map_id == map_id) & (Export.map_version == number)
        exports.require_none_active(session, what=f"version {number} of map {map_id}", mine=mine)
        return maps.remove_version(session, found, version)

    context.collector.add(caller.project_id, context.database.transact(remove))


@download_route(router, "/{map_id}/versions/{version}/files/{path:path}", summary="Download a file of a map")
async def download_map_file(
    map_id: str, version: str, path: str, request: Request, caller: CallerDep, context: ContextDep
) -> Response:
    """One file of a map's version. `Range` resumes a download; `ETag` and `Repr-Digest` are its SHA-256."""

    def find(session: Session) -> tuple[str, MapFile, Blob]:
        found = maps.get(session, caller.project_id, map_id)
        shown = maps.version_of(session, found, version)
        owner = f"version {shown.number} of map {map_id}"
        return f"{found.name}-{shown.number}", *find_file(session, MapFile, _files(shown), path, owner=owner)

    return await send_file(context, request, path, find)


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
    url = f"/v1/maps/{found.id}/versions/{version.number}"
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
            "files": files_of(session, MapFile, _files(version), MapFileResource, url) if with_files else [],
            "created_at": moment(version.created_us),
        }
    )


def _files(version: MapVersion) -> ColumnElement[bool]:
    return (MapFile.map_id == version.map_id) & (MapFile.number == version.number)
