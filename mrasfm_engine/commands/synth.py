"""`mrasfm synth`: render drives with ground truth."""

from __future__ import annotations

import argparse
import json
from dataclasses import fields
from functools import partial

from rich.console import Console

from mrasfm_engine.commands.stage_progress import stage_progress
from mrasfm_engine.synthetic.options import SpeedProfile, SynthOptions, World
from schemas.command_line import output_folder


def register(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand's parser."""
    parser = subparsers.add_parser(
        "synth", help="render a drive with ground truth", description="Render drives of a synthetic world."
    )
    parser.add_argument(
        "--out", type=output_folder, required=True, help="folder of the drive (of the drives, if several)"
    )
    parser.add_argument("--force", action="store_true", help="replace drives that are in --out")
    default = SynthOptions()

    def add(flag: str, kind: type, text: str, *, metavar: str | None = None, to: str | None = None) -> None:
        name = to or flag.strip("-").replace("-", "_")
        value = getattr(default, name)
        parser.add_argument(
            flag, dest=name, type=kind, default=value, metavar=metavar, help=f"{text} (default: {value})"
        )

    def choose(flag: str, choices: list[str], text: str) -> None:
        name = flag.strip("-").replace("-", "_")
        value = str(getattr(default, name))
        parser.add_argument(flag, choices=choices, default=value, help=f"{text} (default: {value})")

    add("--cameras", int, "cameras of the vehicle, 1 to 8")
    add("--units", int, "frames in which all cameras take an image")
    add("--drives", int, "drives of the same world, an hour apart")
    add("--seed", int, "everything random follows from it")
    choose("--world", [world.value for world in World], "kind of street")
    parser.add_argument("--straight", action="store_true", help="a street without curves")
    add("--ramp", float, "slope of a hill on the path, percent", to="ramp_percent", metavar="PERCENT")
    add("--parked-cars", int, "parked cars along each drive")
    add("--moving-cars", int, "other vehicles that drive")
    add("--same-way-cars", int, "vehicles that drive along, in turns ahead and in the lane beside")
    add("--moving-shadows", int, "objects out of view whose shadows move over the road, besides the vehicle's own")
    add("--shadows", float, "darkness of shadows, 0 to 1", to="shadow_strength", metavar="STRENGTH")

    add("--width", int, "of the images, pixels")
    add("--height", int, "of the images, pixels")
    choose("--camera-model", ["PINHOLE", "OPENCV", "OPENCV_FISHEYE"], "COLMAP's model of all cameras")
    parser.add_argument("--dusk-drive", type=int, metavar="N", help="this drive is driven late, under clouds")
    add("--exposure-jitter", float, "sigma of the logarithm of each image's brightness")
    add("--noise", float, "sensor noise; 1 is a good sensor in daylight")
    add("--blur-px", float, "sigma of the point spread function")
    add("--jpeg-quality", int, "of the images")
    parser.add_argument("--no-masks", dest="masks", action="store_false", help="write no semantic masks")
    parser.add_argument(
        "--moving-masks", action="store_true", help="truth_moving/ says which pixels show something that moves"
    )
    add("--texture-px", int, "side of the largest textures: 64, 128, 256, 512 or 1024")

    add("--rate-hz", float, "units a second")
    add("--spacing-m", float, "mean distance between units")
    choose("--speed-profile", [profile.value for profile in SpeedProfile], "variation of the speed")
    add("--standing", int, "units in the middle during which the vehicle stands", to="standing_units", metavar="UNITS")
    add("--time-skew-ms", float, "images of a unit are taken up to this far apart in time")
    add("--readout-ms", float, "rolling shutter: time from the first row to the last; slow to render")
    add("--drop-images", float, "fraction of images that are missing", metavar="FRACTION")
    parser.add_argument(
        "--own-car", action="store_true", help="the front camera sees the bonnet, the back camera the boot lid"
    )
    parser.add_argument(
        "--occlude",
        dest="occluded_cameras",
        type=lambda text: tuple(name for name in text.split(",") if name),
        default=(),
        metavar="NAME[,NAME]",
        help="a lorry covers most of these cameras' images for half of the drive",
    )

    parser.add_argument("--no-gnss", dest="gnss", action="store_false", help="the drive has no GNSS")
    add("--gnss-noise-m", float, "white noise, sigma of each horizontal axis; vertical errors are 1.5 times as large")
    add("--gnss-drift-m", float, "slowly changing error, sigma of each horizontal axis")
    add("--gnss-bias-m", float, "constant error of each drive, sigma of each horizontal axis")
    parser.add_argument("--biased-drive", type=int, metavar="N", help="all positions of this drive are off")
    add("--biased-by-m", float, "by this distance, in one horizontal direction; its sigmas do not include it")
    add("--gnss-outliers", float, "fraction of samples that are 5 to 40 m off", metavar="FRACTION")
    add("--gnss-offset-s", float, "added to the GNSS timestamps")
    parser.add_argument("--rough-poses", action="store_true", help="the manifest has a rough trajectory")
    add("--rough-noise-m", float, "sigma of each axis of the rough positions")
    add("--rough-noise-deg", float, "sigma of each axis of the rough rotations")

    add("--perturb-rotation-deg", float, "norm of the error of each given extrinsic rotation, in a random direction")
    add("--perturb-translation-m", float, "norm of the error of each given camera position, in a random direction")
    parser.add_argument(
        "--declare-sigmas", action="store_true", help="the manifest declares the sigmas of the calibration"
    )
    parser.add_argument("--tight", action="store_true", help="the manifest declares 0.01 degrees and 1 mm")
    parser.add_argument("--miscalibrated-camera", metavar="NAME", help="camera whose given rotation is wrong")
    add("--miscalibrated-by-deg", float, "error of that rotation, degrees")
    parser.add_argument("--json", action="store_true", help="print the folders as a JSON list")
    parser.set_defaults(run=run)


def options_from(arguments: argparse.Namespace) -> SynthOptions:
    """The options that parsed arguments ask for."""
    values = {field.name: getattr(arguments, field.name) for field in fields(SynthOptions)}
    values["world"] = World(values["world"])
    values["speed_profile"] = SpeedProfile(values["speed_profile"])
    return SynthOptions(**values)


def run(arguments: argparse.Namespace) -> int:
    """Render what the arguments ask for."""
    options = options_from(arguments)
    # The renderer's compiled kernels take a second to load; other subcommands do not pay for it.
    from mrasfm_engine.synthetic.drive_writer import render_drives

    with stage_progress(Console(stderr=True)) as progress:
        report = partial(progress, "rendering")
        folders = render_drives(options, arguments.out, force=arguments.force, progress=report)
    if arguments.json:
        print(json.dumps([str(folder) for folder in folders]))
        return 0
    for folder in folders:
        print(folder)
    return 0
