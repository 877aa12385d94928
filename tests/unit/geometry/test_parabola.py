from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.geometry.parabola import vertex


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_top_of_parabolas_is_found_on_both_sides_of_the_middle(dtype: type) -> None:
    top = np.linspace(-0.5, 0.5, 11)
    samples = (7.0 - 3.0 * (np.array([[-1.0], [0.0], [1.0]]) - top) ** 2).astype(dtype)
    found = vertex(*samples)
    assert found.dtype == dtype
    np.testing.assert_allclose(found, top, atol=1e-6)


def test_what_is_flat_or_a_minimum_has_its_top_in_the_middle() -> None:
    before, at, after = np.array([[5.0, 5.0, 5.0], [2.0, 1.0, 1.5], [1.0, 2.0, 3.0], [5.0, 5.0 + 1e-9, 5.0]]).T
    np.testing.assert_array_equal(vertex(before, at, after), 0.0)


def test_a_top_beyond_the_neighbours_is_not_followed() -> None:
    assert vertex(np.array(1.0), np.array(2.0), np.array(2.9)) == 0.5
