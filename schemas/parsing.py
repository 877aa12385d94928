"""Strict reading of JSON from outside: what is ambiguous or out of range is refused with the field's path."""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any, Never, TypeVar

from pydantic import BaseModel, ValidationError

from schemas.drive import MIN_SIGMA, DriveManifest
from schemas.file_names import name_problems
from schemas.findings import enumerated
from schemas.misspelt import correction_of
from schemas.patterns import MISMATCH

MAX_MANIFEST_BYTES = 200_000_000  # a day's drive of 6 cameras with 100 Hz GNSS has about 100 MB
# 100,000 frames of 8 cameras and a million GNSS samples have 9 million values, in 3 million objects and lists.
MAX_VALUES = 12_000_000
MAX_CONTAINERS = 4_000_000
# The widest object of any contract is a label map of 256 ids. Each unknown key costs a kilobyte to describe.
MAX_KEYS = 256
MAX_PROBLEMS = 100
MAX_PROBLEMS_SHOWN = 5
MAX_KEY_SHOWN = 80

_INTEGER = re.compile("0|[1-9][0-9]*")

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
        told = [f"{p.path}: {p.what}" if p.path else p.what for p in problems]
        super().__init__(enumerated(told, MAX_PROBLEMS_SHOWN, count=count))


def parse_manifest(raw: bytes) -> DriveManifest:
    """The manifest in the bytes of a `drive.json` that was accepted once, perhaps by an earlier version.

    Raises
    ------
    DocumentError
        For all that `parse_document` refuses.
    """
    return parse_document(raw, DriveManifest)


def parse_new_manifest(raw: bytes) -> DriveManifest:
    """The manifest in the bytes of a `drive.json` that a drive is made of.

    Rules that came later hold here alone, so that what was accepted before them can still be read.

    Raises
    ------
    DocumentError
        As `parse_manifest`; for numbers in another form than their schema's, and for files that cannot lie in one
        folder on every system.
    """
    manifest = parse_document(raw, DriveManifest, look=_numbers_in_another_form)
    problems = list(islice(file_problems(manifest), MAX_PROBLEMS))
    if problems:
        raise DocumentError(problems)
    return manifest


def file_problems(manifest: DriveManifest) -> Iterator[FieldProblem]:
    """Files of a manifest that cannot lie in one folder with the others on every system, by path."""
    images = [image for frame in manifest.frames for image in frame.images.values()]
    paths = {path for image in images for path in (image.file, image.mask) if path is not None}
    return (FieldProblem(path, what) for path, what in name_problems(paths))


def _numbers_in_another_form(document: Any) -> list[FieldProblem]:
    """Find numbers of a manifest that pydantic takes for the number that is meant."""
    if not isinstance(document, dict):
        return []
    problems = []
    version = document.get("version", 1)
    if version in (1, 2) and type(version) is not int:
        problems.append(FieldProblem("version", f"must be the integer 1 or 2, is {json.dumps(version)}"))
    label_map = document.get("label_map")
    ids = label_map.get("ids") if isinstance(label_map, dict) else None
    for key in ids if isinstance(ids, dict) else ():
        if not _INTEGER.fullmatch(key):
            what = f"{_shortened(key)} must be an integer without sign, spaces and zeros before it"
            problems.append(FieldProblem("label_map.ids", what))
    return problems


def parse_document(
    raw: bytes,
    model: type[Model],
    *,
    strict: bool = True,
    max_bytes: int = MAX_MANIFEST_BYTES,
    look: Callable[[Any], list[FieldProblem]] = lambda document: [],
) -> Model:
    """A pydantic model from JSON bytes.

    Parameters
    ----------
    raw
        UTF-8 text, at most `max_bytes`.
    strict
        Whether types must match exactly (no numbers in strings, no true for 1) and keys may not repeat nor be more
        than `MAX_KEYS` in one object. Large tables of published datasets are read faster without.
    look
        Of a strict reading: finds defects in the document as JSON has it.

    Raises
    ------
    DocumentError
        If the text is too large, no valid UTF-8 or JSON, holds NaN or Infinity, too many keys or one twice in one
        object, or does not fit the model.
    """
    found: list[FieldProblem] = []
    if strict:
        found = look(parse_json(raw, max_bytes=max_bytes))
    else:
        _require_bounded(raw, max_bytes)
    try:
        read = model.model_validate_json(raw.removeprefix(b"\xef\xbb\xbf"), strict=strict)
    except ValidationError as error:
        details = error.errors(include_url=False, include_context=False)
        problems = [*found, *(_problem(dict(detail), model) for detail in details[:MAX_PROBLEMS])]
        raise DocumentError(problems[:MAX_PROBLEMS], count=len(found) + len(details)) from None
    if found:
        raise DocumentError(found)
    return read


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
    except ValueError:  # all that is left of what Python's parser raises
        what = f"holds an integer of over {sys.get_int_max_str_digits()} digits"
        raise DocumentError([FieldProblem("", what)]) from None


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


def _problem(detail: dict[str, Any], model: type[BaseModel]) -> FieldProblem:
    path = ".".join(str(part) for part in detail["loc"])
    what = str(detail["msg"]).removeprefix("Value error, ")
    kind = detail["type"]
    if kind == "missing":
        what = "is missing"
    elif kind == "extra_forbidden":
        what = f"is not a field of this document{correction_of(model, detail['loc'])}"
    elif kind == "finite_number":
        what = "must be a finite number"
    elif path.endswith("latitude_deg") and kind in ("less_than_equal", "greater_than_equal"):
        what = f"{_shown(detail['input'])} is not a latitude (-90 to 90): are latitude and longitude swapped?"
    elif path.endswith("timestamp_us") and kind in ("int_type", "int_from_float"):
        what = f"{_shown(detail['input'])} must be an integer number of microseconds"
    elif path.endswith("timestamp_us") and kind == "less_than_equal":
        what = f"{detail['input']} is after the year 9999: give microseconds (are these nanoseconds?)"
    elif kind == "greater_than_equal" and str(detail["loc"][-1]).startswith("sigma_"):
        what = f"{detail['input']} is no standard deviation: give {MIN_SIGMA:g} or more (nothing is known better)"
    elif kind == MISMATCH and not str(detail["input"]).isprintable():
        what = f"{detail['input'][:MAX_KEY_SHOWN]!r} holds control characters: give a name that can be printed"
    elif not what.startswith(("must", "coordinates")) and isinstance(detail["input"], str | int | float | None):
        what = f"{what} (is {_shown(detail['input'])})"
    return FieldProblem(path, what)


def _shown(value: str | float | bool | None) -> str:
    """A value as JSON has it: who sends it need not know Python."""
    if isinstance(value, str):
        return repr(value[:MAX_KEY_SHOWN])
    if isinstance(value, float) and math.isinf(value):
        return "a number beyond 1.8e308"
    return json.dumps(value)[:MAX_KEY_SHOWN]
