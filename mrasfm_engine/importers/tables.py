"""Readers of the plain text files that recordings come with: poses, times, GNSS samples."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict

from mrasfm_engine.errors import InputError
from mrasfm_engine.importers.recording import proper_transform
from mrasfm_engine.importers.unknown_fields import notes_of_unknown_fields
from mrasfm_engine.io.documents import read_bytes, read_document
from mrasfm_engine.types import Floats
from schemas import GnssSample
from schemas.drive import LAST_TIMESTAMP_US, MAX_GNSS_SAMPLES, Vector3
from schemas.manifest_check import MAX_FRAME_INTERVAL_US

GNSS_COLUMNS = (
    "timestamp_us",
    "latitude_deg",
    "longitude_deg",
    "ellipsoidal_height_m",
    "sigma_horizontal_m",
    "sigma_vertical_m",
)
MAX_TIME_S = 1e11  # since 1970: milliseconds are beyond this since 1973, seconds will be in three thousand years
_SMALLER_UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
ANTENNA_FILE = "gnss_antenna.json"


def read_lines(path: Path, *, what: str) -> list[str]:
    """The lines of a text file without empty ones at its end.

    Raises
    ------
    InputError
        If it is missing, empty, too large or not UTF-8.
    """
    try:
        lines = read_bytes(path, what=what).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise InputError(f"{what} {path} is not a text file", remedy="Save it as UTF-8 text.") from None
    while lines and not lines[-1].strip():
        lines.pop()
    return lines


def read_numbers(path: Path, *, what: str, columns: int) -> Floats:
    """A table (rows, columns) of finite numbers separated by blanks.

    Raises
    ------
    InputError
        That names the line that does not have that many numbers.
    """
    rows = []
    for number, line in enumerate(read_lines(path, what=what), start=1):
        try:
            row = [float(word) for word in line.split()]
        except ValueError:
            row = []
        if len(row) != columns or not all(map(math.isfinite, row)):
            raise InputError(
                f"{what} {path}, line {number}: {line[:60]!r} is not {columns} numbers",
                remedy=f"Give {columns} finite numbers separated by blanks on every line.",
                code="bad-table",
            )
        rows.append(row)
    return np.array(rows, dtype=np.float64).reshape(-1, columns)


def read_poses(path: Path, *, what: str, frames: list[int]) -> Floats:
    """Poses (frames, 4, 4) of the given frame numbers from a file with a 3x4 matrix, row by row, on every line.

    Raises
    ------
    InputError
        If a frame has no line or a line is no rigid transform.
    """
    table = read_numbers(path, what=what, columns=12)
    if max(frames) >= len(table):
        raise InputError(
            f"{what} {path} has {len(table)} lines, but there are images of frame {max(frames)}",
            remedy="Give one line for every frame, counted from 0, or remove the file.",
            code="missing-poses",
        )
    return np.stack([proper_transform(table[f].reshape(3, 4), what=f"{what} {path}, line {f + 1}") for f in frames])


def read_times(path: Path, *, frames: list[int]) -> list[int]:
    """Microseconds of the given frame numbers from a file with one time in seconds on every line.

    Raises
    ------
    InputError
        If a frame has no line, the times do not increase, or they are in another unit.
    """
    seconds = read_numbers(path, what="times", columns=1)[:, 0]
    if max(frames) >= len(seconds):
        raise InputError(
            f"times {path} has {len(seconds)} lines, but there are images of frame {max(frames)}",
            remedy="Give one time for every frame, counted from 0.",
            code="missing-times",
        )
    _require_seconds(seconds, frames, path)
    times_us = [round(float(seconds[f]) * 1e6) for f in frames]
    for before, after, frame in zip(times_us[:-1], times_us[1:], frames[1:], strict=True):
        if after <= before:
            raise InputError(
                f"times {path}, line {frame + 1}: {seconds[frame]:.6f} s does not come after the frame before it",
                remedy="Give increasing times in seconds.",
                code="times-not-increasing",
            )
    if times_us[0] < 0:
        raise InputError(f"times {path} has negative times", remedy="Give times in seconds from 0 on.")
    return times_us


def _require_seconds(seconds: Floats, frames: list[int], path: Path) -> None:
    """Refuse times whose steps are too long for a drive, or that are beyond any date: they are in a smaller unit."""
    longest_s = MAX_FRAME_INTERVAL_US / 1e6
    steps_s = np.diff(seconds[frames])
    median_s = float(np.median(steps_s)) if len(steps_s) else 0.0
    largest = int(np.argmax(np.abs(seconds)))
    if median_s > longest_s:
        line, what = frames[1], f"frames are {median_s:g} s apart"
        fitting = (unit for unit, each_s in _SMALLER_UNITS.items() if median_s * each_s <= longest_s)
    elif abs(seconds[largest]) > MAX_TIME_S:
        line, what = largest, f"{seconds[largest]:.0f} is no time in seconds"
        fitting = (unit for unit, each_s in _SMALLER_UNITS.items() if abs(seconds[largest]) * each_s <= MAX_TIME_S)
    else:
        return
    raise InputError(
        f"times {path}, line {line + 1}: {what}: they look like {next(fitting, 'another unit')}",
        remedy="Give times in seconds, one on every line, such as 0.1 or 1714730400.1.",
        code="bad-times",
    )


def read_gnss_csv(path: Path) -> list[GnssSample]:
    """GNSS samples from a table with the columns `GNSS_COLUMNS`, in any order, further ones ignored.

    Raises
    ------
    InputError
        That names the line and the column at fault.
    """
    lines = read_lines(path, what="GNSS file")
    remedy = f"Give a header and rows with the columns {','.join(GNSS_COLUMNS)}."
    header = _cells(lines[0]) if lines else []
    for name in GNSS_COLUMNS:
        if header.count(name) != 1:
            state = "no column" if name not in header else "more than one column"
            raise InputError(f"GNSS file {path}, line 1: has {state} {name!r}", remedy=remedy, code="bad-gnss-file")
    if len(lines) - 1 > MAX_GNSS_SAMPLES:
        raise InputError(f"GNSS file {path} has over {MAX_GNSS_SAMPLES} samples", remedy="Give only the drive's time.")
    if len(lines) < 2:
        raise InputError(f"GNSS file {path} has no samples", remedy=remedy, code="gnss-empty")
    samples = []
    for number, line in enumerate(lines[1:], start=2):
        row, where = _cells(line), f"GNSS file {path}, line {number}"
        if len(row) != len(header):
            raise InputError(
                f"{where}: has {len(row)} values, the header has {len(header)}", remedy=remedy, code="bad-gnss-file"
            )
        samples.append(_sample(dict(zip(header, row, strict=True)), where=where))
    return samples


def _cells(line: str) -> list[str]:
    """Numbers and names have no commas of their own, so that every line is a row."""
    return [cell.strip().strip('"') for cell in line.split(",")]


def _sample(row: dict[str, str], *, where: str) -> GnssSample:
    values = {name: _value(row[name], name, where=where) for name in GNSS_COLUMNS}
    return GnssSample(
        timestamp_us=int(row["timestamp_us"]),
        latitude_deg=values["latitude_deg"],
        longitude_deg=values["longitude_deg"],
        height_m=values["ellipsoidal_height_m"],
        sigma_horizontal_m=values["sigma_horizontal_m"],
        sigma_vertical_m=values["sigma_vertical_m"],
    )


# Column: lower and upper bound and what to say beyond them.
_BOUNDS = {
    "timestamp_us": (
        0,
        LAST_TIMESTAMP_US,
        "is not a time in microseconds up to the year 9999: are these nanoseconds?",
    ),
    "latitude_deg": (-90, 90, "is not a latitude (-90 to 90): are latitude and longitude swapped?"),
    "longitude_deg": (-180, 180, "is not a longitude (-180 to 180)"),
    "ellipsoidal_height_m": (-1000, 20000, "is not a height on the earth in metres"),
    "sigma_horizontal_m": (1e-6, 1e6, "must be a standard deviation above zero, in metres"),
    "sigma_vertical_m": (1e-6, 1e6, "must be a standard deviation above zero, in metres"),
}


def _value(text: str, column: str, *, where: str) -> float:
    remedy = "Correct this value, or remove the line."
    lower, upper, complaint = _BOUNDS[column]
    try:
        value: float = int(text) if column == "timestamp_us" else float(text)
    except ValueError:
        kind = "an integer number of microseconds" if column == "timestamp_us" else "a number"
        raise InputError(
            f"{where}, column {column}: {text[:40]!r} is not {kind}", remedy=remedy, code="bad-gnss-file"
        ) from None
    if isinstance(value, float) and not math.isfinite(value):
        raise InputError(
            f"{where}, column {column}: {text[:40]} is not a finite number", remedy=remedy, code="bad-gnss-file"
        )
    if not lower <= value <= upper:
        raise InputError(f"{where}, column {column}: {text[:40]} {complaint}", remedy=remedy, code="bad-gnss-file")
    return value


class _Antenna(BaseModel):
    model_config = ConfigDict(extra="allow", allow_inf_nan=False)

    antenna_in_body_m: Vector3


def read_antenna(path: Path) -> tuple[Floats, list[str]]:
    """Position (3,) of the antenna in the recording's body axes, and notes on fields that are not read.

    Raises
    ------
    InputError
        If the file is missing or malformed.
    """
    if not path.exists():
        raise InputError(
            f"the GNSS antenna's position is not known: {path} does not exist",
            remedy='Write it, as {"antenna_in_body_m": [x, y, z]} in the body axes of the calibration.',
            code="missing-antenna",
        )
    antenna = read_document(path, _Antenna, what="antenna position")
    unknown = antenna.model_extra or ()
    return np.array(antenna.antenna_in_body_m), notes_of_unknown_fields(path.name, unknown, known=_Antenna.model_fields)
