"""A scene as arrays and a small document, for a file that it comes out of as it was."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.io.stage_store import Arrays
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.road import Road, RoadPoints, RoadSource, RoadSurface
from mrasfm_engine.scene.road_relief import Relief
from mrasfm_engine.scene.scene import (
    CalibrationObservability,
    CameraCalibration,
    Georeference,
    ImageFeatures,
    PairMatches,
    Scene,
)
from mrasfm_engine.types import Bools

# Whoever unpacks a scene has these, from where they came to it.
GIVEN = ("drive", "features", "pairs", "own_cars")
_KINDS: dict[str, Callable[..., object]] = {
    kind.__name__: kind
    for kind in (
        CalibrationObservability,
        CameraCalibration,
        Georeference,
        Relief,
        Road,
        RoadPoints,
        RoadSource,
        RoadSurface,
    )
}


def pack_scene(scene: Scene) -> tuple[Arrays, dict[str, Any]]:
    """Arrays by name, and what JSON can hold of all else in the scene but `GIVEN`."""
    arrays: Arrays = {}
    names = (field.name for field in fields(scene) if field.name not in GIVEN)
    return arrays, {name: _packed(getattr(scene, name), name, arrays) for name in names}


def unpack_scene(
    arrays: Mapping[str, NDArray[Any]],
    document: Mapping[str, Any],
    *,
    drive: Drive,
    features: Sequence[ImageFeatures],
    pairs: Sequence[PairMatches],
    own_cars: Sequence[Bools | None],
) -> Scene:
    """The scene that `pack_scene` packed, with what was given."""
    return Scene(
        drive=drive,
        features=list(features),
        pairs=list(pairs),
        own_cars=list(own_cars),
        **{name: _unpacked(value, arrays) for name, value in document.items()},
    )


def _packed(value: object, name: str, arrays: Arrays) -> Any:
    """The value as JSON holds it; its arrays are put aside under names that begin with its own."""
    if isinstance(value, np.ndarray):
        arrays[name] = value
        return {"array": name}
    if isinstance(value, Enum):
        return {"kind": type(value).__name__, "value": value.value}
    if is_dataclass(value) and not isinstance(value, type):
        parts = {f.name: _packed(getattr(value, f.name), f"{name}.{f.name}", arrays) for f in fields(value)}
        return {"kind": type(value).__name__, "fields": parts}
    if isinstance(value, list | tuple):
        return [_packed(part, f"{name}.{number}", arrays) for number, part in enumerate(value)]
    return value


def _unpacked(value: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    if isinstance(value, list):
        return [_unpacked(part, arrays) for part in value]
    if not isinstance(value, dict):
        return value
    if "array" in value:
        return arrays[value["array"]]
    kind = _KINDS[value["kind"]]
    if "value" in value:
        return kind(value["value"])
    return kind(**{name: _unpacked(part, arrays) for name, part in value["fields"].items()})
