"""Seams of simulated scenes: each scene drives through the places of its seams and is bent on its path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from mrasfm_engine.aggregation.graph import SeamGraph
from mrasfm_engine.aggregation.loops import DRIFT_RAD_PER_SQRT_M, ScenePaths, off_positions
from mrasfm_engine.aggregation.seam import Seam
from mrasfm_engine.geometry import se3
from mrasfm_engine.types import Floats

SIGMA_SEAM_RAD, SIGMA_SEAM_M = np.radians(0.02), 0.02
SIGMA_SCALE = 1e-3
STEP_M = 2.0
SPREAD_M = 4.0
UNITS_AT_SEAM = 5

Ends = Sequence[tuple[int, int]]


@dataclass(frozen=True, kw_only=True)
class SimulatedSeams:
    """A graph of scenes whose true poses are known."""

    world_from_scene: Floats  # (scenes, 4, 4)
    ends: list[tuple[int, int]]
    seams: list[Seam]
    paths: list[ScenePaths]
    sigma_position_m: float  # of the scenes' frames, as their receivers place them

    def graph(self) -> SeamGraph:
        """The seams as the aggregation has them."""
        sigma_m = np.full((UNITS_AT_SEAM, 3), self.sigma_position_m)
        return SeamGraph(
            [str(k) for k in range(len(self.paths))],
            self.seams,
            paths=self.paths,
            off_positions=lambda k: off_positions(self.seams[k], sigma_m, sigma_m),
        )

    def without(self, k: int) -> SimulatedSeams:
        """The same without a seam."""
        seams = [replace(seam, accepted=False) if i == k else seam for i, seam in enumerate(self.seams)]
        return replace(self, seams=seams)

    def with_wrong(self, wrong: dict[int, float], rng: np.random.Generator) -> SimulatedSeams:
        """The same with some seams off by so many metres, in any direction along the ground."""
        seams = list(self.seams)
        for k, off_m in wrong.items():
            angle = rng.uniform(0, 2 * np.pi)
            shift = se3.transform(np.eye(3), off_m * np.array([np.cos(angle), np.sin(angle), 0.0]))
            seams[k] = replace(seams[k], a_from_b=shift @ seams[k].a_from_b)
        return replace(self, seams=seams)


def ring(count: int, side_m: float = 60.0) -> tuple[Floats, Ends]:
    """Middles (count, 3) and seams of scenes round a block."""
    angle = 2 * np.pi * np.arange(count) / count
    radius_m = 0.5 * side_m / np.sin(np.pi / count)
    middles = radius_m * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    return middles, [(min(k, (k + 1) % count), max(k, (k + 1) % count)) for k in range(count)]


def torus(rows: int = 4, columns: int = 5, side_m: float = 60.0) -> tuple[Floats, Ends]:
    """Middles and seams of scenes of which every seam is on two loops of four that share no other one."""
    u, v = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    small, large = rows * side_m / (2 * np.pi), (rows + columns) * side_m / (2 * np.pi)
    about, around = 2 * np.pi * u / rows, 2 * np.pi * v / columns
    far = large + small * np.cos(about)
    middles = np.stack([far * np.cos(around), far * np.sin(around), small * np.sin(about)], axis=-1).reshape(-1, 3)
    number = np.arange(rows * columns).reshape(rows, columns)
    nexts = [np.roll(number, -1, axis=axis).ravel() for axis in (0, 1)]
    return middles, [
        (min(a, b), max(a, b)) for other in nexts for a, b in zip(number.ravel().tolist(), other.tolist(), strict=True)
    ]


def town(rows: int, columns: int, seams: int, side_m: float = 60.0) -> tuple[Floats, Ends]:
    """Middles and seams of scenes of a town's blocks: with the neighbours along both streets, and across some."""
    number = np.arange(rows * columns).reshape(rows, columns)
    middles = side_m * np.stack([number // columns, number % columns, 0 * number], axis=-1).reshape(-1, 3)
    pairs = [number[:, :-1], number[:, 1:], number[:-1], number[1:], number[:-1, :-1], number[1:, 1:]]
    ends = np.concatenate([np.stack([a.ravel(), b.ravel()], 1) for a, b in zip(pairs[::2], pairs[1::2], strict=True)])
    across = np.stack([number[:-1, 1:].ravel(), number[1:, :-1].ravel()], 1)
    ends = np.concatenate([ends, across])[:seams]
    return middles.astype(np.float64), [(int(a), int(b)) for a, b in ends]


def simulate(middles: Floats, ends: Ends, rng: np.random.Generator, *, sigma_position_m: float = 1.0) -> SimulatedSeams:
    """Scenes at middles (s, 3) that share places in the middle between them and their neighbours, about."""
    count = len(middles)
    world_from_scene = se3.transform(se3.exp_so3(rng.normal(0, [0.02, 0.02, 1.0], (count, 3))), middles)
    receiver_m = rng.normal(0, sigma_position_m, (count, 3))
    of_scene: list[list[int]] = [[] for _ in range(count)]
    for k, pair in enumerate(ends):
        for scene in pair:
            of_scene[scene].append(k)
    met_m = np.array([0.5 * (middles[a] + middles[b]) for a, b in ends])
    met_m += rng.normal(0, SPREAD_M, met_m.shape)  # no two seams of a scene are at one place
    places, bends, paths = {}, {}, []
    for scene, own in enumerate(of_scene):
        local_m = se3.apply(se3.inverse(world_from_scene[scene]), met_m[own])
        trajectory_m, bent = _driven(local_m, rng)
        paths.append(ScenePaths(trajectory_m=trajectory_m, sigma_scale=SIGMA_SCALE))
        for k, place_m, pose in zip(own, local_m, bent, strict=True):
            places[scene, k], bends[scene, k] = place_m, pose
    seams = []
    for k, (a, b) in enumerate(ends):
        truly = se3.inverse(world_from_scene[a]) @ world_from_scene[b]
        noise = _about(rng.normal(0, SIGMA_SEAM_RAD, 3), rng.normal(0, SIGMA_SEAM_M, 3), places[a, k])
        found = noise @ bends[a, k] @ truly @ se3.inverse(bends[b, k])
        coarse = truly.copy()
        coarse[:3, 3] += world_from_scene[a, :3, :3].T @ (receiver_m[b] - receiver_m[a])
        seams.append(_seam(a, b, found, coarse, se3.apply(bends[b, k], places[b, k][None])[0], rng))
    return SimulatedSeams(
        world_from_scene=world_from_scene, ends=list(ends), seams=seams, paths=paths, sigma_position_m=sigma_position_m
    )


def _driven(places_m: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """A path (n, 3) through places, and how its map is bent at each of them (places, 4, 4)."""
    path, at, bends = [places_m[0]], np.eye(4), [np.eye(4)]
    scale = 1.0 + rng.normal(0, SIGMA_SCALE)
    for start_m, end_m in pairwise(places_m):
        steps = max(2, round(float(np.linalg.norm(end_m - start_m)) / STEP_M))
        step_m = (end_m - start_m) / steps
        for number in range(1, steps + 1):
            here_m = start_m + number * step_m
            # The map goes on from where it has got to, turned by what it is bent, a little longer.
            reached_m = se3.apply(at, (here_m - step_m)[None])[0] + scale * at[:3, :3] @ step_m
            turn = se3.exp_so3(rng.normal(0, DRIFT_RAD_PER_SQRT_M * np.sqrt(np.linalg.norm(step_m)), 3)) @ at[:3, :3]
            at = se3.transform(turn, reached_m - turn @ here_m)
            path.append(here_m)
        bends.append(at)
    return np.array(path), np.array(bends)


def _about(turn: Floats, shift_m: Floats, at_m: Floats) -> Floats:
    rotation = se3.exp_so3(turn)
    return se3.transform(rotation, at_m - rotation @ at_m + shift_m)


def _seam(a: int, b: int, a_from_b: Floats, coarse: Floats, place_b_m: Floats, rng: np.random.Generator) -> Seam:
    none, units = np.zeros(0, dtype=np.int64), int(rng.integers(3, 30))
    return Seam(
        a=str(a),
        b=str(b),
        accepted=True,
        reason="",
        coarse_a_from_b=coarse,
        a_from_b=a_from_b,
        covariance=np.diag([SIGMA_SEAM_RAD**2] * 3 + [SIGMA_SEAM_M**2] * 3),
        shared=np.zeros((0, 2), dtype=np.int64),
        units_a=none,
        units_b=none,
        place_b_m=place_b_m,
        quality={"units_a": units, "units_b": units, "inliers": 50 * units},
    )
