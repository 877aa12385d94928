"""The part of `mrasfm evaluate` that is about maps."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from mrasfm_engine.commands.named_path import split_name
from mrasfm_engine.errors import InputError
from mrasfm_engine.evaluation.seams import SeamErrors, compare_seam
from mrasfm_engine.evaluation.trajectory import MIN_POSES, TrajectoryErrors, compare_trajectories, match_timestamps
from mrasfm_engine.geometry import se3
from mrasfm_engine.io.read_map import MapPoses, MapSeam, read_map
from mrasfm_engine.io.trajectory_file import Trajectory, read_tum
from mrasfm_engine.types import Floats
from schemas.artifacts import drive_of_scene

TOLERANCE_US = 1000


@dataclass(frozen=True, kw_only=True)
class MapErrors:
    """A map against the truth."""

    connected: TrajectoryErrors  # of the units of scenes that are connected, all at once
    seams: list[tuple[MapSeam, SeamErrors, SeamErrors]]  # in the map, and as positions put the scenes


def evaluate_map(folder: Path, words: list[str]) -> tuple[dict[str, Any], Table]:
    """Compare a map with true poses: the document of `--json`, and the table.

    Parameters
    ----------
    words
        One file with the truth of all drives, or SCENE=FILE for each; that of a drive serves all of its components.
    """
    poses = read_map(folder)
    matched = _matched(poses, _truths(poses, words), folder)
    connected = [name for name in matched if name not in poses.unconnected] or list(matched)
    own, true = (np.concatenate([matched[name][side] for name in connected]) for side in (0, 1))
    if len(own) < MIN_POSES:
        raise InputError(
            f"{folder} and the truth have {len(own)} timestamps in common, {MIN_POSES} are needed",
            remedy="Give the truth of these drives, with timestamps in seconds of the same clock.",
        )
    errors = MapErrors(connected=compare_trajectories(own, true), seams=_seams(poses, matched))
    return _document(poses, errors), _table(poses, errors)


def _truths(poses: MapPoses, words: list[str]) -> dict[str, Trajectory]:
    given = [split_name(word) for word in words]
    named = {name: file for name, file in given if name is not None}
    if named and len(named) != len(words):
        raise InputError(
            "--truth has SCENE=FILE and files without a scene, or a scene twice",
            remedy="Give one file for all drives, or SCENE=FILE once for each.",
        )
    for name in named:
        if name not in {other for scene in poses.trajectories for other in (scene, drive_of_scene(scene))}:
            known = ", ".join(sorted(poses.trajectories))
            raise InputError(
                f"--truth names {name}, which the map does not have",
                remedy=f"Its scenes are {known}. Give a file whose name has '=' as ./FILE.",
            )
    if named:
        files = {name: named.get(name, named.get(drive_of_scene(name))) for name in poses.trajectories}
        return {name: read_tum(file) for name, file in files.items() if file is not None}
    if len(words) != 1:
        raise InputError(
            f"--truth has {len(words)} files", remedy="Give one file for all drives, or SCENE=FILE once for each."
        )
    times = np.concatenate([t.timestamps_us for t in poses.trajectories.values()])
    if len(np.unique(times)) != len(times):
        raise InputError(
            f"drives of the map have timestamps in common, so that {given[0][1]} could be of any of them",
            remedy="Give --truth SCENE=FILE for each drive.",
        )
    return dict.fromkeys(poses.trajectories, read_tum(given[0][1]))


def _matched(poses: MapPoses, truths: dict[str, Trajectory], folder: Path) -> dict[str, tuple[Floats, Floats]]:
    """Estimated and true poses of the units of every scene that has a truth."""
    result = {}
    for name, truth in truths.items():
        own = poses.trajectories[name]
        kept, found = match_timestamps(own.timestamps_us, truth.timestamps_us, tolerance_us=TOLERANCE_US)
        if len(kept):
            result[name] = (own.world_from_rig[kept], truth.world_from_rig[found])
    if not result:
        raise InputError(
            f"{folder} and the truth have no timestamp in common within {TOLERANCE_US / 1000:g} ms",
            remedy="Give the truth of these drives, with timestamps in seconds of the same clock.",
        )
    return result


def _seams(poses: MapPoses, matched: dict[str, tuple[Floats, Floats]]) -> list[tuple[MapSeam, SeamErrors, SeamErrors]]:
    result = []
    for seam in poses.seams:
        if seam.a not in matched or seam.b not in matched:
            continue
        (a, true_a), (b, true_b) = matched[seam.a], matched[seam.b]
        # As positions put scene b beside scene a.
        lies = poses.map_from_scene[seam.a] @ seam.coarse_a_from_b @ se3.inverse(poses.map_from_scene[seam.b])
        fine, coarse = (compare_seam(a, other, true_a, true_b) for other in (b, lies @ b))
        if fine is not None and coarse is not None:
            result.append((seam, fine, coarse))
    return result


def _document(poses: MapPoses, errors: MapErrors) -> dict[str, Any]:
    all_units = errors.connected
    return {
        "registered_units": sum(len(t.timestamps_us) for t in poses.trajectories.values()),
        "total_units": poses.total_units,
        "registered_images": poses.registered_images,
        "total_images": poses.total_images,
        "units_with_truth": all_units.poses,
        "metric": {
            "rmse_m": all_units.metric_rmse_m,
            "median_m": all_units.metric_median_m,
            "rotation_median_deg": all_units.rotation_median_deg,
        },
        "similarity": {"rmse_m": all_units.similarity_rmse_m, "scale": all_units.similarity_scale},
        "seams": [
            {
                "a": seam.a,
                "b": seam.b,
                "translation_m": fine.translation_m,
                "rotation_deg": fine.rotation_deg,
                "units": fine.units,
                "coarse": {"translation_m": coarse.translation_m, "rotation_deg": coarse.rotation_deg},
            }
            for seam, fine, coarse in errors.seams
        ],
        "unconnected": poses.unconnected,
    }


def _table(poses: MapPoses, errors: MapErrors) -> Table:
    table, all_units = Table(show_header=False), errors.connected
    registered = sum(len(t.timestamps_us) for t in poses.trajectories.values())
    table.add_row("units", f"{registered} of {poses.total_units} registered")
    table.add_row("units with truth, connected", f"{all_units.poses}")
    table.add_row("position, metric", f"rmse {all_units.metric_rmse_m:.4f} m, median {all_units.metric_median_m:.4f} m")
    table.add_row("rotation", f"median {all_units.rotation_median_deg:.4f} deg")
    for seam, fine, coarse in errors.seams:
        table.add_row(
            f"seam {seam.a} - {seam.b}",
            f"{fine.translation_m:.4f} m, {fine.rotation_deg:.4f} deg "
            f"(by positions {coarse.translation_m:.2f} m, {coarse.rotation_deg:.2f} deg)",
        )
    table.add_row("unconnected", ", ".join(poses.unconnected) or "none")
    return table


def show(table: Table) -> None:
    """Print the table."""
    Console().print(table)
