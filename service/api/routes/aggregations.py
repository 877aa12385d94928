"""Aggregations: drives or scenes to a map, as a tree of jobs."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Response
from sqlalchemy.orm import Session

from schemas.api.aggregations import AggregationRequest
from schemas.api.jobs import JobResource
from service.api.context import Context
from service.api.dependencies import CallerDep, ContextDep, IdempotentDep, answer, expiry_us
from service.api.http.body_reading import json_body
from service.api.http.request_bodies import Body, describe
from service.api.http.responses import gives, problems
from service.api.routes.job_views import RETRY_AFTER_S, view_of
from service.database.tables import Job, now_us
from service.domain import aggregations
from service.domain.idempotency import Answer

router = APIRouter(prefix="/v1/aggregations", tags=["maps"])

read_request = json_body(AggregationRequest, lambda settings: settings.max_json_bytes)
ACCEPTED = gives(202, "The job is recorded and will run", "Location", "Retry-After")


@router.post(
    "",
    status_code=202,
    response_model=JobResource,
    summary="Ask for a map",
    responses={**ACCEPTED, **problems(401, 404, 408, 409, 413, 422, 429)},
    openapi_extra=describe(AggregationRequest),
)
def create_aggregation(
    once: IdempotentDep,
    caller: CallerDep,
    context: ContextDep,
    body: Annotated[Body[AggregationRequest], Depends(read_request, scope="function")],
) -> Response:
    """Ask for a map of drives or scenes, or for a new version of one.

    What is not reconstructed yet with these settings is reconstructed first, in parallel over all workers; the job's
    `members` say how far each is. A drive that fails does not take the others with it, unless `require_all` is set.
    The job's `map_id` is the map's from now on, and `map_version` tells what came of it.
    """

    def effect(session: Session) -> Answer:
        job, due = aggregations.create(
            session,
            project_id=caller.project_id,
            asked=body.value,
            job_expires_us=expiry_us(now_us(), context.settings.job_retention_days),
        )
        return accepted(session, context, job, due)

    return once(effect, body.raw)


def accepted(session: Session, context: Context, job: Job, due: list[Job]) -> Answer:
    """202 for a job, and which jobs may begin now."""
    return answer(
        202,
        view_of(session, job, context.settings),
        waiting=tuple(due),
        Location=f"/v1/jobs/{job.id}",
        Retry_After=str(RETRY_AFTER_S),
    )
