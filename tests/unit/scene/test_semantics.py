from __future__ import annotations

import numpy as np

from mrasfm_engine.scene.semantics import (
    CLASS_CODES,
    CLASS_NAMES,
    ROAD,
    UNKNOWN,
    class_codes,
    classes_at,
    count_classes,
    majority_class,
    may_match,
    usable_pixels,
)
from schemas import LabelMap, SemanticClass

STATIC = CLASS_CODES[SemanticClass.STATIC]


def test_numbers_in_files_do_not_change() -> None:
    assert {name: code for code, name in CLASS_NAMES.items()} == {
        "unknown": 0,
        "static": 1,
        "road": 2,
        "dynamic": 3,
        "sky": 4,
        "own_car": 5,
    }


def test_cityscapes_and_other_maps() -> None:
    mask = np.array([[0, 2, 10], [13, 19, 1]], np.uint8)
    codes = class_codes(mask, LabelMap.cityscapes())
    assert codes.tolist() == [[2, 1, 4], [3, 1, 1]]
    assert usable_pixels(codes).tolist() == [[True, True, False], [False, True, True]]
    own = LabelMap(ids={7: SemanticClass.ROAD, 255: SemanticClass.OWN_CAR})
    codes = class_codes(np.array([[7, 255, 8]], np.uint8), own)
    assert codes.tolist() == [[ROAD, CLASS_CODES[SemanticClass.OWN_CAR], UNKNOWN]]
    assert usable_pixels(codes).tolist() == [[True, False, True]]


def test_borders_between_classes_are_unknown_and_the_images_edge_is_not() -> None:
    codes = np.full((9, 12), STATIC, np.uint8)
    codes[:, 6:] = ROAD
    xy_px = np.stack(np.meshgrid(np.arange(12), np.arange(9)), -1).reshape(-1, 2) + 0.5
    sure = classes_at(codes, xy_px, 2).reshape(codes.shape)
    assert (sure[:, :4] == STATIC).all()
    assert (sure[:, 4:8] == UNKNOWN).all()
    assert (sure[:, 8:] == ROAD).all()
    np.testing.assert_array_equal(classes_at(codes, xy_px).reshape(codes.shape), codes)
    uniform = np.full_like(codes, ROAD)
    assert (classes_at(uniform, xy_px, 100) == ROAD).all()


def test_each_keypoint_has_a_margin_of_its_own() -> None:
    codes = np.full((9, 12), STATIC, np.uint8)
    codes[:, 6:] = ROAD
    xy_px = np.array([[3.5, 4.5], [3.5, 4.5], [9.5, 4.5], [9.5, 4.5]])
    assert classes_at(codes, xy_px, np.array([2.9, 3.0, 3.9, 4.0])).tolist() == [STATIC, UNKNOWN, ROAD, UNKNOWN]


def test_the_class_of_a_keypoint_is_that_of_the_pixel_it_lies_in() -> None:
    codes = np.array([[1, 2], [3, 4]], np.uint8)
    xy = np.array([[0.01, 0.99], [1.0, 0.5], [0.99, 1.0], [2.0, 2.0]], np.float32)
    assert classes_at(codes, xy).tolist() == [1, 2, 3, 4]


def test_unknown_matches_anything() -> None:
    a = np.array([0, 0, 1, 2, 1], np.uint8)
    b = np.array([0, 2, 0, 2, 2], np.uint8)
    assert may_match(a, b).tolist() == [True, True, True, True, False]


def test_majority() -> None:
    classes = np.array([2, 2, 1, 0, 0, 2, 0, 0, 1, 2], np.uint8)
    owner = np.array([0, 0, 0, 1, 1, 1, 2, 2, 3, 3], dtype=np.int64)
    # Unknown observations have no vote, a tie goes to the smaller code, and a point without observations is unknown.
    assert majority_class(classes, owner, 5).tolist() == [2, 2, 0, 1, 0]


def test_counts_by_name() -> None:
    assert count_classes([np.array([2, 2, 0], np.uint8), np.array([1], np.uint8)]) == {
        "unknown": 1,
        "static": 1,
        "road": 2,
    }
    assert count_classes([]) == {}
