"""Line 13: camera set bundle adjustment beside Ceres, which COLMAP uses, on one problem in one run.

Sixty units of six cameras see some 300,000 observations of points in tracks of up to six units, with noise of 0.7 px.
Units, calibration and points are free (but one unit and one camera, which hold the gauge), and start where the growing
scene would leave them. Each solver has a process of its own. It is timed, setting up included, until its cost is within
`WITHIN` of the lower of both final costs.
"""

from __future__ import annotations

import ctypes
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from mrasfm_engine.bundle_adjustment.problem import Layout, Observations
from mrasfm_engine.bundle_adjustment.solver import Problem, SolverOptions, solve
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import PERSPECTIVE, packed
from mrasfm_engine.scene.state import State
from mrasfm_engine.synthetic.simulate import SimulatedObservations, simulate_observations
from tests.benchmarks.commands import CommandFailed
from tests.benchmarks.table import Figure
from tests.helpers.ceres_reference import CeresProblem

UNITS, CAMERAS, POINTS = 60, 6, 130_000
TRACK_UNITS, SEEN = 6, 0.8
NOISE_PX = 0.7
MIN_ANGLE_DEG = 1.0
START = {"unit_deg": 0.05, "unit_m": 0.02, "camera_deg": 0.05, "camera_m": 0.005, "point_m": 0.05}
THREADS = 2
TOLERANCE, WITHIN = 1e-6, 1e-4
MAX_ITERATIONS = 100
MIN_SPEED, MAX_MEMORY_SHARE = 6.0, 0.5


def adjustment(data: Path, work: Path, repeat: int) -> Iterator[Figure]:
    """Line 13."""
    goal = (1 + WITHIN) * min(_measured(solver)["cost"] for solver in ("ours", "ceres"))
    # Solvers take the same way every time: how far they must go is asked once.
    ours, theirs = ([_measured(solver, goal)] for solver in ("ours", "ceres"))
    for _ in range(repeat - 1):
        ours.append(_measured("ours", goal, int(ours[0]["iterations"])))
        theirs.append(_measured("ceres", goal, int(theirs[0]["iterations"])))
    title = f"{UNITS} units of {CAMERAS} cameras, {ours[0]['observations']} observations"
    for name, runs in (("ours", ours), ("Ceres", theirs)):
        yield Figure(line="13", what=f"{title}: {name}, cost at its end", value=runs[0]["cost"])
        yield Figure(line="13", what=f"{title}: {name}, iterations to within {WITHIN:g}", value=runs[0]["iterations"])
        seconds = statistics.median(run["seconds"] for run in runs)
        yield Figure(line="13", what=f"{title}: {name}, time to within {WITHIN:g}", value=seconds, unit="s")
        yield Figure(line="13", what=f"{title}: {name}, peak memory", value=runs[0]["peak_mb"], unit="MB")
    ratio = statistics.median(t["seconds"] / o["seconds"] for o, t in zip(ours, theirs, strict=True))
    yield Figure(line="13", what=f"{title}: how many times as fast as Ceres", value=ratio, above=MIN_SPEED, most=1e3)
    share = max(o["peak_mb"] / t["peak_mb"] for o, t in zip(ours, theirs, strict=True))
    yield Figure(line="13", what=f"{title}: memory, as a part of Ceres'", value=share, most=MAX_MEMORY_SHARE)


def _measured(solver: str, *limits: float) -> dict[str, float]:
    """One solver in a process of its own: to its end, to a cost, or to a cost after known iterations."""
    argv = [sys.executable, "-m", "tests.benchmarks.adjustment", solver, *map(repr, limits)]
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    try:
        figures: dict[str, float] = json.loads(done.stdout)
    except ValueError:
        raise CommandFailed(f"{' '.join(argv[1:])}: {done.stderr.strip()[-300:]}") from None
    return figures


def long_problem() -> Problem:
    """The problem, at its start."""
    rng = np.random.default_rng(0)
    sim = simulate_observations(units=UNITS, cameras=CAMERAS, points=POINTS, noise_px=NOISE_PX, rng=rng)
    # Tracks end: keypoints are found again in some of a few consecutive units.
    begin = rng.integers(1 - TRACK_UNITS, UNITS, POINTS)[sim.point]
    kept = (sim.unit >= begin) & (sim.unit < begin + TRACK_UNITS) & (rng.random(len(sim.unit)) < SEEN)
    lengths = np.bincount(sim.point[kept], minlength=POINTS)
    kept &= lengths[sim.point] >= 3
    kept &= _has_angle(sim, kept)[sim.point]
    points, point = np.unique(sim.point[kept], return_inverse=True)
    order = np.argsort(point, kind="stable")
    free_units, free_cameras = np.ones(UNITS, dtype=np.bool_), np.ones(CAMERAS, dtype=np.bool_)
    free_units[0] = free_cameras[0] = False
    problem = Problem(
        state=_start(sim.world_from_rig, sim.rig_from_cam, sim.camera_params, sim.points_m[points], rng),
        camera_kind=np.zeros(CAMERAS, dtype=np.int64),
        observations=Observations(
            unit=sim.unit[kept][order].astype(np.int64),
            camera=sim.camera[kept][order].astype(np.int64),
            point=point[order].astype(np.int64),
            xy_px=sim.xy_px[kept][order],
            num_points=len(points),
        ),
        layout=Layout.from_free(free_units, free_cameras),
        options=SolverOptions(
            max_iterations=MAX_ITERATIONS, function_tolerance=TOLERANCE, decrement_tolerance=0.0, threads=THREADS
        ),
    )
    # Points are where the poses of the start see them.
    return replace(problem, state=problem.with_points_refined(problem.state))


def _has_angle(sim: SimulatedObservations, kept: np.ndarray) -> np.ndarray:
    """Points (p,) whose rays spread by more than MIN_ANGLE_DEG: without depth they have no optimum to compare."""
    centre_m = (sim.world_from_rig[:, None] @ sim.rig_from_cam[None])[sim.unit[kept], sim.camera[kept], :3, 3]
    rays = sim.points_m[sim.point[kept]] - centre_m
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    mean, count = np.zeros_like(sim.points_m), np.bincount(sim.point[kept], minlength=len(sim.points_m))
    np.add.at(mean, sim.point[kept], rays)
    # The mean of unit vectors that spread by an angle s is shorter than one by s^2 / 2.
    length = np.linalg.norm(mean, axis=1) / np.maximum(count, 1)
    return np.degrees(np.sqrt(2 * np.maximum(1 - length, 0.0))) > MIN_ANGLE_DEG


def _start(
    world_from_rig: np.ndarray,
    rig_from_cam: np.ndarray,
    camera_params: np.ndarray,
    points_m: np.ndarray,
    rng: np.random.Generator,
) -> State:
    def turned(rotation: np.ndarray, deg: float) -> np.ndarray:
        vectors = np.radians(deg) * rng.normal(size=(len(rotation), 3))
        vectors[0] = 0.0
        return se3.exp_so3(vectors) @ rotation

    def shifted(position_m: np.ndarray, by_m: float) -> np.ndarray:
        steps = by_m * rng.normal(size=position_m.shape)
        steps[0] = 0.0
        return position_m + steps

    return State(
        unit_rotation=turned(world_from_rig[:, :3, :3], START["unit_deg"]),
        unit_position_m=shifted(world_from_rig[:, :3, 3], START["unit_m"]),
        camera_rotation=turned(rig_from_cam[:, :3, :3], START["camera_deg"]),
        camera_position_m=shifted(rig_from_cam[:, :3, 3], START["camera_m"]),
        camera_params=np.stack([packed(PERSPECTIVE, own)[1] for own in camera_params]),
        camera_time_offset_s=np.zeros(len(camera_params)),
        points_m=shifted(points_m, START["point_m"]),
    )


def _ours(problem: Problem) -> tuple[float, float, float]:
    rss = _reset_peak_mb()
    started = time.perf_counter()
    _, report = solve(problem)
    return time.perf_counter() - started, report.final_cost, _peak_mb() - rss


def _ceres(problem: Problem) -> tuple[float, float, float]:
    handed = CeresProblem.of(problem)
    rss = _reset_peak_mb()
    started = time.perf_counter()
    handed.adjuster().solve()
    seconds = time.perf_counter() - started
    return seconds, problem.cost(handed.state()), _peak_mb() - rss


def _reset_peak_mb() -> float:
    """Give back what is free, and forget the process's peak of memory; what it uses now."""
    ctypes.CDLL("libc.so.6").malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    return _peak_mb()


def _peak_mb() -> float:
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return float(status.split("VmHWM:")[1].split()[0]) / 1e3


def _until(
    problem: Problem, run: Callable[[Problem], tuple[float, float, float]], goal: float, high: int = 1
) -> dict[str, float]:
    """The fewest iterations that reach the goal, by bisection from what is known to, or at first from one."""

    def after(iterations: int) -> tuple[float, float, float]:
        return run(replace(problem, options=replace(problem.options, max_iterations=iterations)))

    low = 0 if high == 1 else high - 1  # what is known to reach it is known to be the fewest
    while (best := after(high))[1] > goal:
        if high >= MAX_ITERATIONS:
            raise RuntimeError(f"{MAX_ITERATIONS} iterations do not reach {goal}: {best}")
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        if (found := after(middle))[1] > goal:
            low = middle
        else:
            high, best = middle, found
    return {"iterations": high, "seconds": best[0], "cost": best[1], "peak_mb": best[2]}


def main() -> int:
    """Measure one solver, to its own end or to a cost, and print what was measured."""
    pycolmap.logging.minloglevel = 3
    os.environ.setdefault("OMP_NUM_THREADS", str(THREADS))
    run, problem = {"ours": _ours, "ceres": _ceres}[sys.argv[1]], long_problem()
    if sys.argv[1] == "ours":
        solve(problem.of_points(np.arange(problem.observations.num_points) < 1000))  # compiled kernels are loaded
    if len(sys.argv) > 2:
        figures = _until(problem, run, float(sys.argv[2]), *map(int, sys.argv[3:]))
    else:
        seconds, cost, peak_mb = run(problem)
        figures = {"seconds": seconds, "cost": cost, "peak_mb": peak_mb}
    print(json.dumps({**figures, "observations": len(problem.observations.unit)}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
