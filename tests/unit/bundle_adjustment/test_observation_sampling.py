from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.bundle_adjustment.observation_sampling import (
    GRID,
    MOST_UNITS,
    choose_points,
    solve_with_chosen_points,
    thinned,
)
from mrasfm_engine.bundle_adjustment.problem import Observations
from mrasfm_engine.bundle_adjustment.solver import solve
from tests.helpers.small_problems import Case, make_case, perturbed, position_errors_m

AN_IMAGE = 80


def dense_case() -> Case:
    return make_case(units=5, cameras=2, points=4000, noise_px=0.7)


def size_px(case: Case) -> np.ndarray:
    return np.tile(np.array(case.simulation.image_size_px, dtype=np.float64), (2, 1))


def per_cell(o: Observations, rows: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Observations (units, cameras, columns, rows) of a grid."""
    cell = np.minimum((o.xy_px / (size[0] / GRID)).astype(int), np.array(GRID) - 1)
    counts = np.zeros((5, 2, *GRID), dtype=int)
    np.add.at(counts, (o.unit[rows], o.camera[rows], cell[rows, 0], cell[rows, 1]), 1)
    return counts


def test_every_image_has_what_it_wants_all_over_where_there_is_enough() -> None:
    case = dense_case()
    o, size = case.problem.observations, size_px(case)
    chosen = choose_points(o, np.ones(5, dtype=np.bool_), size, an_image=AN_IMAGE)
    assert chosen.mean() < 0.25
    every, some = per_cell(o, np.arange(len(o.unit)), size), per_cell(o, np.flatnonzero(chosen[o.point]), size)
    wanted = AN_IMAGE // (GRID[0] * GRID[1])
    assert wanted == 2
    assert (some >= np.minimum(every, wanted)).all()
    assert every.sum((2, 3)).min() > 4 * AN_IMAGE


def test_of_points_in_one_place_the_longest_tracks_are_taken() -> None:
    lengths = [2, 5, 3, 4, 2]  # all in one cell of the first image, and anywhere in as many others
    unit = np.concatenate([np.arange(n) for n in lengths])
    o = Observations(
        unit=unit,
        camera=np.zeros_like(unit),
        point=np.repeat(np.arange(5), lengths),
        xy_px=np.full((len(unit), 2), 10.0),
        num_points=5,
    )
    free = np.array([True, False, False, False, False])
    chosen = choose_points(o, free, np.array([[800.0, 500.0]]), an_image=2 * GRID[0] * GRID[1])
    np.testing.assert_array_equal(chosen, [False, True, False, True, False])


def test_images_of_fixed_units_want_nothing() -> None:
    case = dense_case()
    o, free = case.problem.observations, np.array([True, False, False, False, False])
    chosen = choose_points(o, free, size_px(case), an_image=AN_IMAGE)
    seen_by_free = np.zeros(len(chosen), dtype=np.bool_)
    seen_by_free[o.point[free[o.unit]]] = True
    assert chosen.any()
    assert not (chosen & ~seen_by_free).any()


def test_poses_from_chosen_points_are_nearly_those_from_all_and_all_points_follow() -> None:
    case = dense_case()
    start = perturbed(case.truth, np.random.default_rng(5), units=range(1, 5), unit_m=0.03, unit_deg=0.1, point_m=0.05)
    problem = replace(case.problem, state=start)
    every, _ = solve(problem)
    some, report = solve_with_chosen_points(problem, size_px(case), an_image=AN_IMAGE)
    assert report.observations < 0.4 * len(problem.observations.unit)
    assert position_errors_m(some, every).max() < 0.01
    assert problem.cost(some) < 1.03 * problem.cost(every)
    assert 3 * problem.cost(every) < problem.cost(start)


@pytest.mark.parametrize("an_image", [0, 10**6])
def test_without_a_choice_it_is_the_solver(an_image: int) -> None:
    case = make_case()
    start = perturbed(case.truth, np.random.default_rng(5), units=range(1, 5), unit_m=0.03, unit_deg=0.1, point_m=0.05)
    problem = replace(case.problem, state=start)
    ours, report = solve_with_chosen_points(problem, np.full((3, 2), 1000.0), an_image=an_image)
    expected, expected_report = solve(problem)
    assert report.iterations == expected_report.iterations
    np.testing.assert_allclose(ours.unit_position_m, expected.unit_position_m, atol=1e-12)
    assert problem.cost(ours) == pytest.approx(problem.cost(expected), rel=1e-6)


def seen_by(*units: np.ndarray) -> Observations:
    """Points that are seen by some units each."""
    unit, point = np.concatenate(units), np.repeat(np.arange(len(units)), [len(of) for of in units])
    return Observations(
        unit=unit, camera=np.zeros_like(unit), point=point, xy_px=np.zeros((len(unit), 2)), num_points=len(units)
    )


def test_of_a_point_that_very_many_units_see_some_are_taken_all_along() -> None:
    many = 3 * MOST_UNITS
    o = seen_by(np.repeat(np.arange(many), 2), np.arange(MOST_UNITS), np.repeat(np.arange(10), 60))
    found = thinned(o, np.ones(many, dtype=np.bool_))
    np.testing.assert_array_equal(np.diff(found.first_of_point), [2 * MOST_UNITS, MOST_UNITS, 600])
    taken = np.unique(found.unit[: found.first_of_point[1]])
    assert len(taken) == MOST_UNITS
    assert taken[0] == 0
    assert np.diff([*taken, many]).max() <= 4
    assert thinned(found, np.ones(many, dtype=np.bool_)) is found


def test_points_choose_the_same_units_and_none_of_those_that_are_held() -> None:
    many = 3 * MOST_UNITS
    o = seen_by(np.arange(many), np.arange(50, many), np.arange(many - 10))
    found = thinned(o, np.ones(many, dtype=np.bool_))
    assert len(np.unique(found.unit)) < 1.3 * MOST_UNITS
    window = (np.arange(many) >= 100) & (np.arange(many) < 110)
    assert thinned(o, window) is o
