"""Rigid and similarity alignment of corresponding point sets, also of planar, collinear and coincident ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mrasfm_engine.geometry import se3
from mrasfm_engine.types import Floats

# A set is collinear where its second eigenvalue is below this fraction of its first: 3 cm beside 30 m (both rms).
COLLINEAR_RATIO = 1e-6


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """A similarity `x_a = scale * R x_b + t` between two frames.

    Attributes
    ----------
    a_from_b
        Rotation and translation (4, 4); the scale is not part of it.
    scale
        Factor on lengths of frame b; 1 for a rigid alignment and for coincident points.
    dimensions
        What the points span: 0 coincident (translation only), 1 collinear (the roll about the line is not observed and
        is the smallest rotation that aligns the lines), 2 planar, 3 spatial.
    """

    a_from_b: Floats
    scale: float
    dimensions: int

    def apply(self, points_b: ArrayLike) -> Floats:
        """Points (n, 3) of frame b in frame a."""
        return se3.apply(self.a_from_b, self.scale * np.asarray(points_b, dtype=np.float64))


def align_rigid(
    points_a: ArrayLike,
    points_b: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    collinear_ratio: float = COLLINEAR_RATIO,
) -> Alignment:
    """Rotation and translation that bring points of frame b onto points of frame a, in the least-squares sense.

    Parameters
    ----------
    points_a, points_b
        Corresponding points (n, 3), n >= 1, metres.
    weights
        Non-negative weights (n,), by default all equal.
    collinear_ratio
        Ratio of the second to the first eigenvalue of the points' scatter below which they count as collinear.

    Raises
    ------
    ValueError
        Where shapes differ, coordinates are not finite or no weight is positive.
    """
    return _align(points_a, points_b, weights=weights, collinear_ratio=collinear_ratio, with_scale=False)


def align_similarity(
    points_a: ArrayLike,
    points_b: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    collinear_ratio: float = COLLINEAR_RATIO,
) -> Alignment:
    """Like `align_rigid`, with the scale that brings frame b onto frame a.

    References
    ----------
    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991.
    """
    return _align(points_a, points_b, weights=weights, collinear_ratio=collinear_ratio, with_scale=True)


def scatter_eigenvalues(points: ArrayLike, weights: ArrayLike | None = None) -> Floats:
    """Eigenvalues (3,), largest first, square metres, of the covariance of points (n, 3)."""
    x = np.asarray(points, dtype=np.float64)
    w = _normalised(weights, len(x))
    x = x - w @ x
    result: Floats = np.clip(np.linalg.eigvalsh((x * w[:, None]).T @ x)[::-1], 0.0, None)
    return result


def rotation_between(direction_a: ArrayLike, direction_b: ArrayLike) -> Floats:
    """The smallest rotation (3, 3) that turns direction b (3,) into direction a (3,).

    Opposite directions are joined by a half turn about the axis nearest to z, so that up stays up where it can.
    """
    a, b = (v / np.linalg.norm(v) for v in (np.asarray(direction_a, float), np.asarray(direction_b, float)))
    cross, cosine = np.cross(b, a), float(a @ b)
    if cosine < -1 + 1e-12:
        reference = np.array([0.0, 0.0, 1.0]) if abs(b[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
        axis = reference - (reference @ b) * b
        return se3.exp_so3(np.pi * axis / np.linalg.norm(axis))
    sine = float(np.linalg.norm(cross))
    return se3.exp_so3(cross * (np.arctan2(sine, cosine) / sine)) if sine > 1e-15 else np.eye(3)


def _normalised(weights: ArrayLike | None, n: int) -> Floats:
    w = np.ones(n) if weights is None else np.asarray(weights, dtype=np.float64)
    if w.shape != (n,) or n == 0 or not np.isfinite(w).all() or (w < 0).any() or w.sum() <= 0:
        raise ValueError(f"{n} points need as many finite weights >= 0, one of them positive")
    result: Floats = w / w.sum()
    return result


def _align(
    points_a: ArrayLike, points_b: ArrayLike, *, weights: ArrayLike | None, collinear_ratio: float, with_scale: bool
) -> Alignment:
    a, b = np.asarray(points_a, dtype=np.float64), np.asarray(points_b, dtype=np.float64)
    if a.shape != b.shape or a.ndim != 2 or a.shape[1] != 3:
        raise ValueError(f"corresponding points must be two arrays (n, 3), got {a.shape} and {b.shape}")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError("points to be aligned must be finite")
    w = _normalised(weights, len(a))
    mean_a, mean_b = w @ a, w @ b
    a, b = a - mean_a, b - mean_b
    dimensions = min(_dimensions(a, mean_a, w, collinear_ratio), _dimensions(b, mean_b, w, collinear_ratio))
    u, _, vt = np.linalg.svd((a * w[:, None]).T @ b)
    if dimensions >= 2:
        rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    elif dimensions == 1:
        rotation = rotation_between(u[:, 0], vt[0])
    else:
        rotation = np.eye(3)
    scale = 1.0
    if with_scale and dimensions >= 1:
        scale = float(w @ np.sum(a * (b @ rotation.T), axis=1) / (w @ np.sum(b * b, axis=1)))
    return Alignment(
        a_from_b=se3.transform(rotation, mean_a - scale * rotation @ mean_b), scale=scale, dimensions=dimensions
    )


def _dimensions(centred: Floats, mean: Floats, weights: Floats, collinear_ratio: float) -> int:
    eigenvalues = scatter_eigenvalues(centred, weights)
    # Coordinates of size |mean| carry rounding errors of this variance.
    floor = (4 * np.finfo(np.float64).eps * max(1e-6, float(np.abs(mean).max()))) ** 2
    if eigenvalues[0] <= floor:
        return 0
    if eigenvalues[1] <= max(floor, collinear_ratio * eigenvalues[0]):
        return 1
    return 2 if eigenvalues[2] <= max(floor, collinear_ratio * eigenvalues[0]) else 3
