"""Report of a map: `map.json`, pictures of its seams, and findings."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mrasfm_engine.aggregation import stages
from mrasfm_engine.aggregation.assembly import Assembly
from mrasfm_engine.aggregation.association import Association
from mrasfm_engine.aggregation.graph import Chain
from mrasfm_engine.aggregation.loops import GATE_SIGMAS, Loop
from mrasfm_engine.aggregation.map_adjustment import AdjustedMap
from mrasfm_engine.aggregation.map_placement import Placement
from mrasfm_engine.aggregation.map_scene import map_scene, params_of
from mrasfm_engine.aggregation.seam import Seam
from mrasfm_engine.aggregation.seam_pictures import seam_picture, shown_square
from mrasfm_engine.aggregation.source import SourceScene
from mrasfm_engine.aggregation.vehicles import Knocked, Vehicle
from mrasfm_engine.bundle_adjustment.solver import Report
from mrasfm_engine.config import AggregationConfig
from mrasfm_engine.errors import CancelledError
from mrasfm_engine.export.calibration import document_in_map
from mrasfm_engine.export.map import MapContent
from mrasfm_engine.export.picture_files import png_of
from mrasfm_engine.geometry import se3
from mrasfm_engine.types import Floats
from schemas.artifacts import PICTURES_FOLDER, Stage, seam_name
from schemas.findings import Finding, warning

MAX_FINDINGS = 5  # of a kind
MEANINGS = {  # of loops that do not close, and what to do
    "seam-contradicted": (
        "wrong, and not used:",
        "Look where these scenes share points: repeated structures, or a scene whose shape is wrong.",
    ),
    "loop-leaves-open": (
        "nothing says which of them is wrong; not used:",
        "Give a drive that shares places with several of these scenes, or better positions.",
    ),
    "loop-does-not-close": (
        "other loops confirm each of them, and all are used",
        "Compare the lengths of these scenes, and their calibrations.",
    ),
}
CONNECTED, BY_POSITIONS = "connected", "placed by positions"
BEFORE, AFTER = "before", "after"


@dataclass(frozen=True, kw_only=True)
class MapResult:
    """All that a map is made of."""

    scenes: Sequence[SourceScene]
    association: Association
    found_seams: Sequence[Seam]  # as every pair of scenes by itself says
    seams: Sequence[Seam]  # without those that contradict others
    loops: Sequence[Loop]  # of seams that do not close
    chains: Sequence[Chain]  # of components; the first is the map's
    map_from_scene: Floats  # (scenes, 4, 4) before units varied on their own
    placements: Sequence[Placement]  # of components that seams connect
    joint_reports: Sequence[Report]
    assembly: Assembly
    adjusted: AdjustedMap
    vehicles: Sequence[Vehicle]  # that several drives name
    left_out: Sequence[Mapping[str, str]]  # names of scenes that are not in the map, and why

    @property
    def unconnected(self) -> list[str]:
        """Scenes that no seam connects with the map's other ones."""
        connected = set(self.chains[0].scenes) if len(self.chains[0].scenes) > 1 else set()
        return [scene.name for k, scene in enumerate(self.scenes) if k not in connected]

    @property
    def component_of_scene(self) -> list[int]:
        """The number of each scene's chain."""
        return [next(n for n, chain in enumerate(self.chains) if k in chain.scenes) for k in range(len(self.scenes))]

    def ends_of(self, seam: Seam) -> tuple[int, int]:
        """The numbers of a seam's scenes."""
        names = [scene.name for scene in self.scenes]
        return names.index(seam.a), names.index(seam.b)

    def units_of(self, k: int) -> Floats:
        """Poses (u, 4, 4) of a scene's units in the map; NaN where not registered."""
        first, stop = self.assembly.first_unit[k : k + 2]
        poses = self.adjusted.model.state.world_from_rig[first:stop].copy()
        poses[~self.assembly.registered[first:stop]] = np.nan
        return poses


def say_findings(run: stages.Run, result: MapResult) -> None:
    """Note scenes that are not connected, and seams that were refused for what they contradict."""
    for finding in loop_findings(result.loops, [s.name for s in result.scenes], [(s.a, s.b) for s in result.seams]):
        run.found(finding)
    for vehicle in result.vehicles:
        for one in vehicle.knocked:
            run.found(_knocked(vehicle, one, [scene.name for scene in result.scenes]))
    if result.adjusted.too_many_cameras:
        run.found(
            warning(
                "calibrations-not-shared",
                "the cameras and units of the map are too many: no drive learns from others of its vehicle"
                + ("" if result.adjusted.free_cameras else ", and calibrations stay as their scenes found them"),
                "Make several maps of fewer drives if their scenes' calibrations are uncertain.",
            )
        )
    for placement in result.placements:
        if placement.sigmas > GATE_SIGMAS:
            run.found(_positions_contradict(placement, [scene.name for scene in result.scenes]))
    for k, factor in result.adjusted.lengthened.items():
        run.found(_lengthened(result.scenes[k], factor))
    names = result.unconnected
    if len(names) == len(result.scenes):
        run.found(nothing_connected(result.found_seams, run.config.aggregation))
    elif names:
        run.found(
            warning(
                "unconnected",
                f"placed by positions only, which may be off by metres: {', '.join(names)}",
                "Give drives whose trajectories meet theirs.",
            )
        )


def nothing_connected(found: Sequence[Seam], settings: AggregationConfig) -> Finding:
    """Finding on a map without a seam in use, by the seams that every pair of scenes by itself says."""
    sharing = [seam for seam in found if len(seam.shared) >= settings.min_inliers]
    off_m = [seam.quality.get("positions_off_m", 0.0) for seam in sharing]
    above_m = max((seam.quality.get("height_between_m", 0.0) for seam in found), default=0.0)
    if any(seam.accepted for seam in found):
        why, remedy = "no seam is left to use", "See the loops that do not close."
    elif not found:
        why = "positions bring no two of them near enough to be compared"
        remedy = (
            "Give drives whose trajectories meet, or check their positions, which may be off by "
            "aggregation.position_error_m."
        )
    elif max(off_m, default=0.0) > settings.position_error_m:
        why = f"what they share contradicts their positions, by up to {max(off_m):.0f} m"
        remedy = (
            "Check positions, height datums and clocks, or set aggregation.position_error_m to what they are off by."
        )
    elif above_m > settings.position_error_m:
        why = f"positions put scenes that meet above one another, by up to {above_m:.0f} m"
        remedy = "Compare the height datums of their drives, in gnss.height_datum."
    elif sharing:
        best = max(sharing, key=lambda seam: len(seam.shared))
        why = f"{best.a} and {best.b} see the same, but {best.reason}"
        remedy = "The seams in map.json have the reason of every pair; aggregation has a setting for each threshold."
    else:
        why = "no two of them see the same"
        remedy = "Give drives whose trajectories meet, in similar light, or check their positions."
    return warning("nothing-connected", f"all scenes are placed by positions only: {why}", remedy)


def _positions_contradict(placement: Placement, names: Sequence[str]) -> Finding:
    """Finding on scenes whose positions differ by more than their sigmas let expect; the worst of them."""
    worst = sorted(placement.off_m, key=lambda k: -placement.off_m[k])[:MAX_FINDINGS]
    off = ", ".join(f"{placement.off_m[k]:.2f} m for {names[k]}" for k in worst)
    return warning(
        "positions-contradict",
        f"positions of scenes that seams connect differ by more than their sigmas, by {placement.sigmas:.1f} of these: "
        f"from where the map lies by {off}",
        "Check antennas, height datums and clocks of these drives, and declare sigmas that hold a receiver's constant "
        "error.",
    )


def _lengthened(scene: SourceScene, factor: float) -> Finding:
    """Finding on a scene whose length the last adjustment changed by more than the scene knows it."""
    known = "" if scene.sigma_scale is None else f", where it knew its length to {100 * scene.sigma_scale:.1f} %"
    return warning(
        "scene-lengthened",
        f"scene {scene.name} is {factor:.2f} times as long in the map as by itself{known}",
        'Declare sigma_translation_m of cameras that are known better, or set aggregation.final_adjustment to "none".',
    )


def _knocked(vehicle: Vehicle, one: Knocked, names: Sequence[str]) -> Finding:
    """Finding on a camera that contradicts its vehicle."""
    where = " or in ".join(names[k] for k in one.scenes)
    what = f"in {where}" + (": nothing says in which" if len(one.scenes) > 1 else ", the other drives agree")
    return warning(
        "camera-contradicts-vehicle",
        f"camera {one.camera} of vehicle {vehicle.name} was knocked or exchanged, {what} ({one.sigmas:.1f} sigmas)",
        "Look at the camera's mount between these drives. Its calibration is not shared between them; if the drives "
        "are of different vehicles, correct vehicle in their manifests.",
    )


def loop_findings(loops: Sequence[Loop], scenes: Sequence[str], seams: Sequence[tuple[str, str]]) -> list[Finding]:
    """Findings on loops that do not close, by the names of scenes and of the seams' ends; the worst ones of a kind."""
    kinds: dict[str, list[Loop]] = {}
    for loop in loops:
        code = "seam-contradicted" if loop.wrong else "loop-leaves-open" if loop.refused else "loop-does-not-close"
        kinds.setdefault(code, []).append(loop)
    found = []
    for code, own in kinds.items():
        worst = sorted(own, key=lambda loop: -loop.sigmas)[:MAX_FINDINGS]
        for loop in worst:
            around = " - ".join(scenes[k] for k in (*loop.scenes, loop.scenes[0]))
            off = f"{loop.shift_m:.2f} m and {loop.turn_deg:.2f} deg, {loop.sigmas:.1f} sigmas"
            ends = ", ".join("{} - {}".format(*seams[k]) for k in loop.refused)
            meaning, remedy = MEANINGS[code]
            found.append(warning(code, f"the seams {around} do not close, by {off}; {meaning} {ends}".rstrip(), remedy))
        if len(own) > len(worst):
            rest = f"{len(own) - len(worst)} more loops do not close: map.json has all of them"
            found.append(warning(code, rest, MEANINGS[code][1]))
    return found


def map_content(run: stages.Run, result: MapResult, pictures: dict[str, bytes]) -> MapContent:
    """Content of the map's folder."""
    reference = result.scenes[result.association.reference]
    scene = map_scene(result.assembly, result.adjusted.model, reference, result.component_of_scene)
    by_name = {s.name: s for s in result.scenes}
    return MapContent(
        scene=scene,
        scene_of_unit=[result.scenes[k].name for k in result.assembly.scene_of_unit],
        document=map_document(result, pictures),
        calibrations={s.name: _calibration(result, k) for k, s in enumerate(result.scenes)},
        pictures=pictures,
        scenes={s.name: (s.fingerprint, *s.pack()) for s in result.scenes},
        seams={
            seam_name(seam.a, seam.b): (
                stages.seam_key(run, by_name[seam.a], by_name[seam.b]),
                *seam.pack(),
            )
            for seam in result.found_seams
        },
    )


def _calibration(result: MapResult, k: int) -> dict[str, Any]:
    scene, first = result.scenes[k], int(result.assembly.first_camera[k])
    state = result.adjusted.model.state
    cameras = zip(scene.drive.cameras, state.rig_from_cam[first:], state.camera_params[first:], strict=False)
    return document_in_map(
        scene.calibration, {camera.name: (pose, params_of(camera, p)) for camera, pose, p in cameras}
    )


def map_document(result: MapResult, pictures: Collection[str]) -> dict[str, Any]:
    """`map.json`; `pictures` are the names of those that there are."""
    scenes = result.scenes
    return {
        "version": 1,
        "reference": scenes[result.association.reference].name,
        "order": [scenes[k].name for chain in result.chains[:1] for k in chain.scenes],
        "scenes": [_scene(result, k) for k in range(len(scenes))],
        "seams": [_seam(result, number, pictures) for number in range(len(result.seams))],
        "loops": [_loop(result, loop) for loop in result.loops],
        "unconnected": result.unconnected,
        "vehicles": [_vehicle(result, vehicle) for vehicle in result.vehicles],
        "left_out": [dict(scene) for scene in result.left_out],
        "joint": [
            {"iterations": r.iterations, "observations": r.observations, "termination": str(r.termination)}
            for r in result.joint_reports
        ],
    }


def _vehicle(result: MapResult, vehicle: Vehicle) -> dict[str, Any]:
    """A vehicle's drives, and the calibration that they share."""
    names = [scene.name for scene in result.scenes]
    return {
        "vehicle": vehicle.name,
        "scenes": [names[k] for k in vehicle.scenes],
        "deviation_deg": float(np.degrees(vehicle.deviation_rad)),
        "deviation_m": vehicle.deviation_m,
        "deviation_focal": vehicle.deviation_focal,
        "learning": [names[k] for k in vehicle.scenes if k in result.adjusted.learning],
        "knocked": [
            {"camera": one.camera, "scenes": [names[k] for k in one.scenes], "sigmas": one.sigmas}
            for one in vehicle.knocked
        ],
    }


def _scene(result: MapResult, k: int) -> dict[str, Any]:
    scene = result.scenes[k]
    positions = result.adjusted.positions.get(k)
    connected = scene.name not in result.unconnected
    moved = se3.apply(result.map_from_scene[k], scene.midpoint_m[None])[0]
    coarse = se3.apply(result.association.map_from_scene[k], scene.midpoint_m[None])[0]
    return {
        "name": scene.name,
        "fingerprint": scene.fingerprint,
        "drive": scene.manifest.name,
        "verdict": CONNECTED if connected else BY_POSITIONS,
        "component": result.component_of_scene[k],
        "map_from_scene": result.map_from_scene[k],
        **({} if "factor" not in scene.report.get("scale", {}) else {"scaled": scene.report["scale"]}),
        **({"moved_from_positions_m": float(np.linalg.norm(moved - coarse))} if scene.is_placed else {}),
        **({} if positions is None else {"positions_bias_m": positions.bias_m}),
        "registered_units": int(scene.unit_registered.sum()),
        "total_units": len(scene.unit_registered),
        "registered_images": int(scene.image_registered.sum()),
        "total_images": len(scene.image_registered),
        "points": len(scene.points_m),
        "height_datum": scene.height_datum,
        "calibration": f"calibration/{scene.name}.json",
    }


def _seam(result: MapResult, number: int, pictures: Collection[str]) -> dict[str, Any]:
    seam = result.seams[number]
    closing = next((c for chain in result.chains for c in chain.closings if c.seam == number), None)
    document: dict[str, Any] = {"a": seam.a, "b": seam.b, "accepted": seam.accepted}
    if seam.reason:
        document["reason"] = seam.reason
    document |= {key: value for key, value in seam.quality.items() if np.isfinite(value)}
    if np.isfinite(seam.coarse_a_from_b).all():
        document["coarse_a_from_b"] = seam.coarse_a_from_b
    if seam.accepted:
        document |= {
            "a_from_b": seam.a_from_b,
            "units_of_a": seam.units_a,
            "units_of_b": seam.units_b,
            "in_chain": any(number in chain.seams for chain in result.chains),
            "adjusted_by_m": _moved(result, seam),
        }
    shown = {when: name for when in (BEFORE, AFTER) if (name := _picture_name(seam, when)) in pictures}
    if shown:
        document["pictures"] = {when: f"{PICTURES_FOLDER}/{name}" for when, name in shown.items()}
    if closing is not None:
        document["closes_loop"] = {"shift_m": closing.shift_m, "turn_deg": closing.turn_deg, "seams": closing.length}
    return document


def _loop(result: MapResult, loop: Loop) -> dict[str, Any]:
    return {
        "scenes": [result.scenes[k].name for k in loop.scenes],
        "shift_m": loop.shift_m,
        "turn_deg": loop.turn_deg,
        "sigmas": loop.sigmas,
        "refused": [[result.seams[k].a, result.seams[k].b] for k in loop.refused],
        "wrong_known": bool(loop.wrong),
    }


def _moved(result: MapResult, seam: Seam) -> float:
    """Difference, at the seam, between the map's transform and the seam's own."""
    (a, b), poses, at = result.ends_of(seam), result.map_from_scene, seam.place_b_m[None]
    lies = se3.apply(se3.inverse(poses[a]) @ poses[b], at)
    return float(np.linalg.norm(lies - se3.apply(seam.a_from_b, at)))


def map_pictures(run: stages.Run, result: MapResult) -> dict[str, bytes]:
    """Pictures of every accepted seam, as positions put its scenes and in the map, as PNG files by name."""
    started = time.perf_counter()
    run.begin(Stage.PICTURES)
    pictures: dict[str, bytes] = {}
    shown = [seam for seam in result.seams if seam.accepted]
    for done, seam in enumerate(shown, 1):
        if run.cancel():
            raise CancelledError
        for when, picture in _seam_pictures(result, seam).items():
            pictures[_picture_name(seam, when)] = png_of(picture)
        run.progress(Stage.PICTURES, done, len(shown))
    run.ended(Stage.PICTURES, started, pictures=len(pictures))
    return pictures


def _picture_name(seam: Seam, when: str) -> str:
    return f"seam-{seam_name(seam.a, seam.b)}-{when}.png"


def _seam_pictures(result: MapResult, seam: Seam) -> dict[str, Any]:
    a, b = result.ends_of(seam)
    trajectory_a, trajectory_b = (result.units_of(k)[result.scenes[k].unit_registered, :3, 3] for k in (a, b))
    at_seam = np.concatenate([result.units_of(a)[seam.units_a, :3, 3], result.units_of(b)[seam.units_b, :3, 3]])
    centre, side = shown_square(at_seam)
    points_a, points_b = (_points_of(result, k) for k in (a, b))
    coarse = result.map_from_scene[a] @ seam.coarse_a_from_b
    scene_b = result.scenes[b]
    quality = seam.quality
    by, off = "their first units put them, without positions", ""
    if "positions_off_m" in quality:
        by, off = "their positions put them", f"{quality['positions_off_m']:.2f} m off, "
    titles = (
        [f"{seam.a} (orange) and {seam.b} (blue), as {by}", "before aggregation: "
         f"{off}residual {quality['residual_before_px']:.1f} px"],
        [f"{seam.a} (orange) and {seam.b} (blue), in the map", f"after: {quality['inliers']} shared points, residual "
         f"{quality['residual_after_px']:.2f} px"],
    )  # fmt: skip
    before = seam_picture(
        titles[0],
        (points_a, se3.apply(coarse, scene_b.points_m)),
        (trajectory_a, se3.apply(coarse, scene_b.trajectory_m)),
        centre,
        side,
        title_of_other=titles[1],
    )
    after = seam_picture(
        titles[1],
        (points_a, points_b),
        (trajectory_a, trajectory_b),
        centre,
        side,
        title_of_other=titles[0],
    )
    return {BEFORE: before, AFTER: after}


def _points_of(result: MapResult, k: int) -> Floats:
    first, stop = result.assembly.first_point[k : k + 2]
    owner = result.adjusted.model.owner[first:stop]
    return result.adjusted.model.state.points_m[owner[owner >= 0]]
