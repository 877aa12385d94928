"""Line 11: the road from above, before and after recalibration."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.benchmarks.commands import mrasfm, read_report
from tests.benchmarks.real_drives import imported, reconstructed
from tests.benchmarks.table import Figure

CAMERAS, UNITS, SEED = 6, 40, 1
PERTURBATION = ("--perturb-rotation-deg", 0.5, "--perturb-translation-m", 0.02)


def birds_eye(data: Path, work: Path) -> Iterator[Figure]:
    """Line 11."""
    drive = work / "surround off by half a degree"
    mrasfm("synth", "--cameras", CAMERAS, "--units", UNITS, "--seed", SEED, *PERTURBATION, "--out", drive)
    found = _found(reconstructed(drive, work / "surround off by half a degree, scene"))
    title = "rendered, calibration off by 0.5 deg and 2 cm"
    before, after = found["before"], found["after"]
    yield Figure(line="11", what=f"{title}: correlation of two cameras, as given", value=before["correlation"])
    yield Figure(
        line="11",
        what=f"{title}: correlation of two cameras, as refined",
        value=after["correlation"],
        above=before["correlation"] + 0.05,
        most=1.0,
    )
    yield Figure(
        line="11",
        what=f"{title}: displacement between two cameras, as given",
        value=before["displacement_m"],
        unit="m",
        above=2 * after["displacement_m"],
        most=0.4,
    )
    yield Figure(
        line="11",
        what=f"{title}: displacement between two cameras, as refined",
        value=after["displacement_m"],
        unit="m",
        most=0.03,
    )
    real = _found(reconstructed(imported(data, "kitti02", work), work / "kitti02 with GNSS"))["after"]
    yield Figure(line="11", what="kitti02: correlation of two cameras", value=real["correlation"], above=0.9, most=1.0)
    yield Figure(
        line="11", what="kitti02: displacement of two cameras", value=real["displacement_m"], unit="m", most=0.03
    )


def _found(scene: Path) -> dict[str, Any]:
    pictures: dict[str, Any] = read_report(scene)["by_stage"]["pictures"]
    found: dict[str, Any] = pictures["birds_eye"]
    if "after" not in found:
        raise AssertionError(f"the cameras' views were not compared: {found}")
    return found
