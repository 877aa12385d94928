"""Scenes without positions are compared with those whose images look most like theirs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrasfm_engine.aggregation.image_search import similar_images, similar_scenes
from mrasfm_engine.aggregation.source import SourceScene
from mrasfm_engine.config import AggregationConfig
from mrasfm_engine.errors import CancelledError
from tests.helpers.small_scenes import drive_along, make_street

WAY = np.arange(0.0, 12.0, 2.0)
FRAME = np.eye(4)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, SourceScene]:
    """Drives in two streets, one of them without positions in the first street."""
    folder = tmp_path_factory.mktemp("search")
    streets = [make_street(length_m=20.0, points=500, seed=seed) for seed in (0, 1)]

    def driven(name: str, street: int, first_m: float, own_frame: np.ndarray | None = None) -> SourceScene:
        place: Path = folder / name
        return drive_along(streets[street], place, WAY + first_m, own_frame=own_frame, seed=len(name)).source

    return {
        "lost": driven("lost", 0, 1.0, FRAME),
        "first": driven("first", 0, 0.0),
        "second": driven("second", 0, 3.0),
        "elsewhere": driven("elsewhere", 1, 0.0),
        "far-away": driven("far-away", 1, 3.0),
    }


def compared(scenes: list[SourceScene], candidates: int) -> set[tuple[str, str]]:
    pairs = similar_scenes(scenes, AggregationConfig(candidates=candidates))
    assert all(i < j for i, j in pairs)
    return {(scenes[i].name, scenes[j].name) for i, j in pairs}


def test_the_most_similar_scenes_are_compared(scenes: dict[str, SourceScene]) -> None:
    found = [scenes[name] for name in ("elsewhere", "far-away", "first", "lost", "second")]
    assert compared(found, 2) == {("first", "lost"), ("lost", "second")}
    assert len(compared(found, 4)) == 4
    assert compared([scene for scene in found if scene.is_placed], 2) == set()


def test_components_of_its_drive_come_besides(scenes: dict[str, SourceScene]) -> None:
    found = [scenes["elsewhere"], scenes["first"], scenes["lost"], replace(scenes["lost"], name="lost#1")]
    assert compared(found, 1) == {("first", "lost"), ("first", "lost#1"), ("lost", "lost#1")}


def test_units_are_looked_for_where_images_look_alike(scenes: dict[str, SourceScene]) -> None:
    first, lost = scenes["first"], scenes["lost"]
    probes = similar_images(first, lost, AggregationConfig())
    assert {probe.unit for probe in probes} == set(range(len(WAY)))
    for probe in probes:
        assert (lost.image_unit[probe.pairs[:, 1]] == probe.unit).all()
        best = probe.pairs[np.arange(0, len(probe.pairs), 8)]  # of each image
        apart_m = np.abs(WAY[first.image_unit[best[:, 0]]] - (WAY[probe.unit] + 1.0))
        assert np.median(apart_m) < 4.0
        assert (first.image_camera[best[:, 0]] == lost.image_camera[best[:, 1]]).mean() > 0.5


def test_the_search_can_be_cancelled(scenes: dict[str, SourceScene]) -> None:
    found = [scenes[name] for name in ("elsewhere", "far-away", "first", "lost", "second")]
    with pytest.raises(CancelledError):
        similar_scenes(found, AggregationConfig(candidates=2), cancel=lambda: True)
    with pytest.raises(CancelledError):
        similar_images(scenes["first"], scenes["lost"], AggregationConfig(), cancel=lambda: True)
