"""`mrasfm aggregate`: several scenes to one map."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rich.console import Console

from mrasfm_engine.commands.named_path import split_name
from mrasfm_engine.commands.reconstruct import cancel_on_interrupt, print_findings, print_report
from mrasfm_engine.commands.stage_progress import stage_progress
from mrasfm_engine.config import read_config
from mrasfm_engine.errors import InputError
from mrasfm_engine.freed_memory import loading
from schemas.command_line import output_folder

SHOWN_SIGMAS, SHOWN_DIFFERENCE = 2.0, 0.001  # of lengths of two scenes


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "aggregate",
        help="join scenes to a map",
        description="Find the seams between scenes of several drives and join them to one map.",
    )
    parser.add_argument(
        "scenes", nargs="*", metavar="SCENE", help="folders that `mrasfm reconstruct` wrote, or NAME=FOLDER"
    )
    parser.add_argument(
        "--out", type=output_folder, metavar="MAP", help="folder for the map; with --into by default that one"
    )
    parser.add_argument("--into", type=Path, metavar="MAP", help="add the scenes to this map")
    parser.add_argument("--remove", action="append", default=[], metavar="NAME", help="take a scene out of the map")
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings (TOML), see mrasfm describe")
    parser.add_argument("--json", action="store_true", help="print report.json instead of a summary")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Aggregate, show progress, and say what is connected and how well."""
    out = arguments.out or arguments.into
    if out is None:
        raise InputError("no folder for the map is given", remedy="Give --out MAP, or --into MAP to extend one.")
    config = read_config(arguments.config)
    scenes = _named(arguments.scenes)
    # The engine takes a second to load; help and argument errors should not wait for it.
    with loading():
        from mrasfm_engine.aggregation import aggregate
        from mrasfm_engine.aggregation.stages import map_document

    console = Console(stderr=True)
    with cancel_on_interrupt(console) as cancelled, stage_progress(console) as progress:
        report = aggregate(
            scenes, out, config, into=arguments.into, remove=arguments.remove, progress=progress, cancel=cancelled
        )
    if arguments.json:
        print_report(out)
    else:
        _say(report, map_document(out), out)
    return 0


def _named(words: list[str]) -> dict[str, Path]:
    """Scenes by name; a folder without one has its own."""
    from mrasfm_engine.aggregation.load import duplicate_scene, like_named

    result: dict[str, Path] = {}
    for word in words:
        given, path = split_name(word)
        name = path.resolve().name if given is None else given
        alike = like_named(name, result)
        if alike is not None:
            raise duplicate_scene(name, path, alike, result[alike])
        result[name] = path
    return result


def _say(report: dict[str, Any], document: dict[str, Any], out: Path) -> None:
    summary, scenes = report["summary"], document["scenes"]
    connected = [scene["name"] for scene in scenes if scene["name"] not in document["unconnected"]]
    print(f"Map: {out}")
    print(f"  scenes connected: {len(connected)} of {len(scenes)}")
    print(f"  units registered: {summary['registered_units']} of {summary['total_units']}")
    print(f"  points:           {summary['points']} in {out / 'points.ply'}")
    for seam in document["seams"]:
        if seam["accepted"]:
            print(f"  {seam_line(seam)}")
        else:
            print(f"  no seam {seam['a']} - {seam['b']}: {seam['reason']}")
    print_findings(report["findings"])


def seam_line(seam: dict[str, Any]) -> str:
    """An accepted seam of `map.json` in a line."""
    off = f", positions were {seam['positions_off_m']:.2f} m off" if "positions_off_m" in seam else ""
    scale, sigma = seam.get("scale", 1.0), seam.get("sigma_scale", 0.0)
    differ = abs(scale - 1.0) > SHOWN_SIGMAS * sigma and abs(scale - 1.0) >= SHOWN_DIFFERENCE
    lengths = f", lengths differ by {100 * abs(scale - 1.0):.1f} %" if differ else ""
    return (
        f"seam {seam['a']} - {seam['b']}: {seam['inliers']} shared points, "
        f"residual {seam['residual_before_px']:.1f} -> {seam['residual_after_px']:.2f} px, "
        f"before the last adjustment sigma {100 * seam['sigma_translation_m']:.1f} cm "
        f"{seam['sigma_rotation_deg']:.3f} deg{lengths}{off}"
    )
