"""`mrasfm ablate`: what every part of the method is worth on a drive whose truth is known."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.table import Table

from mrasfm_engine.commands.work_folder import work_folder, write_document
from mrasfm_engine.config import read_config
from mrasfm_engine.errors import InputError
from mrasfm_engine.io.read_scene import read_calibration
from mrasfm_engine.io.trajectory_file import read_tum
from mrasfm_engine.preflight.drive_reader import read_drive
from schemas.command_line import output_folder

if TYPE_CHECKING:
    from mrasfm_engine.ablation import Row
    from mrasfm_engine.evaluation.pose_errors import PoseErrors

RESULT = "ablation.json"
TRUE_CALIBRATION = "truth_calibration.json"  # as `mrasfm synth` calls it


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "ablate",
        help="reconstruct a drive without each part of the method, and compare",
        description="Reconstruct a drive with every part of the method and once more without each part, and compare "
        "the results with the truth.",
    )
    parser.add_argument("drive", type=Path, metavar="DRIVE", help="folder with drive.json")
    parser.add_argument(
        "--truth", type=Path, required=True, metavar="FILE", help="true poses of the rig in TUM's format"
    )
    parser.add_argument(
        "--truth-calibration",
        type=Path,
        metavar="FILE",
        help=f"true poses of the cameras in the rig (default: {TRUE_CALIBRATION} beside the truth, else as given)",
    )
    parser.add_argument("--out", type=output_folder, metavar="DIR", help=f"keep stages and {RESULT} in this folder")
    parser.add_argument(
        "--only",
        action="append",
        default=[],
        metavar="SWITCH",
        help="setting of one part, as in mapping.camera_set_registration; may be repeated (default: all parts)",
    )
    parser.add_argument("--no-gnss", action="store_true", help="ignore GNSS everywhere")
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings (TOML), see mrasfm describe")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Reconstruct as often as needed, and print the table."""
    config = read_config(arguments.config, **({"use_gnss": False} if arguments.no_gnss else {}))
    truth = read_tum(arguments.truth)
    calibration, source = _true_calibration(arguments)
    from mrasfm_engine.ablation import ablate, switches_named
    from mrasfm_engine.commands.reconstruct import cancel_on_interrupt
    from mrasfm_engine.commands.stage_progress import stage_progress

    switches, console = switches_named(arguments.only), Console(stderr=True)
    with work_folder(arguments.out, prefix="mrasfm-ablation-") as work:
        with cancel_on_interrupt(console) as cancelled, stage_progress(console) as bars:
            rows = ablate(
                arguments.drive,
                truth,
                config,
                true_rig_from_cam=calibration,
                switches=switches,
                work=work,
                progress=lambda row, stage, done, total: bars(f"{row}: {stage}", done, total),
                cancel=cancelled,
            )
        document = _document(rows, source)
        if arguments.out is not None:
            write_document(document, work / RESULT)
    if arguments.json:
        print(json.dumps(document, allow_nan=False))
    else:
        _print_table(rows, source)
    return 0


def _true_calibration(arguments: argparse.Namespace) -> tuple[np.ndarray | None, str]:
    """True `rig_from_cam` (cameras, 4, 4), None for the given one; and what it is."""
    path = arguments.truth_calibration or arguments.truth.parent / TRUE_CALIBRATION
    if arguments.truth_calibration is None and not path.is_file():
        return None, "as given"
    poses = read_calibration(path)
    names = [camera.name for camera in read_drive(arguments.drive).cameras]
    if missing := [name for name in names if name not in poses]:
        raise InputError(
            f"{path} has no pose of {', '.join(missing)}", remedy="Give the calibration of this drive's cameras."
        )
    return np.stack([poses[name] for name in names]), str(path)


def _document(rows: Sequence[Row], source: str) -> dict[str, Any]:
    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(v) for key, v in value.items()}
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return {"true_calibration": source, "rows": [plain(asdict(row)) for row in rows]}


def _print_table(rows: Sequence[Row], source: str) -> None:
    """Measures down, reconstructions across: so it fits into a terminal."""
    console, table = Console(), Table()
    table.add_column("")
    for row in rows:
        table.add_column(row.title, justify="right")
    for measure, of in MEASURES.items():
        table.add_row(measure, *(of(row) for row in rows))
    console.print(table)
    console.print(f"Images are compared under the calibration {source}.", soft_wrap=True)
    for row in rows:
        if row.remark:
            console.print(f"{row.title}: {row.remark}", soft_wrap=True)


def _error(measure: Callable[[PoseErrors], float]) -> Callable[[Row], str]:
    return lambda row: "-" if row.errors is None else _number(measure(row.errors), 4)


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


MEASURES: Mapping[str, Callable[[Row], str]] = {
    "images registered": lambda row: str(row.registered_images),
    "units: metric RMSE, m": _error(lambda e: e.units.metric_rmse_m),
    "  after similarity, m": _error(lambda e: e.units.similarity_rmse_m),
    "  rotation, deg": _error(lambda e: e.units.rotation_median_deg),
    "  one to next, deg": _error(lambda e: e.relative_rotation_median_deg),
    "images: metric RMSE, m": _error(lambda e: e.images.metric_rmse_m),
    "  similarity, m": _error(lambda e: e.images.similarity_rmse_m),
    "  rotations, deg": _error(lambda e: e.images.rotation_median_deg),
    "  camera to camera, deg": _error(lambda e: e.camera_rotation_median_deg),
    "parameters": lambda row: str(row.parameters),
    "  of poses": lambda row: str(row.pose_parameters),
    "iterations": lambda row: str(row.iterations),
    "mapping, s": lambda row: _number(row.mapping_s, 1),
    "whole, s": lambda row: _number(row.whole_s, 1),
}
