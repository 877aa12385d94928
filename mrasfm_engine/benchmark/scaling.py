"""Scaling of time, memory and error with the length of a simulated route, without images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mrasfm_engine.benchmark import mapping
from mrasfm_engine.benchmark.side_by_side import DATABASE, Row, Settings, our_row, peer_rows, with_errors
from mrasfm_engine.errors import InputError
from mrasfm_engine.evaluation.trajectory import MIN_POSES, end_error_m
from mrasfm_engine.synthetic.long_route import require_rig
from mrasfm_engine.types import Floats


@dataclass(frozen=True, kw_only=True)
class GrowthRow:
    """One mapper on one route.

    Attributes
    ----------
    per_unit_s
        Mapping and refinement.
    end_error_percent
        Distance of the last unit from its true place after an alignment on the first units, of the route's length.
    route_error_percent
        RMSE of all positions after one rigid alignment, of the route's length.
    """

    row: Row
    per_unit_s: float | None
    end_error_percent: float | None
    route_error_percent: float | None


@dataclass(frozen=True, kw_only=True)
class Growth:
    """All mappers on one route; ours is the first row."""

    rig: str
    units: int
    seed: int
    route_m: float
    images: int
    keypoints: int
    verified_matches: int | None  # None where descriptors were matched: see the row
    rows: list[GrowthRow]


def measure_growth(
    rig: str, units: Sequence[int], seed: int, work: Path, settings: Settings, *, descriptors: bool = False
) -> list[Growth]:
    """Simulate a route of every length, and map it.

    Parameters
    ----------
    descriptors
        Leave the descriptors of all images on disk, and match them as those of a drive, in sub-maps where it is cut.

    Raises
    ------
    InputError
        For a rig that is not known, a length that makes no sense, or baselines where there are descriptors.
    """
    require_rig(rig)
    if descriptors and settings.baselines:
        raise InputError(
            "--descriptors does not go with --baselines: baselines map matches", remedy="Leave one of them out."
        )
    if descriptors and settings.repeat > 1:
        raise InputError(
            "--descriptors does not go with --repeat: what is matched once stays on disk", remedy="Leave one out."
        )
    for count in units:
        if count < MIN_POSES:
            raise InputError(f"--units {count} is too short a route", remedy=f"Ask for at least {MIN_POSES} units.")
    measure = _measure_from_descriptors if descriptors else _measure
    return [measure(rig, count, seed, work / f"{rig}-{count}", settings) for count in units]


def _measure_from_descriptors(rig: str, units: int, seed: int, folder: Path, settings: Settings) -> Growth:
    label = f"{rig}, {units} units"
    simulated, _ = settings.require(label, mapping.simulate_descriptors, rig, units, seed, settings.config, folder)
    return _growth(rig, units, seed, simulated, [our_row(settings, mapping.map_descriptors, folder, settings.config)])


def _measure(rig: str, units: int, seed: int, folder: Path, settings: Settings) -> Growth:
    label = f"{rig}, {units} units"
    simulated, _ = settings.require(label, mapping.simulate, rig, units, seed, settings.config, folder)
    if settings.baselines:
        settings.require(label, mapping.write_simulated_database, folder, folder / DATABASE)
    rows = [our_row(settings, mapping.map_simulated, folder, settings.config), *peer_rows(settings, folder / DATABASE)]
    return _growth(rig, units, seed, simulated, rows)


def _growth(rig: str, units: int, seed: int, simulated: mapping.Simulated, rows: Sequence[Row]) -> Growth:
    truth = simulated.world_from_rig
    route_m = float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())
    return Growth(
        rig=rig,
        units=units,
        seed=seed,
        route_m=route_m,
        images=simulated.images,
        keypoints=simulated.keypoints,
        verified_matches=simulated.verified_matches,
        rows=[_growth_row(with_errors(row, truth), truth, route_m) for row in rows],
    )


def _growth_row(row: Row, truth: Floats, route_m: float) -> GrowthRow:
    end_m = end_error_m(row.world_from_rig, truth)
    return GrowthRow(
        row=row,
        per_unit_s=None if row.whole_s is None else row.whole_s / len(truth),
        end_error_percent=None if end_m is None else 100 * end_m / route_m,
        route_error_percent=None if row.errors is None else 100 * row.errors.metric_rmse_m / route_m,
    )
