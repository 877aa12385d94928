from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.mapping.loop_closure import (
    DriftModel,
    Revisit,
    close_loops,
    find_revisits,
    split_pairs,
    supported,
)
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.pose_graph import Edges, _linearise, optimise_pose_graph
from mrasfm_engine.scene.scene import PairMatches
from tests.helpers.simulated_drive import (
    SimulatedDrive,
    enlarged,
    make_model,
    make_simulated_drive,
    true_matches,
    with_true_poses,
)


def ring(units: int = 40) -> np.ndarray:
    """Once round a circle of 20 m radius, and back at the start."""
    angle = np.linspace(0, 2 * np.pi, units)
    position = 20.0 * np.stack([np.sin(angle), 1 - np.cos(angle), 0 * angle], 1)
    return se3.transform(se3.exp_so3(angle[:, None] * [0.0, 0.0, 1.0]), position)


def drifted(true: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The same way with every step a little off."""
    steps = se3.inverse(true[:-1]) @ true[1:]
    n = len(steps)
    noise = se3.transform(se3.exp_so3(rng.normal(size=(n, 3)) * 0.002 + [0, 0, 0.002]), rng.normal(size=(n, 3)) * 0.005)
    poses = [true[0]]
    for step in steps @ noise:
        poses.append(poses[-1] @ step)
    return np.stack(poses)


def edges_of(poses: np.ndarray, loops: list[tuple[int, int, np.ndarray]]) -> Edges:
    n = len(poses) - 1
    chain = np.stack([np.arange(n), np.arange(1, n + 1)], 1)
    measured = [se3.inverse(poses[:-1]) @ poses[1:], *[m[None] for _, _, m in loops]]
    return Edges(
        units=np.concatenate([chain, np.array([(a, b) for a, b, _ in loops], dtype=np.int64).reshape(-1, 2)]),
        a_from_b=np.concatenate(measured),
        sigma_rotation_rad=np.full(n + len(loops), 0.002),
        sigma_translation_m=np.full(n + len(loops), 0.01),
        robust=np.arange(n + len(loops)) >= n,
    )


def between(poses: np.ndarray, a: int, b: int) -> np.ndarray:
    result: np.ndarray = se3.inverse(poses[a]) @ poses[b]
    return result


@pytest.mark.parametrize("seed", range(3))
def test_closing_a_loop_spreads_the_drift(seed: int) -> None:
    true = ring()
    start = drifted(true, np.random.default_rng(seed))
    before = np.linalg.norm(start[:, :3, 3] - true[:, :3, 3], axis=1)
    edges = edges_of(
        start, [(0, 39, between(true, 0, 39)), (1, 38, between(true, 1, 38)), (0, 38, between(true, 0, 38))]
    )
    closed = optimise_pose_graph(start, edges)
    after = np.linalg.norm(closed[:, :3, 3] - true[:, :3, 3], axis=1)
    assert before.max() > 0.8
    assert 0.01 < after.max() < 0.5 * before.max()
    assert after[-1] < 0.1
    np.testing.assert_allclose(closed[0], start[0], atol=1e-12)
    steps = np.linalg.norm(closed[1:, :3, 3] - closed[:-1, :3, 3], axis=1)
    np.testing.assert_allclose(steps, np.linalg.norm(start[1:, :3, 3] - start[:-1, :3, 3], axis=1), atol=0.02)


def test_a_graph_that_agrees_does_not_move() -> None:
    true = ring()
    closed = optimise_pose_graph(true, edges_of(true, [(0, 39, between(true, 0, 39))]))
    np.testing.assert_allclose(closed, true, atol=1e-9)


def test_one_wrong_loop_among_right_ones_is_outvoted() -> None:
    true = ring()
    start = drifted(true, np.random.default_rng(0))
    right = [(a, b, between(true, a, b)) for a in (0, 1, 2) for b in (37, 38, 39)]
    wrong = (5, 33, se3.transform(np.eye(3), [8.0, 5.0, 0.0]))
    closed = optimise_pose_graph(start, edges_of(start, [*right, wrong]))
    clean = optimise_pose_graph(start, edges_of(start, right))
    assert np.linalg.norm(closed[:, :3, 3] - clean[:, :3, 3], axis=1).max() < 0.1


def test_the_pose_graphs_jacobians_agree_with_differences() -> None:
    rng = np.random.default_rng(1)
    poses = ring(6)
    edges = edges_of(drifted(poses, rng), [])  # residuals of some millirad, where the derivatives hold
    rotation, position = poses[:, :3, :3], poses[:, :3, 3]
    _, jacobian_a, jacobian_b = _linearise(rotation, position, edges)
    for side, jacobian in ((0, jacobian_a), (1, jacobian_b)):
        for k in range(6):
            values = []
            for sign in (1.0, -1.0):
                step = np.zeros(6)
                step[k] = sign * 1e-6
                for edge, unit in enumerate(edges.units[:, side]):
                    r, p = rotation.copy(), position.copy()
                    r[unit], p[unit] = se3.exp_so3(step[:3]) @ r[unit], p[unit] + step[3:]
                    values.append(_linearise(r, p, edges)[0][edge])
            numeric = (np.array(values[:5]) - np.array(values[5:])) / 2e-6
            np.testing.assert_allclose(jacobian[:, :, k], numeric, atol=0.01)


DRIFT = se3.transform(se3.exp_so3(np.radians([0.1, -0.2, 0.5])), [0.3, -0.25, 0.1])


def marked(pairs: list[PairMatches], unit: np.ndarray) -> list[PairMatches]:
    """The pairs, those of units more than four apart as revisits."""
    return [replace(p, is_revisit=bool(unit[p.image_b] - unit[p.image_a] > 4)) for p in pairs]


def drifted_model(drift: np.ndarray = DRIFT, *, factor: int = 1) -> tuple[SimulatedDrive, Mapper, list[PairMatches]]:
    """A drive whose second half went off by a drift, and the matches across a larger gap."""
    simulated = enlarged(make_simulated_drive(units=16, cameras=2, points=1200, spacing_m=0.8), factor)
    unit = np.array([i.unit for i in simulated.drive.images])
    near, far = split_pairs(marked(true_matches(simulated, window=12), unit))
    mapper = with_true_poses(make_model(simulated, near), simulated, range(16))
    for late in range(8, 16):
        mapper.set_pose(late, drift @ simulated.world_from_rig[late])
    return simulated, mapper, [p for p in far if unit[p.image_a] < 4 and unit[p.image_b] >= 8]


def test_pairs_are_split_by_what_matching_took_for_revisits() -> None:
    simulated = make_simulated_drive(units=8, cameras=2, points=500)
    unit = np.array([i.unit for i in simulated.drive.images])
    pairs = marked(true_matches(simulated, window=7), unit)
    near, far = split_pairs(pairs)
    assert len(near) + len(far) == len(pairs)
    assert {int(unit[p.image_b] - unit[p.image_a]) for p in near} == {0, 1, 2, 3, 4}
    assert {int(unit[p.image_b] - unit[p.image_a]) for p in far} == {5, 6, 7}


def test_revisits_tell_the_drift_and_close_it() -> None:
    simulated, mapper, far = drifted_model()
    revisits, tried = find_revisits(mapper, far)
    assert tried >= len(revisits) >= 3
    for revisit in revisits:
        # The drift found takes the unit back to where it is.
        back = revisit.drift @ DRIFT @ simulated.world_from_rig[revisit.later]
        assert 1e-5 < np.linalg.norm(back[:3, 3] - simulated.world_from_rig[revisit.later, :3, 3]) < 0.1

    def error_of_last() -> float:
        relative = between(mapper.state.world_from_rig, 0, 15)
        return float(np.linalg.norm(relative[:3, 3] - between(simulated.world_from_rig, 0, 15)[:3, 3]))

    before = error_of_last()
    moved_m = close_loops(mapper, revisits)
    assert 0.3 < before < 0.6
    assert 0.001 < error_of_last() < 0.3 * before
    assert 0.2 < moved_m < 0.7


def test_alike_places_are_not_believed() -> None:
    """Matches between places that only look alike: each pair of units tells another drift, or none."""
    _, mapper, far = drifted_model()
    rng = np.random.default_rng(0)
    wrong = [
        PairMatches(
            image_a=p.image_a,
            image_b=p.image_b,
            matches=np.stack([p.matches[:, 0], rng.permutation(p.matches[:, 1])], 1),
            inliers=p.inliers,
        )
        for p in far
        if mapper.image_unit[p.image_a] < 2 and mapper.image_unit[p.image_b] < 11
    ]
    revisits, tried = find_revisits(mapper, wrong)
    assert 4 <= tried <= 6
    assert revisits == []


@pytest.mark.parametrize("factor", [1, 2])
def test_drift_that_calibration_and_way_cannot_explain_is_not_believed(factor: int) -> None:
    for size, believed in ((1.0, True), (6.0, False)):
        drift = se3.transform(se3.exp_so3(size * se3.log_so3(DRIFT[:3, :3])), size * DRIFT[:3, 3])
        _, mapper, far = drifted_model(drift, factor=factor)
        revisits, tried = find_revisits(mapper, far)
        assert tried > 20
        assert (len(revisits) > 0.9 * tried) if believed else not revisits


def straight_model(spacing_m: float, length_m: float = 100.0, depth_m: float = 10.0) -> DriftModel:
    travelled_m = np.arange(0.0, length_m + 1e-9, spacing_m)
    return DriftModel(
        travelled_m=travelled_m,
        position_m=travelled_m[:, None] * [1.0, 0.0, 0.0],
        depth_m=depth_m,
        sigma_rotation_rad=0.001,
        sigma_translation_m=0.01,
    )


def test_drift_is_uncertain_by_the_metres_and_not_by_the_units() -> None:
    sigmas = []
    for spacing_m in (0.5, 4.0):
        model = straight_model(spacing_m)
        last = len(model.travelled_m) - 1
        covariance = model.covariance(0, last)
        sigmas.append(np.sqrt(np.diagonal(covariance)[[0, 3]]))
        half = np.sqrt(np.diagonal(model.covariance(last // 2, last))[[0, 3]])
        assert half[0] == pytest.approx(6 / 11 * sigmas[-1][0], rel=0.04)
        assert 0.2 < half[1] / sigmas[-1][1] < 0.5
    np.testing.assert_allclose(sigmas[0], sigmas[1], rtol=0.03)
    assert sigmas[0][0] == pytest.approx(11 * 0.001)
    # 11 mrad over an arm of 58 m in the mean square; scale off by 2.2 %, eleven times 1 cm.
    assert sigmas[0][1] == pytest.approx(np.sqrt(0.635**2 + 2.211**2 + 0.11**2), rel=0.02)
    # Where points are farther away, the same ones are seen for longer.
    assert np.diagonal(straight_model(0.5, depth_m=20.0).covariance(0, 200))[0] == pytest.approx(0.006**2)


def test_a_vehicle_that_stands_leaves_steps_certain_but_not_without_error() -> None:
    sigmas = straight_model(1.0).step_sigmas(np.array([0.0, 10.0, 40.0]))
    np.testing.assert_allclose(sigmas[1:], [[0.001, 0.01], [0.002, 0.02]])
    assert (sigmas[0] > 0).all()
    assert (sigmas[0] < 0.1 * sigmas[1]).all()


def revisit(model: DriftModel, earlier: int, later: int, *, off: float) -> Revisit:
    """One whose drift is off from none by so many sigmas of a registration (of 0.1 deg, 2 cm)."""
    sigma = np.repeat([np.radians(0.1), 0.02], 3)
    at_m = model.position_m[later]
    about = se3.transform(se3.exp_so3([0.0, 0.0, off * sigma[0]]), np.zeros(3))
    drift = se3.transform(about[:3, :3], at_m - about[:3, :3] @ at_m)
    return Revisit(
        earlier=earlier,
        later=later,
        world_from_rig=drift @ se3.transform(np.eye(3), at_m),
        drift=drift,
        covariance=np.diag(sigma**2),
    )


@pytest.mark.parametrize("spacing_m", [0.5, 2.0])
def test_neighbours_support_one_another_within_a_viewing_depth(spacing_m: float) -> None:
    model = straight_model(spacing_m)

    def at(metres: float) -> int:
        return round(metres / spacing_m)

    for apart_m, believed in ((8.0, True), (12.0, False)):
        pairs = [(at(k * apart_m), at(60.0 + k * apart_m)) for k in range(-1, 2)]
        shifted = [(a + at(12.0), b) for a, b in pairs]
        assert len(supported([revisit(model, a, b, off=0.0) for a, b in shifted], model)) == (1 if believed else 0)


def test_neighbours_support_one_another_if_their_drifts_differ_by_chance() -> None:
    model = straight_model(1.0)
    for off, believed in ((2.0, 4), (12.0, 3)):
        revisits = [revisit(model, k, 60 + k, off=off if k == 3 else 0.0) for k in range(4)]
        assert len(supported(revisits, model)) == believed
    assert supported([revisit(model, k, 60 + k, off=0.0) for k in range(2)], model) == []
