"""`road.json`: the patches of the road's surface, which `points.ply` refers to by their index, and their relief."""

from __future__ import annotations

from typing import Any

import numpy as np

from mrasfm_engine.scene.road_relief import BLEND_M, NO_RELIEF
from mrasfm_engine.scene.scene import Scene

SURFACE = (
    "mean of the patches' planes, each weighted by (1 - (d / r)^2)^2 at the horizontal distance d of its centre, up to "
    "r = patch_radius_m; plus the relief: the sum over its nodes of weight times (height_m + slope . offset), divided "
    f"by the sum of weights and {NO_RELIEF}. There offset and d are the horizontal ones from node_m, and "
    "r = relief.radius_m; node_m are coordinates along the three axes, of which the first two are horizontal"
)
DECIMALS = 4  # of the relief: a tenth of a millimetre; there is a node for every square metre


def road_document(scene: Scene) -> dict[str, Any]:
    """The patches with what is known of the road, in the local frame of `frame.json`; the scene must have a road."""
    road = scene.road
    assert road is not None
    relief, axes = road.surface.relief, road.surface.axes
    points = np.bincount(scene.point_patches[scene.point_patches >= 0], minlength=len(road.surface))
    return {
        "version": 2,
        "frame": "local",
        "source": str(road.source),
        "axes": axes,
        "up": axes[2],
        "patch_radius_m": road.surface.radius_m,
        "surface": SURFACE,
        "roughness_m": road.roughness_m,
        "rig_height_above_road_m": road.rig_height_m,
        "patches": [
            {"centre_m": centre, "normal": normal, "points": int(count)}
            for centre, normal, count in zip(road.surface.centre_m, road.surface.normal, points, strict=True)
        ],
        "relief": {
            "radius_m": BLEND_M,
            "node_m": relief.node_m.round(DECIMALS),
            "height_m": relief.height_m.round(DECIMALS),
            "slope": relief.slope.round(DECIMALS),
            "sigma_m": relief.sigma_m.round(DECIMALS),
        },
    }
