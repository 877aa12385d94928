"""Comparison of `autoware/` with the scene, for the check before it is put in place."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer

from mrasfm_engine.export.autoware import PROJECTOR, projector_text
from mrasfm_engine.export.comparisons import Row, Rows
from mrasfm_engine.export.rig_files_readback import parsed_yaml
from mrasfm_engine.scene.scene import Scene

FLOAT32_STEPS = 2.0**-22  # of a coordinate's size: its rounding along each of three axes
PROJECTION_TOLERANCE_M = 1e-5  # degrees are written with 15 decimals


def read_pcd(path: Path) -> tuple[list[str], NDArray[Any], str]:
    """Lines of the header, points with colours, and the text of the projection beside it."""
    head, _, body = path.read_bytes().partition(b"DATA binary\n")
    rows = np.frombuffer(body, dtype=[("place", "<f4", 3), ("color", "<u4")])
    return (
        head.decode("ascii").removesuffix("\n").split("\n"),
        rows,
        (path.parent / PROJECTOR).read_bytes().decode("ascii"),
    )


def pcd(scene: Scene, found: tuple[list[str], NDArray[Any], str]) -> Rows:
    """Every point and colour, and the points' places on the earth as the projection has them."""
    place, (header, rows, projector) = scene.georeference, found
    assert place is not None
    count = len(scene.points_m)
    fields = {line.split(" ")[0]: line.split(" ")[1:] for line in header[1:]}
    expected = {
        "VERSION": ["0.7"], "FIELDS": ["x", "y", "z", "rgb"], "SIZE": ["4"] * 4, "TYPE": ["F"] * 4, "COUNT": ["1"] * 4,
        "WIDTH": [str(count)], "HEIGHT": ["1"], "VIEWPOINT": [*"0001000"], "POINTS": [str(count)],
    }  # fmt: skip
    yield Row("its header", fields, expected)
    yield Row("its first line", header[0], "# .PCD v0.7 - Point Cloud Data file format")
    yield Row("its number of points", len(rows), count)
    raised = np.array([0.0, 0.0, place.origin_ellipsoidal_height_m])
    yield Row("a point", rows["place"], (scene.points_m + raised).astype(np.float32))
    red, green, blue = scene.point_colors.T.astype(np.uint32)
    yield Row("a colour", rows["color"], (red << 16) + (green << 8) + blue)
    origin = parsed_yaml(projector)["map_origin"]
    to_ecef = Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 "
        f"+lat_0={origin['latitude']!r} +lon_0={origin['longitude']!r} +h_0={origin['altitude']!r}"
    )
    points_m = rows["place"].astype(np.float64)
    ecef = scene.points_m @ place.ecef_from_local[:3, :3].T + place.ecef_from_local[:3, 3]
    tolerance_m = float(np.abs(points_m).max(initial=0.0)) * FLOAT32_STEPS + PROJECTION_TOLERANCE_M
    yield Row("a point's place on the earth", np.stack(to_ecef.transform(*points_m.T), -1), ecef, tolerance_m)


def projector(scene: Scene, text: str) -> Rows:
    """The projection, to the last digit; that it is the right one shows in the points."""
    yield Row("its text", text, projector_text(scene))
    found = parsed_yaml(text)
    yield Row("the projection", (found["projector_type"], found["vertical_datum"]), ("LocalCartesian", "WGS84"))
    yield Row("the origin's altitude", found["map_origin"]["altitude"], 0.0)
