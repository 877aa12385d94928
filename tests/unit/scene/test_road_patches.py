from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.scene.road import RoadSurface, Thickness
from mrasfm_engine.scene.road_relief import Relief


def ramp_surface() -> RoadSurface:
    """Level to x = 0, then up by 10 %."""
    along = np.arange(-24.0, 25.0, 6.0)
    slope = np.where(along > 0, 0.1, 0.0)
    normal = np.column_stack([-slope, np.zeros(len(along)), np.ones(len(along))])
    return RoadSurface(
        axes=np.eye(3),
        centre_m=np.column_stack([along, np.zeros(len(along)), slope * along]),
        normal=normal / np.linalg.norm(normal, axis=1, keepdims=True),
        radius_m=8.0,
    )


def test_distances_are_along_the_normal_and_have_a_sign() -> None:
    points = np.array([[-20.0, 1.0, 0.3], [-20.0, 1.0, -0.2], [20.0, 0.0, 2.0 + 0.3]])
    distance, patch = ramp_surface().locate(points)
    assert distance == pytest.approx([0.3, -0.2, 0.3 / np.hypot(1, 0.1)], abs=1e-9)
    assert patch.tolist() == [1, 1, 7]


def test_the_surface_is_continuous() -> None:
    along = np.arange(-20.0, 20.0, 0.01)
    distance, _ = ramp_surface().locate(np.column_stack([along, np.zeros((len(along), 2))]))
    assert np.isfinite(distance).all()
    assert 0 < np.abs(np.diff(distance)).max() < 0.003  # the slope of 10 % itself makes 1 mm


def test_beyond_the_patches() -> None:
    surface = ramp_surface()
    points = np.array([[40.0, 0.0, 4.5]])
    distance, patch = surface.locate(points)
    assert np.isnan(distance).all()
    assert patch.tolist() == [-1]
    offset, beyond = surface.beyond(points)
    assert offset == pytest.approx([0.5 / np.hypot(1, 0.1)])
    assert beyond == pytest.approx([8.0])


def test_roads_above_one_another() -> None:
    surface = RoadSurface(
        axes=np.eye(3),
        centre_m=np.array([[0.0, 0, 0], [1.0, 0, 5.0]]),
        normal=np.tile([0.0, 0, 1], (2, 1)),
        radius_m=8.0,
    )
    distance, patch = surface.locate(np.array([[0.5, 0.0, 0.1], [0.5, 0.0, 4.8]]))
    assert distance == pytest.approx([0.1, -0.2])
    assert patch.tolist() == [0, 1]


def test_the_relief_lies_on_the_patches_and_fades_out() -> None:
    """On the ramp, 10 cm high and level along it; where no node is near, there are the patches alone."""
    node = np.array([[10.0, 0.0, 1.0], [11.0, 0.0, 1.1], [10.5, 0.8, 1.05]])
    relief = Relief(node_m=node, height_m=np.full(3, 0.1), slope=np.zeros((3, 2)), sigma_m=np.full(3, 0.01))
    surface = replace(ramp_surface(), relief=relief)
    x = np.linspace(10, 18, 81)
    points = np.column_stack([x, 0.2 + 0 * x, 0.1 * x])
    offset = ramp_surface().locate(points)[0] - surface.locate(points)[0]
    assert offset[5] == pytest.approx(0.1, rel=0.05)
    assert np.abs(offset[x > 13.0]).max() == 0.0
    assert 0 < np.abs(np.diff(offset)).max() < 0.03
    height, sigma = relief.at(surface.feet(points, surface.locate_on_patches(points)[0]))
    assert sigma[0] == pytest.approx(0.01)
    assert np.isnan(sigma[-1])
    assert height[-1] == 0.0


def test_a_relief_belongs_to_its_own_level() -> None:
    relief = Relief(
        node_m=np.array([[0.0, 0.0, 0.0]]), height_m=np.array([0.1]), slope=np.zeros((1, 2)), sigma_m=np.array([0.01])
    )
    height, _ = relief.at(np.array([[0.0, 0.0, 0.2], [0.0, 0.0, 5.0]]))
    assert height == pytest.approx([0.1 / 1.05, 0.0])


def test_thickness() -> None:
    distance = np.random.default_rng(0).normal(0.5, 0.02, 20_000)
    thickness = Thickness.from_distances(np.append(distance, np.nan))
    assert 0.0 < abs(thickness.range90_m - 2 * 1.645 * 0.02) < 0.002
    assert 0.0 < abs(thickness.spread_m - 0.02) < 0.001
    assert np.isnan(Thickness.from_distances(np.full(3, np.nan)).range90_m)
