"""Scenes of several drives become one map: `aggregate`."""

from mrasfm_engine.aggregation.pipeline import aggregate

__all__ = ["aggregate"]
