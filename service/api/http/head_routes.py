"""HEAD wherever GET is, as RFC 9110 wants it."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy

from fastapi import APIRouter
from fastapi.routing import APIRoute
from fastapi.sse import EventSourceResponse


def heads_of(routers: Sequence[APIRouter]) -> APIRouter:
    """A HEAD route for every GET route that has none; the server sends no body to HEAD.

    The OpenAPI page says it once, for all. Event streams have none: their answer begins when there is news.
    """
    routes = [route for router in routers for route in router.routes if isinstance(route, APIRoute)]
    own = {route.path for route in routes if "HEAD" in (route.methods or ())}
    heads = [_head_of(route) for route in routes if "GET" in (route.methods or ()) and route.path not in own]
    return APIRouter(routes=[head for head in heads if head.response_class is not EventSourceResponse])


def _head_of(route: APIRoute) -> APIRoute:
    head = copy(route)
    head.methods, head.include_in_schema = {"HEAD"}, False
    return head
