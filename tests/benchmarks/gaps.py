"""Line 28: a real drive with grey images, so few that others reach over them, and so many that none does."""

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
