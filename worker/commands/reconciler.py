"""`mrasfm reconciler`: keeps the system of record, the broker and the workers in step."""

from __future__ import annotations

import argparse
import signal
import threading

from service.logs import add_log_level, configure
from service.settings import settings_of_command


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "reconciler",
        help="run the service's reconciler",
        description="Sends lost messages of jobs again, frees jobs of workers that died, deletes what "
        "has passed its retention date. Settings are environment variables, see mrasfm describe service.",
    )
    add_log_level(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Reconcile until told to stop."""
    from worker.reconciler import Reconciler

    settings = settings_of_command()
    configure(arguments.log_level)
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    Reconciler(settings).run(ended)
    return 0
