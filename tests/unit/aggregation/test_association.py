"""Where positions put scenes, and which of them are compared."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from pyproj import Transformer

from mrasfm_engine.aggregation import association
from mrasfm_engine.aggregation.association import associate, choose_pairs, coarse_transform
from mrasfm_engine.aggregation.load import read_scene
from mrasfm_engine.aggregation.pairs import SIGHT_SHIFT_M, nearest_distance_m
from mrasfm_engine.aggregation.source import SourceScene
from mrasfm_engine.config import AggregationConfig
from mrasfm_engine.export.scene import write_scene
from mrasfm_engine.geometry import geodesy, se3
from tests.helpers.export_example import make_scene


def test_the_best_candidates_of_every_scene_are_compared() -> None:
    scores = {(i, j): (1.0 / (j - i),) for i, j in combinations(range(6), 2)}
    chosen = choose_pairs(6, scores, 2)
    assert {(i, i + 1) for i in range(5)} <= set(chosen)
    assert len(chosen) < len(scores)


def test_two_streets_that_cross_are_compared_with_one_another() -> None:
    """Four drives along each: every one has three better candidates in its own street."""
    street = [0, 0, 0, 0, 1, 1, 1, 1]
    scores = {(i, j): (0.9 if street[i] == street[j] else 0.1 + 0.01 * i, -1.0) for i, j in combinations(range(8), 2)}
    across = [pair for pair in choose_pairs(8, scores, 3) if street[pair[0]] != street[pair[1]]]
    assert len(across) == 3
    assert all(i == 3 for i, _ in across)  # the best of them


def test_what_is_out_of_reach_is_compared_with_nothing() -> None:
    assert choose_pairs(3, {(0, 1): (0.5, -1.0)}, 3) == [(0, 1)]
    assert choose_pairs(3, {}, 3) == []


def test_what_is_compared_place_by_place_is_what_may_come_near(
    scene: SourceScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Scenes along a street of 60 degrees, one of them 400 m up: only neighbours are measured, and none is missed."""
    compared: list[tuple[str, str]] = []

    def counted(a: SourceScene, b: SourceScene, a_from_b: np.ndarray) -> float:
        compared.append((a.name, b.name))
        return nearest_distance_m(a, b, a_from_b)

    monkeypatch.setattr(association, "nearest_distance_m", counted)
    scenes = [
        at(scene, f"{k:02d}", [48.1 + 0.00015 * k, 11.5 + 0.0004 * k, 520.0 + 400.0 * (k == 7)]) for k in range(30)
    ]  # fmt: skip
    config = AggregationConfig(position_error_m=60.0, candidates=30)
    near = {
        (a.name, b.name)
        for a, b in combinations(scenes, 2)
        if nearest_distance_m(a, b, coarse_transform(a, b)) <= 60.0 + SIGHT_SHIFT_M
    }
    found = {(scenes[i].name, scenes[j].name) for i, j in associate(scenes, config).pairs}
    assert found == near >= {(f"{k:02d}", f"{k + 1:02d}") for k in range(29)}
    assert near <= set(compared)
    assert len(compared) < 30 * 8


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SourceScene:
    folder = tmp_path_factory.mktemp("association") / "scene"
    write_scene(make_scene(), folder, {"settings": {"features": {"extractor": "sift"}}})
    return read_scene(folder, "scene")


def at(scene: SourceScene, name: str, place: list[float], **changes: object) -> SourceScene:
    return replace(scene, name=name, ecef_from_local=geodesy.ecef_from_local(place), **changes)


def by_proj(points: np.ndarray, place: list[float], other: list[float]) -> np.ndarray:
    """Points of the east-north-up frame at one place in that at another, as PROJ computes it."""
    here, there = (f"+proj=topocentric +ellps=WGS84 +lat_0={p[0]} +lon_0={p[1]} +h_0={p[2]}" for p in (place, other))
    pipeline = Transformer.from_pipeline(f"+proj=pipeline +step +inv {here} +step {there}")
    return np.stack(pipeline.transform(*points.T), -1)


PLACE = [48.1, 11.5, 520.0]


@pytest.mark.parametrize(
    ("other", "least_m"),
    [([48.5, 12.7, 340.0], 500.0), ([48.1003, 11.5004, 523.0], 1e-4), ([47.2, 11.5, 600.0], 500.0)],
)
def test_frames_of_different_origins_are_combined_through_earth_centred_coordinates(
    scene: SourceScene, other: list[float], least_m: float
) -> None:
    """What subtracting the origins' coordinates would do is wrong by the earth's curvature: 800 m at 100 km."""
    a, b = at(scene, "a", PLACE), at(scene, "b", other)
    points = scene.points_m
    expected = by_proj(points, other, PLACE)
    assert 0 < np.abs(se3.apply(coarse_transform(a, b), points) - expected).max() < 1e-6
    earth = 6371e3 * np.radians(1.0)
    origin = [(other[1] - PLACE[1]) * earth * np.cos(np.radians(PLACE[0])), (other[0] - PLACE[0]) * earth]
    flat = points + np.array([*origin, other[2] - PLACE[2]])
    assert np.abs(flat - expected).max() > least_m
    if least_m > 1:  # and the other's axes are inclined
        origin_m = by_proj(np.zeros((1, 3)), other, PLACE)
        assert np.abs(points + origin_m - expected).max() > 0.1


def test_the_map_has_the_frame_of_the_scene_in_the_middle(scene: SourceScene) -> None:
    """Three of them on a line of 100 km: what is in the middle is the reference, and nothing is compared."""
    places = {"east": [48.1, 12.2, 400.0], "west": [48.1, 10.8, 600.0], "middle": [48.1, 11.5, 520.0]}
    scenes = [at(scene, name, place) for name, place in places.items()]
    found = associate(scenes, AggregationConfig())
    assert (found.reference, found.pairs) == (2, ())
    np.testing.assert_allclose(found.map_from_scene[2], np.eye(4), atol=1e-8)
    for k, place in enumerate(places.values()):
        expected = by_proj(scene.points_m, place, places["middle"])
        assert np.abs(se3.apply(found.map_from_scene[k], scene.points_m) - expected).max() < 1e-6
    # Of two there is no middle: more units, then the smaller name decides.
    assert associate(scenes[:2], AggregationConfig()).reference == 0
    one_less = scene.unit_registered.copy()
    one_less[0] = False
    fewer = at(scene, "east", places["east"], unit_registered=one_less)
    assert associate([fewer, scenes[1]], AggregationConfig()).reference == 1
    assert associate([at(scene, "b", PLACE), at(scene, "a", PLACE)], AggregationConfig()).reference == 1


def test_scenes_within_reach_are_compared(scene: SourceScene) -> None:
    near, far = [48.1, 11.50005, 520.0], [48.1, 11.52, 520.0]
    found = associate([at(scene, "a", PLACE), at(scene, "b", near), at(scene, "c", far)], AggregationConfig())
    assert found.pairs == ((0, 1),)


def test_frames_at_the_date_line_and_near_the_pole(scene: SourceScene) -> None:
    for place, other in (([0.1, 179.9999, 10.0], [0.1, -179.9999, 10.0]), ([89.999, 10.0, 0.0], [89.999, -170.0, 0.0])):
        found = se3.apply(coarse_transform(at(scene, "a", place), at(scene, "b", other)), scene.points_m)
        assert 0 < np.abs(found - by_proj(scene.points_m, other, place)).max() < 1e-6
        assert np.linalg.norm(found.mean(0)) < 500.0
