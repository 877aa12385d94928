"""The ground's height from points."""

from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.geometry import se3
from mrasfm_engine.views.ground import estimate_ground

CAMERAS = np.array([[1.5, 0.5, 1.5], [1.5, -0.5, 1.6]])


def hill(xy: np.ndarray) -> np.ndarray:
    """A road that begins to climb by 6 % and bends over some metres."""
    result: np.ndarray = 0.03 * (xy[:, 0] - 15 + np.sqrt((xy[:, 0] - 15) ** 2 + 30))
    return result


def street(rng: np.random.Generator, *, on_road: int = 1500) -> np.ndarray:
    """Points of a road with kerbs of 12 cm, house fronts, and clutter above the ground."""
    road = np.column_stack([rng.uniform(-10, 45, on_road), rng.uniform(-4, 4, on_road)])
    beside = np.column_stack([rng.uniform(-10, 45, 1200), rng.choice([-1, 1], 1200) * rng.uniform(4.2, 8, 1200)])
    front = np.column_stack([rng.uniform(-10, 45, 2000), np.repeat([-8.5, 8.5], 1000)])
    ground = np.concatenate([road, beside, front])
    height = hill(ground) + rng.normal(0, 0.02, len(ground))
    height[len(road) :] += 0.12
    height[len(road) + len(beside) :] += rng.uniform(0, 6, 2000)
    clutter = np.column_stack([rng.uniform(-10, 45, 300), rng.uniform(-8, 8, 300)])
    cloud = np.column_stack([clutter, hill(clutter) + rng.uniform(0.3, 2.5, 300)])
    return np.concatenate([np.column_stack([ground, height]), cloud])


def drive_over(pitch_deg: float, height_m: float) -> np.ndarray:
    """Poses of a rig that is mounted with a pitch, its origin that far above the road."""
    x = np.arange(0.0, 30.0, 1.0)
    slope = np.gradient(hill(np.column_stack([x, 0 * x])), x)
    rotation = se3.exp_so3(np.column_stack([0 * x, np.radians(pitch_deg) - np.arctan(slope), 0 * x]))
    return se3.transform(rotation, np.column_stack([x, 0 * x, hill(np.column_stack([x, 0 * x])) + height_m]))


@pytest.mark.parametrize(("pitch_deg", "height_m"), [(0.0, 0.0), (1.5, 0.4), (-1.0, -0.5)])
def test_the_road_is_found_on_a_hill_between_kerbs(pitch_deg: float, height_m: float) -> None:
    rng = np.random.default_rng(1)
    ground = estimate_ground(street(rng), drive_over(pitch_deg, height_m), CAMERAS, rng=rng)
    assert ground is not None
    xy = np.column_stack([np.linspace(1, 28, 60), np.tile([-3.0, 0.0, 3.0], 20)])
    error = np.abs(ground.height_m(xy) - hill(xy))
    assert 1e-4 < np.median(error) < 0.015
    assert error.max() < 0.05


def test_without_a_ground_there_is_none() -> None:
    rng = np.random.default_rng(2)
    poses = drive_over(0.0, 0.0)
    cloud = np.column_stack([rng.uniform(-10, 45, 800), rng.uniform(-8, 8, 800), rng.uniform(-4, 8, 800)])
    assert estimate_ground(cloud, poses, CAMERAS, rng=rng) is None
    assert estimate_ground(street(rng)[:30], poses, CAMERAS, rng=rng) is None
    assert estimate_ground(np.zeros((0, 3)), poses, CAMERAS, rng=rng) is None
    high = street(rng)
    high[:, 2] += 5.0
    assert estimate_ground(high, poses, CAMERAS, rng=rng) is None
