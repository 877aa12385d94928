from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, norm

from mrasfm_engine.aggregation.significance import in_sigmas


@pytest.mark.parametrize("freedoms", [1, 3, 6])
@pytest.mark.parametrize("sigmas", [0.5, 2.0, 5.0, 20.0])
def test_it_is_as_unlikely_as_the_sum(freedoms: int, sigmas: float) -> None:
    squared = float(chi2.isf(2 * norm.sf(sigmas), freedoms))
    assert in_sigmas(squared, freedoms) == pytest.approx(sigmas, rel=1e-6)


def test_what_has_no_probability_in_floating_point_goes_on_rising() -> None:
    values = [in_sigmas(squared, 6) for squared in np.linspace(1000.0, 3000.0, 200)]
    assert np.all(np.diff(values) > 0)
    assert values[-1] == pytest.approx(np.sqrt(3000.0), rel=0.01)
