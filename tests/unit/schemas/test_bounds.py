"""A document is small on the wire and large in memory: it is refused before it is parsed."""

from __future__ import annotations

import json
import resource
import time
from typing import Any

import pytest

from schemas import DocumentError, LabelMap, parse_manifest
from schemas.api.drives import DeclareFiles
from schemas.parsing import MAX_CONTAINERS, MAX_KEYS, MAX_PROBLEMS, MAX_VALUES, parse_document, parse_json

_START = b'{"version":1,"name":"x","rig":{"cameras":[]},"frames":['


@pytest.mark.parametrize(
    ("item", "count", "what"),
    [
        (b"{},", MAX_CONTAINERS, "objects and lists"),
        (b"[],", MAX_CONTAINERS, "objects and lists"),
        (b"1,", MAX_VALUES, "values"),
    ],
)
def test_too_many_parts_are_refused_unparsed(item: bytes, count: int, what: str) -> None:
    raw = _START + item * (count + 1) + b"1]}"
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(DocumentError, match=f"{what}, over the bound"):
        parse_manifest(raw)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb < 100_000


def test_a_long_list_of_bad_items_is_not_described_whole() -> None:
    with pytest.raises(DocumentError) as refused:
        parse_manifest(_START + b"{}," * 50_000 + b"{}]}")
    assert 1 <= len(refused.value.problems) < 20
    assert any(problem.path.startswith("frames.0.") for problem in refused.value.problems)


def test_an_object_of_many_keys_is_refused_at_once() -> None:
    """Neither looking for the repeated one nor describing the unknown ones may cost more than reading them."""
    keys = [f'"k{i}":1' for i in range(500_000)]
    raw = ("{" + ",".join([*keys, keys[-1]]) + "}").encode()
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    began_s = time.process_time()
    with pytest.raises(DocumentError, match=rf"500001 keys, over the bound of {MAX_KEYS}; one is 'k499999'") as refused:
        parse_manifest(raw)
    assert time.process_time() - began_s < 20, "the square of the keys would take minutes"
    assert len(refused.value.problems) == 1
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb < 300_000


def test_the_widest_object_of_a_contract_is_read() -> None:
    widest = {str(i): "road" for i in range(MAX_KEYS)}
    assert len(parse_document(json.dumps({"ids": widest}).encode(), LabelMap).ids) == MAX_KEYS
    with pytest.raises(DocumentError, match="over the bound"):
        parse_json(json.dumps({**widest, "256": "road"}).encode())


def test_a_long_key_is_not_repeated_whole() -> None:
    key = "k" * 100_000
    with pytest.raises(DocumentError, match="appears twice") as refused:
        parse_json(f'{{"{key}": 1, "{key}": 2}}'.encode())
    assert len(str(refused.value)) < 200


def test_the_first_of_many_defects_are_kept_and_all_are_counted() -> None:
    camera: dict[str, Any] = {f"unknown{i}": 1 for i in range(200)}
    with pytest.raises(DocumentError, match=r"and 12\d\d\d more") as refused:
        parse_manifest(json.dumps({"rig": {"cameras": [camera] * 60}}).encode())
    assert len(refused.value.problems) == MAX_PROBLEMS


def test_a_long_declaration_of_bad_files_is_not_described_whole() -> None:
    bad = {f"unknown{i}": 1 for i in range(10)}
    with pytest.raises(DocumentError) as refused:
        parse_document(json.dumps({"files": [bad] * 5000}).encode(), DeclareFiles)
    assert len(refused.value.problems) < 20


@pytest.mark.parametrize("raw", [b"[" + b"{}," * (MAX_CONTAINERS + 1) + b"1]", b" " * 101])
def test_plain_json_has_the_same_bounds(raw: bytes) -> None:
    with pytest.raises(DocumentError, match="the bound of"):
        parse_json(raw, max_bytes=100 if raw.isspace() else 10**9)
