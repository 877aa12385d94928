"""Line 29: a rendered drive with a stop of a minute in it, beside the same drive without."""

from __future__ import annotations

import json
import shutil
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mrasfm_engine.io.stage_store import content_sha256_of
from mrasfm_engine.preflight.drive_reader import read_drive
from tests.benchmarks.commands import cpu_time_s, evaluate, mrasfm, read_report
from tests.benchmarks.table import Figure, exactly

SEED, CAMERAS, UNITS, SIZE = 1, 6, 28, ("--width", 640, "--height", 360)
AT, STOP_UNITS = 14, 600  # a minute at 10 Hz
NOISE = 2.0  # grey levels of the sensor, anew in every image
MOST_TIMES, RUNS = 1.1, 3  # of which the shortest counts: what else runs on the machine makes the others longer
ERROR_M = 0.05


def stops(data: Path, work: Path) -> Iterator[Figure]:
    """Line 29."""
    drive = work / "without a stop"
    mrasfm("synth", "--cameras", CAMERAS, "--units", UNITS, "--seed", SEED, *SIZE, "--no-masks", "--out", drive)
    stopped = _with_stop(drive, work / "with a stop")
    mrasfm("reconstruct", drive, "--no-gnss", "--out", work / "warm-up")  # compiles what no run before has
    runs_s, scene = defaultdict(list), work / "scene"
    for one in (drive, stopped) * RUNS:
        if scene.exists():
            shutil.rmtree(scene)
        before_s = cpu_time_s()
        mrasfm("reconstruct", one, "--no-gnss", "--out", scene)
        runs_s[one].append(cpu_time_s() - before_s)
    cpu_s = {one: min(seconds) for one, seconds in runs_s.items()}
    hashing_s = {one: _hashing_s(one) for one in runs_s}
    title = f"a stop of 60 s in a drive of {UNITS} units"
    yield Figure(line="29", what=f"{title}: CPU time without it", value=cpu_s[drive], unit="s")
    ratio = cpu_s[stopped] / cpu_s[drive]
    yield Figure(line="29", what=f"{title}: CPU time with it, of that", value=ratio)
    beyond_s = {one: cpu_s[one] - hashing_s[one] for one in cpu_s}
    ratio = beyond_s[stopped] / beyond_s[drive]
    yield Figure(line="29", what=f"{title}: the same beyond hashing", value=ratio, most=MOST_TIMES)
    units = json.loads((scene / "poses.json").read_text(encoding="utf-8"))["units"]
    yield exactly("29", f"{title}: units with a pose", sum(u["registered"] for u in units), UNITS + STOP_UNITS)
    left_out = read_report(scene)["standing"]["units"]
    yield Figure(line="29", what=f"{title}: units left out", value=left_out, above=STOP_UNITS - 3, most=STOP_UNITS)
    error_m = evaluate(scene, stopped)["metric"]["rmse_m"]
    yield Figure(line="29", what=f"{title}: metric RMSE", value=error_m, unit="m", most=ERROR_M)


def _hashing_s(drive: Path) -> float:
    """CPU time of reading and hashing all images, by which the command finds finished stages again."""
    read, seconds = read_drive(drive), []
    for _ in range(RUNS):
        before_s = time.process_time()
        content_sha256_of(read, threads=1)
        seconds.append(time.process_time() - before_s)
    return min(seconds)


def _with_stop(original: Path, out: Path) -> Path:
    """A copy of a drive whose vehicle stands for a minute: one unit again and again, with new noise in its images."""
    shutil.copytree(original, out)
    manifest = json.loads((out / "drive.json").read_text())
    frames, rng = manifest["frames"], np.random.default_rng(SEED)
    step_us = frames[1]["timestamp_us"] - frames[0]["timestamp_us"]
    pictures = {camera: cv2.imread(str(out / image["file"])) for camera, image in frames[AT]["images"].items()}
    stop = [_again(frames[AT], k, k * step_us, pictures, out, rng) for k in range(1, STOP_UNITS + 1)]
    after = [_later(frame, STOP_UNITS * step_us) for frame in frames[AT + 1 :]]
    manifest["frames"] = [*frames[: AT + 1], *stop, *after]
    manifest.pop("gnss", None)  # it knows of no stop
    (out / "drive.json").write_text(json.dumps(manifest))
    rows = [row.split() for row in (out / "truth.tum").read_text().splitlines() if row and not row.startswith("#")]
    step_s = step_us / 1e6
    between = [[f"{float(rows[AT][0]) + k * step_s:.6f}", *rows[AT][1:]] for k in range(1, STOP_UNITS + 1)]
    later = [[f"{float(row[0]) + STOP_UNITS * step_s:.6f}", *row[1:]] for row in rows[AT + 1 :]]
    text = "\n".join(" ".join(row) for row in [*rows[: AT + 1], *between, *later])
    (out / "truth.tum").write_text(text + "\n")
    return out


def _again(
    frame: dict[str, Any], k: int, later_us: int, pictures: dict[str, Any], out: Path, rng: np.random.Generator
) -> dict[str, Any]:
    """The frame `later_us` later, its images with new noise."""
    result = _later(frame, later_us)
    result["source_frame"] = 100_000 + k
    for camera, picture in pictures.items():
        file = f"images/{camera}/stop_{k:04d}.jpg"
        noisy = np.clip(picture + rng.normal(0.0, NOISE, picture.shape), 0, 255).astype(np.uint8)
        cv2.imwrite(str(out / file), noisy, [cv2.IMWRITE_JPEG_QUALITY, 95])
        result["images"][camera]["file"] = file
    return result


def _later(frame: dict[str, Any], later_us: int) -> dict[str, Any]:
    result = json.loads(json.dumps(frame))
    result["timestamp_us"] += later_us
    for image in result["images"].values():
        if image.get("timestamp_us") is not None:
            image["timestamp_us"] += later_us
    return dict(result)
