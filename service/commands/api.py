"""`mrasfm api`: the HTTP API."""

from __future__ import annotations

import argparse

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
    import uvicorn

    from service.app import create_app
    from service.logs import configure

    settings = Settings()
    configure(arguments.log_level)
    uvicorn.run(
        create_app(settings),
        host=arguments.host or settings.host,
        port=settings.port if arguments.port is None else arguments.port,
        log_config=None,
        access_log=False,  # the request log says more
        timeout_graceful_shutdown=20,  # event streams would hold it up for ever
        h11_max_incomplete_event_size=64_000,
        timeout_keep_alive=30,
        server_header=False,
    )
    return 0
