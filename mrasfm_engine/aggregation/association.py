"""Candidate pairs of scenes, from positions alone, before any image is compared."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mrasfm_engine.aggregation.image_search import similar_scenes
from mrasfm_engine.aggregation.pairs import SIGHT_SHIFT_M, common_view, nearest_distance_m
from mrasfm_engine.aggregation.source import SourceScene
from mrasfm_engine.config import AggregationConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.types import Cancel, Floats


@dataclass(frozen=True, kw_only=True)
class Association:
    """Scenes as their positions place them."""

    reference: int  # whose frame is the map's
    map_from_scene: Floats  # (scenes, 4, 4), NaN of scenes that have no positions
    pairs: tuple[tuple[int, int], ...]  # of scenes that are to be compared, the smaller index first

    def of_scenes(self, chosen: Sequence[int]) -> Association:
        """The same of some scenes, the reference among them, by their new indices."""
        row = {k: new for new, k in enumerate(chosen)}
        return Association(
            reference=row[self.reference],
            map_from_scene=self.map_from_scene[list(chosen)],
            pairs=tuple((row[i], row[j]) for i, j in self.pairs if i in row and j in row),
        )


def associate(scenes: Sequence[SourceScene], config: AggregationConfig, *, cancel: Cancel | None = None) -> Association:
    """Put scenes into one frame by their positions, and say which are to be compared.

    The reference is the scene whose midpoint is nearest to the geometric centre of all (ties: more units, then the
    smaller name). Frames of different origins are combined through earth-centred coordinates. Scenes without positions
    are compared with those whose images look most like theirs.

    Raises
    ------
    CancelledError
        Where `cancel` answers True.
    """
    placed = [k for k, scene in enumerate(scenes) if scene.is_placed]
    middle = np.stack([se3.apply(s.ecef_from_local, s.midpoint_m[None])[0] for s in scenes])
    away = np.linalg.norm(middle - middle[placed].mean(0), axis=1)
    reference = min(
        placed,
        key=lambda k: (round(float(away[k]), 2), -int(scenes[k].unit_registered.sum()), scenes[k].name),
    )
    map_from_ecef = se3.inverse(scenes[reference].ecef_from_local)
    map_from_scene = np.stack([_composed(map_from_ecef, s.ecef_from_local) for s in scenes])
    return Association(
        reference=reference,
        map_from_scene=map_from_scene,
        pairs=tuple(sorted([*_pairs(scenes, placed, config), *similar_scenes(scenes, config, cancel=cancel)])),
    )


def coarse_transform(a: SourceScene, b: SourceScene) -> Floats:
    """Transform a_from_b (4, 4) by the positions of both scenes."""
    return _composed(se3.inverse(a.ecef_from_local), b.ecef_from_local)


def _composed(local_from_ecef: Floats, ecef_from_other: Floats) -> Floats:
    # The difference of the origins first: products with 6.4e6 m would cost precision.
    rotation = local_from_ecef[:3, :3]
    origin = -rotation.T @ local_from_ecef[:3, 3]
    return se3.transform(rotation @ ecef_from_other[:3, :3], rotation @ (ecef_from_other[:3, 3] - origin))


def _pairs(scenes: Sequence[SourceScene], placed: Sequence[int], config: AggregationConfig) -> list[tuple[int, int]]:
    """Pairs of placed scenes that are to be compared, of those within reach, by how much their footprints overlap."""
    reach = config.position_error_m + SIGHT_SHIFT_M
    scores: dict[tuple[int, int], tuple[float, float]] = {}
    for i, j in _near(scenes, placed, reach):
        a_from_b = coarse_transform(scenes[i], scenes[j])
        apart = nearest_distance_m(scenes[i], scenes[j], a_from_b)
        if apart <= reach:
            scores[i, j] = (common_view(scenes[i], scenes[j], a_from_b, config), -apart)
    return choose_pairs(len(scenes), scores, config.candidates)


def _near(scenes: Sequence[SourceScene], placed: Sequence[int], reach_m: float) -> Iterator[tuple[int, int]]:
    """Pairs of placed scenes, the smaller index first, whose trajectories may come within reach of one another.

    A ball around a trajectory holds all of it, so that of a city's scenes few pairs are compared place by place.
    """
    middle, radius = np.zeros((len(placed), 3)), np.zeros(len(placed))
    for row, k in enumerate(placed):
        trajectory = scenes[k].trajectory_m
        centre = 0.5 * (trajectory.min(0) + trajectory.max(0))
        middle[row] = se3.apply(scenes[k].ecef_from_local, centre[None])[0]
        radius[row] = np.linalg.norm(trajectory - centre, axis=1).max()
    for row, i in enumerate(placed):
        between = (middle[row + 1 :] - middle[row]) @ scenes[i].ecef_from_local[:3, :2]  # horizontal, as reach is
        apart = np.linalg.norm(between, axis=1) - radius[row + 1 :] - radius[row]
        for later in np.flatnonzero(apart <= reach_m).tolist():
            yield i, placed[row + 1 + later]


def choose_pairs(
    count: int, scores: Mapping[tuple[int, int], tuple[float, ...]], candidates: int
) -> list[tuple[int, int]]:
    """Choose scored pairs of scenes of which one is among the other's candidates, and as many between their groups.

    Scenes of one street fill each other's lists: without the latter, those of the street across would be compared with
    none of them.
    """
    best_first = sorted(scores, key=lambda pair: scores[pair], reverse=True)
    chosen: set[tuple[int, int]] = set()
    taken = [0] * count
    for pair in best_first:
        if min(taken[k] for k in pair) < candidates:
            chosen.add(pair)
        for k in pair:
            taken[k] += 1
    group = component_labels(count, chosen)
    between: dict[tuple[int, int], int] = {}
    for i, j in best_first:
        ends = min(group[i], group[j]), max(group[i], group[j])
        between[ends] = between.get(ends, 0) + 1
        if ends[0] != ends[1] and between[ends] <= candidates:
            chosen.add((i, j))
    return sorted(chosen)


def component_labels(count: int, pairs: Iterable[tuple[int, int]]) -> list[int]:
    """The component (count,) of each of some scenes, which pairs connect."""
    ends = np.array(list(pairs), dtype=np.int64).reshape(-1, 2)
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
    labels: list[int] = connected_components(graph, directed=False)[1].tolist()
    return labels
