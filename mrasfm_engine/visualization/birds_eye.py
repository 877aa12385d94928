"""Bird's-eye mosaics of the road with the given and with the refined calibration, and how well the cameras agree there.

Where the calibration is right, what different cameras see of one piece of ground lines up; in these pictures the ground
is a chequerboard of the two cameras that see it best, so that lane markings break at the tiles' borders where it does
not. The poses of the vehicle are the final ones in both.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_camera
from mrasfm_engine.io.images import mask_of_png, read_image_rgb, read_mask
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.scene.semantics import class_codes, usable_pixels
from mrasfm_engine.types import Bools, Bytes, CountProgress, Floats, Ints
from mrasfm_engine.visualization.agreement import FINE_CELL_M, Agreement, measure_agreement, plots_along
from mrasfm_engine.visualization.drawing import Framed, framed
from mrasfm_engine.visualization.exposure import camera_gains, exposure_gains
from mrasfm_engine.visualization.ground import GroundHeights, estimate_ground
from mrasfm_engine.visualization.mosaic import GIVEN, REFINED, Grid, Mosaic, View, make_mosaics
from schemas import LabelMap, SemanticClass

BEFORE, AFTER = "birds_eye_before.png", "birds_eye_after.png"
TILE_M = 1.0  # side of the chequerboard's tiles
MIN_SECOND_SHARE = 0.25  # of the best view's resolution, that the second best must have to be shown
MASK_MARGIN_SHARE = 0.004  # of an image's width, around what is masked
OWN_CAR_MARGIN_M = 0.4  # around the cameras
SMALL_CAR_M = np.array([4.4, 1.9])  # length and width
EMPTY = (190, 190, 190)  # ground that no camera sees
MIN_WAY_M = 3.0  # a shorter one has no direction of its own


@dataclass(frozen=True, kw_only=True)
class BirdsEye:
    """Pictures by file name (none where there is nothing to show) and what the report says of them."""

    pictures: dict[str, Bytes] = field(default_factory=dict)
    report: dict[str, Any] = field(default_factory=dict)


def birds_eye(scene: Scene, *, seed: int = 0, progress: CountProgress | None = None) -> BirdsEye:
    """Draw a scene's road from above, before and after recalibration.

    Parameters
    ----------
    progress
        Called as progress(images done, images); may raise to stop.

    Returns
    -------
    BirdsEye
        Without pictures where no ground was found or no camera sees it; `report["not_drawn"]` then says why.
    """
    if not scene.unit_registered.any():
        return BirdsEye(report={"not_drawn": "no unit is registered"})
    plan_from_world = _plan_from_world(scene)
    plan_from_rig = plan_from_world @ scene.world_from_rig[scene.unit_registered]
    cameras = np.stack([c.rig_from_cam[:3, 3] for c in scene.calibration])
    ground = estimate_ground(
        se3.apply(plan_from_world, scene.points_m), plan_from_rig, cameras, rng=np.random.default_rng(seed)
    )
    if ground is None:
        return BirdsEye(report={"not_drawn": "too few points of the scene lie on the ground along the trajectory"})
    trajectory_m = plan_from_rig[:, :2, 3]
    mosaic, *plots = _mosaics_of(scene, plan_from_world, ground, trajectory_m, progress)
    if not mosaic.images_used:
        return BirdsEye(report={"not_drawn": "no camera sees the road"})
    agreement = measure_agreement(plots or [mosaic], trajectory_m)
    before, after = (_picture(scene, mosaic, which, agreement, plan_from_world) for which in (GIVEN, REFINED))
    level_m = float(np.median(ground.height_m(trajectory_m)))
    report = _report(scene, mosaic, agreement)
    report["world_from_pixel"] = _world_from_pixel(mosaic, se3.inverse(plan_from_world), after.top_px, level_m).tolist()
    return BirdsEye(pictures={BEFORE: before.picture, AFTER: after.picture}, report=report)


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


def _mosaics_of(
    scene: Scene,
    plan_from_world: Floats,
    ground: GroundHeights,
    trajectory_m: Floats,
    progress: CountProgress | None,
) -> list[Mosaic]:
    """Mosaic of the picture; where its cells are too coarse to compare cameras, those of fine plots along the path."""
    images = _nearest_first(scene)
    refined = scene.world_from_cam
    gains = exposure_gains(scene)
    given = scene.drive.rig_from_cam
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
            )
        )

    def step(done: int) -> None:
        if progress is not None:
            progress(done, len(views))

    return make_mosaics(
        views,
        grids_along(trajectory_m),
        ground,
        lambda index: read_view(scene, int(images[index])),
        own_car_m=_own_car_m(scene),
        step=step,
    )


def grids_along(trajectory_m: Floats) -> list[Grid]:
    """The grid of the picture around a way (n, 2), and where its cells are too coarse to compare cameras, fine plots
    along the trajectory."""
    grid = Grid.around(trajectory_m)
    return [grid, *(plots_along(trajectory_m) if grid.cell_m > FINE_CELL_M else [])]


def _own_car_m(scene: Scene) -> Floats | None:
    """About where the car itself is: around its cameras, and no smaller than cars are."""
    label_map = scene.drive.manifest.label_map or LabelMap.cityscapes()
    # Masks that a network made do not count: few know the car that carries the cameras from others.
    masked = all(image.mask is not None for image in scene.drive.images)
    if masked and SemanticClass.OWN_CAR in label_map.ids.values():
        return None
    cameras = np.stack([c.rig_from_cam[:2, 3] for c in scene.calibration])
    low, high = cameras.min(0), cameras.max(0)
    half = np.maximum((high - low) / 2 + OWN_CAR_MARGIN_M, SMALL_CAR_M / 2)
    return np.stack([(low + high) / 2 - half, (low + high) / 2 + half])


def _nearest_first(scene: Scene) -> Ints:
    """Registered images in an order in which most ground is seen from near first, so that little is painted twice:
    cameras that look forward approach it, so their last images come first."""
    images = np.flatnonzero(scene.image_registered)
    unit = np.array([scene.drive.images[i].unit for i in images])
    forward = np.array([scene.calibration[scene.drive.images[i].camera].rig_from_cam[0, 2] > 0 for i in images])
    return images[np.argsort(np.where(forward, -unit, unit), kind="stable")]


def read_view(scene: Scene, index: int) -> tuple[Bytes, Bools | None]:
    """An image (h, w, 3), and where it shows what stands still (h, w), None where no mask says so.

    The own car counts as masked where it was found. A margin belongs to what moves, as masks are not exact.
    """
    image, root, made = scene.drive.images[index], scene.drive.root, scene.features[index].made_mask
    own_car = scene.own_cars[image.camera]
    rgb = read_image_rgb(root / image.file)
    label_map = scene.drive.manifest.label_map
    if image.mask is not None:
        mask = read_mask(root / image.mask, label_map)
    elif made is not None:
        mask = mask_of_png(made)
    elif own_car is None:
        return rgb, None
    else:
        mask = None
    usable = np.ones(rgb.shape[:2], np.bool_)
    if mask is not None:
        usable = usable_pixels(class_codes(mask, label_map or LabelMap.cityscapes()))
    if own_car is not None:
        usable = usable & ~own_car
    side = 2 * max(1, round(MASK_MARGIN_SHARE * rgb.shape[1])) + 1
    return rgb, cv2.erode(usable.astype(np.uint8), np.ones((side, side), np.uint8)) > 0


def _picture(
    scene: Scene, mosaic: Mosaic, which: int, agreement: tuple[Agreement, Agreement] | None, plan_from_world: Floats
) -> Framed:
    title = f"{scene.drive.manifest.name}: the road from above, "
    title += "calibration as given" if which == GIVEN else "calibration as refined"
    if which == REFINED and not calibration_changed(scene):
        title += " (held: as given)"
    tile = max(TILE_M, 16 * mosaic.grid.cell_m)
    note = f"1 pixel = {mosaic.grid.cell_m:.3g} m, tiles of {tile:.3g} m alternate between the two best cameras"
    if agreement is not None:
        note += f"; correlation between cameras {agreement[which].correlation:.2f}"
        if np.isfinite(agreement[which].displacement_m):
            note += f", displacement {100 * agreement[which].displacement_m:.1f} cm"
    arrows = [("drive", (1.0, 0.0))]
    if scene.georeference is not None:
        arrows.append(("north", (float(plan_from_world[0, 1]), float(plan_from_world[1, 1]))))
    return framed(chequerboard(mosaic, which), [title, note], cell_m=mosaic.grid.cell_m, arrows=arrows)


def chequerboard(mosaic: Mosaic, which: int) -> Bytes:
    """The picture (h, w, 3) under one calibration, alternately by the best and by the second best camera, cut to what
    is seen."""
    tile = round(max(TILE_M, 16 * mosaic.grid.cell_m) / mosaic.grid.cell_m)
    odd = ((np.arange(mosaic.grid.rows) // tile)[:, None] + (np.arange(mosaic.grid.columns) // tile)[None]) % 2 == 1
    second = odd & (mosaic.owner[1] > 0) & (mosaic.score[1] >= MIN_SECOND_SHARE * mosaic.score[0])
    result = np.where(second[..., None], mosaic.color[which, 1], mosaic.color[which, 0])
    owner = np.where(second, mosaic.owner[1], mosaic.owner[0])
    for camera, gain in enumerate(camera_gains(mosaic), 1):
        table = np.minimum(gain * np.arange(256.0) + 0.5, 255).astype(np.uint8)
        cells = owner == camera
        result[cells] = table[result[cells]]
    result[mosaic.owner[0] == 0] = EMPTY
    cut: Bytes = result[mosaic.seen()]
    return cut


def _world_from_pixel(mosaic: Mosaic, world_from_plan: Floats, top_px: int, level_m: float) -> Floats:
    """The affine map (2, 3) from (u right, v down, 1) in the pictures, pixels, to x and y of the scene's local frame.

    The centre of the top left pixel is at (0.5, 0.5).
    """
    grid, (rows, columns) = mosaic.grid, mosaic.seen()
    plan_from_pixel = np.array(
        [
            [grid.cell_m, 0.0, grid.left_m + columns.start * grid.cell_m],
            [0.0, -grid.cell_m, grid.top_m - (rows.start - top_px) * grid.cell_m],
            [0.0, 0.0, level_m],
            [0.0, 0.0, 1.0],
        ]
    )
    result: Floats = (world_from_plan @ plan_from_pixel)[:2]
    return result


def calibration_changed(scene: Scene) -> bool:
    """Return whether any camera's refined calibration differs from the given one."""
    return any(
        not np.allclose(refined.rig_from_cam, given, atol=1e-9)
        or not np.allclose(refined.params, camera.params, rtol=1e-9)
        for refined, given, camera in zip(scene.calibration, scene.drive.rig_from_cam, scene.drive.cameras, strict=True)
    )


def _report(scene: Scene, mosaic: Mosaic, agreement: tuple[Agreement, Agreement] | None) -> dict[str, Any]:
    covered = (mosaic.owner > 0).sum(axis=(1, 2)) * mosaic.grid.cell_m**2
    result: dict[str, Any] = {
        "images": mosaic.images_used,
        "cell_m": mosaic.grid.cell_m,
        "ground_seen_m2": float(covered[0]),
        "ground_seen_by_two_cameras_m2": float(covered[1]),
        "calibration_changed": calibration_changed(scene),
    }
    if agreement is None:
        return result | {"not_compared": "too little textured ground near the trajectory is seen by two cameras"}
    for name, of in zip(("before", "after"), agreement, strict=True):
        result[name] = {"blocks": of.blocks, "correlation": of.correlation, "displaced_blocks": of.displaced_blocks}
        if np.isfinite(of.displacement_m):
            result[name]["displacement_m"] = of.displacement_m
    return result
