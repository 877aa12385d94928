"""Comparison of `autoware/` with the scene, for the check before it is put in place."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer

from mrasfm_engine.export.autoware import PROJECTOR, projector_text
from mrasfm_engine.export.comparisons import Row, Rows
from mrasfm_engine.export.rig_files_readback import parsed_yaml
from mrasfm_engine.scene.scene import Scene

BATCH = 500_000  # points that are in memory at one time
MAX_HEADER_BYTES = 1000
_POINT = np.dtype([("place", "<f4", 3), ("color", "<u4")])
FLOAT32_STEPS = 2.0**-22  # of a coordinate's size: its rounding along each of three axes
PROJECTION_TOLERANCE_M = 1e-5  # degrees are written with 15 decimals


class PcdFile(NamedTuple):
    """Everything that the file holds but its points, which are read in blocks."""

    path: Path
    header: list[str]  # its lines
    points_at: int
    points_bytes: int
    projector: str  # text of the projection beside it

    def points(self) -> Iterator[NDArray[Any]]:
        """Points with colours, some at one time."""
        with self.path.open("rb") as file:
            file.seek(self.points_at)
            while data := file.read(BATCH * _POINT.itemsize):
                yield np.frombuffer(data, dtype=_POINT)


def read_pcd(path: Path) -> PcdFile:
    """The file with its header; ValueError where that does not end."""
    with path.open("rb") as file:
        head, end, _ = file.read(MAX_HEADER_BYTES).partition(b"DATA binary\n")
    if not end:
        raise ValueError("its header does not end")
    points_at = len(head) + len(end)
    return PcdFile(
        path=path,
        header=head.decode("ascii").removesuffix("\n").split("\n"),
        points_at=points_at,
        points_bytes=path.stat().st_size - points_at,
        projector=(path.parent / PROJECTOR).read_bytes().decode("ascii"),
    )


def pcd(scene: Scene, found: PcdFile) -> Rows:
    """Every point and colour, and the points' places on the earth as the projection has them."""
    place, header = scene.georeference, found.header
    assert place is not None
    count = len(scene.points_m)
    fields = {line.split(" ")[0]: line.split(" ")[1:] for line in header[1:]}
    expected = {
        "VERSION": ["0.7"], "FIELDS": ["x", "y", "z", "rgb"], "SIZE": ["4"] * 4, "TYPE": ["F"] * 4, "COUNT": ["1"] * 4,
        "WIDTH": [str(count)], "HEIGHT": ["1"], "VIEWPOINT": [*"0001000"], "POINTS": [str(count)],
    }  # fmt: skip
    yield Row("its header", fields, expected)
    yield Row("its first line", header[0], "# .PCD v0.7 - Point Cloud Data file format")
    yield Row("the bytes of its points", found.points_bytes, count * _POINT.itemsize)
    raised = np.array([0.0, 0.0, place.origin_ellipsoidal_height_m])
    origin = parsed_yaml(found.projector)["map_origin"]
    to_ecef = Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 "
        f"+lat_0={origin['latitude']!r} +lon_0={origin['longitude']!r} +h_0={origin['altitude']!r}"
    )
    first = 0
    for rows in found.points():
        block = slice(first, first + len(rows))
        first += len(rows)
        expected_m = scene.points_m[block]
        yield Row("a point", rows["place"], (expected_m + raised).astype(np.float32))
        red, green, blue = scene.point_colors[block].T.astype(np.uint32)
        yield Row("a colour", rows["color"], (red << 16) + (green << 8) + blue)
        points_m = rows["place"].astype(np.float64)
        ecef = expected_m @ place.ecef_from_local[:3, :3].T + place.ecef_from_local[:3, 3]
        tolerance_m = float(np.abs(points_m).max(initial=0.0)) * FLOAT32_STEPS + PROJECTION_TOLERANCE_M
        yield Row("a point's place on the earth", np.stack(to_ecef.transform(*points_m.T), -1), ecef, tolerance_m)
    yield Row("its number of points", first, count)


def projector(scene: Scene, text: str) -> Rows:
    """The projection, to the last digit; that it is the right one shows in the points."""
    yield Row("its text", text, projector_text(scene))
    found = parsed_yaml(text)
    yield Row("the projection", (found["projector_type"], found["vertical_datum"]), ("LocalCartesian", "WGS84"))
    yield Row("the origin's altitude", found["map_origin"]["altitude"], 0.0)
