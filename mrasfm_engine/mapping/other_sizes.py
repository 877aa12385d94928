"""Other sizes of a scene that images like as well as the one that was found.

Where few points link cameras of an uncertain rig, a small turn of a camera explains them at almost any distance: along
the scale the cost has a long flat tail, of which its curvature at the minimum knows nothing. Adjusted from other sizes,
such a scene stays there at hardly any cost [the likelihood's profile].

A scene that is too large has lost the observations that say so. Counted by those that are left it is the best of all
sizes. So every size takes up what fits it, and all observations count, those that do not fit by as much as one at the
gate: the loss is truncated, and the choice of inliers is part of its minimum.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from mrasfm_engine.bundle_adjustment.marginal_covariances import Covariances
from mrasfm_engine.bundle_adjustment.priors import Term
from mrasfm_engine.bundle_adjustment.solver import SolverOptions
from mrasfm_engine.mapping.calibration import scale_scene, sigma_scale_of_images
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.types import Floats, Ints

FACTORS = 0.25, 0.5, 2.0, 4.0  # of the size
UNSURE = 0.05  # of the scale by images alone: where they know it better, its curvature says how well
MOST_ROUNDS = 8  # of adjusting and taking up observations
SMALL = 0.5  # half the square of a standard deviation
PARTS = "state", "motion", "triangulated", "is_inlier", "rejected"  # of a mapper, that an adjustment changes


@dataclass(frozen=True, kw_only=True)
class SizedScenes:
    """Scenes that were adjusted from several sizes."""

    size_m: Floats  # (n,) where each has come to
    cost: Floats  # (n,) of all observations and terms
    _best: dict[str, object] = field(repr=False)  # parts of the mapper, of the most likely one

    def take_best(self, mapper: Mapper) -> None:
        """Let the mapper have the most likely scene."""
        _restore(mapper, self._best)

    def sigma_of_scale(self, of_size_m: float) -> float:
        """Standard deviation, relative, of one of these sizes that the costs of all leave.

        A size that costs half the square of n more than the best is n standard deviations away.
        """
        sigmas = np.sqrt(np.maximum(2.0 * (self.cost - self.cost.min()), 1.0))
        return float((np.abs(np.log(self.size_m / of_size_m)) / sigmas).max())


def scenes_of_sizes(
    mapper: Mapper,
    factors: Sequence[float],
    adjust: Callable[[Sequence[Term]], object],
    terms: Callable[[], Sequence[Term]],
    options: SolverOptions,
) -> SizedScenes:
    """Adjust the mapper's scene from several sizes. The mapper is left as it was.

    Parameters
    ----------
    factors
        Of the size that it has.
    adjust
        Adjusts the mapper's scene by some terms, its cameras free under their prior.
    terms
        The terms by the scene as it is: the weights of a gauge hold for one adjustment.
    options
        Of the adjustment.
    """
    kept, dropped = _parts_of(mapper), np.flatnonzero(mapper.rejected)
    sizes_m, costs, best = list[float](), list[float](), kept
    try:
        for factor in factors:
            _restore(mapper, copy.deepcopy(kept))
            scale_scene(mapper, factor)
            costs.append(_adjusted_cost(mapper, dropped, adjust, terms, options))
            sizes_m.append(size_m(mapper))
            if costs[-1] == min(costs):
                best = _parts_of(mapper)
    finally:
        _restore(mapper, kept)
    return SizedScenes(size_m=np.array(sizes_m), cost=np.array(costs), _best=best)


def with_other_sizes(
    mapper: Mapper,
    certainty: Covariances,
    adjust: Callable[[Sequence[Term]], object],
    terms: Callable[[], Sequence[Term]],
    options: SolverOptions,
) -> Covariances:
    """The certainty with a scale no better known than sizes of equal cost leave it; see `scenes_of_sizes`.

    Of a scene that costs the same at all sizes the sigma is as far as they were tried, the logarithm of the largest of
    `FACTORS`.
    """
    if not UNSURE < sigma_scale_of_images(mapper, certainty) < np.inf:
        return certainty
    sigma = scenes_of_sizes(mapper, (1.0, *FACTORS), adjust, terms, options).sigma_of_scale(size_m(mapper))
    return certainty.with_scale_error(float(np.sqrt(max(sigma**2 - certainty.sigma_scale**2, 0.0))))


def size_m(mapper: Mapper) -> float:
    """Size of the trajectory, of which the sigma of the scale speaks."""
    position_m = mapper.state.unit_position_m[mapper.registered]
    return max(float(np.linalg.norm(position_m - position_m.mean(axis=0))), 1e-9)


def _adjusted_cost(
    mapper: Mapper,
    dropped: Ints,
    adjust: Callable[[Sequence[Term]], object],
    terms: Callable[[], Sequence[Term]],
    options: SolverOptions,
) -> float:
    """Cost of the scene, adjusted with what fits it until that changes no more."""
    least, best = np.inf, _parts_of(mapper)
    for _ in range(MOST_ROUNDS):
        known = terms()
        adjust(known)
        cost = _cost(mapper, known, options)
        if cost >= least:
            break
        gain, least, best = least - cost, cost, copy.deepcopy(_parts_of(mapper))
        if gain < SMALL:
            break
        mapper.complete()
        mapper.drop(dropped)
    _restore(mapper, best)
    return least


def _cost(mapper: Mapper, terms: Sequence[Term], options: SolverOptions) -> float:
    """Cost of the terms, and of all observations of tracks that were not dropped: at most as of one at the gate."""
    of_keypoint = mapper.tracks.of_keypoint
    rows = np.flatnonzero((of_keypoint >= 0) & mapper.registered[mapper.keypoints.unit])
    rows = rows[~mapper.missing[mapper.keypoints.image[rows]] & ~mapper.rejected[of_keypoint[rows]]]
    errors_px = np.full(len(rows), mapper.triangulator.max_error_px)
    has_point = mapper.triangulated[of_keypoint[rows]]
    seen = rows[has_point]
    errors_px[has_point] = np.fmin(
        mapper.triangulator.errors_px(mapper.state, seen, mapper.state.points_m, of_keypoint[seen]),
        mapper.triangulator.max_error_px,
    )
    of_images = np.log1p((errors_px / (options.loss_scale * options.sigma_px)) ** 2).sum()
    return float(0.5 * options.loss_scale**2 * of_images + sum(term.cost(mapper.state) for term in terms))


def _parts_of(mapper: Mapper) -> dict[str, object]:
    return {name: getattr(mapper, name) for name in PARTS}


def _restore(mapper: Mapper, parts: dict[str, object]) -> None:
    for name, part in parts.items():
        setattr(mapper, name, part)
