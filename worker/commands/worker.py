"""`mrasfm worker`: takes jobs and runs them."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from service.logs import add_log_level
from service.settings import Settings, settings_of_command

QUEUES = ("checks", "reconstructions")


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "worker",
        help="run a worker of the service",
        description="Run a worker of the service. Settings are environment variables, see mrasfm describe service.",
    )
    parser.add_argument(
        "--queues",
        default=",".join(QUEUES),
        help="checks (of drives, and exports), reconstructions, or both separated by a comma (default: both)",
    )
    parser.add_argument("--concurrency", type=int, default=1, help="jobs at one time (default: 1)")
    add_log_level(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Work until told to stop; a job under way is given back, and another worker goes on with it."""
    import sys
    import tempfile

    from service.storage.process_folder import own_folder

    wanted = arguments.queues.split(",")
    unknown = sorted(set(wanted) - set(QUEUES))
    settings = settings_of_command()
    if unknown or not 1 <= arguments.concurrency <= 1024 or settings.redis_url is None:
        what = "MRASFM_REDIS_URL is not set" if settings.redis_url is None else "--concurrency must be 1 to 1024"
        what = f"--queues: there is no queue {unknown[0]!r}, only {' and '.join(QUEUES)}" if unknown else what
        print(f"mrasfm: error: {what}", file=sys.stderr)
        return 2
    with own_folder(settings.temporary_dir, "worker") as temporary:
        # Celery's pool keeps files here that a killed process leaves behind.
        tempfile.tempdir = str(temporary)
        return _work(settings, wanted, concurrency=arguments.concurrency, log_level=arguments.log_level)


def _work(settings: Settings, queues: Sequence[str], *, concurrency: int, log_level: str) -> int:
    import os
    import socket

    from worker.app import make_app

    worker = make_app(settings, log_level=log_level).Worker(
        hostname=f"{queues[0] if len(queues) == 1 else 'all'}.{os.getpid()}@{socket.gethostname()}",
        queues=queues,
        concurrency=concurrency,
        pool="prefork",
        loglevel=log_level.upper(),
        without_gossip=True,
        without_mingle=True,
        without_heartbeat=True,
        quiet=True,
    )
    worker.start()
    return int(worker.exitcode or 0)
