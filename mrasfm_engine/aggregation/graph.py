"""Seams as a graph of scenes: what is connected, in which order, and which seams contradict the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mrasfm_engine.aggregation.association import component_labels
from mrasfm_engine.aggregation.seam import Seam
from mrasfm_engine.geometry import se3
from mrasfm_engine.mapping.pose_graph import Edges, optimise_pose_graph
from mrasfm_engine.types import Floats

MAX_CLOSING_M, MAX_CLOSING_DEG = 0.6, 1.5  # of a loop of seams, for each of them
LEAST_SIGMA_DEG, LEAST_SIGMA_M = 0.02, 0.01  # of a seam: scenes are bent by more than their images' noise says


@dataclass(frozen=True, kw_only=True)
class Closing:
    """Misclosure of a seam that closes a loop: its transform against the chain of the other seams."""

    seam: int
    shift_m: float
    turn_deg: float
    length: int  # seams of the loop

    @property
    def plausible(self) -> bool:
        """Return whether the errors of good seams can add up to this misclosure."""
        return self.shift_m <= MAX_CLOSING_M * self.length and self.turn_deg <= MAX_CLOSING_DEG * self.length


@dataclass(frozen=True, kw_only=True)
class Chain:
    """Scenes of one component put together one after the other."""

    scenes: tuple[int, ...]  # in the order in which they came; the first one is where it was
    seams: tuple[int, ...]  # by which the second and later ones came
    first_from_scene: dict[int, Floats]
    closings: tuple[Closing, ...]  # of the component's other seams


class SeamGraph:
    """Seams between scenes, these by index."""

    def __init__(self, names: Sequence[str], seams: Sequence[Seam]) -> None:
        self.seams = list(seams)
        number = {name: k for k, name in enumerate(names)}
        self._ends = [(number[s.a], number[s.b]) for s in seams]
        self._count = len(names)

    def components(self) -> list[tuple[int, ...]]:
        """Scenes that accepted seams connect, the largest first, each with its members ascending."""
        groups: dict[int, list[int]] = {}
        for scene, value in enumerate(component_labels(self._count, (self._ends[k] for k in self._accepted()))):
            groups.setdefault(value, []).append(scene)
        return sorted((tuple(g) for g in groups.values()), key=lambda g: (-len(g), g))

    def chain(self, start: int) -> Chain:
        """Join the component of a scene one scene after the other, always over the best seam there is."""
        poses = {start: np.eye(4)}
        order, used = [start], []
        parent: dict[int, int] = {}
        while True:
            open_seams = [k for k in self._accepted() if sum(end in poses for end in self._ends[k]) == 1]
            if not open_seams:
                break
            k = max(open_seams, key=self._strength)
            a, b = self._ends[k]
            known, new = (a, b) if a in poses else (b, a)
            step = self.seams[k].a_from_b if known == a else se3.inverse(self.seams[k].a_from_b)
            poses[new], parent[new] = poses[known] @ step, known
            order.append(new)
            used.append(k)
        closings = tuple(
            self._closing(k, poses, parent) for k in self._accepted() if k not in used and self._ends[k][0] in poses
        )
        return Chain(scenes=tuple(order), seams=tuple(used), first_from_scene=poses, closings=closings)

    def without_contradictions(self, start: int) -> tuple[SeamGraph, Chain]:
        """The graph without seams that contradict the others round a loop, and its chain.

        Which seam of a loop is wrong, the loop does not say: the one goes without which least contradicts, of several
        the weakest.
        """
        graph, chain = self, self.chain(start)
        while bad := [c for c in chain.closings if not c.plausible]:
            worst = max(bad, key=lambda c: c.shift_m)
            suspects = [worst.seam, *chain.seams]

            def left(k: int, graph: SeamGraph = graph) -> tuple[int, int, tuple[int, int]]:
                rest = graph._without(k, "")
                found = rest.chain(start)
                contradicting = sum(not c.plausible for c in found.closings)
                return contradicting, -len(found.scenes), graph._strength(k)

            k = min(suspects, key=left)
            graph = graph._without(k, f"it contradicts the other seams: a loop does not close by {worst.shift_m:.2f} m")
            chain = graph.chain(start)
        return graph, chain

    def balanced(self, chain: Chain) -> dict[int, Floats]:
        """Poses (by scene) with the errors of loops spread over their seams; the chain's first scene stays."""
        if not chain.closings:
            return dict(chain.first_from_scene)
        members = list(chain.scenes)
        row = {scene: k for k, scene in enumerate(members)}
        used = [*chain.seams, *(c.seam for c in chain.closings)]
        units = np.array([[row[e] for e in self._ends[k]] for k in used], dtype=np.int64)
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

    def _accepted(self) -> list[int]:
        return [k for k, seam in enumerate(self.seams) if seam.accepted]

    def _strength(self, k: int) -> tuple[int, int]:
        quality = self.seams[k].quality
        return min(quality["units_a"], quality["units_b"]), quality["inliers"]

    def _sigmas(self, seam: Seam) -> tuple[float, float]:
        rotation, translation = (np.sqrt(np.trace(seam.covariance[i : i + 3, i : i + 3]) / 3) for i in (0, 3))
        return (
            float(np.hypot(rotation, np.radians(LEAST_SIGMA_DEG))),
            float(np.hypot(translation, LEAST_SIGMA_M)),
        )

    def _closing(self, k: int, poses: dict[int, Floats], parent: dict[int, int]) -> Closing:
        a, b = self._ends[k]
        by_others = se3.inverse(poses[a]) @ poses[b]
        seam = self.seams[k]
        at = seam.place_b_m[None]
        shift = np.linalg.norm(se3.apply(by_others, at) - se3.apply(seam.a_from_b, at))
        turn = se3.rotation_angle_deg(by_others[:3, :3] @ seam.a_from_b[:3, :3].T)
        return Closing(seam=k, shift_m=float(shift), turn_deg=float(turn), length=1 + _path_length(a, b, parent))

    def _without(self, k: int, reason: str) -> SeamGraph:
        result = SeamGraph.__new__(SeamGraph)
        result.seams = [replace(s, accepted=False, reason=reason) if i == k else s for i, s in enumerate(self.seams)]
        result._ends, result._count = self._ends, self._count
        return result


def _path_length(a: int, b: int, parent: dict[int, int]) -> int:
    """Seams between two scenes along the chain."""

    def up(scene: int) -> list[int]:
        path = [scene]
        while scene in parent:
            scene = parent[scene]
            path.append(scene)
        return path

    above_a, above_b = up(a), up(b)
    common = next(s for s in above_a if s in set(above_b))
    return above_a.index(common) + above_b.index(common)
