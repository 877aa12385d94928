"""Three scenes and more at once: points that are one, a loop that closes, and where positions put the whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.aggregation.assembly import Assembly
from mrasfm_engine.aggregation.multi_scene_adjustment import adjust_jointly, joined_owner
from mrasfm_engine.aggregation.seam import Seam
from tests.helpers.small_scenes import (
    CONFIG,
    Driven,
    configured,
    drive_along,
    make_street,
    noisy,
    off,
    shared_points,
    true_a_from_b,
)

BIAS_M = np.array([[0.9, -0.4, 0.3], [-0.8, 0.7, -0.5], [0.2, -0.6, 0.6]])


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> list[Driven]:
    street, folder = make_street(length_m=16.0, points=700), tmp_path_factory.mktemp("joint")
    return [
        drive_along(street, folder / str(k), np.arange(1.5 * k, 1.5 * k + 12.0, 2.0), bias_m=BIAS_M[k], seed=k)
        for k in range(3)
    ]


def seam(drives: list[Driven], i: int, j: int) -> Seam:
    a, b = drives[i], drives[j]
    pairs = shared_points(a, b)
    return Seam(
        a=a.source.name,
        b=b.source.name,
        accepted=True,
        reason="",
        coarse_a_from_b=np.eye(4),
        a_from_b=true_a_from_b(a, b),
        covariance=np.eye(6),
        shared=pairs,
        units_a=np.arange(6),
        units_b=np.arange(6),
        place_b_m=np.zeros(3),
        quality={},
    )


@pytest.fixture(scope="module")
def seams(drives: list[Driven]) -> list[Seam]:
    return [seam(drives, i, j) for i, j in ((0, 1), (1, 2), (0, 2))]


def test_points_of_three_scenes_become_one(drives: list[Driven], seams: list[Seam]) -> None:
    assembly = Assembly(scenes=[d.source for d in drives])
    owner = joined_owner(assembly, seams)
    truth = np.concatenate([d.point_of_street for d in drives])
    joined = owner >= 0
    scenes = [{int(s) for s in assembly.scene_of_point[truth == p]} for p in truth]
    np.testing.assert_array_equal(joined, [len(s) > 1 for s in scenes])
    # One to one with the street's points, numbered without gaps.
    assert len(np.unique(np.column_stack([owner[joined], truth[joined]]), axis=0)) == owner.max() + 1
    assert len(np.unique(truth[joined])) == owner.max() + 1
    # Two seams join the same points as three do, but for those that scene 1 does not have.
    chain = joined_owner(assembly, seams[:2])
    assert 0 < (chain >= 0).sum() <= joined.sum()


def test_two_points_of_one_scene_are_never_joined(drives: list[Driven], seams: list[Seam]) -> None:
    """One seam says that two points of scene 0 are one point of scene 1, by way of scene 2."""
    shifted = seams[2].shared.copy()
    shifted[:, 1] = np.roll(shifted[:, 1], 3)
    assembly = Assembly(scenes=[d.source for d in drives])
    owner = joined_owner(assembly, [*seams[:2], replace(seams[2], shared=shifted)])
    for k in range(3):
        own = owner[assembly.first_point[k] : assembly.first_point[k + 1]]
        own = own[own >= 0]
        assert len(np.unique(own)) == len(own)


def test_all_scenes_are_adjusted_at_once(drives: list[Driven], seams: list[Seam]) -> None:
    """From a chain whose errors add up to decimetres, all transforms come out right; the fixed one stays."""
    rng = np.random.default_rng(0)
    assembly = Assembly(scenes=[d.source for d in drives])
    truth = np.stack([true_a_from_b(drives[1], d) for d in drives])
    start = np.stack([p if k == 1 else noisy(p, rng, m=0.1, deg=0.2) for k, p in enumerate(truth)])
    found = adjust_jointly(assembly, start, seams, 1, CONFIG, cancel=lambda: False)
    assert found.report is not None
    assert found.report.pose_parameters == 12
    np.testing.assert_allclose(found.first_from_scene[1], start[1], atol=1e-12)
    for k in (0, 2):
        at = drives[k].source.midpoint_m
        assert off(start[k], truth[k], at)[0] > 0.05
        shift, turn = off(found.first_from_scene[k], truth[k], at)
        assert 0 < shift < 0.015
        assert 0 < turn < 0.1
    without = adjust_jointly(assembly, start, seams, 1, configured(multi_scene_adjustment=False), cancel=lambda: False)
    assert without.report is None
    np.testing.assert_array_equal(without.first_from_scene, start)
