"""Parser and types of arguments that the commands of the engine, of the service and of its client share."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import Any


class CommandParser(argparse.ArgumentParser):
    """A parser whose subcommands refuse unknown arguments by themselves, with their own usage.

    argparse leaves that to the outermost parser, whose usage says nothing of the subcommand's options.
    """

    def parse_known_args(self, args: Iterable[str] | None = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """Parse as argparse does, and end with an error where anything is left over."""
        known, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return known, unknown


def output_folder(text: str) -> Path:
    """The folder that an option names for a result.

    An empty text, as a shell makes of a variable that is not set, would be the working directory.

    Raises
    ------
    argparse.ArgumentTypeError
        If the text is empty.
    """
    if not text.strip():
        raise argparse.ArgumentTypeError("no folder is given; the working directory is '.'")
    return Path(text)
