"""Exports: scenes and maps in formats of other programs."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, ConfigDict, Field, WithJsonSchema
from pydantic.config import JsonDict
from pydantic_core import PydanticCustomError

from schemas.api.jobs import JobState
from schemas.api.problems import Problem
from schemas.api.resource import (
    EXAMPLE_EXPORT,
    EXAMPLE_JOB,
    EXAMPLE_SCENE,
    EXAMPLE_SHA256,
    ArtifactResource,
    RequestBody,
    Resource,
    Times,
)
from schemas.exports import EXPORT_FORMATS, MAX_COMPONENT, MAX_FORMATS, MAX_IMAGE_SIZE_PX, MIN_IMAGE_SIZE_PX
from schemas.patterns import Pattern


def _known(name: str) -> str:
    if name not in EXPORT_FORMATS:
        listed = ", ".join(f"'{known}'" for known in EXPORT_FORMATS)
        raise PydanticCustomError("literal_error", "Input should be one of {expected}", {"expected": listed})
    return name


FormatName = Annotated[str, AfterValidator(_known), WithJsonSchema({"type": "string", "enum": list(EXPORT_FORMATS)})]
Crs = Annotated[
    str,
    Pattern(
        r"^EPSG:[0-9]{4,6}(\+[0-9]{4,6})?$",
        words="EPSG: and 4 to 6 digits, as EPSG:25832, or with + and those of a height, as EPSG:25832+7837",
    ),
]


class ExportRequest(RequestBody):
    """Formats that a scene or a map's version is wanted in."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"formats": ["colmap"], "image_size_px": 1600}]})

    formats: Annotated[list[FormatName], Field(min_length=1, max_length=MAX_FORMATS)] = Field(
        description="; ".join(f"`{known.name}`: {known.description}" for known in EXPORT_FORMATS.values())
    )
    image_size_px: Annotated[int, Field(ge=MIN_IMAGE_SIZE_PX, le=MAX_IMAGE_SIZE_PX, strict=True)] | None = Field(
        None, description="longest side that images are scaled down to; null: they keep their resolution"
    )
    crs: Crs | None = Field(
        None, description="coordinate reference system of formats that take one; null: the format's own"
    )
    component: Annotated[int, Field(ge=1, le=MAX_COMPONENT, strict=True)] | None = Field(
        None,
        description="number of the scene's component that is wanted in its place, of those whose `folder` is "
        "`components/N`; null: the scene itself. A map has none",
    )


_FILE: JsonDict = {
    "path": "colmap/sparse/0/cameras.bin",
    "size_bytes": 392,
    "sha256": EXAMPLE_SHA256,
    "media_type": "application/octet-stream",
    "url": f"/v1/exports/{EXAMPLE_EXPORT}/files/colmap/sparse/0/cameras.bin",
}
_RESULT: JsonDict = {
    "format": "colmap",
    "files": 243,
    "size_bytes": 34511206,
    "withheld": None,
    "notes": ["66 points are left out: the pinhole images show them less than twice"],
}


class ExportFileResource(ArtifactResource):
    """One file of an export."""

    model_config = ConfigDict(json_schema_extra={"examples": [_FILE]})


class ExportResult(Resource):
    """A format of an export that has succeeded."""

    model_config = ConfigDict(json_schema_extra={"examples": [_RESULT]})

    format: str = Field(description="its name, and its folder among the files")
    files: int = Field(description="that it has", ge=0)
    size_bytes: int = Field(description="of all of them", ge=0)
    withheld: str | None = Field(None, description="which file did not read back, and why the format is not there")
    notes: list[str] = Field(default_factory=list, description="what the format lacks of the scene, and why")


class ExportResource(Times):
    """An export as the API shows it."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "id": EXAMPLE_EXPORT,
                    "scene_id": EXAMPLE_SCENE,
                    "map_id": None,
                    "map_version": None,
                    "formats": ["colmap"],
                    "image_size_px": 1600,
                    "crs": None,
                    "component": None,
                    "job_id": EXAMPLE_JOB,
                    "state": "SUCCEEDED",
                    "problem": None,
                    "results": [_RESULT],
                    "files": [_FILE],
                    "created_at": "2026-05-04T10:41:00Z",
                    "expires_at": None,
                }
            ]
        }
    )

    id: str
    scene_id: str | None = Field(None, description="of which it is; null for a map's")
    map_id: str | None = Field(None, description="of which it is; null for a scene's")
    map_version: int | None = Field(None, description="of the map")
    formats: list[str] = Field(description="as asked, each once, sorted")
    image_size_px: int | None = Field(None, description="as asked")
    crs: str | None = Field(None, description="as asked")
    component: int | None = Field(None, description="as asked")
    job_id: str = Field(description="the job that makes it; poll it, cancel it, retry it there")
    state: JobState = Field(description="of that job")
    problem: Problem | None = Field(None, description="why that job failed")
    results: list[ExportResult] = Field(description="by format, once it has succeeded")
    files: list[ExportFileResource] = Field(description="empty in lists: ask for the export itself")
