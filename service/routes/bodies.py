"""Request bodies: read within bounds, parsed strictly, described in the OpenAPI page."""

from __future__ import annotations

import hashlib
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import anyio
from fastapi import Request
from pydantic import BaseModel
from starlette.concurrency import run_in_threadpool

from schemas.parsing import DocumentError, parse_document
from service.bounded_process import LARGE_BYTES
from service.context import Context
from service.errors import ServiceError, invalid_document
from service.settings import Settings

Model = TypeVar("Model", bound=BaseModel)
Value = TypeVar("Value")

BODY = "the request's body"  # what errors call it
_LARGE_WITHIN_S = 300.0  # 64 MB over 1.7 Mbit/s


@dataclass(frozen=True)
class Body(Generic[Value]):
    """A parsed body and the bytes that it came as."""

    value: Value
    raw: bytes


def json_body(
    model: type[Model], max_bytes: Callable[[Settings], int]
) -> Callable[[Request], AsyncIterator[Body[Model]]]:
    """A dependency that reads a JSON body as `model`.

    FastAPI's own parsing would hold a body of any size in memory, and takes NaN and repeated keys.
    """

    def parse(context: Context, raw: bytes) -> Model:
        try:
            return parse_document(raw, model)
        except DocumentError as error:
            raise invalid_document(error, what=BODY) from None

    return parsed_body(parse, max_bytes)


def parsed_body(
    parse: Callable[[Context, bytes], Value], max_bytes: Callable[[Settings], int]
) -> Callable[[Request], AsyncIterator[Body[Value]]]:
    """A dependency that reads a body and what `parse`, which may block, makes of it.

    Few large bodies are held at one time, and one of them is parsed and recorded: it takes ten times its size until it
    is answered.
    """

    async def read(request: Request) -> AsyncIterator[Body[Value]]:
        context: Context = request.app.state.context
        async with AsyncExitStack() as turns:
            raw = await _read(request, max_bytes(context.settings), context, turns)
            yield Body(await run_in_threadpool(parse, context, raw), raw)

    return read


async def _read(request: Request, bound: int, context: Context, turns: AsyncExitStack) -> bytes:
    """The request's body, which waits for its turns once it proves to be large.

    Raises
    ------
    ServiceError
        413 as soon as it is known to be larger than `bound`, 408 where a large one takes too long.
    """
    if int(request.headers.get("content-length", 0)) > bound:
        raise _too_large(request.headers["content-length"], bound)
    stream = request.stream()
    parts = [part async for part in _until(stream, min(bound, LARGE_BYTES))]
    if sum(map(len, parts)) > LARGE_BYTES:
        # Only now: who announces a large body and sends none shall not hold up those who do.
        await turns.enter_async_context(context.large_bodies)
        parts += await _rest_in_time(stream, bound - sum(map(len, parts)))
        await turns.enter_async_context(context.large_documents)
    if sum(map(len, parts)) > bound:
        raise _too_large(f"over {bound}", bound)
    return b"".join(parts)


async def _until(stream: AsyncIterator[bytes], enough_bytes: int) -> AsyncIterator[bytes]:
    """Parts of a stream until there are more bytes than these, or no more."""
    size_bytes = 0
    async for part in stream:
        yield part
        size_bytes += len(part)
        if size_bytes > enough_bytes:
            return


async def _rest_in_time(stream: AsyncIterator[bytes], bound: int) -> list[bytes]:
    try:
        with anyio.fail_after(_LARGE_WITHIN_S):
            return [part async for part in _until(stream, bound)]
    except TimeoutError:
        raise ServiceError(
            408,
            "too-slow",
            "The request took too long",
            f"the body was not here within {_LARGE_WITHIN_S:g} s",
            remedy="Repeat it over a faster connection, or split the drive.",
        ) from None


def _too_large(size: str, max_bytes: int) -> ServiceError:
    return ServiceError(
        413,
        "too-large",
        "The request is too large",
        f"the body has {size} bytes, the bound is {max_bytes}",
        remedy="Split the drive, or ask the operator for a larger bound.",
    )


def request_sha256(request: Request, raw: bytes) -> str:
    """Tells requests apart that are made under one idempotency key."""
    target = f"{request.method} {request.url.path}?{request.url.query}\n"
    digest = hashlib.sha256(target.encode())
    digest.update(raw)
    return digest.hexdigest()


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
