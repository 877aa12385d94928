"""A plane as heights over horizontal coordinates, by locally optimised RANSAC (Chum, Matas and Kittler, DAGM 2003)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from mrasfm_engine.jit import njit, uncounted
from mrasfm_engine.types import Bools, Floats, Ints

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
    starts = _hypotheses(xy_m, height_m, sigma_m, weight, expected_slope, max_slope_change, rng)
    plane = np.empty(3)
    if not _best(
        starts, xy_m, height_m, sigma_m, weight, expected_slope, sigma_slope, max_slope_change, plane
    ):  # fmt: skip
        return None
    inliers = np.abs(height_m - plane[0] - xy_m @ plane[1:]) < GATE_SIGMAS * sigma_m
    if inliers.sum() < min_points:
        return None
    return HeightPlane(
        offset_m=float(plane[0]),
        slope=plane[1:],
        support=float(weight[inliers].sum() / weight.sum()),
        inliers=inliers,
    )


def refit_height_planes(
    planes: Floats, first: Ints, xy_m: Floats, height_m: Floats, sigma_m: Floats, weight: Floats,
    slopes: Floats, sigma_slope: float,
) -> tuple[Floats, Floats, Ints]:  # fmt: skip
    """Planes (k, 3) of offset and slope, each optimised again over its own points.

    Parameters
    ----------
    planes, slopes
        Planes (k, 3) near the wanted ones, and expected slopes (k, 2).
    first
        Points of plane k are rows `first[k]` to `first[k + 1]` of the arrays of points, which are as in
        `fit_height_plane`, each point's coordinates from its own patch's centre.

    Returns
    -------
    The planes, the share of the weight that agrees with each (k,), and how many points do (k,).
    """
    result, support, count = planes.copy(), np.zeros(len(planes)), np.zeros(len(planes), dtype=np.int64)
    _refit(result, first, xy_m, height_m, sigma_m, weight, slopes, sigma_slope, support, count)
    return result, support, count


@uncounted()
def _refit(
    planes: Any, first: Any, xy: Any, height: Any, sigma: Any, weight: Any, slopes: Any, sigma_slope: float,
    support: Any, count: Any,
) -> None:  # fmt: skip
    for k in range(len(planes)):
        lo, hi = first[k], first[k + 1]
        _optimise(planes[k], xy[lo:hi], height[lo:hi], sigma[lo:hi], weight[lo:hi], slopes[k], sigma_slope)
        agree, total = 0.0, 0.0
        for n in range(lo, hi):
            total += weight[n]
            off = height[n] - planes[k, 0] - xy[n, 0] * planes[k, 1] - xy[n, 1] * planes[k, 2]
            if abs(off) < GATE_SIGMAS * sigma[n]:
                agree += weight[n]
                count[k] += 1
        support[k] = agree / total if total > 0.0 else 0.0


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
    chance = np.cumsum(weight / sigma)
    chance /= chance[-1]

    def drawn(*shape: int) -> Ints:
        result: Ints = np.minimum(chance.searchsorted(rng.random(shape), side="right"), len(height) - 1)
        return result

    some = drawn(HYPOTHESES, 3)
    a, b = xy[some[:, 1]] - xy[some[:, 0]], xy[some[:, 2]] - xy[some[:, 0]]
    det = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    wide = np.abs(det) > 2 * SMALLEST_AREA_M2
    some, a, b, det = some[wide], a[wide], b[wide], det[wide]
    rise_a, rise_b = height[some[:, 1]] - height[some[:, 0]], height[some[:, 2]] - height[some[:, 0]]
    slope = np.stack([rise_a * b[:, 1] - rise_b * a[:, 1], a[:, 0] * rise_b - b[:, 0] * rise_a], 1) / det[:, None]
    offset = height[some[:, 0]] - (slope * xy[some[:, 0]]).sum(1)
    single = drawn(LEVEL_HYPOTHESES)
    level = np.tile(expected_slope, (LEVEL_HYPOTHESES, 1))
    planes = np.concatenate(
        [
            np.column_stack([offset, slope])[np.hypot(*(slope - expected_slope).T) <= max_slope_change],
            np.column_stack([height[single] - xy[single] @ expected_slope, level]),
        ]
    )
    scored = drawn(SCORED) if len(height) > SCORED else np.arange(len(height))
    residual = height[scored] - planes[:, :1] - planes[:, 1:] @ xy[scored].T
    cost = np.minimum((residual / (GATE_SIGMAS * sigma[scored])) ** 2, 1.0) @ weight[scored]
    result: Floats = planes[np.argsort(cost, kind="stable")[:OPTIMISED]]
    return result


@njit(cache=True, nogil=True, error_model="numpy")
def _best(
    starts: Any, xy: Any, height: Any, sigma: Any, weight: Any, expected: Any, sigma_slope: float,
    max_slope_change: float, plane: Any,
) -> bool:  # fmt: skip
    """The best plane (3,), written into `plane`, of those that hypotheses (k, 3) lead to; whether there is one."""
    found, least = False, np.inf
    x = np.empty(3)
    for start in starts:
        x[:] = start
        _optimise(x, xy, height, sigma, weight, expected, sigma_slope)
        if math.hypot(x[1] - expected[0], x[2] - expected[1]) > max_slope_change:
            continue
        score = 0.0
        for n in range(len(height)):
            e = (height[n] - x[0] - xy[n, 0] * x[1] - xy[n, 1] * x[2]) / (GATE_SIGMAS * sigma[n])
            score += weight[n] * min(e * e, 1.0)
        if score < least:
            found, least = True, score
            plane[:] = x
    return found


@uncounted()
def _optimise(x: Any, xy: Any, height: Any, sigma: Any, weight: Any, expected: Any, sigma_slope: float) -> None:
    """Least squares with Tukey's weights from a hypothesis x (3,), in place, with the prior on the slope."""
    prior = 1.0 / sigma_slope**2
    for _ in range(STEPS):
        h00, h01, h02, h11, h12, h22 = 1e-12, 0.0, 0.0, prior, 0.0, prior
        g0, g1, g2 = 0.0, expected[0] * prior, expected[1] * prior
        agree = 0
        for n in range(len(height)):
            a, b = xy[n, 0], xy[n, 1]
            e = (height[n] - x[0] - a * x[1] - b * x[2]) / (GATE_SIGMAS * sigma[n])
            if e * e >= 1.0 or weight[n] <= 0.0:
                continue
            agree += 1
            w = weight[n] / sigma[n] ** 2 * (1.0 - e * e) ** 2
            h00 += w
            h01 += w * a
            h02 += w * b
            h11 += w * a * a
            h12 += w * a * b
            h22 += w * b * b
            g0 += w * height[n]
            g1 += w * a * height[n]
            g2 += w * b * height[n]
        if agree == 0:
            return
        # The offset is eliminated, and the slope's two equations are left: sums about the weighted mean.
        s11, s12, s22 = h11 - h01 * h01 / h00, h12 - h01 * h02 / h00, h22 - h02 * h02 / h00
        r1, r2 = g1 - h01 * g0 / h00, g2 - h02 * g0 / h00
        det = s11 * s22 - s12 * s12
        slope0, slope1 = (s22 * r1 - s12 * r2) / det, (s11 * r2 - s12 * r1) / det
        offset = (g0 - h01 * slope0 - h02 * slope1) / h00
        change = max(abs(offset - x[0]), abs(slope0 - x[1]), abs(slope1 - x[2]))
        x[0], x[1], x[2] = offset, slope0, slope1
        if change < CONVERGED_M:
            return
