"""Scenes: list, show, delete, download."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, BackgroundTasks, Query, Request, Response
from sqlalchemy import delete, select, tuple_
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from schemas.api.resource import Page
from schemas.api.scenes import SceneFileResource, SceneResource
from service.api.context import Context
from service.api.dependencies import CallerDep, ContextDep, Cursor, Limit, moment
from service.api.http.paging import cursor_of, position_of
from service.api.http.responses import gives, problems
from service.api.routes.downloads import (
    DOWNLOAD_PARAMETERS,
    DOWNLOADS,
    HEAD_PARAMETERS,
    HEADS,
    download_name,
    send_file,
)
from service.database.tables import Blob, Scene, SceneFile
from service.domain.access import require
from service.domain.maps import require_unused
from service.errors import not_found
from service.storage.garbage_collection import collect_unused

router = APIRouter(prefix="/v1/scenes", tags=["scenes"])


@router.get("", summary="List scenes", responses={**gives(200, "A page of scenes"), **problems(401, 422)})
def list_scenes(
    caller: CallerDep,
    context: ContextDep,
    limit: Limit = 50,
    cursor: Cursor = None,
    drive_id: Annotated[str | None, Query(pattern="^[a-z0-9_]{1,40}$", description="only of this drive")] = None,
) -> Page[SceneResource]:
    """Scenes of the project, newest first, without their files."""
    statement = select(Scene).where(Scene.project_id == caller.project_id)
    if drive_id is not None:
        statement = statement.where(Scene.drive_id == drive_id)
    after = position_of(cursor, int, str)
    if after is not None:
        statement = statement.where(tuple_(Scene.created_us, Scene.id) < after)
    with context.database.read() as session:
        found = session.scalars(statement.order_by(Scene.created_us.desc(), Scene.id.desc()).limit(limit)).all()
    last = found[-1] if len(found) == limit else None
    return Page(
        items=[_shown(scene, []) for scene in found],
        next=None if last is None else cursor_of(last.created_us, last.id),
    )


@router.get("/{scene_id}", summary="Show a scene", responses={**gives(200, "The scene"), **problems(401, 404)})
def get_scene(scene_id: str, caller: CallerDep, context: ContextDep) -> SceneResource:
    """One scene and its files."""
    with context.database.read() as session:
        scene = require(session, Scene, caller.project_id, scene_id)
        statement = select(SceneFile, Blob).join(Blob, SceneFile.blob_id == Blob.id)
        rows = session.execute(statement.where(SceneFile.scene_id == scene_id).order_by(SceneFile.path)).all()
    return _shown(scene, [_shown_file(file, blob) for file, blob in rows])


@router.delete(
    "/{scene_id}",
    status_code=204,
    summary="Delete a scene",
    responses={**gives(204, "Deleted"), **problems(401, 404, 409)},
)
def delete_scene(scene_id: str, caller: CallerDep, context: ContextDep, background: BackgroundTasks) -> None:
    """Delete a scene and its files. Its drive stays; what a map is made of cannot be deleted."""
    with context.database.write() as session:
        require(session, Scene, caller.project_id, scene_id, lock=True)
        require_unused(session, what=f"scene {scene_id}", scene_id=scene_id)
        session.execute(delete(Scene).where(Scene.id == scene_id))
    background.add_task(collect_unused, context.database, context.artifacts, project_id=caller.project_id)


@router.head(
    "/{scene_id}/files/{path:path}",
    response_class=Response,
    name="head_scene_file",
    summary="Show a download's headers",
    responses={**HEADS, **problems(401, 404)},
    openapi_extra=HEAD_PARAMETERS,
)
@router.get(
    "/{scene_id}/files/{path:path}",
    response_class=Response,
    summary="Download a file of a scene",
    responses={**DOWNLOADS, **problems(401, 404, 416)},
    openapi_extra=DOWNLOAD_PARAMETERS,
)
async def download_scene_file(
    scene_id: str, path: str, request: Request, caller: CallerDep, context: ContextDep
) -> Response:
    """One file of a scene. `Range` resumes a download; `ETag` and `Repr-Digest` are its SHA-256."""
    scene, file, blob = await run_in_threadpool(_look_up, context, caller.project_id, scene_id, path)
    name = download_name(scene.name, path)
    return await send_file(context, request, blob, media_type=file.media_type, name=name)


def _look_up(context: Context, project_id: str, scene_id: str, path: str) -> tuple[Scene, SceneFile, Blob]:
    with context.database.read() as session:
        scene = require(session, Scene, project_id, scene_id)
        return scene, *_get_file(session, scene, path)


def _get_file(session: Session, scene: Scene, path: str) -> tuple[SceneFile, Blob]:
    statement = select(SceneFile, Blob).join(Blob, SceneFile.blob_id == Blob.id).where(SceneFile.scene_id == scene.id)
    found = session.execute(statement.where(SceneFile.path == path)).first() if path.isprintable() else None
    if found is None:
        raise not_found(f"file in scene {scene.id} named", path)
    return found[0], found[1]


def _shown_file(file: SceneFile, blob: Blob) -> SceneFileResource:
    return SceneFileResource(
        path=file.path,
        size_bytes=blob.size_bytes,
        sha256=blob.sha256,
        media_type=file.media_type,
        url=f"/v1/scenes/{file.scene_id}/files/{file.path}",
    )


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
