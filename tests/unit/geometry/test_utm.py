from __future__ import annotations

import numpy as np
import pytest
from pyproj import CRS, Transformer

from mrasfm_engine.geometry import geodesy, utm

PLACES = [(49.0, 8.4, 32632), (-33.9, 151.2, 32756), (0.0, -180.0, 32601), (10.0, 180.0, 32601), (-0.1, 179.9, 32760)]


@pytest.mark.parametrize(("latitude_deg", "longitude_deg", "code"), PLACES)
def test_coordinates_are_those_of_the_zone(latitude_deg: float, longitude_deg: float, code: int) -> None:
    assert utm.epsg_code(latitude_deg, longitude_deg) == code
    matrix = geodesy.ecef_from_local([latitude_deg, longitude_deg, 520.0])
    points_m = np.random.default_rng(0).uniform(-5000, 5000, (20, 3)) * [1, 1, 0.1]
    found = utm.utm_from_local(points_m, matrix, code)
    to_zone = Transformer.from_crs("EPSG:4979", CRS.from_epsg(code).to_3d(), always_xy=True)
    latitude, longitude, height = geodesy.geodetic_from_local(points_m, matrix).T
    np.testing.assert_allclose(found, np.stack(to_zone.transform(longitude, latitude, height), -1), atol=1e-6)
    lengths = np.linalg.norm(np.diff(found[:, :2], axis=0), axis=1)
    assert (lengths / np.linalg.norm(np.diff(points_m[:, :2], axis=0), axis=1)).mean() == pytest.approx(1.0, abs=1.5e-3)


def test_the_text_has_three_axes_in_wkt_1() -> None:
    text = utm.well_known_text(32632)
    system = CRS.from_wkt(text)
    assert text.startswith("COMPD_CS[")
    assert 'AUTHORITY["EPSG","32632"]' in text
    points = np.array([[11.5, 48.1, 520.0], [11.4, 48.0, 10.0]])
    by_text, by_code = (
        np.stack(Transformer.from_crs("EPSG:4979", crs, always_xy=True).transform(*points.T), -1)
        for crs in (system, CRS.from_epsg(32632).to_3d())
    )
    np.testing.assert_array_equal(by_text, by_code)  # the heights stay ellipsoidal
    np.testing.assert_array_equal(by_text[:, 2], points[:, 2])
