"""`mrasfm completion`: the shell's completion of all commands."""

from __future__ import annotations

import argparse
from pathlib import Path

SHELLS = ("bash", "zsh")
FOLDER = Path(__file__).resolve().parents[1] / "completion"


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "completion",
        help="print the completion script of a shell",
        description="Print the completion script of a shell: "
        'eval "$(mrasfm completion bash)", or write it where the shell looks for completions.',
    )
    parser.add_argument("shell", choices=SHELLS, help="shell that completes")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print the script."""
    print((FOLDER / f"mrasfm.{arguments.shell}").read_text(encoding="utf-8"), end="")
    return 0
