from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.geometry.neighbours import nearest_sorted


@pytest.mark.parametrize("count", [1, 2, 50])
def test_the_nearest_of_ascending_values_is_found(count: int) -> None:
    rng = np.random.default_rng(count)
    values, wanted = np.sort(rng.uniform(0, 10, count)), rng.uniform(-2, 12, 200)
    np.testing.assert_array_equal(nearest_sorted(values, wanted), np.abs(wanted[:, None] - values).argmin(1))
