"""Manifests that are sent: small ones are read here, large ones by a program that gives the memory back."""

from __future__ import annotations

import sys

from service.api.context import Context
from service.api.manifests.bounded_process import LARGE_BYTES
from service.api.manifests.manifest_check import Bounds, result_of
from service.api.manifests.reader import read, result_in
from service.domain.manifest_facts import ManifestFacts

_COMMAND = (sys.executable, "-P", "-m", "service.api.manifests.reader")
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
    command = [*_COMMAND, str(_MEMORY_MB), what]
    bounds = Bounds(memory_mb=_MEMORY_MB, timeout_s=_TIMEOUT_S)
    return result_of(command, result_in, bounds, size_bytes=len(raw), folder=folder, given=raw)
