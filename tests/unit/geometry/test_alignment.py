from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.alignment import align_rigid, align_similarity, rotation_between, scatter_eigenvalues


def random_transform(rng: np.random.Generator) -> np.ndarray:
    return se3.transform(se3.exp_so3(rng.normal(size=3)), rng.normal(size=3) * 100)


@pytest.mark.parametrize(("dimensions", "extent"), [(3, [30, 20, 5]), (2, [30, 20, 0])])
@pytest.mark.parametrize("seed", range(5))
def test_exact_points_give_the_transform_back(dimensions: int, extent: list[float], seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn, a_from_b = se3.exp_so3(rng.normal(size=3)), random_transform(rng)
    points_b = (rng.normal(size=(20, 3)) * extent) @ turn.T + 1000.0
    rigid = align_rigid(se3.apply(a_from_b, points_b), points_b)
    np.testing.assert_allclose(rigid.a_from_b[:3, :3], a_from_b[:3, :3], atol=1e-10)
    np.testing.assert_allclose(rigid.apply(points_b), se3.apply(a_from_b, points_b), atol=1e-9)
    assert rigid.scale == 1.0
    similar = align_similarity(se3.apply(a_from_b, 2.5 * points_b), points_b)
    assert similar.scale == pytest.approx(2.5, rel=1e-12)
    np.testing.assert_allclose(similar.a_from_b[:3, :3], a_from_b[:3, :3], atol=1e-10)
    assert rigid.dimensions == similar.dimensions == dimensions


def test_a_mirrored_set_is_aligned_by_a_rotation_not_a_reflection() -> None:
    points = np.random.default_rng(0).normal(size=(30, 3)) * [10, 5, 1]
    alignment = align_rigid(points * [1, 1, -1], points)
    assert np.linalg.det(alignment.a_from_b[:3, :3]) == pytest.approx(1.0)
    assert 0.5 < np.abs(alignment.apply(points) - points * [1, 1, -1]).max() < 10


@pytest.mark.parametrize("noise_m", [0.0, 1e-3])
def test_a_line_leaves_roll_at_the_smallest_rotation(noise_m: float) -> None:
    rng = np.random.default_rng(1)
    along = np.linspace(-50, 50, 40)[:, None]
    points_b = along * [1.0, 0, 0] + rng.normal(size=(40, 3)) * noise_m
    # The frames differ by a heading of 90 deg about z, and by a roll about the line that positions do not see.
    heading, roll = se3.exp_so3([0, 0, np.pi / 2]), se3.exp_so3([0.7, 0, 0])
    points_a = points_b @ (heading @ roll).T + [10, 20, 30]
    alignment = align_rigid(points_a, points_b)
    assert alignment.dimensions == 1
    assert float(se3.rotation_angle_deg(alignment.a_from_b[:3, :3].T @ heading)) < 0.01
    assert np.abs(alignment.apply(points_b) - points_a).max() <= 1e-9 + 5 * noise_m


def test_a_line_has_a_scale() -> None:
    points_b = np.linspace(0, 10, 5)[:, None] * [0.6, 0.8, 0.0]
    alignment = align_similarity(3.0 * points_b[:, [2, 0, 1]] + 7.0, points_b)
    assert alignment.scale == pytest.approx(3.0)
    assert alignment.dimensions == 1


def test_a_nearly_straight_line_may_decide_when_asked_to() -> None:
    rng = np.random.default_rng(2)
    points_b = np.linspace(-50, 50, 60)[:, None] * [1.0, 0, 0] + rng.normal(size=(60, 3)) * 0.01
    a_from_b = se3.transform(se3.exp_so3([0.7, 0, 0]), [1, 2, 3])
    points_a = se3.apply(a_from_b, points_b)
    assert align_rigid(points_a, points_b).dimensions == 1
    fitted = align_rigid(points_a, points_b, collinear_ratio=0.0)
    assert fitted.dimensions == 3
    np.testing.assert_allclose(fitted.apply(points_b), points_a, atol=1e-9)


@pytest.mark.parametrize("points", [np.ones((1, 3)), np.full((5, 3), 4.2e6)])
def test_coincident_points_are_only_shifted(points: np.ndarray) -> None:
    alignment = align_similarity(points + np.array([1.0, 2.0, 3.0]), points)
    assert (alignment.dimensions, alignment.scale) == (0, 1.0)
    np.testing.assert_allclose(alignment.a_from_b[:3, 3], [1, 2, 3], atol=1e-8)


def test_weights_take_an_outlier_out() -> None:
    rng = np.random.default_rng(3)
    points_b, a_from_b = rng.normal(size=(10, 3)) * 10, random_transform(rng)
    points_a = se3.apply(a_from_b, points_b)
    points_a[0] += 100.0
    weights = np.r_[0.0, np.ones(9)]
    np.testing.assert_allclose(align_rigid(points_a, points_b, weights=weights).a_from_b, a_from_b, atol=1e-9)
    assert np.abs(align_rigid(points_a, points_b).a_from_b - a_from_b).max() > 1.0


def test_noise_moves_the_result_as_little_as_it_should() -> None:
    rng = np.random.default_rng(4)
    points_b, a_from_b = rng.normal(size=(400, 3)) * 20, random_transform(rng)
    points_a = se3.apply(a_from_b, points_b) + rng.normal(size=(400, 3)) * 0.05
    residuals = align_rigid(points_a, points_b).apply(points_b) - points_a
    assert 0.045 < np.sqrt(np.mean(residuals**2)) < 0.055


@pytest.mark.parametrize(
    ("a", "b", "weights"),
    [
        (np.zeros((3, 3)), np.zeros((4, 3)), None),
        (np.zeros((3, 2)), np.zeros((3, 2)), None),
        (np.zeros((0, 3)), np.zeros((0, 3)), None),
        (np.full((3, 3), np.nan), np.zeros((3, 3)), None),
        (np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)),
        (np.zeros((3, 3)), np.zeros((3, 3)), np.array([1.0, -1.0, 1.0])),
    ],
)
def test_misuse_is_refused(a: np.ndarray, b: np.ndarray, weights: np.ndarray | None) -> None:
    with pytest.raises(ValueError, match="points"):
        align_rigid(a, b, weights=weights)


def test_rotation_between() -> None:
    rng = np.random.default_rng(5)
    for a, b in rng.normal(size=(20, 2, 3)):
        rotation = rotation_between(a, b)
        np.testing.assert_allclose(rotation @ b / np.linalg.norm(b), a / np.linalg.norm(a), atol=1e-12)
        cosine = a @ b / np.linalg.norm(a) / np.linalg.norm(b)
        assert float(se3.rotation_angle_deg(rotation)) == pytest.approx(np.degrees(np.arccos(cosine)))
    np.testing.assert_allclose(rotation_between([1, 0, 0], [1, 0, 0]), np.eye(3))


@pytest.mark.parametrize("direction", [[1.0, 0, 0], [0.6, -0.8, 0], [0, 0, 1.0]])
def test_opposite_directions_keep_up_where_it_can_be_kept(direction: list[float]) -> None:
    rotation = rotation_between(direction, -np.array(direction))
    np.testing.assert_allclose(rotation @ -np.array(direction), direction, atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    if direction[2] == 0:
        np.testing.assert_allclose(rotation @ [0, 0, 1], [0, 0, 1], atol=1e-12)


def test_scatter_eigenvalues() -> None:
    points = np.array([[-3.0, 0, 0], [3, 0, 0], [0, -2, 0], [0, 2, 0]]) + 5.0
    np.testing.assert_allclose(scatter_eigenvalues(points), [4.5, 2.0, 0.0], atol=1e-12)
