"""Trajectories in TUM's format: a line `timestamp tx ty tz qx qy qz qw` a pose, seconds and metres."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.types import Floats, Ints

REMEDY = (
    "Give one line 'timestamp tx ty tz qx qy qz qw' a pose: seconds, metres, unit quaternion; '#' starts a comment."
)
MAX_TIME_S = 2**62 // 1_000_000  # microseconds have 64 bits
MAX_POSITION_M = 1e9  # the earth's centre is 6.4e6 m away


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """Poses sorted by time."""

    timestamps_us: Ints  # (n,) strictly rising
    world_from_rig: Floats  # (n, 4, 4)


def format_tum(timestamps_us: Iterable[int], world_from_rig: Floats) -> str:
    """The text of a trajectory file: seconds with 6 decimals, metres, quaternions x y z w."""
    quaternions = se3.quaternion_from_rotation(world_from_rig[:, :3, :3])
    lines = ["# timestamp_s tx ty tz qx qy qz qw (world_from_rig)"]
    for time_us, pose, quaternion in zip(timestamps_us, world_from_rig, quaternions, strict=True):
        seconds, rest = divmod(int(time_us), 1_000_000)
        values = " ".join(f"{v:.9f}" for v in (*pose[:3, 3], *quaternion))
        lines.append(f"{seconds}.{rest:06d} {values}")
    return "\n".join(lines) + "\n"


def read_tum(path: Path) -> Trajectory:
    """Read a trajectory; lines may be in any order.

    Raises
    ------
    InputError
        Where the file cannot be read or a line is malformed, not finite or repeats a timestamp; it names the line.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise InputError(f"trajectory {path} does not exist", remedy="Check the path.") from error
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"trajectory {path} cannot be read as text: {error}", remedy=REMEDY) from error
    times: dict[int, int] = {}
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        content = line.split("#", 1)[0].replace(",", " ").split()
        if not content:
            continue
        try:
            time_us, row = _parse_line(content)
        except ValueError as error:
            raise InputError(f"{path}, line {number}: {error}", remedy=REMEDY) from error
        if time_us in times:
            raise InputError(
                f"{path}, line {number}: repeats the timestamp of an earlier line", remedy="Keep one pose an instant."
            )
        times[time_us] = number
        rows.append(row)
    timestamps_us = np.array(list(times), dtype=np.int64)
    values = np.array(rows, dtype=np.float64).reshape(-1, 7)
    order = np.argsort(timestamps_us)
    poses = se3.transform(se3.rotation_from_quaternion(values[:, 3:]), values[:, :3])
    return Trajectory(timestamps_us=timestamps_us[order], world_from_rig=poses[order])


def _parse_line(content: list[str]) -> tuple[int, list[float]]:
    if len(content) != 8:
        raise ValueError(f"{len(content)} values instead of 8")
    try:
        # Decimal keeps microseconds of epoch times that a float would round.
        time_s, row = Decimal(content[0]), [float(v) for v in content[1:]]
    except (InvalidOperation, ValueError):
        raise ValueError("not all values are numbers") from None
    if not time_s.is_finite() or not np.isfinite(row).all():
        raise ValueError("not all values are finite")
    if time_s.copy_abs() > MAX_TIME_S:
        raise ValueError(f"timestamp {time_s} is out of range")
    time_us = round(time_s * 1_000_000)
    if max(map(abs, row[:3])) > MAX_POSITION_M:
        raise ValueError(f"a position is over {MAX_POSITION_M:g} m from the origin")
    norm = float(np.linalg.norm(row[3:]))
    if abs(norm - 1) > 1e-2:
        raise ValueError(f"the quaternion's norm is {norm:.4g} instead of 1")
    return time_us, row
