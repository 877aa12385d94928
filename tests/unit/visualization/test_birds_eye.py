"""Pictures that cannot be drawn say why."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.visualization.birds_eye import birds_eye
from mrasfm_engine.visualization.drawing import framed
from tests.helpers.export_example import make_scene


def test_a_scene_without_ground_is_not_drawn() -> None:
    drawn = birds_eye(make_scene())
    assert drawn.pictures == {}
    assert "ground" in drawn.report["not_drawn"]


def test_a_scene_without_units_is_not_drawn() -> None:
    scene = make_scene()
    scene.unit_registered[:] = False
    assert birds_eye(scene).report == {"not_drawn": "no unit is registered"}


def test_the_frame_keeps_the_picture_and_draws_a_scale_of_the_right_length() -> None:
    picture = np.full((400, 1000, 3), 120, np.uint8)
    out = framed(picture, ["one", "two"], cell_m=0.025, arrows=[("drive", (1.0, 0.0))])
    np.testing.assert_array_equal(out.picture[out.top_px : out.top_px + 400, :1000], picture)
    below = out.picture[out.top_px + 400 :]
    longest = max((row.min(axis=1) < 60).sum() for row in below[:, :500])
    assert 198 <= longest <= 206  # 5 m: the longest round length within a quarter of the width
