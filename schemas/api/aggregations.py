"""Aggregations: drives or scenes to a map, or to a new version of one."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field, StringConstraints

from schemas.api.jobs import DriveId, ReconstructionSettings
from schemas.api.resource import RequestBody

MAX_MEMBERS = 1000
SceneId = Annotated[str, StringConstraints(pattern=r"^[a-z0-9_]{1,40}$")]
MapId = Annotated[str, StringConstraints(pattern=r"^[a-z0-9_]{1,40}$")]
MapName = Annotated[str, StringConstraints(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f-\x9f]+$")]


class AggregationRequest(RequestBody):
    """Which drives or scenes become one map, or are added to one and taken out of it."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "name": "crossing",
                    "drives": ["drv_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c", "drv_77aa0c2a9d3b7e4f5a6c8d9e0f1a2b"],
                    "settings": {"use_gnss": True},
                },
                {
                    "map_id": "map_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c",
                    "scenes": ["scn_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c"],
                    "remove": ["drv_77aa0c2a9d3b7e4f5a6c8d9e0f1a2b"],
                    "require_all": True,
                },
            ]
        }
    )

    drives: Annotated[list[DriveId], Field(max_length=MAX_MEMBERS)] = Field(
        default=[],
        description="committed drives; what is not reconstructed yet with these settings is reconstructed first",
        examples=[["drv_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c"]],
    )
    scenes: Annotated[list[SceneId], Field(max_length=MAX_MEMBERS)] = Field(
        default=[],
        description="scenes that are taken as they are",
        examples=[["scn_1f0c2a9d3b7e4f5a6c8d9e0f1a2b3c"]],
    )
    map_id: MapId | None = Field(
        None, description="make a new version of this map from its current one; null: a new map", examples=[None]
    )
    remove: Annotated[list[DriveId], Field(max_length=MAX_MEMBERS)] = Field(
        default=[], description="drives or scenes of the map's current version that the new one shall not have"
    )
    name: MapName | None = Field(None, description="of a new map; by default after its drives", examples=["crossing"])
    settings: ReconstructionSettings = Field(
        default=ReconstructionSettings(), description="of the reconstructions, and of the aggregation where they apply"
    )
    require_all: bool = Field(
        False,
        description="fail where a drive cannot be reconstructed; by default the map is made of the others and says so",
    )
