"""The table of the settings that a request may set, as `docs/service/api.md` has it."""

from __future__ import annotations

from typing import Any

from schemas.api.jobs import ReconstructionSettings
from tests.documentation.tables import table


def request_settings() -> str:
    """A row for each setting, as Markdown."""
    fields = ReconstructionSettings.model_json_schema()["properties"]
    rows = [[f"`{name}`", _values(field), field["description"]] for name, field in fields.items()]
    return table(["setting", "values", "meaning"], rows)


def _values(field: dict[str, Any]) -> str:
    kind = field.get("anyOf", [field])[0]
    if "enum" in kind:
        return " ".join(f"`{value}`" for value in kind["enum"])
    if kind["type"] == "integer":
        return f"{kind['minimum']} to {kind['maximum']}"
    return "`true` `false`" if kind["type"] == "boolean" else "text"
