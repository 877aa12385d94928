"""Images that may see the ground: their geometry, and how they are painted one after the other.

Every image is read once, whatever is painted of it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import project, unproject_pixels
from mrasfm_engine.jit import uncounted
from mrasfm_engine.parallel import in_order
from mrasfm_engine.types import Bools, Bytes, Floats
from mrasfm_engine.visualization.ground import HEIGHT_STEP_M, GroundTiles

GIVEN, REFINED = 0, 1
VIEW_M = 15.0  # how far from a camera its image is used
MIN_RESOLUTION_PX = 5.0  # of an image on the ground, pixels a metre along the line of sight
OWN_CAR_LEVEL = 0.5  # of the cameras' height: up to there the car's body hides the ground
FOOTPRINT_MARGIN_M = 1.0  # around where the corners of an image meet the ground: it is not level
AHEAD = 1  # views by which a painter may be ahead of another one

Read = Callable[[int], tuple[Bytes, Bools | None]]  # image (h, w, 3) and usable pixels (h, w), None where all are


@dataclass(frozen=True, kw_only=True)
class View:
    """One image that may see the ground; poses are `plan_from_cam` (2, 4, 4) as given and as refined."""

    camera: int
    plan_from_cam: Floats
    params: Floats  # (2, PARAMETERS) as given and as refined
    kind: int
    size_px: tuple[int, int]  # width, height
    plan_from_rig: Floats  # (4, 4)
    gain: Floats  # (3,)
    place: int = 0  # number of the camera and of the part of the path that it is taken from, see `place_numbers`


class Painter(Protocol):
    """Something that takes images one after the other."""

    def paint(self, index: int, view: View, rgb: Bytes, usable: Bools | None) -> None:
        """Take a view, by its position in the sequence, with its image (h, w, 3) and usable pixels (h, w).

        Views come in the order of the sequence, each of them once.
        """
        ...


def paint_views(
    views: Sequence[View], read: Read, painters: Sequence[Painter], *, step: Callable[[int], None] = lambda done: None
) -> None:
    """Hand every view to all painters, in order, each in a thread of its own; every image is read once.

    A painter that is slow with one view does not hold up the others, which may be `AHEAD` views ahead of it.

    Parameters
    ----------
    read
        Image and usable pixels of a view by its position in `views`.
    step
        Called after every view with how many are done; may raise.
    """
    under_way: deque[list[Future[None]]] = deque()
    done = 0

    def finish_first() -> None:
        nonlocal done
        for each in under_way[0]:
            each.result()
        under_way.popleft()
        done += 1
        step(done)

    with ExitStack() as stack:
        images = stack.enter_context(closing(in_order(1, read, range(len(views)))))
        pools = [stack.enter_context(ThreadPoolExecutor(1)) for _ in painters]
        stack.callback(lambda: [each.cancel() for view in under_way for each in view])  # of an error, before all ends
        for index, (view, (rgb, usable)) in enumerate(zip(views, images, strict=True)):
            both = zip(painters, pools, strict=True)
            under_way.append([pool.submit(painter.paint, index, view, rgb, usable) for painter, pool in both])
            if len(under_way) > AHEAD:
                finish_first()
        while under_way:
            finish_first()


@dataclass(frozen=True, kw_only=True)
class PlacedView:
    """A view above the ground that it may see.

    Attributes
    ----------
    cam_from_plan
        (2, 3, 4) as given and as refined.
    rig_from_plan
        (2, 4): x and y only.
    heights_m, first_m
        Heights of the ground around the camera, and x and y (2,) of the first one; see `GroundTiles.around`.
    above_ground_m
        How far the camera is above the ground.
    low_m, high_m
        Corners (2,) of the rectangle of ground that the image may show.
    """

    cam_from_plan: Floats
    rig_from_plan: Floats
    centre_m: Floats
    heights_m: Floats
    first_m: Floats
    above_ground_m: float
    low_m: Floats
    high_m: Floats


def place_view(view: View, ground: GroundTiles, *, margin_m: float = 0.0) -> PlacedView | None:
    """Place a view above the ground, known `margin_m` farther than the view reaches; None where it sees no ground."""
    centre = view.plan_from_cam[REFINED][:3, 3]
    heights, first = ground.around(centre[:2], VIEW_M + FOOTPRINT_MARGIN_M + margin_m)
    corners = _footprint(view, float(heights.min()))
    if corners is None:
        return None
    return PlacedView(
        cam_from_plan=np.ascontiguousarray(se3.inverse(view.plan_from_cam)[:, :3]),
        rig_from_plan=np.ascontiguousarray(se3.inverse(view.plan_from_rig)[:2]),
        centre_m=centre,
        heights_m=heights,
        first_m=first,
        above_ground_m=float(centre[2] - height_at(heights, *(centre[:2] - first))),
        low_m=corners[0],
        high_m=corners[1],
    )


def _footprint(view: View, lowest_m: float) -> tuple[Floats, Floats] | None:
    """Corners (2,) of the rectangle of ground, nowhere below `lowest_m`, that the image may show; None for none."""
    width, height = view.size_px
    u, v = np.meshgrid(np.linspace(0, width, 25), np.linspace(0, height, 17))
    rays = unproject_pixels(view.kind, view.params[REFINED], np.column_stack([u.ravel(), v.ravel()]))
    pose = view.plan_from_cam[REFINED]
    rays = rays @ pose[:3, :3].T
    rays = rays[rays[:, 2] < 0]
    if not len(rays):
        return None
    above = max(float(pose[2, 3]) - lowest_m, 0.1)
    flat = np.maximum(np.hypot(rays[:, 0], rays[:, 1]), 1e-9)
    reach = np.minimum(above * flat / -rays[:, 2], VIEW_M)
    at = pose[:2, 3] + rays[:, :2] * (reach / flat)[:, None]
    return at.min(0) - FOOTPRINT_MARGIN_M, at.max(0) + FOOTPRINT_MARGIN_M


@uncounted(forceinline=True)
def height_at(heights: Any, right_m: float, up_m: float) -> float:
    """Bilinear between the corners of the height grid."""
    a, b = up_m / HEIGHT_STEP_M, right_m / HEIGHT_STEP_M
    i, j = int(a), int(b)
    a, b = a - i, b - j
    here = heights[i, j] * (1 - b) + heights[i, j + 1] * b
    next_up = heights[i + 1, j] * (1 - b) + heights[i + 1, j + 1] * b
    return float(here * (1 - a) + next_up * a)


@uncounted(forceinline=True)
def inside_car(rig_from_plan: Any, own_car: Any, x: float, y: float, z: float) -> bool:
    """Return whether a place of the plan frame lies in a rectangle (2, 2) of the rig's x and y, lowest first."""
    for i in range(2):
        m = rig_from_plan[i]
        if not own_car[0, i] < m[0] * x + m[1] * y + m[2] * z + m[3] < own_car[1, i]:
            return False
    return True


@uncounted(forceinline=True)
def find_pixel(
    rgb: Any, usable: Any, has_mask: bool, cam_from_plan: Any, rig_from_plan: Any, own_car: Any, kind: int,
    params: Any, x: float, y: float, z: float, dx: float, dy: float, above: float, work: Any,
    pixel: Any,
) -> bool:  # fmt: skip
    """Find the pixel that shows a place; False where none does."""
    m = cam_from_plan
    a = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
    b = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
    c = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
    if not project(kind, params, a, b, c, work, pixel):
        return False
    if not shows(rgb, usable, has_mask, pixel[0], pixel[1]):
        return False
    return not hidden_by_car(rig_from_plan, own_car, x, y, z, dx, dy, above)


@uncounted(forceinline=True)
def shows(rgb: Any, usable: Any, has_mask: bool, u: float, v: float) -> bool:
    """Return whether a pixel is in the image, and usable."""
    if not (0.0 <= u < rgb.shape[1] and 0.0 <= v < rgb.shape[0]):
        return False
    return bool(not has_mask or usable[int(v), int(u)])


@uncounted(forceinline=True)
def hidden_by_car(
    rig_from_plan: Any, own_car: Any, x: float, y: float, z: float, dx: float, dy: float, above: float
) -> bool:
    """Return whether a place, or what is over it on the line of sight, lies in the car's rectangle."""
    over = OWN_CAR_LEVEL
    return bool(
        inside_car(rig_from_plan, own_car, x, y, z)
        or inside_car(rig_from_plan, own_car, x - over * dx, y - over * dy, z + over * above)
    )


@uncounted(forceinline=True)
def sample(rgb: Any, u: float, v: float, gain: Any, out: Any) -> None:
    """Bilinear colour at a pixel position whose top left pixel has its centre at (0.5, 0.5)."""
    height, width = rgb.shape[0], rgb.shape[1]
    x = max(min(u - 0.5, width - 1.0), 0.0)
    y = max(min(v - 0.5, height - 1.0), 0.0)
    i, j = int(y), int(x)
    below, right = min(i + 1, height - 1), min(j + 1, width - 1)
    a, b = y - i, x - j
    for k in range(3):
        top = rgb[i, j, k] * (1 - b) + rgb[i, right, k] * b
        bottom = rgb[below, j, k] * (1 - b) + rgb[below, right, k] * b
        value = gain[k] * (top * (1 - a) + bottom * a) + 0.5
        out[k] = int(min(max(value, 1.0), 255.0))
