"""Properties of values from outside: numbers beyond their bounds are refused by name, nothing ends in another error."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from mrasfm_engine.config import EngineConfig
from schemas import DocumentError, parse_manifest
from schemas.api.jobs import ReconstructionSettings
from schemas.drive import LAST_TIMESTAMP_US, MAX_IMAGE_SIDE_PX, MIN_SIGMA
from schemas.export import SCHEMA_FILE

TEXT = SCHEMA_FILE.with_name("README.md").read_text(encoding="utf-8")
EXAMPLE: dict[str, Any] = json.loads(re.findall(r"```json\n(.*?)```", TEXT, flags=re.DOTALL)[0])
# Path in the documented example, least and greatest value, and whether only whole numbers are taken.
NUMBERS = [
    ("rig.cameras.0.width", 1, MAX_IMAGE_SIDE_PX, True),
    ("rig.cameras.0.height", 1, MAX_IMAGE_SIDE_PX, True),
    ("rig.cameras.0.sigma_rotation_deg", MIN_SIGMA, 1e6, False),
    ("rig.cameras.0.sigma_translation_m", MIN_SIGMA, 1e6, False),
    ("frames.0.timestamp_us", 0, LAST_TIMESTAMP_US, True),
    ("frames.0.source_frame", 0, 2**31 - 1, True),
    ("gnss.samples.0.latitude_deg", -90, 90, False),
    ("gnss.samples.0.longitude_deg", -180, 180, False),
    ("gnss.samples.0.height_m", -1000, 20000, False),
    ("gnss.samples.0.sigma_horizontal_m", MIN_SIGMA, 1e6, False),
    ("gnss.samples.0.sigma_vertical_m", MIN_SIGMA, 1e6, False),
]
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)
quick = settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])


def changed(path: str, value: object) -> bytes:
    document = copy.deepcopy(EXAMPLE)
    *parents, last = path.split(".")
    target: Any = document
    for part in parents:
        target = target[int(part) if part.isdigit() else part]
    target[last] = value
    return json.dumps(document).encode()


def paths(document: object, prefix: str = "") -> Iterator[str]:
    """All members of objects in a document."""
    if isinstance(document, dict):
        for key, value in document.items():
            yield f"{prefix}{key}"
            yield from paths(value, f"{prefix}{key}.")
    elif isinstance(document, list):
        for i, value in enumerate(document):
            yield from paths(value, f"{prefix}{i}.")


def beyond(low: float, high: float, *, whole: bool) -> st.SearchStrategy[float]:
    if whole:
        return st.integers(max_value=int(low) - 1) | st.integers(min_value=int(high) + 1)
    finite = st.floats(allow_nan=False, allow_infinity=False)
    return finite.filter(lambda value: not low <= value <= high)


@pytest.mark.parametrize(("path", "low", "high", "whole"), NUMBERS)
def test_a_number_beyond_its_bounds_is_refused_by_name(path: str, low: float, high: float, whole: bool) -> None:
    @quick
    @given(beyond(low, high, whole=whole))
    def refused(value: float) -> None:
        with pytest.raises(DocumentError) as caught:
            parse_manifest(changed(path, value))
        assert caught.value.problems[0].path == path

    refused()


@pytest.mark.parametrize(("path", "low", "high", "whole"), [n for n in NUMBERS if n[0] != "frames.0.timestamp_us"])
def test_a_number_within_its_bounds_is_read(path: str, low: float, high: float, whole: bool) -> None:
    within = st.integers(int(low), int(high)) if whole else st.floats(low, high)

    @quick
    @given(within)
    def is_read(value: float) -> None:
        assume(path not in ("rig.cameras.0.width", "rig.cameras.0.height") or value > 1200)  # the principal point
        assume(path != "frames.0.source_frame" or value != EXAMPLE["frames"][1].get("source_frame"))
        parse_manifest(changed(path, value))

    is_read()


@settings(quick, max_examples=300)
@given(st.sampled_from(sorted(paths(EXAMPLE))), JSON)
def test_any_value_anywhere_is_read_or_refused(path: str, value: object) -> None:
    with suppress(DocumentError):
        parse_manifest(changed(path, value))


def bounded(schema: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Numeric fields of a model's JSON Schema that have a bound."""
    for name, field in schema["properties"].items():
        for form in field.get("anyOf", [field]):
            if form.get("type") in ("integer", "number") and {"minimum", "maximum", "exclusiveMinimum"} & set(form):
                yield name, form


def outside(form: Mapping[str, Any]) -> st.SearchStrategy[float]:
    number = st.integers() if form["type"] == "integer" else st.floats(allow_nan=False)
    low = form.get("minimum", form.get("exclusiveMinimum", float("-inf")))
    high = form.get("maximum", form.get("exclusiveMaximum", float("inf")))
    return number.filter(lambda v: v < low or v > high or (v == low and "exclusiveMinimum" in form))


SETTINGS = [
    (section, name, form)
    for section, part in EngineConfig.model_json_schema()["$defs"].items()
    for name, form in bounded(part)
]


def test_every_numeric_setting_has_two_bounds() -> None:
    """Numbers near the ends of float64 would overflow in equations and end in tracebacks."""
    numbers = [
        (section, name, form)
        for section, part in EngineConfig.model_json_schema()["$defs"].items()
        for name, field in part["properties"].items()
        for form in field.get("anyOf", [field])
        if form.get("type") in ("integer", "number")
    ]
    assert len(numbers) > 40
    assert [(section, name) for section, name, form in numbers if not {"minimum", "maximum"} <= set(form)] == []


@pytest.mark.parametrize(
    ("section", "name", "form"), SETTINGS, ids=[f"{section}.{name}" for section, name, _ in SETTINGS]
)
def test_a_setting_beyond_its_bounds_is_refused(section: str, name: str, form: Mapping[str, Any]) -> None:
    (key,) = [k for k, f in EngineConfig.model_fields.items() if getattr(f.annotation, "__name__", "") == section]

    @settings(quick, max_examples=10)
    @given(outside(form))
    def refused(value: float) -> None:
        with pytest.raises(ValidationError, match=name):
            EngineConfig.model_validate({key: {name: value}})

    refused()


@pytest.mark.parametrize(("name", "form"), list(bounded(ReconstructionSettings.model_json_schema())))
def test_a_requested_setting_beyond_its_bounds_is_refused(name: str, form: Mapping[str, Any]) -> None:
    @settings(quick, max_examples=10)
    @given(outside(form))
    def refused(value: float) -> None:
        with pytest.raises(ValidationError, match=name):
            ReconstructionSettings.model_validate({name: value})

    refused()
