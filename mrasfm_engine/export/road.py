"""`road.json`: the patches of the road's surface, which `points.ply` refers to by their index."""

from __future__ import annotations

from typing import Any

import numpy as np

from mrasfm_engine.scene.scene import Scene


def road_document(scene: Scene) -> dict[str, Any]:
    """The patches with what is known of the road, in the local frame of `frame.json`; the scene must have a road."""
    road = scene.road
    assert road is not None
    points = np.bincount(scene.point_patches[scene.point_patches >= 0], minlength=len(road.surface))
    return {
        "version": 1,
        "frame": "local",
        "source": str(road.source),
        "up": road.surface.axes[2],
        "patch_radius_m": road.surface.radius_m,
        "surface": "mean of the patches' planes, each weighted by (1 - (d / r)^2)^2 at the horizontal distance d of "
        "its centre, up to r = patch_radius_m",
        "roughness_m": road.roughness_m,
        "rig_height_above_road_m": road.rig_height_m,
        "patches": [
            {"centre_m": centre, "normal": normal, "points": int(count)}
            for centre, normal, count in zip(road.surface.centre_m, road.surface.normal, points, strict=True)
        ],
    }
