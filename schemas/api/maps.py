"""Maps: what aggregations publish, version by version."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from pydantic import ConfigDict, Field

from schemas.api.problems import Problem
from schemas.api.resource import RequestBody, Resource, Sha256, Times

_MAP = "map_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c"
_DRIVE = "drv_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c"
_JOB = "job_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c"
_SUMMARY: dict[str, Any] = {
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


class MapSummary(Resource):
    """The figures of a map's version that a reader wants first; all are in its report and `map.json`."""

    registered_units: int = Field(description="rigid units with a pose, of all scenes", examples=[80])
    units: int = Field(examples=[80])
    registered_images: int = Field(examples=[480])
    images: int = Field(examples=[480])
    points: int = Field(examples=[101234])
    georeferenced: bool = Field(description="whether frame.json ties the map to the earth", examples=[True])
    warnings: int = Field(description="findings of the report", examples=[0])
    engine_version: str = Field(examples=["0.2.0"])
    scenes: int = Field(description="that are in it, connected or not", examples=[2])
    connected: int = Field(description="of them, those that images tie to the map", examples=[2])
    seams: int = Field(description="accepted connections of two scenes; map.json has their quality", examples=[1])


class MapSceneResource(Resource):
    """A scene of a map's version."""

    name: str = Field(description="in map.json, seams and the report", examples=["ring-road-2026-05-04"])
    drive_id: str = Field(examples=[_DRIVE])
    scene_id: str = Field(examples=["scn_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c"])
    connected: bool = Field(description="false: placed by its GNSS alone, as it overlaps nothing", examples=[True])


class FailedDrive(Resource):
    """A drive that was asked for and is not in the map."""

    name: str = Field(examples=["ring-road-2026-05-05"])
    drive_id: str = Field(examples=["drv_77aa0c2a9d3b7e4f5a6c8d9e0f1a2b"])
    job_id: str | None = Field(None, description="the reconstruction that failed")
    problem: Problem = Field(description="why it has no scene")


class MapFileResource(Resource):
    """One artifact of a map's version."""

    path: str = Field(examples=["points.ply"])
    size_bytes: int = Field(examples=[1387264])
    sha256: Sha256 = Field(examples=["ab" * 32])
    media_type: str = Field(examples=["application/octet-stream"])
    url: str = Field(
        description="where to get it, relative to the server", examples=[f"/v1/maps/{_MAP}/versions/1/files/points.ply"]
    )


_VERSION: dict[str, Any] = {
    "map_id": _MAP,
    "number": 1,
    "is_current": True,
    "name": "crossing",
    "job_id": _JOB,
    "summary": _SUMMARY,
    "scenes": [
        {
            "name": "ring-road-2026-05-04",
            "drive_id": _DRIVE,
            "scene_id": "scn_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c",
            "connected": True,
        }
    ],
    "unconnected": [],
    "failed": [],
    "files": [],
    "created_at": "2026-05-04T10:41:00Z",
}


class MapVersionResource(Resource):
    """One version of a map: it never changes."""

    model_config = ConfigDict(json_schema_extra={"examples": [_VERSION]})

    map_id: str
    number: int = Field(description="1 for the first, rising", ge=1)
    is_current: bool = Field(description="whether the map shows this one")
    name: str = Field(description="of the map")
    job_id: str = Field(description="the aggregation that made it")
    summary: MapSummary
    scenes: list[MapSceneResource] = Field(description="by name")
    unconnected: list[str] = Field(description="names of scenes that overlap no other: placed by GNSS alone")
    failed: list[FailedDrive] = Field(description="drives that were asked for and could not be reconstructed")
    files: list[MapFileResource] = Field(description="empty in lists: ask for the version itself")
    created_at: datetime


class MapResource(Times):
    """A map as the API shows it."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "id": _MAP,
                    "name": "crossing",
                    "current_version": 1,
                    "version": _VERSION,
                    "job_id": None,
                    "created_at": "2026-05-04T10:31:00Z",
                    "expires_at": None,
                }
            ]
        }
    )

    id: str
    name: str
    current_version: int | None = Field(description="null: none has been published yet")
    version: MapVersionResource | None = Field(None, description="the current one, without its files")
    job_id: str | None = Field(None, description="the aggregation under way that will make the next version")


class CurrentVersion(RequestBody):
    """Which version a map shall show."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"version": 1}]})

    version: int = Field(ge=1, le=2**31 - 1, description="one that is there", examples=[1])
