"""Manifests that are sent: small ones are read here, large ones by a program that gives the memory back."""

from __future__ import annotations

import logging
import sys

from service.bounded_process import LARGE_BYTES, TooCostlyError, end_of_log, run_on_document
from service.context import Context
from service.manifest_check import check_failed, manifest_too_large
from service.manifest_facts import ManifestFacts
from service.manifest_reader import read, result_in

log = logging.getLogger("mrasfm.api")

_COMMAND = (sys.executable, "-P", "-m", "service.manifest_reader")
_MEMORY_MB = 1000  # 100,000 frames of 6 cameras take 800
_TIMEOUT_S = 300  # it takes 15 of a core that it has for itself


def read_manifest(context: Context, raw: bytes, *, what: str) -> ManifestFacts:
    """The facts of a manifest.

    Parameters
    ----------
    what
        The bytes are, for the error.

    Raises
    ------
    ServiceError
        422 with all defects, or where it takes too much memory or time; 503 where it cannot be read.
    """
    if len(raw) <= LARGE_BYTES:
        return read(raw, what=what)
    folder = context.settings.spool_dir
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    try:
        command = [*_COMMAND, str(_MEMORY_MB), what]
        done = run_on_document(command, size_bytes=len(raw), folder=folder, timeout_s=_TIMEOUT_S, given=raw)
    except TooCostlyError:
        raise manifest_too_large(memory_mb=_MEMORY_MB, timeout_s=_TIMEOUT_S) from None
    except OSError as error:
        log.error("the reader of manifests cannot be started", exc_info=error)
        raise check_failed() from error
    try:
        return result_in(done.stdout)
    except (ValueError, LookupError) as error:
        fields = {"exit": done.returncode, "log": end_of_log(done)}
        log.error("the reader of manifests failed", extra={"fields": fields})
        raise check_failed() from error
