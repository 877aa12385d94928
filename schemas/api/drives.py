"""Drives: from the manifest to the check of the images."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from typing import Annotated

from pydantic import ConfigDict, FailFast, Field
from pydantic.config import JsonDict

from schemas.api.resource import (
    EXAMPLE_DRIVE,
    EXAMPLE_SHA256,
    Finding,
    RequestBody,
    Resource,
    Sha256,
    Times,
    example_of,
)
from schemas.drive import RelativePath

MAX_DECLARED_FILES = 10_000


class DriveState(StrEnum):
    """A drive takes files until it is committed."""

    OPEN = "OPEN"
    COMMITTED = "COMMITTED"


class PreflightState(StrEnum):
    """State of the check of a drive."""

    NONE = "NONE"
    PENDING = "PENDING"
    PASSED = "PASSED"
    REJECTED = "REJECTED"
    UNKNOWN = "UNKNOWN"


_PREFLIGHT_STATES = (
    "NONE: not committed yet; PENDING: the images are being looked at; PASSED; REJECTED: see the findings; "
    "UNKNOWN: the check itself failed, its job says why"
)


class DriveResource(Times):
    """A drive as the API shows it."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "id": EXAMPLE_DRIVE,
                    "name": "ring-road-2026-05-04",
                    "vehicle": "van-7",
                    "state": "OPEN",
                    "cameras": 6,
                    "frames": 40,
                    "has_gnss": True,
                    "files_expected": 240,
                    "files_stored": 12,
                    "bytes_stored": 18874368,
                    "preflight": "NONE",
                    "preflight_errors": 0,
                    "preflight_warnings": 0,
                    "preflight_job_id": None,
                    "created_at": "2026-05-04T09:30:00Z",
                    "committed_at": None,
                    "expires_at": None,
                }
            ]
        }
    )

    id: str
    name: str = Field(description="as the manifest says")
    vehicle: str | None = Field(None, description="as the manifest says; null where it names none")
    state: DriveState = Field(description="OPEN takes files; COMMITTED is frozen and can be reconstructed")
    cameras: int = Field(description="of the rig")
    frames: int = Field(description="instants: all cameras at once")
    has_gnss: bool = Field(description="whether the manifest has positions of a receiver")
    files_expected: int = Field(description="files that the manifest names")
    files_stored: int = Field(description="of them, those whose bytes are here")
    bytes_stored: int = Field(description="of these files")
    preflight: PreflightState = Field(description=_PREFLIGHT_STATES)
    preflight_errors: int = Field(description="errors among the findings of the check, so far while it is PENDING")
    preflight_warnings: int = Field(description="warnings among these findings")
    preflight_job_id: str | None = Field(None, description="the job that checks the images; null before the commit")
    committed_at: datetime | None = Field(None, description="null while it is open")


_FILE: JsonDict = {"path": "front/000000.png", "size_bytes": 1048576, "sha256": EXAMPLE_SHA256}


class FileRole(StrEnum):
    """Role of a file in its drive."""

    IMAGE = "image"
    MASK = "mask"


class DriveFileResource(Resource):
    """A file that a drive's manifest names."""

    model_config = ConfigDict(json_schema_extra={"examples": [{**_FILE, "role": "image", "stored": True}]})

    path: str = Field(description="as the manifest names it")
    role: FileRole = Field(description="a camera's image, or the semantic mask of one")
    stored: bool = Field(description="whether its bytes are here")
    size_bytes: int | None = Field(None, description="null where it is not stored")
    sha256: Sha256 | None = Field(None, description="in hexadecimal; null where it is not stored")


class FileDeclaration(RequestBody):
    """A file that a client has."""

    model_config = ConfigDict(json_schema_extra={"examples": [_FILE]})

    path: RelativePath = Field(description="as the manifest names it")
    size_bytes: Annotated[int, Field(ge=0, le=2**50)]
    sha256: Sha256 = Field(description="in hexadecimal, lower case")


class DeclareFiles(RequestBody):
    """Files that a client has, to learn which of them it must send."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"files": [_FILE]}]})

    files: Annotated[list[FileDeclaration], Field(min_length=1, max_length=MAX_DECLARED_FILES), FailFast()] = Field(
        description="all that the manifest names, or some of them in each of several requests"
    )


class DeclaredFiles(Resource):
    """Files that are stored already, here or under another name, and files that must be sent."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"stored": ["front/000000.png"], "to_send": ["front/000001.png"]}]}
    )

    stored: list[str] = Field(description="paths whose bytes are there: nothing to send")
    to_send: list[str] = Field(description="paths to upload")


class StoredFiles(Resource):
    """Files of an archive that were stored."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"stored": 228, "files_stored": 240, "files_expected": 240}]}
    )

    stored: int = Field(description="files of the archive that are now in the drive")
    files_stored: int = Field(description="files that the drive now has")
    files_expected: int = Field(description="files that the manifest names")


class PreflightResource(Resource):
    """Findings of the check of the drive."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "state": "PASSED",
                    "job_id": "job_77aa0c2a9d3b7e4f5a6c8d9e0f1a2b",
                    "findings": [example_of(Finding)],
                }
            ]
        }
    )

    state: PreflightState = Field(description=_PREFLIGHT_STATES)
    job_id: str | None = Field(None, description="of the check of the images")
    findings: list[Finding] = Field(description="of the manifest, and of the images once they were looked at")
