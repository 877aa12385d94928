"""`mrasfm import`: a recording in a known layout becomes a drive."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mrasfm_engine.importers.layouts import import_recording


def register(subparsers: Any) -> None:
    """Add the command to the `mrasfm` parser."""
    parser = subparsers.add_parser(
        "import",
        help="turn a recording (rig folder, KITTI, nuScenes, PandaSet) into a drive",
        description="Turn a recording into a drive. The layout is recognised: a folder with rig.json, a sequence of "
        "KITTI odometry, a drive of KITTI raw, nuScenes, or PandaSet.",
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="the recording")
    parser.add_argument("--out", type=Path, required=True, metavar="DRIVE", help="folder of the drive")
    parser.add_argument(
        "--frames",
        metavar="START:STOP:STEP",
        help="slice of the frames, STOP not included; where START is negative, write --frames=-10:",
    )
    parser.add_argument("--gnss", type=Path, metavar="FILE", help="GNSS table, in FOLDER or the working directory")
    parser.add_argument("--scene", metavar="NAME", help="name of the scene, if the recording holds several")
    parser.add_argument(
        "--vehicle", metavar="NAME", help="which vehicle drove, where the recording does not say or is wrong"
    )
    parser.add_argument(
        "--truth",
        action="store_true",
        help="write truth.tum also where the true poses and the GNSS come from one system (KITTI raw)",
    )
    files = parser.add_mutually_exclusive_group()
    files.add_argument("--link", action="store_true", help="hard-link images where possible (the default)")
    files.add_argument("--copy", action="store_true", help="copy images")
    parser.add_argument("--force", action="store_true", help="replace a drive that is already at DRIVE")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a summary")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Import and print what was written."""
    summary = import_recording(
        arguments.folder,
        arguments.out,
        frames=arguments.frames,
        gnss_file=arguments.gnss,
        scene=arguments.scene,
        vehicle=arguments.vehicle,
        truth=arguments.truth,
        copy=arguments.copy,
        force=arguments.force,
    )
    if arguments.json:
        print(json.dumps(asdict(summary), default=str))
        return 0
    print(
        f"Imported {arguments.folder} ({summary.layout}): {summary.cameras} cameras, {summary.units} units, "
        f"{summary.images} images\n"
        f"  GNSS samples: {summary.gnss_samples}\n"
        f"  rough poses:  {summary.rough_poses}\n"
        f"  masks:        {summary.masks}\n"
        f"  truth:        {'yes, in truth.tum' if summary.truth else 'no'}\n"
        f"  drive:        {summary.drive}"
    )
    return 0
