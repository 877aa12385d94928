"""Scenes without positions take their length from a scene that sees the same.

Without positions a scene is as long as the baselines of its rig say, which may be wrong by a tenth and more, and scenes
that move rigidly do not fit then. A unit finds its pose among the points of another scene whatever the length of its
own scene: only its rig is too large or too small, which is little beside the distance of the points. How far apart the
places of several units are says roughly how long the scene is; then the length is the one at which all of them together
see the points best.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from mrasfm_engine.aggregation.image_search import similar_images
from mrasfm_engine.aggregation.relocalization import (
    MAX_ERROR_FOCAL,
    MIN_MAJORITY,
    SAME_PLACE_DEG,
    SAME_PLACE_M,
    Matches2D3D,
    Relocaliser,
    matches_2d3d,
)
from mrasfm_engine.aggregation.scene_matching import CrossMatcher, CrossMatches
from mrasfm_engine.aggregation.seam_refinement import CORRELATION
from mrasfm_engine.aggregation.source import SourceScene
from mrasfm_engine.config import AggregationConfig, EngineConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.matching.prepared_images import Matcher
from mrasfm_engine.types import Floats, Ints

MAX_UNITS = 16  # that are looked for: they are spread over what both see
ROUNDS = 3  # each from the rig at the length of the one before
REWEIGHTED = 5
LOSS = 3.0  # of what units, and images of points, are off by, in their median
SEARCHED, STEP, TOLERANCE = 0.2, 0.005, 1e-5  # of the length's logarithm
SIGNIFICANT, MOST = 2.0, 3.0  # sigmas of a difference of lengths, by another scene and by the scene itself


@dataclass(frozen=True, kw_only=True)
class SceneScale:
    """A scene's lengths in another one, by those that it has."""

    by: str  # the other scene
    factor: float
    sigma: float  # relative
    units: int  # that agree
    sigma_by: float = 0.0  # relative, of the other scene's own length as it states it

    def may_be_of(self, scene: SourceScene, settings: AggregationConfig) -> bool:
        """True where the scene may be so long by the uncertainty that it states; else this is rather another place."""
        return self._off <= MOST * stated_sigma(scene) + settings.max_scale_error

    @property
    def sigma_of_length(self) -> float:
        """Relative standard deviation of the length that the scene gets."""
        return float(np.hypot(self.sigma, self.sigma_by))

    @property
    def is_significant(self) -> bool:
        """The scene is longer or shorter than by itself."""
        return self._off > SIGNIFICANT * self.sigma

    def is_unexpected(self, scene: SourceScene) -> bool:
        """True where the scene gets another length than it states to be possible, by one sigma."""
        return self.is_significant and self._off > stated_sigma(scene)

    @property
    def _off(self) -> float:
        return abs(float(np.log(self.factor)))


def stated_sigma(scene: SourceScene) -> float:
    """Relative standard deviation of a scene's length as its report states it; zero where it states none."""
    return scene.sigma_scale or 0.0


def find_scale(
    a: SourceScene, b: SourceScene, matcher: Matcher, config: EngineConfig, *, cancel: Callable[[], bool]
) -> SceneScale | None:
    """Lengths of scene b in scene a; None where too few of its units are found there.

    Raises
    ------
    CancelledError
        Where `cancel` answers True.
    """
    wanted = similar_images(a, b, config.aggregation, cancel=cancel)[:MAX_UNITS]
    if not wanted:
        return None
    cross = CrossMatcher(a, b, matcher, config.matching, threads=config.threads)
    pairs = np.concatenate([probe.pairs for probe in wanted])
    matches = CrossMatches.joined(cross.match(pairs, verified=True, cancel=cancel))
    seen = matches_2d3d(a, b, matches.a, matches.b)
    relocaliser = Relocaliser(b, config.aggregation, seed=config.seed)
    factor, units = 1.0, 0
    for _ in range(ROUNDS):
        places = _places(relocaliser.of_length(factor), seen, config.aggregation)
        found = None if places is None else _scale_between(*places, config.aggregation)
        if found is None:
            return None
        factor, units = factor * found[0], found[1]
    best = _seen_best(relocaliser.of_length(factor), seen)
    if best is None:
        return None
    more, sigma = best
    # Units err together, as do points: how far both estimates are apart tells of that, the bend of a cost does not.
    sigma = float(np.hypot(sigma, np.log(more)))
    return SceneScale(by=a.name, factor=factor * more, sigma=sigma, units=units, sigma_by=stated_sigma(a))


def _seen_best(relocaliser: Relocaliser, seen: Matches2D3D) -> tuple[float, float] | None:
    """The factor near one on lengths at which all units together see points of a best, with its relative sigma; None
    where they do not agree how the scenes lie."""
    placed = relocaliser.relocalise(seen)
    if placed.a_from_b is None:
        return None
    begin = placed.a_from_b
    fits = relocaliser.errors_focal(begin, seen) < MAX_ERROR_FOCAL
    seen = seen.select(fits & np.isin(seen.unit, placed.units_agreeing))
    usual = max(float(np.median(relocaliser.errors_focal(begin, seen))), 1e-9)

    def cost(log_more: float) -> float:
        """Cost of the errors at the best place, in their usual size."""
        longer = relocaliser.of_length(float(np.exp(log_more)))
        a_from_b = longer.refined(begin, seen)
        if a_from_b is None:
            return np.inf
        off = np.minimum(longer.errors_focal(a_from_b, seen), 1.0) / usual
        return float(0.5 * LOSS**2 * np.log1p((off / LOSS) ** 2).sum())

    found = minimize_scalar(cost, bounds=(-SEARCHED, SEARCHED), method="bounded", options={"xatol": TOLERANCE})
    at = float(found.x)
    bend = cost(at - STEP) + cost(at + STEP) - 2.0 * float(found.fun)
    if not (np.isfinite(bend) and bend > 0.0 and abs(at) < SEARCHED - STEP):
        return None
    # The usual error squared passes for the variance, which it is 1.4 times; here errors are less than at the start.
    left = float(found.fun) / max(cost(0.0), 1e-12)
    return float(np.exp(at)), STEP * float(np.sqrt(CORRELATION * left / bend))


def _places(relocaliser: Relocaliser, seen: Matches2D3D, settings: AggregationConfig) -> tuple[Floats, Floats] | None:
    """Poses (n, 4, 4) of units as b has them, and as each finds itself in a; None where too few do."""
    units, counts = np.unique(seen.unit, return_counts=True)
    tried = units[counts >= settings.min_unit_inliers]
    alone = {int(unit): relocaliser.hypothesis(int(unit), seen) for unit in tried}
    own = [(relocaliser.b_from_rig[unit], a_from_b) for unit, a_from_b in alone.items() if a_from_b is not None]
    if len(own) < max(settings.min_units, MIN_MAJORITY * len(tried)):
        return None
    b_from_rig = np.stack([pose for pose, _ in own])
    return b_from_rig, np.stack([a_from_b for _, a_from_b in own]) @ b_from_rig


def _scale_between(b_from_rig: Floats, a_from_rig: Floats, settings: AggregationConfig) -> tuple[float, int] | None:
    """Lengths in a by those in b, and how many units agree; None where too few do.

    Of the similarities by two units each, the one with which most agree wins; of several, that of the units that are
    farthest apart.
    """
    best: tuple[int, float] = 0, 0.0
    agreeing = np.zeros(0, dtype=np.int64)
    for i in range(len(b_from_rig)):
        for j in range(i + 1, len(b_from_rig)):
            apart_m = float(np.linalg.norm(b_from_rig[j, :3, 3] - b_from_rig[i, :3, 3]))
            fitting = _agreeing(b_from_rig, a_from_rig, i, j)
            if (len(fitting), apart_m) > best:
                best, agreeing = (len(fitting), apart_m), fitting
    if len(agreeing) < max(settings.min_units, MIN_MAJORITY * len(b_from_rig)):
        return None
    turn = se3.mean_rotation(_turns(b_from_rig, a_from_rig)[agreeing])
    pb, pa = b_from_rig[agreeing, :3, 3] @ turn.T, a_from_rig[agreeing, :3, 3]
    weight, scale = np.ones(len(agreeing)), 1.0
    for _ in range(REWEIGHTED):
        cb, ca = (p - np.average(p, axis=0, weights=weight) for p in (pb, pa))
        scale = max(float(weight @ (ca * cb).sum(1)) / max(float(weight @ (cb**2).sum(1)), 1e-12), 1e-9)
        off_m = np.linalg.norm(ca - scale * cb, axis=1)
        weight = 1.0 / (1.0 + (off_m / (LOSS * max(float(np.median(off_m)), 1e-6))) ** 2) ** 2
    return scale, len(agreeing)


def _turns(b_from_rig: Floats, a_from_rig: Floats) -> Floats:
    """Rotations (n, 3, 3) from b to a by each unit alone."""
    result: Floats = a_from_rig[:, :3, :3] @ np.swapaxes(b_from_rig[:, :3, :3], 1, 2)
    return result


def _agreeing(b_from_rig: Floats, a_from_rig: Floats, i: int, j: int) -> Ints:
    """Units that lie as the similarity by units i and j says."""
    pb, pa, turns = b_from_rig[:, :3, 3], a_from_rig[:, :3, 3], _turns(b_from_rig, a_from_rig)
    apart_b, apart_a = pb[j] - pb[i], pa[j] - pa[i]
    scale = float(np.linalg.norm(apart_a)) / max(float(np.linalg.norm(apart_b)), 1e-9)
    off_m = np.linalg.norm(pa - pa[i] - scale * (pb - pb[i]) @ turns[i].T, axis=1)
    turned_deg = se3.rotation_angle_deg(turns @ turns[i].T)
    return np.flatnonzero((off_m <= SAME_PLACE_M) & (turned_deg <= SAME_PLACE_DEG))
