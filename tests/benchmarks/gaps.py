"""Line 28: a real drive with grey images, so few that others reach over them, and so many that none does.

Line 28b: both components of one without GNSS, in the map of another drive that covers the gap.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from schemas.artifacts import component_folder
from tests.benchmarks.commands import evaluate, mrasfm, read_report
from tests.benchmarks.real_drives import imported
from tests.benchmarks.table import Figure, exactly

DRIVE, UNITS, GREY = "kitti06", 51, 128
LONG_OF_HALF = range(7, 20)
SHORT, LONG = range(22, 27), range(12, 41)  # 6 m, and 36 m: over half of what is seen 50 m ahead is behind by then
WITHOUT, WITH = "without GNSS", "with GNSS"
JOINED_M = {WITHOUT: 0.20, WITH: 0.06}
COMPONENT_M = 0.10
BY_POSITIONS_M = 0.5  # no better than the receiver: its sigma is 0.5 m


def gaps(data: Path, work: Path) -> Iterator[Figure]:
    """Line 28."""
    original = imported(data, DRIVE, work)
    for grey in (SHORT, LONG):
        drive = _with_grey(original, grey, work / f"{len(grey)} grey")
        for title, options in ((WITHOUT, ("--no-gnss",)), (WITH, ())):
            what = f"{DRIVE} {title}, {len(grey)} units grey"
            scene = work / f"{len(grey)} grey, {title}"
            mrasfm("reconstruct", drive, "--out", scene, *options)
            yield from _figures(what, scene, drive, len(grey), title)
        shutil.rmtree(drive)


def components_in_map(data: Path, work: Path) -> Iterator[Figure]:
    """Line 28b: frames of two halves of a real drive, which share no image; one has grey images and no GNSS."""
    for name, frames, gnss in (("even", "0:51:2", "a"), ("odd", "1:51:2", "b")):
        options = ("--frames", frames, "--gnss", f"gnss_drive_{gnss}.csv")
        mrasfm("import", data / DRIVE, *options, "--out", work / f"frames {name}")
    drives = {"grey": _with_grey(work / "frames even", LONG_OF_HALF, work / "frames grey"), "odd": work / "frames odd"}
    mrasfm("reconstruct", drives["grey"], "--no-gnss", "--out", work / "scene grey")
    mrasfm("reconstruct", drives["odd"], "--out", work / "scene odd")
    out = work / "map of components"
    mrasfm("aggregate", *(f"{name}={work / f'scene {name}'}" for name in drives), "--out", out)
    truths = [f"{name}={drive / 'truth.tum'}" for name, drive in drives.items()]
    errors = json.loads(mrasfm("evaluate", out, "--json", "--truth", *truths))
    what = f"{DRIVE} in components and a drive over the gap"
    names = {scene["name"] for scene in json.loads((out / "map.json").read_text())["scenes"]}
    yield exactly("28b", f"{what}: scenes of the map", len(names & {"grey", "grey#1", "odd"}), 3)
    yield exactly("28b", f"{what}: scenes not connected", len(errors["unconnected"]), 0)
    for seam in errors["seams"]:
        title = f"{what}: seam {seam['a']} - {seam['b']}"
        yield Figure(line="28b", what=title, value=seam["translation_m"], unit="m", most=0.05)
        yield Figure(line="28b", what=title, value=seam["rotation_deg"], unit="deg", most=0.2)
    yield Figure(line="28b", what=f"{what}: metric RMSE", value=errors["metric"]["rmse_m"], unit="m", most=0.2)


def _figures(what: str, scene: Path, drive: Path, grey: int, title: str) -> Iterator[Figure]:
    report = read_report(scene)
    parts = next(stage for stage in report["stages"] if stage["stage"] == "mapping")["components"]
    codes = {finding["code"] for finding in report["findings"]}
    yield exactly("28", f"{what}: units with a pose", sum(part["units"] for part in parts), UNITS - grey)
    apart = grey == len(LONG) and title == WITHOUT
    yield exactly("28", f"{what}: components", len(parts), 2 if apart else 1)
    expected = "units-without-pose"
    if grey == len(LONG):
        expected = "drive-in-components" if apart else "gap-without-images"
    yield exactly("28", f"{what}: finding {expected}", int(expected in codes), 1)
    most_m = COMPONENT_M if apart else JOINED_M[title]
    if grey == len(LONG) and title == WITH:
        most_m = BY_POSITIONS_M
    for number in range(len(parts)):
        folder = scene / component_folder(number) if number else scene
        yield Figure(
            line="28",
            what=f"{what}: metric RMSE" + (f" of component {number}" if number else ""),
            value=evaluate(folder, drive)["metric"]["rmse_m"],
            unit="m",
            most=most_m,
        )


def _with_grey(original: Path, units: range, out: Path) -> Path:
    """A copy of a drive whose images of some units are grey all over."""
    shutil.copytree(original, out)
    frames = json.loads((out / "drive.json").read_text())["frames"]
    for unit in units:
        for image in frames[unit]["images"].values():
            path = out / image["file"]
            picture = cv2.imread(str(path))
            assert picture is not None
            path.unlink()  # it may be a link to the recording
            cv2.imwrite(str(path), np.full_like(picture, GREY))
    return out
