"""Aggregations: drives or scenes to a map, or to a new version of one."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field, StringConstraints

from schemas.api.jobs import ReconstructionSettings
from schemas.api.resource import EXAMPLE_DRIVE, EXAMPLE_MAP, EXAMPLE_OTHER_DRIVE, EXAMPLE_SCENE, Id, RequestBody
from schemas.drive import PRINTED_NAME

MAX_MEMBERS = 1000
MapName = Annotated[str, StringConstraints(min_length=1, max_length=200), PRINTED_NAME]


class AggregationRequest(RequestBody):
    """Drives or scenes that become one map, or are added to one and taken out of it."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "name": "crossing",
                    "drives": [EXAMPLE_DRIVE, EXAMPLE_OTHER_DRIVE],
                    "settings": {"use_gnss": True},
                },
                {
                    "map_id": EXAMPLE_MAP,
                    "scenes": [EXAMPLE_SCENE],
                    "remove": [EXAMPLE_OTHER_DRIVE],
                    "require_all": True,
                },
            ]
        }
    )

    drives: Annotated[list[Id], Field(max_length=MAX_MEMBERS)] = Field(
        default=[],
        description="committed drives; what is not reconstructed yet with these settings is reconstructed first",
    )
    scenes: Annotated[list[Id], Field(max_length=MAX_MEMBERS)] = Field(
        default=[], description="scenes that are taken as they are"
    )
    map_id: Id | None = Field(None, description="make a new version of this map from its current one; null: a new map")
    remove: Annotated[list[Id], Field(max_length=MAX_MEMBERS)] = Field(
        default=[], description="drives or scenes of the map's current version that the new one shall not have"
    )
    name: MapName | None = Field(None, description="of a new map; by default after its drives")
    settings: ReconstructionSettings = Field(
        default=ReconstructionSettings(), description="of the reconstructions, and of the aggregation where they apply"
    )
    require_all: bool = Field(
        False,
        description="fail where a drive cannot be reconstructed, or its scene or one of its smaller components cannot "
        "be placed in the map (components too small to be a scene are only named); by default the map is made of the "
        "others and says so",
    )
