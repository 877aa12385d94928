from __future__ import annotations

import pytest

from mrasfm_engine.aggregation.load import NEEDED
from schemas.artifacts import is_read_by_aggregation
from schemas.exports import is_read_by_export


def test_an_aggregation_fetches_what_it_needs() -> None:
    assert all(map(is_read_by_aggregation, NEEDED))


@pytest.mark.parametrize(
    "path",
    ["points.copc.laz", "trajectory.gpkg", "rig/camchain.yaml", "autoware/pointcloud_map.pcd", "pictures/road.tif"],
)
def test_an_aggregation_fetches_no_files_for_other_programs(path: str) -> None:
    assert not is_read_by_aggregation(path)


def test_an_export_fetches_the_picture_of_the_road_for_its_own_format_alone() -> None:
    assert is_read_by_export("pictures/road.tif", ["copc", "geotiff"])
    assert not is_read_by_export("pictures/road.tif", ["copc", "geopackage"])
    assert is_read_by_export("poses.json", ["copc"])
