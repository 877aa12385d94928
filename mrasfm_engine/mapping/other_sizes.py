"""Other sizes of a scene that images like as well as the one that was found, or better.

Where few points link cameras of an uncertain rig, a small turn of a camera explains them at almost any distance: along
the scale the cost has a long flat tail, of which its curvature at the minimum knows nothing. Adjusted from other sizes,
such a scene stays there at hardly any cost [the likelihood's profile], or finds a better one: a scene whose cameras
are held, turned a little, has come to the size that explains their turns.

A scene that is too large has lost the observations that say so. Counted by those that are left it is the best of all
sizes. So every size takes up what fits it, and all observations count, those that do not fit by as much as one at the
gate: the loss is truncated, and the choice of inliers is part of its minimum.

Of two scenes the one of lower cost is the more likely, but by how much, few points may decide. The difference of their
costs is known to what it scatters over points [Vuong, Likelihood Ratio Tests for Model Selection and Non-Nested
Hypotheses, Econometrica 1989].
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from mrasfm_engine.bundle_adjustment.cauchy_loss import relative_cauchy_losses
from mrasfm_engine.bundle_adjustment.marginal_covariances import Covariances
from mrasfm_engine.bundle_adjustment.priors import Term
from mrasfm_engine.bundle_adjustment.solver import SolverOptions
from mrasfm_engine.mapping.calibration import scale_scene, sigma_scale_of_images
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.types import Floats, Ints

Adjust = Callable[[Sequence[Term]], object]  # adjusts the mapper's scene by some terms
Parts = dict[str, object]  # of a mapper, that an adjustment changes
Terms = Callable[[], Sequence[Term]]  # by the scene as it is: the weights of a gauge hold for one adjustment

FACTORS = 0.5, 2.0, 0.25, 4.0  # of the size; nearer ones first
UNSURE = 0.05  # of the scale by images alone: where they know it better, its curvature says how well
SAME = 0.5 * UNSURE  # of two sizes: nearer ones hardly widen a scale that is unsure
MOST_ROUNDS = 8  # of adjusting and taking up observations
SMALL = 0.5  # half the square of a standard deviation
CLEAR_SIGMAS = 3.0  # by which a scene is clearly more likely: its cost is lower by half the square, 4.5
NAMES_OF_PARTS = "state", "motion", "triangulated", "is_inlier", "rejected"


@dataclass(frozen=True)
class Cost:
    """Cost of an adjusted scene."""

    of_terms: float
    of_tracks: Floats  # (tracks,) of all observations of each

    @property
    def total(self) -> float:
        """Cost of everything."""
        return self.of_terms + float(self.of_tracks.sum())

    def sigmas_above(self, other: Cost) -> float:
        """Standard deviations by which a scene of that cost is less likely than another one; 0 where it is not.

        As many as the costs say, half the square of which they are apart, but no more than their difference has by its
        scatter over tracks.
        """
        apart = max(self.total - other.total, 0.0)
        observed = (self.of_tracks > 0.0) | (other.of_tracks > 0.0)
        by_track = (self.of_tracks - other.of_tracks)[observed]
        scatter = float(np.sqrt(len(by_track)) * by_track.std()) if len(by_track) else 0.0
        return min(float(np.sqrt(2.0 * apart)), apart / max(scatter, 1e-9))

    def is_clearly_below(self, other: Cost) -> bool:
        """True where a scene of this cost is clearly more likely than another one."""
        return other.sigmas_above(self) >= CLEAR_SIGMAS


@dataclass(frozen=True, kw_only=True)
class SizedScenes:
    """Scenes that were adjusted from several sizes."""

    size_m: Floats  # (n,) where each has come to
    costs: Sequence[Cost]  # (n,) of all observations and terms
    _parts: Sequence[Parts] = field(repr=False)  # (n,) of the mapper

    @property
    def cost(self) -> Floats:
        """Cost (n,) of each."""
        return np.array([cost.total for cost in self.costs])

    @property
    def best(self) -> int:
        """The one of least cost."""
        return int(self.cost.argmin())

    @property
    def likely(self) -> int:
        """The one of least cost where it is clearly more likely than the first one, else the first."""
        return self.best if self.costs[self.best].is_clearly_below(self.costs[0]) else 0

    def take(self, which: int, mapper: Mapper) -> None:
        """Let the mapper have one of the scenes."""
        _restore(mapper, self._parts[which])

    def sigma_of_scale(self, of_size_m: float) -> float:
        """Standard deviation, relative, of one of these sizes that the costs of all leave.

        A size that is n standard deviations less likely than the best is as many away. One that is clearly less likely
        counts no farther than sizes are tried: a scene that has lost its scale is at any.
        """
        sigmas = np.maximum([cost.sigmas_above(self.costs[self.best]) for cost in self.costs], 1.0)
        away = np.abs(np.log(self.size_m / of_size_m))
        away[sigmas >= CLEAR_SIGMAS] = np.minimum(away[sigmas >= CLEAR_SIGMAS], np.log(max(FACTORS)))
        return float((away / sigmas).max())


def scenes_of_sizes(
    mapper: Mapper,
    factors: Sequence[float],
    adjust: Adjust,
    terms: Terms,
    options: SolverOptions,
    *,
    as_grown: Parts | None = None,
) -> SizedScenes:
    """Adjust the mapper's scene from several sizes. The mapper is left as it was.

    Sizes are not tried beyond one from which the scene comes to another that is known already, or stays where it is
    clearly less likely: the cost rises that way.

    Parameters
    ----------
    factors
        Of the size that it has, nearer ones first.
    adjust, terms
        Of the adjustments, with cameras under their prior as they are to be free.
    options
        By which observations count.
    as_grown
        Another scene of the same units to begin with, tried after the first size.
    """
    kept, dropped = parts_of(mapper), np.flatnonzero(mapper.rejected)
    starts = [(kept, factor) for factor in factors]
    if as_grown is not None:
        starts.insert(1, (as_grown, 1.0))
    sizes_m, costs, parts, ends = list[float](), list[Cost](), list[Parts](), list[float]()
    try:
        for start, factor in starts:
            if any(_is_beyond(factor, end) for end in ends):
                continue
            _begin_with(mapper, start, factor, dropped)
            cost = _least_cost(mapper, dropped, lambda: _adjusted_cost(mapper, adjust, terms, options), sizes_m)
            if _is_known(size_m(mapper), sizes_m) or any(known.is_clearly_below(cost) for known in costs):
                ends.append(factor)
            sizes_m.append(size_m(mapper))
            costs.append(cost)
            parts.append(parts_of(mapper))
    finally:
        _restore(mapper, kept)
    return SizedScenes(size_m=np.array(sizes_m), costs=costs, _parts=parts)


def scenes_of_other_sizes(
    mapper: Mapper,
    certainty: Covariances,
    adjust: Adjust,
    terms: Terms,
    options: SolverOptions,
    *,
    as_grown: Parts | None = None,
) -> SizedScenes | None:
    """The scene adjusted from its own size, the first, from `as_grown`, and from `FACTORS` of its size.

    None where images know its scale. Where they do not know it at all, no other size differs from its own.
    """
    sigma = sigma_scale_of_images(mapper, certainty)
    if sigma <= UNSURE or (as_grown is None and not sigma < np.inf):
        return None
    factors = FACTORS if sigma < np.inf else ()
    return scenes_of_sizes(mapper, (1.0, *factors), adjust, terms, options, as_grown=as_grown)


def cost_as_found(mapper: Mapper, options: SolverOptions) -> Cost:
    """Cost of the scene as it is, with all observations that fit it.

    Terms are left out, in favour of what was found: those of its cameras may have had other weights when it was
    adjusted, or none.
    """
    kept, dropped = parts_of(mapper), np.flatnonzero(mapper.rejected)
    try:
        _begin_with(mapper, kept, 1.0, dropped)
        return _least_cost(mapper, dropped, lambda: _cost(mapper, (), options))
    finally:
        _restore(mapper, kept)


def is_another_size(size: float, other: float, *, near: float = 0.0) -> bool:
    """True where two sizes differ by more than hardly matters where the scale is unsure, and than `near`, relative."""
    return abs(float(np.log(size / other))) > max(SAME, near)


def with_other_sizes(mapper: Mapper, certainty: Covariances, scenes: SizedScenes) -> Covariances:
    """The certainty with a scale no better known than sizes of equal cost leave it; see `scenes_of_sizes`.

    Of a scene that costs the same at all sizes the sigma is as far as they were tried, the logarithm of the largest of
    `FACTORS`.
    """
    sigma = scenes.sigma_of_scale(size_m(mapper))
    return certainty.with_scale_error(float(np.sqrt(max(sigma**2 - certainty.sigma_scale**2, 0.0))))


def size_m(mapper: Mapper) -> float:
    """Size of the trajectory, of which the sigma of the scale speaks."""
    position_m = mapper.state.unit_position_m[mapper.registered]
    return max(float(np.linalg.norm(position_m - position_m.mean(axis=0))), 1e-9)


def parts_of(mapper: Mapper) -> Parts:
    """Parts of the mapper as they are; they change with its next adjustment, unless copied."""
    return {name: getattr(mapper, name) for name in NAMES_OF_PARTS}


def _restore(mapper: Mapper, parts: Parts) -> None:
    for name, part in parts.items():
        setattr(mapper, name, part)


def _begin_with(mapper: Mapper, parts: Parts, factor: float, dropped: Ints) -> None:
    """Let the mapper have a copy of a scene in another size, without the tracks (n,) and units that were dropped."""
    _restore(mapper, copy.deepcopy(parts))
    mapper.forget(np.flatnonzero(~mapper.registered))
    mapper.rejected[:] = False
    mapper.drop(dropped)
    scale_scene(mapper, factor)


def _is_known(size: float, sizes: Sequence[float]) -> bool:
    return not all(is_another_size(size, known) for known in sizes)


def _is_beyond(factor: float, nearer: float) -> bool:
    """True where a factor is on one side of 1 with another, and farther away."""
    return bool(np.log(factor) / np.log(nearer) > 1.0) if nearer != 1.0 else False


def _least_cost(
    mapper: Mapper, dropped: Ints, cost_of_scene: Callable[[], Cost], sizes_m: Sequence[float] = ()
) -> Cost:
    """Cost of the scene with what fits it, which it takes up until that changes no more, or it has come to a size (n,)
    that is known.
    """
    least, gain = cost_of_scene(), np.inf
    for _ in range(MOST_ROUNDS - 1):
        if gain < SMALL or _is_known(size_m(mapper), sizes_m):
            break
        best = copy.deepcopy(parts_of(mapper))
        mapper.complete()
        mapper.drop(dropped)
        cost = cost_of_scene()
        gain = least.total - cost.total
        if gain <= 0.0:
            _restore(mapper, best)
        else:
            least = cost
    return least


def _adjusted_cost(mapper: Mapper, adjust: Adjust, terms: Terms, options: SolverOptions) -> Cost:
    """Cost of the scene once it is adjusted."""
    known = terms()
    adjust(known)
    return _cost(mapper, known, options)


def _cost(mapper: Mapper, terms: Sequence[Term], options: SolverOptions) -> Cost:
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
    loss_scale_px = options.loss_scale * options.sigma_px
    costs = 0.5 * options.loss_scale**2 * relative_cauchy_losses((errors_px / loss_scale_px) ** 2)
    return Cost(
        of_terms=sum(term.cost(mapper.state) for term in terms),
        of_tracks=np.bincount(of_keypoint[rows], weights=costs, minlength=len(mapper.tracks)).astype(np.float64),
    )
