"""The API's server: uvicorn, with explicit settings where its defaults do not fit."""

from __future__ import annotations

import os
import resource
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import uvicorn
from uvicorn.supervisors import Multiprocess

from service.pdeathsig import end_with_parent
from service.storage.process_folder import own_folder

if TYPE_CHECKING:  # a process that only watches others does not load it
    from fastapi import FastAPI

_METRICS_FOLDER = "PROMETHEUS_MULTIPROC_DIR"  # prometheus_client's: where several processes count together
_DESCRIPTORS = 65_536  # an upload takes two: its connection and its file


def serve(make_app: Callable[[], FastAPI], *, host: str, port: int, processes: int, metrics_dir: Path) -> int:
    """Serve until told to stop; an exit code.

    Parameters
    ----------
    make_app
        Makes the application, in the process that serves it: a function that can be pickled.
    processes
        That take requests from one socket. One that dies is started again, and requests wait for it.
    metrics_dir
        Where several processes count together, in a folder of this API's own; what killed ones left there is removed.
    """
    _allow_many_connections()
    if processes == 1:
        server = server_of(make_app(), host=host, port=port)
        with suppress(KeyboardInterrupt):  # uvicorn raises it anew once it has stopped
            server.run()
        return 0 if server.started else 1
    with own_folder(metrics_dir, "api") as folder:
        os.environ[_METRICS_FOLDER] = str(folder)
        in_child = partial(_in_child, make_app, os.getpid())
        config = _config(in_child, host=host, port=port, factory=True, workers=processes)
        Multiprocess(config, sockets=[config.bind_socket()]).run()
    return 0


def server_of(app: FastAPI, *, host: str, port: int, **options: Any) -> uvicorn.Server:
    """A server of the application, for this process; `options` are uvicorn's."""
    return uvicorn.Server(_config(app, host=host, port=port, **options))


def _config(app: Any, *, host: str, port: int, **options: Any) -> uvicorn.Config:
    chosen = {
        "http": "service.api.http.protocol:BoundedHttpProtocol",
        "ws": "none",
        "log_config": None,
        "access_log": False,  # the request log says more
        "timeout_graceful_shutdown": 20,  # event streams would hold it up for ever
        "timeout_keep_alive": 30,
        "server_header": False,
        **options,
    }
    return uvicorn.Config(app, host=host, port=port, **chosen)


def _in_child(make_app: Callable[[], FastAPI], parent: int) -> FastAPI:
    end_with_parent(parent)
    return make_app()


def _allow_many_connections() -> None:
    """Raise this process's bound of descriptors, which many systems set low for the sake of old programs."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, _DESCRIPTORS)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
