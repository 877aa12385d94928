"""Bird's-eye mosaics of the road with the given and with the refined calibration, and how well the cameras agree there.

Where the calibration is right, what different cameras see of one piece of ground lines up; in these pictures the ground
is a chequerboard of the two cameras that see it best, so that lane markings break at the tiles' borders where it does
not. The poses of the vehicle are the final ones in both.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mrasfm_engine.export.picture_files import LargeFile
from mrasfm_engine.io.images import mask_of_png, read_image_rgb, read_mask
from mrasfm_engine.jit import njit
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.scene.semantics import class_codes, usable_pixels
from mrasfm_engine.types import Bools, Bytes, CountProgress, Floats
from mrasfm_engine.visualization.agreement import FINE_CELL_M, Agreement, measure_agreement, plots_along, why_not_better
from mrasfm_engine.visualization.drawing import Framed, framed
from mrasfm_engine.visualization.exposure import camera_gains
from mrasfm_engine.visualization.ground import GroundTiles
from mrasfm_engine.visualization.mosaic import Grid, Mosaic, MosaicPainter
from mrasfm_engine.visualization.plan import Plan, plan_of
from mrasfm_engine.visualization.road_picture import (
    OptionalPainter,
    RoadPicture,
    discard_road,
    finish_road,
    painting_road,
)
from mrasfm_engine.visualization.views import GIVEN, MIN_RESOLUTION_PX, REFINED, Painter, paint_views
from schemas import LabelMap, SemanticClass

BEFORE, AFTER = "birds_eye_before.png", "birds_eye_after.png"
TILE_M = 1.0  # side of the chequerboard's tiles
MIN_SECOND_SHARE = 0.25  # of the best view's resolution, that the second best must have to be shown
MASK_MARGIN_SHARE = 0.004  # of an image's width, around what is masked
OWN_CAR_MARGIN_M = 0.4  # around the cameras
SMALL_CAR_M = np.array([4.4, 1.9])  # length and width
EMPTY = (190, 190, 190)  # ground that no camera sees


@dataclass(frozen=True, kw_only=True)
class BirdsEye:
    """Pictures by file name (none where there is nothing to show) and what the report says of them."""

    pictures: dict[str, Bytes] = field(default_factory=dict)
    files: dict[str, bytes | LargeFile] = field(default_factory=dict)  # what is no picture in memory
    report: dict[str, Any] = field(default_factory=dict)
    road_report: dict[str, Any] = field(default_factory=dict)


def birds_eye(
    scene: Scene, *, seed: int = 0, progress: CountProgress | None = None, scratch: Path | None = None
) -> BirdsEye:
    """Draw a scene's road from above, before and after recalibration, and as one picture.

    Parameters
    ----------
    progress
        Called as progress(images done, images); may raise to stop.
    scratch
        An empty folder for the picture of the whole road, which lies on disk; without it there is none.

    Returns
    -------
    BirdsEye
        Without pictures where no ground was found or no image shows it finely; `report["not_drawn"]` then says why.
    """
    plan = plan_of(scene, seed=seed)
    if isinstance(plan, str):
        return BirdsEye(report={"not_drawn": plan})
    heights, own_car_m = GroundTiles(plan.ground), _own_car_m(scene)
    painter = MosaicPainter(grids_along(plan.trajectory_m), heights, own_car_m=own_car_m)
    with ExitStack() as stack:
        painters: list[Painter] = [painter]
        if scratch is not None:
            road = stack.enter_context(painting_road(plan, heights, scratch, own_car_m))
            optional = OptionalPainter(road, on_error=lambda: discard_road(road, scratch))
            painters.append(optional)
        paint_views(
            plan.views,
            lambda index: read_view(scene, int(plan.images[index])),
            painters,
            step=lambda done: None if progress is None else progress(done, len(plan.views)),
        )
        mosaic, *plots = painter.mosaics()
        if not mosaic.images_used:
            finest = f"{MIN_RESOLUTION_PX:g} pixels a metre or more"
            return BirdsEye(report={"not_drawn": f"no image shows ground beside the car itself by {finest}"})
        pool = stack.enter_context(ThreadPoolExecutor(2))  # ends before the road's files go
        finishing = None
        if scratch is not None:
            finishing = pool.submit(finish_road, scene, plan, road, scratch, optional.error)
        agreement = measure_agreement(plots or [mosaic], plan.trajectory_m)
        gains = camera_gains(mosaic)
        before, after = pool.map(
            lambda which: _picture(scene, mosaic, which, gains, agreement, plan.plan_from_world), (GIVEN, REFINED)
        )
        drawn = RoadPicture() if finishing is None else finishing.result()
    report = _report(scene, mosaic, agreement)
    report["world_from_pixel"] = _world_from_pixel(mosaic, plan, after.top_px).tolist()
    pictures = {BEFORE: before.picture, AFTER: after.picture, **drawn.pictures}
    return BirdsEye(pictures=pictures, files=drawn.files, report=report, road_report=drawn.report)


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


def read_view(scene: Scene, index: int) -> tuple[Bytes, Bools | None]:
    """An image (h, w, 3), and where it shows what stands still (h, w), None where no mask says so.

    The own car counts as masked where it was found. A margin belongs to what moves, as masks are not exact.
    """
    image, made = scene.drive.images[index], scene.features[index].made_mask
    own_car = scene.own_cars[image.camera]
    rgb = read_image_rgb(scene.drive.path_of(image.file))
    label_map = scene.drive.manifest.label_map
    if image.mask is not None:
        mask = read_mask(scene.drive.path_of(image.mask), label_map)
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
    scene: Scene,
    mosaic: Mosaic,
    which: int,
    gains: Floats,
    agreement: tuple[Agreement, Agreement] | None,
    plan_from_world: Floats,
) -> Framed:
    lines = [_title_lines(scene, mosaic, one, agreement) for one in (GIVEN, REFINED)]
    arrows = [("drive", (1.0, 0.0))]
    if scene.georeference is not None:
        arrows.append(("north", (float(plan_from_world[0, 1]), float(plan_from_world[1, 1]))))
    drawn = chequerboard(mosaic, which, gains)
    return framed(drawn, lines[which], cell_m=mosaic.grid.cell_m, arrows=arrows, lines_of_other=lines[1 - which])


def _title_lines(scene: Scene, mosaic: Mosaic, which: int, agreement: tuple[Agreement, Agreement] | None) -> list[str]:
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
    return [title, note]


def chequerboard(mosaic: Mosaic, which: int, gains: Floats) -> Bytes:
    """The picture (h, w, 3) under one calibration, alternately by the best and by the second best camera, cut to what
    is seen.

    Parameters
    ----------
    gains
        Factors (cameras,) on the colours, see `camera_gains`.
    """
    rows, columns = mosaic.seen()
    result = np.empty((rows.stop - rows.start, columns.stop - columns.start, 3), np.uint8)
    shown_as = np.minimum(gains[:, None] * np.arange(256.0) + 0.5, 255).astype(np.uint8)
    tile = round(max(TILE_M, 16 * mosaic.grid.cell_m) / mosaic.grid.cell_m)
    place = rows.start, columns.start
    _lay_tiles(mosaic.owner, mosaic.score, mosaic.color[which], shown_as, EMPTY, tile, *place, result)
    return result


@njit(cache=True, nogil=True)
def _lay_tiles(
    owner: Any, score: Any, color: Any, shown_as: Any, empty: Any, tile: int, top: int, left: int, result: Any
) -> None:
    """Colour the cells (h, w, 3) of a mosaic from a row and column on; `shown_as` (cameras, 256) is by camera."""
    for i in range(result.shape[0]):
        row = top + i
        for j in range(result.shape[1]):
            column = left + j
            layer = 0
            if (row // tile + column // tile) % 2 == 1 and owner[1, row, column] > 0:
                layer = int(score[1, row, column] >= MIN_SECOND_SHARE * score[0, row, column])
            camera = owner[layer, row, column]
            for k in range(3):
                result[i, j, k] = empty[k] if camera == 0 else shown_as[camera - 1, color[layer, row, column, k]]


def _world_from_pixel(mosaic: Mosaic, plan: Plan, top_px: int) -> Floats:
    """The affine map (2, 3) from (u right, v down, 1) in the pictures to x and y of the scene; see `Plan`."""
    grid, (rows, columns) = mosaic.grid, mosaic.seen()
    left_m = grid.left_m + columns.start * grid.cell_m
    return plan.world_from_pixel(left_m, grid.top_m - (rows.start - top_px) * grid.cell_m, grid.cell_m)


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
    reason = why_not_better(*agreement, changed=result["calibration_changed"])
    if reason is not None:
        result["not_better"] = reason
    return result
