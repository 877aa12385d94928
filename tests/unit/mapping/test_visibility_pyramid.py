from __future__ import annotations

import numpy as np

from mrasfm_engine.mapping.visibility_pyramid import LEVELS, finest_cells, visibility_score

SIZE_PX = np.array([[640.0, 480.0], [1280.0, 720.0]])


def score(xy_px: np.ndarray, camera: np.ndarray, seen: np.ndarray | None = None) -> int:
    n = len(xy_px)
    cell = finest_cells(xy_px, camera, SIZE_PX)
    triangulated = np.ones(n, dtype=np.bool_) if seen is None else seen
    return visibility_score(np.arange(n), cell, camera, np.arange(n), triangulated, len(SIZE_PX))


def expected(xy_px: np.ndarray, camera: np.ndarray) -> int:
    """Occupied cells of every level, counted one by one."""
    total = 0
    for level in range(1, LEVELS + 1):
        cells = 2**level
        at = np.minimum((xy_px / SIZE_PX[camera] * cells).astype(int), cells - 1)
        total += cells**2 * len({(c, x, y) for c, (x, y) in zip(camera.tolist(), at.tolist(), strict=True)})
    return total


def test_every_occupied_cell_of_a_level_counts_as_many_as_the_level_has() -> None:
    rng = np.random.default_rng(0)
    camera = rng.integers(0, 2, 500)
    xy_px = rng.uniform(0, 1, (500, 2)) ** 2 * SIZE_PX[camera]
    assert score(xy_px, camera) == expected(xy_px, camera)
    half = np.arange(500) < 250
    assert score(xy_px, camera, half) == expected(xy_px[half], camera[half]) < score(xy_px, camera)
    assert score(xy_px, camera, np.zeros(500, dtype=np.bool_)) == 0


def test_few_points_all_over_the_image_are_worth_more_than_many_in_a_corner() -> None:
    rng = np.random.default_rng(0)
    camera = np.zeros(400, dtype=np.int64)
    spread = rng.uniform(0, 1, (400, 2)) * SIZE_PX[0]
    assert score(spread[:100], camera[:100]) > 1.5 * score(0.1 * spread, camera)


def test_points_at_the_border_are_in_the_last_cell() -> None:
    edge = np.array([[640.0, 480.0], [-0.5, -0.5]])
    np.testing.assert_array_equal(finest_cells(edge, np.zeros(2, dtype=np.int64), SIZE_PX), [64 * 64 - 1, 0])
