"""`points.copc.laz` as laspy reads it, and as readers want it that found traps in the format."""

from __future__ import annotations

import json
import resource
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
from pyproj import CRS, Transformer

from mrasfm_engine.export import copc, copc_readback, octree, ply
from mrasfm_engine.export.copc import write_copc
from mrasfm_engine.export.scene import write_scene
from mrasfm_engine.geometry import geodesy
from mrasfm_engine.io.read_model import read_vertices
from mrasfm_engine.scene.scene import Scene
from schemas.artifacts import COPC_FILE
from tests.helpers.export_example import assert_withheld, make_scene, scene_with_road, street_of_points, withheld_files


@pytest.fixture(scope="module")
def scene() -> Scene:
    return street_of_points(60_000)


@pytest.fixture(scope="module")
def written(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("copc") / COPC_FILE
    write_copc(scene, path)
    return path


def disagreement(scene: Scene, path: Path) -> str | None:
    """The first thing in which a file is not what the scene says."""
    try:
        return next(
            (row.what for row in copc_readback.copc(scene, copc_readback.read_copc(path)) if not row.agrees), None
        )
    except Exception as error:
        return repr(error)


def test_laspy_reads_what_the_ply_says(scene: Scene, written: Path, tmp_path: Path) -> None:
    las = laspy.read(written)
    ply.write_ply(scene, tmp_path / "points.ply")
    rows = read_vertices(tmp_path / "points.ply")[1][las["point_id"] - 1]
    np.testing.assert_array_equal(np.sort(las["point_id"]), np.arange(1, len(scene.points_m) + 1))
    assert scene.georeference is not None
    to_ecef = Transformer.from_crs(las.header.parse_crs(), "EPSG:4978", always_xy=True)
    matrix = scene.georeference.ecef_from_local
    local_m = (np.stack(to_ecef.transform(las.x, las.y, las.z), -1) - matrix[:3, 3]) @ matrix[:3, :3]
    away_m = np.linalg.norm(local_m - np.stack([rows[axis] for axis in "xyz"], -1), axis=1)
    assert 0 < away_m.max() < 1e-3
    for name in ("red", "green", "blue"):
        np.testing.assert_array_equal(las[name] >> 8, rows[name])
        np.testing.assert_array_equal(las[name] & 255, rows[name])
    for name in ("track_length", "error_px", "road_patch"):
        np.testing.assert_array_equal(las[name], rows[name])
    classes = {0: 0, 1: 1, 2: 11, 3: 67, 4: 68, 5: 69}
    np.testing.assert_array_equal(las.classification, [classes[code] for code in rows["class"].tolist()])
    assert set(np.unique(las.return_number)) == set(np.unique(las.number_of_returns)) == {1}


def test_the_system_is_utm_with_ellipsoidal_heights(scene: Scene, written: Path) -> None:
    header = laspy.read(written).header
    system = header.parse_crs()
    assert system is not None
    assert CRS(system.name.split(" + ")[0]).to_epsg() == 32632
    assert header.global_encoding.wkt
    assert header.mins[2] == pytest.approx(520.0, abs=0.1)
    assert scene.georeference is not None
    assert scene.georeference.origin_ellipsoidal_height_m == 520.0


def test_without_a_place_on_earth_there_is_no_system_and_coordinates_are_local(tmp_path: Path) -> None:
    scene = make_scene(georeferenced=False)
    write_copc(scene, tmp_path / COPC_FILE)
    las = laspy.read(tmp_path / COPC_FILE)
    assert las.header.parse_crs() is None
    assert [record.record_id for record in las.header.vlrs if record.record_id == 2112] == []
    points_m = scene.points_m[las["point_id"] - 1]
    error_m = np.abs(np.stack([las.x, las.y, las.z], -1) - points_m)
    assert 0 < error_m.max() <= 0.51e-4
    assert disagreement(scene, tmp_path / COPC_FILE) is None


def test_viewers_read_parts_of_it(scene: Scene, written: Path) -> None:
    with laspy.CopcReader.open(written) as reader:
        root, whole = reader.query(level=0), reader.query()
        box = laspy.copc.Bounds(reader.header.mins, reader.header.mins + np.full(3, 100.0))
        part = reader.query(bounds=box)
        low, high = (np.array(getattr(reader.header, name)) for name in ("mins", "maxs"))
    assert 1000 < len(root) < len(whole) / 2
    assert len(whole) == len(scene.points_m)
    inside = np.stack([whole.x, whole.y, whole.z], -1) <= box.maxs
    assert len(part) == inside.all(axis=1).sum() > 0
    assert np.ptp(root.x) == pytest.approx(high[0] - low[0], rel=0.02)  # it shows all of the cloud


def test_extra_attributes_declare_no_minimum(written: Path) -> None:
    """copc.js refuses the largest integer for one, which others write where there is none."""
    (record,) = (r for r in laspy.read(written).header.vlrs if r.record_id == 4)
    assert [extra.name.decode() for extra in record.extra_bytes_structs] == list(copc.EXTRA)
    data = record.record_data_bytes()
    assert len(data) == 192 * len(copc.EXTRA)
    for first in range(0, len(data), 192):
        assert data[first + 3] == 0  # the options: none of minimum, maximum, scale and offset
        assert not any(data[first + 40 : first + 160])


def test_the_cube_is_the_one_that_the_bounds_give(written: Path) -> None:
    """copclib takes the header's minimum and largest extent for the cube and calls points outside of it invalid."""
    with laspy.CopcReader.open(written) as reader:
        information, low, high = reader.copc_info, reader.header.mins, reader.header.maxs
    np.testing.assert_allclose(information.center - information.halfsize, low, atol=1e-9)
    assert 2 * information.halfsize == pytest.approx(max(high - low), abs=1e-9)
    assert information.spacing == pytest.approx(2 * information.halfsize / octree.GRID)


def test_the_system_follows_laszips_record(written: Path) -> None:
    data, at, order = written.read_bytes(), 375, []
    for _ in range(int.from_bytes(data[100:104], "little")):
        order.append(int.from_bytes(data[at + 18 : at + 20], "little"))
        at += 54 + int.from_bytes(data[at + 20 : at + 22], "little")
    assert order == [1, 22204, 2112, 4]
    assert at == int.from_bytes(data[96:100], "little")


def test_the_last_chunk_is_not_an_empty_one(scene: Scene, written: Path) -> None:
    found = copc_readback.read_copc(written)
    assert min(points for points, _ in found.chunks) > 0
    assert sum(points for points, _ in found.chunks) == len(scene.points_m)


def test_the_check_accepts_it_in_parts(scene: Scene, written: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(copc_readback, "BATCH", 20_000)
    assert len(list(copc_readback.read_copc(written).points())) > 2
    assert disagreement(scene, written) is None


@pytest.mark.parametrize("block", [1000, 10**6])
def test_projecting_in_parts_changes_nothing(
    scene: Scene, written: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int
) -> None:
    monkeypatch.setattr(copc, "BLOCK", block)
    write_copc(scene, tmp_path / COPC_FILE)
    assert (tmp_path / COPC_FILE).read_bytes() == written.read_bytes()


@pytest.mark.slow
def test_every_flipped_bit_is_found(tmp_path: Path) -> None:
    """Every 19th byte; the bits of a compressed stream's end may say nothing."""
    scene, path = scene_with_road(), tmp_path / COPC_FILE
    write_copc(scene, path)
    data, points, rng = path.read_bytes(), laspy.read(path).points.array.tobytes(), np.random.default_rng(1)
    points_at = int.from_bytes(data[96:100], "little")
    nodes_at = int.from_bytes(data[235:243], "little")
    without_meaning = 0
    for at in range(0, len(data), 19):
        flipped = bytearray(data)
        flipped[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        if disagreement(scene, path) is None:
            assert points_at <= at < nodes_at, at
            assert laspy.read(path).points.array.tobytes() == points
            without_meaning += 1
    assert without_meaning < 0.03 * len(data) / 19


@pytest.mark.parametrize(
    "change",
    [
        lambda s: replace(s, points_m=s.points_m + 2e-4),
        lambda s: replace(s, point_colors=s.point_colors[::-1].copy()),
        lambda s: replace(s, point_error_px=s.point_error_px + 0.1),
        lambda s: replace(s, point_patches=np.roll(s.point_patches, 1)),
        lambda s: replace(s, point_classes=np.roll(s.point_classes, 1)),
        lambda s: replace(s, points_m=s.points_m[:-1], observation_point=s.observation_point.clip(0, 48)),
        lambda s: replace(s, georeference=None),
        lambda s: replace(s, georeference=replace(s.georeference, origin_longitude_deg=12.5)),
    ],
)
def test_a_file_of_other_points_is_withheld_and_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: Callable[[Scene], Scene]
) -> None:
    scene, original = scene_with_road(), copc.write_copc
    monkeypatch.setattr(copc, "write_copc", lambda _, path: original(change(scene), path))
    write_scene(scene, tmp_path / "scene", {})
    assert_withheld(tmp_path / "scene", COPC_FILE)


def test_a_file_that_cannot_grow_is_an_os_error(scene: Scene, tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        with pytest.raises(OSError, match="File too large"):
            write_copc(scene, tmp_path / COPC_FILE)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_an_origin_on_a_central_meridian_is_no_matter_of_rounding(tmp_path: Path) -> None:
    scene = make_scene()
    assert scene.georeference is not None
    for longitude_deg in (9.0, 15.0, 8.999999999999998):
        matrix = geodesy.ecef_from_local([48.1, longitude_deg, 520.0])
        place = replace(scene.georeference, origin_longitude_deg=longitude_deg, ecef_from_local=matrix)
        there = replace(scene, georeference=place)
        write_copc(there, tmp_path / COPC_FILE)
        assert laspy.read(tmp_path / COPC_FILE).header.offsets[0] in (499_999, 500_000)
        assert disagreement(there, tmp_path / COPC_FILE) is None


def test_a_point_too_far_away_withholds_the_file(tmp_path: Path) -> None:
    scene, out = make_scene(), tmp_path / "scene"
    write_scene(scene, out, {})
    assert (out / COPC_FILE).is_file()
    assert json.loads((out / "report.json").read_text())["summary"]["notes"] == scene.notes
    far = scene.points_m.copy()
    far[3] = [150_000.0, 150_000.0, 0.0]
    write_scene(replace(scene, points_m=far), out, {})
    assert not (out / COPC_FILE).exists()
    note = json.loads((out / "report.json").read_text())["summary"]["notes"][-1]
    assert note == "points.copc.laz is withheld: it holds points up to 200 km from the origin"
    none = {name: getattr(scene, name)[:0] for name in vars(scene) if name.startswith(("point", "observation_"))}
    write_scene(replace(scene, **none), out, {})
    assert withheld_files(out) == []
    far[3:5] = [140_000.0, -140_000.0, 0.0], [-140_000.0, 140_000.0, 0.0]
    write_scene(replace(scene, points_m=far), out, {})
    assert np.ptp(laspy.read(out / COPC_FILE).x) == pytest.approx(280_000, rel=0.05)


def test_points_at_both_ends_of_the_reach(tmp_path: Path) -> None:
    """400 km are more steps than 32 bits with a sign count."""
    scene, path = street_of_points(50_000), tmp_path / COPC_FILE
    points_m = scene.points_m.copy()
    points_m[0], points_m[-1] = [-199_999.0, 0.0, 0.0], [199_999.0, 0.0, 0.0]
    far = replace(scene, points_m=points_m, georeference=None)
    write_copc(far, path)
    assert disagreement(far, path) is None
    assert np.ptp(laspy.read(path).x) == pytest.approx(399_998.0)
