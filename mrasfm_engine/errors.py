"""Errors whose message names the thing and the remedy."""

from __future__ import annotations

import errno
from pathlib import Path


class MrasfmError(Exception):
    """Root of all errors that a user can do something about.

    Parameters
    ----------
    what
        One sentence that names the file, field or stage, and what is wrong with it.
    remedy
        One sentence that says what to do.
    code
        Stable identifier in lower case with dashes, the same wherever the error shows up.
    """

    code = "error"

    def __init__(self, what: str, *, remedy: str, code: str | None = None) -> None:
        super().__init__(f"{what}\n  {remedy}")
        self.what = what
        self.remedy = remedy
        self.code = code or type(self).code


class InputError(MrasfmError):
    """The drive, its files or an argument is at fault; trying again does not help."""

    code = "bad-input"


class ReconstructionError(MrasfmError):
    """The drive is well-formed but could not be reconstructed."""

    code = "reconstruction-failed"


class CancelledError(MrasfmError):
    """Somebody asked to stop."""

    code = "cancelled"

    def __init__(self) -> None:
        super().__init__("the run was cancelled", remedy="Run it again: finished stages are reused.")


class TerminatedError(CancelledError):
    """SIGTERM asked to stop."""


class StorageError(MrasfmError):
    """The disk is full or cannot be written."""

    code = "storage"


def storage_error(path: Path, error: OSError) -> StorageError:
    """The error to raise when writing `path` failed."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return StorageError(f"no space left to write {path}", remedy="Free disk space, then run it again.")
    return StorageError(
        f"cannot write {path}: {error.strerror or error}", remedy="Check that the folder exists and may be written."
    )
