"""Units that positions alone put into one frame are found again by the points that they share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.scene.unit_components import connected_units
from tests.helpers.export_example import POINTS, UNITS, make_scene


def with_observations(scene: Scene, kept: np.ndarray) -> Scene:
    return replace(
        scene,
        observation_point=scene.observation_point[kept],
        observation_image=scene.observation_image[kept],
        observation_keypoint=scene.observation_keypoint[kept],
    )


def parted(scene: Scene, *, points_across: int) -> Scene:
    """Units 0 and 2 observe one half of the points, units 3 and 4 the other; some points are seen by all."""
    unit, point = scene.image_unit[scene.observation_image], scene.observation_point
    late, second = unit >= 3, point >= POINTS // 2
    return with_observations(scene, (late == second) | (point < points_across))


def test_units_that_share_points_are_one_component() -> None:
    scene = make_scene()
    assert connected_units(scene, next_number=1).tolist() == [0] * UNITS
    assert connected_units(parted(scene, points_across=0), next_number=1).tolist() == [0, 0, 0, 1, 1]


def test_numbers_follow_those_of_other_folders_and_few_common_points_connect_nothing() -> None:
    scene = make_scene()
    assert connected_units(parted(scene, points_across=5), next_number=3).tolist() == [0, 0, 0, 3, 3]
    assert connected_units(parted(scene, points_across=POINTS // 2), next_number=3).tolist() == [0] * UNITS


def test_the_largest_is_the_one_with_most_units_and_units_without_points_go_with_their_neighbour() -> None:
    scene = make_scene()
    unit, point = scene.image_unit[scene.observation_image], scene.observation_point
    first, second = (unit == 0) & (point < 25), np.isin(unit, (2, 3)) & (point >= 25)
    found = connected_units(with_observations(scene, first | second), next_number=1)
    # The second unit has no pose; the last one observes nothing, and the one before it is the nearest in time.
    assert found.tolist() == [1, 0, 0, 0, 0]


def test_a_unit_with_few_points_goes_with_the_one_that_it_shares_most_with() -> None:
    scene = make_scene()
    unit, point = scene.image_unit[scene.observation_image], scene.observation_point
    most = np.isin(unit, (0, 2)) & (point < 25)
    for few, expected in (((1, 2, 3), 0), ((40, 41, 42), 1)):
        seen = most | ((unit == 4) & np.isin(point, few))
        assert connected_units(with_observations(scene, seen), next_number=1)[[0, 2, 4]].tolist() == [0, 0, expected]
