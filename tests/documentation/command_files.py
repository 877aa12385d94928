"""Files of the `mrasfm` command that are made of its parsers: what `--help` lists, and the shells' completion."""

from __future__ import annotations

import argparse
import json

import shtab

from mrasfm_engine.cli import INDEX, build_parser
from mrasfm_engine.commands.completion import FOLDER, SHELLS


def command_files() -> dict[str, str]:
    """The files by their path below `mrasfm_engine/`."""
    parser = build_parser()
    texts = {INDEX.name: json.dumps(_helps(parser), indent=1) + "\n"}
    for shell in SHELLS:
        texts[f"{FOLDER.name}/mrasfm.{shell}"] = shtab.complete(build_parser(), shell=shell).rstrip() + "\n"
    return texts


def _helps(parser: argparse.ArgumentParser) -> dict[str, str]:
    (action,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    return {choice.dest: choice.help or "" for choice in action._choices_actions}
