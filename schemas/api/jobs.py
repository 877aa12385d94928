"""Jobs: what is asked, how far it is, and what became of it."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from typing import Annotated, Any

from pydantic import ConfigDict, Field
from pydantic.config import JsonDict

from schemas.api.problems import Problem
from schemas.api.resource import EXAMPLE_DRIVE, EXAMPLE_JOB, Id, RequestBody, Resource, Times
from schemas.methods import ExtractorName, MatcherName
from schemas.patterns import Pattern

ModelName = Annotated[
    str,
    Pattern(
        "^[a-z0-9][a-z0-9._-]{0,63}$",
        words="1 to 64 lower-case letters (a-z), digits and _ . - without spaces, first a letter or digit",
    ),
]


class ReconstructionSettings(RequestBody):
    """Engine settings that a request may set; null leaves the engine's default."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"use_gnss": True}]})

    use_gnss: bool = Field(True, description="false ignores GNSS everywhere")
    max_keypoints: Annotated[int, Field(ge=128, le=16384)] | None = Field(None, description="at most, of an image")
    max_side_px: Annotated[int, Field(ge=320, le=8192)] | None = Field(
        None, description="pixels; larger images are extracted at reduced size"
    )
    refine_calibration: bool | None = Field(None, description="rig_from_cam, where the drive makes it observable")
    refine_focal: bool | None = Field(
        None,
        description="intrinsics, where the drive observes focal lengths; by default of a single camera, of cameras "
        "for which the manifest declares a sigma of any of them, and of all where lenses bend the scene",
    )
    seed: Annotated[int, Field(ge=0, le=2**31 - 1)] | None = Field(None, description="of all that is drawn at random")
    extractor: ExtractorName | None = Field(None, description="of keypoints; all but sift need a model on the workers")
    matcher: MatcherName | None = Field(
        None, description="all but nearest need a model on the workers, trained on the extractor's descriptors"
    )
    segmentation_model: ModelName | None = Field(
        None, description="name of a model on the workers that makes masks for images that come without"
    )
    semantic_triangulation: bool | None = Field(None, description="drop points of the road that are off its surface")
    submaps: Annotated[int, Field(ge=1, le=1000)] | None = Field(
        None, description="number of pieces that a long drive is cut into; null: as its length and the workers ask for"
    )
    motion_compensation: bool | None = Field(None, description="pose every image at its own time")


class ReconstructionRequest(RequestBody):
    """One drive to one scene."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"drive_id": EXAMPLE_DRIVE, "settings": {"use_gnss": True}}]}
    )

    drive_id: Id = Field(description="a committed drive")
    settings: ReconstructionSettings = ReconstructionSettings()


class JobKind(StrEnum):
    """Kind of a job."""

    PREFLIGHT = "PREFLIGHT"
    RECONSTRUCTION = "RECONSTRUCTION"
    AGGREGATION = "AGGREGATION"
    SUBMAP = "SUBMAP"
    EXPORT = "EXPORT"


class JobState(StrEnum):
    """State of a job. SUCCEEDED, FAILED and CANCELLED never change again."""

    QUEUED = "QUEUED"
    RUNNING = "RUNNING"
    STALLED = "STALLED"
    SUCCEEDED = "SUCCEEDED"
    FAILED = "FAILED"
    CANCELLED = "CANCELLED"


_PROGRESS: JsonDict = {
    "stage": "matches",
    "done": 410,
    "total": 1902,
    "unit": "pairs",
    "percent": 33.5,
    "eta_low_s": 120.0,
    "eta_high_s": 260.0,
    "reused_stages": ["features"],
}
_ATTEMPT: JsonDict = {
    "attempt": 1,
    "worker": "host:4711",
    "started_at": "2026-05-04T09:31:02Z",
    "finished_at": None,
    "outcome": None,
    "problem": None,
}


class JobProgress(Resource):
    """Progress of the current attempt."""

    model_config = ConfigDict(json_schema_extra={"examples": [_PROGRESS]})

    stage: str | None = Field(None, description="what is being done; null before the first")
    done: int | None = Field(None, description="of the stage")
    total: int | None = Field(None, description="of the stage")
    unit: str | None = Field(None, description="what done and total count")
    percent: float = Field(
        description="of the whole job, with the jobs that it waits for; never falls within an attempt",
        ge=0,
        le=100,
    )
    eta_low_s: float | None = Field(None, description="seconds to the end, likely at least")
    eta_high_s: float | None = Field(None, description="seconds to the end, likely at most")
    reused_stages: list[str] = Field(default_factory=list, description="finished before, not done again")


class JobAttempt(Resource):
    """One try at a job."""

    model_config = ConfigDict(json_schema_extra={"examples": [_ATTEMPT]})

    attempt: int = Field(description="1 for the first, rising; one that was released costs no retry")
    worker: str = Field(description="machine and process")
    started_at: datetime
    finished_at: datetime | None = Field(None, description="null while it runs")
    outcome: str | None = Field(
        None, description="succeeded, cancelled, released, planned (sub-maps go on), or the code of a problem"
    )
    problem: Problem | None = Field(None, description="why it failed")


class JobMember(Resource):
    """A drive that an aggregation brings into its map."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "name": "ring-road-2026-05-04",
                    "drive_id": EXAMPLE_DRIVE,
                    "job_id": EXAMPLE_JOB,
                    "state": "RUNNING",
                    "percent": 33.5,
                    "scene_id": None,
                    "problem": None,
                }
            ]
        }
    )

    name: str = Field(description="of the scene in the map")
    drive_id: str
    job_id: str | None = Field(None, description="the reconstruction that makes its scene; null: it was there")
    state: JobState | None = Field(None, description="of that job; null where its record is gone")
    percent: float = Field(description="of that job", ge=0, le=100)
    scene_id: str | None = Field(None, description="its scene, once it is there")
    problem: Problem | None = Field(None, description="why there will be none")


class JobSubmap(Resource):
    """A sub-map of a long drive, which a job of its own maps."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "number": 3,
                    "job_id": EXAMPLE_JOB,
                    "first_unit": 4100,
                    "last_unit": 6200,
                    "state": "RUNNING",
                    "percent": 33.5,
                    "problem": None,
                }
            ]
        }
    )

    number: int = Field(description="along the drive, from 1")
    job_id: str = Field(description="the job that maps it")
    first_unit: int = Field(description="index of its first frame in the manifest")
    last_unit: int = Field(description="index of its last frame in the manifest")
    state: JobState = Field(description="of that job")
    percent: float = Field(description="of that job", ge=0, le=100)
    problem: Problem | None = Field(None, description="why that job failed")


class JobResource(Times):
    """A job as the API shows it."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "id": EXAMPLE_JOB,
                    "kind": "RECONSTRUCTION",
                    "drive_id": EXAMPLE_DRIVE,
                    "state": "RUNNING",
                    "settings": {"use_gnss": True},
                    "progress": _PROGRESS,
                    "attempts": [_ATTEMPT],
                    "cancel_requested": False,
                    "heartbeat_at": "2026-05-04T09:33:40Z",
                    "problem": None,
                    "scene_id": None,
                    "map_id": None,
                    "map_version": None,
                    "export_id": None,
                    "members": [],
                    "parent_id": None,
                    "submap": None,
                    "submaps": [],
                    "retry_of": None,
                    "created_at": "2026-05-04T09:31:00Z",
                    "started_at": "2026-05-04T09:31:02Z",
                    "finished_at": None,
                    "expires_at": None,
                }
            ]
        }
    )

    id: str
    kind: JobKind = Field(
        description="PREFLIGHT is the check of a drive's images, which its commit starts; SUBMAP is a piece of a long "
        "drive, which its reconstruction starts; EXPORT writes a scene or map in formats of other programs"
    )
    drive_id: str | None = Field(
        None, description="null for an aggregation, which has members, and for the export of a map"
    )
    state: JobState = Field(
        description="STALLED is RUNNING without a recent heartbeat: another worker will take over. An aggregation is "
        "QUEUED, in stage 'reconstructions', while its drives are reconstructed, and the reconstruction of a long "
        "drive, in stage 'submaps', while its sub-maps are mapped"
    )
    settings: dict[str, Any] = Field(description="as asked")
    progress: JobProgress
    attempts: list[JobAttempt] = Field(description="oldest first")
    cancel_requested: bool = Field(description="a job that runs still has to stop")
    heartbeat_at: datetime | None = Field(None, description="when its worker was last heard of; null before the first")
    problem: Problem | None = Field(None, description="why it failed")
    scene_id: str | None = Field(None, description="what it made")
    map_id: str | None = Field(None, description="of which an aggregation makes a version")
    map_version: int | None = Field(None, description="the version that it made")
    export_id: str | None = Field(None, description="the export that an EXPORT job makes")
    members: list[JobMember] = Field(default_factory=list, description="what an aggregation brings into its map")
    parent_id: str | None = Field(None, description="the reconstruction that a sub-map is a piece of")
    submap: int | None = Field(None, description="number of a SUBMAP's sub-map along the drive, from 1")
    submaps: list[JobSubmap] = Field(
        default_factory=list, description="jobs that a reconstruction started for the sub-maps of its drive"
    )
    retry_of: str | None = Field(None, description="the job that this one repeats")
    started_at: datetime | None = Field(None, description="of the first attempt")
    finished_at: datetime | None = Field(None, description="when it succeeded, failed or was cancelled")
