"""The findings in a scene's report, for whoever waited for it."""

from __future__ import annotations

import json
from typing import Any

from pydantic import ValidationError

from schemas.api.resource import Finding
from schemas.api.scenes import SceneResource
from schemas.artifacts import REPORT_FILE
from service.client.api import Client

MAX_REPORT_BYTES = 1 << 27  # that of the longest drives has some megabytes


def scene_findings(client: Client, scene: SceneResource) -> list[Finding]:
    """Findings in a scene's report that a user should read; empty where there is no readable report.

    Raises
    ------
    ApiError
        Where the service refuses, as for a scene that was deleted meanwhile.
    UnreachableError
        Where the service does not answer.
    """
    file = next((file for file in scene.files if file.path == REPORT_FILE), None)
    if file is None or file.size_bytes > MAX_REPORT_BYTES:
        return []
    try:
        document: Any = json.loads(client.read_file(scene, file))
        return [Finding.model_validate(finding) for finding in document.get("findings", [])]
    except (ValueError, AttributeError, TypeError, ValidationError):
        return []
