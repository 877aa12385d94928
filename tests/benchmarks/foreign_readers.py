"""Line 31: the files for other programs, as readers of others read them, and the time of a large COPC."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap

from mrasfm_engine.export import copc_readback
from mrasfm_engine.export.copc import write_copc
from schemas.artifacts import COPC_FILE
from tests.benchmarks.commands import CommandFailed, mrasfm, read_report
from tests.benchmarks.real_drives import imported, reconstructed
from tests.benchmarks.table import Figure, exactly
from tests.helpers.export_example import street_of_points

LINE = "31"
READERS = Path(__file__).resolve().parents[1] / "foreign_readers"
POINTS = 5_000_000
RENDERED = ("--cameras", 6, "--units", 20, "--seed", 7)
DEMO = ("--drives", 2, "--cameras", 6, "--units", 20, "--seed", 1)  # as `mrasfm demo` renders
COLORED_POINTS, COLOR_LEVELS = 200, 2.0
GDAL = (("gdalinfo", "pictures/road.tif"), ("ogrinfo", "trajectory.gpkg"))
IN_PLACE, SHIFTED = 0.6, 0.5  # of colours: the correlation in place, and its part that a shift of 0.25 m may leave
KALIBR = 1e-9


def foreign_readers(data: Path, work: Path) -> Iterator[Figure]:
    """Readers that are not installed and cannot be are skipped by name."""
    yield from _large_copc(work)
    python, node = python_readers(work, "requirements.lock"), _copc_js(work)
    for program, found in (("the Python readers", python), ("copc.js", node)):
        if isinstance(found, str):
            yield Figure(line=LINE, what=f"{program}: skipped, cannot be installed here", value=0, remark=found)
    drives = {"rendered": work / "rendered for other programs", "demo": work / "demo" / "drive_0"}
    mrasfm("synth", *RENDERED, "--out", drives["rendered"])
    mrasfm("synth", *DEMO, "--out", work / "demo")
    scenes = {title: work / f"{title} for other programs, scene" for title in drives}
    for name in ("kitti02", "kitti06"):
        drives[name], scenes[name] = imported(data, name, work), work / f"{name} with GNSS"
    for title, drive in drives.items():
        scene = reconstructed(drive, scenes[title])
        yield from _figures(title, scene, python, node)
        yield from _own_colors(title, scene, drive)
        yield from _gdal(title, scene)


def _large_copc(work: Path) -> Iterator[Figure]:
    scene, path = street_of_points(POINTS), work / COPC_FILE
    write_copc(street_of_points(30_000), path)  # compiles
    started_s = time.perf_counter()
    write_copc(scene, path)
    seconds = time.perf_counter() - started_s
    yield Figure(line=LINE, what="COPC of 5 million points: written", value=seconds, unit="s", most=15.0)
    started_s = time.perf_counter()
    agrees = all(row.agrees for row in copc_readback.copc(scene, copc_readback.read_copc(path)))
    seconds = time.perf_counter() - started_s
    yield Figure(line=LINE, what="COPC of 5 million points: read back and compared", value=seconds, unit="s", most=15.0)
    yield exactly(LINE, "COPC of 5 million points: agrees", int(agrees), 1)
    yield Figure(line=LINE, what="COPC of 5 million points: size", value=path.stat().st_size / 1e6, unit="MB")


def python_readers(work: Path, lock: str) -> Path | str:
    """Interpreter of an environment with the readers of a lock; why there is none."""
    folder = work / f"readers of {lock}"
    python = folder / "bin" / "python"
    if (folder / "complete").exists():
        return python
    install = ["-m", "pip", "install", "--quiet", "--require-hashes", "-r", READERS / lock]
    for command in ([sys.executable, "-m", "venv", folder], [python, *install]):
        problem = problem_of(command, work)
        if problem is not None:
            return problem
    (folder / "complete").touch()
    return python


def _copc_js(work: Path) -> Path | str:
    """Script that reads with copc.js; why there is none."""
    if shutil.which("npm") is None:
        return "there is no npm"
    folder = work / "copc_js"
    shutil.copytree(READERS / "copc_js", folder)
    return problem_of(["npm", "ci", "--silent"], folder) or folder / "read.mjs"


def _run(command: list[Any], folder: Path) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def problem_of(command: list[Any], folder: Path) -> str | None:
    """The last line of a command that fails."""
    result = _run(command, folder)
    return None if result.returncode == 0 else (result.stderr.strip().splitlines() or ["it says nothing"])[-1]


def output_of(command: list[Any], folder: Path) -> dict[str, Any]:
    result = _run(command, folder)
    if result.returncode != 0:
        raise CommandFailed(f"{Path(command[1]).name} ended with {result.returncode}: {result.stderr.strip()[-200:]}")
    said: dict[str, Any] = json.loads(result.stdout)
    return said


def _figures(title: str, scene: Path, python: Path | str, node: Path | str) -> Iterator[Figure]:
    points = read_report(scene)["summary"]["points"]
    if isinstance(python, Path):
        said = output_of([python, READERS / "read.py", scene], scene)
        for name, found in said.items():
            problem = found.get("missing") or found.get("error")
            yield exactly(LINE, f"{title}: {name} reads it" + (f": {problem}" if problem else ""), int(not problem), 1)
        yield from _of_python(title, said, points)
    if isinstance(node, Path):
        found = output_of(["node", node, scene / COPC_FILE], node.parent)
        yield exactly(
            LINE, f"{title}: copc.js, points inside of their nodes", found["points"] - found["outside"], points
        )


def _own_colors(title: str, scene: Path, drive: Path) -> Iterator[Figure]:
    """Colours of points against the images of their own observations, in the drive's files."""
    model = pycolmap.Reconstruction(str(scene / "model"))
    chosen = np.random.default_rng(0).choice(sorted(model.points3D), COLORED_POINTS, replace=False).tolist()
    of_image: dict[int, list[tuple[int, int]]] = {}
    for point in chosen:
        for element in model.points3D[point].track.elements:
            of_image.setdefault(element.image_id, []).append((point, element.point2D_idx))
    seen: dict[int, list[Any]] = {point: [] for point in chosen}
    for image_id, observations in of_image.items():
        image = model.images[image_id]
        pixels = cv2.imread(str(drive / image.name))[..., ::-1]
        for point, keypoint in observations:
            column, row = image.points2D[keypoint].xy.astype(int)
            seen[point].append(pixels[row, column])
    off = max(float(np.abs(np.mean(seen[point], axis=0) - model.points3D[point].color).max()) for point in chosen)
    what = f"{title}: colours of {COLORED_POINTS} points, off those of their own observations"
    yield Figure(line=LINE, what=what, value=off, unit="of 255", above=-1, most=COLOR_LEVELS)


def _gdal(title: str, scene: Path) -> Iterator[Figure]:
    """GDAL's own programs, where they are installed: they say nothing on stderr."""
    for program, file in GDAL:
        if shutil.which(program) is None:
            yield Figure(line=LINE, what=f"{title}: {program}: skipped, not in PATH", value=0)
            continue
        result = _run([program, *(["-al", "-so"] if program == "ogrinfo" else []), scene / file], scene)
        said = result.stderr.strip()
        is_well = result.returncode == 0 and not said
        yield exactly(
            LINE, f"{title}: {program} without a warning" + (f": {said[:100]}" if said else ""), int(is_well), 1
        )


def _of_python(title: str, said: dict[str, Any], points: int) -> Iterator[Figure]:
    """What each reader of the environment says; a reader that failed has no figures."""
    if "farthest_m" in (las := said["laspy"]):
        yield Figure(
            line=LINE, what=f"{title}: COPC, farthest from the PLY", value=las["farthest_m"], unit="m", most=1e-3
        )
        yield exactly(LINE, f"{title}: COPC, attributes as in the PLY", int(las["attributes_agree"]), 1)
    if "valid" in (copc := said["copclib"]):
        yield exactly(LINE, f"{title}: copclib, the octree is valid", int(copc["valid"]), 1)
        yield exactly(LINE, f"{title}: copclib, points", copc["points"], points)
    if "system" in (package := said["pyogrio"]):
        is_right = package["system"] == "EPSG:4326" and package["time"].startswith("datetime64")
        yield exactly(LINE, f"{title}: GeoPackage, system and times", int(is_right), 1)
        off = package["degrees_off"]
        yield Figure(line=LINE, what=f"{title}: GeoPackage, off", value=off, unit="deg", above=-1, most=1e-9)
        yield Figure(line=LINE, what=f"{title}: the same", value=package["metres_off"], unit="m", above=-1, most=1e-3)
    if "correlations" in (road := said["rasterio"]):
        is_whole = road["is_tiled"] and min(map(len, road["overviews"])) > 1
        yield exactly(LINE, f"{title}: GeoTIFF, tiled and with overviews", int(is_whole), 1)
        (own,), shifted = road["correlations"]["in place"], max(road["correlations"]["0.25 m"])
        what = f"{title}: colours of road points in the COPC and the GeoTIFF, correlation"
        yield Figure(line=LINE, what=what, value=own, above=IN_PLACE, most=0.999)
        # Real roads are dark beside light grass, metres wide: there a shift of 0.25 m says less.
        most = SHIFTED if title in ("rendered", "demo") else None
        yield Figure(
            line=LINE, what=f"{title}: the same, part left at 0.25 m", value=shifted / own, above=-1, most=most
        )
        (own,), shifted = road["contrasts"]["in place"], max(road["contrasts"]["0.25 m"])
        what = f"{title}: the same of differences within 2 m, part left at 0.25 m"
        yield Figure(line=LINE, what=what, value=shifted / own, above=-1, most=SHIFTED, remark=f"in place {own:.3f}")
    if "chain_off" in (texts := said["yaml"]):
        yield Figure(line=LINE, what=f"{title}: Kalibr's chain, off", value=texts["chain_off"], most=KALIBR)
        yield exactly(LINE, f"{title}: texts for numbers in YAML + 1", len(texts["texts_for_numbers"]) + 1, 1)
    if "farthest_m" in (cloud := said["pypcd4"]):
        yield Figure(line=LINE, what=f"{title}: PCD, off the PLY", value=cloud["farthest_m"], unit="m", most=1e-3)
        yield exactly(LINE, f"{title}: PCD, points", cloud["points"], points)
