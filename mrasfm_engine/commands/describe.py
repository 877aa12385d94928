"""`mrasfm describe`: the formats of files that users write, from the installed package."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from importlib.metadata import entry_points
from importlib.resources import files
from pathlib import Path

from pydantic import BaseModel

from mrasfm_engine.config import EngineConfig

TOPICS = "mrasfm.descriptions"  # entry points: functions that return the text of a topic
MANIFEST_PAGE = "README.md"
MANIFEST_SCHEMA = "drive.schema.json"


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand's parser."""
    parser = subparsers.add_parser(
        "describe",
        help="print the format of the manifest or of settings",
        description="Print the drive manifest's format as Markdown (manifest) or as JSON Schema (schema), the engine's "
        "settings with their defaults as a TOML file for --config (settings), or the environment variables of the "
        "service (service).",
    )
    parser.add_argument("topic", choices=sorted(entry_points(group=TOPICS).names), help="text to print")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print the description."""
    (entry,) = entry_points(group=TOPICS, name=arguments.topic)
    print(entry.load()(), end="")
    return 0


def manifest_page() -> str:
    """The description of every field of `drive.json`, as Markdown."""
    return files("schemas").joinpath(MANIFEST_PAGE).read_text(encoding="utf-8")


def manifest_schema() -> str:
    """The JSON Schema (draft 2020-12) of `drive.json`."""
    return files("schemas").joinpath(MANIFEST_SCHEMA).read_text(encoding="utf-8")


def settings_file() -> str:
    """All settings with their defaults, as TOML; settings without a default are comments."""
    config = EngineConfig()
    sections = {name: getattr(config, name) for name in EngineConfig.model_fields}
    lines = list(_assignments(config, {name for name, value in sections.items() if not isinstance(value, BaseModel)}))
    for name, section in sections.items():
        if isinstance(section, BaseModel):
            lines += ["", f"# {section.__doc__}", f"[{name}]", *_assignments(section, set(type(section).model_fields))]
    return "\n".join(lines) + "\n"


def _assignments(section: BaseModel, names: set[str]) -> Iterator[str]:
    for name, field in type(section).model_fields.items():
        if name in names:
            value = getattr(section, name)
            yield f"# {field.description}"
            yield f"# {name} =" if value is None else f"{name} = {_toml(value)}"


def _toml(value: bool | float | str | Path) -> str:
    """A scalar in TOML, whose numbers, booleans and basic strings have JSON's form."""
    return json.dumps(str(value) if isinstance(value, Path) else value)
