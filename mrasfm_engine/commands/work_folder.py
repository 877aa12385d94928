"""The folder in which a command keeps what it may need again, and its result as a document."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mrasfm_engine.errors import storage_error


@contextmanager
def work_folder(out: Path | None, *, prefix: str) -> Iterator[Path]:
    """The given folder, made if need be; without one a temporary folder that goes away.

    Raises
    ------
    StorageError
        Where it cannot be made.
    """
    if out is None:
        with tempfile.TemporaryDirectory(prefix=prefix) as folder:
            yield Path(folder)
        return
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise storage_error(out, error) from error
    yield out


def write_document(document: dict[str, Any], path: Path) -> None:
    """Write a result as JSON.

    Raises
    ------
    StorageError
        Where that is impossible.
    """
    try:
        path.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise storage_error(path, error) from error
