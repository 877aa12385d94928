"""`mrasfm evaluate`: how far a scene's or a map's trajectory is from the truth."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from mrasfm_engine.commands.evaluate_map import evaluate_map, show
from mrasfm_engine.errors import InputError
from mrasfm_engine.evaluation.trajectory import MIN_POSES, TrajectoryErrors, compare_trajectories, match_timestamps
from mrasfm_engine.io.read_map import is_map
from mrasfm_engine.io.read_scene import ScenePoses, read_poses
from mrasfm_engine.io.trajectory_file import read_tum

TOLERANCE_US = 1000


def register(subparsers: Any) -> None:
    """Add the `evaluate` parser."""
    parser = subparsers.add_parser(
        "evaluate",
        # argparse would put OUT last, where the option's files take it for one of theirs
        usage="%(prog)s [-h] OUT --truth FILE [FILE ...] [--json]",
        help="compare a scene's or map's trajectory with the truth",
        description="Compare the trajectory of a scene or a map with true poses: errors before and after "
        "alignment, and the errors of a map's seams.",
    )
    parser.add_argument(
        "scene", type=Path, metavar="OUT", help="the folder that `mrasfm reconstruct` or `mrasfm aggregate` wrote"
    )
    parser.add_argument(
        "--truth",
        nargs="+",
        required=True,
        metavar="FILE",
        help="true poses of the rig in TUM's format; of a map one file for all drives, or SCENE=FILE for each",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Compare and print."""
    if is_map(arguments.scene):
        document, table = evaluate_map(arguments.scene, arguments.truth)
        if arguments.json:
            print(json.dumps(document, allow_nan=False))
        else:
            show(table)
        return 0
    scene = read_poses(arguments.scene)
    if len(arguments.truth) != 1:
        raise InputError(f"--truth has {len(arguments.truth)} files", remedy="A scene has one: give one FILE.")
    file = Path(arguments.truth[0])
    truth = read_tum(file)
    kept, matched = match_timestamps(scene.trajectory.timestamps_us, truth.timestamps_us, tolerance_us=TOLERANCE_US)
    if len(kept) < MIN_POSES:
        raise InputError(
            f"{arguments.scene} and {file} have {len(kept)} timestamps in common within "
            f"{TOLERANCE_US / 1000:g} ms, {MIN_POSES} are needed",
            remedy="Give the truth of this drive, with timestamps in seconds of the same clock.",
        )
    errors = compare_trajectories(scene.trajectory.world_from_rig[kept], truth.world_from_rig[matched])
    if arguments.json:
        print(json.dumps(_summary(scene, errors), allow_nan=False))
    else:
        _print_table(scene, errors)
    return 0


def _summary(scene: ScenePoses, errors: TrajectoryErrors) -> dict[str, Any]:
    return {
        "registered_units": len(scene.trajectory.timestamps_us),
        "registered_images": scene.registered_images,
        "total_images": scene.total_images,
        "metric": {
            "rmse_m": errors.metric_rmse_m,
            "median_m": errors.metric_median_m,
            "rotation_median_deg": errors.rotation_median_deg,
        },
        "similarity": {"rmse_m": errors.similarity_rmse_m, "scale": errors.similarity_scale},
    }


def _print_table(scene: ScenePoses, errors: TrajectoryErrors) -> None:
    table = Table(show_header=False)
    table.add_row("units", f"{len(scene.trajectory.timestamps_us)} of {scene.total_units} registered")
    table.add_row("images", f"{scene.registered_images} of {scene.total_images} registered")
    table.add_row("units with truth", f"{errors.poses}")
    table.add_row("position, metric", f"rmse {errors.metric_rmse_m:.4f} m, median {errors.metric_median_m:.4f} m")
    table.add_row("rotation", f"median {errors.rotation_median_deg:.4f} deg")
    table.add_row("position, similarity", f"rmse {errors.similarity_rmse_m:.4f} m, scale {errors.similarity_scale:.6f}")
    Console().print(table)
