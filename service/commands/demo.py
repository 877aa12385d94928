"""`mrasfm demo`: show the whole service at work."""

from __future__ import annotations

import argparse


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser("demo", help="show the whole service at work")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Being written."""
    return 2
