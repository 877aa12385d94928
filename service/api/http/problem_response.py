"""Errors as answers."""

from __future__ import annotations

from fastapi.responses import JSONResponse

from schemas.api.problems import MEDIA_TYPE
from service.errors import ServiceError


def problem_response(error: ServiceError) -> JSONResponse:
    """An error as RFC 9457 has it."""
    body = error.problem.model_dump(mode="json", exclude_defaults=True)
    return JSONResponse(body, status_code=error.status, headers=error.headers, media_type=MEDIA_TYPE)
