"""Request bodies: what they are once they are read, and how the OpenAPI page describes them."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from fastapi import Request
from pydantic import BaseModel

from service.errors import ServiceError

Value = TypeVar("Value")

BODY = "the request's body"  # what errors call it


@dataclass(frozen=True)
class Body(Generic[Value]):
    """A parsed body and the bytes that it came as."""

    value: Value
    raw: bytes


def request_sha256(request: Request, raw: bytes) -> str:
    """Tells requests apart that are made under one idempotency key."""
    target = f"{request.method} {request.url.path}?{request.url.query}\n"
    digest = hashlib.sha256(target.encode())
    digest.update(raw)
    return digest.hexdigest()


def refuse_form(
    request: Request, refusal: type[ServiceError], *, what: str, remedy: str, code: str | None = None
) -> None:
    """Refuse the form that holds something good in the words of forms: it is the body that is wrong.

    Parameters
    ----------
    refusal, code
        Of the error that the body's bytes would be refused with.
    what
        The body should have been.

    Raises
    ------
    ServiceError
        Of this kind, where the body is a form.
    """
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind.startswith("multipart/"):
        raise refusal(f"the body is a form ({kind}), in which {what} is one part", remedy=remedy, code=code)


# Models that bodies are parsed as: the OpenAPI page describes them.
documented: dict[str, type[BaseModel]] = {}


def describe(model: type[BaseModel]) -> dict[str, Any]:
    """`openapi_extra` of a route whose body is `model`."""
    return {"requestBody": {"required": True, "content": json_content(model)}}


def json_content(model: type[BaseModel]) -> dict[str, Any]:
    """The `content` of what FastAPI neither parses nor writes itself."""
    documented[model.__name__] = model
    return {"application/json": {"schema": {"$ref": f"#/components/schemas/{model.__name__}"}}}


def describe_bytes(what: str) -> dict[str, Any]:
    """`openapi_extra` of a route whose body is a file."""
    schema = {"type": "string", "format": "binary", "description": what}
    return {"requestBody": {"required": True, "content": {"application/octet-stream": {"schema": schema}}}}
