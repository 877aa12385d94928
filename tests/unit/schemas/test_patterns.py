"""A string that is refused for its pattern is told in words what is allowed, never a regular expression."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

import schemas
from schemas.api.aggregations import MapName
from schemas.api.exports import Crs
from schemas.api.jobs import ModelName
from schemas.api.resource import Id, Sha256
from schemas.api.webhooks import WebhookRequest
from schemas.drive import DriveName, Gnss, Name, Vehicle

REPOSITORY = Path(schemas.__file__).parents[1]
# The client's record of its own uploads: a wrong one is not told, it is begun anew.
UNTOLD = REPOSITORY / "service/client/upload_state.py"


def field(model: Any, name: str) -> Any:
    return model.__pydantic_fields__[name].rebuild_annotation()


@pytest.mark.parametrize(
    ("kind", "given", "words"),
    [
        (Name, "front left", "letters (A-Z, a-z), digits and _ . - without spaces"),
        (Name, "größe", "letters (A-Z, a-z), digits and _ . - without spaces"),
        (Name, "a" * 65, "1 to 64 letters"),
        (Name, "", "1 to 64 letters"),
        (Vehicle, "M AB", "1 to 64 letters (A-Z, a-z), digits and _ . : - without spaces"),
        (DriveName, "ring\nroad", "without control characters"),
        (MapName, "ring\x1broad", "without control characters"),
        (ModelName, "Big", "lower-case letters (a-z), digits and _ . -"),
        (Id, "drv-1", "an id: 1 to 40 lower-case letters (a-z), digits and _"),
        (Sha256, "AB" * 32, "64 hexadecimal digits in lower case"),
        (Crs, "UTM32", "as EPSG:25832"),
        (field(Gnss, "height_datum"), "EGM96", "'ellipsoidal' or EPSG: with 4 to 6 digits"),
        (field(WebhookRequest, "url"), "ftp://example.org", "begins with https:// or http://"),
        (field(WebhookRequest, "description"), "a\nb", "without control characters"),
    ],
)
def test_a_refusal_says_in_words_what_is_allowed(kind: Any, given: str, words: str) -> None:
    with pytest.raises(ValidationError) as refused:
        TypeAdapter(kind).validate_python(given)
    (detail,) = refused.value.errors()
    assert words in detail["msg"]
    assert detail["input"] == given
    assert not set("^$[]{}\\") & set(detail["msg"])


def test_a_length_is_refused_as_such() -> None:
    for given, words in (("", "at least 1 character"), ("a" * 201, "at most 200 characters")):
        with pytest.raises(ValidationError, match=words):
            TypeAdapter(DriveName).validate_python(given)


def test_no_pattern_is_without_words() -> None:
    """Every other way of giving pydantic or FastAPI a pattern shows the regular expression to who is refused."""
    bare = [
        f"{path.relative_to(REPOSITORY)}:{call.lineno}"
        for package in ("schemas", "service", "worker", "mrasfm_engine")
        for path in sorted((REPOSITORY / package).rglob("*.py"))
        if path != UNTOLD
        if "pattern" in (text := path.read_text(encoding="utf-8"))  # few have it: to parse all takes seconds
        for call in ast.walk(ast.parse(text))
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Name)
        if call.func.id in ("Field", "StringConstraints", "Query", "Header", "Path", "constr", "Form", "Cookie")
        if any(keyword.arg == "pattern" for keyword in call.keywords)
    ]
    assert bare == []
