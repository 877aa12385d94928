"""Line 24: which seam of a graph is wrong, for simulated scenes that are bent and share places."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mrasfm_engine.aggregation.graph import SeamGraph
from mrasfm_engine.geometry import se3
from tests.benchmarks.table import Figure, exactly, reference_loop_s
from tests.helpers.simulated_seams import Ends, SimulatedSeams, ring, simulate, torus, town

SEEDS = range(100)
SCENES, RING_SIDE_M = 20, 30.0
WRONG_M, SLIGHTLY_WRONG_M = (2.0, 11.0), (0.1, 2.0)
POOR_M, GOOD_M = 20.0, 0.1  # receivers that do not tell a wrong seam, and that do
TOWN, TOWN_SEAMS, TOWN_WRONG = (25, 40), 3000, 10


def seam_graphs(data: Path, work: Path) -> Iterator[Figure]:
    """Line 24a and 24b."""
    yield from _ring()
    yield from _two_loops()
    yield from _town()


def _ring() -> Iterator[Figure]:
    where = ring(SCENES, RING_SIDE_M)
    title = f"ring of {SCENES} scenes"
    kept = sum(not _refused(_case(where, seed, POOR_M)[0].graph())[0] for seed in SEEDS)
    yield exactly("24a", f"{title}, none wrong: all used, of {len(SEEDS)}", kept, len(SEEDS))
    unused = named = 0
    for seed in SEEDS:
        case, wrong = _case(where, seed, POOR_M, wrong_m=WRONG_M)
        refused, loops = _refused(case.graph())
        unused += wrong in refused
        named += any(wrong in loop for loop in loops)
    yield exactly("24a", f"{title}, one wrong: it is not used, of {len(SEEDS)}", unused, len(SEEDS))
    yield exactly("24a", f"{title}, one wrong: the loop is named, of {len(SEEDS)}", named, len(SEEDS))
    alone = 0
    for seed in SEEDS:
        case, wrong = _case(where, seed, GOOD_M, wrong_m=WRONG_M)
        alone += _refused(case.graph())[0] == {wrong}
    yield exactly("24a", f"{title}, receivers of {GOOD_M} m: the wrong one alone, of {len(SEEDS)}", alone, len(SEEDS))


def _two_loops() -> Iterator[Figure]:
    where = torus()
    title = f"{SCENES} scenes, every seam on two loops"
    kept = sum(not _refused(_case(where, seed, POOR_M)[0].graph())[0] for seed in SEEDS)
    yield exactly("24a", f"{title}, none wrong: all used, of {len(SEEDS)}", kept, len(SEEDS))
    for smallest_m, largest_m in (WRONG_M, SLIGHTLY_WRONG_M):
        found, lost, moved_m = 0, 0, []
        for seed in SEEDS:
            case, wrong = _case(where, seed, POOR_M, wrong_m=(smallest_m, largest_m))
            refused, _ = _refused(case.graph())
            found += wrong in refused
            lost += len(refused - {wrong})
            moved_m.append(_moved_by_wrong_m(case, wrong))
        what = f"{title}, one wrong by {smallest_m:g} to {largest_m:g} m"
        if largest_m > WRONG_M[0]:
            yield exactly("24a", f"{what}: it is refused, of {len(SEEDS)}", found, len(SEEDS))
        else:
            yield Figure(line="24a", what=f"{what}: it is refused, of {len(SEEDS)}", value=found)
            yield Figure(line="24a", what=f"{what}: farthest that it moves a scene", value=max(moved_m), unit="m")
        share = 1.0 - lost / (len(SEEDS) * (len(where[1]) - 1))
        yield Figure(line="24a", what=f"{what}: right ones that are used", value=share, above=0.99, most=1.0)


def _town() -> Iterator[Figure]:
    rng = np.random.default_rng(0)
    case = simulate(*town(*TOWN, TOWN_SEAMS), rng, sigma_position_m=POOR_M)
    wrong = {int(k): rng.uniform(*WRONG_M) for k in rng.choice(len(case.seams), TOWN_WRONG, replace=False)}
    graph = case.with_wrong(wrong, rng).graph()
    started_s = time.perf_counter()
    refused, _ = _refused(graph)
    seconds = time.perf_counter() - started_s
    title = f"{TOWN[0] * TOWN[1]} scenes, {len(case.seams)} seams, {TOWN_WRONG} wrong"
    yield exactly("24b", f"{title}: refused", len(refused & set(wrong)), TOWN_WRONG)
    share = 1.0 - len(refused - set(wrong)) / (len(case.seams) - TOWN_WRONG)
    yield Figure(line="24b", what=f"{title}: right ones that are used", value=share, above=0.99, most=1.0)
    yield Figure(line="24b", what=f"{title}: time", value=seconds, unit="s", most=10.0)
    yield Figure(line="24b", what="a loop of ten million additions beside it", value=reference_loop_s(), unit="s")


def _case(
    where: tuple[np.ndarray, Ends], seed: int, sigma_position_m: float, *, wrong_m: tuple[float, float] | None = None
) -> tuple[SimulatedSeams, int]:
    """Simulated seams, and one of them, which is wrong where asked for."""
    rng = np.random.default_rng(seed)
    case = simulate(*where, rng, sigma_position_m=sigma_position_m)
    which = int(rng.integers(len(case.seams)))
    return (case if wrong_m is None else case.with_wrong({which: rng.uniform(*wrong_m)}, rng)), which


def _refused(graph: SeamGraph) -> tuple[set[int], list[set[int]]]:
    """Seams that are not used, and those of every loop that is named."""
    judged, loops = graph.without_contradictions()
    return {k for k, seam in enumerate(judged.seams) if not seam.accepted}, [set(loop.seams) for loop in loops]


def _moved_by_wrong_m(case: SimulatedSeams, wrong: int) -> float:
    """How far a wrong seam, where it is used, moves any scene against where the others alone put it."""
    judged, _ = case.graph().without_contradictions()
    others = case.without(wrong).graph()
    found, expected = (graph.balanced(graph.chain(0)) for graph in (judged, others))
    away = [np.linalg.norm(se3.inverse(expected[k])[:3, 3] - se3.inverse(found[k])[:3, 3]) for k in found]
    return float(max(away))
