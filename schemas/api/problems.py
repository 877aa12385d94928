"""RFC 9457 problem details: how every error of the API looks, and how a failed job says why."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field
from pydantic.config import JsonDict

from schemas.api.resource import EXAMPLE_DRIVE, Finding

PROBLEM_TYPE = "urn:mrasfm:problem:"  # followed by the problem's code
MEDIA_TYPE = "application/problem+json"

_REJECTION: JsonDict = {
    "severity": "error",
    "code": "gnss-swapped",
    "what": "the GNSS track differs from the rough poses by 812.3 m, and by 0.9 m with latitude and longitude "
    "exchanged",
    "remedy": "Exchange latitude_deg and longitude_deg in gnss.samples.",
}


class ProblemItem(BaseModel):
    """One of several defects: a field of a document, or a file."""

    field: str = Field("", description="dotted path in the document, or the file's path; empty for the whole")
    detail: str = Field(description="what is wrong with it")


class Problem(BaseModel):
    """Problem details: the error and its remedy."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "type": "urn:mrasfm:problem:drive-incomplete",
                    "title": "The drive is not complete",
                    "status": 409,
                    "detail": "2 of 240 files have not been uploaded: front/000017.png, front/000018.png",
                    "remedy": "Upload them, then commit again.",
                    "errors": [{"field": "front/000017.png", "detail": "has not been uploaded"}],
                },
                {
                    "type": "urn:mrasfm:problem:drive-rejected",
                    "title": "The check of the drive found errors",
                    "status": 422,
                    "detail": f"drive {EXAMPLE_DRIVE}: {_REJECTION['what']}",
                    "remedy": _REJECTION["remedy"],
                    "findings": [_REJECTION],
                },
            ]
        }
    )

    type: str = Field(description="stable; 'urn:mrasfm:problem:' and a code in lower case with dashes")
    title: str = Field(description="the same for every problem of the type")
    status: Annotated[int, Field(ge=400, le=599)] | None = Field(None, description="of the HTTP answer; none in a job")
    detail: str = Field(description="one sentence that names the file, field or resource and what is wrong with it")
    remedy: str = Field(description="what to do")
    errors: list[ProblemItem] = Field(default_factory=list, description="all defects, where there are several")
    findings: list[Finding] = Field(default_factory=list, description="of the check of a drive")
    log_tail: str | None = Field(None, description="the last lines that a stage wrote before it ended")
    stage: str | None = Field(None, description="the stage that failed")
    retryable: bool | None = Field(None, description="whether trying again may help")
    job_id: str | None = Field(None, description="the job that failed")
