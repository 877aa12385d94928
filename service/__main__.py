"""`python -m service COMMAND`: what standalone and containers start.

The same as `mrasfm COMMAND`, but `mrasfm` imports the engine's subcommands too, which the API has no use for.
"""

from __future__ import annotations

import argparse
import sys

from schemas.command_line import CommandParser
from service.commands import api, keys, migrate, projects, standalone


def main() -> int:
    """Run one subcommand."""
    parser: argparse.ArgumentParser = CommandParser(prog="python -m service")
    subparsers = parser.add_subparsers(required=True, metavar="COMMAND")
    for command in (api, keys, migrate, projects, standalone):
        command.register(subparsers)
    arguments = parser.parse_args()
    return int(arguments.run(arguments))


if __name__ == "__main__":
    sys.exit(main())
