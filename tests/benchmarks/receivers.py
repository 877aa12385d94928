"""Line 21: real drives with poorer receivers than theirs, and with cameras left out."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.alignment import align_rigid, align_similarity
from mrasfm_engine.io.read_scene import read_json, read_poses
from mrasfm_engine.io.trajectory_file import read_tum
from mrasfm_engine.types import Floats
from tests.benchmarks.commands import evaluate, mrasfm, read_report
from tests.benchmarks.edited_drives import Edit, edited_drive, turned
from tests.benchmarks.positions import Receiver
from tests.benchmarks.real_drives import DRIVES, RealDrive, imported
from tests.benchmarks.table import Figure, exactly

SEEDS = 5
WHITE_M, WANDER_M = 0.3, 0.5
WANDERING = Receiver(white_m=WHITE_M, wander_m=WANDER_M, declared_m=math.hypot(WHITE_M, WANDER_M))
EVERY, POOR_M = 5, 1.0
GOOD, LATE_S, ASIDE_M = Receiver(white_m=0.02, declared_m=0.02), 0.3, 0.7
TENTH, FIRSTS = 10, (0, 2, 4, 6, 8)
METRES_A_DEGREE = 111_320.0
# Halves of PandaSet's cameras: of the first no two share a view, so that hardly anything but the prior tells the scale.
HALVES = (
    ("front_camera", "left_camera", "back_camera"),
    ("front_left_camera", "front_right_camera", "right_camera"),
)

# Front and front left camera, turned in their own axes as rotations are that somebody measured by eye.
TURNS_DEG = (((-1.0, 1.0, 1.0), (1.0, 1.0, -1.0)), ((-1.0, 1.0, -1.0), (1.0, 1.0, 1.0)))


def receivers(data: Path, work: Path) -> Iterator[Figure]:
    """Line 21."""
    yield from _wandering(data, work)
    yield from _sparse(data, work)
    yield from _slow(data, work)
    yield from _late(data, work)
    yield from _misplaced(data, work)
    yield from _single_camera(data, work)
    yield from _halves(data, work)
    yield from _turned_pair(data, work)


def _wandering(data: Path, work: Path) -> Iterator[Figure]:
    """PandaSet with positions that scatter and wander, declared so."""
    real, drive = _pandaset(data, work)
    errors = []
    for seed in range(SEEDS):
        edited = edited_drive(drive, work / f"{real.name}, receiver {seed}", _receive(drive, WANDERING, seed=seed))
        mrasfm("reconstruct", edited, "--out", edited.with_name(edited.name + ", scene"))
        found = evaluate(edited.with_name(edited.name + ", scene"), edited)
        yield exactly("21", f"{real.name}, receiver {seed}: images registered", found["registered_images"], real.images)
        yield Figure(
            line="21", what=f"{real.name}, receiver {seed}: metric RMSE", value=found["metric"]["rmse_m"], unit="m"
        )
        errors.append(found["metric"]["rmse_m"])
    what = f"{real.name}, {SEEDS} receivers of {WHITE_M} m that wander by {WANDER_M} m: metric RMSE, median"
    yield Figure(line="21", what=what, value=float(np.median(errors)), unit="m", most=0.10)


def _sparse(data: Path, work: Path) -> Iterator[Figure]:
    """KITTI raw with few poor positions, and with the good ones but without each pair of cameras."""
    real = next(real for real in DRIVES if real.name == "kitti_raw_0001")
    drive = imported(data, real.name, work, *real.options)
    poor = edited_drive(drive, work / f"{real.name}, poor", _poor)
    mrasfm("reconstruct", poor, "--out", work / "poor scene")
    found = evaluate(work / "poor scene", poor)
    title = f"{real.name}, every {EVERY}th position, {POOR_M:.0f} m of noise"
    yield exactly("21", f"{title}: images registered", found["registered_images"], real.images)
    yield Figure(line="21", what=f"{title}: similarity RMSE", value=found["similarity"]["rmse_m"], unit="m", most=0.08)
    yield Figure(line="21", what=f"{title}: metric RMSE", value=found["metric"]["rmse_m"], unit="m")
    mrasfm("reconstruct", drive, "--out", work / "whole scene")
    whole_m = read_poses(work / "whole scene").trajectory.world_from_rig[:, :3, 3]
    cameras = _cameras(drive)
    for pair in (cameras[:2], cameras[2:]):
        less = edited_drive(drive, work / f"{real.name} without {pair}", _without(pair))
        mrasfm("reconstruct", less, "--out", less.with_name(less.name + ", scene"))
        less_m = read_poses(less.with_name(less.name + ", scene")).trajectory.world_from_rig[:, :3, 3]
        off_m = se3.apply(align_rigid(less_m, whole_m).a_from_b, whole_m) - less_m
        yield Figure(
            line="21",
            what=f"{real.name} without {' and '.join(pair)}: positions, difference to those with all cameras, RMS",
            value=_rms(np.linalg.norm(off_m, axis=1)),
            unit="m",
            most=0.02,
        )


def _slow(data: Path, work: Path) -> Iterator[Figure]:
    """KITTI 01, which turns, with one position a second, as most receivers have."""
    drive = imported(data, "kitti01", work)
    errors = []
    for first in FIRSTS:
        edited = edited_drive(drive, work / f"kitti01, a position a second from {first}", _every(TENTH, first))
        mrasfm("reconstruct", edited, "--out", edited.with_name(edited.name + ", scene"))
        errors.append(evaluate(edited.with_name(edited.name + ", scene"), edited)["metric"]["rmse_m"])
    what = f"kitti01, one position a second, {len(FIRSTS)} choices of which: metric RMSE"
    yield Figure(line="21", what=f"{what}, median", value=float(np.median(errors)), unit="m", most=0.15)
    yield Figure(line="21", what=f"{what}, worst", value=max(errors), unit="m")


def _late(data: Path, work: Path) -> Iterator[Figure]:
    """Drives that brake or turn with good positions that have the time of their arrival."""
    for name, most_m in (("pandaset_002", 0.05), ("kitti01", 0.12), ("kitti06", 0.05)):
        real = next(real for real in DRIVES if real.name == name)
        drive = imported(data, name, work, *real.options)
        edited = edited_drive(drive, work / f"{name}, late", _receive(drive, GOOD, seed=0), _delay)
        scene, figure = work / f"{name}, late, scene", partial(Figure, line="21")
        mrasfm("reconstruct", edited, "--out", scene)
        found, refinement = evaluate(scene, edited), read_report(scene)["by_stage"]["refinement"]
        title = f"{name}, positions of {GOOD.white_m} m that are {LATE_S} s late"
        late_s = -refinement["gnss"].get("clock_offset_s", 0.0)
        yield figure(what=f"{title}: they are found to be late by", value=late_s, unit="s", above=-1e-9)
        yield figure(what=f"{title}: metric RMSE", value=found["metric"]["rmse_m"], unit="m", most=most_m)
        yield figure(what=f"{title}: scale", value=found["similarity"]["scale"], above=0.0)
        yield figure(what=f"{title}: sigma of the scale", value=refinement["scale"]["sigma_relative"])


def _delay(manifest: dict[str, Any]) -> None:
    for sample in manifest["gnss"]["samples"]:
        sample["timestamp_us"] += round(LATE_S * 1e6)


def _misplaced(data: Path, work: Path) -> Iterator[Figure]:
    """KITTI 01, which turns, with good positions of an antenna that is where it was given, or on the other side."""
    drive = imported(data, "kitti01", work)
    for aside_m, bounds in ((0.0, {"most": 0.12}), (ASIDE_M, {})):
        edited = edited_drive(
            drive, work / f"kitti01, antenna {aside_m}", _receive(drive, GOOD, seed=0), _aside(aside_m)
        )
        scene = work / f"kitti01, antenna {aside_m}, scene"
        mrasfm("reconstruct", edited, "--out", scene)
        found, title = evaluate(scene, edited), f"kitti01, positions of {GOOD.white_m} m, antenna {aside_m} m aside"
        yield Figure(line="21", what=f"{title}: metric RMSE", value=found["metric"]["rmse_m"], unit="m", **bounds)
        sigma = read_report(scene)["by_stage"]["refinement"]["scale"]["sigma_relative"]
        yield Figure(line="21", what=f"{title}: scale", value=found["similarity"]["scale"], above=0.0)
        yield Figure(line="21", what=f"{title}: sigma of the scale", value=sigma)


def _aside(aside_m: float) -> Edit:
    """Give the antenna another place than the one that positions are of."""

    def edit(manifest: dict[str, Any]) -> None:
        manifest["gnss"]["antenna_in_rig_m"][1] += aside_m

    return edit


def _every(step: int, first: int) -> Edit:
    """Leave one of so many positions of the receiver."""

    def edit(manifest: dict[str, Any]) -> None:
        manifest["gnss"]["samples"] = manifest["gnss"]["samples"][first::step]

    return edit


def _single_camera(data: Path, work: Path) -> Iterator[Figure]:
    """Stereo drives without their second camera, also with half of the frames; of one, the lens is not as given."""
    for name, most_m, most_similarity_m in (("kitti01", 0.12, 0.09), ("kitti06", 0.06, 0.05)):
        drive = imported(data, name, work)
        others = _cameras(drive)[1:]
        for title, edit in (
            (f"{name} without {' and '.join(others)}", _without(others)),
            (f"{name} without {' and '.join(others)}, every second frame", _every_second_without(others)),
        ):
            edited = edited_drive(drive, work / title, edit)
            mrasfm("reconstruct", edited, "--out", edited.with_name(edited.name + ", scene"))
            found = evaluate(edited.with_name(edited.name + ", scene"), edited)
            for kind, most in (("metric", most_m), ("similarity", most_similarity_m)):
                yield Figure(line="21", what=f"{title}: {kind} RMSE", value=found[kind]["rmse_m"], unit="m", most=most)


def _halves(data: Path, work: Path) -> Iterator[Figure]:
    """PandaSet by either half of its cameras, without GNSS: both know its size, and find one shape, as they state."""
    real, drive = _pandaset(data, work)
    positions_m, sigmas_m = [], []
    for half in HALVES:
        title = f"{real.name} by {', '.join(half)}, without GNSS"
        leave = _without([c for c in _cameras(drive) if c not in half])
        scene, found = _without_gnss(edited_drive(drive, work / title, leave))
        yield exactly("21", f"{title}: images registered", found["registered_images"], real.images // 2)
        yield from _shape_and_scale(title, scene, found)
        known = [u for u in read_json(scene / "poses.json")["units"] if "sigma_position_m" in u]
        positions_m.append(np.array([u["world_from_rig"]["translation_m"] for u in known]))
        sigmas_m.append(np.array([u["sigma_position_m"] for u in known]))
    off_m = align_similarity(positions_m[0], positions_m[1]).apply(positions_m[1]) - positions_m[0]
    across = np.argsort(np.ptp(positions_m[0], axis=0))[:2]  # along the way, sigmas have the scale's
    yield Figure(
        line="21",
        what=f"{real.name}, halves apart: positions across the way, RMS",
        value=_rms(off_m[:, across]),
        unit="m",
    )
    yield Figure(
        line="21",
        what=f"{real.name}, halves apart: the same in sigmas",
        value=_rms((off_m / np.hypot(*sigmas_m))[:, across]),
        above=0.2,
        most=3.0,
    )


def _turned_pair(data: Path, work: Path) -> Iterator[Figure]:
    """Two of PandaSet's cameras that see next to nothing in common, given turned against one another, without GNSS."""
    real, drive = _pandaset(data, work)
    pair = ("front_camera", "front_left_camera")
    for number, turns_deg in enumerate(TURNS_DEG):
        title = f"{real.name} by {', '.join(pair)}, turned {number}, without GNSS"
        turns = (turned(camera, by_deg) for camera, by_deg in enumerate(turns_deg))
        leave = _without([c for c in _cameras(drive) if c not in pair])
        scene, found = _without_gnss(edited_drive(drive, work / title, leave, *turns))
        yield from _shape_and_scale(title, scene, found)


def _pandaset(data: Path, work: Path) -> tuple[RealDrive, Path]:
    real = next(real for real in DRIVES if real.name == "pandaset_002")
    return real, imported(data, real.name, work, *real.options)


def _without_gnss(drive: Path) -> tuple[Path, dict[str, Any]]:
    """The scene, and its errors."""
    scene = drive.with_name(drive.name + ", scene")
    mrasfm("reconstruct", drive, "--out", scene, "--no-gnss")
    return scene, evaluate(scene, drive)


def _shape_and_scale(title: str, scene: Path, found: dict[str, Any]) -> Iterator[Figure]:
    similarity, figure = found["similarity"], partial(Figure, line="21")
    sigma = read_report(scene)["by_stage"]["refinement"]["scale"]["sigma_relative"]
    off = abs(math.log(similarity["scale"])) / sigma
    yield figure(what=f"{title}: similarity RMSE", value=similarity["rmse_m"], unit="m", most=0.010)
    yield figure(what=f"{title}: error of the scale in its sigmas", value=off, above=-1e-9, most=3.0)


def _rms(values: Floats) -> float:
    return float(np.sqrt((values**2).mean()))


def _cameras(drive: Path) -> list[str]:
    manifest = json.loads((drive / "drive.json").read_text(encoding="utf-8"))
    return [camera["name"] for camera in manifest["rig"]["cameras"]]


def _receive(drive: Path, receiver: Receiver, *, seed: int) -> Edit:
    """Positions of the rig's origin with a receiver's errors."""
    truth = read_tum(drive / "truth.tum")
    # The truth's first pose may be tilted: the receiver's frame stands upright.
    up = truth.world_from_rig[:, :3, 2].mean(0)
    position_m = truth.world_from_rig[:, :3, 3] @ se3.exp_so3(np.cross(up, [0.0, 0.0, 1.0])).T

    def edit(manifest: dict[str, Any]) -> None:
        rng = np.random.default_rng(seed)
        manifest["gnss"] = receiver.gnss(truth.timestamps_us, position_m, np.zeros(3), rng)

    return edit


def _poor(manifest: dict[str, Any]) -> None:
    rng = np.random.default_rng(0)
    samples = manifest["gnss"]["samples"][::EVERY]
    for sample in samples:
        east_m, north_m, up_m = rng.normal(0, POOR_M, 3)
        around = METRES_A_DEGREE * np.cos(np.radians(sample["latitude_deg"]))
        sample["latitude_deg"] += north_m / METRES_A_DEGREE
        sample["longitude_deg"] += east_m / around
        sample["height_m"] += up_m
        sample["sigma_horizontal_m"] = sample["sigma_vertical_m"] = POOR_M
    manifest["gnss"]["samples"] = samples


def _without(cameras: list[str]) -> Edit:
    def edit(manifest: dict[str, Any]) -> None:
        manifest["rig"]["cameras"] = [c for c in manifest["rig"]["cameras"] if c["name"] not in cameras]
        for frame in manifest["frames"]:
            frame["images"] = {name: image for name, image in frame["images"].items() if name not in cameras}

    return edit


def _every_second_without(cameras: list[str]) -> Edit:
    def edit(manifest: dict[str, Any]) -> None:
        _without(cameras)(manifest)
        manifest["frames"] = manifest["frames"][::2]

    return edit
