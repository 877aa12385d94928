"""The OpenAPI page: FastAPI's, with what FastAPI cannot know."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from fastapi.sse import EventSourceResponse
from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from schemas.api.problems import Problem
from service.routes.bodies import documented
from service.routes.dependencies import problems

_METHODS = ("get", "head", "post", "put", "patch", "delete", "options")
_EVENTS = EventSourceResponse.media_type
_CHECKED = ("query", "header")  # where parameters can be wrong; ids in a path are any text, and found or not


def openapi_page(app: FastAPI) -> dict[str, Any]:
    """The page, with the models of bodies that we read ourselves, and problems wherever FastAPI announces its own."""
    if app.openapi_schema is None:
        page = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
        models: list[type[BaseModel]] = [*documented.values(), Problem]
        _, extra = models_json_schema(
            [(model, "validation") for model in models], ref_template="#/components/schemas/{model}"
        )
        page["components"]["schemas"] |= extra["$defs"]
        for unused in ("HTTPValidationError", "ValidationError"):
            page["components"]["schemas"].pop(unused, None)
        for path, operation in _operations(page):
            _correct_invalid(operation)
            if path.startswith("/v1/"):
                operation["responses"].setdefault("503", problems(503)[503])
        app.openapi_schema = page
    return app.openapi_schema


def _operations(page: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    for path, methods in page["paths"].items():
        yield from ((path, methods[name]) for name in _METHODS if name in methods)


def _correct_invalid(operation: dict[str, Any]) -> None:
    """FastAPI documents its own form of 422 for every route with a parameter; ours is a problem, and only at some."""
    documented_422 = operation["responses"].get("422")
    if documented_422 is None or "HTTPValidationError" not in str(documented_422):
        return
    if "requestBody" in operation or any(given["in"] in _CHECKED for given in operation.get("parameters", ())):
        operation["responses"]["422"] = problems(422)[422]
    else:
        del operation["responses"]["422"]


def allowed_methods(app: FastAPI, path: str) -> list[str]:
    """Methods of the resource at a path, in capitals; none where there is no resource.

    Several templates can match, as `/jobs/{job_id}` and `/jobs/{job_id}:cancel` do: the longest is the one meant.
    """
    paths = openapi_page(app)["paths"]
    matching = [template for template in paths if _expression(template).fullmatch(path)]
    if not matching:
        return []
    meant = paths[max(matching, key=lambda template: len(re.sub(r"{[a-z_]+}", "", template)))]
    names = [name.upper() for name in _METHODS if name in meant]
    if "GET" in names and "HEAD" not in names and _EVENTS not in meant["get"]["responses"]["200"].get("content", {}):
        names.insert(1, "HEAD")
    return names


def _expression(template: str) -> re.Pattern[str]:
    parts = re.split(r"({[a-z_]+})", template)
    wild = {"{path}": ".+"}
    return re.compile("".join(wild.get(p, "[^/]+") if p.startswith("{") else re.escape(p) for p in parts), re.DOTALL)
