"""Types of arguments that the commands of the engine, of the service and of its client share."""

from __future__ import annotations

import argparse
from pathlib import Path


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
