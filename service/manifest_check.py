"""The check of a manifest before its drive is frozen.

It is the engine's own check, in the engine's own words, and runs in a process of its own: the API never imports the
engine.
"""

from __future__ import annotations

import json
import logging
import secrets
import sys
from pathlib import Path

from schemas.api.resource import Finding
from service.bounded_process import TooCostlyError, end_of_log, run_on_document
from service.context import Context
from service.errors import ServiceError, store_unavailable

log = logging.getLogger("mrasfm.api")

# -P: the working directory holds files from outside and is no place to import from.
_COMMAND = (sys.executable, "-P", "-m", "mrasfm_engine.commands.preflight", "--manifest-only", "--json")
_MEMORY_MB = 800  # 100,000 frames of 6 cameras take 700; hostile JSON unpacks to a hundred times its bytes
_TIMEOUT_S = 120


def stored_manifest(context: Context, key: str) -> bytes:
    """The manifest that is stored under `key`.

    Raises
    ------
    ServiceError
        503 where the store misses it.
    """
    try:
        return context.artifacts.read(key)
    except FileNotFoundError:
        raise store_unavailable() from None


def checked_manifest(context: Context, key: str) -> list[Finding]:
    """Findings about the manifest that is stored under `key`.

    Raises
    ------
    ServiceError
        422 where the check takes too much memory or time, 503 where it cannot run or the store misses the manifest.
    """
    folder = context.settings.spool_dir
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    path = folder / f"{secrets.token_hex(16)}.part"
    try:
        raw = stored_manifest(context, key)
        path.write_bytes(raw)
        return _findings(path, len(raw))
    finally:
        path.unlink(missing_ok=True)


def _findings(path: Path, size_bytes: int) -> list[Finding]:
    command = [*_COMMAND, "--max-memory-mb", str(_MEMORY_MB), str(path)]
    try:
        done = run_on_document(command, size_bytes=size_bytes, folder=path.parent, timeout_s=_TIMEOUT_S)
    except TooCostlyError:
        raise manifest_too_large(memory_mb=_MEMORY_MB, timeout_s=_TIMEOUT_S) from None
    except OSError as error:
        log.error("the check of a manifest cannot be started", exc_info=error)
        raise check_failed() from error
    try:
        findings = [Finding.model_validate(finding) for finding in json.loads(done.stdout)["findings"]]
    except (ValueError, LookupError) as error:
        fields = {"exit": done.returncode, "log": end_of_log(done)}
        log.error("the check of a manifest failed", extra={"fields": fields})
        raise check_failed() from error
    if any(finding.code == "bad-size" for finding in findings):
        raise manifest_too_large(memory_mb=_MEMORY_MB, timeout_s=_TIMEOUT_S)
    return findings


def manifest_too_large(*, memory_mb: float, timeout_s: float) -> ServiceError:
    """422: what is done to a manifest before it is taken costs too much."""
    return ServiceError(
        422,
        "manifest-too-large",
        "The manifest is too large to be checked",
        f"the check of the manifest needs over {memory_mb} MB of memory or {timeout_s} s",
        remedy="Split the drive in several.",
    )


def check_failed() -> ServiceError:
    """503: a manifest could not be looked at."""
    return ServiceError(
        503,
        "check-failed",
        "The check of the manifest did not answer",
        "the check of the manifest could not be run; why is in the service's log",
        remedy="Repeat the request in a minute; if it fails again, tell the operator.",
        headers={"Retry-After": "60"},
    )
