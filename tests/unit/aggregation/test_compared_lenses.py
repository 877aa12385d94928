"""Turn and focal length by which lens models differ."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.aggregation.lenses import Lens, turn_and_length
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import FISHEYE, PERSPECTIVE, RADIAL, packed

SIZE_PX = np.array([1240.0, 376.0])
PINHOLE = Lens(kind=PERSPECTIVE, params=packed(PERSPECTIVE, [720.0, 720.0, 610.0, 186.0])[1], size_px=SIZE_PX)
FISHEYE_PARAMS = [330.0, 330.0, 620.0, 188.0, 0.02, -0.008, 0.0, 0.0]


def lens(kind: int, params: list[float]) -> Lens:
    return Lens(kind=kind, params=packed(kind, params)[1], size_px=SIZE_PX)


@pytest.mark.parametrize(
    "one", [PINHOLE, lens(RADIAL, [720.0, 721.0, 610.0, 186.0, 0.01, 0.0, 0.0, 0.0]), lens(FISHEYE, FISHEYE_PARAMS)]
)
def test_the_same_lens_turns_and_stretches_nothing(one: Lens) -> None:
    np.testing.assert_array_equal(turn_and_length(one, one), 0.0)


def test_a_longer_focal_length_is_no_turn_and_neither_is_another_size() -> None:
    longer = lens(PERSPECTIVE, [720.0 * 1.01, 720.0 * 1.01, 610.0, 186.0])
    np.testing.assert_allclose(turn_and_length(longer, PINHOLE), [0.0, 0.0, 0.0, np.log(1.01)], atol=1e-9)
    half = replace(lens(PERSPECTIVE, [360.0, 360.0, 305.0, 93.0]), size_px=SIZE_PX / 2)
    np.testing.assert_allclose(turn_and_length(half, PINHOLE), 0.0, atol=1e-9)


def test_a_principal_point_that_moved_is_a_turn() -> None:
    narrow, moved = (
        lens(PERSPECTIVE, [7200.0, 7200.0, 610.0 + x_px, 186.0 + y_px]) for x_px, y_px in ((0.0, 0.0), (72.0, -36.0))
    )
    found = turn_and_length(moved, narrow)
    np.testing.assert_allclose(found, [-0.005, -0.01, 0.0, 0.0], atol=1e-4)
    ray = np.array([72.0 / 7200.0, -36.0 / 7200.0, 1.0])  # of the moved principal point, through the reference
    np.testing.assert_allclose(se3.exp_so3(found[:3]) @ ray, [0.0, 0.0, 1.0], atol=2e-4)


def test_distortion_takes_a_part_of_the_focal_length() -> None:
    distorted = lens(RADIAL, [715.0, 715.0, 610.0, 186.0, 0.0165, -0.007, 0.0, 0.0])
    *turn, longer = turn_and_length(distorted, PINHOLE)
    np.testing.assert_allclose(turn, 0.0, atol=1e-3)
    assert abs(longer) < 0.3 * np.log(720.0 / 715.0)


def test_views_that_have_nothing_in_common_say_nothing() -> None:
    elsewhere = lens(PERSPECTIVE, [720.0, 720.0, 610.0, 186.0])
    far = lens(FISHEYE, [20.0, 20.0, 5000.0, 188.0, 0.0, 0.0, 0.0, 0.0])
    assert np.isfinite(turn_and_length(far, elsewhere)).all()
