"""Query parameters that a route does not have are refused: a misspelt filter would give everything."""

from __future__ import annotations

from collections.abc import Iterator

from fastapi import Request
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute

from schemas.api.problems import ProblemItem
from schemas.findings import enumerated
from schemas.misspelt import similar_name
from service.errors import InvalidRequest

_MAX_NAMED = 10
_MAX_NAME_SHOWN = 80


def refuse_unknown_parameters(request: Request) -> None:
    """Compare a request with its route. Routes that need no key take anything: probes add parameters of their own.

    Raises
    ------
    InvalidRequest
        That names each unknown parameter, and the route's own that is spelt most like it.
    """
    if not request.scope["query_string"]:
        return
    route: APIRoute = request.scope["route"]
    known = sorted(_declared(route.dependant))
    unknown = [name for name in request.query_params if name not in known]
    if not unknown:
        return
    problems = [
        ProblemItem(field=f"query.{name[:_MAX_NAME_SHOWN]}", detail=_described(name, known))
        for name in unknown[:_MAX_NAMED]
    ]
    raise InvalidRequest(
        enumerated([f"{problem.field!r} {problem.detail}" for problem in problems], 3, count=len(unknown)),
        remedy="Correct the parameters that are named, or leave them out; the page /docs of this service lists them.",
        errors=problems,
    )


def _declared(dependant: Dependant) -> Iterator[str]:
    """Names of the query parameters of a route and of what it depends on."""
    yield from (parameter.alias for parameter in dependant.query_params)
    for other in dependant.dependencies:
        yield from _declared(other)


def _described(name: str, known: list[str]) -> str:
    similar = similar_name(name, known)
    if similar is not None:
        return f"is no parameter of this request; did you mean {similar!r}?"
    return f"is no parameter of this request, which takes {', '.join(known) or 'none'}"
