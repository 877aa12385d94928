"""Measure the worth of every part of the method: reconstruct a drive whole, and once more without each part.

All reconstructions share the stages that the part does not affect, so that nothing else differs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mrasfm_engine import stages
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import CancelledError, InputError, ReconstructionError
from mrasfm_engine.evaluation.pose_errors import TOLERANCE_US, PoseErrors, compare_scene
from mrasfm_engine.evaluation.trajectory import MIN_POSES, match_timestamps
from mrasfm_engine.io.stage_store import Arrays, StageStore, StoredStage
from mrasfm_engine.io.trajectory_file import Trajectory
from mrasfm_engine.mapping import components
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.refinement import refine
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory, prior_trajectory
from mrasfm_engine.preflight.drive_reader import read_drive
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.row_bands import RowBands
from mrasfm_engine.scene.scene import ImageFeatures, PairMatches
from mrasfm_engine.triangulation.tracks import Keypoints
from mrasfm_engine.types import Floats
from schemas.artifacts import Stage

FULL = "full"
WARM_UP_UNITS = 5
TIMED = (Stage.MAPPING, Stage.REFINEMENT)
Progress = Callable[[str, str, int, int], None]  # row, stage, done, total


@dataclass(frozen=True)
class Switch:
    """A part of the method that a setting turns off; the title is a heading in a table."""

    section: str
    field: str
    title: str

    @property
    def name(self) -> str:
        """Name as in a settings file."""
        return f"{self.section}.{self.field}"

    def turned_off(self, config: EngineConfig) -> EngineConfig:
        """The settings without this part, and all else equal."""
        section = getattr(config, self.section).model_copy(update={self.field: False})
        return config.model_copy(update={self.section: section})


SWITCHES = (
    Switch("bundle_adjustment", "camera_set_adjustment", "no CSBA"),
    Switch("mapping", "camera_set_registration", "no camera set PnP"),
    Switch("mapping", "semantic_triangulation", "no road surface"),
    Switch("pairs", "selection", "all pairs"),
    Switch("bundle_adjustment", "priors", "no priors"),
    Switch("bundle_adjustment", "reassessment", "gates"),
)


@dataclass(frozen=True, kw_only=True)
class Row:
    """One reconstruction.

    Attributes
    ----------
    remark
        Why the part may make no difference on this drive, or why there is no result.
    errors
        None where the reconstruction failed, or has too few units that have a truth.
    mapping_s
        Seconds of mapping and refinement.
    whole_s
        With features and matches, also those that were taken from another row; None where they were finished before.
    parameters, pose_parameters, iterations
        Of the final adjustment; pose parameters are those of units (or images) and cameras.
    """

    name: str
    title: str
    remark: str = ""
    registered_images: int = 0
    total_images: int = 0
    errors: PoseErrors | None = None
    mapping_s: float = float("nan")
    whole_s: float | None = None
    parameters: int = 0
    pose_parameters: int = 0
    iterations: int = 0


def switches_named(names: Sequence[str]) -> list[Switch]:
    """Switches by name; all where no name is given.

    Raises
    ------
    InputError
        Where a name is not that of a switch.
    """
    known = {switch.name: switch for switch in SWITCHES}
    for name in names:
        if name not in known:
            raise InputError(f"--only {name}: there is no such switch", remedy=f"Give one of {', '.join(known)}.")
    return [known[name] for name in dict.fromkeys(names)] or list(SWITCHES)


def ablate(
    drive_folder: Path,
    truth: Trajectory,
    config: EngineConfig,
    *,
    true_rig_from_cam: Floats | None = None,
    switches: Sequence[Switch] = SWITCHES,
    work: Path,
    progress: Progress = lambda row, stage, done, total: None,
    cancel: Callable[[], bool] = lambda: False,
) -> list[Row]:
    """Reconstruct a drive with everything, and without each part.

    Parameters
    ----------
    truth
        True poses of the vehicle.
    true_rig_from_cam
        True calibration (cameras, 4, 4); the given one if None.
    work
        Folder for stages; features and matches that are there are used again.

    Raises
    ------
    InputError
        Where the drive cannot be used, or shares too few timestamps with the truth.
    ReconstructionError
        Where the full method fails.
    """
    drive = read_drive(drive_folder)
    _require_truth(drive, truth)
    calibration = drive.rig_from_cam if true_rig_from_cam is None else true_rig_from_cam
    rows: list[Row] = []
    base = _Store(work / FULL)
    seconds: dict[str, float] = {}
    for name, title, settings, remark in [
        (FULL, FULL, config, ""),
        *((s.name, s.title, s.turned_off(config), _remark(s, drive, config)) for s in switches),
    ]:
        run = stages.Run(
            drive,
            settings,
            base if name == FULL else _Store(work / name, base),
            lambda stage, done, total, row=title: progress(row, stage, done, total),  # type: ignore[misc]
            cancel,
        )
        try:
            rows.append(_row(run, name, title, remark, truth, calibration, seconds))
        except ReconstructionError as error:
            if name == FULL:
                raise
            rows.append(Row(name=name, title=title, remark=f"failed: {error.what}", total_images=len(drive.images)))
    return rows


class _Store(StageStore):
    """Stages of one row, and of those that another row has already finished; what is timed is always done."""

    def __init__(self, folder: Path, shared: StageStore | None = None) -> None:
        super().__init__(folder)
        self._shared = shared

    def _read(self, name: str, key: str, *, arrays: bool) -> tuple[Arrays, dict[str, Any]] | None:
        if name in TIMED:
            return None
        own = super()._read(name, key, arrays=arrays)
        return own if own is not None or self._shared is None else self._shared._read(name, key, arrays=arrays)

    def open(self, name: str, key: str) -> StoredStage | None:
        """See `StageStore`; no row times what is opened."""
        own = super().open(name, key)
        return own if own is not None or self._shared is None else self._shared.open(name, key)


def _require_truth(drive: Drive, truth: Trajectory) -> None:
    kept, _ = match_timestamps(drive.timestamps_us, truth.timestamps_us, tolerance_us=TOLERANCE_US)
    if len(kept) < MIN_POSES:
        raise InputError(
            f"{drive.manifest.name} and the truth have {len(kept)} timestamps in common within "
            f"{TOLERANCE_US / 1000:g} ms, {MIN_POSES} are needed",
            remedy="Give the truth of this drive, with timestamps in seconds of the same clock.",
        )


def _remark(switch: Switch, drive: Drive, config: EngineConfig) -> str:
    if drive.has_single_camera and switch.field.startswith("camera_set"):
        return "one camera: there is no camera set, and its intrinsics are held"
    has_masks = config.semantics.model is not None or any(image.mask for image in drive.images)
    if switch.field == "semantic_triangulation" and not has_masks:
        return "the drive has no masks: the road is known by geometry alone"
    if switch.field == "priors" and (drive.manifest.gnss is None or not config.use_gnss):
        return "no GNSS: only the calibration has a prior, where it varies"
    return ""


def _row(
    run: stages.Run,
    name: str,
    title: str,
    remark: str,
    truth: Trajectory,
    true_rig_from_cam: Floats,
    seconds: dict[str, float],
) -> Row:
    run.report["findings"] = []
    if name == FULL:
        stages.preflight(run)
    prior = stages.prior(run)
    features = stages.features(run)
    matches = stages.matches(run, features, prior)
    if name == FULL:
        warm_up(run, features, matches, prior)
    scene, _ = stages.refinement(run, stages.mapping(run, features, matches, prior), prior)
    done = {stage["stage"]: stage for stage in run.report["stages"]}
    took = {stage: seconds.get(stage) if report["reused"] else report["seconds"] for stage, report in done.items()}
    if name == FULL:
        seconds |= {stage: s for stage, s in took.items() if s is not None}
    final = done["refinement"]["adjustments"][-1]
    return Row(
        name=name,
        title=title,
        remark=remark,
        registered_images=int(scene.image_registered.sum()),
        total_images=len(scene.image_registered),
        errors=compare_scene(scene, truth, true_rig_from_cam),
        mapping_s=done["mapping"]["seconds"] + done["refinement"]["seconds"],
        whole_s=None if None in took.values() else sum(s for s in took.values() if s is not None),
        parameters=final["parameters"],
        pose_parameters=final["pose_parameters"],
        iterations=final["iterations"],
    )


def warm_up(
    run: stages.Run, features: Sequence[ImageFeatures], matches: Sequence[PairMatches], prior: PriorTrajectory
) -> None:
    """Map and refine the first units, so that no row's time has the loading of compiled code in it."""
    few = run.drive.part(range(WARM_UP_UNITS))
    images = len(few.images)
    bands = RowBands.from_drive(few, compensate=run.config.mapping.motion_compensation)
    among_them = [pair for pair in matches if pair.image_b < images]
    keypoints, pairs = Keypoints.from_matches(few, features[:images], among_them, bands)
    known = prior_trajectory(few, run.config.gnss, use_gnss=prior.gnss is not None)
    poses, absolute = known.world_from_rig, AbsolutePriors.from_trajectory(known)
    try:
        mapped = components.map_drive(few, keypoints, pairs, poses, run.config, absolute=absolute, cancel=run.cancel)
        refine(mapped[0].mapper, AbsolutePriors.from_trajectory(known), cancel=run.cancel)
    except CancelledError:
        raise
    except ReconstructionError:
        return  # what the first units cannot say, the whole drive will
