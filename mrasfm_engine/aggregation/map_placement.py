"""Place of a component of scenes in the map, by what the positions of its scenes say and how certain they are.

Every receiver has a constant error of its own, which its sigmas hold or do not hold. Where the scenes of a component
differ by no more than their sigmas let expect, the certain ones decide. Where they differ by more, each is taken to
have a further error of one variance, so that scenes with wrongly small sigmas count no more than the others [a
random-effects model; Paule and Mandel, Consensus values and weighting factors, 1982].
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mrasfm_engine.aggregation.seam import LEAST_SIGMA_M, LEAST_SIGMA_RAD
from mrasfm_engine.aggregation.significance import in_sigmas
from mrasfm_engine.aggregation.source import SourceScene
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.averaging import robust_mean_rotation
from mrasfm_engine.types import Floats

HALVINGS = 60  # of the interval in which the further variance lies
MEDIAN_STEPS, LEAST_OFF_SIGMAS = 50, 1e-4  # of Weiszfeld's algorithm
LEAST_SPREAD_M = 1e-3  # of a trajectory


@dataclass(frozen=True, kw_only=True)
class ScenePlace:
    """Certainty of a scene's place by its positions.

    Attributes
    ----------
    middle_m
        (3,) midpoint of the trajectory in the scene's frame.
    sigma_m
        (3,) of where that is, along the scene's axes; NaN where the scene does not say.
    spread_m
        RMS distance of the trajectory from its mean: the longer it is, the better positions tell the direction.
    """

    middle_m: Floats
    sigma_m: Floats
    spread_m: float

    @staticmethod
    def from_scene(scene: SourceScene) -> ScenePlace:
        """The certainty that the scene's units state: they share their errors, so that the mean square counts."""
        with np.errstate(over="ignore"):
            squares = scene.sigma_position_m[scene.unit_registered] ** 2
        known = squares[np.isfinite(squares).all(axis=1)]
        sigma_m = np.sqrt(known.mean(0)) if len(known) else np.full(3, np.nan)
        spread_m = float(np.sqrt(scene.trajectory_m.var(0).sum()))
        return ScenePlace(middle_m=scene.midpoint_m, sigma_m=sigma_m, spread_m=max(spread_m, LEAST_SPREAD_M))


@dataclass(frozen=True, kw_only=True)
class Placement:
    """Place of a component in the map.

    Attributes
    ----------
    map_from_first
        (4, 4) from the component's own frame.
    off_m
        Distance of each scene's place by positions from where the map has it, by scene.
    sigmas
        Differences of the scenes' places beyond what their sigmas let expect: size of a normal variable as unlikely.
    """

    map_from_first: Floats
    off_m: Mapping[int, float]
    sigmas: float


def placed(first_from_scene: Mapping[int, Floats], map_from_scene: Floats, places: Sequence[ScenePlace]) -> Placement:
    """Put a component where the positions of its scenes say.

    Parameters
    ----------
    first_from_scene
        Poses of the component's scenes in its own frame.
    map_from_scene
        Poses (scenes, 4, 4) of all scenes by positions alone.
    places
        Of all scenes.
    """
    members = sorted(first_from_scene)
    covariances = _covariances([map_from_scene[k][:3, :3] for k in members], [places[k] for k in members])
    turns = np.stack([map_from_scene[k][:3, :3] @ first_from_scene[k][:3, :3].T for k in members])
    spread_m = np.array([places[k].spread_m for k in members])
    by_positions = np.trace(covariances, axis1=1, axis2=2) / 3.0 / spread_m**2
    rough = robust_mean_rotation(turns)
    step = agreed_value(se3.log_so3(turns @ rough.T), (by_positions + LEAST_SIGMA_RAD**2)[:, None, None] * np.eye(3))
    rotation = se3.exp_so3(step) @ rough
    own = np.stack([se3.apply(first_from_scene[k], places[k].middle_m[None])[0] for k in members])
    given = np.stack([se3.apply(map_from_scene[k], places[k].middle_m[None])[0] for k in members])
    shifts = given - own @ rotation.T
    shift = agreed_value(shifts, covariances)
    return Placement(
        map_from_first=se3.transform(rotation, shift),
        off_m={k: float(np.linalg.norm(off)) for k, off in zip(members, shifts - shift, strict=True)},
        sigmas=in_sigmas(_squared(shifts, covariances), 3 * (len(members) - 1)) if len(members) > 1 else 0.0,
    )


def _covariances(rotations: Sequence[Floats], places: Sequence[ScenePlace]) -> Floats:
    """Covariances (n, 3, 3) of places in the map's axes; one that is not stated is that of the worst."""
    sigma_m = np.stack([place.sigma_m for place in places])
    known = np.isfinite(sigma_m).all(axis=1)
    sigma_m[~known] = sigma_m[known].max(0) if known.any() else 0.0
    turn = np.stack(rotations)
    result: Floats = np.einsum("nij,nj,nkj->nik", turn, sigma_m**2 + LEAST_SIGMA_M**2, turn)
    return result


def agreed_value(values: Floats, covariances: Floats) -> Floats:
    """Value (d,) by several estimates (n, d) with covariances (n, d, d), and further errors where these differ by more.

    The weighed mean of two; of more the weighed median, the point with the smallest sum of distances in sigmas: one
    that is far off moves it little.
    """
    further = _further_variance(values, covariances)
    weight = _information(covariances + further * np.eye(values.shape[1]))
    result = _mean(values, weight)
    for _ in range(MEDIAN_STEPS if len(values) > 2 else 0):
        off = values - result
        distance = np.sqrt(np.einsum("ni,nij,nj->n", off, weight, off)).clip(LEAST_OFF_SIGMAS)
        result = _mean(values, weight / distance[:, None, None])
    return result


def _information(covariances: Floats) -> Floats:
    return np.linalg.inv(covariances).astype(np.float64)


def _mean(values: Floats, weight: Floats) -> Floats:
    """Mean (d,) of values (n, d) by weights (n, d, d)."""
    result: Floats = np.linalg.solve(weight.sum(0), np.einsum("nij,nj->i", weight, values))
    return result


def _squared(values: Floats, covariances: Floats) -> float:
    """Squared distances of estimates (n, d) from their mean, in sigmas, added."""
    weight = _information(covariances)
    off: Floats = values - _mean(values, weight)
    return float(np.einsum("ni,nij,nj->", off, weight, off))


def _further_variance(values: Floats, covariances: Floats) -> float:
    """Variance that makes estimates (n, d) differ by as much as is expected; 0 where they differ by less."""
    count, size = values.shape
    expected = size * (count - 1)
    if count < 2 or _squared(values, covariances) <= expected:
        return 0.0
    least, most = 0.0, float(((values - values.mean(0)) ** 2).sum()) / expected
    for _ in range(HALVINGS):
        middle = 0.5 * (least + most)
        if _squared(values, covariances + middle * np.eye(size)) > expected:
            least = middle
        else:
            most = middle
    return float(most)
