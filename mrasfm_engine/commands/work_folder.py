"""The folder in which a command keeps what it may need again."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mrasfm_engine.errors import StorageError


@contextmanager
def work_folder(out: Path | None, *, prefix: str) -> Iterator[Path]:
    """The given folder, made if need be; without one a temporary folder that goes away.

    Raises
    ------
    StorageError
        Where it cannot be written.
    """
    if out is None:
        with tempfile.TemporaryDirectory(prefix=prefix) as folder:
            yield Path(folder)
        return
    try:
        out.mkdir(parents=True, exist_ok=True)
        yield out
    except OSError as error:
        raise StorageError(
            f"{out} cannot be written: {error.strerror or error}", remedy="Give a folder that can be written."
        ) from error
