"""The published figures, against what stands in the paper's tables."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.benchmark.published import KITTI, METHODS, NUSCENES_RMSE_M


def test_kitti_has_all_sequences_and_methods() -> None:
    assert list(KITTI) == [f"{number:02d}" for number in range(11)]
    assert all(tuple(figures.by_method) == METHODS for figures in KITTI.values())
    # Sums of the printed columns: one digit that is copied wrongly changes them.
    translation = [sum(f.by_method[m].translation_m for f in KITTI.values()) for m in METHODS]
    rotation = [sum(f.by_method[m].rotation_deg for f in KITTI.values()) for m in METHODS]
    np.testing.assert_allclose(translation, [17.9, 17.7, 4.8, 5.7, 3.1], atol=1e-9)
    np.testing.assert_allclose(rotation, [5.3, 3.5, 2.9, 3.2, 2.9], atol=1e-9)
    assert sum(f.mrasfm_minutes for f in KITTI.values()) == 985


def test_nuscenes() -> None:
    assert min(NUSCENES_RMSE_M, key=lambda name: NUSCENES_RMSE_M[name]) == "MRASfM"
    assert round(sum(NUSCENES_RMSE_M.values()), 3) == 1.037
