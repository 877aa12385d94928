"""Inputs of an aggregation: files of scenes, and of the version that it goes on from."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from schemas.artifacts import (
    COMPONENTS_FOLDER,
    REPORT_FILE,
    component_scene,
    drive_of_scene,
    is_read_by_aggregation,
    is_read_by_next_version,
)
from service.database.tables import Blob, Job, Map, MapFile, SceneFile
from service.domain import jobs, maps


@dataclass(frozen=True)
class StoredArtifact:
    """A file of a scene or map and where its bytes are."""

    path: str
    key: str


@dataclass(frozen=True, kw_only=True)
class MapInputs:
    """Inputs of one aggregation.

    Attributes
    ----------
    name
        The map's.
    scenes
        Files of the scenes that come, by name.
    base
        Files of the version that they are added to; empty for a new map.
    remove
        Names of scenes that are taken out.
    scene_ids
        Ids of all scenes of the new version and of their components, by name: of component N the scene's with #N.
    failed
        Drives that have no scene, as the report names them.
    members
        What it calls those that have one, by name, and the scenes that stay.
    require_all
        Whether a scene that fits into no map takes the others with it.
    """

    name: str
    scenes: Mapping[str, Sequence[StoredArtifact]]
    base: Sequence[StoredArtifact]
    remove: Sequence[str]
    scene_ids: Mapping[str, str]
    failed: Sequence[Mapping[str, Any]]
    members: Mapping[str, Mapping[str, Any]]
    require_all: bool


def inputs_of(session: Session, job_id: str) -> MapInputs:
    """The inputs of an aggregation whose children have ended."""
    job = session.get_one(Job, job_id)
    members = [member for member, _ in jobs.members_of(session, [job_id]).get(job_id, [])]
    coming = {member.name: member.scene_id for member in members if member.scene_id is not None}
    kept = maps.kept_scenes(session, job)
    request = job.request or {}
    files = {name: _files_of_scene(session, scene_id) for name, scene_id in coming.items()}
    return MapInputs(
        name=session.get_one(Map, job.map_id).name,
        scenes=files,
        base=_files_of_version(session, job.map_id, request.get("base_version")),
        remove=list(request.get("remove", ())),
        scene_ids={
            **{scene.name: scene.scene_id + scene.name.removeprefix(drive_of_scene(scene.name)) for scene in kept},
            **coming,
            **{
                component_scene(name, number): component_scene(scene_id, number)
                for name, scene_id in coming.items()
                for number in _components_in(files[name])
            },
        },
        failed=[{**maps.named(member), "problem": member.problem} for member in members if member.problem is not None],
        members={
            **{scene.name: {"name": scene.name, "drive_id": scene.drive_id, "job_id": None} for scene in kept},
            **{member.name: maps.named(member) for member in members if member.scene_id is not None},
        },
        require_all=bool(request.get("require_all")),
    )


def _files_of_scene(session: Session, scene_id: str) -> list[StoredArtifact]:
    statement = select(SceneFile.path, Blob.key).join(Blob, SceneFile.blob_id == Blob.id)
    rows = session.execute(statement.where(SceneFile.scene_id == scene_id).order_by(SceneFile.path))
    return [StoredArtifact(*row) for row in rows if is_read_by_aggregation(row.path)]


def _components_in(files: Sequence[StoredArtifact]) -> list[int]:
    """Numbers of the components that a scene has in folders of their own."""
    found = (re.fullmatch(rf"{COMPONENTS_FOLDER}/(\d+)/{re.escape(REPORT_FILE)}", file.path) for file in files)
    return [int(match[1]) for match in found if match is not None]


def _files_of_version(session: Session, map_id: str | None, number: int | None) -> list[StoredArtifact]:
    statement = select(MapFile.path, Blob.key).join(Blob, MapFile.blob_id == Blob.id)
    mine = (MapFile.map_id == map_id) & (MapFile.number == (number or 0))
    rows = session.execute(statement.where(mine).order_by(MapFile.path))
    return [StoredArtifact(*row) for row in rows if is_read_by_next_version(row.path)]
