"""`python -m service.api.openapi_export FILE`: the types of the OpenAPI page, from which the console's are made."""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from service.api.app import create_app
from service.settings import Settings

_WORDS = ("description", "examples", "example", "title", "default", "properties")


def _types_of(page: Any) -> Any:
    """The page's schemas alone, without words: what a generator of types needs."""
    schemas = {name: _without_words(schema) for name, schema in sorted(page["components"]["schemas"].items())}
    info = {"title": page["info"]["title"], "version": "1"}
    return {"openapi": page["openapi"], "info": info, "paths": {}, "components": {"schemas": schemas}}


def _without_words(schema: Any) -> Any:
    if isinstance(schema, list):
        return [_without_words(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    named = schema.get("properties", {})
    kept = {name: _without_words(of) for name, of in schema.items() if name not in _WORDS}
    return kept | ({"properties": {name: _without_words(of) for name, of in named.items()}} if named else {})


def openapi_text() -> str:
    """The page's types as JSON."""
    with tempfile.TemporaryDirectory() as folder:
        app = create_app(Settings(data_dir=Path(folder)))
        try:
            return json.dumps(_types_of(app.openapi()), indent=1)
        finally:
            app.state.context.close()


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(openapi_text(), encoding="utf-8")
