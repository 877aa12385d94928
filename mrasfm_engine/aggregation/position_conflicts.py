"""Seams that would join scenes whose positions contradict that, over scenes that have no positions.

The seam of two scenes with positions is refused where it contradicts these by more than `aggregation.position_error_m`.
A scene without positions has none to contradict: over it, scenes would be joined that are at two places of the earth by
their receivers. Such a scene stays with the larger group, and the others are placed by their positions.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from mrasfm_engine.aggregation.association import coarse_transform
from mrasfm_engine.aggregation.graph import SeamGraph
from mrasfm_engine.aggregation.loops import GATE_SIGMAS, UNKNOWN_SCALE_SHARE, ScenePaths
from mrasfm_engine.aggregation.map_placement import ScenePlace
from mrasfm_engine.aggregation.source import SourceScene
from mrasfm_engine.config import AggregationConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.types import Floats


@dataclass(kw_only=True)
class _Group:
    """Scenes that seams have joined, by index, with their poses (4, 4) in the group's frame."""

    poses: dict[int, Floats]
    placed: list[int] = field(default_factory=list)  # those with positions


def contradicted_by_positions(
    graph: SeamGraph, scenes: Sequence[SourceScene], settings: AggregationConfig
) -> dict[int, str]:
    """Accepted seams over which scenes without positions would join scenes whose positions contradict that, and why.

    Seams of two scenes with positions come first, then those with the largest groups of these, the strongest first.
    """
    groups = [_Group(poses={k: np.eye(4)}, placed=[k] if scene.is_placed else []) for k, scene in enumerate(scenes)]
    accepted = [k for k, seam in enumerate(graph.seams) if seam.accepted]
    between = [k for k in accepted if all(scenes[end].is_placed for end in graph.ends[k])]
    if len(between) == len(accepted):
        return {}
    for k in between:
        _join(groups, graph, k)
    size = {k: max(len(groups[end].placed) for end in graph.ends[k]) for k in accepted}
    refused: dict[int, str] = {}
    for k in sorted(set(accepted).difference(between), key=lambda k: (-size[k], graph.weakness(k), k)):
        reason = _conflict(groups, graph, k, scenes, settings)
        if reason:
            refused[k] = reason
        else:
            _join(groups, graph, k)
    return refused


def _join(groups: list[_Group], graph: SeamGraph, k: int) -> None:
    """Join the groups of a seam's ends, where they are two: the smaller one moves, so that few scenes do."""
    a, b = (groups[end] for end in graph.ends[k])
    if a is b:
        return
    larger, smaller, larger_from_smaller = a, b, _between(a, b, graph, k)
    if len(a.poses) < len(b.poses):
        larger, smaller, larger_from_smaller = b, a, se3.inverse(larger_from_smaller)
    larger.poses.update({scene: larger_from_smaller @ pose for scene, pose in smaller.poses.items()})
    larger.placed += smaller.placed
    for scene in smaller.poses:
        groups[scene] = larger


def _between(a: _Group, b: _Group, graph: SeamGraph, k: int) -> Floats:
    """Transform (4, 4) between the frames of two groups by a seam."""
    i, j = graph.ends[k]
    return a.poses[i] @ graph.seams[k].a_from_b @ se3.inverse(b.poses[j])


def _conflict(
    groups: Sequence[_Group], graph: SeamGraph, k: int, scenes: Sequence[SourceScene], settings: AggregationConfig
) -> str:
    """Reason against a seam by the positions of the scenes nearest to it on both sides; empty where there is none."""
    a, b = (groups[end] for end in graph.ends[k])
    if a is b or not a.placed or not b.placed:
        return ""
    a_from_b = _between(a, b, graph, k)
    at_m = se3.apply(a_from_b @ b.poses[graph.ends[k][1]], graph.seams[k].place_b_m[None])[0]
    i, place_i = _nearest(((one, a.poses[one]) for one in a.placed), scenes, at_m)
    j, place_j = _nearest(((one, a_from_b @ b.poses[one]) for one in b.placed), scenes, at_m)
    i_from_group = se3.inverse(a.poses[i])
    i_from_j = i_from_group @ a_from_b @ b.poses[j]
    start_m, end_m = se3.apply(i_from_group, np.stack([place_i, place_j]))
    at_j = se3.apply(se3.inverse(i_from_j), end_m[None])
    by_positions_m = se3.apply(coarse_transform(scenes[i], scenes[j]), at_j)[0]
    off_m = float(np.linalg.norm(end_m - by_positions_m))
    if off_m <= settings.position_error_m + GATE_SIGMAS * _sigma_m(scenes[i], start_m, end_m, settings):
        return ""
    return (
        f"it would join scenes {scenes[i].name} and {scenes[j].name}, whose positions contradict that by "
        f"{off_m:.1f} m, more than aggregation.position_error_m"
    )


def _nearest(placed: Iterable[tuple[int, Floats]], scenes: Sequence[SourceScene], at_m: Floats) -> tuple[int, Floats]:
    """The scene that comes nearest to a place (3,), by index, and where (3,) it does, of scenes with their poses."""
    found = []
    for k, pose in placed:
        trajectory = se3.apply(pose, scenes[k].trajectory_m)
        apart = np.linalg.norm(trajectory - at_m, axis=1)
        found.append((float(apart.min()), k, trajectory[int(apart.argmin())]))
    _, nearest, place = min(found, key=lambda one: one[:2])
    return nearest, place


def _sigma_m(scene: SourceScene, start_m: Floats, end_m: Floats, settings: AggregationConfig) -> float:
    """Standard deviation of a place (3,) that seams carry from another one (3,) of a scene, along its worst axis.

    It holds how scenes between drift, the largest scale that they may have, and how the scene is turned by positions.
    """
    largest = UNKNOWN_SCALE_SHARE * settings.max_scale_error
    drift = ScenePaths(sigma_scale=largest).covariance(start_m, end_m)[3:, 3:]
    place = ScenePlace.from_scene(scene)
    turn = np.nan_to_num(np.linalg.norm(place.sigma_m)) / place.spread_m * float(np.linalg.norm(end_m - start_m))
    return float(np.hypot(np.sqrt(np.linalg.eigvalsh(drift)[-1]), turn))
