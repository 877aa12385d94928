"""Line 44: real drives of which only every second to tenth frame is there: how far apart images may be."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mrasfm_engine.io.trajectory_file import read_tum
from tests.benchmarks.commands import evaluate, mrasfm
from tests.benchmarks.table import Figure, exactly

LINE = "44"


@dataclass(frozen=True, kw_only=True)
class Sparse:
    """A recording, the frames of it that are used, and the distances between these for which errors have bounds."""

    name: str
    first: int
    end: int
    steps: tuple[int, ...]
    similarity_rmse_m: float
    metric_rmse_m: float
    bounded_to_m: float


# KITTI 06 is straight, KITTI 01 turns by 98 deg, PandaSet has six cameras that are not simultaneous.
DRIVES = (
    Sparse(
        name="kitti06", first=0, end=51, steps=(1, 2, 3, 5, 7, 10),
        similarity_rmse_m=0.05, metric_rmse_m=0.10, bounded_to_m=13.0,
    ),
    Sparse(
        name="kitti01", first=0, end=51, steps=(1, 2, 3, 5, 7, 10),
        similarity_rmse_m=0.09, metric_rmse_m=0.20, bounded_to_m=6.5,
    ),
    Sparse(
        name="pandaset_002", first=26, end=80, steps=(1, 2, 3, 5),
        similarity_rmse_m=0.010, metric_rmse_m=0.05, bounded_to_m=13.0,
    ),
)  # fmt: skip


def sparse_frames(data: Path, work: Path) -> Iterator[Figure]:
    """Line 44."""
    for sparse in DRIVES:
        for step in sparse.steps:
            drive = work / f"{sparse.name} by {step}"
            frames = f"{sparse.first}:{sparse.end}:{step}"
            mrasfm("import", data / sparse.name, "--frames", frames, "--out", drive)
            yield from _figures(sparse, drive, work / f"{drive.name} scene")


def _figures(sparse: Sparse, drive: Path, scene: Path) -> Iterator[Figure]:
    position_m = read_tum(drive / "truth.tum").world_from_rig[:, :3, 3]
    spacing_m = float(np.linalg.norm(np.diff(position_m, axis=0), axis=1).mean())
    mrasfm("reconstruct", drive, "--out", scene)
    errors, what = evaluate(scene, drive), f"{sparse.name}, {len(position_m)} frames {spacing_m:.1f} m apart"
    is_bounded = spacing_m <= sparse.bounded_to_m
    yield exactly(LINE, f"{what}: units registered", errors["registered_units"], len(position_m))
    for kind, most in (("metric", sparse.metric_rmse_m), ("similarity", sparse.similarity_rmse_m)):
        value = errors[kind]["rmse_m"]
        yield Figure(line=LINE, what=f"{what}: {kind} RMSE", value=value, unit="m", most=most if is_bounded else None)
