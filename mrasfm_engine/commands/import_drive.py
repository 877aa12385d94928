"""`mrasfm import`: a recording in a known layout becomes a drive."""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mrasfm_engine.importers.layouts import import_recording
from mrasfm_engine.importers.recording import RoughQuality
from schemas.command_line import output_folder

OPTIONS = (
    "forward_camera",
    "rate_hz",
    "topics",
    "rig_frame",
    "world_frame",
    "calibration",
    "antenna_m",
    "gnss_sigma_m",
    "sweeps",
)  # of single layouts
MAX_SIGMA_M = 1000.0


def register(subparsers: Any) -> None:
    """Add the command to the `mrasfm` parser."""
    parser = subparsers.add_parser(
        "import",
        help="turn a recording (ROS bag, rig folder, data set, COLMAP rig) into a drive",
        description="Turn a recording into a drive. The layout is recognised: a folder with rig.json, a sequence of "
        "KITTI odometry, a drive of KITTI raw, nuScenes, PandaSet, Argoverse 2, Waymo (version 2), COLMAP's "
        "rig_config.json, or a ROS bag (ROS 1, or ROS 2 in MCAP or SQLite).",
    )
    parser.add_argument("folder", type=Path, metavar="RECORDING", help="the recording: a folder, or a bag's file")
    parser.add_argument("--out", type=output_folder, required=True, metavar="DRIVE", help="folder of the drive")
    parser.add_argument(
        "--frames",
        metavar="START:STOP:STEP",
        help="slice of the frames, STOP not included; where START is negative, write --frames=-10:",
    )
    parser.add_argument("--gnss", type=Path, metavar="FILE", help="GNSS table, in RECORDING or the working directory")
    parser.add_argument("--cameras", type=_words, metavar="NAME,...", help="cameras that are wanted (default: all)")
    parser.add_argument("--scene", metavar="NAME", help="name of the scene, if the recording holds several")
    parser.add_argument("--name", help="what the drive is called, and its scene (default: as the recording)")
    parser.add_argument(
        "--vehicle", metavar="NAME", help="which vehicle drove, where the recording does not say or is wrong"
    )
    parser.add_argument(
        "--truth",
        action="store_true",
        help="write truth.tum also where the true poses and the GNSS come from one system (KITTI raw)",
    )
    parser.add_argument(
        "--rough-noise",
        type=_rough_quality,
        metavar="METRES,DEGREES",
        help="the recording's poses (nuScenes, Argoverse 2, ...) with this noise become rough poses: a trial of drives "
        "without GNSS",
    )
    parser.add_argument(
        "--sweeps", action="store_true", default=None, help="of nuScenes all images, at 12 Hz, not the keyframes alone"
    )
    _add_layout_options(parser)
    files = parser.add_mutually_exclusive_group()
    files.add_argument("--link", action="store_true", help="hard-link images where possible (the default)")
    files.add_argument("--copy", action="store_true", help="copy images")
    parser.add_argument("--force", action="store_true", help="replace a drive that is already at DRIVE")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a summary")
    parser.set_defaults(run=run)


def _add_layout_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--antenna",
        dest="antenna_m",
        type=_three_numbers,
        metavar="X,Y,Z",
        help="of a bag or a COLMAP rig: the receiver's antenna in the rig frame, metres forward, left and up; with a "
        "minus: --antenna=-1,0,2",
    )
    parser.add_argument(
        "--gnss-sigma",
        dest="gnss_sigma_m",
        type=_positive,
        metavar="METRES",
        help="of a bag or a COLMAP rig: standard deviation of horizontal positions, where the receiver states none; "
        "heights have twice that",
    )
    rig = parser.add_argument_group("COLMAP rigs")
    rig.add_argument(
        "--forward-camera",
        metavar="NAME",
        help="camera that looks level and straight ahead (default: the reference camera)",
    )
    rig.add_argument("--rate-hz", type=_positive, metavar="HZ", help="frames a second, where EXIF has no times")
    bag = parser.add_argument_group("ROS bags")
    bag.add_argument(
        "--topics",
        type=_words,
        metavar="TOPIC,...",
        help="topics of images and of the receiver; by default all, where each camera has one",
    )
    bag.add_argument("--rig-frame", metavar="FRAME", help="the vehicle's frame in tf, by default base_link")
    bag.add_argument(
        "--world-frame", metavar="FRAME", help="frame of tf, as odom or map: the vehicle's poses in it are rough poses"
    )
    bag.add_argument(
        "--calibration",
        type=Path,
        metavar="FILE",
        help="Kalibr's camchain.yaml instead of CameraInfo, or a rig.json instead of CameraInfo and tf",
    )


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


def _three_numbers(text: str) -> list[float]:
    values = [float(word) for word in text.split(",")]
    if len(values) != 3 or not all(map(math.isfinite, values)):
        raise argparse.ArgumentTypeError(f"{text!r} is not three numbers as 0.4,0,1.8")
    return values


def _rough_quality(text: str) -> RoughQuality:
    values = [float(word) for word in text.split(",")]
    if len(values) != 2 or not all(0.0 < value <= MAX_SIGMA_M for value in values):
        raise argparse.ArgumentTypeError(f"{text!r} is not two numbers above 0 as 0.5,2")
    return RoughQuality(sigma_m=values[0], sigma_deg=values[1])


def _positive(text: str) -> float:
    if not 0.0 < (value := float(text)) <= MAX_SIGMA_M:
        raise argparse.ArgumentTypeError(f"{text} is not above 0 and up to {MAX_SIGMA_M:g}")
    return value


def run(arguments: argparse.Namespace) -> int:
    """Import and print what was written."""
    summary = import_recording(
        arguments.folder,
        arguments.out,
        frames=arguments.frames,
        cameras=arguments.cameras,
        rough_noise=arguments.rough_noise,
        gnss_file=arguments.gnss,
        scene=arguments.scene,
        options={name: getattr(arguments, name) for name in OPTIONS},
        name=arguments.name,
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
    for note in summary.notes:
        print(f"  note:         {note}")
    return 0
