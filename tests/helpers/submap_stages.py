"""Stages of sub-maps as a scene's report has them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from schemas.artifacts import submap_checkpoint


def stages_run_in_join(report: Mapping[str, Any]) -> list[str]:
    """Names of the stages of sub-maps that the join had to do itself."""
    return [
        submap_checkpoint(submap["number"], stage["stage"])
        for submap in report["submaps"]
        for stage in submap["stages"]
        if not stage["reused"]
    ]
