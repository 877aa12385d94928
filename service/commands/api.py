"""`mrasfm api`: the HTTP API."""

from __future__ import annotations

import argparse
from contextlib import suppress

from service.settings import Settings


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser("api", help="run the HTTP API", description="Settings: environment MRASFM_*.")
    parser.add_argument("--host", help="address to listen on (MRASFM_HOST)")
    parser.add_argument("--port", type=int, help="port to listen on (MRASFM_PORT)")
    parser.add_argument("--log-level", default="info", choices=("debug", "info", "warning", "error"))
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Serve until told to stop."""
    from service.app import create_app
    from service.logs import configure
    from service.server import allow_many_connections, server_of

    settings = Settings()
    configure(arguments.log_level)
    allow_many_connections()
    host, port = arguments.host or settings.host, settings.port if arguments.port is None else arguments.port
    server = server_of(create_app(settings), host=host, port=port)
    with suppress(KeyboardInterrupt):  # uvicorn raises it anew once it has stopped
        server.run()
    return 0 if server.started else 1
