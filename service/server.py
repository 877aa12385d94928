"""How the API is served: uvicorn, with what must not be left to its defaults."""

from __future__ import annotations

import resource
from typing import Any

import uvicorn
from fastapi import FastAPI

from service.http_protocol import BoundedHttpProtocol

_DESCRIPTORS = 65_536  # an upload takes two: its connection and its file


def server_of(app: FastAPI, *, host: str, port: int, **options: Any) -> uvicorn.Server:
    """A server of the application; `options` are uvicorn's."""
    chosen = {
        "http": BoundedHttpProtocol,
        "ws": "none",
        "log_config": None,
        "access_log": False,  # the request log says more
        "timeout_graceful_shutdown": 20,  # event streams would hold it up for ever
        "timeout_keep_alive": 30,
        "server_header": False,
        **options,
    }
    return uvicorn.Server(uvicorn.Config(app, host=host, port=port, **chosen))


def allow_many_connections() -> None:
    """Raise this process's bound of descriptors, which many systems set low for the sake of old programs."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, _DESCRIPTORS)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
