"""RFC 9457 problem details: how every error of the API looks, and how a failed job says why."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

PROBLEM_TYPE = "urn:mrasfm:problem:"  # followed by the problem's code
MEDIA_TYPE = "application/problem+json"


class ProblemItem(BaseModel):
    """One of several defects: a field of a document, or a file."""

    field: str = Field("", description="dotted path in the document, or the file's path; empty for the whole")
    detail: str


class Problem(BaseModel):
    """What went wrong and what to do."""

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
                }
            ]
        }
    )

    type: str = Field(description="stable; 'urn:mrasfm:problem:' and a code in lower case with dashes")
    title: str
    status: Annotated[int, Field(ge=400, le=599)] | None = Field(None, description="of the HTTP answer; none in a job")
    detail: str
    remedy: str = Field(description="what to do")
    errors: list[ProblemItem] = Field(default_factory=list, description="all defects, where there are several")
    findings: list[dict[str, Any]] = Field(default_factory=list, description="of the check of a drive")
    log_tail: str | None = Field(None, description="the last lines that a stage wrote before it ended")
    stage: str | None = Field(None, description="the stage that failed")
    retryable: bool | None = Field(None, description="whether trying again may help")
    job_id: str | None = None
