"""Seams as a graph: chains, loops whose errors are spread, and a seam that contradicts the others."""

from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.aggregation.graph import SeamGraph
from mrasfm_engine.aggregation.seam import Seam
from mrasfm_engine.geometry import se3

NONE = np.zeros(0, dtype=np.int64)


def seam(a: int, b: int, a_from_b: np.ndarray, *, inliers: int = 500, accepted: bool = True) -> Seam:
    return Seam(
        a=str(a),
        b=str(b),
        accepted=accepted,
        reason="" if accepted else "nothing is shared",
        coarse_a_from_b=a_from_b,
        a_from_b=a_from_b,
        covariance=np.diag([1e-8] * 3 + [1e-6] * 3),
        shared=np.zeros((0, 2), dtype=np.int64),
        units_a=NONE,
        units_b=NONE,
        place_b_m=np.zeros(3),
        quality={"units_a": 10, "units_b": 10, "inliers": inliers},
    )


def poses(rng: np.random.Generator, count: int = 4) -> np.ndarray:
    return se3.transform(se3.exp_so3(0.1 * rng.normal(size=(count, 3))), 30.0 * rng.normal(size=(count, 3)))


def noisy(pose: np.ndarray, rng: np.random.Generator, m: float = 0.02) -> np.ndarray:
    return pose @ se3.transform(se3.exp_so3(1e-4 * rng.normal(size=3)), m * rng.normal(size=3))


def ring(world: np.ndarray, rng: np.random.Generator) -> list[Seam]:
    ends = [(k, (k + 1) % len(world)) for k in range(len(world))]
    return [
        seam(min(e), max(e), noisy(se3.inverse(world[min(e)]) @ world[max(e)], rng), inliers=900 - 100 * k)
        for k, e in enumerate(ends)
    ]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def largest_seam_error_m(found: dict[int, np.ndarray], world: np.ndarray, seams: list[Seam]) -> float:
    def error(s: Seam) -> float:
        a, b = int(s.a), int(s.b)
        lies, truly = (se3.inverse(p[a]) @ p[b] for p in (found, world))
        return float(np.linalg.norm(lies[:3, 3] - truly[:3, 3]))

    return max(error(s) for s in seams)


def test_a_chain_takes_the_strongest_seams_first(rng: np.random.Generator) -> None:
    world = poses(rng)
    graph = SeamGraph(["0", "1", "2", "3"], ring(world, rng))
    chain = graph.chain(0)
    assert chain.scenes == (0, 1, 2, 3)  # the weakest seam, 0 - 3, is left over
    assert len(chain.seams) == 3
    assert [(c.seam, c.length) for c in chain.closings] == [(3, 4)]
    assert 0 < chain.closings[0].shift_m < 0.3
    assert np.allclose(chain.first_from_scene[0], np.eye(4))


def test_a_loop_is_closed_by_all_of_its_seams(rng: np.random.Generator) -> None:
    """The largest error at a seam is the closing one's after a chain, and less than half of it when spread."""
    chained, balanced = [], []
    for _ in range(20):
        world = poses(rng)
        seams = ring(world, rng)
        graph = SeamGraph(["0", "1", "2", "3"], seams)
        chain = graph.chain(0)
        chained.append(abs(chain.closings[0].shift_m))
        found = graph.balanced(chain)
        k = chain.closings[0].seam
        a, b = int(seams[k].a), int(seams[k].b)
        lies = se3.inverse(found[a]) @ found[b]
        balanced.append(float(np.linalg.norm(lies[:3, 3] - seams[k].a_from_b[:3, 3])))
    assert 0 < np.median(balanced) < 0.5 * np.median(chained)


def test_components_and_scenes_alone(rng: np.random.Generator) -> None:
    world = poses(rng, 5)
    seams = [seam(0, 1, np.eye(4)), seam(2, 3, np.eye(4)), seam(1, 2, np.eye(4), accepted=False)]
    graph = SeamGraph(list("01234"[: len(world)]), seams)
    assert graph.components() == [(0, 1), (2, 3), (4,)]
    assert graph.chain(4).scenes == (4,)


@pytest.mark.parametrize("wrong", [2, 4])
def test_a_seam_that_others_contradict_goes(rng: np.random.Generator, wrong: int) -> None:
    """A ring of four, and both of its diagonals: every seam is on loops without any other."""
    world = poses(rng)
    seams = ring(world, rng)
    for a, b in ((0, 2), (1, 3)):
        seams.append(seam(a, b, noisy(se3.inverse(world[a]) @ world[b], rng), inliers=300))
    bad = seams[wrong]
    off = bad.a_from_b @ se3.transform(np.eye(3), [12.0, 0.0, 0.0])
    seams[wrong] = seam(int(bad.a), int(bad.b), off, inliers=bad.quality["inliers"])
    graph, loops = SeamGraph(["0", "1", "2", "3"], seams).without_contradictions()
    assert [k for k, s in enumerate(graph.seams) if not s.accepted] == [wrong]
    assert "contradicts" in graph.seams[wrong].reason
    assert {loop.wrong for loop in loops} == {(wrong,)}
    chain = graph.chain(0)
    assert len(chain.scenes) == 4
    assert 0 < largest_seam_error_m(graph.balanced(chain), world, [s for s in graph.seams if s.accepted]) < 0.2


def test_a_diagonal_that_the_ring_contradicts_goes(rng: np.random.Generator) -> None:
    """Both triangles of a diagonal fail; only the ring round both says that it is the diagonal."""
    world = poses(rng)
    seams = ring(world, rng)
    off = se3.inverse(world[0]) @ world[2] @ se3.transform(np.eye(3), [5.0, 0.0, 0.0])
    graph, _ = SeamGraph(["0", "1", "2", "3"], [*seams, seam(0, 2, off)]).without_contradictions()
    assert [k for k, s in enumerate(graph.seams) if not s.accepted] == [4]
