"""Measured work: the stages of a reconstruction, each call to run in its own process."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mrasfm_engine import stages
from mrasfm_engine.ablation import TIMED, warm_up
from mrasfm_engine.benchmark import simulated_drive
from mrasfm_engine.benchmark.simulated_descriptors import store_descriptors
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import storage_error
from mrasfm_engine.export.feature_database import write_matches
from mrasfm_engine.io.stage_store import Arrays, StageStore, fingerprint
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory
from mrasfm_engine.preflight.drive_reader import read_drive, write_manifest
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures, PairMatches, Scene
from mrasfm_engine.subprocess_run import memory_bytes
from mrasfm_engine.synthetic.long_route import simulate_long_route
from mrasfm_engine.types import Bools, Floats, StageProgress
from schemas.artifacts import Stage


@dataclass(frozen=True, kw_only=True)
class Prepared:
    """Features and matches, which all mappers share; seconds are None where they had been finished before."""

    features_s: float | None
    matches_s: float | None
    keypoints: int
    verified_pairs: int
    verified_matches: int


@dataclass(frozen=True, kw_only=True)
class Mapped:
    """Our mapping from features and matches.

    Attributes
    ----------
    start_memory_bytes
        What the process had resident before mapping, with features, matches and compiled code; None where unknown.
    world_from_rig
        (units, 4, 4); NaN for units that are not registered.
    revisits_tried, revisits_believed
        Pairs of units.
    """

    mapping_s: float
    refinement_s: float
    start_memory_bytes: int | None
    registered_images: int
    world_from_rig: Floats
    points: int
    observations: int
    revisits_tried: int
    revisits_believed: int
    matching_s: float | None = None  # where descriptors were matched
    verified_matches: int | None = None  # the same
    submaps: int = 1


@dataclass(frozen=True, kw_only=True)
class Simulated:
    """A simulated route and its true poses (units, 4, 4)."""

    images: int
    keypoints: int
    verified_matches: int | None  # None where descriptors are still to be matched
    world_from_rig: Floats


def prepare(progress: StageProgress, drive_folder: Path, config: EngineConfig, work: Path) -> Prepared:
    """Check a drive, extract and match; what is finished is kept in `work`."""
    run = _run(progress, drive_folder, config, StageStore(work))
    stages.load_models(run)
    stages.preflight(run)
    prior = stages.prior(run)
    stages.probe(run)
    stages.matches(run, stages.features(run), prior)
    done = {stage["stage"]: stage for stage in run.report["stages"]}
    took = {name: None if stage["reused"] else float(stage["seconds"]) for name, stage in done.items()}
    return Prepared(
        features_s=took["features"],
        matches_s=took["matches"],
        keypoints=done["features"]["keypoints"],
        verified_pairs=done["matches"]["verified_pairs"],
        verified_matches=done["matches"]["verified_matches"],
    )


def map_drive(progress: StageProgress, drive_folder: Path, config: EngineConfig, work: Path) -> Mapped:
    """Map from the features and matches that `prepare` left, and refine."""
    run = _run(progress, drive_folder, config, _MappedAnew(work))
    prior = stages.prior(run)
    features = stages.features(run)
    return _map(run, features, stages.matches(run, features, prior), prior)


def map_simulated(progress: StageProgress, folder: Path, config: EngineConfig) -> Mapped:
    """Map from simulated features and matches, and refine."""
    simulated = simulated_drive.load(folder)
    run = simulated_run(progress, simulated.drive, config, _MappedAnew(folder))
    return _map(run, simulated.features, simulated.pairs, stages.prior(run))


def write_database(progress: StageProgress, drive_folder: Path, config: EngineConfig, work: Path, path: Path) -> Path:
    """Write the features and matches that `prepare` left for other mappers; the written file."""
    run = _run(progress, drive_folder, config, StageStore(work))
    prior = stages.prior(run)
    features = stages.features(run)
    return _write_database(run.drive, features, stages.matches(run, features, prior), path)


def write_simulated_database(progress: StageProgress, folder: Path, path: Path) -> Path:
    """Write simulated features and matches for other mappers; the written file."""
    simulated = simulated_drive.load(folder)
    return _write_database(simulated.drive, simulated.features, simulated.pairs, path)


def simulate(progress: StageProgress, rig: str, units: int, seed: int, config: EngineConfig, folder: Path) -> Simulated:
    """Simulate a drive into a folder."""
    simulated = simulated_drive.simulate_drive(rig, units, seed, config, folder, progress=progress)
    simulated_drive.save(simulated)
    return Simulated(
        images=len(simulated.features),
        keypoints=sum(len(features.xy_px) for features in simulated.features),
        verified_matches=sum(int(pair.inliers.sum()) for pair in simulated.pairs),
        world_from_rig=simulated.world_from_rig,
    )


def simulate_descriptors(
    progress: StageProgress, rig: str, units: int, seed: int, config: EngineConfig, folder: Path
) -> Simulated:
    """Simulate a drive into a folder, up to the descriptors of its images."""
    route = simulate_long_route(rig, units, seed=seed, progress=lambda done, total: progress("route", done, total))
    drive = simulated_drive.drive_of_route(rig, route, folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_manifest(drive.manifest, folder)
    run = simulated_run(progress, drive, config, StageStore(folder))
    return Simulated(
        images=len(drive.images),
        keypoints=store_descriptors(run, route, seed=seed),
        verified_matches=None,
        world_from_rig=route.world_from_rig,
    )


def map_descriptors(progress: StageProgress, folder: Path, config: EngineConfig) -> Mapped:
    """Match the descriptors that `simulate_descriptors` left and map, in sub-maps where the drive is cut, and
    refine."""
    run = simulated_run(progress, read_drive(folder), config, StageStore(folder))
    run.report["findings"] = []
    start_memory_bytes = memory_bytes()
    prior, spans = stages.prior(run), stages.cut_drive(run)
    scene, _ = stages.refinement(run, stages.mapped(run, spans, prior), prior)
    every = [*run.report["stages"], *(stage for part in run.report.get("submaps", []) for stage in part["stages"])]
    matched = next(stage for stage in run.report["stages"] if stage["stage"] == Stage.MATCHES)
    return replace(
        _mapped(run, scene, start_memory_bytes),
        mapping_s=sum(stage["seconds"] for stage in every if stage["stage"] == Stage.MAPPING),
        matching_s=sum(stage["seconds"] for stage in every if stage["stage"] == Stage.MATCHES),
        verified_matches=matched["verified_matches"],
        submaps=max(len(spans), 1),
    )


class _MappedAnew(StageStore):
    """Finished stages, of which mapping and what follows is always done again: it is what is timed."""

    def _read(self, name: str, key: str, *, arrays: bool) -> tuple[Arrays, dict[str, Any]] | None:
        return None if name in TIMED else super()._read(name, key, arrays=arrays)


def _run(progress: StageProgress, drive_folder: Path, config: EngineConfig, store: StageStore) -> stages.Run:
    # Whoever wants it to end kills the process.
    return stages.Run(read_drive(drive_folder), config, store, progress, lambda: False)


def simulated_run(progress: StageProgress, drive: Drive, config: EngineConfig, store: StageStore) -> stages.Run:
    """A run of a drive whose images have no files: there is no own car, and none is like another."""
    contents = {image.file: fingerprint(drive.manifest.name, image.file) for image in drive.images}
    own_cars: list[Bools | None] = [None for _ in drive.cameras]
    key = fingerprint(drive.manifest.name)
    return stages.Run(
        drive, config, store, progress, lambda: False, content_sha256=contents, own_cars=own_cars, key=key
    )


def _map(
    run: stages.Run, features: Sequence[ImageFeatures], matches: Sequence[PairMatches], prior: PriorTrajectory
) -> Mapped:
    run.report["findings"] = []
    warm_up(run, features, matches, prior)
    start_memory_bytes = memory_bytes()
    scene, _ = stages.refinement(run, stages.mapping(run, features, matches, prior), prior)
    return _mapped(run, scene, start_memory_bytes)


def _mapped(run: stages.Run, scene: Scene, start_memory_bytes: int | None) -> Mapped:
    done = {stage["stage"]: stage for stage in run.report["stages"]}
    revisits = done["mapping"]["revisits"]
    return Mapped(
        mapping_s=done["mapping"]["seconds"],
        refinement_s=done["refinement"]["seconds"],
        start_memory_bytes=start_memory_bytes,
        registered_images=int(scene.image_registered.sum()),
        world_from_rig=scene.world_from_rig,
        points=len(scene.points_m),
        observations=len(scene.observation_point),
        revisits_tried=revisits["unit_pairs_tried"],
        revisits_believed=revisits["unit_pairs_believed"],
    )


def _write_database(drive: Drive, features: Sequence[ImageFeatures], pairs: Sequence[PairMatches], path: Path) -> Path:
    try:
        path.unlink(missing_ok=True)
        write_matches(drive, features, pairs, path)
    except OSError as error:
        raise storage_error(path, error) from error
    return path
