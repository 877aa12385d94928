"""Our mapping and its baselines on the same features and matches, each in a process of its own."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from mrasfm_engine.benchmark import mapping
from mrasfm_engine.benchmark.baselines import Baseline, run_baseline
from mrasfm_engine.benchmark.mapping import Mapped, Prepared
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import InputError, ReconstructionError
from mrasfm_engine.evaluation.pose_errors import TOLERANCE_US
from mrasfm_engine.evaluation.trajectory import MIN_POSES, TrajectoryErrors, compare_known, match_timestamps
from mrasfm_engine.io.trajectory_file import Trajectory
from mrasfm_engine.preflight.drive_reader import read_drive
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.subprocess_run import ProcessResult, run_in_subprocess
from mrasfm_engine.types import Floats

Progress = Callable[[str, str, int, int], None]  # row, stage, done, total
Call = TypeVar("Call")

OURS = "mrasfm"
BASELINES = {
    "colmap-global": Baseline.GLOBAL,
    "colmap-global-fixed": Baseline.GLOBAL_FIXED_CALIBRATION,
    "colmap-incremental": Baseline.INCREMENTAL,
    "colmap-incremental-fixed": Baseline.INCREMENTAL_FIXED_CALIBRATION,
}
TRUTH = "truth.tum"  # as importers and `mrasfm synth` leave it in a drive
DATABASE = "features.db"


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of a measurement.

    Attributes
    ----------
    repeat
        Mappings of every mapper; what is reported is of the one of median time.
    timeout_s
        For one mapping.
    """

    config: EngineConfig
    baselines: Sequence[str] = ()
    repeat: int = 1
    timeout_s: float = math.inf
    progress: Progress = lambda row, stage, done, total: None
    cancel: Callable[[], bool] = lambda: False

    def __post_init__(self) -> None:
        for baseline in self.baselines:
            if baseline not in BASELINES:
                raise InputError(
                    f"--baselines: there is no mapper {baseline!r}", remedy=f"Give some of {', '.join(BASELINES)}."
                )
        if self.repeat < 1 or not self.timeout_s > 0:
            raise InputError(
                f"cannot map {self.repeat} times within {self.timeout_s:g} s each",
                remedy="Give --repeat 1 or more, and a positive --timeout-s.",
            )

    def run(
        self, row: str, work: Callable[..., Call], *arguments: object, timeout_s: float = math.inf
    ) -> ProcessResult[Call]:
        """Do some work in a process of its own, shown as a row's."""
        return run_in_subprocess(
            work,
            *arguments,
            timeout_s=timeout_s,
            progress=lambda stage, done, total: self.progress(row, stage, done, total),
            cancel=self.cancel,
        )

    def require(self, row: str, work: Callable[..., Call], *arguments: object) -> tuple[Call, int | None]:
        """The result of some work in a process of its own, and its peak memory in bytes.

        Raises
        ------
        ReconstructionError
            Where the process died.
        """
        ran = self.run(row, work, *arguments)
        if ran.result is None:
            raise ReconstructionError(
                f"{row}: the process {ran.failure}",
                remedy="Look at what it printed, and whether there is memory enough.",
                code="process-died",
            )
        return ran.result, ran.peak_memory_bytes


@dataclass(frozen=True, kw_only=True)
class Row:
    """One mapper on one drive.

    Attributes
    ----------
    mapping_s, refinement_s
        Seconds of the run of median time; baselines refine while they map.
    runs_s
        Both together of every run that came to its end.
    start_memory_bytes, peak_memory_bytes
        Resident before mapping and at most, with interpreter and libraries; None where unknown.
    errors
        None without a truth, or with too few registered units that have one.
    failure
        Why there is no result.
    """

    mapper: str
    mapping_s: float | None = None
    refinement_s: float | None = None
    runs_s: list[float] = field(default_factory=list)
    start_memory_bytes: int | None = None
    peak_memory_bytes: int | None = None
    registered_images: int = 0
    registered_units: int = 0
    points: int | None = None
    observations: int | None = None
    revisits_tried: int | None = None
    revisits_believed: int | None = None
    matching_s: float | None = None  # where every mapping matches anew
    verified_matches: int | None = None  # the same
    submaps: int = 1
    errors: TrajectoryErrors | None = None
    failure: str = ""
    world_from_rig: Floats = field(repr=False, default_factory=lambda: np.zeros((0, 4, 4)))

    @property
    def whole_s(self) -> float | None:
        """Mapping and refinement."""
        return None if self.mapping_s is None else self.mapping_s + (self.refinement_s or 0.0)


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """All mappers on one drive; ours is the first row."""

    drive: str
    images: int
    units: int
    prepared: Prepared
    prepared_peak_memory_bytes: int | None
    rows: list[Row]
    truth_world_from_rig: Floats | None = field(repr=False, default=None)


def baselines_named(text: str) -> list[str]:
    """Names of baselines from a list separated by commas; `Settings` refuses unknown ones."""
    return list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))


def compare_mappers(drive_folder: Path, truth: Trajectory | None, work: Path, settings: Settings) -> Comparison:
    """Extract and match once, then map with our method and all chosen baselines.

    Parameters
    ----------
    truth
        True poses of the vehicle, if there are any.
    work
        Folder for stages; features and matches that are there are used again.

    Raises
    ------
    InputError
        Where the drive cannot be used, or shares too few timestamps with the truth.
    ReconstructionError
        Where the drive has no features or matches.
    """
    drive = read_drive(drive_folder)
    true_poses = None if truth is None else poses_of_units(drive, truth)
    prepared, peak = settings.require("features and matches", mapping.prepare, drive_folder, settings.config, work)
    if settings.baselines:
        database = work / DATABASE
        settings.require("database", mapping.write_database, drive_folder, settings.config, work, database)
    rows = [
        our_row(settings, mapping.map_drive, drive_folder, settings.config, work),
        *peer_rows(settings, work / DATABASE),
    ]
    return Comparison(
        drive=drive.manifest.name,
        images=len(drive.images),
        units=len(drive.timestamps_us),
        prepared=prepared,
        prepared_peak_memory_bytes=peak,
        rows=[with_errors(row, true_poses) for row in rows],
        truth_world_from_rig=true_poses,
    )


def poses_of_units(drive: Drive, truth: Trajectory) -> Floats:
    """True poses (units, 4, 4), NaN where there is none.

    Raises
    ------
    InputError
        Where fewer than three units have one.
    """
    units, rows = match_timestamps(drive.timestamps_us, truth.timestamps_us, tolerance_us=TOLERANCE_US)
    if len(units) < MIN_POSES:
        raise InputError(
            f"{drive.manifest.name} and the truth have {len(units)} timestamps in common within "
            f"{TOLERANCE_US / 1000:g} ms, {MIN_POSES} are needed",
            remedy="Give the truth of this drive, with timestamps in seconds of the same clock.",
        )
    poses = np.full((len(drive.timestamps_us), 4, 4), np.nan)
    poses[units] = truth.world_from_rig[rows]
    return poses


def our_row(settings: Settings, work: Callable[..., Mapped], *arguments: object) -> Row:
    """Our mapping, repeated as the settings say."""
    return _median([_ours(settings, work, *arguments) for _ in range(settings.repeat)])


def _ours(settings: Settings, work: Callable[..., Mapped], *arguments: object) -> Row:
    try:
        ran = settings.run(OURS, work, *arguments, timeout_s=settings.timeout_s)
    except ReconstructionError as error:
        return Row(mapper=OURS, failure=error.what)
    mapped = ran.result
    if mapped is None:
        return Row(mapper=OURS, failure=ran.failure, peak_memory_bytes=ran.peak_memory_bytes)
    return Row(
        mapper=OURS,
        mapping_s=mapped.mapping_s,
        refinement_s=mapped.refinement_s,
        start_memory_bytes=mapped.start_memory_bytes,
        peak_memory_bytes=ran.peak_memory_bytes,
        registered_images=mapped.registered_images,
        registered_units=_registered(mapped.world_from_rig),
        points=mapped.points,
        observations=mapped.observations,
        revisits_tried=mapped.revisits_tried,
        revisits_believed=mapped.revisits_believed,
        matching_s=mapped.matching_s,
        verified_matches=mapped.verified_matches,
        submaps=mapped.submaps,
        world_from_rig=mapped.world_from_rig,
    )


def peer_rows(settings: Settings, database: Path) -> list[Row]:
    """All chosen baselines, repeated as the settings say."""
    return [
        _median([_baseline(settings, name, database) for _ in range(settings.repeat)]) for name in settings.baselines
    ]


def _baseline(settings: Settings, name: str, database: Path) -> Row:
    settings.progress(name, "mapping", 0, 1)
    result = run_baseline(
        database,
        BASELINES[name],
        threads=settings.config.threads,
        timeout_s=settings.timeout_s,
        cancel=settings.cancel,
    )
    settings.progress(name, "mapping", 1, 1)
    return Row(
        mapper=name,
        mapping_s=None if result.failure else result.seconds,
        start_memory_bytes=result.start_memory_bytes,
        peak_memory_bytes=result.peak_memory_bytes,
        registered_images=result.registered_images,
        registered_units=_registered(result.world_from_rig),
        world_from_rig=result.world_from_rig,
        failure=result.failure,
    )


def _registered(world_from_rig: Floats) -> int:
    return int(np.isfinite(world_from_rig[:, 0, 0]).sum())


def _median(runs: list[Row]) -> Row:
    """The run of median time, the faster of two in the middle; a failed one only where all failed."""
    done = sorted((run for run in runs if run.whole_s is not None), key=lambda run: run.whole_s or 0.0)
    if not done:
        return runs[0]
    return replace(done[(len(done) - 1) // 2], runs_s=[run.whole_s or 0.0 for run in done])


def with_errors(row: Row, truth_world_from_rig: Floats | None) -> Row:
    """The row with its errors against the truth (units, 4, 4)."""
    if truth_world_from_rig is None:
        return row
    # A baseline's model ends with its last unit.
    known = truth_world_from_rig[: len(row.world_from_rig)]
    return replace(row, errors=compare_known(row.world_from_rig, known))
