"""Line 27: the picture of the road from the best views, against the markings that were painted."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree

from mrasfm_engine.io.trajectory_file import read_tum
from mrasfm_engine.types import Floats
from tests.benchmarks.commands import mrasfm, read_report
from tests.benchmarks.real_drives import imported, reconstructed
from tests.benchmarks.table import Figure
from tests.helpers.true_markings import EdgeErrors, beside_the_vehicle, edge_errors, true_edges, truth_from_scene

LINE = "27"
WITHIN_M = 0.05
ROAD_M, LANE_M = 6.0, 4.0  # to both sides of the path: the whole carriageway, and the lines of the own lane
LOOP = ("--cameras", 3, "--units", 130, "--world", "loop")
PERTURBED = ("--cameras", 6, "--units", 40, "--perturb-rotation-deg", 0.5, "--perturb-translation-m", 0.02)


def rendered_markings(work: Path, seed: int) -> Iterator[Figure]:
    """Edges of markings in the pictures of rendered drives."""
    drive, scene = _rendered(work, "loop", LOOP, seed)
    errors = _errors(drive, scene, ROAD_M, truth_from_scene(scene, drive))
    yield from _edges(f"rendered loop {seed}, in the world", errors, above=0.9)
    drive, scene = _rendered(work, "perturbed", PERTURBED, seed)
    title = f"rendered, calibration off, seed {seed}"
    yield from _edges(f"{title}, beside the vehicle, own lane", _errors(drive, scene, LANE_M, None), above=0.9)
    # For information, below 90 %: in the world they hold the errors of the scene's trajectory and scale as well.
    yield from _edges(f"{title}, beside the vehicle", _errors(drive, scene, ROAD_M, None))
    yield from _edges(f"{title}, in the world", _errors(drive, scene, ROAD_M, truth_from_scene(scene, drive)))


def real_pictures(data: Path, work: Path) -> Iterator[Figure]:
    """What the pictures of real drives show of the road that is seen."""
    for name in ("kitti06", "kitti02"):
        found = _found(reconstructed(imported(data, name, work), work / f"{name} with GNSS"))
        yield Figure(
            line=LINE,
            what=f"{name}: ground that is seen and left out, as its views do not agree or something hides it",
            value=100 * found["left_out_share"],
            unit="%",
            above=0.1,
            most=50.0,
        )
        yield Figure(line=LINE, what=f"{name}: ground that is seen", value=found["ground_seen_m2"], unit="m2")


def _rendered(work: Path, name: str, options: tuple[object, ...], seed: int) -> tuple[Path, Path]:
    drive = work / f"{name} {seed}"
    mrasfm("synth", *options, "--seed", seed, "--out", drive)
    return drive, reconstructed(drive, work / f"{name} {seed}, scene")


def _errors(drive: Path, scene: Path, near_m: float, truth_from_scene_xy: Floats | None) -> EdgeErrors:
    picture = cv2.imread(str(scene / "pictures" / "road.png"), cv2.IMREAD_UNCHANGED)[..., [2, 1, 0, 3]]
    from_pixel = np.array(_found(scene)["world_from_pixel"])
    edges = true_edges(drive)
    near = cKDTree(read_tum(drive / "truth.tum").world_from_rig[:, :2, 3]).query(edges.at_m)[0] < near_m
    if truth_from_scene_xy is None:
        edges = beside_the_vehicle(edges, scene, drive)
    else:
        a = truth_from_scene_xy
        from_pixel = np.column_stack([a[:, :2] @ from_pixel[:, :2], a[:, :2] @ from_pixel[:, 2] + a[:, 2]])
    return edge_errors(picture, from_pixel, edges, near)


def _edges(title: str, errors: EdgeErrors, *, above: float | None = None) -> Iterator[Figure]:
    found = np.abs(errors.error_m[np.isfinite(errors.error_m)])
    yield Figure(line=LINE, what=f"{title}: edges of markings that are shown", value=len(errors.error_m), above=1000)
    yield Figure(
        line=LINE,
        what=f"{title}: of these within 5 cm of the painted ones",
        value=100 * errors.within(WITHIN_M),
        unit="%",
        above=None if above is None else 100 * above,
        most=None if above is None else 99.99,
    )
    yield Figure(line=LINE, what=f"{title}: their distance, median", value=float(np.median(found)), unit="m", most=0.03)


def _found(scene: Path) -> dict[str, Any]:
    found: dict[str, Any] = read_report(scene)["by_stage"]["pictures"]["road"]
    return found
