"""Which scene gives another one its length, where scenes are measured in one another in turn."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mrasfm_engine.aggregation import stages
from mrasfm_engine.aggregation.association import Association
from mrasfm_engine.aggregation.scales import SceneScale, stated_sigma
from mrasfm_engine.aggregation.source import SourceScene
from mrasfm_engine.aggregation.vehicles import corrected, vehicles_of
from mrasfm_engine.io.stage_store import StageStore
from tests.helpers.small_scenes import Street, configured, drive_along, make_street

LIT, NEAR, FAR = 0, 1, 2
ALL = ((LIT, NEAR), (LIT, FAR), (NEAR, FAR))
STATED = 0.06


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> SourceScene:
    street: Street = make_street(length_m=8.0, points=200)
    return drive_along(street, tmp_path_factory.mktemp("scene") / "lit", np.arange(0.0, 8.0, 2.0)).source


class Lengths:
    """Scenes `lit`, which has positions, `near` and `far`, and what they say of one another instead of images."""

    def __init__(self, source: SourceScene, monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
        unplaced = replace(source, is_placed=False, report={"scale": {"sigma_relative": STATED}})
        self.scenes = [source, replace(unplaced, name="near"), replace(unplaced, name="far")]
        self.says: dict[tuple[str, str], tuple[float, float]] = {}  # factor and sigma by scene, and by the one measured
        self.asked: list[tuple[str, str]] = []
        self.folder = folder
        monkeypatch.setattr(stages, "find_scale", self._found)

    def _found(self, a: SourceScene, b: SourceScene, *_: Any, **__: Any) -> SceneScale | None:
        self.asked.append((a.name, b.name))
        factor, sigma = self.says.get((a.name, b.name), (0.0, 0.0))
        return SceneScale(by=a.name, factor=factor, sigma=sigma, units=5, sigma_by=stated_sigma(a)) if factor else None

    def at_length(
        self, pairs: tuple[tuple[int, int], ...] = ALL, *, into: Path | None = None
    ) -> tuple[list[SourceScene], list[str]]:
        """The scenes, and the findings."""
        run = stages.Run(configured(), StageStore(self.folder / ".stages"), into, lambda *_: None, lambda: False)
        known = Association(reference=LIT, map_from_scene=np.tile(np.eye(4), (3, 1, 1)), pairs=pairs)
        return stages.at_length(run, self.scenes, known), [str(finding["what"]) for finding in run.report["findings"]]


@pytest.fixture
def lengths(source: SourceScene, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Lengths:
    return Lengths(source, monkeypatch, tmp_path)


def factor_of(scene: SourceScene) -> float:
    return float(scene.report["scale"].get("factor", 1.0))


def test_a_measured_scene_measures_others(lengths: Lengths) -> None:
    lengths.says = {("lit", "near"): (1.1, 0.003), ("near", "far"): (0.9, 0.004)}
    (_, near, far), findings = lengths.at_length(((LIT, NEAR), (NEAR, FAR)))
    assert (factor_of(near), factor_of(far)) == (1.1, 0.9)
    assert far.report["scale"]["from"] == "scene near"
    assert far.sigma_scale == pytest.approx(0.005), "its own and that of the scene that measures it"
    assert len(findings) == 2


def test_a_scene_whose_length_is_contradicted_measures_no_other(lengths: Lengths) -> None:
    lengths.says = {("lit", "near"): (2.0, 0.001), ("near", "far"): (1.1, 0.001)}
    (_, near, far), findings = lengths.at_length(((LIT, NEAR), (NEAR, FAR)))
    assert (factor_of(near), factor_of(far)) == (1.0, 1.0)
    assert findings == []


def test_a_length_that_cannot_be_does_not_hide_one_that_can(lengths: Lengths) -> None:
    """The sharper one is of another place that looks the same."""
    lengths.says = {("lit", "near"): (1.1, 0.003), ("lit", "far"): (2.0, 0.001), ("near", "far"): (1.05, 0.003)}
    (_, _, far), _ = lengths.at_length()
    assert far.report["scale"]["from"] == "scene near"


def test_scenes_of_a_map_that_is_extended_stay_as_long_as_there(lengths: Lengths) -> None:
    """The map was made at this length; what another scene says of it is not said of the scene by itself."""
    lengths.says = {("lit", "near"): (1.1, 0.003)}
    lengths.scenes, _ = lengths.at_length()
    near = lengths.scenes[NEAR]
    document = {"version": 1, "scenes": [{"name": "near", "fingerprint": near.fingerprint}], "seams": []}
    (lengths.folder / "map.json").write_text(json.dumps(document))
    (lengths.folder / "report.json").write_text("{}")
    lengths.says = {("lit", "near"): (1.002, 0.0005), ("near", "far"): (1.1, 0.003)}
    (_, again, far), findings = lengths.at_length(into=lengths.folder)
    assert again is near
    assert factor_of(again) == 1.1
    assert factor_of(far) == 1.1
    assert len(findings) == 1


def test_lengths_are_not_measured_again(lengths: Lengths) -> None:
    """A run that goes on where another was killed finds them, to the last bit: seams are those of this length."""
    lengths.says = {("lit", "near"): (1.1, 0.003), ("near", "far"): (0.9, 0.004)}
    before, findings = lengths.at_length()
    assert len(lengths.asked) == 3
    again, found_again = lengths.at_length()
    assert len(lengths.asked) == 3
    assert [scene.fingerprint for scene in again] == [scene.fingerprint for scene in before]
    assert found_again == findings
    lengths.scenes[FAR] = replace(lengths.scenes[FAR], points_m=1.01 * lengths.scenes[FAR].points_m)
    lengths.at_length()
    assert len(lengths.asked) == 6


def test_the_nearest_to_positions_decides(lengths: Lengths) -> None:
    """The uncertainty of a scene that was measured itself counts too."""
    lengths.says = {("lit", "near"): (1.1, 0.01), ("lit", "far"): (1.05, 0.005), ("near", "far"): (1.07, 0.002)}
    (_, _, far), _ = lengths.at_length()
    assert far.report["scale"]["from"] == "scene lit"


def with_rig(source: SourceScene, name: str, found_m: np.ndarray, given_m: np.ndarray) -> SourceScene:
    """The scene of a drive of a vehicle whose cameras have found positions (c, 3), and given ones."""
    calibration = json.loads(json.dumps(source.calibration)) | {"adjusted": True}
    cameras = []
    for camera, at_m, declared_m in zip(source.manifest.rig.cameras, found_m.tolist(), given_m.tolist(), strict=True):
        pose = camera.rig_from_cam.model_copy(update={"translation_m": at_m})
        cameras.append(camera.model_copy(update={"rig_from_cam": pose}))
        document = calibration["cameras"][camera.name]
        document["given"]["rig_from_cam"]["translation_m"] = declared_m
        document["repeatability"] = {"rotation_deg": [0.1] * 3, "translation_m": [0.01] * 3}
    rig = source.manifest.rig.model_copy(update={"cameras": cameras})
    manifest = source.manifest.model_copy(update={"rig": rig, "vehicle": "van"})
    return replace(source, name=name, manifest=manifest, calibration=calibration)


def test_a_vehicle_does_not_learn_where_the_rig_of_a_scaled_scene_has_its_origin(source: SourceScene) -> None:
    """A rig gets longer about its origin, so that all of its cameras move together; images do not show that."""
    given_m = np.stack([pose[:3, 3] for pose in source.drive.rig_from_cam])
    assert np.linalg.norm(given_m.mean(0)) > 1.0
    longer_m = given_m + 0.1 * (given_m - given_m.mean(0))  # by positions, without a common motion
    lit, dark = with_rig(source, "lit", longer_m, given_m), with_rig(source, "dark", given_m, given_m)
    dark = stages._of_length(dark, SceneScale(by="lit", factor=1.1, sigma=0.001, units=5))
    (vehicle,) = vehicles_of([lit, dark], configured().bundle_adjustment)
    assert vehicle.knocked == []
    assert 0.0 < vehicle.deviation_m < 0.01
    for told in vehicle.expected.values():
        assert 0.0 < np.abs(told.correction[:, 3:6]).max() < 0.02


def test_a_component_that_was_scaled_does_not_get_the_vehicles_correction_twice(source: SourceScene) -> None:
    given_m = np.stack([pose[:3, 3] for pose in source.drive.rig_from_cam])
    longer_m = given_m + 0.1 * (given_m - given_m.mean(0))
    lit, dark = with_rig(source, "lit", longer_m, given_m), with_rig(source, "dark", given_m, given_m)
    part = replace(dark, name="dark#2")
    scaled = stages._of_length(part, SceneScale(by="lit", factor=1.1, sigma=0.001, units=5))
    expected_m = []
    for scene in (part, scaled):
        (vehicle,) = vehicles_of([lit, dark, scene], configured().bundle_adjustment)
        told = vehicle.expected[2]
        expected_m.append(corrected(scene.drive.rig_from_cam, told.correction[:, :6])[:, :3, 3])
    expected_m = [at_m - at_m.mean(0) for at_m in expected_m]
    np.testing.assert_allclose(expected_m[1], expected_m[0], atol=1e-9)
    assert 0.0 < np.abs(expected_m[0] - (longer_m - longer_m.mean(0))).max() < 0.02
