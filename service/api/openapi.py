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
from schemas.api.resource import RequestBody, Resource
from schemas.drive import DriveManifest
from service.api.http.request_bodies import documented
from service.api.http.responses import COMPONENTS, add_common_headers, problems

_WRITING = ("post", "put", "patch", "delete")
_METHODS = ("get", "head", "post", "put", "patch", "delete", "options")
_EVENTS = EventSourceResponse.media_type
# In the order of a client's conversation.
_TAGS = [
    {"name": "drives", "description": "Recordings: created from a manifest, filled with files, committed and checked."},
    {"name": "files", "description": "The files of a drive: one by one, or in an archive."},
    {"name": "uploads", "description": "Large files in pieces, with any tus 1.0.0 client."},
    {"name": "reconstructions", "description": "One drive to one scene, as a job."},
    {"name": "jobs", "description": "How far it is and what became of it; cancel and repeat."},
    {"name": "scenes", "description": "What reconstructions made, to download."},
    {"name": "maps", "description": "Several drives or scenes in one, version by version."},
    {"name": "exports", "description": "Scenes and maps in formats of other programs, as jobs."},
    {"name": "webhooks", "description": "Addresses that are told when jobs end."},
    {"name": "session", "description": "The web console's: a cookie in place of the key."},
    {"name": "operation", "description": "How the service itself is."},
]
_IDS = {
    "drive_id": "of the drive, `drv_...`",
    "upload_id": "of the upload, `upl_...`",
    "job_id": "of the job, `job_...`",
    "scene_id": "of the scene, `scn_...`",
    "webhook_id": "of the webhook, `whk_...`",
    "delivery_id": "of the message, `msg_...`",
    "export_id": "of the export, `exp_...`",
    "map_id": "of the map, `map_...`",
    "version": "the version's number, or `current`",
    "path": "the file's name with its folders; slashes stay as they are",
}


def openapi_page(app: FastAPI) -> dict[str, Any]:
    """The page, with the models of bodies that we read ourselves, and problems wherever FastAPI announces its own."""
    if app.openapi_schema is None:
        page = get_openapi(
            title=app.title, version=app.version, description=app.description, routes=app.routes, tags=_TAGS
        )
        models: list[type[BaseModel]] = [*documented.values(), Problem]
        _, extra = models_json_schema(
            [(model, "validation") for model in models], ref_template="#/components/schemas/{model}"
        )
        page["components"] |= COMPONENTS
        page["components"]["schemas"] |= extra["$defs"]
        for unused in ("HTTPValidationError", "ValidationError"):
            page["components"]["schemas"].pop(unused, None)
        _restore_examples(page["components"]["schemas"])
        for path, method, operation in _operations(page):
            _correct_invalid(operation)
            if path.startswith("/v1/"):
                _add_problems(operation, 422, 503)
                if method in _WRITING:
                    _add_problems(operation, 403)
            if "requestBody" in operation:
                _add_problems(operation, 408, 415)
            if "application/json" in operation.get("requestBody", {}).get("content", ()):
                _add_problems(operation, 429)
            if method in _WRITING:
                _add_problems(operation, 507)
            _describe_ids(operation)
            add_common_headers(operation)
        app.openapi_schema = page
    return app.openapi_schema


def _restore_examples(schemas: dict[str, Any]) -> None:
    """Restore examples: FastAPI drops what is null from them, and pydantic sorts their fields."""
    models: list[type[BaseModel]] = [DriveManifest, Problem, *_models(RequestBody), *_models(Resource)]
    for model in models:
        schema = schemas.get(re.sub("[^A-Za-z0-9_]", "_", model.__name__))
        extra: Any = model.model_config.get("json_schema_extra")
        if schema is None or extra is None:
            continue
        if callable(extra):
            extra(schema, model)
        else:
            schema.update(extra)


def _models(root: type[BaseModel]) -> Iterator[type[BaseModel]]:
    for model in root.__subclasses__():
        yield model
        yield from _models(model)


def _operations(page: dict[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for path, methods in page["paths"].items():
        yield from ((path, name, methods[name]) for name in _METHODS if name in methods)


def _add_problems(operation: dict[str, Any], *statuses: int) -> None:
    """Add the problems that any request of a kind may meet: a body that does not come, a disk that is full."""
    for status, documented_problem in problems(*statuses).items():
        operation["responses"].setdefault(str(status), documented_problem)


def _correct_invalid(operation: dict[str, Any]) -> None:
    """FastAPI documents its own form of 422 for every route with a parameter; ours is a problem, and only at some."""
    documented_422 = operation["responses"].get("422")
    if documented_422 is None or "HTTPValidationError" not in str(documented_422):
        return
    if "requestBody" in operation or any(_can_be_wrong(given) for given in operation.get("parameters", ())):
        operation["responses"]["422"] = problems(422)[422]
    else:
        del operation["responses"]["422"]


def _can_be_wrong(parameter: dict[str, Any]) -> bool:
    """Ids in a path are any text, and found or not; so are headers without a form."""
    allowed = parameter["schema"].get("anyOf", [parameter["schema"]])
    return parameter["in"] != "path" and {"type": "string"} not in allowed


def _describe_ids(operation: dict[str, Any]) -> None:
    for given in operation.get("parameters", ()):
        if given["in"] == "path":
            given["description"] = _IDS[given["name"]]


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
