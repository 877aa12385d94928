"""`mrasfm standalone`: the whole service on one machine."""

from __future__ import annotations

import argparse
import os
import sys
from contextlib import suppress
from pathlib import Path

from pydantic import ValidationError

from service.commands.administration import EXIT_CANNOT_RUN
from service.logs import add_log_level
from service.settings import Settings, invalid_settings, misspelt_variables


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "standalone",
        help="run the whole service on this machine",
        description="Run API, broker, workers and reconciler on this machine, with all state in one folder. "
        "Settings are environment variables, see mrasfm describe service.",
    )
    parser.add_argument("--data", type=Path, metavar="DIR", help="folder of all state (default: mrasfm-data)")
    parser.add_argument("--host", help="address to listen on (default: 127.0.0.1)")
    parser.add_argument("--port", type=int, help="port to listen on (default: 8000; 0 takes a free one)")
    parser.add_argument("--workers", type=_count, default=1, metavar="N", help="reconstructions at a time (default: 1)")
    add_log_level(parser, "of the files in DIR/logs")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run until a signal says stop."""
    from service.standalone.broker import BrokerServerError
    from service.standalone.program import StandaloneError, run_standalone
    from service.standalone.supervisor import SupervisorError
    from service.storage.data_folder import DataFolderError

    for problem in misspelt_variables(os.environ):
        _say(f"warning: {problem}")
    try:
        run_standalone(_settings(arguments), workers=arguments.workers, log_level=arguments.log_level, say=_say)
    except (DataFolderError, BrokerServerError, StandaloneError, SupervisorError) as error:
        _say(f"error: {error}")
        return EXIT_CANNOT_RUN
    except ValidationError as error:
        for problem in invalid_settings(error):
            _say(f"error: {problem} or the option for it.")
        return EXIT_CANNOT_RUN
    _say("stopped. Started again with the same folder, it goes on where it was.")
    return 0


def _settings(arguments: argparse.Namespace) -> Settings:
    given = {"data_dir": arguments.data, "host": arguments.host, "port": arguments.port}
    return Settings(**{name: value for name, value in given.items() if value is not None})


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number above 0")
    return int(text)


def _say(line: str) -> None:
    """Tell who is at the terminal; that nobody is there any more, or no room for it, stops nothing."""
    try:
        print(f"mrasfm: {line}", file=sys.stderr, flush=True)
    except BrokenPipeError:  # what reads our words has ended
        with suppress(OSError):  # else what is left of the line fails again at the interpreter's end
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, sys.stderr.fileno())
            os.close(nowhere)
    except OSError:
        return
