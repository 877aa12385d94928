"""`mrasfm bench`: time, memory and error beside other mappers, on simulated paths and on published data sets."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from rich.console import Console

from mrasfm_engine.commands.work_folder import work_folder, write_document
from mrasfm_engine.config import read_config
from mrasfm_engine.errors import InputError
from schemas.command_line import output_folder

RESULT = "bench.json"
DEFAULT_UNITS = "100"

# Which options go with which of the things to measure on.
OF_DRIVE, OF_SIMULATION = {"truth"}, {"units", "seed", "descriptors"}
OF_KITTI, OF_NUSCENES = {"sequences", "frames"}, {"scenes", "frames", "sweeps", "no_rough_poses"}


def register(subparsers: Any) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "bench",
        help="measure time, memory and error, also beside COLMAP",
        description="Measure on one of: a drive (DRIVE), simulated paths (--simulate), KITTI odometry (--kitti), "
        "nuScenes (--nuscenes). Every mapper runs in its own process, on the same features and matches.",
    )
    parser.add_argument("drive", nargs="?", type=Path, metavar="DRIVE", help="folder with drive.json")
    parser.add_argument("--truth", type=Path, metavar="FILE", help="true poses (TUM's format); else DRIVE's truth.tum")
    parser.add_argument("--simulate", metavar="RIG", help="long paths without images: stereo or surround")
    parser.add_argument(
        "--units", metavar="N[,N]", help=f"number of units of each path, one per metre (default: {DEFAULT_UNITS})"
    )
    parser.add_argument("--seed", type=int, help="everything random about the paths follows from it (default: 0)")
    parser.add_argument(
        "--descriptors",
        action="store_const",
        const=True,
        help="begin each path with descriptors on disk, and match them; else with matches",
    )
    parser.add_argument("--kitti", type=Path, metavar="FOLDER", help="KITTI odometry: sequences/ and poses/")
    parser.add_argument("--sequences", metavar="LIST", help="as 00-10 or 00,05 (default: all that have true poses)")
    parser.add_argument("--nuscenes", type=Path, metavar="FOLDER", help="nuScenes: v1.0-*/ and samples/")
    parser.add_argument("--scenes", metavar="LIST", help="names of scenes, separated by commas (default: all)")
    parser.add_argument(
        "--sweeps", action="store_true", default=None, help="all images of nuScenes, at 12 Hz, not the keyframes alone"
    )
    parser.add_argument(
        "--no-rough-poses",
        action="store_true",
        default=None,
        help="of nuScenes nothing but images; else the true poses with noise of 0.5 m and 2 deg are rough poses",
    )
    parser.add_argument("--frames", metavar="START:STOP:STEP", help="slice of the frames of every sequence or scene")
    parser.add_argument(
        "--baselines",
        default="",
        metavar="LIST",
        help="baseline mappers, separated by commas: colmap-incremental, colmap-global, and both with -fixed, which "
        "hold the calibration",
    )
    parser.add_argument("--repeat", type=int, default=1, metavar="N", help="mappings; the one of median time counts")
    parser.add_argument(
        "--timeout-s", type=float, default=float("inf"), metavar="S", help="for one mapping (default: none)"
    )
    parser.add_argument("--no-gnss", action="store_true", help="ignore GNSS everywhere")
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings (TOML), see mrasfm describe")
    parser.add_argument(
        "--out", type=output_folder, metavar="DIR", help=f"keep features, matches and {RESULT} in this folder"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of tables")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Measure, and print tables or JSON."""
    _require_one_kind(arguments)
    config = read_config(arguments.config, **({"use_gnss": False} if arguments.no_gnss else {}))
    from mrasfm_engine.benchmark.side_by_side import Settings, baselines_named
    from mrasfm_engine.commands import bench_output
    from mrasfm_engine.commands.reconstruct import cancel_on_interrupt
    from mrasfm_engine.commands.stage_progress import stage_progress

    console = Console(stderr=True)
    with work_folder(arguments.out, prefix="mrasfm-bench-") as work:
        with cancel_on_interrupt(console) as cancelled, stage_progress(console) as bars:
            settings = Settings(
                config=config,
                baselines=baselines_named(arguments.baselines),
                repeat=arguments.repeat,
                timeout_s=arguments.timeout_s,
                progress=lambda row, stage, done, total: bars(f"{row}: {stage}", done, total),
                cancel=cancelled,
            )
            output = _measure(arguments, work, settings)
        document = bench_output.versions(config) | output.document()
        if arguments.out is not None:
            write_document(document, work / RESULT)
    if arguments.json:
        print(json.dumps(document, allow_nan=False))
    else:
        output.print()
    return 0


def _require_one_kind(arguments: argparse.Namespace) -> None:
    kinds = {"DRIVE": OF_DRIVE, "--simulate": OF_SIMULATION, "--kitti": OF_KITTI, "--nuscenes": OF_NUSCENES}
    given = [kind for kind in kinds if getattr(arguments, kind.strip("-").lower()) is not None]
    if len(given) != 1:
        raise InputError(
            f"bench measures on one thing, not on {' and '.join(given) or 'nothing'}",
            remedy=f"Give one of {', '.join(kinds)}.",
        )
    for option in sorted(set().union(*kinds.values()) - kinds[given[0]]):
        if getattr(arguments, option) is not None:
            of = " or ".join(kind for kind, options in kinds.items() if option in options)
            raise InputError(
                f"--{option.replace('_', '-')} does not go with {given[0]}", remedy=f"Leave it out; it goes with {of}."
            )


def _measure(arguments: argparse.Namespace, work: Path, settings: Any) -> Any:
    from mrasfm_engine.benchmark import datasets, scaling
    from mrasfm_engine.benchmark.side_by_side import TRUTH, compare_mappers
    from mrasfm_engine.commands import bench_datasets_output, bench_output
    from mrasfm_engine.io.trajectory_file import read_tum

    if arguments.simulate is not None:
        lengths = _lengths(arguments.units or DEFAULT_UNITS)
        return bench_output.GrowthOutput(
            scaling.measure_growth(
                arguments.simulate,
                lengths,
                arguments.seed or 0,
                work,
                settings,
                descriptors=bool(arguments.descriptors),
            )
        )
    if arguments.kitti is not None:
        sequences = datasets.kitti_sequences(arguments.kitti, arguments.sequences)
        return bench_datasets_output.KittiOutput(
            datasets.bench_kitti(arguments.kitti, sequences, work, settings, frames=arguments.frames)
        )
    if arguments.nuscenes is not None:
        scenes = datasets.nuscenes_scenes(arguments.nuscenes, arguments.scenes)
        noise = None if arguments.no_rough_poses else datasets.ROUGH_NOISE
        results = datasets.bench_nuscenes(
            arguments.nuscenes,
            scenes,
            work,
            settings,
            frames=arguments.frames,
            sweeps=bool(arguments.sweeps),
            rough_noise=noise,
        )
        return bench_datasets_output.NuScenesOutput(results, datasets.nuscenes_setting(bool(arguments.sweeps), noise))
    truth = arguments.truth
    if truth is None and (arguments.drive / TRUTH).is_file():
        truth = arguments.drive / TRUTH
    return bench_output.DriveOutput(
        compare_mappers(arguments.drive, None if truth is None else read_tum(truth), work, settings)
    )


def _lengths(text: str) -> list[int]:
    try:
        return list(dict.fromkeys(int(part) for part in text.split(",")))
    except ValueError:
        raise InputError(
            f"--units {text!r} is not a number, nor a list of them", remedy="Give numbers as 100 or 100,500,2000."
        ) from None
