"""Writing of files with the digest of what was to be written, for the check before they are put in place."""

from __future__ import annotations

import hashlib
from pathlib import Path


def write_content(path: Path, *parts: str | bytes | memoryview) -> str:
    """Write a file, texts as UTF-8; SHA-256 of what was to be written, in hexadecimal.

    The digest is of the parts in memory, not of the file: whatever the disk makes of them is found when the file is
    read back.

    Raises
    ------
    OSError
        Where the disk is full or cannot be written.
    """
    digest = hashlib.sha256()
    with path.open("wb") as file:
        for part in parts:
            data = part.encode("utf-8") if isinstance(part, str) else part
            digest.update(data)
            file.write(data)
    return digest.hexdigest()


def sha256(path: Path) -> str:
    """Digest of a file of any size, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
