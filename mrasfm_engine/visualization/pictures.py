"""All pictures of a scene as PNG files.

They never cost the scene: what cannot be drawn is left out, and the report says why.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from mrasfm_engine.errors import CancelledError, MrasfmError
from mrasfm_engine.export.picture_files import LargeFile, png_of
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.types import Bytes, CountProgress
from mrasfm_engine.visualization.birds_eye import birds_eye
from mrasfm_engine.visualization.road_picture import TIFF
from mrasfm_engine.visualization.road_points import road_points

Drawn = tuple[Mapping[str, Bytes], Mapping[str, bytes | LargeFile], dict[str, Any]]  # pictures, other files, report


def draw_pictures(
    scene: Scene, *, scratch: Path | None = None, seed: int = 0, progress: CountProgress | None = None
) -> tuple[dict[str, bytes | LargeFile], dict[str, Any]]:
    """Files by name, and what the report says of them.

    The road from above before and after recalibration and as one picture of the best views, and its points before and
    after those off it were dropped.

    Parameters
    ----------
    scratch
        An empty folder on the disk of the result; without one there is no picture of the best views.
    progress
        Called as progress(images done, images); may raise `CancelledError` to stop.
    """
    road: dict[str, Any] = {}

    def from_above() -> Drawn:
        drawn = birds_eye(scene, seed=seed, progress=progress, scratch=scratch)
        road.update(drawn.road_report)
        return drawn.pictures, drawn.files, drawn.report

    # The points' picture needs one core for a while that the road's leaves idle.
    with ThreadPoolExecutor(1) as pool:
        beside = pool.submit(_files, lambda: (road_points(scene), {}, {}))
        above, above_report = _files(from_above)
        points, points_report = beside.result()
    if "not_drawn" in above_report:
        if road and "not_drawn" not in road:
            road = {"not_drawn": above_report["not_drawn"]}  # its files are left out with the others
        if scratch is not None:
            (scratch / TIFF).unlink(missing_ok=True)  # the scene may need its space
    report = {"birds_eye": above_report, "road": road, "road_points": points_report}
    return {**above, **points}, {name: part for name, part in report.items() if part or name == "birds_eye"}


def _files(draw: Callable[[], Drawn]) -> tuple[dict[str, bytes | LargeFile], dict[str, Any]]:
    """All of what is drawn as files, or none of it where anything fails."""
    try:
        pictures, files, report = draw()
        with ThreadPoolExecutor(max(len(pictures), 1)) as pool:
            pngs = dict(zip(pictures, pool.map(png_of, pictures.values()), strict=True))
        return {**pngs, **files}, report
    except CancelledError:
        raise
    except MrasfmError as error:
        return {}, {"not_drawn": error.what}
    except Exception as error:  # whatever it is: the scene, which is finished, is worth more than its pictures
        return {}, {"not_drawn": f"{type(error).__name__}: {error}"}
