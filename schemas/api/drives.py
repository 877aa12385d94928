"""Drives: from the manifest to the check of the images."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from typing import Annotated, Any

from pydantic import ConfigDict, FailFast, Field

from schemas.api.resource import Finding, RequestBody, Resource, Sha256, Times
from schemas.drive import RelativePath

MAX_DECLARED_FILES = 10_000

EXAMPLE_MANIFEST: dict[str, Any] = {
    "version": 1,
    "name": "ring-road-2026-05-04",
    "rig": {
        "cameras": [
            {
                "name": "front",
                "model": "PINHOLE",
                "width": 1280,
                "height": 720,
                "params": [910.0, 910.0, 640.0, 360.0],
                "rig_from_cam": {"rotation_xyzw": [-0.5, 0.5, -0.5, 0.5], "translation_m": [1.6, 0.0, 1.4]},
            }
        ]
    },
    "frames": [
        {"timestamp_us": 1777887000000000, "source_frame": 0, "images": {"front": {"file": "front/000000.png"}}},
        {"timestamp_us": 1777887000100000, "source_frame": 1, "images": {"front": {"file": "front/000001.png"}}},
    ],
}


class DriveState(StrEnum):
    """A drive takes files until it is committed."""

    OPEN = "OPEN"
    COMMITTED = "COMMITTED"


class PreflightState(StrEnum):
    """What is known of a drive's soundness."""

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
                    "id": "drv_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c",
                    "name": "ring-road-2026-05-04",
                    "state": "OPEN",
                    "cameras": 6,
                    "frames": 40,
                    "has_gnss": True,
                    "files_expected": 240,
                    "files_stored": 12,
                    "bytes_stored": 18874368,
                    "preflight": "NONE",
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
    state: DriveState = Field(description="OPEN takes files; COMMITTED is frozen and can be reconstructed")
    cameras: int
    frames: int
    has_gnss: bool
    files_expected: int = Field(description="files that the manifest names")
    files_stored: int
    bytes_stored: int
    preflight: PreflightState = Field(description=_PREFLIGHT_STATES)
    preflight_job_id: str | None = None
    committed_at: datetime | None = None


class FileRole(StrEnum):
    """What a file is in its drive."""

    IMAGE = "image"
    MASK = "mask"


class DriveFileResource(Resource):
    """A file that a drive's manifest names."""

    path: str
    role: FileRole
    stored: bool
    size_bytes: int | None = None
    sha256: Sha256 | None = None


class FileDeclaration(RequestBody):
    """A file that a client has."""

    path: RelativePath
    size_bytes: Annotated[int, Field(ge=0, le=2**50)]
    sha256: Sha256


class DeclareFiles(RequestBody):
    """What a client has, to learn what it must send."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"files": [{"path": "front/000000.png", "size_bytes": 1048576, "sha256": "ab" * 32}]}]
        }
    )

    files: Annotated[list[FileDeclaration], Field(min_length=1, max_length=MAX_DECLARED_FILES), FailFast()]


class DeclaredFiles(Resource):
    """What is stored already, here or under another name, and what must be sent."""

    stored: list[str] = Field(description="paths whose bytes are there: nothing to send")
    to_send: list[str] = Field(description="paths to upload")


class StoredFiles(Resource):
    """What an archive brought."""

    stored: int = Field(description="files of the archive that are now in the drive")
    files_stored: int = Field(description="files that the drive now has")
    files_expected: int


class PreflightResource(Resource):
    """What the check of a drive found."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "state": "PASSED",
                    "job_id": "job_77aa0c2a9d3b7e4f5a6c8d9e0f1a2b",
                    "findings": [
                        {
                            "severity": "warning",
                            "code": "gnss-gap",
                            "what": "GNSS has no sample for 12.4 s from 103.200 s",
                            "remedy": "Check the receiver; poses there rest on images alone.",
                        }
                    ],
                }
            ]
        }
    )

    state: PreflightState = Field(description=_PREFLIGHT_STATES)
    job_id: str | None = Field(None, description="of the check of the images")
    findings: list[Finding]
