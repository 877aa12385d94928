"""`mrasfm aggregate`: several scenes to one map."""

from __future__ import annotations

import argparse
from pathlib import Path


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser("aggregate", help="put scenes together to a map")
    parser.add_argument("scenes", type=Path, nargs="*", metavar="SCENE", help="folders of scenes")
