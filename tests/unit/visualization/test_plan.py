"""The order in which views are painted, and the numbers of the places that they are taken from."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.visualization.plan import (
    SAME_PLACE_M,
    VIEW_STEP_M,
    first_visits,
    in_order_of_the_path,
    place_numbers,
)
from mrasfm_engine.visualization.road_candidates import PLACE_M
from tests.helpers.export_example import make_scene


def scene_along(x_m: np.ndarray) -> Scene:
    """The example's units at other places, all of them registered."""
    scene = make_scene()
    scene.unit_registered[:] = scene.image_registered[:] = True
    scene.world_from_rig[:] = np.eye(4)
    scene.world_from_rig[:, 0, 3] = x_m[: len(scene.world_from_rig)]
    return scene


def test_images_of_one_camera_from_one_piece_of_the_path_share_a_number() -> None:
    scene = scene_along(np.array([0.0, 0.4 * PLACE_M, 1.2 * PLACE_M, 2.5 * PLACE_M, 9.0, 12.0]))
    cameras, number = len(scene.drive.cameras), place_numbers(scene)
    for k, image in enumerate(scene.drive.images):
        piece = int((scene.world_from_rig[image.unit, 0, 3] - scene.world_from_rig[0, 0, 3]) // PLACE_M)
        assert number[k] == piece * cameras + image.camera


def test_later_visits_come_with_the_first_one() -> None:
    there_and_back = np.array([0.0, 50.0, 1.0, 51.0, 2.0, 52.0])
    scene = scene_along(there_and_back)
    order = in_order_of_the_path(scene)
    assert sorted(order) == list(range(len(scene.drive.images)))
    far = there_and_back[[scene.drive.images[i].unit for i in order]] > 25.0
    assert np.abs(np.diff(far.astype(int))).sum() == 1  # all of one place, then all of the other


def test_a_slow_vehicle_has_no_more_views_of_a_place_than_a_fast_one() -> None:
    scene = scene_along(VIEW_STEP_M * np.array([0.0, 0.3, 0.9, 1.1, 2.5, 2.9]))
    scene.image_registered[0] = False  # the first of its camera: the second one is taken
    unit, camera = np.array([(image.unit, image.camera) for image in scene.drive.images]).T
    order = in_order_of_the_path(scene)
    assert camera[0] == 0
    assert sorted(unit[order][camera[order] == 0]) == [1, 3, 4]
    assert all(sorted(unit[order][camera[order] == c]) == [0, 3, 4] for c in range(1, len(scene.drive.cameras)))


def test_passes_beside_one_another_are_visited_together() -> None:
    x = np.arange(0.0, 300.0)
    there = np.column_stack([x, 0 * x, 0 * x])
    first = first_visits(np.concatenate([there, there[::-1] + np.array([0.0, 15.0, 0.0])]))
    assert np.abs(first[:300] - first[300:][::-1]).max() < SAME_PLACE_M / 2
    far = first_visits(np.concatenate([there, there[::-1] + np.array([0.0, SAME_PLACE_M + 1, 0.0])]))
    assert far[300:].min() > 300 - SAME_PLACE_M


def test_a_vehicle_that_stands_for_long_is_at_one_place() -> None:
    assert (first_visits(np.full((50_000, 3), 1.0)) == 0).all()
