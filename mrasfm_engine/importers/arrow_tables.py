"""Tables of Apache Arrow (Feather, Parquet), which some data sets come as; pyarrow is an extra."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.importers.recording import proper_transform
from mrasfm_engine.types import Floats
from schemas.drive import LAST_TIMESTAMP_US, MAX_COORDINATE_M

MAX_BYTES = 20_000_000_000  # images of a segment of Waymo are 1 to 2 GB, and are read row by row
MAX_INTEGER = 2**62  # with room to round in 64 bits; nanoseconds of the year 2116
MAX_SECONDS = LAST_TIMESTAMP_US / 1e6
EXTRA = "av2"
_TOO_FAR = f"holds a coordinate beyond {MAX_COORDINATE_M:g} m"


def arrow(module: str) -> Any:
    """A module of pyarrow.

    Raises
    ------
    InputError
        If it is not installed.
    """
    import importlib

    try:
        return importlib.import_module(f"pyarrow.{module}")
    except ModuleNotFoundError:
        raise InputError(
            "this recording has tables of Apache Arrow, and pyarrow is not installed",
            remedy=f"Install the extra: pip install 'mrasfm[{EXTRA}]'.",
            code="missing-extra",
        ) from None


class Columns:
    """Columns of a table as arrays; a defect is named with the file and the column.

    Parameters
    ----------
    table
        A table of pyarrow.
    source
        What messages call it.
    """

    def __init__(self, table: Any, source: str) -> None:
        self._table, self.source = table, source

    def __len__(self) -> int:
        return int(self._table.num_rows)

    def numbers(self, *names: str) -> Floats:
        """Values (rows, names) of columns of numbers.

        Raises
        ------
        InputError
            If a column is missing or holds something else than finite numbers.
        """
        columns = []
        for name in names:
            values = self._values(name)
            try:
                column = np.array(values, dtype=np.float64)
            except (TypeError, ValueError):
                column = np.full(len(values), np.nan)
            if column.shape != (len(values),) or not np.isfinite(column).all():
                raise self._defect(name, "holds a value that is no finite number")
            columns.append(column)
        return np.stack(columns, -1)

    def seconds(self, *names: str) -> Floats:
        """Values (rows, names) of columns of times in seconds since 1970.

        Raises
        ------
        InputError
            If a column is missing or holds something else.
        """
        found = self.numbers(*names)
        for name, column in zip(names, found.T, strict=True):
            if not ((column >= 0) & (column <= MAX_SECONDS)).all():
                raise self._defect(name, "holds a time that is no number of seconds from 1970 to the year 9999")
        return found

    def integers(self, name: str) -> list[int]:
        """Values of a column of integers.

        Raises
        ------
        InputError
            If it is missing or holds something else.
        """
        values = self._values(name)
        if not all(isinstance(value, int) and abs(value) <= MAX_INTEGER for value in values):
            raise self._defect(name, f"holds a value that is no integer up to {MAX_INTEGER}")
        return values

    def texts(self, name: str) -> list[str]:
        """Values of a column of texts.

        Raises
        ------
        InputError
            If it is missing or holds something else.
        """
        values = self._values(name)
        if not all(isinstance(value, str) for value in values):
            raise self._defect(name, "holds a value that is no text")
        return values

    def contents(self, name: str) -> list[bytes]:
        """Values of a column of bytes.

        Raises
        ------
        InputError
            If it is missing or holds something else.
        """
        values = self._values(name)
        if not all(isinstance(value, bytes) for value in values):
            raise self._defect(name, "holds a value without bytes")
        return values

    def poses(self, quaternion: Sequence[str], translation: Sequence[str]) -> Floats:
        """Transforms (rows, 4, 4) of columns w, x, y, z and x, y, z.

        Raises
        ------
        InputError
            If a quaternion is not of norm 1, or a translation beyond all bounds.
        """
        w_first, t = self.numbers(*quaternion), self.numbers(*translation)
        if len(w_first) and abs(np.linalg.norm(w_first, axis=1) - 1.0).max() > 1e-3:
            raise self._defect(", ".join(quaternion), "holds a quaternion that is not of norm 1")
        if (np.abs(t) > MAX_COORDINATE_M).any():
            raise self._defect(", ".join(translation), _TOO_FAR)
        return se3.transform(se3.rotation_from_quaternion(w_first[:, [1, 2, 3, 0]]), t)

    def matrices(self, name: str) -> Floats:
        """Transforms (rows, 4, 4) of a column of lists of 16 numbers, row by row.

        Raises
        ------
        InputError
            If one is no rigid transform, or leads beyond all bounds.
        """
        found = []
        for row, value in enumerate(self._values(name)):
            where = f"{self.source}, row {row}: {name}"
            if not isinstance(value, list) or len(value) != 16 or not all(isinstance(v, float | int) for v in value):
                raise self._defect(name, f"row {row} is not 16 numbers")
            matrix = proper_transform(np.array(value, dtype=np.float64).reshape(4, 4), what=where)
            if (np.abs(matrix[:3, 3]) > MAX_COORDINATE_M).any():
                raise self._defect(name, f"row {row} {_TOO_FAR}")
            found.append(matrix)
        return np.stack(found) if found else np.empty((0, 4, 4))

    def _values(self, name: str) -> list[Any]:
        if name not in self._table.column_names:
            raise self._defect(name, "is not there")
        values: list[Any] = self._table.column(name).to_pylist()
        return values

    def _defect(self, column: str, what: str) -> InputError:
        return InputError(
            f"{self.source}, column {column}: {what}", remedy="Download the file again.", code="bad-table"
        )


def read_feather(path: Path) -> Columns:
    """A Feather file.

    Raises
    ------
    InputError
        If it is missing, too large or no Feather file.
    """
    feather = arrow("feather")
    require_file(path)
    try:
        return Columns(feather.read_table(path, memory_map=False), str(path))
    except (arrow("lib").ArrowException, OSError, ValueError) as error:
        said = " ".join(str(error).split())[:200]
        raise InputError(
            f"table {path} cannot be read: {said}", remedy="Download it again.", code="bad-table"
        ) from None


def read_parquet(path: Path, columns: Sequence[str]) -> Columns:
    """Some columns of a Parquet file; those that it lacks are named where they are asked for.

    Raises
    ------
    InputError
        If it is missing, too large or no Parquet file.
    """
    with _parquet_file(path) as file:
        known = [name for name in columns if name in file.schema_arrow.names]
        return Columns(file.read(columns=known), str(path))


def parquet_batches(path: Path, columns: Sequence[str], rows: int) -> Iterator[Columns]:
    """The same, some rows at a time."""
    with _parquet_file(path) as file:
        for batch in file.iter_batches(batch_size=rows, columns=list(columns)):
            yield Columns(arrow("lib").Table.from_batches([batch]), str(path))


@contextmanager
def _parquet_file(path: Path) -> Iterator[Any]:
    parquet = arrow("parquet")
    require_file(path)
    try:
        with parquet.ParquetFile(path) as file:
            yield file
    except (arrow("lib").ArrowException, OSError, ValueError) as error:
        said = " ".join(str(error).split())[:200]
        raise InputError(f"table {path}: {said}", remedy="Download it again.", code="bad-table") from None


def require_file(path: Path) -> None:
    """Refuse a table that is missing or too large.

    Raises
    ------
    InputError
        That names it.
    """
    if not path.is_file():
        raise InputError(f"table {path} does not exist", remedy="Download the recording again.", code="missing-file")
    if path.stat().st_size > MAX_BYTES:
        raise InputError(f"table {path} has over {MAX_BYTES / 1e9:g} GB", remedy="Give one log's.", code="bad-size")
