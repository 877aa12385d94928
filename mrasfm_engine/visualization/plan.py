"""The ground plan of a scene: its frame, the ground's height, and the views of it in the order of the path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_camera
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.types import Floats, Ints
from mrasfm_engine.visualization.exposure import exposure_gains
from mrasfm_engine.visualization.ground import GroundHeights, estimate_ground
from mrasfm_engine.visualization.road_candidates import PLACE_M
from mrasfm_engine.visualization.views import VIEW_M, View

# Of the images of one camera within so much of the path one is painted: from the others the ground is no more than that
# nearer, and of what stands in the way they show the same side.
VIEW_STEP_M = PLACE_M / 4
MIN_WAY_M = 3.0  # a shorter one has no direction of its own
# Positions closer than this see the same blocks of ground, whenever the vehicle was there: both views and a block.
SAME_PLACE_M = 2.5 * VIEW_M
VISIT_CELL_M = 2.0  # side of the cells of which one position each is compared, however long the vehicle stood there
MAX_PLACES = 65_536  # of different number: a second visit after that many may count as the first


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The plan frame and what is drawn in it: z is up, x the direction in which the trajectory extends most.

    Attributes
    ----------
    trajectory_m
        Positions (n, 2) of the registered units.
    images, views
        Registered images `VIEW_STEP_M` apart, in the order in which they are painted.
    seen_by
        For every view the points that the cameras see at its time.
    """

    plan_from_world: Floats
    points_m: Floats  # (p, 3) the scene's points
    ground: GroundHeights
    trajectory_m: Floats
    images: Ints
    views: list[View]
    seen_by: list[Ints]

    def world_from_pixel(self, left_m: float, top_m: float, cell_m: float) -> Floats:
        """The affine map (2, 3) from (u right, v down, 1) in a picture, pixels, to x and y of the scene's local frame.

        The centre of the top left pixel is at (0.5, 0.5), the picture's top left corner at the given place.
        """
        level_m = float(np.median(self.ground.height_m(self.trajectory_m)))
        plan_from_pixel = np.array([[cell_m, 0.0, left_m], [0.0, -cell_m, top_m], [0.0, 0.0, level_m], [0.0, 0.0, 1.0]])
        result: Floats = (se3.inverse(self.plan_from_world) @ plan_from_pixel)[:2]
        return result


def plan_of(scene: Scene, *, seed: int) -> Plan | str:
    """The plan of a scene, or why there is none."""
    if not scene.unit_registered.any():
        return "no unit is registered"
    plan_from_world = _plan_from_world(scene)
    plan_from_rig = plan_from_world @ scene.world_from_rig[scene.unit_registered]
    cameras = np.stack([c.rig_from_cam[:3, 3] for c in scene.calibration])
    points_m = se3.apply(plan_from_world, scene.points_m)
    ground = estimate_ground(points_m, plan_from_rig, cameras, rng=np.random.default_rng(seed))
    if ground is None:
        return "too few points of the scene lie on the ground along the trajectory"
    images = in_order_of_the_path(scene)
    return Plan(
        plan_from_world=plan_from_world,
        points_m=points_m,
        ground=ground,
        trajectory_m=plan_from_rig[:, :2, 3],
        images=images,
        views=_views(scene, plan_from_world, images),
        seen_by=_seen_by(scene, images),
    )


def _plan_from_world(scene: Scene) -> Floats:
    """The plan frame: z is up, x the direction in which the trajectory extends most.

    Where the scene's frame does not know what is up, it is the vehicle's mean up axis.
    """
    poses = scene.world_from_rig[scene.unit_registered]
    upright = scene.georeference is not None or scene.rough_world_from_local is not None
    up = np.array([0.0, 0.0, 1.0]) if upright else poses[:, :3, 2].mean(0)
    up /= np.linalg.norm(up)
    position = poses[:, :3, 3] - poses[:, :3, 3].mean(0)
    flat = position - np.outer(position @ up, up)
    _, _, axes = np.linalg.svd(flat, full_matrices=False)
    along, trajectory = axes[0], flat[-1] - flat[0]
    if np.ptp(flat @ along) < MIN_WAY_M:
        along = trajectory = poses[:, :3, 0].mean(0)
    along = along - (along @ up) * up
    along *= (1.0 if along @ trajectory >= 0 else -1.0) / np.linalg.norm(along)
    rotation = np.stack([along, np.cross(up, along), up])
    return se3.transform(rotation, -rotation @ poses[:, :3, 3].mean(0))


def _views(scene: Scene, plan_from_world: Floats, images: Ints) -> list[View]:
    refined, given, gains = scene.world_from_cam, scene.drive.rig_from_cam, exposure_gains(scene)
    place = place_numbers(scene)
    views = []
    for i in images:
        image = scene.drive.images[i]
        camera, calibration = scene.drive.cameras[image.camera], scene.calibration[image.camera]
        rig = refined[i] @ se3.inverse(calibration.rig_from_cam)  # of the image's own time
        packed = [pack_camera(camera.model, p) for p in (camera.params, calibration.params)]
        views.append(
            View(
                camera=image.camera,
                plan_from_cam=plan_from_world @ np.stack([rig @ given[image.camera], refined[i]]),
                params=np.stack([p for _, p in packed]),
                kind=packed[0][0],
                size_px=(camera.width, camera.height),
                plan_from_rig=plan_from_world @ rig,
                gain=gains[i],
                place=int(place[i]),
            )
        )
    return views


def _seen_by(scene: Scene, images: Ints) -> list[Ints]:
    unit = np.array([image.unit for image in scene.drive.images], dtype=np.int64)
    shape = len(scene.unit_registered), max(len(scene.points_m), 1)
    pairs = unit[scene.observation_image], scene.observation_point
    # Counting by unit takes a fiftieth of the time that sorting all pairs takes.
    seen = csr_array((np.ones(len(pairs[0]), dtype=np.bool_), pairs), shape=shape)
    seen.sum_duplicates()
    by_unit = np.split(seen.indices, seen.indptr[1:-1])  # shared by the images of a unit
    return [by_unit[u] for u in unit[images]]


def place_numbers(scene: Scene) -> Ints:
    """Numbers (images,) that images of one camera from one piece of `PLACE_M` of the path share.

    Images of all cameras from there have consecutive numbers, from a multiple of the number of cameras.
    """
    cameras = len(scene.drive.cameras)
    unit, camera = _units_and_cameras(scene)
    result: Ints = _pieces(scene, PLACE_M)[unit] % (MAX_PLACES // cameras) * cameras + camera
    return result


def _pieces(scene: Scene, length_m: float) -> Ints:
    """Numbers (units,) of the pieces of the path that registered units are in."""
    units = np.flatnonzero(scene.unit_registered)
    steps_m = np.linalg.norm(np.diff(scene.world_from_rig[units][:, :3, 3], axis=0), axis=1)
    piece = np.zeros(len(scene.unit_registered), dtype=np.int64)
    piece[units] = np.concatenate([[0.0], np.cumsum(steps_m)]) // length_m
    return piece


def _units_and_cameras(scene: Scene) -> Ints:
    """Unit and camera (2, images) of all images."""
    result: Ints = np.array([(image.unit, image.camera) for image in scene.drive.images]).reshape(-1, 2).T
    return result


def in_order_of_the_path(scene: Scene) -> Ints:
    """Registered images `VIEW_STEP_M` apart in the order of the path, those of later visits with those of the first.

    Against the driving direction where most cameras look ahead, so that they see ground from near first, and little is
    painted twice.
    """
    units = np.flatnonzero(scene.unit_registered)
    position = scene.world_from_rig[units][:, :3, 3]
    first_visit = np.zeros(len(scene.unit_registered), dtype=np.int64)
    first_visit[units] = first_visits(position)
    images = np.flatnonzero(scene.image_registered)
    unit, camera = _units_and_cameras(scene)[:, images]
    _, apart = np.unique(_pieces(scene, VIEW_STEP_M)[unit] * len(scene.drive.cameras) + camera, return_index=True)
    images, unit, camera = images[apart], unit[apart], camera[apart]
    forward = np.array([c.rig_from_cam[0, 2] > 0 for c in scene.calibration])[camera].mean() >= 0.5
    sign = -1 if forward else 1
    return images[np.lexsort((sign * unit, sign * first_visit[unit]))]


def first_visits(position_m: Floats) -> Ints:
    """Numbers (n,) of the first position near each of those given (n, 3); see `SAME_PLACE_M`."""
    cells = np.floor(position_m / VISIT_CELL_M).astype(np.int64)
    _, first, cell = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    tree = cKDTree(position_m[first])
    earliest = [first[tree.query_ball_point(place, SAME_PLACE_M)].min() for place in position_m[first]]
    result: Ints = np.array(earliest, dtype=np.int64)[cell.reshape(-1)]
    return result
