"""Pixels between the corners of squares, against projections of every cell."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_camera, project
from mrasfm_engine.types import Floats
from mrasfm_engine.visualization.pixel_lattice import (
    EXACT,
    LINEAR,
    SKIPPED,
    along_row,
    meets_car,
    node_step,
    place_nodes,
    square_kind,
)
from mrasfm_engine.visualization.views import MIN_RESOLUTION_PX, VIEW_M, hidden_by_car

CELL_M, HEIGHT_M = 0.025, 1.6
SIZE_PX = (960, 540)
PINHOLE = ("PINHOLE", [700.0, 700.0, 480.0, 270.0])
FISHEYE = ("OPENCV_FISHEYE", [300.0, 300.0, 480.0, 270.0, 0.02, -0.005, 0.001, 0.0])
AHEAD_DEG, DOWN_DEG = 80.0, 35.0  # of the axis, from straight down
REACH_CELLS = 400
CENTRE_M = np.array([0.0, 0.0, HEIGHT_M])


def _cam_from_plan(from_down_deg: float) -> Floats:
    """A camera at `CENTRE_M` that looks along x, so much up from straight down."""
    angle = math.radians(from_down_deg)
    ahead = np.array([math.sin(angle), 0.0, -math.cos(angle)])
    right = np.array([0.0, -1.0, 0.0])
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    return np.ascontiguousarray(se3.transform(rotation, -rotation @ CENTRE_M)[:3])


def _pixel(kind: int, params: Floats, cam_from_plan: Floats, place_m: Floats) -> Floats:
    out, work = np.empty(8), np.empty(6)
    a, b, c = cam_from_plan[:, :3] @ place_m + cam_from_plan[:, 3]
    return out[:2].copy() if project(kind, params, a, b, c, work, out) else np.full(2, np.nan)


@pytest.mark.parametrize(("camera", "from_down_deg"), [(PINHOLE, AHEAD_DEG), (FISHEYE, AHEAD_DEG), (FISHEYE, DOWN_DEG)])
def test_interpolated_pixels_are_a_small_part_of_a_cell_off_and_nothing_visible_is_skipped(
    camera: tuple[str, list[float]], from_down_deg: float
) -> None:
    kind, params = pack_camera(*camera)
    pose, heights = _cam_from_plan(from_down_deg), np.zeros((80, 80))
    bounds, step = np.array([-REACH_CELLS, REACH_CELLS, -REACH_CELLS, REACH_CELLS]), node_step(CELL_M)
    rows, columns, nodes = place_nodes(
        0.0, 0.0, CELL_M, bounds, step, pose, CENTRE_M, kind, params, heights, np.array([-19.0, -19.0])
    )
    assert (rows[0], rows[-1], columns[0], columns[-1]) == (-REACH_CELLS, REACH_CELLS) * 2
    focal = math.sqrt(params[0] * params[1])
    rng, kinds = np.random.default_rng(0), set()
    for _ in range(4000):
        i, j = int(rng.integers(len(rows) - 1)), int(rng.integers(len(columns) - 1))
        row, column = int(rng.integers(rows[i], rows[i + 1])), int(rng.integers(columns[j], columns[j + 1]))
        place_m = np.array([column * CELL_M, -row * CELL_M, 0.0])
        found = _pixel(kind, params, pose, place_m)
        how = square_kind(nodes, i, j, *SIZE_PX, focal, HEIGHT_M)
        kinds.add(how)
        away_m = float(np.linalg.norm(place_m - CENTRE_M))
        if how == SKIPPED:
            is_seen = bool(np.all((found >= 0) & (found < SIZE_PX)))  # False for NaN
            assert not is_seen or away_m > VIEW_M or focal * HEIGHT_M < MIN_RESOLUTION_PX * away_m**2
        if how == LINEAR and np.all((found > -50) & (found < np.array(SIZE_PX) + 50)):
            # A pixel for a step of one cell across the line of sight, where it is shortest.
            beside = _pixel(kind, params, pose, place_m + np.array([0.0, CELL_M, 0.0]))
            along = _pixel(kind, params, pose, place_m + np.array([CELL_M, 0.0, 0.0]))
            cells = np.linalg.solve(
                np.stack([beside - found, along - found], -1), _between(nodes, rows, columns, row, column, i, j) - found
            )
            assert np.abs(cells).max() < 0.25
    assert LINEAR in kinds
    assert SKIPPED in kinds


def _between(nodes: Floats, rows: Floats, columns: Floats, row: int, column: int, i: int, j: int) -> Floats:
    u, v, _, u_step, v_step, _ = along_row(nodes, rows, columns, i, j, row)
    return np.array([u, v]) + (column - columns[j]) * np.array([u_step, v_step])


def test_a_square_with_a_corner_that_the_camera_does_not_show_is_projected_cell_by_cell() -> None:
    kind, params = pack_camera(*PINHOLE)
    bounds = np.array([-8, 8, -8, 8])
    rows, columns, nodes = place_nodes(
        0.0, 0.0, CELL_M, bounds, 8, _cam_from_plan(90.0 - 1e-6), np.array([0.0, 0.0, 0.2]), kind, params,
        np.zeros((80, 80)), np.array([-19.0, -19.0]),
    )  # fmt: skip
    kinds = {
        square_kind(nodes, i, j, *SIZE_PX, 700.0, 0.2) for i in range(len(rows) - 1) for j in range(len(columns) - 1)
    }
    assert EXACT in kinds


def test_no_cell_that_the_own_car_hides_is_in_a_square_that_does_not_meet_it() -> None:
    rig_from_plan = np.array([[0.8, 0.6, 0.0, -1.0], [-0.6, 0.8, 0.1, 0.3]])
    own_car = np.array([[-1.0, -0.9], [3.5, 0.9]])
    bounds = np.array([-200, 200, -200, 200])
    kind, params = pack_camera(*PINHOLE)
    rows, columns, nodes = place_nodes(
        0.0, 0.0, CELL_M, bounds, 8, _cam_from_plan(AHEAD_DEG), CENTRE_M, kind, params, np.zeros((80, 80)),
        np.array([-19.0, -19.0]),
    )  # fmt: skip
    met, hidden = 0, 0
    for i in range(len(rows) - 1):
        for j in range(len(columns) - 1):
            meets = meets_car(rig_from_plan, own_car, 0.0, 0.0, CELL_M, rows, columns, nodes, i, j, CENTRE_M)
            met += meets
            for row, column in (
                (rows[i], columns[j]),
                (rows[i + 1] - 1, columns[j + 1] - 1),
                (rows[i] + 3, columns[j] + 4),
            ):
                x, y = column * CELL_M, -row * CELL_M
                if hidden_by_car(rig_from_plan, own_car, x, y, 0.0, x - CENTRE_M[0], y - CENTRE_M[1], HEIGHT_M):
                    hidden += 1
                    assert meets
    assert hidden > 100
    assert met < (len(rows) - 1) * (len(columns) - 1) / 2
