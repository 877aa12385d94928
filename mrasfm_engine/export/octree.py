"""An octree whose coarse nodes show the whole cloud: each point is in one node, as COPC wants it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.jit import njit, uncounted
from mrasfm_engine.types import Ints, Ints32

GRID_BITS = 7
GRID = 1 << GRID_BITS  # cells of a node along each side; of the points in a cell the first stays in the node
LEAF_POINTS = 20_000  # a node with no more points than this has no children
_CELL = 64  # steps of the coordinates that a grid cell of the deepest level has at least
_OCTANTS = 8


class Octree(NamedTuple):
    """Nodes of an octree, parents before their children.

    The cube begins at 0 and ends at `side`. That of node (level, x, y, z) has the side s = `side` / 2^level, and its
    lowest corner is at (x, y, z) s.
    """

    side: int  # in steps of the coordinates
    nodes: Ints  # (m, 4) level, x, y, z
    bounds: Ints  # (m, 2) first and end of each node's points in `order`
    order: Ints32  # (n,) the points


def build_octree(steps: NDArray[np.uint32], *, leaf_points: int = LEAF_POINTS) -> Octree:
    """Sort points (n, 3), coordinates in whole steps from 0 on, into nodes; the cube ends at the largest coordinate.

    A node with at most `leaf_points` points keeps them. Of others, one point stays for each of `GRID`^3 cells, and the
    rest goes to the children. Nodes of the deepest level, whose cells are some steps wide, keep all of theirs.
    """
    side = max(1, int(steps.max(initial=0)))
    depth = max(0, (side // (_CELL * GRID)).bit_length() - 1)
    order = np.arange(len(steps), dtype=np.int32)
    seen = np.zeros(GRID**3 if len(steps) > leaf_points else 0, dtype=np.bool_)
    nodes = _sorted_into_nodes(steps, order, seen, side, depth, leaf_points)
    return Octree(side, nodes[:, :4], nodes[:, 4:], order)


@njit(cache=True, nogil=True)
def _sorted_into_nodes(steps: Any, order: Any, seen: Any, side: int, depth: int, leaf_points: int) -> Any:
    """Put `order` into the order of the nodes; level, x, y, z, first and end of each."""
    nodes = np.zeros((64, 6), np.int64)
    nodes[0, 5] = len(order)
    known = min(len(order), 1)
    rest, octant = np.empty(len(order), np.int32), np.empty(len(order), np.int8)
    node = np.int64(0)  # a literal has the kernel that it is given to compiled once more
    while node < known:
        first, end = nodes[node, 4], nodes[node, 5]
        if end - first > leaf_points and nodes[node, 0] < depth:
            kept = _keep_first_of_cells(steps, order[first:end], seen, side, nodes[node, :4], rest, octant)
            nodes[node, 5] = first + kept
            others = end - first - kept
            if known + _OCTANTS > len(nodes):
                nodes = np.concatenate((nodes, np.zeros_like(nodes)))
            known = _add_children(nodes, node, known, order, rest[:others], octant[:others])
        node += 1
    return nodes[:known]


@uncounted()
def _keep_first_of_cells(steps: Any, order: Any, seen: Any, side: int, node: Any, rest: Any, octant: Any) -> int:
    """Move the first point of each grid cell to the front of `order`, the others and their octants to `rest`.

    `seen` (GRID^3,) is false everywhere, before and after; the number of points in front is returned.
    """
    kept, others = 0, 0
    for point in order:
        x, y, z = _cell(steps[point], side, node)
        place = (x * GRID + y) * GRID + z
        if seen[place]:
            rest[others] = point
            octant[others] = (x * 2 // GRID) * 4 + (y * 2 // GRID) * 2 + z * 2 // GRID
            others += 1
        else:
            seen[place] = True
            order[kept] = point
            kept += 1
    for point in order[:kept]:
        x, y, z = _cell(steps[point], side, node)
        seen[(x * GRID + y) * GRID + z] = False
    return kept


@uncounted(forceinline=True)
def _cell(point: Any, side: int, node: Any) -> tuple[int, int, int]:
    """The grid cell of a node that a point is in; what is at the very end of the cube is in the last one."""
    bits = node[0] + GRID_BITS
    last = (1 << bits) - 1
    x = min((np.int64(point[0]) << bits) // side, last) - (node[1] << GRID_BITS)
    y = min((np.int64(point[1]) << bits) // side, last) - (node[2] << GRID_BITS)
    z = min((np.int64(point[2]) << bits) // side, last) - (node[3] << GRID_BITS)
    return x, y, z


@njit(cache=True, nogil=True)
def _add_children(nodes: Any, parent: int, known: int, order: Any, rest: Any, octant: Any) -> Any:
    """Append a node for each octant that has points, and put these behind the parent's; the new number of nodes."""
    counts = np.zeros(_OCTANTS, np.int64)
    for k in octant:
        counts[k] += 1
    begins = nodes[parent, 5] + np.cumsum(counts) - counts
    for k in range(_OCTANTS):
        if counts[k]:
            nodes[known, 0] = nodes[parent, 0] + 1
            nodes[known, 1] = 2 * nodes[parent, 1] + k // 4
            nodes[known, 2] = 2 * nodes[parent, 2] + k // 2 % 2
            nodes[known, 3] = 2 * nodes[parent, 3] + k % 2
            nodes[known, 4] = begins[k]
            nodes[known, 5] = begins[k] + counts[k]
            known += 1
    for i in range(len(rest)):
        order[begins[octant[i]]] = rest[i]
        begins[octant[i]] += 1
    return known
