"""Loops of seams: which seams other seams confirm, which they contradict, and what a loop leaves open.

Round a loop of right seams one comes back to where one began, but for what the seams and the scenes between them err
by. Both have covariances: a seam its own, a scene that of a path through it, which bends and has a scale that is known
no better than the scene says. The misclosure is tested against their sum.

A loop that closes well confirms all of its seams: a wrong one would have to be wrong by what its loop cannot tell. A
seam that does not close a loop of confirmed ones is wrong. Where a loop does not close and several of its seams are on
no loop that does, nothing in the graph says which of them is wrong; positions may, and else none of them is used. Each
seam is asked for its shortest loop, so that the cost grows with the seams [the idea: Zach, Klopschitz and Pollefeys,
Disambiguating Visual Relations Using Loop Constraints, CVPR 2010].
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.special import chdtrc, chdtri  # scipy.stats takes half a second to import

from mrasfm_engine.aggregation.seam import Seam, with_bends
from mrasfm_engine.aggregation.significance import in_sigmas
from mrasfm_engine.aggregation.source import SourceScene
from mrasfm_engine.geometry import se3
from mrasfm_engine.types import Floats

GATE_SIGMAS = 4.0  # of a loop and of positions: of right loops one in 16,000 is beyond
MAX_MISCLOSURE = float(chdtri(6, chdtrc(1, GATE_SIGMAS**2)))  # squared: as likely as one value beyond the gate
# A loop that closes no worse than most right ones do confirms its seams; between the two it says nothing.
CONFIRMING = float(chdtri(6, chdtrc(1, 2.0**2)))
# What images leave of a path: heading and tilt drift like a random walk. The similarity errors of reconstructed drives
# (0.01 to 0.07 m after 50 to 100 m, see docs/benchmarks/accuracy.md) are of this size.
DRIFT_RAD_PER_SQRT_M = np.radians(0.02) / np.sqrt(10.0)
# So many loops tell whether scenes of this map are bent by more, of which most have to be right.
MIN_LOOPS, USUAL_MISCLOSURE = 10, float(chdtri(6, 0.5))
UNKNOWN_SCALE_SHARE = 1.0 / 3.0  # of the largest difference between scenes that seams allow: a gate is several sigmas
STRAIGHT_PARTS = 32  # of a path of which only the ends are known


@dataclass(frozen=True, kw_only=True)
class ScenePaths:
    """Paths through a scene, from one seam to another.

    Attributes
    ----------
    trajectory_m
        (n, 3) of the scene's units, in its frame; where there is none, paths are straight.
    sigma_scale
        Relative standard deviation of the scene's lengths.
    """

    trajectory_m: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    sigma_scale: float = 0.0

    @staticmethod
    def from_scene(scene: SourceScene, *, most_scale: float, seen: float = 0.0) -> ScenePaths:
        """The paths through a scene, of which seams let scales differ by up to `most_scale`.

        `seen` is the largest difference that seams of the scene show: where it is beyond `most_scale`, the scene states
        an uncertainty that allows it.
        """
        largest = UNKNOWN_SCALE_SHARE * most_scale if seen <= most_scale else seen
        sigma = largest if scene.sigma_scale is None else min(scene.sigma_scale, largest)
        return ScenePaths(trajectory_m=scene.trajectory_m, sigma_scale=sigma)

    @cached_property
    def _turns(self) -> tuple[Floats, Floats]:
        """Places (n - 1, 3) in the middle between the trajectory's units, and how far these are apart."""
        return 0.5 * (self.trajectory_m[1:] + self.trajectory_m[:-1]), np.linalg.norm(
            np.diff(self.trajectory_m, axis=0), axis=1
        )

    def _parts(self, start_m: Floats, end_m: Floats) -> tuple[Floats, Floats]:
        """Places (n, 3) on the path between two others, and the lengths (n,) of it that they stand for."""
        chord_m = end_m - start_m
        share = (np.arange(STRAIGHT_PARTS) + 0.5) / STRAIGHT_PARTS
        straight = start_m + share[:, None] * chord_m, np.full(len(share), np.linalg.norm(chord_m) / len(share))
        if len(self.trajectory_m) < 2:
            return straight
        first, last = sorted(int(np.argmin(((self.trajectory_m - at) ** 2).sum(1))) for at in (start_m, end_m))
        places_m, lengths_m = self._turns
        on_it = places_m[first:last], lengths_m[first:last]
        return on_it if on_it[1].sum() > straight[1].sum() else straight

    def covariance(self, start_m: Floats, end_m: Floats) -> Floats:
        """Covariance (6, 6) of rotation and shift at the end of a path against its start, about its end, in the scene's
        axes.
        """
        places_m, lengths_m = self._parts(start_m, end_m)
        by_turn = np.zeros((len(places_m), 6, 3))  # of the path's end, by a turn on it
        by_turn[:, :3], by_turn[:, 3:] = np.eye(3), -se3.skew(end_m - places_m)
        result: Floats = np.einsum("n,nik,njk->ij", DRIFT_RAD_PER_SQRT_M**2 * lengths_m, by_turn, by_turn)
        longer_m = self.sigma_scale * (end_m - start_m)
        result[3:, 3:] += np.outer(longer_m, longer_m)
        return result


@dataclass(frozen=True, kw_only=True)
class Loop:
    """Seams round a loop that does not close.

    Attributes
    ----------
    seams, scenes
        One after the other; the first scene is where the first seam begins.
    shift_m, turn_deg
        The misclosure, at the place of the first seam.
    sigmas
        Its size: that of a normal variable as unlikely.
    sigma_m, sigma_deg
        Standard deviations of the misclosure, along the axes of which least is known.
    wrong
        Seams that are; none where nothing says which, or where all are confirmed by other loops.
    refused
        Seams that are not used because of this loop.
    """

    seams: tuple[int, ...]
    scenes: tuple[int, ...]
    shift_m: float
    turn_deg: float
    sigmas: float
    sigma_m: float
    sigma_deg: float
    wrong: tuple[int, ...] = ()
    refused: tuple[int, ...] = ()


@dataclass(frozen=True, kw_only=True)
class LoopAssessment:
    """Seams and loops after they are assessed."""

    refused: Mapping[int, str]  # seams that are not to be used, and why
    loops: tuple[Loop, ...]  # that do not close


class LoopConsistency:
    """Consistency of the accepted seams of a graph round its loops.

    Parameters
    ----------
    seams, ends
        All seams, and the numbers of each one's scenes.
    of_scene
        Accepted seams of every scene.
    paths
        Those through every scene.
    off_positions
        Distance of a seam, in sigmas, from what positions say; 0 where they say nothing.
    """

    def __init__(
        self,
        seams: Sequence[Seam],
        ends: Sequence[tuple[int, int]],
        *,
        of_scene: Sequence[Sequence[int]],
        paths: Sequence[ScenePaths],
        off_positions: Callable[[int], float],
    ) -> None:
        self._seams, self._ends, self._paths, self._off_positions = seams, ends, paths, off_positions
        self._of_scene = of_scene
        self._accepted = sorted({k for own in of_scene for k in own})
        # What the sharpest loop that confirms a seam leaves of it: standard deviations in m and deg.
        self._left = np.full((len(seams), 2), np.inf)
        self._wrong: dict[int, str] = {}  # why
        self._open: dict[frozenset[int], Loop] = {}  # loops that do not close
        self._tested: dict[frozenset[int], tuple[Loop, float]] = {}  # and their squared misclosures
        self._bent = 1.0  # variance of misclosures, of what is expected

    def assess(self) -> LoopAssessment:
        """Confirm what closes, find what does not."""
        shortest = [self._shortest_loop(k, frozenset()) for k in self._accepted]
        squared = [self._measured(path)[1] for path in {frozenset(p): p for p in shortest if p is not None}.values()]
        if len(squared) >= MIN_LOOPS:
            self._bent = max(1.0, float(np.median(squared)) / USUAL_MISCLOSURE)
        for path in shortest:
            self._test(path)
        while self._narrowed():
            pass
        return self._explained()

    def _narrowed(self) -> bool:
        """Test suspects on loops without wrong seams, of confirmed ones, and without one another; whether any was new.

        A suspect on no loop without its neighbours on this one is on none that could tell it from them.
        """
        new = False
        for loop in list(self._open.values()):
            suspects = self._suspects(loop)
            if any(k in self._wrong for k in loop.seams):
                # The others are on this loop no longer: what do they say without the wrong one?
                for k in suspects:
                    new |= k not in self._wrong and self._test(self._shortest_loop(k, frozenset()))
                continue
            if len(suspects) == 1:
                self._wrong[suspects[0]] = f"it contradicts {_words(loop)}, whose other seams other loops confirm"
                new = True
                continue
            unconfirmed = frozenset(k for k in self._accepted if not self._is_confirmed(k))
            for number, other in enumerate(suspects):
                new |= self._test(self._shortest_loop(other, unconfirmed - {other}))
                for k in {suspects[number - 1], suspects[(number + 1) % len(suspects)]} - {other}:
                    new |= self._test(self._shortest_loop(k, frozenset({other})))
        return new

    def _is_confirmed(self, k: int) -> bool:
        return bool(np.isfinite(self._left[k, 0]))

    def _singled_out(self, loop: Loop) -> None:
        """Take the seam for wrong that positions are far off, if there is one such among the loop's suspects."""
        if any(k in self._wrong for k in loop.seams):
            return
        off = {k: self._off_positions(k) for k in self._suspects(loop)}
        far = [k for k, sigmas in off.items() if sigmas > GATE_SIGMAS]
        if len(far) == 1:
            self._wrong[far[0]] = f"{_words(loop)} does not close, and positions are {off[far[0]]:.0f} sigmas off it"

    def _explained(self) -> LoopAssessment:
        """The loops that do not close, with what is wrong on them; suspects of which nothing tells more are refused."""
        # A loop of fewer suspects says more; of several that tell the same, the shortest is shown.
        loops = sorted(self._open.values(), key=lambda one: (len(self._suspects(one)), len(one.seams), one.seams))
        for loop in loops:
            self._singled_out(loop)
        refused, shown = dict(self._wrong), dict[tuple[int, ...], Loop]()
        for loop in loops:
            wrong = tuple(k for k in loop.seams if k in self._wrong)
            own = wrong or tuple(self._suspects(loop))
            for k in own:
                refused.setdefault(k, f"{_words(loop)} does not close, and nothing says which of its seams is wrong")
            shown.setdefault(own or loop.seams, replace(loop, wrong=wrong, refused=own))
        return LoopAssessment(refused=refused, loops=tuple(shown.values()))

    def _suspects(self, loop: Loop) -> list[int]:
        """Seams of a loop that nothing confirms, or only a loop that could not tell an error of this size."""
        left_m, left_deg = self._left[list(loop.seams)].T
        may = (GATE_SIGMAS * left_m >= loop.shift_m) & (GATE_SIGMAS * left_deg >= loop.turn_deg)
        return [k for k, suspect in zip(loop.seams, may.tolist(), strict=True) if suspect]

    def _test(self, path: list[int] | None) -> bool:
        """Test the loop of a path of seams: one that closes well confirms them. Whether that told something new."""
        if path is None:
            return False
        loop, squared = self._measured(path)
        squared /= self._bent
        if squared <= CONFIRMING:
            before = self._left[path].copy()
            left = np.sqrt(self._bent) * np.array([loop.sigma_m, loop.sigma_deg])
            self._left[path] = np.where((left < before).all(axis=1, keepdims=True), left, before)
            return bool((np.isinf(before) & np.isfinite(self._left[path])).any())
        key = frozenset(path)
        if squared <= MAX_MISCLOSURE or key in self._open:
            return False
        self._open[key] = replace(loop, sigmas=in_sigmas(squared, 6))
        return True

    def _measured(self, path: list[int]) -> tuple[Loop, float]:
        """The loop of a path of seams, and its squared misclosure."""
        key = frozenset(path)
        if key not in self._tested:
            scenes, off, covariance = self._closing(path)
            largest = [np.sqrt(np.linalg.eigvalsh(covariance[i : i + 3, i : i + 3])[-1]) for i in (3, 0)]
            loop = Loop(
                seams=tuple(path),
                scenes=scenes,
                shift_m=float(np.linalg.norm(off[3:])),
                turn_deg=float(np.degrees(np.linalg.norm(off[:3]))),
                sigmas=0.0,
                sigma_m=float(largest[0]),
                sigma_deg=float(np.degrees(largest[1])),
            )
            self._tested[key] = loop, float(off @ np.linalg.solve(covariance, off))
        return self._tested[key]

    def _shortest_loop(self, seam: int, without: frozenset[int]) -> list[int] | None:
        """The shortest loop through a seam, it first, over seams that are not known to be wrong; None without one."""
        start, goal = self._ends[seam][1], self._ends[seam][0]
        came: dict[int, tuple[int, int]] = {start: (-1, -1)}
        queue = deque([start])
        while queue:
            scene = queue.popleft()
            for k, other in self._steps(scene):
                if k == seam or other in came or k in self._wrong or k in without:
                    continue
                came[other] = (scene, k)
                if other == goal:
                    return [seam, *self._back(came, goal)]
                queue.append(other)
        return None

    @staticmethod
    def _back(came: dict[int, tuple[int, int]], scene: int) -> list[int]:
        path = []
        while came[scene][1] >= 0:
            scene, k = came[scene]
            path.append(k)
        return path[::-1]

    def _steps(self, scene: int) -> Iterator[tuple[int, int]]:
        for k in self._of_scene[scene]:
            a, b = self._ends[k]
            yield k, b if a == scene else a

    def _closing(self, path: Sequence[int]) -> tuple[tuple[int, ...], Floats, Floats]:
        """Scenes of a loop, its misclosure (6,) at the first seam's place, and the covariance (6, 6) of that."""
        scenes = [self._ends[path[0]][0]]
        pose = np.eye(4)  # of the present scene, in the first one's frame
        here: list[tuple[Floats, Floats]] = []  # places there, and covariances of errors about them
        first_m, arrived_m = self._place(path[0], scenes[0]), np.zeros(3)
        for number, k in enumerate(path):
            scene = scenes[-1]
            leave_m = self._place(k, scene)
            if number:
                here.append(_error_at(pose, leave_m, self._paths[scene].covariance(arrived_m, leave_m)))
            a, b = self._ends[k]
            here.append(_error_at(pose if scene == a else pose @ se3.inverse(self._seams[k].a_from_b),
                                  self._place(k, a), with_bends(self._seams[k].covariance)))  # fmt: skip
            pose = pose @ (self._seams[k].a_from_b if scene == a else se3.inverse(self._seams[k].a_from_b))
            scenes.append(b if scene == a else a)
            arrived_m = self._place(k, scenes[-1])
        here.append(_error_at(pose, first_m, self._paths[scenes[0]].covariance(arrived_m, first_m)))
        end_m = se3.apply(pose, first_m[None])[0]
        covariance = np.zeros((6, 6))
        for at_m, own in here:
            carried = np.eye(6)
            carried[3:, :3] = -se3.skew(end_m - at_m)
            covariance += carried @ own @ carried.T
        return tuple(scenes[:-1]), np.concatenate([se3.log_so3(pose[:3, :3]), end_m - first_m]), covariance

    def _place(self, k: int, scene: int) -> Floats:
        """The place (3,) of a seam in the frame of one of its scenes."""
        seam = self._seams[k]
        at = seam.place_b_m[None]
        result: Floats = (se3.apply(seam.a_from_b, at) if scene == self._ends[k][0] else at)[0]
        return result


def _error_at(first_from_scene: Floats, at_m: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """A place (3,) and the covariance of an error about it, from a scene's axes to those of the loop's first one."""
    turned = np.kron(np.eye(2), first_from_scene[:3, :3])
    return se3.apply(first_from_scene, at_m[None])[0], turned @ covariance @ turned.T


def _words(loop: Loop) -> str:
    return f"a loop of {len(loop.seams)} seams that is {loop.shift_m:.2f} m and {loop.turn_deg:.2f} deg off"


def off_positions(seam: Seam, sigma_a_m: Floats, sigma_b_m: Floats) -> float:
    """Distance of a seam, in sigmas, from where the positions of both scenes put them; 0 where they are not known.

    As a normal variable as unlikely as the shift (3,) at the seam's place.

    Parameters
    ----------
    sigma_a_m, sigma_b_m
        (n, 3) of both scenes' units at the seam, along their frames' axes; NaN where not known.
    """
    known = [sigma_m[np.isfinite(sigma_m).all(1)] for sigma_m in (sigma_a_m, sigma_b_m)]
    if not all(len(rows) for rows in known):
        return 0.0
    at = seam.place_b_m[None]
    shift_m = (se3.apply(seam.a_from_b, at) - se3.apply(seam.coarse_a_from_b, at))[0]
    # What units of a scene err by they share, as receivers do: its mean square, not its mean's.
    of_a, of_b = (np.diag((rows**2).mean(0)) for rows in known)
    a_from_b = seam.a_from_b[:3, :3]
    covariance = of_a + a_from_b @ of_b @ a_from_b.T + with_bends(seam.covariance)[3:, 3:]
    squared = float(shift_m @ np.linalg.solve(covariance, shift_m))
    return in_sigmas(squared, 3)
