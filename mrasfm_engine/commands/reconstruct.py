"""`mrasfm reconstruct`: one drive to one scene."""

from __future__ import annotations

import argparse
import json
import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path
from typing import Any

from rich.console import Console

from mrasfm_engine.commands.stage_progress import stage_progress
from mrasfm_engine.config import read_config
from mrasfm_engine.errors import CancelledError, TerminatedError
from mrasfm_engine.freed_memory import loading
from schemas.artifacts import REPORT_FILE, component_folder
from schemas.command_line import output_folder


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "reconstruct",
        help="turn a drive into a scene",
        description="Turn a drive into a scene. An interrupted reconstruction goes on from its last finished stage.",
    )
    parser.add_argument("drive", type=Path, metavar="DRIVE", help="folder with drive.json")
    parser.add_argument("--out", type=output_folder, required=True, metavar="OUT", help="folder for the scene")
    parser.add_argument("--no-gnss", action="store_true", help="ignore GNSS everywhere")
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings (TOML), see mrasfm describe")
    parser.add_argument("--force", action="store_true", help="replace the scene of another drive in OUT")
    parser.add_argument("--json", action="store_true", help="print report.json instead of a summary")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Reconstruct, show progress, and say what there is and how good."""
    config = read_config(arguments.config, **({"use_gnss": False} if arguments.no_gnss else {}))
    # The engine takes a second to load; help and argument errors should not wait for it.
    with loading():
        from mrasfm_engine.compilation import watched_compilation
        from mrasfm_engine.pipeline import reconstruct

    console = Console(stderr=True)
    with (
        cancel_on_interrupt(console) as cancelled,
        watched_compilation(lambda: console.print("compiling for this machine: one to two minutes, once")),
        stage_progress(console) as progress,
    ):
        report = reconstruct(
            arguments.drive,
            arguments.out,
            config,
            progress=progress,
            cancel=cancelled,
            is_new=True,
            force=arguments.force,
        )
    if arguments.json:
        print_report(arguments.out)
    else:
        _say(report, arguments.out)
    return 0


def print_report(out: Path) -> None:
    """Print the report of a scene or map on one line, as it was written."""
    print(json.dumps(json.loads((out / REPORT_FILE).read_text(encoding="utf-8")), ensure_ascii=False))


def print_findings(findings: Sequence[Mapping[str, Any]]) -> None:
    """Print the findings of a report, each with its remedy below it."""
    for finding in findings:
        print(f"  {finding['severity']}: {finding['what']}\n    {finding['remedy']}".rstrip())


@contextmanager
def cancel_on_interrupt(console: Console) -> Iterator[Callable[[], bool]]:
    """Ctrl-C or SIGTERM asks the run to stop where it leaves nothing half-written; a second one stops at once.

    Enter this after the engine is imported: COLMAP's library then installs a handler of SIGTERM that prints its stack.

    Raises
    ------
    TerminatedError
        Where SIGTERM, and not Ctrl-C, ended the run.
    """
    asked = threading.Event()
    received: list[int] = []

    def handle(number: int, frame: object) -> None:
        received.append(number)
        if asked.is_set():
            raise KeyboardInterrupt
        asked.set()
        console.print("stopping; finished stages are kept")

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield asked.is_set
    except (CancelledError, KeyboardInterrupt) as error:
        if received and received[-1] == signal.SIGTERM:
            raise TerminatedError from error
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _say(report: dict[str, Any], out: Path) -> None:
    stages = {stage["stage"]: stage for stage in report["stages"]}
    mapping, refinement = stages["mapping"], stages["refinement"]
    others = mapping["components"][1:]
    between = refinement["between_keyframes"]
    registered = mapping["registered_units"] + between["registered"]
    missing = [*mapping["units_not_registered"], *between["units_not_registered"]]
    units = registered + len(missing) + sum(other["units"] for other in others)
    standing = report.get("standing", {"units": 0})["units"]
    print(f"Scene: {out}")
    print(f"  units registered: {registered} of {units}")
    if standing:
        print(f"  units standing:   {standing} more, posed between the ends of their stops")
    for number, other in enumerate(others, start=1):
        print(f"  component {number}:      {other['units']} units, {out / component_folder(number)}")
    print(f"  points:           {refinement['points']} in {out / 'points.ply'}")
    if refinement["georeferenced"]:
        gnss = refinement["gnss"]
        print(f"  georeferenced:    yes, {gnss['units_used']} positions, residual {gnss['residual_rms_m']:.2f} m RMS")
    else:
        print(f"  georeferenced:    no{' (' + refinement['gnss']['not_used'] + ')' if 'gnss' in refinement else ''}")
    if "scale" in refinement:
        print(f"  scale sigma:      {refinement['scale']['sigma_relative']:.2%}")
    calibration = refinement["calibration"]
    print(f"  calibration:      {'refined' if calibration['adjusted'] else 'held'} ({calibration['reason']})")
    for line in _verdicts(calibration):
        print(f"    {line}")
    for camera, focal in calibration.get("focal_lengths_px", {}).items():
        print(f"    {camera}: intrinsics refined, focal length {focal['refined']:.1f} px, was {focal['given']:.1f}")
    if "pictures" in stages:
        print(f"  road from above:  {_birds_eye(stages['pictures']['birds_eye'], out)}")
    for camera, images in Counter(image["camera"] for image in mapping["images_occluded"]).items():
        print(f"  occluded:         {camera} in {images} images, by something that moves along")
    print_findings(report["findings"])
    for frames, reason in _missing(sorted(missing, key=lambda unit: unit["unit"])):
        print(f"  not registered:   {frames}: {reason}")


def _missing(units: Sequence[dict[str, Any]]) -> Iterator[tuple[str, str]]:
    """Frames without a pose and why, those that follow one another with the same reason at once."""
    # A unit's number less its place in the list is the same as long as units follow one another.
    runs = groupby(enumerate(units), key=lambda item: (item[1]["unit"] - item[0], item[1]["reason"]))
    for (_, reason), members in runs:
        frames = [unit["source_frame"] for _, unit in members]
        yield f"frame {frames[0]}" if len(frames) == 1 else f"frames {frames[0]} to {frames[-1]}", reason


def _verdicts(calibration: dict[str, Any]) -> list[str]:
    """Lines on what the refined calibration rests on, one for all cameras with the same answer."""
    if not calibration["adjusted"] or "observed" not in calibration:
        return []
    by_directions: dict[tuple[str, ...], list[str]] = {}
    for camera, directions in calibration["only_the_prior"].items():
        by_directions.setdefault(tuple(directions), []).append(camera)
    lines = [
        f"{', '.join(cameras)}: "
        + (f"only the prior for {', '.join(names)}" if names else "observed in all directions")
        for names, cameras in by_directions.items()
    ]
    return [*lines, f"all cameras together: held; scale of the rig: {calibration['scale_of_the_rig']}"]


def _birds_eye(seen: dict[str, Any], out: Path) -> str:
    if "not_drawn" in seen:
        return f"not drawn ({seen['not_drawn']})"
    if "not_compared" in seen:
        return f"{out / 'pictures'} ({seen['not_compared']})"
    before, after = (seen[name]["correlation"] for name in ("before", "after"))
    return f"{out / 'pictures'}; views of two cameras correlate by {before:.2f} as given, {after:.2f} now, of 1 at most"
