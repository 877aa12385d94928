"""Which images of two scenes are compared: footprints, and pairs by how the scenes lie."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.aggregation.footprint import footprints, overlaps, rig_height_m
from mrasfm_engine.aggregation.pairs import common_view, guided_pairs, nearest_distance_m, probes, thinned
from mrasfm_engine.geometry import se3
from tests.helpers.small_scenes import CONFIG, Driven, drive_along, make_street, true_a_from_b

SETTINGS = CONFIG.aggregation
FRONT, LEFT, RIGHT, BACK = range(4)


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Driven]:
    street, folder = make_street(length_m=26.0, points=900), tmp_path_factory.mktemp("pairs")
    way = np.arange(0.0, 24.0, 2.0)
    return {
        "a": drive_along(street, folder / "a", way),
        "same": drive_along(street, folder / "same", way + 1.0, bias_m=(3.0, 0.0, 0.0), seed=1),
        "back": drive_along(street, folder / "back", way[::-1] + 1.0, lateral_m=-0.5, back=True, seed=2),
        "one camera": drive_along(street, folder / "one", way, cameras=1, seed=3),
        "one camera back": drive_along(street, folder / "one-back", way[::-1], cameras=1, back=True, seed=4),
    }


def ahead(a: Driven, b: Driven, metres: float) -> np.ndarray:
    """How b would lie if it were so far along the street."""
    along = a.source.trajectory_m[-1] - a.source.trajectory_m[0]
    return se3.transform(np.eye(3), metres * along / np.linalg.norm(along)) @ true_a_from_b(a, b)


def image_of(driven: Driven, unit: int, camera: int) -> int:
    return int(np.flatnonzero((driven.source.image_unit == unit) & (driven.source.image_camera == camera))[0])


def overlap(a: Driven, b: Driven, images: list[tuple[int, int]], a_from_b: np.ndarray | None = None) -> np.ndarray:
    depth = SETTINGS.max_depth_m
    return overlaps(
        np.array(images),
        a.source,
        b.source,
        a_from_b=true_a_from_b(a, b) if a_from_b is None else a_from_b,
        samples=(footprints(a.source, depth), footprints(b.source, depth)),
        max_depth_m=depth,
    )


def test_footprints_end_at_the_ground_and_at_the_end_of_sight(drives: dict[str, Driven]) -> None:
    """The rig's origin is on the ground."""
    a = drives["a"].source
    height = rig_height_m(a)
    assert 0 <= abs(height) < 0.3
    found = footprints(a, 30.0)
    in_rig = se3.apply(a.drive.rig_from_cam, found)
    assert found.shape == (4, 120, 3)
    assert -height - 1e-9 <= in_rig[..., 2].min() < -height + 0.01
    assert 25.0 < found[..., 2].max() < 30.0 * 1.3
    assert footprints(a, 30.0) is found


def test_overlap_says_which_cameras_see_the_same(drives: dict[str, Driven]) -> None:
    a, same, back = drives["a"], drives["same"], drives["back"]
    unit = 5
    fronts, front_back, front_left = overlap(
        a, same, [(image_of(a, unit, FRONT), image_of(same, unit, c)) for c in (FRONT, BACK, LEFT)]
    )
    assert 0.6 < fronts <= 1
    assert front_back == 0
    assert 0 <= front_left < 0.3
    # A vehicle that comes the other way: unit 11 - 5 of it is where unit 5 of a is.
    to_front, to_back = overlap(
        a, back, [(image_of(a, unit, FRONT), image_of(back, 11 - unit, c)) for c in (FRONT, BACK)]
    )
    assert to_front == 0
    assert 0.5 < to_back <= 1


def test_overlap_falls_with_the_distance(drives: dict[str, Driven]) -> None:
    a, same = drives["a"], drives["same"]
    pair = [(image_of(a, 5, FRONT), image_of(same, 5, FRONT))]
    found = [float(overlap(a, same, pair, ahead(a, same, m))[0]) for m in (0.0, 8.0, 20.0, 90.0)]
    assert found[0] > found[1] > found[2] > found[3] == 0


@pytest.mark.parametrize(
    ("other", "partner"), [("same", [FRONT, LEFT, RIGHT, BACK]), ("back", [BACK, RIGHT, LEFT, FRONT])]
)
def test_guided_pairs_join_cameras_that_look_the_same_way(
    drives: dict[str, Driven], other: str, partner: list[int]
) -> None:
    a, b = drives["a"].source, drives[other].source
    found = guided_pairs(a, b, true_a_from_b(drives["a"], drives[other]), SETTINGS)
    cameras_a, cameras_b = a.image_camera[found[:, 0]], b.image_camera[found[:, 1]]
    assert (np.array(partner)[cameras_a] == cameras_b).all()
    assert set(cameras_a.tolist()) == {FRONT, LEFT, RIGHT, BACK}
    assert len(np.unique(found, axis=0)) == len(found) <= SETTINGS.max_pairs
    # Every image has its best ones, so none goes without; by far not all with all.
    assert len(np.unique(found[:, 0])) == len(a.image_unit)
    assert len(found) <= 2 * SETTINGS.pairs_per_image * len(a.image_unit)
    few = SETTINGS.model_copy(update={"max_pairs": 10})
    best = guided_pairs(a, b, true_a_from_b(drives["a"], drives[other]), few)
    assert len(best) == 10
    assert {tuple(p) for p in best.tolist()} <= {tuple(p) for p in found.tolist()}


def test_the_nearest_view_is_taken_first(drives: dict[str, Driven]) -> None:
    """Units of `same` are 1 m ahead of those of a."""
    a, b = drives["a"].source, drives["same"].source
    one = SETTINGS.model_copy(update={"pairs_per_image": 1})
    found = guided_pairs(a, b, true_a_from_b(drives["a"], drives["same"]), one)
    away = np.abs(a.image_unit[found[:, 0]] - b.image_unit[found[:, 1]])
    assert away.max() <= 1


def test_common_view_is_more_the_nearer_scenes_are_and_nothing_without_overlap(drives: dict[str, Driven]) -> None:
    a = drives["a"]
    for name in ("same", "back"):
        b = drives[name]
        found = [common_view(a.source, b.source, ahead(a, b, m), SETTINGS) for m in (0.0, 15.0, 30.0, 200.0)]
        assert len(a.source.image_unit) * 0.3 < found[0] <= len(a.source.image_unit)
        assert found[0] > found[1] > found[2] >= found[3] == 0
    # One camera each, one vehicle looks east and the other west: near one another, and yet they share no view.
    one, other = drives["one camera"], drives["one camera back"]
    lies = true_a_from_b(one, other)
    assert 0 <= nearest_distance_m(one.source, other.source, lies) < 1.0
    assert common_view(one.source, other.source, lies, SETTINGS) == 0
    assert guided_pairs(one.source, other.source, lies, SETTINGS).shape == (0, 2)
    assert probes(one.source, other.source, lies, SETTINGS) == []


@pytest.mark.parametrize("other", ["same", "back"])
def test_probes_find_the_right_images_although_positions_are_off(drives: dict[str, Driven], other: str) -> None:
    a, b = drives["a"], drives[other]
    truth = true_a_from_b(a, b)
    found = probes(a.source, b.source, ahead(a, b, 0.8 * SETTINGS.position_error_m), SETTINGS)
    units = [probe.unit for probe in found]
    assert len(units) == len(set(units)) >= 5
    good = 0
    for probe in found:
        assert (b.source.image_unit[probe.pairs[:, 1]] == probe.unit).all()
        counts = np.bincount(probe.pairs[:, 1])
        assert 0 < counts.max() <= 14
        seen_a = a.source.world_from_cam[probe.pairs[:, 0]]
        seen_b = truth @ b.source.world_from_cam[probe.pairs[:, 1]]
        apart = np.linalg.norm(seen_a[:, :3, 3] - seen_b[:, :3, 3], axis=1)
        cosine = (seen_a[:, :3, 2] * seen_b[:, :3, 2]).sum(1)
        good += bool(((apart < 4.0) & (cosine > 0.9)).any())
    assert good >= 0.7 * len(found)
    assert probes(a.source, b.source, ahead(a, b, 400.0), SETTINGS) == []


def test_thinned_units_are_apart(drives: dict[str, Driven]) -> None:
    a = drives["a"].source
    found = thinned(a, 5.0)
    apart = np.linalg.norm(np.diff(a.world_from_rig[found, :3, 3], axis=0), axis=1)
    assert 5.0 <= apart.min() <= apart.max() < 7.0
    assert thinned(a, 0.0).tolist() == list(range(12))


def test_units_that_stood_crowd_out_no_others(drives: dict[str, Driven]) -> None:
    """Their images have a pose and no keypoints."""
    a, b = drives["a"].source, drives["same"].source
    stood = np.isin(b.image_unit, (4, 5))
    counts = np.where(stood, 0, np.diff(b.keypoint_first))
    rows = np.repeat(~stood, np.diff(b.keypoint_first))
    b = replace(
        b,
        keypoint_first=np.concatenate([[0], np.cumsum(counts)]),
        keypoint_xy_px=b.keypoint_xy_px[rows],
        keypoint_point=b.keypoint_point[rows],
        descriptors=b.descriptors[b.descriptor_row[rows & (b.keypoint_point >= 0)]],
    )
    a_from_b = true_a_from_b(drives["a"], drives["same"])
    pairs = guided_pairs(a, b, a_from_b, SETTINGS)
    assert len(pairs)
    assert not stood[pairs[:, 1]].any()
    assert not {4, 5} & {probe.unit for probe in probes(a, b, a_from_b, SETTINGS)}
    assert not {4, 5} & set(thinned(b, 0.1).tolist())
