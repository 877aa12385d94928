"""The `mrasfm` command: collects the subcommands of all installed packages and turns errors into exit codes."""

from __future__ import annotations

import argparse
import sys
from importlib.metadata import entry_points, version

from mrasfm_engine.errors import CancelledError, MrasfmError

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130


def build_parser() -> argparse.ArgumentParser:
    """The parser of `mrasfm` with all subcommands.

    Subcommands are modules of the entry-point group `mrasfm.commands` with a function
    `register(subparsers)` that adds a parser whose default `run` takes the parsed arguments.
    """
    parser = argparse.ArgumentParser(prog="mrasfm", description="Multi-camera drives to metric maps.")
    parser.add_argument("--version", action="version", version=version("mrasfm"), help="print the version and exit")
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for entry in sorted(entry_points(group="mrasfm.commands"), key=lambda entry: entry.name):
        entry.load().register(subparsers)
    return parser


def main(argv: list[str] | None = None) -> int:
    """Run one subcommand."""
    arguments = build_parser().parse_args(argv)
    try:
        return int(arguments.run(arguments) or 0)
    except CancelledError as error:
        print(f"mrasfm: {error}", file=sys.stderr)
        return EXIT_INTERRUPTED
    except MrasfmError as error:
        print(f"mrasfm: error: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print("mrasfm: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
