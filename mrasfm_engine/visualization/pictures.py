"""All pictures of a scene as PNG files.

They never cost the scene: what cannot be drawn is left out, and the report says why.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from mrasfm_engine.errors import CancelledError, MrasfmError
from mrasfm_engine.export.picture_files import png_of
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.types import Bytes, CountProgress
from mrasfm_engine.visualization.birds_eye import birds_eye
from mrasfm_engine.visualization.road_points import road_points

Pictures = Mapping[str, Bytes]


def draw_pictures(
    scene: Scene, *, seed: int = 0, progress: CountProgress | None = None
) -> tuple[dict[str, bytes], dict[str, Any]]:
    """PNG files by name, and what the report says of them.

    The road from above before and after recalibration, and its points before and after those off it were dropped.

    Parameters
    ----------
    progress
        Called as progress(images done, images); may raise `CancelledError` to stop.
    """

    def from_above() -> tuple[Pictures, dict[str, Any]]:
        drawn = birds_eye(scene, seed=seed, progress=progress)
        return drawn.pictures, drawn.report

    above, above_report = _files(from_above)
    points, points_report = _files(lambda: (road_points(scene), {}))
    report = {"birds_eye": above_report}
    if points_report:
        report["road_points"] = points_report
    return {**above, **points}, report


def _files(draw: Callable[[], tuple[Pictures, dict[str, Any]]]) -> tuple[dict[str, bytes], dict[str, Any]]:
    """All of what is drawn as PNG files, or none of it where anything fails."""
    try:
        pictures, report = draw()
        return {name: png_of(picture) for name, picture in pictures.items()}, report
    except CancelledError:
        raise
    except MrasfmError as error:
        return {}, {"not_drawn": error.what}
    except Exception as error:  # whatever it is: the scene, which is finished, is worth more than its pictures
        return {}, {"not_drawn": f"{type(error).__name__}: {error}"}
