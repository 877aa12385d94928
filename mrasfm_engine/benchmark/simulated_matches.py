"""Verified matches of a simulated long route, as the matching stage would leave them.

Pairs are those of the ordinary window, and revisits. Revisits are not found by descriptors here but taken from the
truth, with what a search by similarity does wrong: it misses some, and takes some other place for the same. Descriptors
would have to be simulated, compared and clustered for millions of keypoints. That takes long and much memory, is not
what is to be measured, and random descriptors say nothing of how well a search tells real places apart.

Of the matches of every pair a tenth is wrong: the wrong end is any keypoint that lies near the epipolar line, so that
verification lets it pass.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from mrasfm_engine.config import EngineConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.jit import njit
from mrasfm_engine.matching.image_motion import Motion, are_following
from mrasfm_engine.matching.pair_selection import pairs_from_window, units_ahead
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import PairMatches
from mrasfm_engine.synthetic.long_route import LongRoute
from mrasfm_engine.types import CountProgress, Floats, Ints

WRONG = 0.1  # share of every pair's matches
MAX_ANGLE_DEG = 35.0  # between the views of a point that still look alike
MAX_RATIO = 2.0  # of their distances
REVISIT_M, REVISIT_WAY_M = 5.0, 30.0  # units this near to each other, so long a way apart
REVISIT_ANGLE_DEG = 45.0  # between axes of cameras
NOT_FOUND = 0.2  # share of units whose revisits the search misses
FALSE_REVISITS = 0.1  # share of units that it takes for another place
FALSE_MATCHES = (20, 40)  # of such a pair


@dataclass(frozen=True, kw_only=True)
class _View:
    """One image, and its keypoints in the order of their points."""

    camera: int
    focal_px: float
    world_from_cam: Floats
    point: Ints  # (n,) rising
    keypoint: Ints  # (n,) which keypoint each is
    away_m: Floats  # (n, 3) from the point to the camera
    rays: Floats  # (n, 3) unit rays of the keypoints, with their noise, in camera axes


def simulate_matches(
    drive: Drive,
    route: LongRoute,
    config: EngineConfig,
    rng: np.random.Generator,
    *,
    progress: CountProgress | None = None,
) -> list[PairMatches]:
    """Verified matches of the route's image pairs; `drive` has one image for each of the route's."""
    views = list(_views(route))
    motion = Motion.from_travelled(drive, route.travelled_m)
    window = pairs_from_window(drive, config.pairs, motion)
    true, false = revisits(views, route, config.pairs.revisit_pairs_per_unit, rng)
    result = []
    pairs = np.unique(np.concatenate([window, true]), axis=0)
    for done, (a, b) in enumerate(pairs.tolist(), 1):
        matches = _matches(views[a], views[b], config, rng)
        if len(matches) >= config.matching.min_matches:
            result.append(_verified(a, b, matches))
        if progress is not None and done % 1000 == 0:
            progress(done, len(pairs))
    for a, b in false.tolist():
        matches = _chance_matches(views[a], views[b], config, rng)
        if len(matches) >= config.matching.min_matches:
            result.append(_verified(a, b, matches))
    unit = np.array([image.unit for image in drive.images], dtype=np.int64)
    a, b = np.array([(pair.image_a, pair.image_b) for pair in result], dtype=np.int64).reshape(-1, 2).T
    follows = are_following(units_ahead(motion, config.pairs), unit[a], unit[b])
    result = [replace(pair, is_revisit=not near) for pair, near in zip(result, follows, strict=True)]
    return sorted(result, key=lambda pair: (pair.image_a, pair.image_b))


def _verified(a: int, b: int, matches: Ints) -> PairMatches:
    return PairMatches(
        image_a=a, image_b=b, matches=matches.astype(np.int32), inliers=np.ones(len(matches), dtype=np.bool_)
    )


def _views(route: LongRoute) -> Iterator[_View]:
    for image, (xy_px, point) in enumerate(zip(route.xy_px, route.point, strict=True)):
        unit, camera = divmod(image, len(route.cameras))
        params = np.array(route.cameras[camera].params)
        world_from_cam = route.world_from_rig[unit] @ route.cameras[camera].rig_from_cam
        order = np.argsort(point)
        rays = np.concatenate([(xy_px[order] - params[2:4]) / params[:2], np.ones((len(order), 1))], axis=1)
        yield _View(
            camera=camera,
            focal_px=float(params[0]),
            world_from_cam=world_from_cam,
            point=point[order],
            keypoint=order,
            away_m=world_from_cam[:3, 3] - route.points_m[point[order]],
            rays=rays / np.linalg.norm(rays, axis=1, keepdims=True),
        )


def revisits(views: list[_View], route: LongRoute, per_unit: int, rng: np.random.Generator) -> tuple[Ints, Ints]:
    """Image pairs (n, 2) of units that came back, and (m, 2) of places that only look alike.

    As in `matching.retrieval`, a unit has its `per_unit` best pairs; of a pair of one camera, the units' other
    cameras are paired as well.
    """
    cameras, units = len(route.cameras), len(route.world_from_rig)
    near: dict[int, list[int]] = defaultdict(list)
    travelled_m = route.travelled_m
    for u, v in cKDTree(route.world_from_rig[:, :3, 3]).query_pairs(REVISIT_M, output_type="ndarray").tolist():
        if travelled_m[v] - travelled_m[u] > REVISIT_WAY_M:
            near[u].append(v)
            near[v].append(u)
    true: set[tuple[int, int]] = set()
    false: set[tuple[int, int]] = set()
    for u in range(units):
        if near[u] and rng.random() >= NOT_FOUND:
            for i, j in _most_alike(views, cameras, u, near[u], per_unit):
                pairs = [(i, j)]
                if views[i].camera == views[j].camera:
                    pairs = [(i - i % cameras + c, j - j % cameras + c) for c in range(cameras)]
                true |= {(min(pair), max(pair)) for pair in pairs}
        other = int(rng.integers(units))
        if (
            rng.random() < FALSE_REVISITS
            and abs(travelled_m[other] - travelled_m[u]) > REVISIT_WAY_M
            and other not in near[u]
        ):
            i, j = (cameras * unit + int(rng.integers(cameras)) for unit in sorted((u, other)))
            false.add((i, j))
    as_array = [np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2) for pairs in (true, false - true)]
    return as_array[0], as_array[1]


def _most_alike(views: list[_View], cameras: int, unit: int, others: list[int], count: int) -> list[tuple[int, int]]:
    """Image pairs of a unit and units near it that share most points."""
    alike = []
    for i in range(cameras * unit, cameras * (unit + 1)):
        for other in others:
            for j in range(cameras * other, cameras * (other + 1)):
                cosine = views[i].world_from_cam[:3, 2] @ views[j].world_from_cam[:3, 2]
                if cosine > np.cos(np.radians(REVISIT_ANGLE_DEG)):
                    alike.append((len(_common(views[i], views[j])[0]), i, j))
    return [(i, j) for shared, i, j in sorted(alike, key=lambda a: (-a[0], *a[1:]))[:count] if shared]


def _common(a: _View, b: _View) -> tuple[Ints, Ints]:
    """Rows of two views that show the same point."""
    if not len(a.point) or not len(b.point):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    at = np.minimum(np.searchsorted(b.point, a.point), len(b.point) - 1)
    rows = np.flatnonzero(b.point[at] == a.point)
    return rows, at[rows]


def _matches(a: _View, b: _View, config: EngineConfig, rng: np.random.Generator) -> Ints:
    """Matches (n, 2) of keypoints: points that look alike from both sides, and wrong ones in place of some."""
    i, j = _common(a, b)
    from_a, from_b = (np.linalg.norm(rows, axis=1) for rows in (a.away_m[i], b.away_m[j]))
    cosine = (a.away_m[i] * b.away_m[j]).sum(1) / (from_a * from_b)
    alike = cosine > np.cos(np.radians(MAX_ANGLE_DEG))
    alike &= (from_a < MAX_RATIO * from_b) & (from_b < MAX_RATIO * from_a)
    i, j = i[alike], j[alike]
    b_from_a = se3.inverse(b.world_from_cam) @ a.world_from_cam
    true_partner = np.full(len(a.point), -1, dtype=np.int64)
    true_partner[i] = j
    wrong, to = _near_epipolar_lines(
        b_from_a, a, b, rng.permutation(i), round(WRONG * len(i)), true_partner, config, rng
    )
    # What looks most like something else has no other match: matches are mutual.
    free_a, free_b = np.ones(len(a.point), dtype=np.bool_), np.ones(len(b.point), dtype=np.bool_)
    free_a[wrong] = free_b[to] = False
    true = free_a[i] & free_b[j]
    i, j = np.concatenate([i[true], wrong]), np.concatenate([j[true], to])
    return np.stack([a.keypoint[i], b.keypoint[j]], axis=-1)


def _chance_matches(a: _View, b: _View, config: EngineConfig, rng: np.random.Generator) -> Ints:
    """Matches (n, 2) between two places that agree with some motion by chance, here 1 m ahead."""
    b_from_a = se3.transform(se3.exp_so3(rng.normal(0.0, 0.02, 3)), np.array([*rng.normal(0.0, 0.1, 2), -1.0]))
    nothing = np.full(len(a.point), -1, dtype=np.int64)
    count = int(rng.integers(*FALSE_MATCHES))
    i, j = _near_epipolar_lines(b_from_a, a, b, rng.permutation(len(a.point)), count, nothing, config, rng)
    return np.stack([a.keypoint[i], b.keypoint[j]], axis=-1)


def _near_epipolar_lines(
    b_from_a: Floats, a: _View, b: _View, rows: Ints, count: int, true_partner: Ints, config: EngineConfig,
    rng: np.random.Generator,
) -> tuple[Ints, Ints]:  # fmt: skip
    """Wrong matches that verification takes for right ones: rows (n,) of one view, n <= `count`, and of the other."""
    rotation, translation_m = b_from_a[:3, :3].copy(), b_from_a[:3, 3].copy()
    essential = se3.skew(translation_m) @ rotation
    max_sine = math.sin(config.matching.max_error_px / max(a.focal_px, b.focal_px))
    found: tuple[Ints, Ints] = _match_wrongly(
        rows, count, a.rays, b.rays, essential, rotation, translation_m, max_sine, true_partner, rng.random(len(rows))
    )
    return found


@njit(cache=True, nogil=True)
def _match_wrongly(
    rows: Any, count: int, rays_a: Any, rays_b: Any, essential: Any, rotation: Any, translation_m: Any,
    max_sine: float, true_partner: Any, chance: Any,
) -> Any:  # fmt: skip
    """Match rows, one after the other, with any ray that is near the epipolar line, in front and not taken yet.

    These are `epipolar_errors` and `in_front_of_both` for one ray against many: as arrays they take ten times as long.
    """
    taken = np.zeros(len(rays_b), np.bool_)
    fitting = np.empty(len(rays_b), np.int64)
    own, other = np.empty(count, np.int64), np.empty(count, np.int64)
    found = 0
    for n in range(len(rows)):
        if found == count:
            break
        ray = rays_a[rows[n]]
        normal, turned = essential @ ray, rotation @ ray
        limit = max_sine * math.sqrt((normal**2).sum())
        fits = 0
        for j in range(len(rays_b)):
            sine = normal[0] * rays_b[j, 0] + normal[1] * rays_b[j, 1] + normal[2] * rays_b[j, 2]
            if abs(sine) < limit and not taken[j] and j != true_partner[rows[n]]:
                cosine = (turned * rays_b[j]).sum()
                along_a, along_b = (turned * translation_m).sum(), (rays_b[j] * translation_m).sum()
                if cosine * along_b > along_a and along_b > cosine * along_a:
                    fitting[fits] = j
                    fits += 1
        if fits:
            j = fitting[int(chance[n] * fits)]
            taken[j] = True
            own[found], other[found] = rows[n], j
            found += 1
    return own[:found], other[:found]
