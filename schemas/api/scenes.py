"""Scenes: what a reconstruction published."""

from __future__ import annotations

from pydantic import ConfigDict, Field

from schemas.api.resource import Resource, Sha256, Times


class SceneFileResource(Resource):
    """One artifact of a scene."""

    path: str = Field(examples=["points.ply"])
    size_bytes: int
    sha256: Sha256
    media_type: str = Field(examples=["application/octet-stream"])
    url: str = Field(
        description="where to get it, relative to the server", examples=["/v1/scenes/scn_1f/files/points.ply"]
    )


class SceneSummary(Resource):
    """The figures of a scene that a reader wants first; all are in its report."""

    registered_units: int
    units: int
    registered_images: int
    images: int
    points: int
    georeferenced: bool = Field(description="whether frame.json ties the scene to the earth")
    warnings: int = Field(description="findings of the drive's check")
    engine_version: str


class SceneResource(Times):
    """A scene as the API shows it."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "id": "scn_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c",
                    "name": "ring-road-2026-05-04",
                    "drive_id": "drv_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c",
                    "job_id": "job_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c",
                    "summary": {
                        "registered_units": 40,
                        "units": 40,
                        "registered_images": 240,
                        "images": 240,
                        "points": 51234,
                        "georeferenced": True,
                        "warnings": 0,
                        "engine_version": "0.2.0",
                    },
                    "files": [
                        {
                            "path": "points.ply",
                            "size_bytes": 1387264,
                            "sha256": "ab" * 32,
                            "media_type": "application/octet-stream",
                            "url": "/v1/scenes/scn_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c/files/points.ply",
                        }
                    ],
                    "created_at": "2026-05-04T09:41:00Z",
                    "expires_at": None,
                }
            ]
        }
    )

    id: str
    name: str = Field(description="of its drive")
    drive_id: str
    job_id: str
    summary: SceneSummary
    files: list[SceneFileResource] = Field(description="empty in lists: ask for the scene itself")
