"""`mrasfm api`: the HTTP API."""

from __future__ import annotations

import argparse
import os
from functools import partial
from typing import TYPE_CHECKING

from service.logs import add_log_level, configure
from service.settings import Settings, settings_of_command

if TYPE_CHECKING:
    from fastapi import FastAPI


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "api",
        help="run the HTTP API",
        description="Run the HTTP API. Settings are environment variables, see mrasfm describe service.",
    )
    parser.add_argument("--host", help="address to listen on (MRASFM_HOST)")
    parser.add_argument("--port", type=int, help="port to listen on (MRASFM_PORT)")
    add_log_level(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Serve until told to stop."""
    from service.api.server import serve

    settings = settings_of_command()
    configure(arguments.log_level)
    return serve(
        partial(make_app, settings, arguments.log_level),
        host=arguments.host or settings.host,
        port=settings.port if arguments.port is None else arguments.port,
        processes=settings.api_processes or min(2, os.cpu_count() or 1),
        metrics_dir=settings.metrics_dir,
    )


def make_app(settings: Settings, log_level: str) -> FastAPI:
    """The application, in the process that serves it."""
    from service.api.app import create_app

    configure(log_level)
    return create_app(settings)
