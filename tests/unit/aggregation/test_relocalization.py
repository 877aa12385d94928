"""Which of several places a scene is put at, when its units do not all say the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.aggregation.relocalization import Matches2D3D, Relocaliser, Relocalization, matches_2d3d
from mrasfm_engine.geometry import se3
from tests.helpers.small_scenes import (
    CONFIG,
    Driven,
    configured,
    drive_along,
    make_street,
    off,
    shared_points,
    true_a_from_b,
)

FACADE_M = np.array([6.0, 2.0, 0.0])  # from one house to the next one like it


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> tuple[Driven, Driven]:
    street, folder = make_street(length_m=16.0, points=900), tmp_path_factory.mktemp("consensus")
    a = drive_along(street, folder / "a", np.arange(0.0, 14.0, 2.0))
    b = drive_along(street, folder / "b", np.arange(1.0, 15.0, 2.0), bias_m=(2.0, -1.0, 0.5), lateral_m=0.5, seed=1)
    return a, b


@pytest.fixture(scope="module")
def seen(two: tuple[Driven, Driven]) -> Matches2D3D:
    """All that b sees of a's points."""
    a, b = two
    partner = np.full(len(b.source.points_m) + 1, -1)
    pairs = shared_points(a, b)
    partner[pairs[:, 1]] = pairs[:, 0]
    rows = np.flatnonzero(partner[b.source.keypoint_point] >= 0)
    image = np.searchsorted(b.source.keypoint_first, rows, side="right") - 1
    return Matches2D3D(
        unit=b.source.image_unit[image],
        image=image,
        xy_px=b.source.keypoint_xy_px[rows].astype(np.float64),
        points_m=a.source.points_m[partner[b.source.keypoint_point[rows]]],
    )


def some(seen: Matches2D3D, counts: list[int], rng: np.random.Generator) -> Matches2D3D:
    """A given number of matches of every unit."""
    rows = [rng.choice(np.flatnonzero(seen.unit == u), count, replace=False) for u, count in enumerate(counts)]
    return seen.select(np.sort(np.concatenate(rows)))


def displaced(seen: Matches2D3D, units: list[int], street_from_a: np.ndarray) -> Matches2D3D:
    """These units take every house for the next one."""
    by = street_from_a[:3, :3].T @ FACADE_M
    return replace(seen, points_m=seen.points_m + np.isin(seen.unit, units)[:, None] * by)


def relocalised(two: tuple[Driven, Driven], seen: Matches2D3D, **aggregation: object) -> Relocalization:
    return Relocaliser(two[1].source, configured(**aggregation).aggregation, seed=0).relocalise(seen)


def place(b: Driven) -> np.ndarray:
    return b.source.trajectory_m.mean(0)


def test_units_that_agree_win_over_more_matches_that_do_not(two: tuple[Driven, Driven], seen: Matches2D3D) -> None:
    """One unit has six times the matches of any other, all at the next house: alone it would decide."""
    a, b = two
    truth = true_a_from_b(a, b)
    few = some(seen, [25, 25, 25, 240, 25, 25, 25], np.random.default_rng(0))
    wrong = displaced(few, [3], a.street_from_scene)
    found = relocalised(two, wrong)
    assert found.a_from_b is not None, found.reason
    assert found.units_agreeing == (0, 1, 2, 4, 5, 6)
    assert found.units_tried == 7
    shift, turn = off(found.a_from_b, truth, place(b))
    assert 0 < shift < 0.1
    assert 0 < turn < 0.5
    alone = relocalised(two, wrong, agreeing_units=False)
    assert alone.a_from_b is not None
    assert alone.units_agreeing == (3,)
    by = se3.apply(alone.a_from_b, place(b)[None]) - se3.apply(truth, place(b)[None])
    assert 0 < np.abs(by[0] @ a.street_from_scene[:3, :3].T - FACADE_M).max() < 0.3  # at the next house


def test_without_a_majority_nothing_is_said(two: tuple[Driven, Driven], seen: Matches2D3D) -> None:
    a, _ = two
    few = some(seen, [60] * 7, np.random.default_rng(1))
    found = relocalised(two, displaced(few, [0, 4], a.street_from_scene))
    assert found.a_from_b is not None
    assert found.units_agreeing == (1, 2, 3, 5, 6)
    assert found.runner_up == 2
    four_to_three = relocalised(two, displaced(few, [0, 2, 4], a.street_from_scene))
    assert four_to_three.a_from_b is None
    assert four_to_three.reason == "4 units agree on one place, but for 3 another is nearly as good"
    # Three at one place, two at the other, and two anywhere.
    rng = np.random.default_rng(2)
    lost = np.isin(few.unit, [5, 6])
    points = few.points_m.copy()
    points[lost] = rng.permutation(points[lost])
    split = relocalised(two, displaced(replace(few, points_m=points), [0, 2, 4], a.street_from_scene))
    assert split.a_from_b is None
    assert split.reason == "only 3 of 7 units agree how the scenes lie"
    assert split.units_tried == 7


def test_a_facade_that_repeats_for_all_units_is_refused(two: tuple[Driven, Driven], seen: Matches2D3D) -> None:
    """Every unit has its matches at the right house and nearly as many at the next one: nothing says which is right."""
    a, _ = two
    rng = np.random.default_rng(3)
    here, there = some(seen, [60] * 7, rng), some(seen, [50] * 7, rng)
    there = displaced(there, list(range(7)), a.street_from_scene)
    both = Matches2D3D(
        unit=np.concatenate([here.unit, there.unit]),
        image=np.concatenate([here.image, there.image]),
        xy_px=np.concatenate([here.xy_px, there.xy_px]),
        points_m=np.concatenate([here.points_m, there.points_m]),
    )
    found = relocalised(two, both)
    assert found.a_from_b is None
    assert "another is nearly as good" in found.reason
    assert found.runner_up >= 4
    # What repeats for one unit of seven does no harm.
    found = relocalised(two, both.select((both.unit == 3) | (np.arange(len(both.unit)) < len(here.unit))))
    assert found.a_from_b is not None
    assert found.runner_up <= 1


def test_too_few_units_or_matches(two: tuple[Driven, Driven], seen: Matches2D3D) -> None:
    rng = np.random.default_rng(4)
    least = CONFIG.aggregation.min_unit_inliers
    found = relocalised(two, some(seen, [least - 1] * 7, rng))
    assert (found.a_from_b, found.units_tried) == (None, 0)
    found = relocalised(two, some(seen, [60, 60, 0, 0, 0, 0, 0], rng))
    assert found.a_from_b is None
    assert found.reason == "2 units agree how the scenes lie, 3 are needed"
    assert relocalised(two, some(seen, [60, 60, 0, 0, 0, 0, 0], rng), min_units=2).a_from_b is not None


def test_wrong_matches_of_every_unit_are_left_out(two: tuple[Driven, Driven], seen: Matches2D3D) -> None:
    """Four of ten matches of every unit are anywhere."""
    a, b = two
    rng = np.random.default_rng(5)
    mixed = some(seen, [60] * 7, rng)
    wrong = rng.random(len(mixed.unit)) < 0.4
    points = mixed.points_m.copy()
    points[wrong] = rng.permutation(points[wrong])
    found = relocalised(two, replace(mixed, points_m=points))
    assert found.a_from_b is not None, found.reason
    assert found.units_agreeing == tuple(range(7))
    assert 0.8 * (~wrong).sum() < found.inliers < 1.05 * (~wrong).sum()
    assert 0 < off(found.a_from_b, true_a_from_b(a, b), place(b))[0] < 0.1


def test_a_pair_of_keypoint_and_point_counts_once(two: tuple[Driven, Driven]) -> None:
    """Several keypoints of a that see one point say the same."""
    a, b = (driven.source for driven in two)
    point = int(np.bincount(a.keypoint_point[a.keypoint_point >= 0]).argmax())
    rows_a = np.flatnonzero(a.keypoint_point == point)
    row_b = int(b.keypoints_with_points(0)[0])
    found = matches_2d3d(a, b, rows_a, np.full(len(rows_a), row_b))
    assert len(rows_a) > 1
    assert found.unit.tolist() == [b.image_unit[0]]
    np.testing.assert_array_equal(found.points_m, a.points_m[[point]])
