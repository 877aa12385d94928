"""Line 6c: what a road's surface keeps of bumps, bays and crowns, and how long it takes on 2 km."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.triangulation.road_surface import KnownPatches, fit_road
from tests.benchmarks.table import Figure, reference_loop_s
from tests.helpers.road_shapes import SHAPES

SEEDS = range(5)
NOISE_M = 0.01
LENGTH_M, HALF_WIDTH_M = 60.0, 5.0
POINTS_A_M2 = 2
LONG_M, LONG_HALF_WIDTH_M, LONG_POINTS = 2000.0, 8.0, 400_000
THREADS = 2


def road_shapes(data: Path, work: Path) -> Iterator[Figure]:
    """Shares of true points that are lost, by shape, and the time of one round on a long road."""
    for name, shape in SHAPES.items():
        lost = []
        for seed in SEEDS:
            rng = np.random.default_rng(seed)
            count = int(POINTS_A_M2 * LENGTH_M * 2 * HALF_WIDTH_M)
            x, y = rng.uniform(0, LENGTH_M, count), rng.uniform(-HALF_WIDTH_M, HALF_WIDTH_M, count)
            raised_m = shape(x, y)
            points = np.column_stack([x, y, raised_m + rng.normal(0, NOISE_M, count)])
            sigma = np.full(count, NOISE_M)
            road = fit_road(points, sigma, _way(LENGTH_M), radius_m=8.0, rng=rng, max_offset_m=0.05)
            assert road is not None
            off = road.off(road.limits_m(sigma, sigmas=3.0, max_offset_m=0.05))
            lost.append(off[raised_m != 0].mean())
        what = f"{name}, 1 cm of noise: true points that are dropped"
        yield Figure(line="6c", what=what, value=float(np.mean(lost)), above=-1e-9, most=0.03)
    first_s, known = _long_road_s(None)
    again_s, _ = _long_road_s(known)
    title = f"{LONG_M / 1000:g} km of road, {LONG_POINTS} points"
    yield Figure(line="6c", what=f"{title}: a round from nothing", value=first_s, unit="s", most=3.0)
    yield Figure(line="6c", what=f"{title}: a round from the one before", value=again_s, unit="s", most=3.0)
    yield Figure(line="6c", what="a loop of ten million additions beside it", value=reference_loop_s(), unit="s")


def _long_road_s(known: KnownPatches | None) -> tuple[float, KnownPatches]:
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, LONG_M, LONG_POINTS), rng.uniform(-LONG_HALF_WIDTH_M, LONG_HALF_WIDTH_M, LONG_POINTS)
    points = np.column_stack([x, y, 1.5 * np.sin(x / 60.0) + rng.normal(0, NOISE_M, LONG_POINTS)])
    sigma = np.full(LONG_POINTS, NOISE_M)
    for count in (2000, LONG_POINTS):  # the first compiles
        begin_s = time.perf_counter()
        road = fit_road(
            points[:count], sigma[:count], _way(LONG_M, hills=True), radius_m=8.0, rng=rng, known=known, threads=THREADS
        )
        taken_s = time.perf_counter() - begin_s
        assert road is not None
    return taken_s, road.known


def _way(length_m: float, *, hills: bool = False) -> np.ndarray:
    x = np.arange(0.0, length_m, 1.5)
    height = 1.5 + (1.5 * np.sin(x / 60.0) if hills else 0 * x)
    return se3.transform(np.tile(np.eye(3), (len(x), 1, 1)), np.column_stack([x, 0 * x, height]))
