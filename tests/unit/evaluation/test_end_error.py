"""The error of a route's end."""

from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.evaluation.trajectory import compare_known, end_error_m
from mrasfm_engine.geometry import se3

UNITS = 40


def route() -> np.ndarray:
    s = np.arange(UNITS, dtype=float)
    return se3.transform(se3.exp_so3(np.outer(s, [0.0, 0.0, 0.02])), np.stack([s, 0.1 * s, 0 * s], axis=-1))


def test_where_the_world_lies_does_not_matter() -> None:
    moved = se3.transform(se3.exp_so3([0.3, -1.0, 2.0]), [5.0, -80.0, 3.0]) @ route()
    assert end_error_m(moved, route()) == pytest.approx(0.0, abs=1e-9)


def test_a_start_that_looks_elsewhere_moves_the_end() -> None:
    turned = route()
    turned[:5, :3, :3] = turned[:5, :3, :3] @ se3.exp_so3([0.0, 0.0, 0.001])
    error = end_error_m(turned, route())
    assert error is not None
    assert 0.02 < error < 0.04  # a milliradian over 39 m
    longer = route()
    longer[-1, 2, 3] += 0.7
    assert end_error_m(longer, route()) == pytest.approx(0.7)


def test_an_end_or_a_start_that_is_missing_has_no_error() -> None:
    without_end, without_start = route(), route()
    without_end[-1] = np.nan
    without_start[:5] = np.nan
    assert end_error_m(without_end, route()) is None
    assert end_error_m(without_start, route()) is None
    assert end_error_m(route()[:30], route()) is None
    without_start[4] = route()[4]
    assert end_error_m(without_start, route()) == pytest.approx(0.0, abs=1e-9)


def test_poses_that_one_side_does_not_know_do_not_count() -> None:
    estimate, truth = route(), route()
    estimate[3, 0, 3] = 1e6
    truth[3] = np.nan
    estimate[9] = np.nan
    errors = compare_known(estimate, truth)
    assert errors is not None
    assert errors.poses == UNITS - 2
    assert errors.metric_rmse_m < 1e-9
    assert compare_known(estimate[:4], truth[:4]) is not None
    assert compare_known(estimate[:3], truth[1:4]) is None
