"""The check of a manifest before its drive is frozen: `schemas.manifest_check`, in a process of its own."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from schemas.api.resource import Finding
from service.api.context import Context
from service.api.manifests.bounded_process import TooCostlyError, end_of_log, run_on_document
from service.errors import CheckFailed, ManifestTooLarge, ServiceError, store_unavailable

log = logging.getLogger("mrasfm.api")

Result = TypeVar("Result")

# -P: the working directory holds files from outside and is no place to import from.
_COMMAND = (sys.executable, "-P", "-m", "schemas.manifest_check")
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
    raw = stored_manifest(context, key)
    bounds = Bounds(memory_mb=_MEMORY_MB, timeout_s=_TIMEOUT_S)
    return result_of([*_COMMAND, str(_MEMORY_MB)], _findings_in, bounds, size_bytes=len(raw), folder=folder, given=raw)


def _findings_in(output: bytes) -> list[Finding]:
    return [Finding.model_validate(finding) for finding in json.loads(output)["findings"]]


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """Bounds of a program that reads a manifest. Its time is bounded here, its memory by itself."""

    memory_mb: float
    timeout_s: float


def result_of(
    command: Sequence[str],
    read: Callable[[bytes], Result],
    bounds: Bounds,
    *,
    size_bytes: int,
    folder: Path,
    given: bytes = b"",
) -> Result:
    """Run a program on a manifest and read its output; other parameters are those of `run_on_document`.

    Parameters
    ----------
    read
        Raises ValueError or LookupError where the program came to no end.

    Raises
    ------
    ServiceError
        422 where it takes too much memory or time, 503 where it cannot run, and what `read` raises.
    """
    try:
        done = run_on_document(command, size_bytes=size_bytes, folder=folder, timeout_s=bounds.timeout_s, given=given)
    except TooCostlyError:
        raise _too_large(bounds) from None
    except OSError as error:
        log.error("a program that reads manifests cannot be started", exc_info=error)
        raise _check_failed() from error
    try:
        return read(done.stdout)
    except (ValueError, LookupError) as error:
        fields = {"exit": done.returncode, "log": end_of_log(done)}
        log.error("a program that reads manifests failed", extra={"fields": fields})
        raise _check_failed() from error


def _too_large(bounds: Bounds) -> ServiceError:
    return ManifestTooLarge(
        f"the check of the manifest needs over {bounds.memory_mb} MB of memory or {bounds.timeout_s} s",
        remedy="Split the drive in several.",
    )


def _check_failed() -> ServiceError:
    return CheckFailed(
        "the check of the manifest could not be run; why is in the service's log",
        remedy="Repeat the request in a minute; if it fails again, tell the operator.",
        headers={"Retry-After": "60"},
    )
