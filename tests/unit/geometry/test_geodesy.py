from __future__ import annotations

import numpy as np
import pytest
from pyproj import Geod
from pyproj.transformer import TransformerGroup

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import geodesy

MUNICH = [48.137, 11.575, 560.0]
PLACES = np.array(
    [MUNICH, [-33.86, 151.21, 20.0], [64.1, -21.9, 0.0], [0.0, 0.0, 0.0], [1.3, 179.99, 5.0], [89.9, 0.0, 2.0]]
)


def test_ecef_of_known_places() -> None:
    equator, pole = geodesy.ecef_from_geodetic([[0.0, 90.0, 100.0], [90.0, 0.0, 0.0]])
    np.testing.assert_allclose(equator, [0, 6378137.0 + 100.0, 0], atol=1e-6)
    np.testing.assert_allclose(pole, [0, 0, 6356752.314245], atol=1e-6)


def test_latitude_comes_first() -> None:
    # Munich is north of the equator by 48 deg: z is large, and it lies east of Greenwich by only 11.6 deg.
    x, y, z = geodesy.ecef_from_geodetic(MUNICH)
    assert 4.7e6 < z < 4.8e6
    assert 0 < y < x < 4.3e6
    latitude, longitude, height = geodesy.geodetic_from_ecef([x, y, z])
    assert (latitude, longitude, height) == pytest.approx(tuple(MUNICH), abs=1e-8)


def test_round_trips() -> None:
    np.testing.assert_allclose(geodesy.geodetic_from_ecef(geodesy.ecef_from_geodetic(PLACES)), PLACES, atol=1e-8)
    grid = np.broadcast_to(PLACES, (4, *PLACES.shape))
    assert geodesy.ecef_from_geodetic(grid).shape == grid.shape
    rng = np.random.default_rng(0)
    for place in PLACES:
        frame = geodesy.ecef_from_local(place)
        local = rng.uniform(-5000, 5000, (50, 3))
        back = geodesy.local_from_geodetic(geodesy.geodetic_from_local(local, frame), frame)
        np.testing.assert_allclose(back, local, atol=1e-6)


@pytest.mark.parametrize("place", PLACES[:5].tolist())
def test_the_local_frame_is_east_north_up(place: list[float]) -> None:
    frame = geodesy.ecef_from_local(place)
    assert np.linalg.det(frame[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(frame[:3, :3] @ frame[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(geodesy.local_from_geodetic(place, frame), 0, atol=1e-8)
    # The geodesic problem, solved by other code, says where 100 m east and north are.
    for azimuth, expected in ((90.0, [100.0, 0, 0]), (0.0, [0, 100.0, 0])):
        longitude, latitude, _ = Geod(ellps="WGS84").fwd(place[1], place[0], azimuth, 100.0)
        moved = geodesy.local_from_geodetic([latitude, longitude, place[2]], frame)
        error = np.abs(moved - expected).max()
        assert 0 < error < 0.012  # the curvature of the earth, and the height of the place above the ellipsoid
    above = geodesy.local_from_geodetic([place[0], place[1], place[2] + 10], frame)
    np.testing.assert_allclose(above, [0, 0, 10], atol=1e-7)


@pytest.mark.parametrize(
    "place", [[11.575, 181.0, 0.0], [-95.0, 11.0, 0.0], [np.nan, 0, 0], [48.0, np.inf, 0], [48.0, 11.0]]
)
def test_impossible_coordinates_are_refused(place: list[float]) -> None:
    with pytest.raises(ValueError, match=r"geodetic|latitude"):
        geodesy.ecef_from_geodetic(place)


@pytest.mark.parametrize("point", [[0.0, 0, 0], [np.nan, 0, 0], [1e8, 0, 0]])
def test_points_that_are_not_on_the_earth_are_refused(point: list[float]) -> None:
    with pytest.raises(ValueError, match="earth"):
        geodesy.geodetic_from_ecef(point)


def test_ellipsoidal_heights_pass_unchanged() -> None:
    np.testing.assert_array_equal(geodesy.ellipsoidal_from_datum(PLACES, "ellipsoidal"), PLACES)


@pytest.mark.filterwarnings("ignore:Best transformation is not available")
@pytest.mark.parametrize("datum", ["EPSG:5773", "EPSG:7837"])
def test_a_datum_without_its_grid_is_an_error_never_a_zero(datum: str) -> None:
    places = TransformerGroup(f"EPSG:4326+{datum[5:]}", "EPSG:4979", allow_ballpark=False, always_xy=True)
    if places.best_available and places.transformers:
        assert 40 < geodesy.ellipsoidal_from_datum(MUNICH, datum)[2] - MUNICH[2] < 50
        return
    with pytest.raises(InputError, match=datum) as raised:
        geodesy.ellipsoidal_from_datum(MUNICH, datum)
    assert "grid" in raised.value.remedy


def test_an_unknown_datum_is_an_error() -> None:
    with pytest.raises(InputError, match="EPSG:999999"):
        geodesy.ellipsoidal_from_datum(MUNICH, "EPSG:999999")
