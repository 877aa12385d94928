"""`pictures/road_before.png` and `road_after.png`: the road's points from the side and from above.

Before and after points off the surface were dropped, on the same axes, so that the two can be laid over each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np

from mrasfm_engine.geometry.neighbours import nearest
from mrasfm_engine.scene.road import Road, Thickness
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.types import Bools, Bytes, Floats, Ints
from mrasfm_engine.visualization.drawing import write_text

NAMES = ("road_before.png", "road_after.png")
SIZE_PX = (1600, 1000)
POINT_PX = 3
SIDE_VIEW = (90, 110, 1570, 520)  # left, top, right, bottom
TOP_VIEW = (90, 610, 1570, 900)
ON_SURFACE_M = 0.05  # farther points are coloured as above or below the surface
MARGIN_M = 1.0  # of height above and below the surface in the side view
GREY, PALE = (110, 110, 110), (228, 228, 228)
ON, ABOVE, BELOW, SURFACE, TRAJECTORY = (
    (120, 120, 120),
    (30, 60, 220),
    (200, 90, 20),
    (60, 150, 40),
    (0, 140, 230),
)  # BGR


@dataclass(frozen=True, kw_only=True)
class _Panel:
    """A rectangle of the picture with axes in metres."""

    box: tuple[int, int, int, int]  # left, top, right, bottom
    low: tuple[float, float]  # at left and bottom
    high: tuple[float, float]

    def pixels(self, xy: Floats) -> Ints:
        """Columns and rows (n, 2) of points (n, 2); those outside lie on the border."""
        left, top, right, bottom = self.box
        scaled = (xy - np.array(self.low)) / (np.array(self.high) - np.array(self.low))
        at = np.column_stack([left + scaled[:, 0] * (right - left), bottom - scaled[:, 1] * (bottom - top)])
        result: Ints = np.clip(np.round(at), (left + 2, top + 2), (right - 4, bottom - 4)).astype(np.int64)
        return result

    def frame(self, image: Bytes, *, title: str, x_label: str, y_label: str) -> None:
        """Grid, ticks, labels and border."""
        left, top, right, bottom = self.box
        for value in _ticks(self.low[0], self.high[0], 12):
            column = int(self.pixels(np.array([[value, self.low[1]]]))[0, 0])
            cv2.line(image, (column, top), (column, bottom), PALE, 1)
            write_text(image, f"{value:g}", (column, bottom + 18), align="centre")
        for value in _ticks(self.low[1], self.high[1], 6):
            row = int(self.pixels(np.array([[self.low[0], value]]))[0, 1])
            cv2.line(image, (left, row), (right, row), PALE, 1)
            write_text(image, f"{value:g}", (left - 8, row + 5), align="right")
        cv2.rectangle(image, (left, top), (right, bottom), GREY, 1)
        write_text(image, title, (left, top - 10))
        write_text(image, x_label, ((left + right) // 2, bottom + 40), align="centre")
        write_text(image, y_label, (12, top - 10))

    def scatter(self, image: Bytes, xy: Floats, colour: tuple[int, int, int]) -> None:
        """Points (n, 2) as small squares."""
        for shift in product(range(POINT_PX), repeat=2):
            at = self.pixels(xy) + np.array(shift)
            image[at[:, 1], at[:, 0]] = colour

    def line(self, image: Bytes, xy: Floats, colour: tuple[int, int, int], width: int) -> None:
        """A polyline through points (n, 2)."""
        cv2.polylines(image, [self.pixels(xy).astype(np.int32)], False, colour, width, cv2.LINE_AA)


@dataclass(frozen=True, kw_only=True)
class _Views:
    """The road's points in the coordinates of both panels, and the panels themselves."""

    side: _Panel
    top: _Panel
    side_xy: Floats  # (n, 2): along the trajectory, height
    top_xy: Floats  # (n, 2)
    surface: Floats  # (m, 2) the surface below the trajectory in the side view
    trajectory: Floats  # (m, 2) the trajectory in the view from above
    exaggeration: float
    outside: int  # points that the side view does not reach


def road_points(scene: Scene) -> dict[str, Bytes]:
    """Both pictures (h, w, 3) of the scene's road by file name; none where no road was found."""
    if scene.road is None:
        return {}
    road, trajectory = scene.road, scene.world_from_rig[scene.unit_registered]
    views = _views(road, trajectory)
    everything = np.ones(len(road.before.is_inlier), dtype=np.bool_)
    shown = zip(NAMES, (everything, road.before.is_inlier), ("before", "after"), strict=True)
    return {name: np.ascontiguousarray(_draw(road, views, points, what)[..., ::-1]) for name, points, what in shown}


def _views(road: Road, world_from_rig: Floats) -> _Views:
    axes, before = road.surface.axes, road.before
    trajectory = world_from_rig[:, :3, 3] @ axes.T
    points = before.points_m @ axes.T
    steps = np.linalg.norm(np.diff(trajectory[:, :2], axis=0), axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    along = _along(trajectory, travelled, world_from_rig[:, :3, 0] @ axes.T, points)
    ground = trajectory[:, 2] - road.rig_height_m * (world_from_rig[:, :3, 2] @ axes.T)[:, 2]
    zero = ground[0]
    # The trajectory's own height: where a patch is, the surface's.
    offset, _ = road.surface.locate(np.column_stack([trajectory[:, :2], ground]) @ axes)
    surface = np.column_stack([travelled, np.where(np.isfinite(offset), ground - offset, ground) - zero])
    kept = before.is_inlier & np.isfinite(before.distance_m)
    shown = np.concatenate([points[kept, 2] - zero, surface[:, 1]])
    reach = np.percentile(along[kept], [0.5, 99.5]) if kept.any() else np.array([0.0, 1.0])
    low = (float(min(reach[0], 0.0)) - 1.0, float(np.percentile(shown, 0.5)) - MARGIN_M)
    high = (float(max(reach[1], travelled[-1])) + 1.0, float(np.percentile(shown, 99.5)) + MARGIN_M)
    side = _Panel(box=SIDE_VIEW, low=low, high=high)
    top_axes = _along_the_picture(trajectory[:, :2])
    middle = trajectory[:, :2].mean(0)
    top_xy, top_trajectory = (points[:, :2] - middle) @ top_axes.T, (trajectory[:, :2] - middle) @ top_axes.T
    height = points[:, 2] - zero
    return _Views(
        side=side,
        top=_equal_scale(TOP_VIEW, np.concatenate([top_xy[kept], top_trajectory])),
        side_xy=np.column_stack([along, height]),
        top_xy=top_xy,
        surface=surface,
        trajectory=top_trajectory,
        exaggeration=_exaggeration(side),
        outside=int(((height < low[1]) | (height > high[1]) | (along < low[0]) | (along > high[0])).sum()),
    )


def _along(trajectory: Floats, travelled: Floats, forward: Floats, points: Floats) -> Floats:
    """Distance along the trajectory (n,) of points: that of the nearest pose, and their lead over it."""
    pose = nearest(trajectory[:, :2], points[:, :2])[1][:, 0]
    ahead = ((points[:, :2] - trajectory[pose, :2]) * forward[pose, :2]).sum(1)
    result: Floats = travelled[pose] + ahead
    return result


def _along_the_picture(trajectory: Floats) -> Floats:
    """Axes (2, 2) of the view from above: the trajectory's longest extent to the right."""
    _, vectors = np.linalg.eigh(np.cov(trajectory.T) if len(trajectory) > 1 else np.eye(2))
    right = vectors[:, 1]
    if right @ (trajectory[-1] - trajectory[0]) < 0:
        right = -right
    return np.array([right, [-right[1], right[0]]])


def _equal_scale(box: tuple[int, int, int, int], xy: Floats) -> _Panel:
    """A panel around points (n, 2) whose two axes have one scale."""
    low, high = np.percentile(xy, 0.5, axis=0) - 1.0, np.percentile(xy, 99.5, axis=0) + 1.0  # a few may be far away
    size = np.array([box[2] - box[0], box[3] - box[1]], dtype=np.float64)
    scale = ((high - low) / size).max()
    middle = (low + high) / 2
    low, high = middle - scale * size / 2, middle + scale * size / 2
    return _Panel(box=box, low=(float(low[0]), float(low[1])), high=(float(high[0]), float(high[1])))


def _exaggeration(panel: _Panel) -> float:
    left, top, right, bottom = panel.box
    across = (right - left) / (panel.high[0] - panel.low[0])
    return float((bottom - top) / (panel.high[1] - panel.low[1]) / across)


def _draw(road: Road, views: _Views, shown: Bools, what: str) -> Bytes:
    image: Bytes = np.full((SIZE_PX[1], SIZE_PX[0], 3), 255, np.uint8)
    distance = road.before.distance_m
    thickness = Thickness.from_distances(distance[shown])
    write_text(image, f"Road points {what} those off the surface were dropped", (90, 34), size=0.8)
    write_text(
        image,
        f"{int(shown.sum())} points, told by {road.source}; thickness {100 * thickness.range90_m:.1f} cm "
        f"(5th to 95th percentile of signed distances), spread {100 * thickness.spread_m:.1f} cm (1.4826 MAD); "
        f"{len(road.surface)} patches",
        (90, 62),
    )
    _legend(image)
    views.side.frame(
        image,
        title=f"from the side, heights {views.exaggeration:.0f} times exaggerated"
        + (f"; {views.outside} points of both pictures lie outside, on the border" if views.outside else ""),
        x_label="along the vehicle's trajectory [m]",
        y_label="height [m]",
    )
    views.top.frame(
        image,
        title="from above, equal scales",
        x_label="along the longest extent of the trajectory [m]",
        y_label="across [m]",
    )
    on = shown & ~(np.abs(distance) > ON_SURFACE_M)
    for marks, colour in (
        (on, ON),
        (shown & (distance > ON_SURFACE_M), ABOVE),
        (shown & (distance < -ON_SURFACE_M), BELOW),
    ):
        views.side.scatter(image, views.side_xy[marks], colour)
        views.top.scatter(image, views.top_xy[marks], colour)
    views.side.line(image, views.surface, SURFACE, 2)
    views.top.line(image, views.trajectory, TRAJECTORY, 2)
    return image


def _legend(image: Bytes) -> None:
    column = 90
    for colour, text in (
        (ON, f"within {100 * ON_SURFACE_M:.0f} cm of the surface"),
        (ABOVE, "above it"),
        (BELOW, "below it"),
        (SURFACE, "the surface below the trajectory"),
        (TRAJECTORY, "the vehicle's trajectory"),
    ):
        cv2.rectangle(image, (column, 972), (column + 14, 986), colour, -1)
        write_text(image, text, (column + 22, 985))
        column += 60 + 10 * len(text)


def _ticks(low: float, high: float, most: int) -> Floats:
    """Round values between two limits, at most about so many."""
    raw = (high - low) / most
    power = 10.0 ** np.floor(np.log10(raw))
    step = next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= raw)
    result: Floats = np.round(np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step, 9)
    return result
