"""`autoware/`: the map that Autoware loads, and where it puts it on the earth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyproj import Transformer

from mrasfm_engine.export import autoware, autoware_readback
from mrasfm_engine.export.autoware import write_autoware
from mrasfm_engine.export.rig_files_readback import parsed_yaml
from mrasfm_engine.export.scene import write_scene
from mrasfm_engine.geometry import geodesy
from mrasfm_engine.scene.scene import Scene
from tests.helpers.export_example import assert_withheld, make_scene, withheld_files


def points_of(path: Path) -> np.ndarray:
    """The points as a reader of PCD finds them by the header."""
    head, _, body = path.read_bytes().partition(b"DATA binary\n")
    fields = dict(line.split(" ", 1) for line in head.decode().splitlines()[1:])
    kinds = {"F4": "<f4"}
    formats = [kinds[a + b] for a, b in zip(fields["TYPE"].split(), fields["SIZE"].split(), strict=True)]
    rows = np.frombuffer(body, dtype=list(zip(fields["FIELDS"].split(), formats, strict=True)))
    assert len(rows) == int(fields["POINTS"]) == int(fields["WIDTH"]) * int(fields["HEIGHT"])
    return rows


def test_the_projection_puts_the_points_where_they_are(tmp_path: Path) -> None:
    """With the altitude of the map's origin taken for zero, as Autoware takes it."""
    scene = make_scene()
    write_scene(scene, tmp_path / "scene", {})
    folder = tmp_path / "scene" / "autoware"
    found = parsed_yaml((folder / "map_projector_info.yaml").read_text())
    assert (found["projector_type"], found["vertical_datum"]) == ("LocalCartesian", "WGS84")
    assert found["map_origin"] == {"latitude": 48.1, "longitude": 11.5, "altitude": 0.0}
    rows = points_of(folder / "pointcloud_map.pcd")
    points_m = np.stack([rows[axis] for axis in "xyz"], -1).astype(np.float64)
    to_ecef = Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lat_0=48.1 +lon_0=11.5 +h_0=0"
    )
    assert scene.georeference is not None
    places = geodesy.geodetic_from_ecef(np.stack(to_ecef.transform(*points_m.T), -1))
    away_m = geodesy.local_from_geodetic(places, scene.georeference.ecef_from_local) - scene.points_m
    assert 0 < np.abs(away_m).max() < 1e-4
    assert points_m[:, 2].min() > 500  # heights above the ellipsoid
    colors = rows["rgb"].copy().view("<u4")
    np.testing.assert_array_equal(np.stack([colors >> 16, colors >> 8 & 255, colors & 255], -1), scene.point_colors)


def test_what_has_no_place_on_the_earth_is_no_map(tmp_path: Path) -> None:
    out = tmp_path / "scene"
    write_scene(make_scene(), out, {})
    assert (out / "autoware").is_dir()
    write_scene(make_scene(georeferenced=False), out, {})
    assert not (out / "autoware").exists()


@pytest.mark.parametrize("file", [autoware.POINTS, autoware.PROJECTOR])
def test_every_flipped_bit_is_found(tmp_path: Path, file: str) -> None:
    scene, path, rng = make_scene(), tmp_path / "autoware" / file, np.random.default_rng(0)
    write_autoware(scene, path.parent)
    data = path.read_bytes()
    assert agrees(scene, path.parent)
    for at in range(0, len(data), 3):
        flipped = bytearray(data)
        flipped[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        assert not agrees(scene, path.parent), at


def test_parts_of_it_are_written_and_read_at_one_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = make_scene()
    write_autoware(scene, tmp_path / "whole")
    monkeypatch.setattr(autoware, "BLOCK", 7)
    monkeypatch.setattr(autoware_readback, "BATCH", 11)
    write_autoware(scene, tmp_path / "parts")
    written, whole = (tmp_path / folder / autoware.POINTS for folder in ("parts", "whole"))
    assert written.read_bytes() == whole.read_bytes()
    sizes = [len(rows) for rows in autoware_readback.read_pcd(written).points()]
    assert (max(sizes), sum(sizes)) == (11, len(scene.points_m))
    assert agrees(scene, tmp_path / "parts")
    written.write_bytes(whole.read_bytes()[:-16])
    assert not agrees(scene, tmp_path / "parts")


def agrees(scene: Scene, folder: Path) -> bool:
    try:
        rows = [
            *autoware_readback.projector(scene, (folder / autoware.PROJECTOR).read_text()),
            *autoware_readback.pcd(scene, autoware_readback.read_pcd(folder / autoware.POINTS)),
        ]
    except Exception:
        return False
    return all(row.agrees for row in rows)


@pytest.mark.parametrize(
    ("change", "file"),
    [
        (lambda s: replace(s, points_m=s.points_m + 0.001), "pointcloud_map.pcd"),
        (lambda s: replace(s, point_colors=s.point_colors[:, ::-1]), "pointcloud_map.pcd"),
        (
            lambda s: replace(s, georeference=replace(s.georeference, origin_latitude_deg=48.2)),
            "map_projector_info.yaml",
        ),
    ],
)
def test_a_map_of_another_scene_is_withheld_and_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: Callable[[Scene], Scene], file: str
) -> None:
    original: Any = autoware.write_autoware
    monkeypatch.setattr(autoware, "write_autoware", lambda scene, folder: original(change(scene), folder))
    write_scene(make_scene(), tmp_path / "scene", {})
    assert_withheld(tmp_path / "scene", "autoware")
    (note,) = withheld_files(tmp_path / "scene")
    assert f": {file} was written" in note


def test_a_projection_of_another_place_is_refused_by_the_points(tmp_path: Path) -> None:
    scene = make_scene()
    assert scene.georeference is not None
    write_autoware(scene, tmp_path / "autoware")
    text = (tmp_path / "autoware" / autoware.PROJECTOR).read_text()
    (tmp_path / "autoware" / autoware.PROJECTOR).write_text(text.replace("48.1", "48.100001"))
    found = autoware_readback.read_pcd(tmp_path / "autoware" / autoware.POINTS)
    assert [row.what for row in autoware_readback.pcd(scene, found) if not row.agrees] == [
        "a point's place on the earth"
    ]
