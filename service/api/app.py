"""The API: `create_app` puts routes, errors, logs and metrics together."""

from __future__ import annotations

import asyncio
import errno
import logging
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from importlib.metadata import version

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from obstore.exceptions import BaseError
from sqlalchemy.exc import InterfaceError, OperationalError, SQLAlchemyError
from sqlalchemy.exc import InternalError as RefusedByDatabase
from sqlalchemy.exc import TimeoutError as PoolTimeout
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from schemas.api.problems import PROBLEM_TYPE, Problem, ProblemItem
from service.api.context import Context
from service.api.http.head_routes import heads_of
from service.api.http.problem_response import problem_response
from service.api.metrics import Metrics
from service.api.middleware.body_rules import BodyRules
from service.api.middleware.request_log import RequestLog
from service.api.middleware.security_headers import SecurityHeaders
from service.api.openapi import allowed_methods, openapi_page
from service.api.readiness import Readiness
from service.api.routes import (
    aggregations,
    drive_downloads,
    drives,
    events,
    exports,
    files,
    jobs,
    maps,
    operations,
    reconstructions,
    scenes,
    session,
    uploads,
    webhooks,
)
from service.api.routes.console import add_console
from service.api.routes.documentation import add_documentation
from service.database.tables import now_us
from service.domain import uploads as upload_records
from service.errors import (
    DatabaseUnavailable,
    DiskFull,
    InternalError,
    InvalidRequest,
    OtherError,
    ServiceError,
    store_unavailable,
)
from service.settings import Settings
from service.storage.artifacts import StoreAwayError
from service.storage.spool import sweep
from service.storage.uploads.resumable import sweep as sweep_resumable

log = logging.getLogger("mrasfm.api")

_SPOOL_KEPT_S = 24 * 3600
_UPLOADS_SWEPT_AFTER_S = 60  # at its start an API has other things to do
_SWEEP_EVERY_S = 3600
_EXPIRED_KEPT_S = 7 * 24 * 3600
_DATABASE_FULL = ("database or disk is full", "No space left on device")
_ABOUT = """
Send a drive (images of a vehicle's cameras, GNSS, calibration), get a metric scene.

1. `POST /v1/drives` with the manifest, `drive.json`
2. `PUT /v1/drives/{id}/files/{path}` for each file, or one `PUT /v1/drives/{id}/archive`; large ones can be sent in
   pieces, with any tus client, to `/v1/drives/{id}/uploads`
3. `POST /v1/drives/{id}:commit`
4. `POST /v1/reconstructions`, then poll `/v1/jobs/{id}` or read its events
5. `GET /v1/scenes/{id}` and its files
6. `POST /v1/aggregations` with several drives or scenes makes one map of them: `GET /v1/maps/{id}` and its versions

`mrasfm upload` and `mrasfm map` do all of it. HEAD is answered wherever GET is, but for event streams. Every error is
an RFC 9457 problem whose `remedy` says what to do.
"""


def create_app(settings: Settings | None = None) -> FastAPI:
    """The API as an ASGI application, with the settings of the environment by default."""
    settings = settings or Settings()
    context = Context.open(settings)
    metrics = Metrics(context.database, settings)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        sweeping = asyncio.create_task(_sweep_for_ever(context))
        yield
        sweeping.cancel()
        await asyncio.gather(sweeping, return_exceptions=True)
        context.close()

    app = FastAPI(
        title="MRASfM",
        version=version("mrasfm"),
        description=_ABOUT,
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
        generate_unique_id_function=lambda route: route.name,  # `create_drive`: what generated clients call it
        redirect_slashes=False,  # it would lead whoever asks to the host that the request itself names
    )
    app.state.context = context
    app.state.readiness = Readiness(context)
    modules = (
        drives,
        files,
        drive_downloads,
        uploads,
        reconstructions,
        aggregations,
        jobs,
        events,
        scenes,
        maps,
        exports,
        webhooks,
        session,
        operations,
    )
    routers = [*(module.router for module in modules), operations.metrics_route(metrics, settings.metrics_token)]
    for router in (*routers, heads_of(routers)):
        app.include_router(router)
    add_documentation(app)
    add_console(app, tile_origin=settings.tile_origin)
    _answer_errors(app)
    app.add_middleware(BodyRules, idle_s=settings.upload_idle_seconds)
    app.add_middleware(RequestLog, metrics=metrics, failed=_failed)
    app.add_middleware(SecurityHeaders)
    app.openapi = lambda: openapi_page(app)  # type: ignore[method-assign]
    return app


async def _sweep_for_ever(context: Context) -> None:
    """Remove what killed processes left in the spool, and uploads that nobody went on with."""
    settings = context.settings
    await asyncio.gather(
        _repeat(0.0, lambda: sweep(settings.spool_dir, older_than_s=_SPOOL_KEPT_S)),
        _repeat(_UPLOADS_SWEPT_AFTER_S, lambda: sweep_uploads(context)),
    )


async def _repeat(after_s: float, step: Callable[[], object]) -> None:
    await asyncio.sleep(after_s)
    while True:
        try:
            await asyncio.to_thread(step)
        except (OSError, SQLAlchemyError):
            log.exception("the spool could not be swept")
        await asyncio.sleep(_SWEEP_EVERY_S)


def sweep_uploads(context: Context) -> None:
    """Remove what is nobody's any more. An upload that expired is answered with 410 for a while, then with 404."""

    def alive(upload_ids: Sequence[str]) -> set[str]:
        with context.database.read() as session:
            return upload_records.alive(session, upload_ids)

    sweep_resumable(context.settings.uploads_dir, alive)
    with context.database.write() as session:
        upload_records.forget_expired(session, before_us=now_us() - int(_EXPIRED_KEPT_S * 1e6))


def _answer_errors(app: FastAPI) -> None:
    @app.exception_handler(ServiceError)
    async def refused(request: Request, error: ServiceError) -> Response:
        return problem_response(error)

    @app.exception_handler(RequestValidationError)
    async def invalid(request: Request, error: RequestValidationError) -> Response:
        items = [
            ProblemItem(field=".".join(str(part) for part in detail["loc"]), detail=str(detail["msg"]))
            for detail in error.errors()
        ]
        what = "; ".join(f"{item.field}: {item.detail}" for item in items[:3])
        remedy = "Correct the parameters that are named; the page /docs of this service describes them."
        return problem_response(InvalidRequest(what, remedy=remedy, errors=items))

    @app.exception_handler(HTTPException)
    async def http(request: Request, error: HTTPException) -> Response:
        code = {404: "not-found", 405: "method-not-allowed"}.get(error.status_code, "http-error")
        detail = f"{request.method} {request.url.path}: {error.detail}"
        remedy = "The page /docs of this service lists all routes."
        headers = dict(error.headers or {})
        if error.status_code == 405:
            headers["Allow"] = ", ".join(allowed_methods(app, request.url.path)) or headers.get("Allow", "GET")
        problem = Problem(
            type=PROBLEM_TYPE + code, title=str(error.detail), status=error.status_code, detail=detail, remedy=remedy
        )
        return problem_response(OtherError(problem, headers=headers))

    @app.exception_handler(ClientDisconnect)
    async def gone(request: Request, error: ClientDisconnect) -> Response:
        return Response(status_code=400)  # nobody reads it

    @app.exception_handler(OSError)
    async def disk(request: Request, error: OSError) -> Response:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            return problem_response(_disk_full())
        raise error

    @app.exception_handler(StoreAwayError)
    @app.exception_handler(BaseError)
    async def store(request: Request, error: Exception) -> Response:
        log.error("the artifact store does not answer", exc_info=error)
        return problem_response(store_unavailable())

    @app.exception_handler(PoolTimeout)
    @app.exception_handler(InterfaceError)
    @app.exception_handler(RefusedByDatabase)
    @app.exception_handler(OperationalError)
    async def database(request: Request, error: SQLAlchemyError) -> Response:
        if isinstance(error, RefusedByDatabase) and not error.connection_invalidated:
            raise error
        if any(words in str(error) for words in _DATABASE_FULL):
            return problem_response(_disk_full())
        log.error("the database does not answer", exc_info=error)
        # What it was sent last, it may commit after the connection broke.
        detail = "the database does not answer: the request was recorded as a whole, or not at all"
        remedy = "Repeat it in some seconds, with the same Idempotency-Key if it had one."
        headers = {"Retry-After": "5"}
        return problem_response(DatabaseUnavailable(detail, remedy=remedy, headers=headers))


def _failed() -> Response:
    detail = "an error of the service itself; it is in the service's log"
    remedy = "Repeat the request; if it fails again, tell the operator the header X-Request-Id."
    return problem_response(InternalError(detail, remedy=remedy))


def _disk_full() -> ServiceError:
    return DiskFull(
        "the service has no space left to store this",
        remedy="Nothing was stored. The operator has to free space; then repeat the request.",
    )
