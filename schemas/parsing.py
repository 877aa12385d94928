"""Strict reading of JSON from outside: what is ambiguous or out of range is refused with the field's path."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, Never, TypeVar

from pydantic import BaseModel, ValidationError

from schemas.drive import DriveManifest

MAX_MANIFEST_BYTES = 200_000_000  # a day's drive of 6 cameras with 100 Hz GNSS has about 100 MB
# 100,000 frames of 8 cameras and a million GNSS samples have 9 million values, in 3 million objects and lists.
MAX_VALUES = 12_000_000
MAX_CONTAINERS = 4_000_000
# The widest object of any contract is a label map of 256 ids. Each unknown key costs a kilobyte to describe.
MAX_KEYS = 256
MAX_PROBLEMS = 100
MAX_PROBLEMS_SHOWN = 5
MAX_KEY_SHOWN = 80

Model = TypeVar("Model", bound=BaseModel)


@dataclass(frozen=True)
class FieldProblem:
    """One defect: where (dotted path, empty for the document as a whole) and what."""

    path: str
    what: str


class DocumentError(ValueError):
    """A JSON document does not follow its contract.

    Parameters
    ----------
    problems
        The first defects that were found, in document order; at least one.
    count
        Of all defects, where there are more.
    """

    def __init__(self, problems: list[FieldProblem], *, count: int | None = None) -> None:
        self.problems = problems
        shown = [f"{p.path}: {p.what}" if p.path else p.what for p in problems[:MAX_PROBLEMS_SHOWN]]
        more = (count or len(problems)) - len(shown)
        if more:
            shown.append(f"and {more} more")
        super().__init__("; ".join(shown))


def parse_manifest(raw: bytes) -> DriveManifest:
    """The manifest in the bytes of a `drive.json`.

    Raises
    ------
    DocumentError
        For all that `parse_document` refuses.
    """
    return parse_document(raw, DriveManifest)


def parse_document(
    raw: bytes, model: type[Model], *, strict: bool = True, max_bytes: int = MAX_MANIFEST_BYTES
) -> Model:
    """A pydantic model from JSON bytes.

    Parameters
    ----------
    raw
        UTF-8 text, at most `max_bytes`.
    strict
        Whether types must match exactly (no numbers in strings, no true for 1) and keys may not repeat nor be more
        than `MAX_KEYS` in one object. Large tables of published datasets are read faster without.

    Raises
    ------
    DocumentError
        If the text is too large, no valid UTF-8 or JSON, holds NaN or Infinity, too many keys or one twice in one
        object, or does not fit the model.
    """
    if strict:
        parse_json(raw, max_bytes=max_bytes)
    else:
        _require_bounded(raw, max_bytes)
    try:
        return model.model_validate_json(raw.removeprefix(b"\xef\xbb\xbf"), strict=strict)
    except ValidationError as error:
        details = error.errors(include_url=False, include_context=False)
        problems = [_problem(dict(detail)) for detail in details[:MAX_PROBLEMS]]
        raise DocumentError(problems, count=len(details)) from None


def parse_json(raw: bytes, *, max_bytes: int = MAX_MANIFEST_BYTES) -> Any:
    """The value of JSON bytes, without the extensions that Python's parser allows.

    Raises
    ------
    DocumentError
        If the text is too large, no valid UTF-8 or JSON, or holds NaN, Infinity, too many keys or one twice in one
        object.
    """
    _require_bounded(raw, max_bytes)
    try:
        text = raw.removeprefix(b"\xef\xbb\xbf").decode("utf-8")
    except UnicodeDecodeError as error:
        raise DocumentError([FieldProblem("", f"is not UTF-8 text (byte {error.start})")]) from None
    try:
        return json.loads(text, object_pairs_hook=_object_without_repeats, parse_constant=_refuse_constant)
    except DocumentError:
        raise
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        raise DocumentError([FieldProblem("", f"is not valid JSON: {error.msg} at {where}")]) from None
    except RecursionError:
        raise DocumentError([FieldProblem("", "is not valid: nested too deeply")]) from None
    except ValueError as error:
        raise DocumentError([FieldProblem("", f"is not valid JSON: {error}")]) from None


def _require_bounded(raw: bytes, max_bytes: int) -> None:
    if len(raw) > max_bytes:
        raise DocumentError([FieldProblem("", f"has {len(raw)} bytes, over the bound of {max_bytes}")])
    # An empty object is two bytes on the wire and a hundred in memory.
    for what, count, bound in (
        ("objects and lists", raw.count(b"{") + raw.count(b"["), MAX_CONTAINERS),
        ("values", raw.count(b","), MAX_VALUES),
    ):
        if count > bound:
            raise DocumentError([FieldProblem("", f"has {count} {what}, over the bound of {bound}")])


def _object_without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(pairs) > MAX_KEYS:
        what = f"an object has {len(pairs)} keys, over the bound of {MAX_KEYS}; one is {_shortened(pairs[-1][0])}"
        raise DocumentError([FieldProblem("", what)])
    result: dict[str, Any] = {}
    for key, value in pairs:
        if key in result:
            raise DocumentError([FieldProblem("", f"key {_shortened(key)} appears twice in one object")])
        result[key] = value
    return result


def _shortened(key: str) -> str:
    return repr(key if len(key) <= MAX_KEY_SHOWN else key[:MAX_KEY_SHOWN] + "...")


def _refuse_constant(name: str) -> Never:
    raise DocumentError([FieldProblem("", f"holds {name}, which is not a JSON number")])


def _problem(detail: dict[str, Any]) -> FieldProblem:
    path = ".".join(str(part) for part in detail["loc"])
    what = str(detail["msg"]).removeprefix("Value error, ")
    kind = detail["type"]
    if kind == "missing":
        what = "is missing"
    elif kind == "extra_forbidden":
        what = "is not a field of this document"
    elif kind == "finite_number":
        what = "must be a finite number"
    elif path.endswith("latitude_deg") and kind in ("less_than_equal", "greater_than_equal"):
        what = f"{detail['input']} is not a latitude (-90 to 90): are latitude and longitude swapped?"
    elif path.endswith("timestamp_us") and kind in ("int_type", "int_from_float"):
        what = f"{detail['input']!r} must be an integer number of microseconds"
    elif not what.startswith(("must", "coordinates")) and isinstance(detail["input"], str | int | float | None):
        what = f"{what} (is {str(detail['input'])[:80]!r})"
    return FieldProblem(path, what)
