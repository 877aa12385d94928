"""Line 18: a real drive with faults that recordings have: of its receiver, of its files, of its baselines."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation

from tests.benchmarks.commands import CommandFailed, evaluate, mrasfm, read_report
from tests.benchmarks.edited_drives import Edit
from tests.benchmarks.real_drives import imported
from tests.benchmarks.table import Figure, exactly
from tests.benchmarks.wrong_manifests import edited, rmse

METRES_A_DEGREE = 111_320.0
LATE = "image_1"


def faults(data: Path, work: Path) -> Iterator[Figure]:
    """Line 18, beside manifests that are wrong about the cameras."""
    drive = imported(data, "kitti06", work)
    for title, edit, finding, most_m in (
        ("positions jump by 1 m", _jumping((25, 1.0)), "gnss-error-jumps", 0.1),
        ("positions jump by 4 m", _jumping((25, 4.0)), "gnss-error-jumps", 0.1),
        ("positions jump by 15 m", _jumping((25, 15.0)), "gnss-error-jumps", 0.2),
        ("positions jump by 4 m and back by 6 m", _jumping((15, 4.0), (35, -6.0)), "gnss-error-jumps", 0.1),
        ("a receiver that is held for 2 s", _held(15, 35), "gnss-held", 0.1),
        ("positions of 1 Hz, each written ten times", _repeated(10), None, 0.1),
        ("baselines in feet", _scaled_baselines(1 / 0.3048), "scale-disagreement", 0.1),
    ):
        scene = work / f"kitti06, {title}"
        mrasfm("reconstruct", edited(drive, work / f"kitti06, {title}, drive", [edit]), "--out", scene)
        errors, report = evaluate(scene, drive), read_report(scene)
        yield exactly("18", f"kitti06, {title}: images registered", errors["registered_images"], 102)
        yield rmse(f"kitti06, {title}", errors, most_m)
        stated = report["by_stage"]["refinement"]["scale"]["sigma_relative"]
        off = abs(math.log(errors["similarity"]["scale"]))
        yield Figure(
            line="18",
            what=f"kitti06, {title}: error of the scale in its sigmas",
            value=off / stated,
            above=-1e-9,
            most=3.0,
        )
        codes = {one["code"] for one in report["findings"]}
        if finding is not None:
            yield exactly("18", f"kitti06, {title}: the finding {finding}", int(finding in codes), 1)
    for title, units, options, kind in (
        ("every fifth unit is the one before once more", range(4, 51, 5), (), "metric"),
        ("a recorder that hangs for 8 units, without GNSS", range(20, 28), ("--no-gnss",), "similarity"),
    ):
        scene, copy = work / f"kitti06, {title}", edited(drive, work / f"kitti06, {title}, drive", [])
        _repeat(copy, units)
        mrasfm("reconstruct", copy, "--out", scene, *options)
        errors, codes = evaluate(scene, drive), {one["code"] for one in read_report(scene)["findings"]}
        images = 2 * (51 - len(units))
        yield exactly("18", f"kitti06, {title}: images registered", errors["registered_images"], images)
        what, value = f"kitti06, {title}: {kind} RMSE", errors[kind]["rmse_m"]
        yield Figure(line="18", what=what, value=value, unit="m", most=0.1)
        yield exactly("18", f"kitti06, {title}: the finding repeated-images", int("repeated-images" in codes), 1)
    for title, edit, said in (
        ("a camera one frame late", _late(1), "listed 1 frame before them"),
        ("a camera twenty frames late", _late(20), "listed 20 frames before them"),
        ("a camera without one of its frames", _without_a_frame, "listed 1 frame after them from 2500000 us on"),
        ("a camera upside down", _turned("z", 180.0), "turned by 180 deg against each other"),
        ("a camera given as if it looked up", _turned("x", 60.0), "turned by 60 deg against each other"),
    ):
        refused = edited(drive, work / f"kitti06, {title}, drive", [edit])
        try:
            mrasfm("reconstruct", refused, "--out", work / f"kitti06, {title}")
            message = ""
        except CommandFailed as error:
            message = str(error)
        yield exactly("18", f"kitti06, {title}: refused with the reason", int(said in message), 1)


def _repeat(drive: Path, units: range) -> None:
    """Files of some units become those of the units before them."""
    frames = json.loads((drive / "drive.json").read_text(encoding="utf-8"))["frames"]
    for unit in units:
        for name, image in frames[unit]["images"].items():
            shutil.copyfile(drive / frames[unit - 1]["images"][name]["file"], drive / image["file"])


def _jumping(*jumps: tuple[int, float]) -> Edit:
    """From some samples on, positions are farther north by so many metres."""

    def edit(manifest: dict[str, Any]) -> None:
        for first, by_m in jumps:
            for sample in manifest["gnss"]["samples"][first:]:
                sample["latitude_deg"] += by_m / METRES_A_DEGREE

    return edit


def _held(first: int, end: int) -> Edit:
    def edit(manifest: dict[str, Any]) -> None:
        samples = manifest["gnss"]["samples"]
        for sample in samples[first:end]:
            _take_position(sample, samples[first])

    return edit


def _repeated(times: int) -> Edit:
    def edit(manifest: dict[str, Any]) -> None:
        samples = manifest["gnss"]["samples"]
        for k, sample in enumerate(samples):
            _take_position(sample, samples[k - k % times])

    return edit


def _take_position(sample: dict[str, Any], other: dict[str, Any]) -> None:
    for key in ("latitude_deg", "longitude_deg", "height_m"):
        sample[key] = other[key]


def _scaled_baselines(factor: float) -> Edit:
    def edit(manifest: dict[str, Any]) -> None:
        for camera in manifest["rig"]["cameras"]:
            pose = camera["rig_from_cam"]
            pose["translation_m"] = [factor * value for value in pose["translation_m"]]

    return edit


def _late(count: int) -> Edit:
    """Every frame has the image of a camera that is so many frames before its own; the first ones have none."""

    def edit(manifest: dict[str, Any]) -> None:
        files = [frame["images"].pop(LATE) for frame in manifest["frames"]]
        for frame, before in zip(manifest["frames"][count:], files[:-count], strict=True):
            frame["images"][LATE] = before

    return edit


def _without_a_frame(manifest: dict[str, Any]) -> None:
    """A camera lost a frame in the middle: those after it are listed a frame early, and the last frame has none."""
    frames = manifest["frames"]
    middle = len(frames) // 2
    files = [frame["images"][LATE] for frame in frames]
    for frame, after in zip(frames[middle:-1], files[middle + 1 :], strict=True):
        frame["images"][LATE] = after
    del frames[-1]["images"][LATE]


def _turned(axis: str, turn_deg: float) -> Edit:
    """A camera is said to be turned about an axis of its own."""

    def edit(manifest: dict[str, Any]) -> None:
        for camera in manifest["rig"]["cameras"]:
            if camera["name"] == LATE:
                given = Rotation.from_quat(camera["rig_from_cam"]["rotation_xyzw"])
                wrong = given * Rotation.from_euler(axis, turn_deg, degrees=True)
                camera["rig_from_cam"]["rotation_xyzw"] = wrong.as_quat().tolist()

    return edit
