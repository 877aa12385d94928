"""COLMAP's mappers on the matches of a scene, as figures of a line."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import pycolmap

from mrasfm_engine.benchmark.baselines import Baseline, run_baseline
from mrasfm_engine.io.trajectory_file import read_tum
from tests.benchmarks.table import Figure

THREADS = os.cpu_count() or 1


def beside_colmap(
    line: str,
    title: str,
    mapper: Baseline,
    *,
    scene: Path,
    drive: Path,
    unit_of_image: Mapping[str, int] | None = None,
) -> tuple[list[Figure], float]:
    """Figures of one mapper, and its RMSE in metres after a similarity; infinite where there is no model."""
    result = run_baseline(scene / "features.db", mapper, threads=THREADS, unit_of_image=unit_of_image)
    figure, title = partial(Figure, line=line), f"{title}, COLMAP {mapper}"
    figures = [
        figure(what=f"{title}: mapping", value=result.seconds, unit="s", remark=result.failure),
        figure(what=f"{title}: images registered", value=result.registered_images),
    ]
    errors = result.errors(read_tum(drive / "truth.tum").world_from_rig)
    if errors is None:
        return figures, math.inf
    figures.append(figure(what=f"{title}: metric RMSE", value=errors.metric_rmse_m, unit="m"))
    figures.append(figure(what=f"{title}: similarity RMSE", value=errors.similarity_rmse_m, unit="m"))
    return figures, errors.similarity_rmse_m


def verified_pairs(database: Path) -> list[tuple[str, str]]:
    """Names of the images of each pair that a database has verified."""
    opened = pycolmap.Database.open(str(database))
    names = {image.image_id: image.name for image in opened.read_all_images()}
    ids, _ = opened.read_two_view_geometry_num_inliers()
    opened.close()
    return [(names[a], names[b]) for a, b in map(pycolmap.pair_id_to_image_pair, ids)]
