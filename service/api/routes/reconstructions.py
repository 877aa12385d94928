"""Reconstructions: one drive to one scene, as a job."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Response
from sqlalchemy.orm import Session

from schemas.api.drives import DriveState
from schemas.api.jobs import JobKind, JobResource, ReconstructionRequest
from service.api.dependencies import CallerDep, ContextDep, IdempotentDep, expiry_us
from service.api.http.body_reading import json_body
from service.api.http.request_bodies import Body, describe
from service.api.http.responses import problems
from service.api.routes.aggregations import ACCEPTED, accepted
from service.database.tables import now_us
from service.domain import drives, jobs
from service.domain.idempotency import Answer
from service.errors import DriveNotCommitted

router = APIRouter(prefix="/v1/reconstructions", tags=["reconstructions"])

read_request = json_body(ReconstructionRequest, lambda settings: settings.max_json_bytes)


@router.post(
    "",
    status_code=202,
    response_model=JobResource,
    summary="Ask for a reconstruction",
    responses={**ACCEPTED, **problems(401, 404, 408, 409, 413, 422, 429)},
    openapi_extra=describe(ReconstructionRequest),
)
def create_reconstruction(
    once: IdempotentDep,
    caller: CallerDep,
    context: ContextDep,
    body: Annotated[Body[ReconstructionRequest], Depends(read_request, scope="function")],
) -> Response:
    """Ask for a committed drive's reconstruction.

    Once this answers 202 the job is recorded and will run, also where broker or workers are down at the moment. While
    the drive's images are still being checked it is accepted, and fails with the findings if there are errors.
    """
    request = body.value

    def effect(session: Session) -> Answer:
        drive = drives.get(session, caller.project_id, request.drive_id, lock=True)
        if drive.state == DriveState.OPEN:
            raise DriveNotCommitted(
                f"drive {drive.id} still takes files",
                remedy=f"Upload what is missing, then POST /v1/drives/{drive.id}:commit.",
            )
        jobs.require_not_rejected(drive)
        job = jobs.create(
            session,
            project_id=caller.project_id,
            kind=JobKind.RECONSTRUCTION,
            drive_id=drive.id,
            settings=request.settings.model_dump(mode="json", exclude_none=True),
            expires_us=expiry_us(now_us(), context.settings.job_retention_days),
        )
        return accepted(session, context, job, [job])

    return once(effect, body.raw)
