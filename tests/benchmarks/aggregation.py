"""Line 20: scenes that share no image become one map. Rendered worlds: the worst of the seeds counts."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from tests.benchmarks.commands import mrasfm, read_report
from tests.benchmarks.edited_drives import edited_drive
from tests.benchmarks.table import Figure, exactly

AGGREGATION_SEEDS = (1, 2, 3)  # others of the run are left out: seven drives take long
SIZE = ("--width", 640, "--height", 360, "--no-masks")
# At a crossing: 1 same direction, 2 the other one, 3 and 5 the crossing street, 4 a part of the way, 6 far away.
DRIVES, DUSK, BIASED, FAR = 7, 1, 2, 6
CROSSING_UNITS, SURROUND_UNITS, LOOP_UNITS, REPEATED_UNITS = 30, 40, 37, 24
LOOP_DRIVES = 4
BASELINES = (0.9, 1.0, 1.3)  # as declared, in true ones
UNTRUSTED_POSITIONS = "[aggregation]\nposition_error_m = 80.0\n"  # so that a street 60 m away comes into question
CHAIN = '[aggregation]\nmulti_scene_adjustment = false\nfinal_adjustment = "none"\n'


def kitti(data: Path, work: Path) -> Iterator[Figure]:
    """Line 20a: two parts of a real drive without a common image, their receivers about 3 m apart."""
    for name, frames in (("a", "0:35:2"), ("b", "17:51:2")):
        drive = work / f"part {name}"
        gnss = ("--frames", frames, "--gnss", f"gnss_drive_{name}.csv")
        mrasfm("import", data / "kitti06", *gnss, "--out", drive)
        mrasfm("reconstruct", drive, "--out", work / f"part-{name}")
    scenes = [work / "part-a", work / "part-b"]
    errors = _aggregated(scenes, [work / "part a", work / "part b"], work / "map of kitti06")
    title = "kitti06 in two parts"
    yield from _one_seam(errors, title)
    coarse = errors["seams"][0]["coarse"]["translation_m"]
    yield Figure(line="20a", what=f"{title}: seam by positions alone", value=coarse, unit="m", above=1.0, most=10.0)
    for factor in BASELINES:
        yield from _without_positions(work, work / "part-a", work / "part b", factor)


def _without_positions(work: Path, placed: Path, drive: Path, factor: float) -> Iterator[Figure]:
    """Line 20a: one of the parts has no GNSS, and its baselines are declared too short or too long."""

    def edit(manifest: dict[str, Any]) -> None:
        for camera in manifest["rig"]["cameras"]:
            camera["rig_from_cam"]["translation_m"] = [factor * x for x in camera["rig_from_cam"]["translation_m"]]

    edited = edited_drive(drive, work / f"part b, baselines times {factor}", edit)
    scene = work / f"part-b-{round(100 * factor)}"
    mrasfm("reconstruct", edited, "--out", scene, "--no-gnss")
    errors = _aggregated([placed, scene], [work / "part a", drive], work / f"map of kitti06, {factor}")
    yield from _one_seam(errors, f"kitti06 in two parts, one without GNSS, its baselines times {factor}")


def _one_seam(errors: dict[str, Any], title: str) -> Iterator[Figure]:
    """Line 20a: the seam of two parts, and what the map is off by."""
    yield exactly("20a", f"{title}: seams", len(errors["seams"]), 1)
    seam = errors["seams"][0]
    yield Figure(line="20a", what=f"{title}: seam", value=seam["translation_m"], unit="m", most=0.03)
    yield Figure(line="20a", what=f"{title}: seam", value=seam["rotation_deg"], unit="deg", most=0.05)
    yield Figure(line="20a", what=f"{title}: metric RMSE", value=errors["metric"]["rmse_m"], unit="m", most=0.08)


def crossing(work: Path, seed: int) -> Iterator[Figure]:
    """Lines 20b and 20d: seven drives at a crossing; the sixth is added to a map of five."""
    if seed not in AGGREGATION_SEEDS:
        return
    folder = work / f"crossing {seed}"
    special = ("--dusk-drive", DUSK, "--biased-drive", BIASED, "--biased-by-m", 8)
    world = ("--world", "crossing", "--drives", DRIVES, "--units", CROSSING_UNITS)
    mrasfm("synth", *world, *special, *SIZE, "--seed", seed, "--out", folder)
    drives = [folder / f"drive_{k}" for k in range(DRIVES)]
    scenes = [_scene(drive) for drive in drives]
    errors = _aggregated(scenes, drives, folder / "map")
    title = f"crossing {seed}"
    yield exactly("20b", f"{title}: scenes not connected", len(errors["unconnected"]), 1)
    right = errors["unconnected"] == [drives[FAR].name]
    yield exactly("20b", f"{title}: it is the one 300 m away", int(right), 1)
    worst_m = max(seam["translation_m"] for seam in errors["seams"])
    worst_deg = max(seam["rotation_deg"] for seam in errors["seams"])
    yield Figure(line="20b", what=f"{title}: worst of {len(errors['seams'])} seams", value=worst_m, unit="m", most=0.1)
    yield Figure(line="20b", what=f"{title}: worst seam", value=worst_deg, unit="deg", most=0.2)
    yield Figure(line="20b", what=f"{title}: metric RMSE", value=errors["metric"]["rmse_m"], unit="m")
    yield from _added(scenes, folder, title)


def _added(scenes: Sequence[Path], folder: Path, title: str) -> Iterator[Figure]:
    whole_s = _seconds("aggregate", *scenes[:6], "--out", folder / "map of six")
    mrasfm("aggregate", *scenes[:5], "--out", folder / "map of five")
    added_s = _seconds(
        "aggregate", scenes[5], "--into", folder / "map of five", "--out", folder / "map of five and one"
    )
    made_s = sum(_reconstruction_s(scene) for scene in scenes[:6])
    what = f"{title}: adding the sixth scene, of making the map anew"
    share = (added_s + _reconstruction_s(scenes[5])) / (whole_s + made_s)
    yield Figure(line="20d", what=f"{what} with its scenes", value=share, most=1 / 3)
    yield Figure(line="20d", what=f"{what} of scenes that are there", value=added_s / whole_s)


def repeated(work: Path, seed: int) -> Iterator[Figure]:
    """Line 20b: facades repeat along two streets, and positions are trusted no farther than to the other street."""
    if seed not in AGGREGATION_SEEDS:
        return
    folder = work / f"repeated {seed}"
    world = ("--world", "repeated", "--drives", 2, "--units", REPEATED_UNITS)
    mrasfm("synth", *world, *SIZE, "--seed", seed, "--out", folder)
    drives = [folder / f"drive_{k}" for k in range(2)]
    scenes = [_scene(drive) for drive in drives]
    for title, text, expected in (
        ("with the consensus", UNTRUSTED_POSITIONS, 0),
        ("without it", UNTRUSTED_POSITIONS + "agreeing_units = false\n", 1),
    ):
        errors = _aggregated(scenes, drives, folder / title, settings=text)
        yield exactly("20b", f"two streets alike {seed}: seams {title}", len(errors["seams"]), expected)


def loop(work: Path, seed: int) -> Iterator[Figure]:
    """Line 20c: drives around a block, one after the other and together."""
    if seed not in AGGREGATION_SEEDS:
        return
    folder = work / f"loop of drives {seed}"
    world = ("--world", "loop", "--cameras", 4, "--drives", LOOP_DRIVES, "--units", LOOP_UNITS)
    mrasfm("synth", *world, *SIZE, "--seed", seed, "--out", folder)
    drives = [folder / f"drive_{k}" for k in range(LOOP_DRIVES)]
    scenes = [_scene(drive) for drive in drives]
    worst = {}
    for title, text in (("chain", CHAIN), ("joint", "")):
        errors = _aggregated(scenes, drives, folder / title, settings=text)
        yield exactly("20c", f"loop of drives {seed}, {title}: seams", len(errors["seams"]), LOOP_DRIVES)
        worst[title] = max(seam["translation_m"] for seam in errors["seams"])
        yield Figure(line="20c", what=f"loop of drives {seed}, {title}: worst seam", value=worst[title], unit="m")
    share = worst["joint"] / worst["chain"]
    yield Figure(line="20c", what=f"loop of drives {seed}: worst seam, joint of chain", value=share, most=0.5)


def speed_of_aggregation(data: Path, work: Path) -> Iterator[Figure]:
    """Line 20e: two surround scenes, against reconstructing one of them."""
    folder = work / "surround pair"
    mrasfm("synth", "--world", "street", "--drives", 2, "--units", SURROUND_UNITS, *SIZE, "--seed", 1, "--out", folder)
    drives = [folder / f"drive_{k}" for k in range(2)]
    seconds = [_seconds("reconstruct", drive, "--out", _place(drive)) for drive in drives]
    together_s = _seconds("aggregate", *map(_place, drives), "--out", folder / "map")
    yield Figure(line="20e", what="aggregation of two surround scenes", value=together_s, unit="s")
    share = together_s / min(seconds)
    yield Figure(line="20e", what="the same, of the time that one of them took", value=share, most=0.5)


def _place(drive: Path) -> Path:
    return drive.parent / "scenes" / drive.name


def _scene(drive: Path) -> Path:
    mrasfm("reconstruct", drive, "--out", _place(drive))
    return _place(drive)


def _aggregated(scenes: Sequence[Path], drives: Sequence[Path], out: Path, settings: str = "") -> dict[str, Any]:
    """What `mrasfm evaluate` says of the map of some scenes."""
    options: list[object] = []
    if settings:
        file = out.with_name(f"{out.name}.toml")
        file.write_text(settings, encoding="utf-8")
        options = ["--config", file]
    mrasfm("aggregate", *scenes, "--out", out, *options)
    truths = [f"{scene.name}={drive / 'truth.tum'}" for scene, drive in zip(scenes, drives, strict=True)]
    document: dict[str, Any] = json.loads(mrasfm("evaluate", out, "--json", "--truth", *truths))
    return document


def _seconds(*words: object) -> float:
    started_s = time.perf_counter()
    mrasfm(*words)
    return time.perf_counter() - started_s


def _reconstruction_s(scene: Path) -> float:
    return float(sum(stage["seconds"] for stage in read_report(scene)["stages"]))
