"""Components of a drive without GNSS are scenes of a map: a drive with positions that covers the gap joins them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mrasfm_engine.aggregation import stages
from mrasfm_engine.aggregation.association import associate
from mrasfm_engine.aggregation.load import read_scene
from mrasfm_engine.aggregation.pipeline import aggregate
from mrasfm_engine.errors import InputError
from mrasfm_engine.export import readers
from mrasfm_engine.geometry import se3
from mrasfm_engine.io.read_map import read_map
from mrasfm_engine.io.stage_store import StageStore
from mrasfm_engine.synthetic.simulate import poses_along
from tests.helpers.small_scenes import Street, configured, drive_along, make_street

UNITS, DARK = 16, range(7, 10)
LIT_LATERAL_M = 0.8
WAY = np.arange(0.0, 2.0 * UNITS, 2.0)
FRAMES = (
    se3.transform(se3.exp_so3([0.02, -0.05, 1.1]), [300.0, -20.0, 4.0]),
    se3.transform(se3.exp_so3([-0.04, 0.01, -2.3]), [-70.0, 15.0, -9.0]),
)


@pytest.fixture(scope="module")
def street() -> Street:
    return make_street(length_m=36.0, points=1500)


@pytest.fixture(scope="module")
def elsewhere() -> Street:
    return make_street(length_m=36.0, points=1500, seed=2)


def in_components(street: Street, beyond: Street, folder: Path) -> None:
    """A drive without a receiver whose images of some units were dark: two components in frames of their own.

    The second one is driven in the street `beyond`.
    """
    late, early = range(DARK.start, UNITS), range(DARK.stop)
    drive_along(street, folder, WAY, own_frame=FRAMES[0], missing_units=late, seed=1)
    drive_along(beyond, folder / "components" / "1", WAY, own_frame=FRAMES[1], missing_units=early, component=1, seed=1)
    path = folder / "poses.json"
    poses = json.loads(path.read_text())
    for unit in range(DARK.stop, UNITS):
        poses["units"][unit]["component"] = 1
    path.write_text(json.dumps(poses))


@pytest.fixture(scope="module")
def folders(street: Street, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("components")
    in_components(street, street, folder / "tunnel")
    return {
        "tunnel": folder / "tunnel",
        "lit": drive_along(street, folder / "lit", WAY + 1.0, lateral_m=LIT_LATERAL_M, seed=2).folder,
    }


def made(folders: dict[str, Path], out: Path, **options: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    config = configured()
    config = config.model_copy(update={"output": config.output.model_copy(update={"pictures": False})})
    report = aggregate(folders, out, config, **options)
    return json.loads((out / "map.json").read_text()), report


@pytest.fixture(scope="module")
def result(folders: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    out = tmp_path_factory.mktemp("map") / "out"
    return made(folders, out)[0], out


def test_a_component_has_its_own_units_alone(folders: dict[str, Path]) -> None:
    largest = read_scene(folders["tunnel"], "tunnel")
    other = read_scene(folders["tunnel"] / "components" / "1", "tunnel#1")
    assert not largest.is_placed
    assert not other.is_placed
    assert largest.unit_registered.tolist() == [True] * DARK.start + [False] * len(DARK)
    assert other.unit_registered.all()
    assert [frame.source_frame for frame in other.manifest.frames] == list(range(DARK.stop, UNITS))
    assert len(other.keypoint_first) == len(other.image_unit) + 1
    assert other.keypoint_first[-1] == len(other.keypoint_point)


def test_both_components_lie_where_they_were_driven(result: tuple[dict[str, Any], Path], street: Street) -> None:
    document, out = result
    assert document["unconnected"] == document["left_out"] == []
    accepted = {(seam["a"], seam["b"]) for seam in document["seams"] if seam["accepted"]}
    assert {("lit", "tunnel"), ("lit", "tunnel#1")} <= accepted
    for seam in document["seams"]:
        assert "positions_off_m" not in seam
    units = [unit for unit in json.loads((out / "poses.json").read_text())["units"] if unit["registered"]]
    assert len(units) == 2 * UNITS - len(DARK)
    frame = json.loads((out / "frame.json").read_text())
    street_from_map = se3.inverse(street.ecef_from_street) @ np.array(frame["ecef_from_local"])
    driven = {"lit": WAY + 1.0, "tunnel": WAY[: DARK.start], "tunnel#1": WAY[DARK.stop :]}
    for name, trajectory in read_map(out).trajectories.items():
        aside = se3.transform(np.eye(3), [0.0, LIT_LATERAL_M if name == "lit" else 0.0, 0.0])
        error = se3.inverse(poses_along(driven[name]) @ aside) @ street_from_map @ trajectory.world_from_rig
        assert 0 < np.linalg.norm(error[:, :3, 3], axis=1).max() < 0.08, name  # the receiver's noise is 0.05 m
        assert 0 < np.degrees(np.linalg.norm(se3.log_so3(error[:, :3, :3]), axis=-1)).max() < 0.2, name


def test_files_of_the_map_name_them(result: tuple[dict[str, Any], Path]) -> None:
    _, out = result
    assert {path.name for path in (out / "calibration").iterdir()} == {"lit.json", "tunnel.json", "tunnel#1.json"}
    points = readers.ply(out / "points.ply")
    assert (points["component"] == 0).all()


@pytest.mark.slow
def test_adding_to_the_map_reuses_seams_and_removing_a_drive_takes_its_components(
    result: tuple[dict[str, Any], Path], folders: dict[str, Path], street: Street, tmp_path: Path
) -> None:
    more = drive_along(street, tmp_path / "more", WAY, lateral_m=-0.7, seed=3).folder
    document, report = made({"more": more}, tmp_path / "larger", into=result[1])
    seams = next(stage for stage in report["stages"] if stage["stage"] == "seams")
    assert seams["pairs_reused"] == 3  # of lit, tunnel and tunnel#1 with one another
    assert sorted(scene["name"] for scene in document["scenes"]) == ["lit", "more", "tunnel", "tunnel#1"]
    document, _ = made({}, tmp_path / "without", into=tmp_path / "larger", remove=["tunnel"])
    assert sorted(scene["name"] for scene in document["scenes"]) == ["lit", "more"]
    document, _ = made({}, tmp_path / "without one", into=tmp_path / "larger", remove=["tunnel#1"])
    assert sorted(scene["name"] for scene in document["scenes"]) == ["lit", "more", "tunnel"]


@pytest.mark.slow
def test_a_component_that_nothing_places_is_left_out_with_the_reason(
    street: Street, elsewhere: Street, tmp_path: Path
) -> None:
    """Nobody else has been where its units are."""
    in_components(street, elsewhere, tmp_path / "tunnel")
    short = [drive_along(street, tmp_path / name, WAY[:5], lateral_m=side, seed=seed).folder
             for name, side, seed in (("one", 0.6, 4), ("two", -0.6, 5))]  # fmt: skip
    document, report = made({"tunnel": tmp_path / "tunnel", "one": short[0], "two": short[1]}, tmp_path / "map")
    assert sorted(scene["name"] for scene in document["scenes"]) == ["one", "tunnel", "two"]
    (left_out,) = document["left_out"]
    assert left_out["name"] == "tunnel#1"
    assert "no seam places it: with one: " in left_out["reason"]
    assert [finding["code"] for finding in report["findings"]] == ["scene-left-out"]
    assert report["left_out"][0]["code"] == "not-georeferenced"


@pytest.mark.slow
def test_a_component_that_nothing_places_is_an_error_where_all_are_required(
    street: Street, elsewhere: Street, tmp_path: Path
) -> None:
    in_components(street, elsewhere, tmp_path / "tunnel")
    lit = drive_along(street, tmp_path / "lit", WAY[:5], lateral_m=0.6, seed=4).folder
    with pytest.raises(InputError, match="scene tunnel#1 is not georeferenced, and no seam places it") as raised:
        made({"tunnel": tmp_path / "tunnel", "lit": lit}, tmp_path / "map", require_components=True)
    assert raised.value.code == "not-georeferenced"
    assert not (tmp_path / "map" / "map.json").exists()


@pytest.mark.slow
def test_a_component_keeps_its_place_whatever_is_added(
    result: tuple[dict[str, Any], Path], street: Street, folders: dict[str, Path], tmp_path: Path
) -> None:
    """With one candidate, a drive that looks more like it than the one whose seam places it takes that one's turn."""
    config = configured()
    changes = {
        "output": config.output.model_copy(update={"pictures": False}),
        "aggregation": config.aggregation.model_copy(update={"candidates": 1}),
    }
    run = stages.Run(config.model_copy(update=changes), StageStore(tmp_path), result[1], lambda *_: None, lambda: False)
    more = {f"more{k}": drive_along(street, tmp_path / f"more{k}", WAY, lateral_m=0.1 * k, seed=1).folder
            for k in range(2)}  # fmt: skip
    found = stages.scenes(run, more, [])
    names = [scene.name for scene in found]
    known = stages.association(run, found)
    assert {(names[i], names[j]) for i, j in known.pairs} >= {("lit", "tunnel"), ("lit", "tunnel#1")}
    before = associate(found, run.config.aggregation)
    assert not {(names[i], names[j]) for i, j in before.pairs} & {("lit", "tunnel"), ("lit", "tunnel#1")}
    made = {seam.a + seam.b for seam in stages.seams(run, found, known.of_scenes(range(len(found)))) if seam.accepted}
    assert "littunnel#1" in made


def test_components_of_one_drive_are_no_map(street: Street, tmp_path: Path) -> None:
    folder = drive_along(street, tmp_path / "lit", WAY[:4], seed=4).folder
    drive_along(street, folder / "components" / "1", WAY[:4], lateral_m=0.5, component=1, seed=5)
    with pytest.raises(InputError, match="a map needs 2 drives, this would have 1") as raised:
        made({"lit": folder}, tmp_path / "map")
    assert raised.value.code == "one-scene"


def test_a_drive_that_nothing_places_is_an_error_unless_it_may_be_left_out(
    street: Street, elsewhere: Street, tmp_path: Path
) -> None:
    alone = drive_along(elsewhere, tmp_path / "elsewhere", WAY[:6], own_frame=FRAMES[0], seed=6).folder
    folders = {"elsewhere": alone} | {
        name: drive_along(street, tmp_path / name, WAY[:6], lateral_m=side, seed=seed).folder
        for name, side, seed in (("one", 0.6, 4), ("two", -0.6, 5))
    }
    with pytest.raises(InputError, match="scene elsewhere is not georeferenced, and no seam places it") as raised:
        made(folders, tmp_path / "map")
    assert raised.value.code == "not-georeferenced"
    assert not (tmp_path / "map" / "map.json").exists()
    document, _ = made(folders, tmp_path / "map", leave_out=True)
    assert [scene["name"] for scene in document["left_out"]] == ["elsewhere"]
