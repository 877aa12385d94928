"""A document is small on the wire and large in memory: it is refused before it is parsed."""

from __future__ import annotations

import resource

import pytest

from schemas import DocumentError, parse_manifest
from schemas.parsing import MAX_CONTAINERS, MAX_VALUES

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
