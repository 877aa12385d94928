"""Engine settings that a request may set."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from mrasfm_engine.config import EngineConfig, described
from mrasfm_engine.errors import InputError

# Name in the API's ReconstructionSettings -> section of the engine's (None: none) and name there.
_PLACES: dict[str, tuple[str | None, str]] = {
    "use_gnss": (None, "use_gnss"),
    "seed": (None, "seed"),
    "max_keypoints": ("features", "max_keypoints"),
    "max_side_px": ("features", "max_side_px"),
    "refine_calibration": ("bundle_adjustment", "refine_calibration"),
    "refine_focal": ("bundle_adjustment", "refine_focal"),
    "extractor": ("features", "extractor"),
    "matcher": ("matching", "matcher"),
    "segmentation_model": ("semantics", "model"),
    "semantic_triangulation": ("mapping", "semantic_triangulation"),
    "submaps": ("submaps", "count"),
    "motion_compensation": ("mapping", "motion_compensation"),
}


def engine_config(settings: Mapping[str, Any], *, threads: int) -> EngineConfig:
    """The engine's settings for a request's; what is missing or None keeps the engine's default.

    Raises
    ------
    InputError
        Where a setting is unknown or out of range.
    """
    values: dict[str, Any] = {"threads": threads}
    for name, value in settings.items():
        if name not in _PLACES:
            raise InputError(f"settings.{name} is not known", remedy="Leave it out.", code="bad-settings")
        if value is not None:
            section, field = _PLACES[name]
            (values if section is None else values.setdefault(section, {}))[field] = value
    try:
        return EngineConfig.model_validate(values)
    except ValidationError as problem:
        raise InputError(
            f"settings: {described(problem)}", remedy="Give values in their ranges.", code="bad-settings"
        ) from problem
