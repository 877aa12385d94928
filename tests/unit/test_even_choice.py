from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from mrasfm_engine.even_choice import even_choice, nearest_even_choice

CHOICES = pytest.mark.parametrize("choice", [even_choice, nearest_even_choice])


@CHOICES
@pytest.mark.parametrize("most", [1, 2, 3, 7, 40, 150, 1000])
def test_a_choice_is_even_from_the_first_to_the_last(choice: Callable[[int, int], np.ndarray], most: int) -> None:
    for count in (most, most + 1, 2 * most - 1, 2 * most, 3 * most + 1, 10_007 + most):
        chosen = choice(count, most)
        assert chosen.dtype == np.int64
        assert len(chosen) == most
        assert chosen[0] == 0
        if most > 1:
            assert chosen[-1] == count - 1
            steps = np.diff(chosen)
            assert steps.min() >= 1  # none twice
            assert steps.max() - steps.min() <= 1


@CHOICES
@pytest.mark.parametrize("count", [0, 1, 2, 9])
def test_of_few_items_all_are_chosen(choice: Callable[[int, int], np.ndarray], count: int) -> None:
    for most in (count, count + 1, 100):
        np.testing.assert_array_equal(choice(count, most), np.arange(count))


def test_places_between_two_items_are_rounded() -> None:
    np.testing.assert_array_equal(even_choice(9, 4), [0, 2, 5, 8])
    np.testing.assert_array_equal(nearest_even_choice(9, 4), [0, 3, 5, 8])
