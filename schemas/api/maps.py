"""Maps: what aggregations publish, version by version."""

from __future__ import annotations

from datetime import datetime

from pydantic import ConfigDict, Field
from pydantic.config import JsonDict

from schemas.api.problems import Problem
from schemas.api.resource import (
    EXAMPLE_DRIVE,
    EXAMPLE_JOB,
    EXAMPLE_MAP,
    EXAMPLE_OTHER_DRIVE,
    EXAMPLE_SCENE,
    EXAMPLE_SHA256,
    ArtifactResource,
    RequestBody,
    Resource,
    Times,
)

_SUMMARY: JsonDict = {
    "registered_units": 80,
    "units": 80,
    "registered_images": 480,
    "images": 480,
    "points": 101234,
    "georeferenced": True,
    "warnings": 0,
    "engine_version": "0.2.0",
    "scenes": 2,
    "connected": 2,
    "seams": 1,
}
_SCENE: JsonDict = {
    "name": "ring-road-2026-05-04",
    "drive_id": EXAMPLE_DRIVE,
    "scene_id": EXAMPLE_SCENE,
    "connected": True,
}
_OTHER_SCENE: JsonDict = {
    "name": "ring-road-2026-05-05",
    "drive_id": EXAMPLE_OTHER_DRIVE,
    "scene_id": "scn_77aa0c2a9d3b7e4f5a6c8d9e0f1a2b",
    "connected": True,
}
_FILE: JsonDict = {
    "path": "points.ply",
    "size_bytes": 2740993,
    "sha256": EXAMPLE_SHA256,
    "media_type": "application/octet-stream",
    "url": f"/v1/maps/{EXAMPLE_MAP}/versions/1/files/points.ply",
}


class MapSummary(Resource):
    """The figures of a map's version that a reader wants first; all are in its report and `map.json`."""

    model_config = ConfigDict(json_schema_extra={"examples": [_SUMMARY]})

    registered_units: int = Field(description="rigid units, one a frame, with a pose, of all scenes")
    units: int = Field(description="of all drives")
    registered_images: int = Field(description="images with a pose, of all scenes")
    images: int = Field(description="of all drives")
    points: int = Field(description="triangulated points of the map")
    georeferenced: bool = Field(description="whether frame.json ties the map to the earth")
    warnings: int = Field(description="findings of the report")
    engine_version: str = Field(description="that made it")
    scenes: int = Field(description="that are in it, connected or not")
    connected: int = Field(description="of them, those that images tie to the map")
    seams: int = Field(description="accepted connections of two scenes; map.json has their quality")


class MapSceneResource(Resource):
    """A scene of a map's version."""

    model_config = ConfigDict(json_schema_extra={"examples": [_SCENE]})

    name: str = Field(description="in map.json, seams and the report; NAME#N is component N of the scene NAME")
    drive_id: str
    scene_id: str
    connected: bool = Field(description="false: placed by its GNSS alone, as it overlaps nothing")


class FailedDrive(Resource):
    """A drive that was asked for and is not in the map, or a component of one."""

    name: str = Field(description="of the drive in the map; NAME#N is its component N")
    drive_id: str
    job_id: str | None = Field(None, description="the reconstruction that failed")
    problem: Problem = Field(description="why it has no scene")


class MapFileResource(ArtifactResource):
    """One artifact of a map's version."""

    model_config = ConfigDict(json_schema_extra={"examples": [_FILE]})


_VERSION: JsonDict = {
    "map_id": EXAMPLE_MAP,
    "number": 1,
    "is_current": True,
    "name": "crossing",
    "job_id": EXAMPLE_JOB,
    "summary": _SUMMARY,
    "scenes": [_SCENE, _OTHER_SCENE],
    "unconnected": [],
    "failed": [],
    "files": [_FILE],
    "created_at": "2026-05-04T10:41:00Z",
}


class MapVersionResource(Resource):
    """One version of a map: it never changes."""

    model_config = ConfigDict(json_schema_extra={"examples": [_VERSION]})

    map_id: str = Field(description="whose version it is")
    number: int = Field(description="1 for the first, rising", ge=1)
    is_current: bool = Field(description="whether the map shows this one")
    name: str = Field(description="of the map")
    job_id: str = Field(description="the aggregation that made it")
    summary: MapSummary
    scenes: list[MapSceneResource] = Field(description="by name")
    unconnected: list[str] = Field(description="names of scenes that overlap no other: placed by GNSS alone")
    failed: list[FailedDrive] = Field(description="drives, or components, that are not in it and why")
    files: list[MapFileResource] = Field(description="empty in lists: ask for the version itself")
    created_at: datetime


class MapResource(Times):
    """A map as the API shows it."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "id": EXAMPLE_MAP,
                    "name": "crossing",
                    "current_version": 1,
                    "version": {**_VERSION, "files": []},
                    "job_id": None,
                    "created_at": "2026-05-04T10:31:00Z",
                    "expires_at": None,
                }
            ]
        }
    )

    id: str
    name: str = Field(description="as the aggregation that began it said")
    current_version: int | None = Field(description="null: none has been published yet")
    version: MapVersionResource | None = Field(None, description="the current one, without its files")
    job_id: str | None = Field(None, description="the aggregation under way that will make the next version")


class CurrentVersion(RequestBody):
    """Version that a map shows."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"version": 1}]})

    version: int = Field(ge=1, le=2**31 - 1, description="one that is there")
