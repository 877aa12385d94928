"""The check of a manifest before its drive is frozen.

It is the engine's own check, in the engine's own words, and runs in a process of its own: the API never imports the
engine, and a monstrous manifest can take down nothing but its own check.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import secrets
import signal
import subprocess
import sys
import threading
from pathlib import Path

from schemas.api.resource import Finding
from service.context import Context
from service.errors import ServiceError

log = logging.getLogger("mrasfm.api")

# -P: the working directory holds files from outside and is no place to import from.
_COMMAND = (sys.executable, "-P", "-m", "mrasfm_engine.commands.preflight", "--manifest-only", "--json")
_MEMORY_MB = 800  # 100,000 frames of 6 cameras take 700; hostile JSON unpacks to a hundred times its bytes
_TIMEOUT_S = 120
_LARGE_BYTES = 2_000_000
_one_large = threading.Lock()

# Of the environment the check gets what it runs with; the rest may hold the API's secrets.
_KEPT = frozenset({"PATH", "HOME", "USER", "LANG", "TZ", "LD_LIBRARY_PATH", "VIRTUAL_ENV"})
_KEPT_PREFIXES = ("LC_", "PYTHON", "PROJ_", "XDG_")
# How a process ends that is refused memory: by its own allocator, or by the system.
_OUT_OF_MEMORY = frozenset({-signal.SIGABRT, -signal.SIGSEGV, -signal.SIGKILL})


def checked_manifest(context: Context, key: str) -> list[Finding]:
    """Findings about the manifest that is stored under `key`.

    Raises
    ------
    ServiceError
        422 where the check takes too much memory or time, 503 where it cannot run.
    """
    folder = context.settings.spool_dir
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    path = folder / f"{secrets.token_hex(16)}.part"
    try:
        raw = context.artifacts.read(key)
        path.write_bytes(raw)
        with _one_large if len(raw) > _LARGE_BYTES else contextlib.nullcontext():
            return _findings(path)
    finally:
        path.unlink(missing_ok=True)


def _findings(path: Path) -> list[Finding]:
    done = _run(path)
    if done is None or done.returncode in _OUT_OF_MEMORY or b"MemoryError" in done.stderr:
        raise _too_costly()
    try:
        findings = [Finding.model_validate(finding) for finding in json.loads(done.stdout)["findings"]]
    except (ValueError, LookupError) as error:
        log.error("the check of a manifest failed", extra={"fields": {"exit": done.returncode, "log": _end(done)}})
        raise _unavailable() from error
    if any(finding.code == "bad-size" for finding in findings):
        raise _too_costly()
    return findings


def _run(path: Path) -> subprocess.CompletedProcess[bytes] | None:
    """The ended check; None where it took too long."""
    command = [*_COMMAND, "--max-memory-mb", str(_MEMORY_MB), str(path)]
    kept = {name: value for name, value in os.environ.items() if name in _KEPT or name.startswith(_KEPT_PREFIXES)}
    try:
        return subprocess.run(
            command,
            cwd=path.parent,
            env=kept,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=_TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return None
    except OSError as error:
        log.error("the check of a manifest cannot be started", exc_info=error)
        raise _unavailable() from error


def _end(done: subprocess.CompletedProcess[bytes]) -> str:
    return done.stderr[-2000:].decode(errors="replace")


def _too_costly() -> ServiceError:
    return ServiceError(
        422,
        "manifest-too-large",
        "The manifest is too large to be checked",
        f"the check of the manifest needs over {_MEMORY_MB} MB of memory or {_TIMEOUT_S} s",
        remedy="Split the drive in several.",
    )


def _unavailable() -> ServiceError:
    return ServiceError(
        503,
        "check-failed",
        "The check of the manifest did not answer",
        "the check of the manifest could not be run; why is in the service's log",
        remedy="Commit again in a minute; if it fails again, tell the operator.",
        headers={"Retry-After": "60"},
    )
