"""A plane as heights over horizontal coordinates, by locally optimised RANSAC (Chum, Matas and Kittler, DAGM 2003)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

HYPOTHESES = 96  # planes through three points
LEVEL_HYPOTHESES = 32  # planes through one point with the expected slope
SCORED = 400  # points that hypotheses are scored on
OPTIMISED = 3  # best hypotheses that are optimised
STEPS = 6  # of reweighted least squares, at most
CONVERGED_M = 1e-4
GATE_SIGMAS = 3.0
SMALLEST_AREA_M2 = 0.25  # of the triangle of three points


@dataclass(frozen=True, kw_only=True)
class HeightPlane:
    """`height = offset_m + slope . xy` over horizontal coordinates xy from the patch's centre."""

    offset_m: float
    slope: Floats  # (2,) metres of height a metre
    support: float  # share of the weight that agrees with it
    inliers: Bools  # (n,) of the points that it was fitted to

    def heights_m(self, xy_m: Floats) -> Floats:
        """Heights (n,) at horizontal coordinates (n, 2)."""
        result: Floats = self.offset_m + xy_m @ self.slope
        return result


def fit_height_plane(
    xy_m: Floats,
    height_m: Floats,
    sigma_m: Floats,
    weight: Floats,
    *,
    expected_slope: Floats,
    sigma_slope: float,
    max_slope_change: float,
    min_points: int,
    rng: np.random.Generator,
) -> HeightPlane | None:
    """The plane that most points agree with, each within its own uncertainty.

    Parameters
    ----------
    xy_m, height_m, sigma_m, weight
        Horizontal coordinates (n, 2), heights (n,), their standard deviations (n,), and how much each counts (n,).
    expected_slope, sigma_slope
        Slope (2,) that the plane should have, and how surely: where points lie on a line, it decides across the line.
    max_slope_change
        Planes whose slope is farther from the expected one are not looked at.
    min_points
        Planes that fewer points agree with are none.

    Returns
    -------
    The plane, or None where there is none.
    """
    if len(height_m) < min_points or not weight.sum() > 0:
        return None
    gate = GATE_SIGMAS * sigma_m
    best: tuple[float, Floats] | None = None
    for start in _hypotheses(xy_m, height_m, sigma_m, weight, expected_slope, max_slope_change, rng):
        plane = _optimise(start, xy_m, height_m, sigma_m, weight, expected_slope, sigma_slope)
        if np.hypot(*(plane[1:] - expected_slope)) > max_slope_change:
            continue
        score = float((weight * np.minimum(((height_m - plane[0] - xy_m @ plane[1:]) / gate) ** 2, 1.0)).sum())
        if best is None or score < best[0]:
            best = score, plane
    if best is None:
        return None
    plane = best[1]
    inliers = np.abs(height_m - plane[0] - xy_m @ plane[1:]) < gate
    if inliers.sum() < min_points:
        return None
    return HeightPlane(
        offset_m=float(plane[0]),
        slope=plane[1:],
        support=float(weight[inliers].sum() / weight.sum()),
        inliers=inliers,
    )


def _hypotheses(
    xy: Floats,
    height: Floats,
    sigma: Floats,
    weight: Floats,
    expected_slope: Floats,
    max_slope_change: float,
    rng: np.random.Generator,
) -> Floats:
    """The best few planes (k, 3) of offset and slope through random points."""
    chance: Floats = weight / sigma
    chance /= chance.sum()
    some = rng.choice(len(height), (HYPOTHESES, 3), p=chance)
    a, b = xy[some[:, 1]] - xy[some[:, 0]], xy[some[:, 2]] - xy[some[:, 0]]
    det = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    wide = np.abs(det) > 2 * SMALLEST_AREA_M2
    some, a, b, det = some[wide], a[wide], b[wide], det[wide]
    rise_a, rise_b = height[some[:, 1]] - height[some[:, 0]], height[some[:, 2]] - height[some[:, 0]]
    slope = np.stack([rise_a * b[:, 1] - rise_b * a[:, 1], a[:, 0] * rise_b - b[:, 0] * rise_a], 1) / det[:, None]
    offset = height[some[:, 0]] - (slope * xy[some[:, 0]]).sum(1)
    single = rng.choice(len(height), LEVEL_HYPOTHESES, p=chance)
    level = np.tile(expected_slope, (LEVEL_HYPOTHESES, 1))
    planes = np.concatenate(
        [
            np.column_stack([offset, slope])[np.hypot(*(slope - expected_slope).T) <= max_slope_change],
            np.column_stack([height[single] - xy[single] @ expected_slope, level]),
        ]
    )
    scored = rng.choice(len(height), SCORED, p=chance) if len(height) > SCORED else np.arange(len(height))
    residual = height[scored] - planes[:, :1] - planes[:, 1:] @ xy[scored].T
    cost = np.minimum((residual / (GATE_SIGMAS * sigma[scored])) ** 2, 1.0) @ weight[scored]
    result: Floats = planes[np.argsort(cost, kind="stable")[:OPTIMISED]]
    return result


def _optimise(
    plane: Floats, xy: Floats, height: Floats, sigma: Floats, weight: Floats, expected_slope: Floats, sigma_slope: float
) -> Floats:
    """Least squares with Tukey's weights from a hypothesis (3,), with the prior on the slope."""
    rows = np.column_stack([np.ones(len(xy)), xy])
    for _ in range(STEPS):
        residual = (height - rows @ plane) / (GATE_SIGMAS * sigma)
        w = weight / sigma**2 * np.clip(1.0 - residual**2, 0.0, None) ** 2
        normal = rows.T @ (w[:, None] * rows) + np.diag([1e-12, sigma_slope**-2, sigma_slope**-2])
        right = rows.T @ (w * height) + np.append(0.0, expected_slope) / sigma_slope**2
        if not w.any():
            return plane
        before = plane
        plane = np.asarray(np.linalg.solve(normal, right), dtype=np.float64)
        if np.abs(plane - before).max() < CONVERGED_M:
            break
    return plane
