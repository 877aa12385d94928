"""What loops of seams say: which of them is wrong, and where they leave it open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest

from mrasfm_engine.aggregation import loops, seam
from mrasfm_engine.aggregation.loops import Loop, ScenePaths, off_positions
from mrasfm_engine.aggregation.map_report import loop_findings
from mrasfm_engine.geometry import se3
from tests.helpers import simulated_seams
from tests.helpers.simulated_seams import SimulatedSeams, ring, simulate, torus, town

SIDE_M = 30.0  # of scenes: so far they know how they lie to decimetres round a ring of 20
SEEDS = range(2)  # acceptance line 24 takes a hundred


def refused(case: SimulatedSeams) -> set[int]:
    graph, _ = case.graph().without_contradictions()
    return {k for k, seam in enumerate(graph.seams) if not seam.accepted}


@pytest.mark.parametrize("seed", SEEDS)
def test_right_seams_are_kept(seed: int) -> None:
    rng = np.random.default_rng(seed)
    assert refused(simulate(*ring(20, SIDE_M), rng)) == set()
    assert refused(simulate(*torus(), rng)) == set()


@pytest.mark.parametrize("seed", SEEDS)
def test_a_ring_does_not_say_which_seam_is_wrong(seed: int) -> None:
    rng = np.random.default_rng(seed)
    case = simulate(*ring(20, SIDE_M), rng, sigma_position_m=20.0).with_wrong({seed: rng.uniform(2, 11)}, rng)
    graph, found = case.graph().without_contradictions()
    assert not any(seam.accepted for seam in graph.seams)
    assert "nothing says which" in graph.seams[3].reason
    (loop,) = found
    assert sorted(loop.scenes) == list(range(20))
    assert loop.wrong == ()
    assert loop.sigmas > loops.GATE_SIGMAS
    assert len(graph.components()) == 20


@pytest.mark.parametrize("seed", SEEDS)
def test_positions_single_out_the_wrong_seam_of_a_ring(seed: int) -> None:
    rng = np.random.default_rng(seed)
    case = simulate(*ring(20, SIDE_M), rng, sigma_position_m=0.1).with_wrong({seed: rng.uniform(2, 11)}, rng)
    graph, found = case.graph().without_contradictions()
    assert [k for k, seam in enumerate(graph.seams) if not seam.accepted] == [seed]
    assert "positions" in graph.seams[seed].reason
    assert [loop.wrong for loop in found] == [(seed,)]
    assert len(graph.components()) == 1


@pytest.mark.parametrize("seed", SEEDS)
def test_two_loops_single_out_the_wrong_seam(seed: int) -> None:
    rng = np.random.default_rng(seed)
    case = simulate(*torus(), rng, sigma_position_m=20.0)
    wrong = int(rng.integers(len(case.seams)))
    assert refused(case.with_wrong({wrong: rng.uniform(2, 11)}, rng)) == {wrong}


@pytest.mark.parametrize("seed", SEEDS)
def test_many_wrong_seams_are_found_on_loops_without_one_another(seed: int) -> None:
    rng = np.random.default_rng(seed)
    case = simulate(*town(8, 8, 200), rng, sigma_position_m=20.0)
    wrong = {int(k): rng.uniform(2, 11) for k in rng.choice(len(case.seams), 10, replace=False)}
    found = refused(case.with_wrong(wrong, rng))
    assert set(wrong) <= found
    assert len(found) <= len(wrong) + 3  # of scenes with two seams, one of them wrong, nothing says which


def test_a_loop_that_cannot_tell_the_error_confirms_nothing() -> None:
    """A scene of unknown scale closes a loop with a wrong seam; another loop, which is sharp, does not close."""
    middles = np.array([[0.0, 0, 0], [60, 0, 0], [30, 300, 0], [30, -20, 0]])
    case = simulate(middles, [(0, 1), (0, 2), (1, 2), (0, 3), (1, 3)], np.random.default_rng(0), sigma_position_m=20.0)
    case.paths[2] = replace(case.paths[2], sigma_scale=0.2)
    shift = se3.transform(np.eye(3), [0.0, 8.0, 0.0])
    case.seams[0] = replace(case.seams[0], a_from_b=shift @ case.seams[0].a_from_b)
    graph, found = case.graph().without_contradictions()
    assert not graph.seams[0].accepted
    assert found


def test_usual_misclosures_say_how_much_scenes_are_bent(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scenes that drift three times as much as expected lose hardly a seam."""
    monkeypatch.setattr(simulated_seams, "DRIFT_RAD_PER_SQRT_M", 3.0 * loops.DRIFT_RAD_PER_SQRT_M)
    lost = [len(refused(simulate(*torus(), np.random.default_rng(seed), sigma_position_m=20.0))) for seed in SEEDS]
    assert sum(lost) <= 0.01 * len(SEEDS) * 40


def test_findings_on_loops_name_seams_and_are_few() -> None:
    loop = Loop(seams=(0, 1, 2), scenes=(0, 1, 2), shift_m=3.0, turn_deg=0.1, sigmas=9.0, sigma_m=0.3, sigma_deg=0.1)
    names, ends = ["a", "b", "c"], [("a", "b"), ("b", "c"), ("a", "c")]
    wrong, left_open = replace(loop, wrong=(1,), refused=(1,)), replace(loop, refused=(0, 1, 2))
    found = loop_findings([wrong, left_open, loop], names, ends)
    assert [finding.code for finding in found] == ["seam-contradicted", "loop-leaves-open", "loop-does-not-close"]
    assert "a - b - c - a do not close, by 3.00 m" in found[0].what
    assert found[0].what.endswith("not used: b - c")
    assert found[1].what.endswith("not used: a - b, b - c, a - c")
    assert found[2].what.endswith("all are used")
    many = loop_findings([replace(wrong, seams=(k,)) for k in range(20)], names, ends)
    assert len(many) == 6
    assert "15 more loops" in many[-1].what


def test_the_cost_grows_with_the_seams() -> None:
    """Loops that are tested, whose closing is what takes time: at most 2.3 times as many for twice the seams."""
    counts = []
    for rows in (6, 12):
        rng = np.random.default_rng(rows)
        case = simulate(*town(rows, 12, 3 * rows * 12), rng, sigma_position_m=20.0)
        wrong = {int(k): 5.0 for k in rng.choice(len(case.seams), rows // 2, replace=False)}
        case, tested = case.with_wrong(wrong, rng), [0]
        closing = loops.LoopConsistency._closing

        def counted(
            self: loops.LoopConsistency, path: list[int], closing: object = closing, tested: list[int] = tested
        ) -> object:
            tested[0] += 1
            return closing(self, path)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(loops.LoopConsistency, "_closing", counted)
            assert set(wrong) <= refused(case)
        counts.append(tested[0])
    assert counts[1] <= 2.3 * counts[0]


@pytest.mark.slow
def test_misclosures_are_as_large_as_their_covariance_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of right loops: chi-squared, with six degrees of freedom."""
    monkeypatch.setattr(seam, "LEAST_SIGMA_RAD", 0.0)
    monkeypatch.setattr(seam, "LEAST_SIGMA_M", 0.0)
    squared = []
    for seed in range(150):
        case = simulate(*ring(8, SIDE_M), np.random.default_rng(seed))
        _, off, covariance = case.graph().consistency()._closing(list(range(8)))
        squared.append(off @ np.linalg.solve(covariance, off))
    assert kstest(squared, "chi2", args=(6,)).pvalue > 1e-3
    # Seams without their scenes' bends would not be.
    straight = replace(case, paths=[ScenePaths()] * 8)
    monkeypatch.setattr(loops, "DRIFT_RAD_PER_SQRT_M", 0.0)
    assert np.trace(straight.graph().consistency()._closing(list(range(8)))[2]) < 0.7 * np.trace(covariance)


def test_a_path_turns_what_comes_after_it() -> None:
    """The covariance of a straight path is that of a random walk of its heading."""
    path = ScenePaths(trajectory_m=np.linspace([0, 0, 0], [100.0, 0, 0], 51), sigma_scale=1e-3)
    found = path.covariance(np.zeros(3), np.array([100.0, 0, 0]))
    variance = loops.DRIFT_RAD_PER_SQRT_M**2 * 100.0
    assert np.allclose(np.diag(found)[:3], variance)
    assert np.allclose(np.diag(found)[3:], [0.1**2, variance * 100.0**2 / 3, variance * 100.0**2 / 3], rtol=1e-3)
    # To turn left on the path is to end left of it.
    assert found[2, 4] == pytest.approx(0.5 * variance * 100.0, rel=1e-3)
    back = path.covariance(np.array([100.0, 0, 0]), np.zeros(3))
    assert back[2, 4] == pytest.approx(-found[2, 4], rel=1e-3)
    # Without a trajectory it is straight.
    assert np.allclose(ScenePaths(sigma_scale=1e-3).covariance(np.zeros(3), np.array([100.0, 0, 0])), found, rtol=0.02)


def test_positions_that_are_not_known_say_nothing() -> None:
    case = simulate(*ring(4), np.random.default_rng(0))
    unknown, known = np.full((5, 3), np.nan), np.full((5, 3), 0.01)
    assert off_positions(case.seams[0], unknown, known) == 0.0
    assert off_positions(case.seams[0], known, np.zeros((0, 3))) == 0.0
    assert off_positions(case.seams[0], known, known) > loops.GATE_SIGMAS  # receivers that are a metre off
