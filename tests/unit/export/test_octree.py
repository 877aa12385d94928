from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.export.octree import GRID, LEAF_POINTS, Octree, build_octree


def street(count: int) -> np.ndarray:
    """A long, thin cloud that is dense at one end, in steps from 0 on."""
    rng = np.random.default_rng(2)
    along = 4_000_000 * rng.random(count) ** 2
    points = np.column_stack([along, 90_000 + rng.normal(0, 9_000, count), 50_000 * rng.random(count) ** 3])
    return (points - points.min(axis=0)).astype(np.uint32)


def nodes_with_points(octree: Octree, steps: np.ndarray) -> list[tuple[tuple[int, ...], np.ndarray]]:
    return [
        (tuple(node), steps[octree.order[first:end]])
        for node, (first, end) in zip(octree.nodes.tolist(), octree.bounds.tolist(), strict=True)
    ]


def test_every_point_is_in_one_node_inside_its_cube() -> None:
    steps = street(50_000)
    octree = build_octree(steps, leaf_points=500)
    assert octree.side == steps.max()
    np.testing.assert_array_equal(np.sort(octree.order), np.arange(len(steps)))
    nodes = nodes_with_points(octree, steps)
    assert sum(len(points) for _, points in nodes) == len(steps)
    for (level, *place), points in nodes:
        side = octree.side / 2**level
        assert (points >= np.array(place) * side).all()
        assert (points <= (np.array(place) + 1) * side).all()


def test_parents_come_before_their_children_and_show_one_point_of_each_cell() -> None:
    steps = street(50_000)
    octree = build_octree(steps, leaf_points=500)
    known, depth = {(0, 0, 0, 0)}, octree.nodes[:, 0].max()
    assert depth >= 3
    parents = {(level - 1, x // 2, y // 2, z // 2) for level, x, y, z in octree.nodes.tolist() if level}
    for (level, *place), points in nodes_with_points(octree, steps):
        assert (level, *place) in known
        known |= {
            (level + 1, *(2 * p + k for p, k in zip(place, octant, strict=True))) for octant in np.ndindex(2, 2, 2)
        }
        if (level, *place) in parents:
            cells = (points.astype(np.int64) * GRID * 2**level - np.array(place) * octree.side * GRID) // octree.side
            assert len(np.unique(cells.clip(0, GRID - 1), axis=0)) == len(points)
        else:
            assert 0 < len(points) <= 500
    whole = np.unique((steps.astype(np.int64) * GRID // octree.side).clip(0, GRID - 1), axis=0)
    assert octree.bounds[0, 1] == len(whole)  # the root shows all of the cloud


def test_leaves_are_large() -> None:
    """Viewers fetch nodes one by one: hundreds of small ones take longer than a dozen."""
    steps = street(200_000)
    assert LEAF_POINTS == 20_000
    assert 8 < len(build_octree(steps).nodes) < 60
    assert len(build_octree(steps[:LEAF_POINTS]).nodes) == 1


@pytest.mark.parametrize("steps", [np.zeros((3, 3), np.uint32), np.full((30_000, 3), [5, 0, 9], np.uint32)])
def test_points_at_one_place_are_one_node(steps: np.ndarray) -> None:
    octree = build_octree(steps, leaf_points=2)
    assert octree.nodes.tolist() == [[0, 0, 0, 0]]
    assert octree.bounds.tolist() == [[0, len(steps)]]


def test_coordinates_up_to_the_largest_number_fit() -> None:
    steps = np.array([[0, 0, 0], [2**32 - 2, 5, 2**32 - 3]] * 300, np.uint32)
    octree = build_octree(steps, leaf_points=2)
    assert octree.side == 2**32 - 2
    for (level, *place), points in nodes_with_points(octree, steps):
        side = octree.side / 2**level
        assert (np.abs(points - (np.array(place) + 0.5) * side) <= side / 2).all()
