"""Seams as a graph of scenes: what is connected, in which order, and which seams contradict the others."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from heapq import heapify, heappop, heappush

import numpy as np

from mrasfm_engine.aggregation.association import component_labels
from mrasfm_engine.aggregation.loops import Loop, LoopConsistency, ScenePaths
from mrasfm_engine.aggregation.seam import Seam, with_bends
from mrasfm_engine.geometry import se3
from mrasfm_engine.mapping.pose_graph import Edges, optimise_pose_graph
from mrasfm_engine.types import Floats


@dataclass(frozen=True, kw_only=True)
class Closing:
    """Misclosure of a seam that closes a loop: its transform against the chain of the other seams."""

    seam: int
    shift_m: float
    turn_deg: float
    length: int  # seams of the loop


@dataclass(frozen=True, kw_only=True)
class Chain:
    """Scenes of one component put together one after the other."""

    scenes: tuple[int, ...]  # in the order in which they came; the first one is where it was
    seams: tuple[int, ...]  # by which the second and later ones came
    first_from_scene: dict[int, Floats]
    closings: tuple[Closing, ...]  # of the component's other seams


class SeamGraph:
    """Seams between scenes, these by index.

    Parameters
    ----------
    paths
        Those through every scene, for what loops say; without, scenes have the errors of their images alone.
    off_positions
        Distance of a seam from positions, in sigmas; without, these say nothing.

    Attributes
    ----------
    ends
        The scenes of each seam, a's and b's.
    """

    def __init__(
        self,
        names: Sequence[str],
        seams: Sequence[Seam],
        *,
        paths: Sequence[ScenePaths] | None = None,
        off_positions: Callable[[int], float] = lambda _: 0.0,
    ) -> None:
        self.seams = list(seams)
        self._names = names
        number = {name: k for k, name in enumerate(names)}
        self.ends = [(number[s.a], number[s.b]) for s in seams]
        self._paths = [ScenePaths()] * len(names) if paths is None else paths
        self._off_positions = off_positions
        self._of_scene = self._seams_of_scenes()

    def components(self) -> list[tuple[int, ...]]:
        """Scenes that accepted seams connect, the largest first, each with its members ascending."""
        groups: dict[int, list[int]] = {}
        for scene, value in enumerate(component_labels(len(self._paths), (self.ends[k] for k in self._accepted()))):
            groups.setdefault(value, []).append(scene)
        return sorted((tuple(g) for g in groups.values()), key=lambda g: (-len(g), g))

    def chain(self, start: int) -> Chain:
        """Join the component of a scene one scene after the other, always over the best seam there is."""
        poses = {start: np.eye(4)}
        order, used = [start], []
        parent: dict[int, int] = {}
        reached = [(self.weakness(k), k) for k in self._of_scene[start]]
        heapify(reached)
        while reached:
            _, k = heappop(reached)
            a, b = self.ends[k]
            if a in poses and b in poses:
                continue
            known, new = (a, b) if a in poses else (b, a)
            step = self.seams[k].a_from_b if known == a else se3.inverse(self.seams[k].a_from_b)
            poses[new], parent[new] = poses[known] @ step, known
            order.append(new)
            used.append(k)
            for other in self._of_scene[new]:
                heappush(reached, (self.weakness(other), other))
        others = sorted({k for scene in order for k in self._of_scene[scene]}.difference(used))
        closings = tuple(self._closing(k, poses, parent) for k in others)
        return Chain(scenes=tuple(order), seams=tuple(used), first_from_scene=poses, closings=closings)

    def without_contradictions(self) -> tuple[SeamGraph, tuple[Loop, ...]]:
        """The graph without seams that loops contradict or leave open, and the loops that do not close."""
        assessment = self.consistency().assess()
        return self.without(assessment.refused), assessment.loops

    def without(self, refused: Mapping[int, str]) -> SeamGraph:
        """The graph without some seams, that are not accepted for reasons."""
        seams = [
            replace(seam, accepted=False, reason=refused[k]) if k in refused else seam
            for k, seam in enumerate(self.seams)
        ]
        return SeamGraph(self._names, seams, paths=self._paths, off_positions=self._off_positions)

    def consistency(self) -> LoopConsistency:
        """The loops of the graph's seams, not assessed yet."""
        return LoopConsistency(
            self.seams, self.ends, of_scene=self._of_scene, paths=self._paths, off_positions=self._off_positions
        )

    def balanced(self, chain: Chain) -> dict[int, Floats]:
        """Poses (by scene) with the errors of loops spread over their seams; the chain's first scene stays."""
        if not chain.closings:
            return dict(chain.first_from_scene)
        members = list(chain.scenes)
        row = {scene: k for k, scene in enumerate(members)}
        used = [*chain.seams, *(c.seam for c in chain.closings)]
        units = np.array([[row[e] for e in self.ends[k]] for k in used], dtype=np.int64)
        # The first edge's first unit stays: let it be the chain's first scene.
        flip = units[:, 1] == 0
        measured = np.stack([self.seams[k].a_from_b for k in used])
        measured[flip] = se3.inverse(measured[flip])
        units[flip] = units[flip][:, ::-1]
        order = np.argsort(units[:, 0] != 0, kind="stable")
        sigma = np.array([self._sigmas(self.seams[k]) for k in used])
        poses = optimise_pose_graph(
            np.stack([chain.first_from_scene[scene] for scene in members]),
            Edges(
                units=units[order],
                a_from_b=measured[order],
                sigma_rotation_rad=sigma[order, 0],
                sigma_translation_m=sigma[order, 1],
                robust=np.ones(len(used), dtype=np.bool_),
            ),
        )
        return {scene: poses[k] for scene, k in row.items()}

    def _seams_of_scenes(self) -> list[list[int]]:
        result: list[list[int]] = [[] for _ in self._paths]
        for k in self._accepted():
            for end in self.ends[k]:
                result[end].append(k)
        return result

    def _accepted(self) -> list[int]:
        return [k for k, seam in enumerate(self.seams) if seam.accepted]

    def weakness(self, k: int) -> tuple[int, int]:
        """Order of seams: the strongest have the least."""
        quality = self.seams[k].quality
        return -min(quality["units_a"], quality["units_b"]), -quality["inliers"]

    def _sigmas(self, seam: Seam) -> tuple[float, float]:
        covariance = with_bends(seam.covariance)
        rotation, translation = (float(np.sqrt(np.trace(covariance[i : i + 3, i : i + 3]) / 3)) for i in (0, 3))
        return rotation, translation

    def _closing(self, k: int, poses: dict[int, Floats], parent: dict[int, int]) -> Closing:
        a, b = self.ends[k]
        by_others = se3.inverse(poses[a]) @ poses[b]
        seam = self.seams[k]
        at = seam.place_b_m[None]
        shift = np.linalg.norm(se3.apply(by_others, at) - se3.apply(seam.a_from_b, at))
        turn = se3.rotation_angle_deg(by_others[:3, :3] @ seam.a_from_b[:3, :3].T)
        return Closing(seam=k, shift_m=float(shift), turn_deg=float(turn), length=1 + _path_length(a, b, parent))


def _path_length(a: int, b: int, parent: dict[int, int]) -> int:
    """Seams between two scenes along the chain."""

    def up(scene: int) -> list[int]:
        path = [scene]
        while scene in parent:
            scene = parent[scene]
            path.append(scene)
        return path

    steps_to_b = {scene: steps for steps, scene in enumerate(up(b))}
    return next(steps + steps_to_b[scene] for steps, scene in enumerate(up(a)) if scene in steps_to_b)
