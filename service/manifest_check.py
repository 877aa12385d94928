"""The check of a manifest before its drive is frozen.

It is the engine's own check, in the engine's own words, and runs in a process of its own: the API never imports the
engine, and a monstrous manifest can take down nothing but its own check.
"""

from __future__ import annotations

import json
import secrets
import subprocess
import sys
import threading
from pathlib import Path

from schemas.api.common import Finding
from service.context import Context
from service.errors import ServiceError

_COMMAND = (sys.executable, "-m", "mrasfm_engine.commands.preflight", "--manifest-only", "--json")
_MEMORY_MB = 4000  # small JSON can unpack to a hundred times its bytes
_TIMEOUT_S = 120
_at_one_time = threading.BoundedSemaphore(2)


def checked_manifest(context: Context, key: str) -> list[Finding]:
    """Findings about the manifest that is stored under `key`.

    Raises
    ------
    ServiceError
        503 where the check does not answer.
    """
    folder = context.settings.spool_dir
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    path = folder / f"{secrets.token_hex(16)}.part"
    try:
        path.write_bytes(context.artifacts.read(key))
        with _at_one_time:
            return _findings(path)
    finally:
        path.unlink(missing_ok=True)


def _findings(path: Path) -> list[Finding]:
    try:
        command = [*_COMMAND, "--max-memory-mb", str(_MEMORY_MB), str(path)]
        done = subprocess.run(command, capture_output=True, timeout=_TIMEOUT_S, check=False)
        return [Finding.model_validate(finding) for finding in json.loads(done.stdout)["findings"]]
    except (subprocess.TimeoutExpired, ValueError, LookupError) as error:
        raise ServiceError(
            503,
            "check-failed",
            "The check of the manifest did not answer",
            f"the check of the manifest failed: {type(error).__name__}",
            remedy="Commit again in a minute; if it fails again, tell the operator.",
            headers={"Retry-After": "60"},
        ) from error
