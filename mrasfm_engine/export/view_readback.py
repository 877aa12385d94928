"""Reader of `view.json` and its comparison with the scene, for the check before it is put in place.

Coordinates are computed by pyproj from the scene's place on the earth, and observations are read from `model/` at the
places that the document names.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pyproj import CRS, Transformer

from mrasfm_engine.export.comparisons import Row, Rows
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.types import Floats, Ints

ROUNDED_M = 2e-3
PIXEL_TOLERANCE = 1e-3
NO_POINT = 2**64 - 1
KEYPOINT = np.dtype([("xy_px", "<f8", 2), ("point", "<u8")])


class View(NamedTuple):
    """A document, and the keypoints of its images by file."""

    document: dict[str, Any]
    keypoints: dict[tuple[str, str], np.ndarray[Any, Any]]


def read_view(path: Path) -> View:
    """A document and what it names."""
    document = json.loads(path.read_text(encoding="utf-8"))
    data = (path.parent / document["observations"]).read_bytes()
    keypoints = {}
    for scene in document["scenes"]:
        for image in scene["images"]:
            at, count = image["observations"]
            keypoints[scene["name"], image["file"]] = np.frombuffer(data, KEYPOINT, count, at)
    return View(document, keypoints)


def view(scene: Scene, read: View) -> Rows:
    """A document beside the scene."""
    document = read.document
    units = [unit for one in document["scenes"] for unit in one["units"]]
    yield Row("registered units", sorted(units), np.flatnonzero(scene.unit_registered).tolist())
    found = _places([position for one in document["scenes"] for position in one["trajectory_m"]], document)
    wanted = _expected(scene, scene.world_from_rig[np.array(units, dtype=np.int64), :3, 3], document)
    yield Row("positions agree", bool(np.abs(found - wanted).max(initial=0.0) < ROUNDED_M), True)
    by_name = {image.file: index for index, image in enumerate(scene.drive.images)}
    shown, centres, observed = [], [], list[np.ndarray[Any, Any]]()
    for one in document["scenes"]:
        for image in one["images"]:
            file = image["file"] if image["file"] in by_name else f"{one['name']}/{image['file']}"
            shown.append(by_name[file])
            centres.append(image["frustum_m"][0])
            keypoints = read.keypoints[one["name"], image["file"]]
            observed.append(keypoints[keypoints["point"] != NO_POINT])
    yield Row("registered images", sorted(shown), np.flatnonzero(scene.image_registered).tolist())
    yield from _observations(scene, np.array(shown, dtype=np.int64), observed)
    wanted = _expected(scene, scene.world_from_cam[np.array(shown, dtype=np.int64), :3, 3], document)
    difference = np.abs(_places(centres, document) - wanted).max(initial=0.0)
    yield Row("centres of the cameras agree", bool(difference < ROUNDED_M), True)


def _observations(scene: Scene, images: Ints, observed: Sequence[np.ndarray[Any, Any]]) -> Rows:
    """Keypoints that observe a point, of each of some images (n,), beside the scene's observations."""
    counts = np.bincount(scene.observation_image, minlength=len(scene.drive.images))
    yield Row("the numbers of the images' observations", [len(rows) for rows in observed], counts[images].tolist())
    if not counts[images].any():
        return
    found = np.concatenate(observed)
    found = found[np.lexsort((found["point"], np.repeat(images, counts[images])))]
    mine = np.lexsort((scene.observation_point, scene.observation_image))
    of_image = np.split(scene.observation_keypoint[mine], np.cumsum(counts)[:-1])
    seen = [scene.features[i].xy_px[of_image[i]] for i in np.flatnonzero(counts)]
    yield Row("pixels of the observations", found["xy_px"], np.concatenate(seen), PIXEL_TOLERANCE)


def _places(positions: list[list[float]], document: dict[str, Any]) -> Floats:
    places: Floats = np.array(positions, dtype=np.float64).reshape(-1, 3) + np.array(document["offset_m"])
    return places


def _expected(scene: Scene, points_m: Floats, document: dict[str, Any]) -> Floats:
    if scene.georeference is None:
        return points_m
    to_utm = Transformer.from_crs("EPSG:4978", CRS.from_epsg(document["epsg"]).to_3d(), always_xy=True)
    matrix = scene.georeference.ecef_from_local
    earth = points_m @ matrix[:3, :3].T + matrix[:3, 3]
    return np.column_stack(to_utm.transform(*earth.T))
