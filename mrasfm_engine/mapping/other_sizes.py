"""Other sizes of a scene that images like as well as the one that was found.

Where few points link cameras of an uncertain rig, a small turn of a camera explains them at almost any distance: along
the scale the cost has a long flat tail, of which its curvature at the minimum knows nothing. Adjusted from other sizes,
such a scene stays there at hardly any cost [the likelihood's profile].
"""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np

from mrasfm_engine.bundle_adjustment.marginal_covariances import Covariances
from mrasfm_engine.bundle_adjustment.solver import Report
from mrasfm_engine.mapping.calibration import scale_scene, sigma_scale_of_images
from mrasfm_engine.mapping.mapper import Mapper

FACTORS = 0.25, 0.5, 2.0, 4.0  # of the size
UNSURE = 0.05  # of the scale by images alone: where they know it better, its curvature says how well


def with_other_sizes(mapper: Mapper, certainty: Covariances, adjust: Callable[[], Report]) -> Covariances:
    """The certainty with a scale no better known than sizes of equal cost leave it.

    A size that costs half the square of n more than the best is n standard deviations away. Of a scene that costs the
    same at all sizes the sigma is as far as they were tried, the logarithm of the largest of `FACTORS`.

    Parameters
    ----------
    adjust
        Adjusts the mapper's scene, its cameras free under their prior. The mapper is left as it was.
    """
    if not UNSURE < sigma_scale_of_images(mapper, certainty) < np.inf:
        return certainty
    kept, found_m = (mapper.state, mapper.motion), _size_m(mapper)
    away, costs = [], []
    try:
        for factor in (1.0, *FACTORS):
            mapper.state, mapper.motion = copy.deepcopy(kept)
            scale_scene(mapper, factor)
            costs.append(adjust().final_cost)
            away.append(abs(np.log(_size_m(mapper) / found_m)))
    finally:
        mapper.state, mapper.motion = kept
    sigmas = np.sqrt(np.maximum(2.0 * (np.array(costs) - min(costs)), 1.0))
    sigma = float((np.array(away) / sigmas).max())
    return certainty.with_scale_error(float(np.sqrt(max(sigma**2 - certainty.sigma_scale**2, 0.0))))


def _size_m(mapper: Mapper) -> float:
    position_m = mapper.state.unit_position_m[mapper.registered]
    return max(float(np.linalg.norm(position_m - position_m.mean(axis=0))), 1e-9)
