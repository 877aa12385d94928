"""Scenes: list, show, delete, download."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from sqlalchemy import delete
from sqlalchemy.orm import Session

from schemas.api.resource import Id, Page
from schemas.api.scenes import SceneFileResource, SceneResource
from service.api.dependencies import CallerDep, ContextDep, Cursor, Limit, moment
from service.api.http.paging import newest
from service.api.http.responses import gives, problems
from service.api.routes.downloads import download_route, files_of, find_file, send_file
from service.database.tables import Blob, Export, Scene, SceneFile
from service.domain import exports
from service.domain.access import require
from service.domain.maps import require_unused
from service.storage import named_blobs
from service.storage.named_blobs import Named

router = APIRouter(prefix="/v1/scenes", tags=["scenes"])


@router.get("", summary="List scenes", responses={**gives(200, "A page of scenes"), **problems(401, 422)})
def list_scenes(
    caller: CallerDep,
    context: ContextDep,
    limit: Limit = 50,
    cursor: Cursor = None,
    drive_id: Annotated[Id | None, Query(description="only of this drive")] = None,
) -> Page[SceneResource]:
    """Scenes of the project, newest first, without their files."""
    with context.database.read() as session:
        found, following = newest(session, Scene, caller.project_id, cursor=cursor, limit=limit, drive_id=drive_id)
    return Page(items=[_shown(scene, []) for scene in found], next=following)


@router.get("/{scene_id}", summary="Show a scene", responses={**gives(200, "The scene"), **problems(401, 404)})
def get_scene(scene_id: str, caller: CallerDep, context: ContextDep) -> SceneResource:
    """One scene and its files."""
    with context.database.read() as session:
        scene = require(session, Scene, caller.project_id, scene_id)
        mine = SceneFile.scene_id == scene_id
        return _shown(scene, files_of(session, SceneFile, mine, SceneFileResource, f"/v1/scenes/{scene_id}"))


@router.delete(
    "/{scene_id}",
    status_code=204,
    summary="Delete a scene",
    responses={**gives(204, "Deleted"), **problems(401, 404, 409)},
)
def delete_scene(scene_id: str, caller: CallerDep, context: ContextDep) -> None:
    """Delete a scene and its files. Its drive stays; what a map is made of cannot be deleted."""

    def remove(session: Session) -> Named:
        require(session, Scene, caller.project_id, scene_id, lock=True)
        require_unused(session, what=f"scene {scene_id}", scene_id=scene_id)
        exports.require_none_active(session, what=f"scene {scene_id}", mine=Export.scene_id == scene_id)
        named = named_blobs.of_scene(session, scene_id)
        session.execute(delete(Scene).where(Scene.id == scene_id))
        return named

    context.collector.add(caller.project_id, context.database.transact(remove))


@download_route(router, "/{scene_id}/files/{path:path}", summary="Download a file of a scene")
async def download_scene_file(
    scene_id: str, path: str, request: Request, caller: CallerDep, context: ContextDep
) -> Response:
    """One file of a scene. `Range` resumes a download; `ETag` and `Repr-Digest` are its SHA-256."""

    def find(session: Session) -> tuple[str, SceneFile, Blob]:
        scene = require(session, Scene, caller.project_id, scene_id)
        return scene.name, *find_file(
            session, SceneFile, SceneFile.scene_id == scene_id, path, owner=f"scene {scene_id}"
        )

    return await send_file(context, request, path, find)


def _shown(scene: Scene, files: list[SceneFileResource]) -> SceneResource:
    return SceneResource.model_validate(
        {
            "id": scene.id,
            "name": scene.name,
            "drive_id": scene.drive_id,
            "job_id": scene.job_id,
            "summary": scene.summary,
            "files": files,
            "created_at": moment(scene.created_us),
            "expires_at": moment(scene.expires_us),
        }
    )
