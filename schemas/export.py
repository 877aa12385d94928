"""Writes the JSON Schema of the drive manifest: `python -m schemas.export`."""

from __future__ import annotations

import json
from pathlib import Path

from schemas.drive import DriveManifest

SCHEMA_FILE = Path(__file__).with_name("drive.schema.json")


def schema_text() -> str:
    """The JSON Schema (draft 2020-12) of `drive.json`, as it is committed."""
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema", **DriveManifest.model_json_schema()}
    return json.dumps(schema, indent=2) + "\n"


def main() -> None:
    """Write the schema beside this module."""
    SCHEMA_FILE.write_text(schema_text(), encoding="utf-8")


if __name__ == "__main__":
    main()
