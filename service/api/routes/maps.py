"""Maps and their versions: list, show, go back, delete, download."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Request, Response
from sqlalchemy.orm import Session

from schemas.api.maps import CurrentVersion, MapResource, MapVersionResource
from schemas.api.resource import Page
from service.api.dependencies import CallerDep, ContextDep, Cursor, Limit
from service.api.http.body_reading import json_body
from service.api.http.request_bodies import Body, describe
from service.api.http.responses import gives, problems
from service.api.routes.downloads import download_route, find_file, send_file
from service.api.routes.map_views import files_of_version, map_view, page_of_maps, page_of_versions, version_view
from service.database.tables import Blob, Export, MapFile
from service.domain import exports, maps
from service.storage.named_blobs import Named

router = APIRouter(prefix="/v1/maps", tags=["maps"])

read_current = json_body(CurrentVersion, lambda settings: settings.max_json_bytes)


@router.get("", summary="List maps", responses={**gives(200, "A page of maps"), **problems(401, 422)})
def list_maps(caller: CallerDep, context: ContextDep, limit: Limit = 50, cursor: Cursor = None) -> Page[MapResource]:
    """Maps of the project, newest first, with their current versions."""
    with context.database.read() as session:
        return page_of_maps(session, caller.project_id, cursor=cursor, limit=limit)


@router.get("/{map_id}", summary="Show a map", responses={**gives(200, "The map"), **problems(401, 404)})
def get_map(map_id: str, caller: CallerDep, context: ContextDep) -> MapResource:
    """One map and its current version. One without a version is being made, or could not be."""
    with context.database.read() as session:
        return map_view(session, maps.get(session, caller.project_id, map_id))


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
        return map_view(session, found)

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
        return page_of_versions(session, found, cursor=cursor, limit=limit)


@router.get(
    "/{map_id}/versions/{version}",
    summary="Show a map's version",
    responses={**gives(200, "The version"), **problems(401, 404)},
)
def get_map_version(map_id: str, version: str, caller: CallerDep, context: ContextDep) -> MapVersionResource:
    """One version and its files, by its number or as `current`."""
    with context.database.read() as session:
        found = maps.get(session, caller.project_id, map_id)
        return version_view(session, found, maps.version_of(session, found, version))


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
        return f"{found.name}-{shown.number}", *find_file(session, MapFile, files_of_version(shown), path, owner=owner)

    return await send_file(context, request, path, find)
