"""`mrasfm describe service`: the environment variables of the service."""

from __future__ import annotations

from service.settings import Settings


def service_variables() -> str:
    """All variables with their defaults, as a file of environment variables; each is a comment until it is set."""
    blocks = []
    for name, field in Settings.model_fields.items():
        default = "" if field.default is None else field.default
        blocks.append(f"# {field.description}\n#MRASFM_{name.upper()}={default}\n")
    return "".join(blocks)
