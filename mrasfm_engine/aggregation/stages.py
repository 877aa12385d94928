"""The stages of an aggregation. What takes long, seams, is kept by what it depends on and not done again."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mrasfm_engine import __version__
from mrasfm_engine.aggregation.association import Association, associate, coarse_transform
from mrasfm_engine.aggregation.load import components_of, like_named, not_georeferenced, read_scene
from mrasfm_engine.aggregation.scales import SceneScale, find_scale, stated_sigma
from mrasfm_engine.aggregation.seam import Seam, find_seam
from mrasfm_engine.aggregation.source import SourceScene
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import CancelledError, InputError
from mrasfm_engine.io.stage_store import StageStore, fingerprint
from mrasfm_engine.registry import Components, load_components
from mrasfm_engine.types import CountProgress, StageProgress
from schemas.artifacts import (
    MAP_FILE,
    SCALES_CHECKPOINT,
    SCENES_FOLDER,
    SEAMS_FOLDER,
    Stage,
    drive_of_scene,
    seam_checkpoint,
    seam_name,
)
from schemas.findings import Finding, as_json, listed, warning

FAR_APART_M = 50_000.0
MIN_DRIVES = 2
SEAM_VERSION, SCALES_VERSION = 8, 2  # see `mrasfm_engine.stages.VERSIONS`


@dataclass
class Run:
    """One aggregation under way."""

    config: EngineConfig
    store: StageStore  # finished stages of this folder
    into: Path | None  # the map that is extended
    progress: StageProgress
    cancel: Callable[[], bool]
    report: dict[str, Any] = field(
        default_factory=lambda: {"engine_version": __version__, "stages": [], "findings": [], "left_out": []}
    )

    @cached_property
    def components(self) -> Components:
        """The matcher; its model is loaded at the first use, once."""
        return load_components(self.config, None, self.cancel)

    @cached_property
    def extended(self) -> dict[str, Any] | None:
        """`map.json` of the map that is extended; None where a new one is made."""
        return None if self.into is None else map_document(self.into)

    def step(self, stage: Stage) -> CountProgress:
        """The progress callback of a stage."""
        return lambda done, total: self.progress(stage, done, total)

    def begin(self, stage: Stage) -> None:
        """Tell that a stage begins, of which nothing is done yet."""
        self.progress(stage, 0, 0)

    def ended(self, stage: Stage, started_s: float, **figures: Any) -> None:
        """Note a stage in the report."""
        seconds = round(time.perf_counter() - started_s, 3)
        self.report["stages"].append({"stage": stage, "seconds": seconds, "reused": False, **figures})
        self.progress(stage, 1, 1)
        if self.cancel():
            raise CancelledError

    def found(self, finding: Finding) -> None:
        """Note a finding."""
        self.report["findings"].append(as_json(finding))


def scenes(
    run: Run, folders: Mapping[str, Path], remove: Sequence[str], *, leave_out: bool = False
) -> list[SourceScene]:
    """All scenes of the map, those that it has already too; checked against one another."""
    started = time.perf_counter()
    run.begin(Stage.SCENES)
    before = {} if run.into is None or run.extended is None else _scenes_of_map(run.into, run.extended)
    for number, name in enumerate(remove):
        if not _named(name, before) or name in remove[:number]:
            what = "given to --remove twice" if name in remove[:number] else f"not in the map {run.into}"
            raise InputError(
                f"scene {name} is {what}",
                remedy=f"The map has {', '.join(sorted(before)) or 'no scenes'}." if before else "Give --into MAP.",
                code="no-such-scene",
            )
    kept = {name: scene for name, scene in before.items() if not any(_named(gone, [name]) for gone in remove)}
    result = list(kept.values())
    unfit: dict[str, InputError] = {}
    coming = {name: folder for one in folders.items() for name, folder in _with_components(*one).items()}
    for done, (name, folder) in enumerate(coming.items(), 1):
        if (alike := like_named(name, [*kept, *map(drive_of_scene, kept)])) is not None:
            raise InputError(
                f"the map {run.into} has a scene called {alike} already",
                remedy="Remove it first (--remove), or give the new one another name: NAME=FOLDER.",
                code="duplicate-scene",
            )
        try:
            result.append(read_scene(folder, name))
        except InputError as error:
            if not leave_out and not _is_small_component(name, error):
                raise
            unfit[name] = error
        run.progress(Stage.SCENES, done, len(coming))
    if unfit and (len(unfit) == len(coming) or _drives(result) < MIN_DRIVES):
        raise next(iter(unfit.values()))
    for name, unfit_because in unfit.items():
        _leave_out(run, name, unfit_because)
    result.sort(key=lambda scene: scene.name)
    if result and not any(scene.is_placed for scene in result):
        raise not_georeferenced(result[0].name)
    _check_together(run, result)
    run.ended(Stage.SCENES, started, scenes=len(result), taken_from_the_map=len(kept))
    return result


def _named(name: str, scenes: Collection[str]) -> list[str]:
    """Scenes of these that a name means: the one called so, and the components of the drive of that name."""
    return [scene for scene in scenes if name in (scene, drive_of_scene(scene))]


def _with_components(name: str, folder: Path) -> dict[str, Path]:
    return {name: folder, **components_of(folder, name)}


def _is_small_component(name: str, error: InputError) -> bool:
    """Return whether a scene is one of those components that are too small for a map, as some of a drive are."""
    return name != drive_of_scene(name) and error.code == "empty-scene"


def _drives(scenes: Iterable[SourceScene]) -> int:
    """Count the drives that scenes are of: components of one drive count once."""
    return len({drive_of_scene(scene.name) for scene in scenes})


def _leave_out(run: Run, name: str, because: InputError) -> None:
    """Note that a scene is not in the map."""
    run.report["left_out"].append({"scene": name, "code": because.code, "what": because.what, "remedy": because.remedy})
    run.found(warning("scene-left-out", f"scene {name} is not in the map: {because.what}", because.remedy))


def without_unplaced(
    run: Run,
    found: Sequence[SourceScene],
    seams: Sequence[Seam],
    chains: Iterable[Sequence[int]],
    *,
    leave_out: bool,
    require_components: bool,
) -> list[int]:
    """Indices of the scenes that the map can place: by positions, or by seams with scenes that have some.

    The others are noted with the best reason that their seams give.

    Parameters
    ----------
    chains
        Indices of scenes that seams connect.
    leave_out, require_components
        See `pipeline.aggregate`.

    Raises
    ------
    InputError
        Where nothing places a scene that must not be left out, or fewer drives are left than a map needs.
    """
    lost = sorted(k for chain in chains if not any(found[i].is_placed for i in chain) for k in chain)
    errors = {k: not_georeferenced(found[k].name, f", and no seam places it: {_tried(found[k], seams)}") for k in lost}
    for k, error in errors.items():
        is_component = found[k].name != drive_of_scene(found[k].name)
        if require_components if is_component else not leave_out:
            raise error
        _leave_out(run, found[k].name, error)
    kept = [k for k in range(len(found)) if k not in errors]
    if errors and _drives(found[k] for k in kept) < MIN_DRIVES:
        raise next(iter(errors.values()))
    return kept


def _tried(scene: SourceScene, seams: Sequence[Seam]) -> str:
    """Reasons that were found against the seams of a scene, in words."""
    ends = [(seam, seam.b if seam.a == scene.name else seam.a) for seam in seams if scene.name in (seam.a, seam.b)]
    reasons = [
        f"with {other}: {'accepted, but that one is not placed either' if seam.accepted else seam.reason}"
        for seam, other in ends
    ]
    return listed(reasons) if reasons else "no scene is like it"


def _scenes_of_map(folder: Path, document: Mapping[str, Any]) -> dict[str, SourceScene]:
    store, result = StageStore(folder / SCENES_FOLDER), {}
    for entry in document["scenes"]:
        found = store.load(entry["name"], entry["fingerprint"])
        if found is None:
            raise InputError(
                f"map {folder} has no usable {SCENES_FOLDER}/{entry['name']}.npz",
                remedy="Copy or download the map again, or make it anew from its scenes.",
                code="damaged-map",
            )
        try:
            result[entry["name"]] = SourceScene.unpack(entry["name"], *found)
        except (KeyError, TypeError, ValueError) as error:
            raise _of_another_version(folder, f"{SCENES_FOLDER}/{entry['name']}.npz: {error}") from error
    return result


def _of_another_version(folder: Path, what: str) -> InputError:
    return InputError(
        f"map {folder} was written by another version of the engine: {what}",
        remedy="Make the map anew from its scenes.",
        code="map-version",
    )


def map_document(folder: Path) -> dict[str, Any]:
    """A map's `map.json`.

    Raises
    ------
    InputError
        Where the folder is no complete map of this version.
    """
    try:
        if not (folder / "report.json").is_file():
            raise FileNotFoundError("it has no report.json")
        document = json.loads((folder / MAP_FILE).read_text(encoding="utf-8"))
        if document["version"] != 1:
            raise _of_another_version(folder, f"{MAP_FILE} is of version {document['version']!r}, not of 1")
        names = [scene["name"] for scene in document["scenes"] if scene["fingerprint"]]
        if not all(isinstance(seam[end], str) for seam in document["seams"] if seam["accepted"] for end in "ab"):
            raise TypeError("a seam names no scenes")
        if len(set(names)) != len(names):
            raise ValueError("a scene is in it twice")
        return dict(document)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{folder} is no map: {error}",
            remedy="Give the folder that `mrasfm aggregate --out` wrote.",
            code="not-a-map",
        ) from error


def _check_together(run: Run, found: Sequence[SourceScene]) -> None:
    """Refuse scenes that cannot be in one map; say what is unusual."""
    if _drives(found) < MIN_DRIVES:
        raise InputError(
            f"a map needs {MIN_DRIVES} drives, this would have {_drives(found)}",
            remedy="Give scenes of more drives; a drive by itself needs no map, whatever components it has.",
            code="one-scene",
        )
    for k, scene in enumerate(found):
        for other in found[:k]:
            if drive_of_scene(scene.name) != drive_of_scene(other.name) and _of_one_drive(scene, other):
                raise InputError(
                    f"scenes {other.name} and {scene.name} are of the same drive",
                    remedy="Give each drive once.",
                    code="same-drive",
                )
    _require_one(
        found, "features_kind", "different-features", "keypoints", "Reconstruct all drives with one extractor."
    )
    _require_one(
        found,
        "common_world",
        "different-worlds",
        "worlds",
        "Give all drives GNSS, or rough_poses in one common_world.",
    )
    datums = sorted({scene.height_datum for scene in found if scene.is_placed})
    if len(datums) > 1:
        run.found(
            warning(
                "height-datums",
                f"heights of the drives count from different datums: {', '.join(datums)}",
                "They were converted to ellipsoidal heights; check that each drive declares its own rightly.",
            )
        )
    versions = {scene.name: scene.report.get("engine_version") for scene in found}
    others = sorted(name for name, version in versions.items() if version != __version__)
    if others:
        run.found(
            warning(
                "engine-versions",
                f"other versions of the engine made the scenes {', '.join(others)}",
                f"Reconstruct them with {__version__} if the map is worse than expected.",
            )
        )


def _of_one_drive(a: SourceScene, b: SourceScene) -> bool:
    """Return whether two scenes were made of the same recording, perhaps under other settings."""
    if a.fingerprint == b.fingerprint:
        return True
    if a.manifest.frames != b.manifest.frames or a.manifest.gnss != b.manifest.gnss:
        return False
    # Clocks that begin at zero and numbered files are those of many drives: where they were tells them apart.
    rough_a, rough_b = (None if s.manifest.rough_poses is None else s.manifest.rough_poses.poses for s in (a, b))
    if a.manifest.gnss is None and rough_a is None and rough_b is None:
        return np.array_equal(a.keypoint_xy_px, b.keypoint_xy_px)
    return a.manifest.gnss is not None or rough_a == rough_b


def _require_one(found: Sequence[SourceScene], name: str, code: str, what: str, remedy: str) -> None:
    values: dict[Any, str] = {}
    for scene in found:
        if scene.is_placed or name != "common_world":
            values.setdefault(getattr(scene, name), scene.name)
    if len(values) > 1:
        (a, first), (b, second) = list(values.items())[:2]
        raise InputError(
            f"scenes {first} and {second} have different {what}: {a or 'of positions'} and {b or 'of positions'}",
            remedy=remedy,
            code=code,
        )


def association(run: Run, found: Sequence[SourceScene]) -> Association:
    """Place the scenes by their positions, and choose the pairs to compare."""
    started = time.perf_counter()
    run.begin(Stage.ASSOCIATION)
    result = associate(found, run.config.aggregation, cancel=run.cancel)
    result = replace(result, pairs=tuple(sorted({*result.pairs, *_pairs_with_seams(run.extended, found)})))
    middle = np.array([m[:3, 3] for m in result.map_from_scene])
    if np.nanmax(np.abs(middle - middle[result.reference])) > FAR_APART_M:
        run.found(
            warning(
                "far-apart",
                "some scenes are over 50 km apart",
                "They are in one map, in the frame of the reference; check that this is meant.",
            )
        )
    run.ended(Stage.ASSOCIATION, started, reference=found[result.reference].name, pairs=len(result.pairs))
    return result


def _pairs_with_seams(document: Mapping[str, Any] | None, found: Sequence[SourceScene]) -> list[tuple[int, int]]:
    """Pairs of scenes that seams of the map join already.

    Scenes that are added fill the lists of candidates: what rests on a seam would lose its place to them.
    """
    if document is None:
        return []
    row = _rows_of_map(document, found)
    ends = [(seam["a"], seam["b"]) for seam in document["seams"] if seam["accepted"]]
    return [(min(row[a], row[b]), max(row[a], row[b])) for a, b in ends if a in row and b in row]


def _rows_of_map(document: Mapping[str, Any], found: Sequence[SourceScene]) -> dict[str, int]:
    """Indices of the scenes that are in a map as they are, by name."""
    of_map = {entry["name"]: entry["fingerprint"] for entry in document["scenes"]}
    return {scene.name: k for k, scene in enumerate(found) if of_map.get(scene.name) == scene.fingerprint}


def at_length(run: Run, found: Sequence[SourceScene], known: Association) -> list[SourceScene]:
    """The scenes, those without positions as long as scenes with positions say that see the same.

    One that these measure says it for others in turn. Scenes of a map that is extended stay as long as they are there:
    the seams between them are those of this length. Which are longer or shorter than by themselves the report says.
    """
    result = list(found)
    if not run.config.aggregation.agreeing_units:  # one unit alone tells no length
        return result
    in_map = set() if run.extended is None else set(_rows_of_map(run.extended, found).values())
    measured = {k for k, scene in enumerate(found) if scene.is_placed or k in in_map}
    waiting = [k for k, scene in enumerate(found) if k not in measured and stated_sigma(scene)]
    if not waiting:
        return result
    key = fingerprint([(s.name, s.fingerprint) for s in found], known.pairs, waiting, _comparison(run), SCALES_VERSION)
    kept = run.store.load(SCALES_CHECKPOINT, key)
    if kept is None:
        scales = _scales(run, found, known, measured, waiting)
        run.store.save(SCALES_CHECKPOINT, key, {}, {str(k): asdict(scale) for k, scale in scales.items()})
    else:
        scales = {int(k): SceneScale(**scale) for k, scale in kept[1].items()}
    for k, scale in scales.items():
        result[k] = _of_length(found[k], scale)
        if scale.is_unexpected(found[k]):
            run.found(_scaled(found[k], scale))
    return result


def _scales(
    run: Run, found: Sequence[SourceScene], known: Association, measured: Collection[int], waiting: Sequence[int]
) -> dict[int, SceneScale]:
    """Lengths of waiting scenes in scenes whose lengths are right, or were measured before; by index."""
    at_length, result = {k: found[k] for k in measured}, dict[int, SceneScale]()
    compared: set[tuple[int, int]] = set()
    while True:
        before = len(result)
        for k in [k for k in waiting if k not in result]:
            others = {sum(pair) - k for pair in known.pairs if k in pair} & at_length.keys()
            new = sorted(other for other in others if (k, other) not in compared)
            compared.update((k, other) for other in new)
            best = _best_scale(run, found[k], [at_length[other] for other in new])
            if best is not None:
                result[k], at_length[k] = best, _of_length(found[k], best)
        if len(result) == before:
            return result


def _best_scale(run: Run, scene: SourceScene, others: Iterable[SourceScene]) -> SceneScale | None:
    """The best known length of a scene in others that it may have; None where none of them measures it."""
    possible = []
    for other in others:
        scale = find_scale(other, scene, run.components.matcher, run.config, cancel=run.cancel)
        if scale is not None and scale.may_be_of(scene, run.config.aggregation):
            possible.append(scale)
    return min(possible, key=lambda scale: scale.sigma_of_length, default=None)


def _of_length(scene: SourceScene, scale: SceneScale) -> SourceScene:
    """The scene at the length that another one gives it, where that differs from its own."""
    if not scale.is_significant:
        return scene
    stated = {"sigma_relative": scale.sigma_of_length, "from": f"scene {scale.by}", "factor": scale.factor}
    return replace(scene.of_length(scale.factor), report={**scene.report, "scale": stated})


def _scaled(scene: SourceScene, scale: SceneScale) -> Finding:
    return warning(
        "scene-scaled",
        f"scene {scene.name} is {scale.factor:.3f} times as long as by itself: {scale.by} says that to "
        f"{100 * scale.sigma:.2g} %, where the scene knew its length to {100 * stated_sigma(scene):.2g} %",
        "Give its drive GNSS, or sigma_translation_m of cameras that are known better.",
    )


def seams(run: Run, found: Sequence[SourceScene], known: Association) -> list[Seam]:
    """The seam of every pair of scenes that is to be compared; those found before are taken from the store or map."""
    started = time.perf_counter()
    result, reused = [], 0
    older = None if run.into is None else StageStore(run.into / SEAMS_FOLDER)
    total = len(known.pairs)
    for number, (i, j) in enumerate(known.pairs):
        if run.cancel():
            raise CancelledError
        a, b = found[i], found[j]
        key, name = seam_key(run, a, b), seam_checkpoint(a.name, b.name)
        kept = run.store.load(name, key)
        if kept is None and older is not None:
            kept = older.load(seam_name(a.name, b.name), key)
        if kept is None:
            if reused == number:  # the first that is not there
                run.begin(Stage.SEAMS)
            seam = find_seam(
                a,
                b,
                coarse_transform(a, b) if a.is_placed and b.is_placed else None,
                run.components.matcher,
                run.config,
                cancel=run.cancel,
                progress=lambda done, all_pairs, number=number: run.progress(  # type: ignore[misc]
                    "seams", 100 * number + min(99, 100 * done // max(all_pairs, 1)), 100 * total
                ),
            )
            if run.cancel():
                raise CancelledError  # else a seam that is half adjusted would pass for a finished one
            run.store.save(name, key, *seam.pack())
        else:
            seam = Seam.unpack(a.name, b.name, *kept)
            reused += 1
        result.append(seam)
        if reused <= number:
            run.progress(Stage.SEAMS, 100 * (number + 1), 100 * total)
    run.ended(Stage.SEAMS, started, pairs=total, pairs_reused=reused, accepted=sum(s.accepted for s in result))
    run.report["stages"][-1]["reused"] = reused == total
    return result


def seam_key(run: Run, a: SourceScene, b: SourceScene) -> str:
    """Fingerprint of a seam: both scenes' content, in this order, settings, models and version; not their names."""
    return fingerprint(a.fingerprint, b.fingerprint, *_comparison(run), SEAM_VERSION)


def _comparison(run: Run) -> tuple[object, ...]:
    """Settings and models that a comparison of two scenes depends on."""
    config = run.config
    settings = [
        config.matching.model_dump(),
        config.mapping.max_error_px,
        config.bundle_adjustment.loss_scale,
        config.seed,
    ]
    aggregation = config.aggregation.model_dump(exclude={"candidates", "multi_scene_adjustment", "final_adjustment"})
    return settings, aggregation, run.components.fingerprint_of("matcher")
