"""Figures that others have published for the data sets that we measure on.

Source: Xuan, Nie et al., "MRASfM: Multi-Camera Reconstruction and Aggregation through Structure-from-Motion in Driving
Scenes", arXiv 2510.15467: its tables of KITTI odometry (grey or colour stereo) and of nuScenes (six cameras).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

METHODS = ("COLMAP", "GLOMAP", "MGSfM", "MCSfM", "MRASfM")


@dataclass(frozen=True)
class KittiError:
    """Median absolute errors of a sequence."""

    translation_m: float
    rotation_deg: float


@dataclass(frozen=True)
class KittiFigures:
    """Published figures of one sequence."""

    by_method: Mapping[str, KittiError]
    mrasfm_minutes: float


def _kitti(*errors: tuple[float, float], minutes: float) -> KittiFigures:
    return KittiFigures({name: KittiError(*error) for name, error in zip(METHODS, errors, strict=True)}, minutes)


KITTI: Mapping[str, KittiFigures] = {
    "00": _kitti((0.9, 0.4), (0.8, 0.4), (0.5, 0.4), (0.5, 0.3), (0.3, 0.5), minutes=192),
    "01": _kitti((1.5, 0.2), (4.5, 0.5), (0.6, 0.2), (1.0, 0.4), (0.6, 0.2), minutes=34),
    "02": _kitti((4.0, 0.5), (5.4, 0.4), (0.9, 0.4), (1.0, 0.3), (0.7, 0.4), minutes=276),
    "03": _kitti((0.2, 0.1), (0.4, 0.2), (0.2, 0.2), (0.2, 0.2), (0.1, 0.2), minutes=48),
    "04": _kitti((0.1, 0.1), (0.2, 0.1), (0.1, 0.1), (0.1, 0.1), (0.1, 0.1), minutes=3),
    "05": _kitti((0.8, 0.6), (0.3, 0.2), (0.2, 0.2), (0.2, 0.3), (0.1, 0.3), minutes=81),
    "06": _kitti((0.2, 0.2), (0.3, 0.1), (0.1, 0.1), (0.2, 0.1), (0.1, 0.1), minutes=28),
    "07": _kitti((0.5, 1.1), (0.3, 0.3), (0.2, 0.2), (0.4, 0.4), (0.2, 0.1), minutes=43),
    "08": _kitti((6.1, 0.7), (3.1, 0.7), (0.9, 0.4), (1.2, 0.4), (0.5, 0.3), minutes=188),
    "09": _kitti((1.1, 0.6), (1.7, 0.3), (0.5, 0.3), (0.5, 0.3), (0.2, 0.3), minutes=54),
    "10": _kitti((2.5, 0.8), (0.7, 0.3), (0.6, 0.4), (0.4, 0.4), (0.2, 0.4), minutes=38),
}

# RMSE of positions, metres.
NUSCENES_RMSE_M: Mapping[str, float] = {
    "ORB-SLAM3": 0.199,
    "DROID-SLAM": 0.282,
    "GLOMAP": 0.158,
    "OCC-VO": 0.140,
    "MGSfM": 0.134,
    "MRASfM": 0.124,
}
