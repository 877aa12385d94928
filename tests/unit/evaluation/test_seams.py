from __future__ import annotations

import numpy as np

from mrasfm_engine.evaluation.seams import compare_seam
from mrasfm_engine.geometry import se3


def street(start_m: float, units: int = 20) -> np.ndarray:
    positions = np.stack([start_m + np.arange(units), np.zeros(units), np.zeros(units)], 1)
    return se3.transform(np.tile(np.eye(3), (units, 1, 1)), positions)


def test_only_the_overlap_counts() -> None:
    """Scene b is scaled by 1 %: where the scenes meet that is little, at its far end 0.2 m."""
    a, b = street(0.0), street(16.0)
    scaled = b.copy()
    scaled[:, :3, 3] = 16.0 + 1.01 * (b[:, :3, 3] - 16.0) * [1, 0, 0] - [16.0 - 16.0, 16.0, 16.0]
    scaled[:, 1:3, 3] = 0.0
    errors = compare_seam(a, scaled, a, b)
    assert errors is not None
    assert 8 <= errors.units <= 10  # those within 5 m of a unit of b
    assert 0 <= errors.translation_m < 0.02


def test_a_shift_and_a_turn_are_found_whatever_the_world_is() -> None:
    a, b = street(0.0), street(5.0)
    off = se3.transform(se3.exp_so3([0.0, 0.0, np.radians(0.5)]), [0.0, 0.3, 0.0])
    about = se3.transform(np.eye(3), [10.0, 0.0, 0.0])
    moved = about @ off @ se3.inverse(about) @ b
    elsewhere = se3.transform(se3.exp_so3([0.1, 0.2, 0.3]), [100.0, 200.0, 5.0])
    errors = compare_seam(elsewhere @ a, elsewhere @ moved, a, b)
    assert errors is not None
    assert 0.25 < errors.translation_m < 0.35
    assert abs(errors.rotation_deg - 0.5) < 1e-6


def test_nothing_to_compare() -> None:
    assert compare_seam(street(0.0)[:0], street(0.0), street(0.0)[:0], street(0.0)) is None
