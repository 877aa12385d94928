"""`trajectory.gpkg` by SQL, as the standard describes it."""

from __future__ import annotations

import json
import re
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mrasfm_engine.errors import StorageError
from mrasfm_engine.export import geopackage, geopackage_readback
from mrasfm_engine.export.geopackage import write_geopackage
from mrasfm_engine.export.pose_files import geodetic_positions
from mrasfm_engine.export.scene import write_scene
from mrasfm_engine.geometry import geodesy
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import Scene
from schemas.artifacts import TRAJECTORY_FILE
from tests.helpers.export_example import MISSING_IMAGE, MISSING_UNIT, UNITS, assert_withheld, make_scene, withheld_files

NAMES = ["example"] * UNITS


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("geopackage") / "scene"
    write_scene(make_scene(), out, {})
    return out


def select(path: Path, sql: str) -> list[tuple[Any, ...]]:
    with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as db:
        return db.execute(sql).fetchall()


def with_times(scene: Scene, timestamps_us: list[int]) -> Scene:
    frames = [
        frame.model_copy(update={"timestamp_us": t})
        for frame, t in zip(scene.drive.manifest.frames, timestamps_us, strict=True)
    ]
    return replace(scene, drive=Drive(scene.drive.root, scene.drive.manifest.model_copy(update={"frames": frames})))


def disagreement(scene: Scene, path: Path) -> str | None:
    try:
        rows = geopackage_readback.geopackage(scene, NAMES, geopackage_readback.read_geopackage(path))
        return next((row.what for row in rows if not row.agrees), None)
    except Exception as error:
        return repr(error)


def test_it_is_a_geopackage(written: Path) -> None:
    path = written / TRAJECTORY_FILE
    assert path.read_bytes()[68:72] == b"GPKG"
    assert select(path, "PRAGMA user_version") == [(10300,)]
    assert select(path, "PRAGMA foreign_key_check") == []
    assert {4326, -1, 0} == {srs for (srs,) in select(path, "SELECT srs_id FROM gpkg_spatial_ref_sys")}
    layers = [("camera_positions", "POINT"), ("trajectory", "LINESTRING"), ("unit_positions", "POINT")]
    columns = "SELECT table_name, geometry_type_name FROM gpkg_geometry_columns ORDER BY table_name"
    assert select(path, columns) == layers
    for name, _ in layers:
        ((minimum, maximum),) = select(path, f"SELECT min_y, max_y FROM gpkg_contents WHERE table_name = '{name}'")
        assert 48.0999 < minimum < maximum < 48.1001


@pytest.mark.parametrize(("table", "entries"), [("unit_positions", "units"), ("camera_positions", "images")])
def test_positions_are_those_of_poses_json(written: Path, table: str, entries: str) -> None:
    document = json.loads((written / "poses.json").read_text())[entries]
    rows = select(written / TRAJECTORY_FILE, f"SELECT fid, geom, registered, timestamp_us FROM {table} ORDER BY fid")
    assert [row[0] for row in rows] == list(range(1, len(document) + 1))
    for entry, (_, geometry, registered, timestamp_us) in zip(document, rows, strict=True):
        assert (registered, timestamp_us) == (entry["registered"], entry["timestamp_us"])
        assert (geometry is None) == (not registered)
        if registered:
            magic, _, flags, srs, order, kind, x, y, z = struct.unpack("<2sBBiBI3d", geometry)
            assert (magic, flags & 1, srs, order, kind) == (b"GP", 1, 4326, 1, 1001)
            place = entry["geodetic"]
            assert x == pytest.approx(place["longitude_deg"], abs=1e-9)
            assert y == pytest.approx(place["latitude_deg"], abs=1e-9)
            assert z == pytest.approx(place["ellipsoidal_height_m"], abs=1e-3)


def test_attributes(written: Path) -> None:
    path = written / TRAJECTORY_FILE
    unit = select(path, "SELECT scene, source_frame, sigma_x_m, sigma_z_m FROM unit_positions ORDER BY fid")
    assert unit[3] == ("example", 30, 0.01, 0.03)
    assert unit[MISSING_UNIT] == ("example", 10, None, None)
    images = select(path, "SELECT unit, camera, image, registered FROM camera_positions ORDER BY fid")
    assert images[MISSING_IMAGE] == (UNITS, "right", "images/right/004.png", 0)
    assert images[4] == (3, "left", "images/left/002.png", 1)
    ((units, line),) = select(path, "SELECT units, geom FROM trajectory")
    assert units == UNITS - 1
    assert len(line) == 8 + 6 * 8 + 9 + units * 24


def test_times_have_three_decimals(written: Path) -> None:
    for table in ("unit_positions", "camera_positions"):
        times = [time for (time,) in select(written / TRAJECTORY_FILE, f"SELECT time FROM {table} ORDER BY fid")]
        assert times[0] == "2020-09-13T12:26:40.000Z"
        assert all(re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z", time) for time in times)
    ((change,),) = select(written / TRAJECTORY_FILE, "SELECT DISTINCT last_change FROM gpkg_contents")
    assert change == "2020-09-13T12:26:42.000Z"


def test_a_clock_that_does_not_count_from_1970_has_no_dates(tmp_path: Path) -> None:
    path, first = tmp_path / TRAJECTORY_FILE, 946_684_800_000_000
    scene = with_times(make_scene(), [0, first - 1, first, first + 1_499, 2**62])
    write_geopackage(scene, NAMES, path)
    rows = select(path, "SELECT timestamp_us, time FROM unit_positions ORDER BY fid")
    assert [when for when, _ in rows] == scene.drive.timestamps_us.tolist()
    dates = [None, None, "2000-01-01T00:00:00.000Z", "2000-01-01T00:00:00.001Z", None]
    assert [time for _, time in rows] == dates
    assert select(path, "SELECT DISTINCT last_change FROM gpkg_contents") == [("1970-01-01T00:00:00.000Z",)]
    assert disagreement(scene, path) is None


def test_without_a_place_on_earth_positions_are_local(tmp_path: Path) -> None:
    scene, path = make_scene(georeferenced=False), tmp_path / TRAJECTORY_FILE
    write_geopackage(scene, NAMES, path)
    assert select(path, "SELECT DISTINCT srs_id FROM gpkg_geometry_columns") == [(-1,)]
    ((geometry,),) = select(path, "SELECT geom FROM unit_positions WHERE fid = 3")
    assert struct.unpack_from("<i", geometry, 4) == (-1,)
    np.testing.assert_array_equal(struct.unpack_from("<3d", geometry, 13), scene.world_from_rig[2, :3, 3])
    assert disagreement(scene, path) is None


def test_each_scene_of_a_map_has_a_line_in_order_of_time(tmp_path: Path) -> None:
    path = tmp_path / TRAJECTORY_FILE
    times = [1_600_000_000_000_000 + t for t in (0, 1, 2_000_000, 4_000_000, 3_000_000)]
    scene = with_times(make_scene(), times)
    write_geopackage(scene, ["a", "a", "b", "b", "b"], path)
    ((name, units, line),) = select(path, "SELECT scene, units, geom FROM trajectory")  # of `a`, one unit is registered
    assert (name, units) == ("b", 3)
    latitudes = np.frombuffer(line[65:]).reshape(-1, 3)[:, 1]
    by_unit = [struct.unpack_from("<d", g, 21)[0] for (g,) in select(path, "SELECT geom FROM unit_positions") if g]
    assert latitudes.tolist() == [by_unit[1], by_unit[3], by_unit[2]]


def test_a_scene_without_poses_has_rows_without_geometry(tmp_path: Path) -> None:
    scene, path = make_scene(), tmp_path / TRAJECTORY_FILE
    bare = replace(
        scene,
        unit_registered=np.zeros_like(scene.unit_registered),
        image_registered=np.zeros_like(scene.image_registered),
        world_from_rig=np.full_like(scene.world_from_rig, np.nan),
    )
    write_geopackage(bare, NAMES, path)
    assert select(path, "SELECT count(*), count(geom) FROM camera_positions") == [(2 * UNITS, 0)]
    assert select(path, "SELECT DISTINCT min_x FROM gpkg_contents") == [(None,)]
    assert disagreement(bare, path) is None


@pytest.mark.slow
def test_every_flipped_bit_that_changes_what_it_says_is_found(tmp_path: Path) -> None:
    scene, path, rng = make_scene(), tmp_path / TRAJECTORY_FILE, np.random.default_rng(3)
    write_geopackage(scene, NAMES, path)
    data, dump = path.read_bytes(), dumped(path)
    found = 0
    for at in range(0, len(data), 61):
        flipped = bytearray(data)
        flipped[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        if disagreement(scene, path) is None:
            assert dumped(path) == dump, at
        else:
            found += 1
    assert found > 60


def dumped(path: Path) -> list[str]:
    with closing(sqlite3.connect(f"file:{path}?mode=ro&immutable=1", uri=True)) as db:
        tables = [name for (name,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        rows = [f"{name}: {row!r}" for name in tables for row in db.execute(f"SELECT * FROM {name}")]
        return [*rows, *(sql for (sql,) in db.execute("SELECT sql FROM sqlite_master WHERE sql NOT NULL"))]


@pytest.mark.parametrize(
    "change",
    [
        lambda s: replace(s, world_from_rig=s.world_from_rig + 1e-9 * (np.arange(16) == 3).reshape(4, 4)),
        lambda s: replace(s, sigma_position_m=2 * s.sigma_position_m),
        lambda s: replace(s, georeference=None),
        lambda s: with_times(s, (s.drive.timestamps_us + 1).tolist()),
    ],
)
def test_a_file_of_another_scene_is_withheld_and_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: Callable[[Scene], Scene]
) -> None:
    original = geopackage.write_geopackage
    monkeypatch.setattr(geopackage, "write_geopackage", lambda scene, *args: original(change(scene), *args))
    write_scene(make_scene(), tmp_path / "scene", {})
    assert_withheld(tmp_path / "scene", "trajectory.gpkg")


@pytest.mark.parametrize(("longitude_deg", "east_m", "low"), [(180.0 - 1e-6, 0.0, 179.9), (1e-6 - 180.0, -3.0, -180.1)])
def test_the_antimeridian_divides_no_line(tmp_path: Path, longitude_deg: float, east_m: float, low: float) -> None:
    scene, path = make_scene(), tmp_path / TRAJECTORY_FILE
    assert scene.georeference is not None
    matrix = geodesy.ecef_from_local([0.1, longitude_deg, 10.0])
    place = replace(scene.georeference, origin_longitude_deg=longitude_deg, ecef_from_local=matrix)
    poses = scene.world_from_rig.copy()
    poses[:, 0, 3] += east_m
    scene = replace(scene, georeference=place, world_from_rig=poses)
    geodetic = geodetic_positions(scene, scene.world_from_rig)
    assert geodetic is not None
    assert np.nanmax(geodetic[:, 1]) - np.nanmin(geodetic[:, 1]) > 359  # the way crosses it
    write_geopackage(scene, NAMES, path)
    assert disagreement(scene, path) is None
    ((least, greatest),) = select(path, "SELECT min_x, max_x FROM gpkg_contents WHERE table_name = 'trajectory'")
    assert low < least < greatest < low + 0.2


@pytest.mark.parametrize("error", [ValueError("no"), OSError(28, "No space left on device")])
def test_a_writer_that_fails_takes_its_file_alone_and_a_full_disk_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fail(scene: Scene, names: object, path: Path) -> None:
        path.write_bytes(b"half")
        raise error

    out = tmp_path / "scene"
    write_scene(make_scene(), out, {})
    monkeypatch.setattr(geopackage, "write_geopackage", fail)
    if isinstance(error, OSError):
        with pytest.raises(StorageError, match="No space left"):
            write_scene(make_scene(), out, {})
        assert (out / "trajectory.gpkg").exists()  # the older one, with its own report
        return
    write_scene(make_scene(), out, {})
    assert not (out / "trajectory.gpkg").exists()  # not even the older one
    assert withheld_files(out) == ["trajectory.gpkg is withheld: it cannot be written: ValueError: no"]
