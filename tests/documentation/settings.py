"""The page of all settings, from the pydantic models of the engine and of the service."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import BaseModel

from mrasfm_engine.config import EngineConfig
from service.settings import Settings
from tests.documentation.tables import table

PREAMBLE = """<!-- Made from the settings' models by make docs: change the models, not this page. -->

# Configuration

## The engine

`--config FILE` takes TOML. A setting that the file leaves out keeps its default; an unknown name is an error.
`mrasfm describe settings` prints a file with all settings and their defaults.

```toml
threads = 8
seed = 0

[features]
max_keypoints = 2048       # per image

[pairs]
pairs_per_image = 16       # with GNSS or rough poses
max_depth_m = 50.0         # reach of the viewing frustums

[mapping]
keyframe_motion_px = 2.0   # units that moved less are registered in the finished scene
motion_compensation = true # cameras that are not simultaneous, and rolling shutters
pose_observations = 400    # of an image, for its pose while the scene grows; 0: all

[bundle_adjustment]
refine_calibration = true  # where motion or GNSS make it observable
sigma_rotation_deg = 2.0   # prior of rig_from_cam where the manifest declares none
sigma_translation_m = 0.05

[gnss]
outlier_sigmas = 4.0
```
"""

SERVICE = """
## The service

API, workers and reconciler read environment variables. Every setting has a default that suits one machine; production
sets `MRASFM_DATABASE_URL`, `MRASFM_ARTIFACTS_URL` and `MRASFM_REDIS_URL`. No setting has a default secret.
`mrasfm describe service` prints them.
"""


def settings_page() -> str:
    """Every setting with its default, range and meaning, as Markdown."""
    schema = EngineConfig.model_json_schema()
    parts = [PREAMBLE, "\n### Top level\n\n"]
    fields = EngineConfig.model_fields
    sections = {name: kind for name, field in fields.items() if _is_section(kind := field.annotation)}
    parts.append(_fields({name: form for name, form in schema["properties"].items() if name not in sections}))
    for name, section in sections.items():
        parts.append(f"\n### `[{name}]`\n\n{section.__doc__}\n\n")
        parts.append(_fields(section.model_json_schema()["properties"]))
    variables = Settings.model_json_schema()["properties"]
    parts += [SERVICE, "\n", _fields(variables, prefix="MRASFM_")]
    return "".join(parts)


def _is_section(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _fields(properties: Mapping[str, Mapping[str, Any]], *, prefix: str = "") -> str:
    rows = [
        [f"`{prefix}{name.upper() if prefix else name}`", _default(form), ", ".join(_range(form)), form["description"]]
        for name, form in properties.items()
    ]
    return table(["setting", "default", "range", "meaning"], rows)


def _default(form: Mapping[str, Any]) -> str:
    default = form.get("default")
    return "" if default is None else f"`{str(default).lower() if isinstance(default, bool) else default}`"


def _range(form: Mapping[str, Any]) -> Iterator[str]:
    for kind in form.get("anyOf", [form]):
        if "enum" in kind:
            yield " ".join(f"`{value}`" for value in kind["enum"])
        if kind.get("type") == "boolean":
            yield "`true` `false`"
        for keyword, sign in (
            ("minimum", ">="),
            ("exclusiveMinimum", ">"),
            ("maximum", "<="),
            ("exclusiveMaximum", "<"),
        ):
            if keyword in kind:
                bound = kind[keyword]
                yield f"{sign} {bound:g}" if isinstance(bound, float) else f"{sign} {bound}"
