from __future__ import annotations

import numpy as np

from mrasfm_engine.triangulation.uncertainty import point_covariances

FOCAL_PX, SIGMA_PX = 800.0, 0.7
ORIGINS = np.array([[0.0, 0.3, 1.5], [0.0, -0.3, 1.5], [1.1, 0.3, 1.5], [1.1, -0.3, 1.5]])


def triangulated(point: np.ndarray, rng: np.random.Generator, trials: int = 4000) -> np.ndarray:
    """The same point from noisy rays, by linear least squares (trials, 3)."""
    ray = point - ORIGINS
    depth = np.linalg.norm(ray, axis=1)
    noisy = ray / depth[:, None] + rng.normal(0, SIGMA_PX / FOCAL_PX, (trials, len(ORIGINS), 3))
    noisy /= np.linalg.norm(noisy, axis=2, keepdims=True)
    across = (np.eye(3) - noisy[..., :, None] * noisy[..., None, :]) / depth[:, None, None] ** 2
    right = (across @ ORIGINS[:, :, None])[..., 0].sum(1)
    return np.linalg.solve(across.sum(1), right[..., None])[..., 0]


def test_covariance_is_that_of_repeated_triangulation() -> None:
    rng = np.random.default_rng(0)
    points = np.array([[6.0, 0.5, 0.0], [14.0, -1.0, 0.0]])
    count = len(ORIGINS)
    covariance = point_covariances(
        points,
        np.repeat(np.arange(2), count).astype(np.int64),
        np.tile(ORIGINS, (2, 1)),
        np.full(2 * count, FOCAL_PX),
        sigma_px=SIGMA_PX,
    )
    for point, expected in zip(points, covariance, strict=True):
        seen = np.cov(triangulated(point, rng).T)
        ratio = np.sqrt(np.diag(seen) / np.diag(expected))
        assert (np.abs(ratio - 1) < 0.1).all()
        assert (ratio != 1).all()
    # Depth is the worst, and grows with its square.
    assert covariance[0, 0, 0] > covariance[0, 2, 2]
    assert 3.0 < np.sqrt(covariance[1, 0, 0] / covariance[0, 0, 0]) < 8.0


def test_parallel_rays_are_uncertain_and_finite() -> None:
    covariance = point_covariances(
        np.array([[10.0, 0.0, 0.0]]),
        np.zeros(2, dtype=np.int64),
        np.zeros((2, 3)),
        np.full(2, FOCAL_PX),
        sigma_px=SIGMA_PX,
    )
    assert np.isfinite(covariance).all()
    assert np.sqrt(covariance[0, 0, 0]) > 50.0
