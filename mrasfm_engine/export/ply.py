"""`points.ply`: the scene's points with colour, track length, error, class, patch of the road and component."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mrasfm_engine.export.file_contents import write_content
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.scene.semantics import CLASS_NAMES

# float32 keeps half a millimetre to here; scenes that reach farther from their origin are written in double.
FLOAT32_LIMIT_M = 8000.0

PLY_TYPES = {"<f4": "float", "<f8": "double", "|u1": "uchar", "<i4": "int"}


def write_ply(scene: Scene, path: Path) -> str:
    """Write a binary little-endian PLY in the local frame; the SHA-256 of its content.

    Properties are x y z, red green blue, track_length, error_px, class (the header's comment names the numbers),
    road_patch, the index of the patch in `road.json` whose surface the point lies on, or -1, and component, the number
    of the component whose units observe the point.
    """
    n = len(scene.points_m)
    far = n > 0 and float(np.abs(scene.points_m).max()) > FLOAT32_LIMIT_M
    coordinate = "<f8" if far else "<f4"
    dtype = np.dtype(
        [(name, coordinate) for name in "xyz"]
        + [(name, "|u1") for name in ("red", "green", "blue")]
        + [("track_length", "<i4"), ("error_px", "<f4"), ("class", "|u1"), ("road_patch", "<i4")]
        + [("component", "<i4")]
    )
    rows = np.zeros(n, dtype=dtype)
    for k, name in enumerate("xyz"):
        rows[name] = scene.points_m[:, k]
    for k, name in enumerate(("red", "green", "blue")):
        rows[name] = scene.point_colors[:, k]
    rows["track_length"] = np.bincount(scene.observation_point, minlength=n)
    rows["error_px"] = scene.point_error_px
    rows["class"] = scene.point_classes
    rows["road_patch"] = scene.point_patches
    rows["component"] = scene.point_component
    assert dtype.names is not None
    properties = "".join(f"property {PLY_TYPES[dtype[name].str]} {name}\n" for name in dtype.names)
    classes = ", ".join(f"{code} {name}" for code, name in CLASS_NAMES.items())
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment metres in the local frame of frame.json\n"
        f"comment class: {classes}\ncomment road_patch: index into road.json's patches, -1 off the road\n"
        "comment component: as report.json numbers a scene's and map.json a map's, 0 the largest\n"
        f"element vertex {n}\n{properties}end_header\n"
    )
    return write_content(path, header, rows.view(np.uint8).data)
