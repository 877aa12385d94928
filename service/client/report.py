"""The findings in a scene's report, for whoever waited for it."""

from __future__ import annotations

import json
from typing import Any
from urllib.parse import quote

from pydantic import ValidationError

from schemas.api.resource import Finding
from service.client.api import Client
from service.client.download import REPORT_NAME
from service.client.transport import TroubleError

MAX_REPORT_BYTES = 1 << 27  # that of the longest drives has some megabytes


def scene_findings(client: Client, scene_id: str) -> list[Finding]:
    """Findings in a scene's report that a user should read; empty where there is no readable report.

    Raises
    ------
    ApiError
        Where the service refuses, as for a scene that was deleted meanwhile.
    UnreachableError
        Where the service does not answer.
    """
    scene = client.scene(scene_id)
    file = next((file for file in scene.files if file.path == REPORT_NAME), None)
    if file is None or file.size_bytes > MAX_REPORT_BYTES:
        return []
    resource = f"/v1/scenes/{quote(scene_id, safe='')}"
    budget = client.retry_budget()
    while True:
        try:
            with client.open_file(resource, REPORT_NAME, sha256=file.sha256) as (_, pieces):
                data = b"".join(pieces)
            return _findings(data)
        except TroubleError as trouble:
            budget.pause(trouble)


def _findings(report: bytes) -> list[Finding]:
    try:
        document: Any = json.loads(report)
        return [Finding.model_validate(finding) for finding in document.get("findings", [])]
    except (ValueError, AttributeError, TypeError, ValidationError):
        return []
