"""Scenes: what a reconstruction published."""

from __future__ import annotations

from pydantic import ConfigDict, Field
from pydantic.config import JsonDict

from schemas.api.resource import (
    EXAMPLE_DRIVE,
    EXAMPLE_JOB,
    EXAMPLE_SCENE,
    EXAMPLE_SHA256,
    ArtifactResource,
    Resource,
    Times,
)

_FILE: JsonDict = {
    "path": "points.ply",
    "size_bytes": 1387264,
    "sha256": EXAMPLE_SHA256,
    "media_type": "application/octet-stream",
    "url": f"/v1/scenes/{EXAMPLE_SCENE}/files/points.ply",
}
_SUMMARY: JsonDict = {
    "registered_units": 40,
    "units": 40,
    "registered_images": 240,
    "images": 240,
    "points": 51234,
    "georeferenced": True,
    "warnings": 0,
    "engine_version": "0.2.0",
}


class SceneFileResource(ArtifactResource):
    """One artifact of a scene."""

    model_config = ConfigDict(json_schema_extra={"examples": [_FILE]})


class SceneSummary(Resource):
    """The figures of a scene that a reader wants first; all are in its report."""

    model_config = ConfigDict(json_schema_extra={"examples": [_SUMMARY]})

    registered_units: int = Field(description="rigid units, one a frame, with a pose in the scene")
    units: int = Field(description="of the drive")
    registered_images: int = Field(description="images with a pose in the scene")
    images: int = Field(description="of the drive")
    points: int = Field(description="triangulated points of the scene")
    georeferenced: bool = Field(description="whether frame.json ties the scene to the earth")
    warnings: int = Field(description="findings of the drive's check")
    engine_version: str = Field(description="that made it")


class SceneResource(Times):
    """A scene as the API shows it."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "id": EXAMPLE_SCENE,
                    "name": "ring-road-2026-05-04",
                    "drive_id": EXAMPLE_DRIVE,
                    "job_id": EXAMPLE_JOB,
                    "summary": _SUMMARY,
                    "files": [_FILE],
                    "created_at": "2026-05-04T09:41:00Z",
                    "expires_at": None,
                }
            ]
        }
    )

    id: str
    name: str = Field(description="of its drive")
    drive_id: str = Field(description="of which it was made; the drive may be deleted since")
    job_id: str = Field(description="the reconstruction that made it")
    summary: SceneSummary
    files: list[SceneFileResource] = Field(description="empty in lists: ask for the scene itself")
