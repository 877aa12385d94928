"""Prints how far a recording that rerun has converted is from its scene, as JSON: `read_rerun.py RECORDING SCENE`.

It runs in an environment of its own (`requirements.lock`), and knows nothing of this project but what `docs/outputs.md`
and `docs/exports.md` say. rerun keeps positions on the earth in double precision, all others in single.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rerun.chunk import RrdReader


def rows(recording: Path, topic: str) -> Iterator[dict[str, Any]]:
    """Messages of a topic, without those that describe it."""
    for chunk in RrdReader(str(recording)).stream():
        if chunk.entity_path == topic:
            for row in chunk.to_record_batch().to_pylist():
                if "message_log_time" in row:
                    yield row


def time_us(row: dict[str, Any]) -> int:
    stamp = row["message_log_time"]
    return round(stamp.value / 1000) if hasattr(stamp, "value") else round(np.datetime64(stamp, "us").astype(np.int64))


def relative(found: Any, expected: Any) -> float:
    """Largest difference, in parts of what it should be; of less than a metre in metres."""
    found, expected = np.asarray(found, dtype=np.float64), np.asarray(expected, dtype=np.float64)
    return float((np.abs(found - expected) / np.maximum(1.0, np.abs(expected))).max())


def main(recording: Path, scene: Path) -> dict[str, Any]:
    units = [unit for unit in json.loads((scene / "poses.json").read_text())["units"] if unit["registered"]]
    by_time = {unit["timestamp_us"]: unit for unit in units}
    transforms = [row for row in rows(recording, "/tf") if row["Transform3D:child_frame"] == ["rig"]]
    off, turned = 0.0, 0.0
    at_units = [(by_time[time_us(row)], row) for row in transforms if time_us(row) in by_time]
    for unit, row in at_units:
        pose = unit["world_from_rig"]
        off = max(off, relative(row["Transform3D:translation"][0], pose["translation_m"]))
        q, expected = np.array(row["Transform3D:quaternion"][0]), np.array(pose["rotation_xyzw"])
        turned = max(turned, float(np.abs(q * np.sign(q @ expected) - expected).max()))
    fixes = list(rows(recording, "/fix"))
    degrees = [
        np.abs(np.array(row["GeoPoints:positions"][0]) - [place["latitude_deg"], place["longitude_deg"]]).max()
        for row in fixes
        for place in [by_time[time_us(row)]["geodetic"]]
    ]
    (cloud,) = rows(recording, "/points")
    head, _, body = (scene / "points.ply").read_bytes().partition(b"end_header\n")
    kinds = {"float": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4"}
    fields = [line.split()[1:] for line in head.decode().splitlines() if line.startswith("property")]
    own = np.frombuffer(body, dtype=[(name, kinds[kind]) for kind, name in fields])
    points = np.stack([own[axis] for axis in "xyz"], -1)
    return {
        "units": len(at_units),
        "expected_units": len(units),
        "position_off": off,
        "quaternion_off": turned,
        "fixes": len(fixes),
        "degrees_off": float(max(degrees, default=0.0)),
        "points": len(cloud["Points3D:positions"]),
        "point_off": relative(cloud["Points3D:positions"], points),
    }


if __name__ == "__main__":
    print(json.dumps(main(Path(sys.argv[1]), Path(sys.argv[2]))))
