"""Liveness, readiness and status of the service, for load balancers, monitoring and people."""

from __future__ import annotations

import secrets
from importlib.metadata import version

from fastapi import APIRouter, Depends, Request, Response
from fastapi.security import HTTPBearer
from pydantic import SecretStr
from sqlalchemy import func, select
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from schemas.api.status import DiskStatus, Health, QueueStatus, Ready, ServiceStatus, WorkerStatus
from service.api.context import Context
from service.api.dependencies import CallerDep, ContextDep, moment
from service.api.http.responses import gives, problems
from service.api.metrics import CONTENT_TYPE, Metrics, disk_of_uploads
from service.api.readiness import Readiness
from service.database.connections import clock_us
from service.database.tables import Job, JobState, WorkerSeen
from service.domain import jobs, passes
from service.domain.workers import ONLINE_US
from service.errors import Unauthorized
from service.job_queue import QUEUES, BrokerError

router = APIRouter(tags=["operation"])

_ALIVE = {"application/json": {"example": {"status": "alive"}}}


@router.get("/livez", summary="Is it alive?", responses=gives(200, "It is", content=_ALIVE))
async def get_liveness() -> Ready:
    """The process answers."""
    return Ready(status="alive")


@router.get("/readyz", summary="Is it ready?", responses={**gives(200, "It is"), **problems(503)})
async def get_readiness(request: Request) -> Ready:
    """Database and artifact store can be written. A broker that is down does not matter here: uploads go on."""
    readiness: Readiness = request.app.state.readiness
    await readiness.require()
    return Ready(status="ready")


@router.get("/v1/status", summary="How is it?", responses={**gives(200, "Also where it is degraded"), **problems(401)})
def get_status(caller: CallerDep, context: ContextDep) -> ServiceStatus:
    """Status of every part of the service, and its consequence for clients."""
    broker, reasons = True, []
    try:
        context.job_queue.require_broker()
    except BrokerError:
        broker = False
        reasons.append("the broker does not answer: jobs are accepted and start when it is back")
    with context.database.read() as session:
        workers, queue = _workers(session), _queue(session, context)
        reconciler = passes.are_made(session, every_s=context.settings.reconcile_seconds)
    if not reconciler:
        reasons.append(
            "no reconciler looks after the jobs: those whose worker died stay with it, those whose message was lost "
            "wait, and nothing is sent to webhooks or deleted"
        )
    served = {name for worker in workers if worker.online for name in worker.queues}
    for name in dict.fromkeys(QUEUES.values()):
        if name not in served:
            kinds = " and ".join(kind for kind, queue in QUEUES.items() if queue == name)
            reasons.append(f"no worker serves the queue {name!r}: jobs of kind {kinds} are accepted and wait")
    disk = _disk(context)
    if not disk.accepts_uploads:
        reasons.append("the disk is full: uploads are refused with 507")
    return ServiceStatus(
        status=Health.DEGRADED if reasons else Health.OK,
        reasons=reasons,
        version=version("mrasfm"),
        broker=broker,
        reconciler=reconciler,
        workers=workers,
        queue=queue,
        disk=disk,
    )


def _workers(session: Session) -> list[WorkerStatus]:
    now = clock_us(session)
    rows = session.scalars(
        select(WorkerSeen).where(WorkerSeen.seen_us > now - 86_400_000_000).order_by(WorkerSeen.name)
    )
    return [
        WorkerStatus.model_validate(
            {
                "name": row.name,
                "queues": row.queues.split(","),
                "concurrency": row.concurrency,
                "seen_at": moment(row.seen_us),
                "online": row.seen_us > now - ONLINE_US,
            }
        )
        for row in rows
    ]


def _queue(session: Session, context: Context) -> QueueStatus:
    # Of these alone, which an index finds: those that have ended become hundreds of thousands.
    waiting = Job.state.in_((JobState.QUEUED, JobState.RUNNING))
    by_state = select(Job.state, func.count()).where(waiting).group_by(Job.state)
    counts: dict[str, int] = {row[0]: row[1] for row in session.execute(by_state)}
    waits_us = (backlog.longest_wait_us for backlog in jobs.backlogs(session).values())
    return QueueStatus(
        queued=counts.get(JobState.QUEUED, 0),
        running=counts.get(JobState.RUNNING, 0),
        stalled=jobs.count_stalled(session, stalled_s=context.settings.stalled_seconds),
        longest_wait_seconds=max(waits_us, default=0) / 1e6,
    )


def _disk(context: Context) -> DiskStatus:
    free_bytes, total_bytes = disk_of_uploads(context.settings)
    return DiskStatus(
        free_bytes=free_bytes,
        total_bytes=total_bytes,
        accepts_uploads=free_bytes > context.settings.min_free_disk_bytes,
    )


def metrics_route(metrics: Metrics, token: SecretStr | None) -> APIRouter:
    """`/metrics` of these metrics.

    Parameters
    ----------
    token
        That whoever asks has to send; None: anybody may ask.
    """
    metrics_router = APIRouter(tags=["operation"])
    text = gives(200, "In Prometheus' text format", content={"text/plain": {"schema": {"type": "string"}}})

    @metrics_router.get(
        "/metrics",
        response_class=Response,
        summary="Metrics",
        responses=text if token is None else {**text, **problems(401)},
        dependencies=[] if token is None else [Depends(_MetricsToken(token))],
    )
    async def get_metrics() -> Response:
        """Metrics for Prometheus."""
        return Response(await run_in_threadpool(metrics.text), media_type=CONTENT_TYPE)

    return metrics_router


class _MetricsToken(HTTPBearer):
    """FastAPI's, so that the OpenAPI page says which token the route needs."""

    def __init__(self, token: SecretStr) -> None:
        super().__init__(
            auto_error=False, scheme_name="MetricsToken", description="The operator's `MRASFM_METRICS_TOKEN`"
        )
        self._token = token.get_secret_value().encode()

    async def __call__(self, request: Request) -> None:  # type: ignore[override]
        """Let whoever has the token pass.

        Raises
        ------
        ServiceError
            401 without it.
        """
        credentials = await super().__call__(request)
        given = b"" if credentials is None else credentials.credentials.encode()
        if not secrets.compare_digest(given, self._token):
            raise Unauthorized(
                "the metrics of this service are for its operator",
                remedy="Send 'Authorization: Bearer TOKEN' with the value of MRASFM_METRICS_TOKEN.",
                headers={"WWW-Authenticate": 'Bearer realm="mrasfm metrics"'},
                title="No valid token",
            )
