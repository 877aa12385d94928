from __future__ import annotations

import numpy as np

from mrasfm_engine.visualization.road_points import ABOVE, BELOW, NAMES, ON, road_points
from tests.helpers.export_example import make_scene, scene_with_road


def counted(picture: np.ndarray) -> dict[str, int]:
    """Pixels of both panels by colour."""
    image = picture[100:950, :, ::-1]
    named = {"on": ON, "above": ABOVE, "below": BELOW}
    return {name: int((image == np.array(colour)).all(-1).sum()) for name, colour in named.items()}


def test_pictures_show_what_was_dropped() -> None:
    drawn = road_points(scene_with_road())
    before, after = (counted(drawn[name]) for name in NAMES)
    assert min(before.values()) > 100
    assert after["above"] == after["below"] == 0
    assert 0.5 * before["on"] < after["on"]


def test_points_at_the_end_of_the_world_do_not_spoil_the_picture() -> None:
    near = counted(road_points(scene_with_road(far=True))[NAMES[0]])
    assert min(near.values()) > 100


def test_no_road_no_picture() -> None:
    assert road_points(make_scene()) == {}
