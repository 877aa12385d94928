"""`points.ply`: the scene's points with colour, track length and reprojection error."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mrasfm_engine.scene.scene import Scene

# float32 keeps half a millimetre to here; scenes that reach farther from their origin are written in double.
FLOAT32_LIMIT_M = 8000.0

PLY_TYPES = {"<f4": "float", "<f8": "double", "|u1": "uchar", "<i4": "int"}


def write_ply(scene: Scene, path: Path) -> None:
    """Write a binary little-endian PLY in the local frame: x y z, red green blue, track_length, error_px."""
    n = len(scene.points_m)
    far = n > 0 and float(np.abs(scene.points_m).max()) > FLOAT32_LIMIT_M
    coordinate = "<f8" if far else "<f4"
    dtype = np.dtype(
        [(name, coordinate) for name in "xyz"]
        + [(name, "|u1") for name in ("red", "green", "blue")]
        + [("track_length", "<i4"), ("error_px", "<f4")]
    )
    rows = np.zeros(n, dtype=dtype)
    for k, name in enumerate("xyz"):
        rows[name] = scene.points_m[:, k]
    for k, name in enumerate(("red", "green", "blue")):
        rows[name] = scene.point_colors[:, k]
    rows["track_length"] = np.bincount(scene.observation_point, minlength=n)
    rows["error_px"] = scene.point_error_px
    assert dtype.names is not None
    properties = "".join(f"property {PLY_TYPES[dtype[name].str]} {name}\n" for name in dtype.names)
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment metres in the local frame of frame.json\n"
        f"element vertex {n}\n{properties}end_header\n"
    )
    with path.open("wb") as file:
        file.write(header.encode("ascii"))
        file.write(rows.tobytes())
