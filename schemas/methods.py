"""Extractors and matchers, by the names that settings give them.

A new one is a module of the engine and its line here. The module has the attribute `METHOD` (a `Method` or a
`LearnedMethod` of `mrasfm_engine.learned.catalogue`) and, where it needs a trained model, lists the known ones as
`MODELS`. Settings, the HTTP API, `mrasfm models` and the documentation follow from this table.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, WithJsonSchema
from pydantic_core import PydanticCustomError

EXTRACTORS = {
    "sift": "mrasfm_engine.features.sift",
    "superpoint": "mrasfm_engine.features.superpoint",
    "aliked": "mrasfm_engine.features.aliked",
    "xfeat": "mrasfm_engine.features.xfeat",
}
MATCHERS = {
    "nearest": "mrasfm_engine.matching.nearest_neighbour",
    "superglue": "mrasfm_engine.matching.superglue",
    "lightglue": "mrasfm_engine.matching.lightglue",
    "lighterglue": "mrasfm_engine.matching.lighterglue",
}


def _one_of(table: Mapping[str, str]) -> tuple[Any, Any]:
    def check(name: str) -> str:
        if name not in table:
            raise PydanticCustomError("literal_error", "Input should be {expected}", {"expected": _listed(table)})
        return name

    return AfterValidator(check), WithJsonSchema({"type": "string", "enum": list(table)})


def _listed(names: Iterable[str]) -> str:
    *others, last = (f"'{name}'" for name in names)
    return f"{', '.join(others)} or {last}"


ExtractorName = Annotated[str, *_one_of(EXTRACTORS)]
MatcherName = Annotated[str, *_one_of(MATCHERS)]
