"""`autoware/`: the points as a PCD map and the projection that it is in, as Autoware loads them.

The map's frame is east, north, up at the scene's origin, but at height zero: Autoware takes the altitude of a map's
origin for zero, whatever `map_projector_info.yaml` says. So z is larger than in the local frame by the origin's
ellipsoidal height, and nothing else differs.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mrasfm_engine.scene.scene import Scene

POINTS, PROJECTOR = "pointcloud_map.pcd", "map_projector_info.yaml"
BLOCK = 500_000  # points that are in memory at one time


def fits(scene: Scene) -> bool:
    """Return whether there is a map to write: points that have a place on the earth."""
    return scene.georeference is not None and len(scene.points_m) > 0


def write_autoware(scene: Scene, folder: Path) -> None:
    """Write `pointcloud_map.pcd` and `map_projector_info.yaml` into a new folder; they must fit."""
    folder.mkdir()
    (folder / PROJECTOR).write_text(projector_text(scene), encoding="ascii")
    place = scene.georeference
    assert place is not None
    count = len(scene.points_m)
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\n"
        f"COUNT 1 1 1 1\nWIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n"
    )
    with (folder / POINTS).open("wb") as file:
        file.write(header.encode("ascii"))
        for first in range(0, count, BLOCK):
            block = slice(first, first + BLOCK)
            # PCL's points with colours: 32 bits each, the colours' bits as those of a float
            rows = np.zeros(len(scene.points_m[block]), dtype=[("xyz", "<f4", 3), ("bgr", "u1", 3), ("zero", "u1")])
            rows["xyz"] = scene.points_m[block] + np.array([0.0, 0.0, place.origin_ellipsoidal_height_m])
            rows["bgr"] = scene.point_colors[block, ::-1]
            file.write(rows.tobytes())


def projector_text(scene: Scene) -> str:
    """`map_projector_info.yaml`: a local cartesian frame about the scene's origin."""
    place = scene.georeference
    assert place is not None
    # Without exponents: YAML takes some of them for texts.
    latitude, longitude = f"{place.origin_latitude_deg:.15f}", f"{place.origin_longitude_deg:.15f}"
    return (
        "projector_type: LocalCartesian\nvertical_datum: WGS84\nmap_origin:\n"
        f"  latitude: {latitude}\n  longitude: {longitude}\n  altitude: 0.0\n"
    )
