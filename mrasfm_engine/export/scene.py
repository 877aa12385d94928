"""Writes a scene's files, checks them, and puts them in place.

A scene's folder holds `model/` (COLMAP, binary; `model/text/` the same as text), `points.ply`, `poses.tum`,
`poses.json`, `calibration.json`, `frame.json`, `features.db`, `manifest.json` (the drive's, in the engine's axes: the
scene can be aggregated without the drive), `pictures/` where any were drawn, `own_car/` where a camera shows the
vehicle itself, `road.json` where the road was found, `components/N/` with a scene for each part of the drive that
nothing links to this one, what other programs read (`export.interchange`), `report.html`, and `report.json`. One
with a `report.json` is complete.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np

from mrasfm_engine.errors import CancelledError, MrasfmError
from mrasfm_engine.export import (
    calibration,
    colmap,
    comparisons,
    coordinate_frame,
    feature_database,
    interchange,
    picture_files,
    ply,
    pose_files,
    readers,
    road,
)
from mrasfm_engine.export.check import (
    Check,
    ReadBack,
    binary_model_checks,
    common_checks,
    completing_checks,
)
from mrasfm_engine.export.colmap_io import ModelRead
from mrasfm_engine.export.file_contents import write_content
from mrasfm_engine.export.interchange import Interchange
from mrasfm_engine.export.picture_files import PictureFiles
from mrasfm_engine.export.publishing import COMPLETE_MARK, publishing, require_space
from mrasfm_engine.export.report_page import scene_page, write_page
from mrasfm_engine.export.text_model import TextModel, write_text_model
from mrasfm_engine.io.images import mask_png
from mrasfm_engine.io.plain_json import plain
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.types import Bools, Floats, Ints
from schemas.artifacts import (
    COMPONENTS_FOLDER,
    OWN_CAR_FOLDER,
    PICTURES_FOLDER,
    REPORT_PAGE,
    RIG_FOLDER,
    component_folder,
)

Draw = Callable[[], PictureFiles]
ROAD_FILE = "road.json"
MANIFEST_FILE = "manifest.json"
REPLACED = (PICTURES_FOLDER, OWN_CAR_FOLDER, ROAD_FILE, COMPONENTS_FOLDER, REPORT_PAGE, *interchange.OPTIONAL)


def no_pictures() -> PictureFiles:
    """The files of `pictures/` where none are drawn."""
    return {}


def write_scene(
    scene: Scene,
    out: Path,
    report: Mapping[str, Any],
    draw: Draw = no_pictures,
    components: Sequence[tuple[Scene, Mapping[str, Any]]] = (),
) -> None:
    """Write all files of a scene into the folder `out`.

    They are written into a temporary folder, read back and compared with the scene, and only then moved: an interrupted
    or failed run leaves nothing half-written. A new folder appears at once; into an existing one the files move one by
    one, its old `report.json` goes first and the new one comes last. Other files in it are kept.

    Parameters
    ----------
    report
        What `report.json` holds besides a `summary`; JSON values, numpy scalars and arrays, paths. `draw` may add to
        it.
    draw
        Makes the files of `pictures/` by name, large ones on the disk of `out`, while a thread writes and reads files
        that do not need them; those of an earlier scene there are removed.
    components
        Parts of the drive that nothing links to the scene, each in a frame of its own, with their reports: scenes in
        `components/1`, `components/2` and so on.

    Raises
    ------
    StorageError
        Where the disk is full or cannot be written.
    MrasfmError
        Where the scene contradicts itself, or a file that was written does not read back.
    """
    scenes = [scene, *(other for other, _ in components)]
    for one in scenes:
        check_scene(one)
    with publishing(out, sum(map(_size_bytes, scenes)), replaced=REPLACED) as work:
        parts = _Parts(units=[other.unit_registered for other, _ in components], listed=component_list(scenes))
        still_needed = sum(_size_bytes(other) for other, _ in components)

        def draw_what_fits() -> PictureFiles:
            pictures = draw()
            require_space(picture_files.size_bytes(pictures) + still_needed, work, what=out)
            return pictures

        _write(scene, work, report, draw_what_fits, parts)
        for number, (other, own_report) in enumerate(components, start=1):
            folder = work / component_folder(number)
            folder.mkdir(parents=True)
            _write(other, folder, own_report)


def component_list(scenes: Sequence[Scene]) -> list[dict[str, Any]]:
    """`components` of a scene's report: of the scene itself, and of those in its folder `components/`.

    Each has its number, what it has of units and points, and where its files are. Components of one folder share its
    frame.
    """
    found = [
        {
            "component": int(number),
            "folder": component_folder(at) if at else ".",
            "georeferenced": scene.georeference is not None,
            "registered_units": int((scene.unit_registered & (scene.unit_component == number)).sum()),
            "registered_images": int(
                (scene.image_registered & (scene.unit_component[scene.image_unit] == number)).sum()
            ),
            "points": int((scene.point_component == number).sum()),
        }
        for at, scene in enumerate(scenes)
        for number in np.unique(scene.unit_component[scene.unit_registered])
    ]
    return sorted(found, key=lambda one: one["component"])


def summary(scene: Scene) -> dict[str, Any]:
    """The figures of `report.json`'s `summary`."""
    figures: dict[str, Any] = {
        "georeferenced": scene.georeference is not None,
        "registered_units": int(scene.unit_registered.sum()),
        "total_units": len(scene.unit_registered),
        "registered_images": int(scene.image_registered.sum()),
        "total_images": len(scene.image_registered),
        "points": len(scene.points_m),
        "observations": len(scene.observation_point),
        "notes": list(scene.notes),
    }
    if len(scene.points_m):
        figures["mean_track_length"] = len(scene.observation_point) / len(scene.points_m)
        figures["mean_reprojection_error_px"] = float(scene.point_error_px.mean())
    return figures


@dataclass(frozen=True, kw_only=True)
class _Parts:
    """Parts of the drive that are scenes of their own: their units, and the report's list of all."""

    units: Sequence[Bools] = ()
    listed: Sequence[Mapping[str, Any]] | None = None


def _write(
    scene: Scene, work: Path, report: Mapping[str, Any], draw: Draw = no_pictures, parts: _Parts = _Parts()
) -> None:
    read_back = ReadBack(work)
    with ThreadPoolExecutor(1) as pool:
        stopped = Event()
        beside = pool.submit(_write_beside_pictures, scene, work, parts, report.get("component", 0), read_back, stopped)
        try:
            pictures = draw()
        except BaseException:
            stopped.set()
            raise
        figures, calibrated = beside.result()
    picture_files.write_pictures(pictures, work / PICTURES_FOLDER)
    document = {**report, **({} if parts.listed is None else {"components": parts.listed}), "summary": figures}
    make_page = partial(scene_page, scene, work, document, calibrated)
    figures["notes"] += write_page(work, make_page, read_back, {"": calibrated})
    read_back.expect({COMPLETE_MARK: write_json(work / COMPLETE_MARK, document)})
    read_back.check(completing_checks(pictures))
    read_back.require_all()


def _write_beside_pictures(
    scene: Scene, work: Path, parts: _Parts, component: int, read_back: ReadBack, stopped: Event
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Write and read all files that need no pictures; the report's `summary`, and `calibration.json`.

    Raises
    ------
    CancelledError
        Between two files, once `stopped` is set.
    """
    figures = _write_model(scene, work, read_back)
    # COLMAP reads and writes for half of the time, in processes of its own.
    with ThreadPoolExecutor(1) as pool:
        of_model = pool.submit(_check_model, scene, work, read_back, partial(_require_going_on, stopped))
        try:
            calibrated = _write_others(scene, work, parts, component, read_back, stopped, figures)
        except BaseException:
            stopped.set()
            raise
        of_model.result()
    return figures, calibrated


def _write_others(
    scene: Scene,
    work: Path,
    parts: _Parts,
    component: int,
    read_back: ReadBack,
    stopped: Event,
    figures: dict[str, Any],
) -> dict[str, Any]:
    """Write and read the other files but the model and the points; `calibration.json`."""
    _require_going_on(stopped)
    names = [scene.drive.manifest.name] * len(scene.unit_registered)
    others = Interchange(scene=scene, scene_of_unit=names, rigs={RIG_FOLDER: ""})
    figures["notes"] += others.write(work, read_back)
    _require_going_on(stopped)
    picture_files.write_pictures(_own_car_files(scene), work / OWN_CAR_FOLDER)
    digests = {"features.db": feature_database.write_features(scene, work / "features.db")}
    if scene.road is not None:
        digests[ROAD_FILE] = write_json(work / ROAD_FILE, road.road_document(scene))
    digests["poses.tum"] = write_content(work / "poses.tum", pose_files.poses_text(scene))
    digests["poses.json"] = write_json(
        work / "poses.json", pose_files.poses_document(scene, parts.units), in_lines=pose_files.LISTS
    )
    calibrated = calibration.calibration_document(scene, component)
    digests["calibration.json"] = write_json(work / "calibration.json", calibrated)
    digests["frame.json"] = write_json(work / "frame.json", coordinate_frame.frame_document(scene))
    manifest = scene.drive.manifest.model_dump_json(exclude_none=True)
    digests[MANIFEST_FILE] = write_content(work / MANIFEST_FILE, manifest + "\n")
    read_back.expect(digests)
    for check in _checks(scene):
        _require_going_on(stopped)
        read_back.check([check])
    return calibrated


def _require_going_on(stopped: Event) -> None:
    if stopped.is_set():
        raise CancelledError


def write_common(scene: Scene, work: Path, read_back: ReadBack) -> dict[str, Any]:
    """Write what scenes and maps have alike: model and points; the figures of `report.json`'s `summary`."""
    figures = _write_model(scene, work, read_back)
    _check_model(scene, work, read_back)
    return figures


def _write_model(scene: Scene, work: Path, read_back: ReadBack) -> dict[str, Any]:
    """Write the binary model and the points; the report's `summary`."""
    model, figures = work / "model", summary(scene)
    model.mkdir()
    read_back.expect({f"model/{name}": digest for name, digest in colmap.write_model(scene, model).items()})
    if not colmap.text_model_fits(scene):
        figures["notes"].append("model/text is withheld: COLMAP's text format cannot hold image names with spaces")
    read_back.expect({"points.ply": ply.write_ply(scene, work / "points.ply")})
    return figures


def _check_model(
    scene: Scene, work: Path, read_back: ReadBack, require_going_on: Callable[[], None] = lambda: None
) -> None:
    """Read the binary model, and let COLMAP make the text model of it, which is read too."""
    if not colmap.text_model_fits(scene):
        read_back.check(binary_model_checks(scene))
        return
    text, made = work / "model" / "text", list[TextModel]()

    def read_and_translate(folder: Path) -> ModelRead:
        text.mkdir()
        made.append(write_text_model(folder, text))
        read_back.expect({f"model/text/{name}": digest for name, digest in made[0].digests.items()})
        return made[0].binary

    text_check = Check("model/text", lambda folder: made[0].require_equal(), comparisons.nothing)
    for check in (*binary_model_checks(scene, read_and_translate), text_check):
        require_going_on()
        read_back.check([check])


def _checks(scene: Scene) -> list[Check]:
    road_check = Check(ROAD_FILE, readers.json_object, partial(comparisons.road, scene))
    registered = np.flatnonzero(scene.unit_registered)
    return [
        *common_checks(scene),
        *([] if scene.road is None else [road_check]),
        *(
            Check(f"{OWN_CAR_FOLDER}/{name}", Path.read_bytes, partial(comparisons.content, data))
            for name, data in _own_car_files(scene).items()
        ),
        Check("features.db", readers.database, partial(comparisons.features, scene)),
        Check("poses.tum", readers.tum, partial(comparisons.tum, scene, registered)),
        Check("calibration.json", readers.json_object, partial(comparisons.calibration, scene)),
        Check(MANIFEST_FILE, readers.manifest, partial(comparisons.manifest, scene)),
    ]


def _own_car_files(scene: Scene) -> dict[str, bytes]:
    """PNG files by name: of each camera that shows the own car."""
    return {
        f"{camera.name}.png": mask_png(mask.astype(np.uint8) * 255).tobytes()
        for camera, mask in zip(scene.drive.cameras, scene.own_cars, strict=True)
        if mask is not None
    }


def write_json(path: Path, document: Mapping[str, Any], *, in_lines: Sequence[str] = ()) -> str:
    """Write a JSON document; the SHA-256 of its text.

    Of lists named `in_lines` every entry has one line: Python's encoder writes them ten times as fast.

    Raises
    ------
    MrasfmError
        Where a value has no JSON form.
    """
    try:
        text = _in_lines(document, in_lines) if in_lines else _encode(document, indent=1)
    except (TypeError, ValueError) as error:
        raise MrasfmError(
            f"{path.name} cannot be written: {error}",
            remedy="This is a defect of mrasfm, please report it.",
            code="export-check-failed",
        ) from error
    return write_content(path, text + "\n")


def _encode(value: Any, *, indent: int | None = None) -> str:
    return json.dumps(value, allow_nan=False, indent=indent, ensure_ascii=False, default=plain)


def _in_lines(document: Mapping[str, Any], lists: Sequence[str]) -> str:
    """JSON with a line for each value, and for each entry of some `lists`."""
    lines = []
    for key, value in document.items():
        text = "[\n  " + ",\n  ".join(map(_encode, value)) + "\n ]" if key in lists else _encode(value)
        lines.append(f" {_encode(key)}: {text}")
    return "{\n" + ",\n".join(lines) + "\n}"


def _size_bytes(scene: Scene) -> int:
    """About what the files take, with the database's write-ahead log."""
    keypoints = sum(len(f.xy_px) for f in scene.features)
    matches = sum(len(p.matches) for p in scene.pairs)
    other = 360 * len(scene.points_m) + 300 * len(scene.drive.images)
    return 2 * (140 * keypoints + 20 * matches) + 80 * keypoints + other + 2_000_000


def check_scene(scene: Scene) -> None:
    """Refuse a scene whose arrays contradict each other before anything is written."""
    for what, right in _consistency(scene):
        if not right:
            raise MrasfmError(
                f"the scene contradicts itself: {what}",
                remedy="This is a defect of mrasfm, please report it.",
                code="inconsistent-scene",
            )


def _consistency(scene: Scene) -> Iterator[tuple[str, bool]]:
    """Conditions that a scene must meet, and whether it does; a later check relies on the earlier ones."""
    images, units, points = len(scene.drive.images), len(scene.drive.manifest.frames), len(scene.points_m)
    shapes = [
        (scene.world_from_rig.shape, (units, 4, 4)),
        (scene.sigma_position_m.shape, (units, 3)),
        (scene.unit_registered.shape, (units,)),
        (scene.image_registered.shape, (images,)),
        (scene.point_colors.shape, (points, 3)),
        (scene.point_error_px.shape, (points,)),
        (scene.point_classes.shape, (points,)),
        (scene.point_patches.shape, (points,)),
        (len(scene.calibration), len(scene.drive.cameras)),
    ]
    unit = np.array([image.unit for image in scene.drive.images], dtype=np.int64)
    sizes = np.array([len(features.xy_px) for features in scene.features], dtype=np.int64)
    point, image, keypoint = scene.observation_point, scene.observation_image, scene.observation_keypoint
    yield "array sizes do not fit the drive", all(actual == expected for actual, expected in shapes)
    yield "it does not have features for every image", len(sizes) == images
    yield "a registered unit's pose is not finite", _finite(scene.world_from_rig[scene.unit_registered])
    yield "an image is registered without its unit", not (scene.image_registered & ~scene.unit_registered[unit]).any()
    yield "a point is not finite", _finite(scene.points_m) and _finite(scene.point_error_px)
    patches = 0 if scene.road is None else len(scene.road.surface)
    yield "a point lies on no patch of the road", _inside(scene.point_patches.astype(np.int64) + 1, patches + 1)
    yield "an observation names no point", _inside(point, points)
    yield "observations are not sorted by point", not (np.diff(point) < 0).any()
    yield "an observation names no image", _inside(image, images)
    yield "an observation's image is not registered", bool(scene.image_registered[image].all())
    yield "an observation names no keypoint", _inside(keypoint, sizes[image])
    row = (np.cumsum(sizes) - sizes)[image] + keypoint
    yield "a keypoint observes two points", not (np.bincount(row) > 1).any()


def _finite(values: Floats) -> bool:
    return bool(np.isfinite(values).all())


def _inside(values: Ints, stop: int | Ints) -> bool:
    return bool(((values >= 0) & (values < stop)).all())
