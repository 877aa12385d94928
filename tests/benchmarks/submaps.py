"""Line 30: drives that are cut into sub-maps, beside the same drives in one piece; the joins between sub-maps; a long
path that closes over their borders.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.io.trajectory_file import read_tum
from mrasfm_engine.preflight.drive_reader import read_drive
from tests.benchmarks.commands import evaluate, mrasfm, read_report
from tests.benchmarks.real_drives import imported
from tests.benchmarks.rendered_drives import error_of_the_end
from tests.benchmarks.table import Figure, exactly

CAMERAS, UNITS, SUBMAPS, SEED = 6, 150, 4, 1
SEEDS = (1, 2, 3)  # without GNSS the metric error of one drive is mostly the luck of its scale
SIZE = ("--width", 640, "--height", 360)
# A real drive has 51 units: in three parts they are so short that they may share only four.
REAL, REAL_SUBMAPS, REAL_OVERLAP = "kitti06", 3, 4
MOST_TIMES, JOIN_M, JOIN_DEG = 1.2, 0.01, 0.02
LOOP_UNITS, LOOP_SPACING_M, LOOP_END_PERCENT = 600, 1.0, 0.05
LOOP_CAMERAS = 2  # rendering takes longer than all else
LOOP_TIMEOUT_S = 3600.0  # a bound against a hang, not of the time that it takes


def submaps(data: Path, work: Path) -> Iterator[Figure]:
    """Line 30."""
    cut, title = _settings(work / "four.toml", count=SUBMAPS), f"rendered, {UNITS} units"
    found = []
    for seed in SEEDS:
        drive = work / f"rendered {seed}, to be cut"
        mrasfm("synth", "--cameras", CAMERAS, "--units", UNITS, "--seed", seed, *SIZE, "--no-masks", "--out", drive)
        both = yield from _both(f"{title}, seed {seed}", drive, cut, SUBMAPS, work, "--no-gnss")
        yield from _joins(f"{title}, seed {seed}", both.cut, drive)
        found.append(both)
    yield _ratio(f"{title}, {len(SEEDS)} seeds", found)
    original = imported(data, REAL, work)
    cut = _settings(work / "three.toml", count=REAL_SUBMAPS, overlap_units=REAL_OVERLAP)
    for title, options in (("without GNSS", ("--no-gnss",)), ("with GNSS", ())):
        both = yield from _both(f"{REAL} {title}", original, cut, REAL_SUBMAPS, work, *options)
        yield _ratio(f"{REAL} {title}", [both])


def loop_over_borders(data: Path, work: Path) -> Iterator[Figure]:
    """Line 30: once around a block, without GNSS: the last sub-map ends where the first one begins."""
    del data
    drive, scene = work / "a loop, to be cut", work / "a loop, cut"
    path = ("--world", "loop", "--units", LOOP_UNITS, "--spacing-m", LOOP_SPACING_M)
    mrasfm("synth", "--cameras", LOOP_CAMERAS, "--seed", SEED, *path, *SIZE, "--no-masks", "--tight", "--out", drive)
    cut = _settings(work / "four.toml", count=SUBMAPS)
    mrasfm("reconstruct", drive, "--config", cut, "--out", scene, "--no-gnss", timeout_s=LOOP_TIMEOUT_S)
    what = f"a loop of {LOOP_UNITS} units"
    yield exactly("30", f"{what}: sub-maps", len(read_report(scene)["submaps"]), SUBMAPS)
    errors = evaluate(scene, drive)
    yield exactly("30", f"{what}: units with a pose", errors["registered_units"], LOOP_UNITS)
    truth, found = (read_tum(path).world_from_rig for path in (drive / "truth.tum", scene / "poses.tum"))
    length_m, percent = error_of_the_end(found, truth)
    yield Figure(line="30", what=f"{what}: length", value=length_m, unit="m")
    yield Figure(line="30", what=f"{what}: metric RMSE", value=errors["metric"]["rmse_m"], unit="m")
    yield Figure(
        line="30", what=f"{what}: error at the end, of its length", value=percent, unit="%", most=LOOP_END_PERCENT
    )


def _settings(path: Path, **values: int) -> Path:
    lines = [f"{name} = {value}" for name, value in values.items()]
    path.write_text("\n".join(["[output]", "pictures = false", "[submaps]", *lines, ""]))
    return path


@dataclass(frozen=True)
class _Both:
    """Metric RMSE of a drive in one piece and cut, and the cut one's scene."""

    one_m: float
    cut_m: float
    cut: Path


def _both(what: str, drive: Path, cut: Path, count: int, work: Path, *options: str) -> Generator[Figure, None, _Both]:
    """Figures of a drive in one piece and cut."""
    one, several = work / f"{what}, in one piece", work / f"{what}, cut"
    uncut = _settings(work / "one.toml", count=1)
    mrasfm("reconstruct", drive, "--config", uncut, "--out", one, *options)
    mrasfm("reconstruct", drive, "--config", cut, "--out", several, *options)
    yield exactly("30", f"{what}: sub-maps", len(read_report(several)["submaps"]), count)
    errors = {scene: evaluate(scene, drive) for scene in (one, several)}
    for scene, found in errors.items():
        title = "cut" if scene == several else "in one piece"
        rmse_m = found["metric"]["rmse_m"]
        yield Figure(line="30", what=f"{what}, {title}: metric RMSE", value=rmse_m, unit="m")
    units = len(read_drive(drive).manifest.frames)
    for scene, found in errors.items():
        title = "cut" if scene == several else "in one piece"
        yield exactly("30", f"{what}, {title}: units with a pose", found["registered_units"], units)
    return _Both(errors[one]["metric"]["rmse_m"], errors[several]["metric"]["rmse_m"], several)


def _ratio(what: str, found: Sequence[_Both]) -> Figure:
    """RMSE of all units of some drives, cut, of that in one piece."""
    squares_m2 = np.square([(both.one_m, both.cut_m) for both in found]).mean(axis=0)
    ratio = float(np.sqrt(squares_m2[1] / squares_m2[0]))
    return Figure(line="30", what=f"{what}: metric RMSE, cut, of that in one piece", value=ratio, most=MOST_TIMES)


def _joins(what: str, scene: Path, drive: Path) -> Iterator[Figure]:
    """The worst error of the relative pose of the last unit before what two sub-maps share and the first one after."""
    truth, found = (read_tum(path).world_from_rig for path in (drive / "truth.tum", scene / "poses.tum"))
    spans = [part["spans"][0] for part in read_report(scene)["submaps"]]
    ends = np.array([(after[0] - 1, before[1] + 1) for before, after in pairwise(spans)])
    relative = [se3.inverse(poses[ends[:, 0]]) @ poses[ends[:, 1]] for poses in (truth, found)]
    off = se3.inverse(relative[0]) @ relative[1]
    off_m, off_deg = np.linalg.norm(off[:, :3, 3], axis=1), se3.rotation_angle_deg(off[:, :3, :3])
    title = f"{what}: units on either side of what two sub-maps share, worst relative"
    yield Figure(line="30", what=f"{title} position", value=float(off_m.max()), unit="m", most=JOIN_M)
    yield Figure(line="30", what=f"{title} rotation", value=float(off_deg.max()), unit="deg", most=JOIN_DEG)
