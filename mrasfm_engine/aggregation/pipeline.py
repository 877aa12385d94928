"""The aggregation: scenes on disk become a map on disk."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mrasfm_engine.aggregation import stages
from mrasfm_engine.aggregation.assembly import Assembly
from mrasfm_engine.aggregation.association import Association
from mrasfm_engine.aggregation.graph import Chain, SeamGraph
from mrasfm_engine.aggregation.load import name_scenes
from mrasfm_engine.aggregation.loops import Loop, ScenePaths, off_positions
from mrasfm_engine.aggregation.map_adjustment import AdjustedMap, adjust_map
from mrasfm_engine.aggregation.map_placement import Placement, ScenePlace, placed
from mrasfm_engine.aggregation.map_report import MapResult, map_content, map_pictures, say_findings
from mrasfm_engine.aggregation.multi_scene_adjustment import adjust_jointly, joined_owner
from mrasfm_engine.aggregation.position_conflicts import contradicted_by_positions
from mrasfm_engine.aggregation.positions import drive_positions
from mrasfm_engine.aggregation.seam import Seam
from mrasfm_engine.aggregation.source import SourceScene
from mrasfm_engine.aggregation.vehicles import Vehicle, vehicles_of
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import CancelledError, InputError
from mrasfm_engine.export.map import write_map
from mrasfm_engine.export.publishing import COMPLETE_MARK, only_run, require_free
from mrasfm_engine.io.read_map import is_map
from mrasfm_engine.io.stage_store import StageStore
from mrasfm_engine.types import Floats, StageProgress
from schemas.artifacts import CHECKPOINT_FOLDER, Stage


def aggregate(
    scenes: Mapping[str, Path] | Sequence[Path],
    out: Path,
    config: EngineConfig,
    *,
    into: Path | None = None,
    remove: Sequence[str] = (),
    leave_out: bool = False,
    require_components: bool = False,
    progress: StageProgress = lambda stage, done, total: None,
    cancel: Callable[[], bool] = lambda: False,
    complete_report: Callable[[dict[str, Any]], None] = lambda report: None,
) -> dict[str, Any]:
    """Put scenes together to a map, and write it into the folder `out`.

    Seams between scenes that have been compared before, by an earlier run in `out` or in the map `into`, are not looked
    for again.

    Parameters
    ----------
    scenes
        Folders that `mrasfm reconstruct` wrote, by the names that they have in the map; without names by their own.
    into
        A map that these scenes are added to. It is only read, and may be `out` itself.
    remove
        Names of scenes that the new map does not take over from `into`.
    leave_out
        Make the map without scenes that can be in none, for being damaged, or placed nowhere on the earth; the report
        says which and why under `left_out`. Else they are errors, as they are where nothing new is left.
    require_components
        A smaller component of a drive that nothing places is an error, too. Else the report names it. One that is too
        small to be a scene is only named.
    progress
        Called as progress(stage, done, total).
    cancel
        Asked now and then; where it answers True the run ends with CancelledError.
    complete_report
        Called with the report before it is written: what the caller alone knows can be added.

    Returns
    -------
    dict
        What `report.json` says.

    Raises
    ------
    InputError, StorageError, CancelledError
        See `errors`; also where another run makes a map in `out`. A map that was there is untouched then.
    """
    if into is None and remove:
        raise InputError("--remove needs the map to remove from", remedy="Give --into MAP.", code="no-such-scene")
    if (out / COMPLETE_MARK).is_file() and not is_map(out):
        raise InputError(
            f"{out} holds a scene, which the map would overwrite",
            remedy="Give the map a folder of its own with --out.",
            code="not-a-map",
        )
    require_free(out, result="map")
    named = name_scenes(scenes)
    with only_run(out):
        run = stages.Run(config, StageStore(out / CHECKPOINT_FOLDER), into, progress, cancel)
        run.report["settings"] = config.model_dump(mode="json")
        found = stages.scenes(run, named, remove, leave_out=leave_out)
        result = _joined(run, found, leave_out=leave_out, require_components=require_components)
        say_findings(run, result)
        pictures = map_pictures(run, result) if config.output.pictures else {}
        if cancel():
            raise CancelledError
        run.begin(Stage.EXPORT)
        complete_report(run.report)
        report = write_map(map_content(run, result, pictures), out, run.report)
    run.progress(Stage.EXPORT, 1, 1)
    return report


def _joined(run: stages.Run, found: Sequence[SourceScene], *, leave_out: bool, require_components: bool) -> MapResult:
    """The scenes that can be in the map, compared and joined."""
    known = stages.association(run, found)
    found = stages.at_length(run, found, known)
    seams = stages.seams(run, found, known)
    graph, loops, chains = _graph(found, known, seams, run.config)
    kept = stages.without_unplaced(
        run,
        found,
        seams,
        [chain.scenes for chain in chains],
        leave_out=leave_out,
        require_components=require_components,
    )
    if len(kept) < len(found):
        found, known = [found[k] for k in kept], known.of_scenes(kept)
        names = {scene.name for scene in found}
        seams = [seam for seam in seams if {seam.a, seam.b} <= names]
        graph, loops, chains = _graph(found, known, seams, run.config)
    return _join_scenes(run, found, known, seams, graph, loops, chains)


def _graph(
    found: Sequence[SourceScene], known: Association, seams: Sequence[Seam], config: EngineConfig
) -> tuple[SeamGraph, Sequence[Loop], list[Chain]]:
    """Seams without contradictions, the loops that do not close, and the chain of every component.

    The map's, which is the largest, comes first. It begins with the reference, or where that is not in the largest
    component with this one's first scene.
    """
    by_name = {scene.name: scene for scene in found}
    seen: dict[str, float] = {}  # the largest difference in length that seams of a scene show
    for seam in seams:
        for name in (seam.a, seam.b):
            seen[name] = max(seen.get(name, 0.0), seam.off_in_length)
    graph, loops = SeamGraph(
        list(by_name),
        seams,
        paths=[
            ScenePaths.from_scene(scene, most_scale=config.aggregation.max_scale_error, seen=seen.get(scene.name, 0.0))
            for scene in found
        ],
        off_positions=lambda k: _off_positions(seams[k], by_name[seams[k].a], by_name[seams[k].b]),
    ).without_contradictions()
    graph = graph.without(contradicted_by_positions(graph, found, config.aggregation))
    done: set[int] = set()
    chains: list[Chain] = []
    components = graph.components()
    own = next(c for c in components if known.reference in c)
    starts = [known.reference] if len(own) == len(components[0]) else []
    starts += [c[0] for c in components]
    for start in [*starts, *range(len(found))]:
        if start in done:
            continue
        chain = graph.chain(start)
        chains.append(chain)
        done.update(chain.scenes)
    return graph, loops, chains


def _off_positions(seam: Seam, a: SourceScene, b: SourceScene) -> float:
    if not (a.is_placed and b.is_placed):
        return 0.0
    return off_positions(seam, a.sigma_position_m[seam.units_a], b.sigma_position_m[seam.units_b])


def _join_scenes(
    run: stages.Run,
    found: Sequence[SourceScene],
    known: Association,
    seams: Sequence[Seam],
    graph: SeamGraph,
    loops: Sequence[Loop],
    chains: Sequence[Chain],
) -> MapResult:
    started = time.perf_counter()
    run.begin(Stage.MULTI_SCENE_ADJUSTMENT)
    poses = known.map_from_scene.copy()
    places = [ScenePlace.from_scene(scene) for scene in found]
    placements: list[Placement] = []
    reports = []
    for chain in chains:
        if len(chain.scenes) < 2:
            continue
        members = sorted(chain.scenes)
        balanced = graph.balanced(chain) if run.config.aggregation.multi_scene_adjustment else chain.first_from_scene
        assembly = Assembly(scenes=[found[k] for k in members])
        joint = adjust_jointly(
            assembly,
            np.stack([balanced[k] for k in members]),
            _seams_among(graph, found, members),
            members.index(chain.scenes[0]),
            run.config,
            cancel=run.cancel,
        )
        own = {k: m for k, m in zip(members, joint.first_from_scene, strict=True) if found[k].is_placed}
        placement = placed(own, known.map_from_scene, places)
        placements.append(placement)
        poses[members] = placement.map_from_first @ joint.first_from_scene
        reports.append(joint.report)
    run.ended(Stage.MULTI_SCENE_ADJUSTMENT, started, loops=sum(len(chain.closings) for chain in chains))
    vehicles = vehicles_of(found, run.config.bundle_adjustment)
    adjusted = _adjust_map(run, found, known, graph, poses, vehicles)
    return MapResult(
        scenes=found,
        association=known,
        found_seams=seams,
        seams=graph.seams,
        loops=loops,
        chains=chains,
        map_from_scene=poses,
        placements=placements,
        joint_reports=[r for r in reports if r is not None],
        assembly=Assembly(scenes=found),
        adjusted=adjusted,
        vehicles=vehicles,
        left_out=[{"name": scene["scene"], "reason": scene["what"]} for scene in run.report["left_out"]],
    )


def _seams_among(graph: SeamGraph, found: Sequence[SourceScene], members: Sequence[int]) -> list[Seam]:
    names = {found[k].name for k in members}
    return [seam for seam in graph.seams if seam.accepted and {seam.a, seam.b} <= names]


def _adjust_map(
    run: stages.Run,
    found: Sequence[SourceScene],
    known: Association,
    graph: SeamGraph,
    poses: Floats,
    vehicles: Sequence[Vehicle],
) -> AdjustedMap:
    started = time.perf_counter()
    run.begin(Stage.MAP_ADJUSTMENT)
    assembly = Assembly(scenes=found)
    positions = {
        k: p
        for k, scene in enumerate(found)
        if scene.is_placed
        and (p := drive_positions(scene, known.map_from_scene[k], int(assembly.first_unit[k]), run.config.gnss))
        is not None
    }
    owner = joined_owner(assembly, _seams_among(graph, found, range(len(found))))
    adjusted = adjust_map(assembly, poses, owner, positions, run.config, vehicles=vehicles, cancel=run.cancel)
    run.ended(
        Stage.MAP_ADJUSTMENT,
        started,
        free_units=adjusted.free_units,
        free_cameras=adjusted.free_cameras,
        iterations=[r.iterations for r in adjusted.reports],
        points=len(adjusted.model.state.points_m),
        joined_points=int(adjusted.model.joined.sum()),
        observations_dropped=adjusted.dropped_observations,
        points_dropped=adjusted.dropped_points,
    )
    return adjusted
