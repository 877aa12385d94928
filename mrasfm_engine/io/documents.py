"""Reads JSON documents from outside and turns their defects into errors that name file, field and remedy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel

from mrasfm_engine.errors import InputError
from schemas.parsing import MAX_MANIFEST_BYTES, DocumentError, parse_document

Model = TypeVar("Model", bound=BaseModel)


def read_bytes(path: Path, *, what: str, max_bytes: int = MAX_MANIFEST_BYTES) -> bytes:
    """The content of a regular file of at most `max_bytes`.

    Raises
    ------
    InputError
        If the file is missing, not a regular file, empty, too large or cannot be read.
    """
    try:
        if not path.is_file():
            state = "is not a file" if path.exists() else "does not exist"
            raise InputError(f"{what} {path} {state}", remedy="Check the path.", code="missing-file")
        size = path.stat().st_size
        if not 0 < size <= max_bytes:
            state = "is empty" if size == 0 else f"has {size / 1e6:.0f} MB, over the bound of {max_bytes / 1e6:.0f} MB"
            raise InputError(f"{what} {path} {state}", remedy="Write the file again.", code="bad-size")
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{what} {path} cannot be read: {error.strerror}", remedy="Check its permissions.") from error


def read_document(
    path: Path,
    model: type[Model],
    *,
    what: str,
    strict: bool = True,
    help_page: str = "",
    max_bytes: int = MAX_MANIFEST_BYTES,
) -> Model:
    """A pydantic model from a JSON file.

    Parameters
    ----------
    what
        What the file is, for messages: "drive manifest".
    strict
        Whether types must match exactly.
    help_page
        Where the format is described.

    Raises
    ------
    InputError
        That names the file, the fields at fault and what is wrong with them.
    """

    def parse(raw: bytes) -> Model:
        return parse_document(raw, model, strict=strict, max_bytes=max_bytes)

    return read_parsed(path, parse, what=what, help_page=help_page, max_bytes=max_bytes)


def read_parsed(
    path: Path,
    parse: Callable[[bytes], Model],
    *,
    what: str,
    help_page: str = "",
    max_bytes: int = MAX_MANIFEST_BYTES,
) -> Model:
    """As `read_document`, with what `parse` makes of the file's bytes; it raises DocumentError."""
    raw = read_bytes(path, what=what, max_bytes=max_bytes)
    try:
        return parse(raw)
    except DocumentError as error:
        fields = ", ".join(p.path for p in error.problems[:3] if p.path) or "the file"
        described = f"; {help_page} describes the format" if help_page else ""
        raise InputError(
            f"{what} {path}: {error}", remedy=f"Correct {fields}{described}.", code="bad-document"
        ) from None
