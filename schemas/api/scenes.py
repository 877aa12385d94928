"""Scenes: what a reconstruction published."""

from __future__ import annotations

from pydantic import ConfigDict, Field
from pydantic.config import JsonDict, JsonValue

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
_COMPONENTS: list[JsonValue] = [
    {
        "component": 0,
        "folder": ".",
        "georeferenced": True,
        "registered_units": 27,
        "registered_images": 162,
        "points": 38120,
    },
    {
        "component": 1,
        "folder": "components/1",
        "georeferenced": False,
        "registered_units": 9,
        "registered_images": 54,
        "points": 13114,
    },
]
_SUMMARY: JsonDict = {
    "registered_units": 27,
    "units": 40,
    "registered_images": 162,
    "images": 240,
    "points": 38120,
    "georeferenced": True,
    "warnings": 0,
    "engine_version": "0.2.0",
    "components": _COMPONENTS,
}


class SceneFileResource(ArtifactResource):
    """One artifact of a scene."""

    model_config = ConfigDict(json_schema_extra={"examples": [_FILE]})


class SceneComponent(Resource):
    """A part of the drive that no image links to the others."""

    model_config = ConfigDict(json_schema_extra={"examples": _COMPONENTS[:1]})

    component: int = Field(description="its number in points.ply, poses.json and report.json; 0 is the largest", ge=0)
    folder: str = Field(
        description="of its files, among `files`: `.` for those of the scene itself, which several components share "
        "that positions put into one frame"
    )
    georeferenced: bool = Field(description="whether the frame.json of its folder ties it to the earth")
    registered_units: int = Field(description="rigid units with a pose in it")
    registered_images: int = Field(description="images with a pose in it")
    points: int = Field(description="that its units observe")


class SceneSummary(Resource):
    """The figures of a scene that a reader wants first; all are in its report."""

    model_config = ConfigDict(json_schema_extra={"examples": [_SUMMARY]})

    registered_units: int = Field(description="rigid units, one a frame, with a pose in the scene's own folder")
    units: int = Field(description="of the drive")
    registered_images: int = Field(description="images with a pose in the scene")
    images: int = Field(description="of the drive")
    points: int = Field(description="triangulated points of the scene")
    georeferenced: bool = Field(description="whether frame.json ties the scene to the earth")
    warnings: int = Field(description="findings of the drive's check")
    engine_version: str = Field(description="that made it")
    components: list[SceneComponent] = Field(
        default=[], description="by number; one where images link the whole drive, none where an older version made it"
    )


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
