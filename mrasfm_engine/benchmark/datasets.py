"""Published data sets, reconstructed scene by scene: KITTI odometry and nuScenes in the layouts they come in."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mrasfm_engine.benchmark.side_by_side import TRUTH, Comparison, Settings, compare_mappers
from mrasfm_engine.errors import InputError, ReconstructionError
from mrasfm_engine.evaluation.trajectory import MIN_POSES
from mrasfm_engine.geometry.alignment import align_rigid
from mrasfm_engine.importers import nuscenes
from mrasfm_engine.importers.layouts import import_recording
from mrasfm_engine.importers.recording import RoughQuality
from mrasfm_engine.io.trajectory_file import read_tum
from mrasfm_engine.types import Floats

STEREO_PAIRS = (("image_0", "image_1"), ("image_2", "image_3"))  # of KITTI; the grey one is preferred

# Of the rough poses of nuScenes: what a usual receiver with a compass and an odometer gives.
ROUGH_NOISE = RoughQuality(sigma_m=0.5, sigma_deg=2.0)


@dataclass(frozen=True, kw_only=True)
class SceneResult:
    """One sequence or scene: what came out, or why nothing did."""

    name: str
    comparison: Comparison | None
    failure: str = ""


def kitti_sequences(folder: Path, wanted: str | None) -> list[str]:
    """Names of sequences, two digits each, that are there with images and true poses.

    Parameters
    ----------
    wanted
        As `00-10` or `00,05,07-08`; None for all that have true poses.

    Raises
    ------
    InputError
        That names the sequence that is not there or has no truth.
    """
    there = sorted(path.name for path in (folder / "sequences").glob("[0-9][0-9]") if path.is_dir())
    if not there:
        raise InputError(
            f"{folder} has no sequences/00 and so on",
            remedy="Give the folder of KITTI odometry that holds sequences and poses.",
            code="unknown-layout",
        )
    if wanted is None:
        names = [name for name in there if _has_truth(folder, name)]
        if not names:
            raise InputError(f"no sequence of {folder} has true poses", remedy="Unpack poses/00.txt and so on.")
        return names
    names = _named(wanted)
    for name in names:
        if name not in there:
            raise InputError(
                f"--sequences {wanted}: {folder / 'sequences' / name} does not exist",
                remedy=f"There are {', '.join(there)}.",
                code="unknown-sequence",
            )
        if not _has_truth(folder, name):
            raise InputError(
                f"sequence {name} has no true poses: {folder / 'poses' / name}.txt does not exist",
                remedy="Unpack the benchmark's poses; of sequences 11 to 21 there are none.",
                code="missing-poses",
            )
    return names


def _named(text: str) -> list[str]:
    names: list[str] = []
    for part in text.split(","):
        found = re.fullmatch(r"\s*(\d{1,2})(?:-(\d{1,2}))?\s*", part)
        first, last = (0, -1) if found is None else (int(found[1]), int(found[2] or found[1]))
        if last < first:
            raise InputError(
                f"--sequences {text!r}: {part!r} is no sequence and no range of them", remedy="Give 00-10 or 00,05,07."
            )
        names += [f"{number:02d}" for number in range(first, last + 1)]
    return list(dict.fromkeys(names))


def _has_truth(folder: Path, name: str) -> bool:
    return (folder / "poses" / f"{name}.txt").is_file() or (folder / "sequences" / name / "poses.txt").is_file()


def bench_kitti(
    folder: Path, sequences: Sequence[str], work: Path, settings: Settings, *, frames: str | None = None
) -> list[SceneResult]:
    """Reconstruct sequences from one stereo pair each, the grey one where there are both.

    Parameters
    ----------
    frames
        A slice START:STOP:STEP of every sequence's frames.

    Raises
    ------
    InputError
        Before anything is reconstructed, where a sequence is incomplete.
    """
    drives = []
    for name in sequences:
        sequence, drive = folder / "sequences" / name, work / f"kitti-{name}" / "drive"
        pair = next((pair for pair in STEREO_PAIRS if all((sequence / camera).is_dir() for camera in pair)), None)
        import_recording(sequence, drive, frames=frames, cameras=pair, force=True)
        drives.append(drive)
    return [_bench(name, drive, settings) for name, drive in zip(sequences, drives, strict=True)]


def nuscenes_scenes(folder: Path, wanted: str | None) -> list[str]:
    """Names of scenes from a list separated by commas; None for all of the table.

    Raises
    ------
    InputError
        That names the scene that is not in the table.
    """
    there = nuscenes.scene_names(folder)
    if wanted is None:
        return there
    names = [name.strip() for name in wanted.split(",") if name.strip()]
    for name in names:
        if name not in there:
            raise InputError(
                f"--scenes: {folder} has no scene {name!r}",
                remedy=f"There are {', '.join(there[:20])}{' and more' if len(there) > 20 else ''}.",
                code="unknown-scene",
            )
    return list(dict.fromkeys(names))


def bench_nuscenes(
    folder: Path,
    scenes: Sequence[str],
    work: Path,
    settings: Settings,
    *,
    frames: str | None = None,
    sweeps: bool = False,
    rough_noise: RoughQuality | None = ROUGH_NOISE,
) -> list[SceneResult]:
    """Reconstruct scenes with all cameras.

    The method takes rough poses of the vehicle, which nuScenes does not have beside the true ones: they are those with
    noise. Errors are against the true poses without it.

    Parameters
    ----------
    frames
        A slice START:STOP:STEP of every scene's frames.
    sweeps
        Whether all images are taken, at 12 Hz, not the keyframes alone.
    rough_noise
        None: there are no rough poses.

    Raises
    ------
    InputError
        Before anything is reconstructed, where a table or an image is missing.
    """
    drives = []
    options = {"sweeps": True} if sweeps else {}
    for name in scenes:
        drive = work / f"nuscenes-{name}" / "drive"
        import_recording(folder, drive, scene=name, frames=frames, options=options, rough_noise=rough_noise, force=True)
        drives.append(drive)
    return [_bench(name, drive, settings) for name, drive in zip(scenes, drives, strict=True)]


def nuscenes_setting(sweeps: bool, rough_noise: RoughQuality | None) -> str:
    """A sentence on what `bench_nuscenes` reconstructs."""
    images = "All images, at 12 Hz" if sweeps else "Keyframes, at 2 Hz"
    if rough_noise is None:
        return f"{images}, without rough poses."
    return (
        f"{images}, with rough poses: the true ones with noise of {rough_noise.sigma_m:g} m and "
        f"{rough_noise.sigma_deg:g} deg along and about each axis."
    )


def _bench(name: str, drive: Path, settings: Settings) -> SceneResult:
    truth = drive / TRUTH
    try:
        found = compare_mappers(drive, read_tum(truth) if truth.is_file() else None, drive.parent / "stages", settings)
    except (InputError, ReconstructionError) as error:
        return SceneResult(name=name, comparison=None, failure=error.what)
    return SceneResult(name=name, comparison=found)


def planar_rmse_m(estimate: Floats, truth: Floats) -> float | None:
    """RMSE of x and y of positions after one rigid alignment in space, for a truth that knows no heights.

    Parameters
    ----------
    estimate, truth
        Poses (units, 4, 4), NaN where there is none; z of the truth's world is up. None for fewer than 3 of both.
    """
    known = np.isfinite(estimate[:, 0, 0]) & np.isfinite(truth[:, 0, 0])
    if known.sum() < MIN_POSES:
        return None
    positions, true = estimate[known, :3, 3], truth[known, :3, 3]
    away = align_rigid(true, positions, collinear_ratio=0.0).apply(positions) - true
    return float(np.sqrt((away[:, :2] ** 2).sum(1).mean()))
