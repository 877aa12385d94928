"""Seams over which scenes without positions would join scenes whose positions contradict that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrasfm_engine.aggregation.graph import SeamGraph
from mrasfm_engine.aggregation.position_conflicts import contradicted_by_positions
from mrasfm_engine.aggregation.seam import Seam
from mrasfm_engine.config import AggregationConfig
from mrasfm_engine.geometry import se3
from tests.helpers.small_scenes import Driven, drive_along, make_street, true_a_from_b

WAY = np.arange(0.0, 12.0, 2.0)
OWN_FRAME = se3.transform(se3.exp_so3([0.1, -0.2, 2.0]), np.array([40.0, -70.0, 5.0]))


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Driven]:
    street, folder = make_street(length_m=16.0, points=300), tmp_path_factory.mktemp("conflicts")
    biases = {"a": (0.0, 0.0, 0.0), "b": (0.0, 5.0, 0.0), "high": (0.0, 0.0, 50.0), "c": (3.0, 0.0, 1.0)}
    found = {
        name: drive_along(street, folder / name, WAY, bias_m=bias_m, seed=k)
        for k, (name, bias_m) in enumerate(biases.items())
    }
    for k, name in enumerate(("u", "v")):
        found[name] = drive_along(street, folder / name, WAY + 1.0, own_frame=OWN_FRAME, seed=10 + k)
    return found


def seam(drives: dict[str, Driven], pair: str, inliers: int) -> Seam:
    a, b = pair.split("-")
    middle_m = drives[b].source.midpoint_m
    return Seam(
        a=a,
        b=b,
        accepted=True,
        reason="",
        coarse_a_from_b=np.eye(4),
        a_from_b=true_a_from_b(drives[a], drives[b]),
        covariance=1e-6 * np.eye(6),
        shared=np.zeros((0, 2), dtype=np.int64),
        units_a=np.arange(len(WAY)),
        units_b=np.arange(len(WAY)),
        place_b_m=middle_m,
        quality={"units_a": len(WAY), "units_b": len(WAY), "inliers": inliers},
    )


def refused(drives: dict[str, Driven], pairs: Sequence[str], *, position_error_m: float = 12.0) -> dict[str, str]:
    """Seams that are refused, and why; the first ones share most points."""
    names = sorted({name for pair in pairs for name in pair.split("-")})
    graph = SeamGraph(names, [seam(drives, pair, 1000 - k) for k, pair in enumerate(pairs)])
    scenes = [drives[name].source for name in names]
    found = contradicted_by_positions(graph, scenes, AggregationConfig(position_error_m=position_error_m))
    left = graph.without(found)
    assert [s.accepted for s in left.seams] == [k not in found for k in range(len(pairs))]
    return {pairs[k]: reason for k, reason in found.items()}


def test_a_scene_without_positions_joins_none_that_lie_elsewhere(drives: dict[str, Driven]) -> None:
    """A map was made of scenes 50 m above one another, and one of scenes on two continents lay within the earth."""
    found = refused(drives, ["a-u", "high-u"])
    assert list(found) == ["high-u"]
    expected = "it would join scenes a and high, whose positions contradict that by 50.0 m, more than"
    assert found["high-u"].startswith(expected) or "high and a" in found["high-u"]
    assert list(refused(drives, ["high-u", "a-u"])) == ["a-u"]
    assert refused(drives, ["a-u", "high-u"], position_error_m=60.0) == {}


def test_scenes_whose_positions_agree_are_joined_over_any_others(drives: dict[str, Driven]) -> None:
    assert refused(drives, ["a-u", "b-u", "c-u", "a-b"]) == {}
    assert refused(drives, ["a-u", "u-v", "b-v"]) == {}
    assert refused(drives, ["u-v"]) == {}


def test_the_larger_group_keeps_the_scene(drives: dict[str, Driven]) -> None:
    """Also where the seam with the other one shares more points."""
    assert list(refused(drives, ["high-u", "a-u", "a-b"])) == ["high-u"]


def test_over_several_scenes_one_seam_alone_is_refused(drives: dict[str, Driven]) -> None:
    assert len(refused(drives, ["a-u", "u-v", "high-v"])) == 1
    # Seams that close a loop of what is joined already stay: loops tell of them.
    assert list(refused(drives, ["a-u", "u-v", "a-v", "high-v"])) == ["high-v"]


def test_a_long_way_without_positions_may_drift(drives: dict[str, Driven], tmp_path: Path) -> None:
    """Scenes at both ends of it are not told apart by what it may be off by."""
    street = make_street(length_m=16.0, points=300)
    far = drive_along(street, tmp_path / "far", WAY, bias_m=(0.0, 14.0, 0.0), seed=30)
    assert list(refused({**drives, "far": far}, ["a-u", "far-u"])) == ["far-u"]
    ahead = se3.transform(np.eye(3), np.array([600.0, 0.0, 0.0]))
    source = replace(far.source, ecef_from_local=far.source.ecef_from_local @ ahead)
    moved = replace(far, source=source, street_from_scene=far.street_from_scene @ ahead)
    assert refused({**drives, "far": moved}, ["a-u", "far-u"]) == {}
