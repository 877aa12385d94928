"""Writing of a page. A result is worth more than its page: one that fails is withheld and named."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from mrasfm_engine.errors import StorageError
from mrasfm_engine.export import comparisons
from mrasfm_engine.export.check import Check, ReadBack
from mrasfm_engine.export.file_contents import write_content
from mrasfm_engine.export.report_page._read_back import faults_of
from schemas.artifacts import REPORT_PAGE


def write_page(
    folder: Path, make: Callable[[], str], read_back: ReadBack, calibrations: Mapping[str, Mapping[str, Any]]
) -> list[str]:
    """Write `report.html` and read it back; why it is withheld, or nothing.

    `calibrations` are as `faults_of` takes them.

    Raises
    ------
    StorageError
        Where the disk is full or cannot be written.
    """
    path = folder / REPORT_PAGE
    try:
        read_back.expect({REPORT_PAGE: write_content(path, make())})
    except (OSError, StorageError):
        raise
    except Exception as error:
        return [f"{REPORT_PAGE} is withheld: it cannot be written: {type(error).__name__}: {error}"]

    def read(written: Path) -> list[str]:
        return list(faults_of(written, calibrations))

    fault = read_back.fault(Check(REPORT_PAGE, read, partial(comparisons.content, [])))
    if fault is None:
        return []
    path.unlink()
    return [f"{REPORT_PAGE} is withheld: it was written but does not read back: {fault}"]
