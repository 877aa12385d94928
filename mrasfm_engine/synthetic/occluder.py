"""A lorry that keeps beside the vehicle and hides most of one camera's image."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.synthetic.cameras import unproject
from mrasfm_engine.synthetic.objects import TRUCK_SIZE_M
from mrasfm_engine.synthetic.rigs import TrueCamera
from mrasfm_engine.types import Floats

_COVERAGE = 0.9
_CLEARANCE_M = 0.45  # between the lorry and any camera
_BOTTOM_M = 0.5


def _coverage(origin: Floats, rays: Floats, centre: Floats) -> Floats:
    """Share of rays (n, 3) from `origin` that hit lorries (m,) whose boxes are centred at (m, 2) in the rig."""
    length, width, height = TRUCK_SIZE_M
    half = np.array([length / 2, width / 2])
    low = np.concatenate([centre - half, np.full((len(centre), 1), _BOTTOM_M)], 1)
    high = np.concatenate([centre + half, np.full((len(centre), 1), height)], 1)
    safe = np.where(np.abs(rays) < 1e-9, 1e-9, rays)
    a = (low[:, None] - origin) / safe
    b = (high[:, None] - origin) / safe
    enter, leave = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
    result: Floats = ((enter < leave) & (enter > 0)).mean(-1)
    return result


def place_truck(camera: TrueCamera, rig: list[TrueCamera]) -> Floats:
    """`rig_from_truck` (4, 4) of a lorry parallel to the vehicle that covers about 90 % of a camera's image."""
    x = (np.arange(24) + 0.5) * camera.width / 24
    y = (np.arange(14) + 0.5) * camera.height / 14
    ideal = unproject(camera.model, camera.params, np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))
    rays = np.concatenate([ideal, np.ones((len(ideal), 1))], 1) @ camera.rig_from_cam[:3, :3].T
    length, width, _ = TRUCK_SIZE_M
    grid = np.stack(np.meshgrid(np.arange(-9.0, 9.01, 0.1), np.arange(-4.0, 4.01, 0.1)), -1).reshape(-1, 2)
    for other in rig:
        away = np.abs(grid - other.rig_from_cam[:2, 3]) - [length / 2, width / 2]
        grid = grid[away.max(1) > _CLEARANCE_M]
    cover = _coverage(camera.rig_from_cam[:3, 3], rays, grid)
    # Of all places that hide as much as asked, the farthest: it hides least from the neighbours.
    distance = np.linalg.norm(grid - camera.rig_from_cam[:2, 3], axis=1)
    score = np.abs(cover - _COVERAGE) - 0.002 * distance
    best = grid[np.argmin(score)]
    return se3.transform(np.eye(3), np.array([best[0], best[1], 0.0]))
