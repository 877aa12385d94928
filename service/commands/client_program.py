"""`mrasfm-client`: all that a user does with a service, without the engine."""

from __future__ import annotations

import argparse
import os
import sys
from io import TextIOWrapper

from schemas.command_line import CommandParser
from service.commands import client_resources, map, upload

EXIT_UNREAD = 141  # as of a program that a broken pipe ends


def build_parser() -> argparse.ArgumentParser:
    """The parser of `mrasfm-client` with its subcommands."""
    parser: argparse.ArgumentParser = CommandParser(prog="mrasfm-client", description="Use an MRASfM service.")
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    upload.register(subparsers)
    map.register(subparsers)
    client_resources.register_resources(subparsers)
    return parser


def main(argv: list[str] | None = None) -> int:
    """Run one subcommand."""
    arguments = build_parser().parse_args(argv)
    if isinstance(sys.stdout, TextIOWrapper):  # names may have characters that the terminal's encoding lacks
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        code = int(arguments.run(arguments) or 0)
        sys.stdout.flush()
    except BrokenPipeError:  # who reads has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_UNREAD
    return code


if __name__ == "__main__":
    sys.exit(main())
