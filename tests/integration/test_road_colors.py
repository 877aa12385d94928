"""The COPC and the GeoTIFF of a scene agree on the earth: points of the road have the colours of the picture there."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import laspy
import numpy as np
import pytest
from pyproj import Transformer

DOUBLE_BYTES = 8
TRANSFORMATION, GEO_DOUBLES = 34264, 34736


def doubles(path: Path, tag: int) -> np.ndarray:
    """The numbers of a tag of the first directory of a little-endian BigTIFF."""
    data = path.read_bytes()
    (at,) = struct.unpack_from("<Q", data, 8)
    (count,) = struct.unpack_from("<Q", data, at)
    for entry in range(count):
        found, _, number, offset = struct.unpack_from("<HHQQ", data, at + 8 + 20 * entry)
        if found == tag:
            return np.frombuffer(data, "<f8", number, offset)
    raise AssertionError(f"{path} has no tag {tag}")


@pytest.mark.slow
def test_points_have_the_colours_of_the_picture_at_their_place_only(surround_scene: Path) -> None:
    """It ties the points, their reference system, the picture and its projection together."""
    las = laspy.read(surround_scene / "points.copc.laz")
    road = las["road_patch"] >= 0
    assert road.sum() > 150
    assert set(np.unique(las.classification[road])) <= {0, 11}
    grey = np.stack([las.red, las.green, las.blue], -1)[road].mean(axis=1) / 257
    path = surround_scene / "pictures" / "road.tif"
    picture = cv2.imreadmulti(str(path), flags=cv2.IMREAD_UNCHANGED)[1][0]
    longitude, latitude = doubles(path, GEO_DOUBLES)[:2]
    projection = f"+proj=ortho +lat_0={latitude} +lon_0={longitude} +ellps=WGS84"
    to_picture = Transformer.from_crs(las.header.parse_crs(), projection, always_xy=True)
    to_pixel = np.linalg.inv(doubles(path, TRANSFORMATION).reshape(4, 4)[np.ix_([0, 1, 3], [0, 1, 3])])

    def correlation(east_m: float, north_m: float) -> float:
        x, y = to_picture.transform(np.array(las.x)[road] + east_m, np.array(las.y)[road] + north_m)
        column, row = np.floor((to_pixel @ [x, y, np.ones_like(x)])[:2]).astype(int)
        shown = (row >= 0) & (row < picture.shape[0]) & (column >= 0) & (column < picture.shape[1])
        shown[shown] = picture[row[shown], column[shown], 3] > 127
        assert shown.mean() > 0.5
        return float(np.corrcoef(picture[row[shown], column[shown], :3].mean(axis=1), grey[shown])[0, 1])

    in_place = correlation(0, 0)
    shifted = [correlation(*shift) for shift in ((0.25, 0), (-0.25, 0), (0, 0.25), (0, -0.25))]
    assert 0.6 < in_place < 0.999
    assert max(shifted) < in_place / 2
