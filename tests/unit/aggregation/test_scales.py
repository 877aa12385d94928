"""Scenes without positions whose lengths are wrong get those of a scene that sees the same."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mrasfm_engine.aggregation.load import read_scene
from mrasfm_engine.aggregation.pipeline import aggregate
from mrasfm_engine.aggregation.scales import SceneScale, find_scale, stated_sigma
from mrasfm_engine.aggregation.source import SourceScene
from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.io.read_map import read_map
from mrasfm_engine.registry import load_components
from mrasfm_engine.synthetic.simulate import poses_along
from tests.helpers.small_scenes import Street, configured, drive_along, make_street

WAY = np.arange(0.0, 24.0, 2.0)
OWN_FRAME = se3.transform(se3.exp_so3([0.02, -0.05, 1.1]), [300.0, -20.0, 4.0])
LIT_LATERAL_M = 0.8
LENGTH, STATED = 0.88, 0.06


@pytest.fixture(scope="module")
def street() -> Street:
    return make_street(length_m=30.0, points=1500)


@pytest.fixture(scope="module")
def lit(street: Street, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lit") / "lit"
    return drive_along(street, folder, WAY + 1.0, lateral_m=LIT_LATERAL_M, seed=2).folder


def in_tunnel(street: Street, folder: Path, *, stated: float | None = STATED, scale: float = LENGTH) -> Path:
    """A drive without a receiver, whose scene has other lengths than the world and says how well it knows them."""
    drive_along(street, folder, WAY, own_frame=OWN_FRAME, scale=scale, seed=1)
    path = folder / "report.json"
    report = json.loads(path.read_text())
    report.setdefault("stages", []).append({"stage": "refinement", "scale": {"sigma_relative": stated}})
    path.write_text(json.dumps(report))
    return folder


def made(out: Path, *folders: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    config = configured()
    config = config.model_copy(update={"output": config.output.model_copy(update={"pictures": False})})
    report = aggregate({folder.name: folder for folder in folders}, out, config)
    return json.loads((out / "map.json").read_text()), report


def found(a: SourceScene, b: SourceScene) -> Any:
    config = configured()
    return find_scale(a, b, load_components(config, None).matcher, config, cancel=lambda: False)


def test_what_a_report_says_of_the_scale_may_be_anything(street: Street, tmp_path: Path) -> None:
    """Only a number is a statement; that a scene was scaled is a map's to say."""
    folder = in_tunnel(street, tmp_path / "tunnel")
    assert read_scene(folder, "tunnel").sigma_scale == STATED
    report = json.loads((folder / "report.json").read_text())
    for sigma in ("0.1", [0.1], None, float("nan"), float("inf"), -0.1, 10**400):
        report["stages"][-1]["scale"] = {"sigma_relative": sigma, "factor": 2.0}
        (folder / "report.json").write_text(json.dumps(report))
        scene = read_scene(folder, "tunnel")
        assert scene.sigma_scale is None
        assert stated_sigma(scene) == 0.0
        assert "factor" not in scene.report["scale"]
    report["stages"][-1]["scale"] = None
    (folder / "report.json").write_text(json.dumps(report))
    with pytest.raises(InputError) as raised:
        read_scene(folder, "tunnel")
    assert raised.value.code == "damaged-scene"


@pytest.mark.parametrize(("factor", "unexpected"), [(1.005, False), (0.95, False), (1.1, True), (0.9, True)])
def test_a_length_within_what_the_scene_states_is_expected(
    street: Street, tmp_path: Path, factor: float, unexpected: bool
) -> None:
    scene = read_scene(in_tunnel(street, tmp_path / "tunnel"), "tunnel")
    scale = SceneScale(by="lit", factor=factor, sigma=0.001, units=9)
    assert scale.is_significant
    assert scale.is_unexpected(scene) == unexpected


@pytest.mark.parametrize("scale", [0.75, 1.0, 1.3])
def test_lengths_by_another_scene(street: Street, lit: Path, tmp_path: Path, scale: float) -> None:
    a, b = read_scene(lit, "lit"), read_scene(in_tunnel(street, tmp_path / "tunnel", scale=scale), "tunnel")
    result = found(a, b)
    assert result.by == "lit"
    assert result.units >= 3
    off = abs(np.log(result.factor * scale))
    assert 1e-9 < off < max(3.0 * result.sigma, 1e-3) < 0.01


def test_a_scene_of_another_street_says_nothing(lit: Path, tmp_path: Path) -> None:
    elsewhere = in_tunnel(make_street(length_m=30.0, points=1500, seed=2), tmp_path / "tunnel")
    assert found(read_scene(lit, "lit"), read_scene(elsewhere, "tunnel")) is None


def test_all_lengths_of_a_scene_change_together(street: Street, tmp_path: Path) -> None:
    scene = read_scene(in_tunnel(street, tmp_path / "tunnel"), "tunnel")
    longer = scene.of_length(2.0)
    np.testing.assert_allclose(longer.points_m, 2.0 * scene.points_m)
    np.testing.assert_allclose(longer.world_from_cam[:, :3, 3], 2.0 * scene.world_from_cam[:, :3, 3])
    np.testing.assert_array_equal(longer.world_from_cam[:, :3, :3], scene.world_from_cam[:, :3, :3])
    np.testing.assert_allclose(longer.sigma_position_m, 2.0 * scene.sigma_position_m)
    np.testing.assert_array_equal(longer.given_rig_from_cam, scene.given_rig_from_cam)
    assert longer.fingerprint != scene.fingerprint
    # What it was made of is as it was.
    again = read_scene(tmp_path / "tunnel", "tunnel")
    assert again.fingerprint == scene.fingerprint


def test_a_scene_of_wrong_length_finds_its_place(street: Street, lit: Path, tmp_path: Path) -> None:
    document, report = made(tmp_path / "map", lit, in_tunnel(street, tmp_path / "tunnel"))
    assert document["unconnected"] == document["left_out"] == []
    assert [finding["code"] for finding in report["findings"]] == ["scene-scaled"]
    by_name = {scene["name"]: scene for scene in document["scenes"]}
    assert "scaled" not in by_name["lit"]
    scaled = by_name["tunnel"]["scaled"]
    assert scaled["from"] == "scene lit"
    assert 0.0 < abs(scaled["factor"] * LENGTH - 1.0) < 0.005
    frame = json.loads((tmp_path / "map" / "frame.json").read_text())
    street_from_map = se3.inverse(street.ecef_from_street) @ np.array(frame["ecef_from_local"])
    own = read_map(tmp_path / "map").trajectories["tunnel"].world_from_rig
    error = se3.inverse(poses_along(WAY)) @ street_from_map @ own
    assert 0.0 < np.linalg.norm(error[:, :3, 3], axis=1).max() < 0.1  # the receiver's noise is 0.05 m
    # Taken from the map, it is as long as there.
    more = drive_along(street, tmp_path / "more", WAY, lateral_m=-0.7, seed=3).folder
    config = configured()
    config = config.model_copy(update={"output": config.output.model_copy(update={"pictures": False})})
    report = aggregate({"more": more}, tmp_path / "larger", config, into=tmp_path / "map")
    assert report["findings"] == []


@pytest.mark.parametrize("stated", [0.02, None])
def test_a_scene_is_not_made_longer_than_it_may_be(
    street: Street, lit: Path, tmp_path: Path, stated: float | None
) -> None:
    """What contradicts the uncertainty that it states is rather another place that looks the same."""
    tunnel = in_tunnel(street, tmp_path / "tunnel", stated=stated)
    assert stated_sigma(read_scene(tunnel, "tunnel")) == (stated or 0.0)
    with pytest.raises(InputError, match="no seam places it"):
        made(tmp_path / "map", lit, tunnel)
