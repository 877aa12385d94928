"""Output of `mrasfm bench` for a drive and for routes: tables for people, documents for programs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import pycolmap
from rich.console import Console
from rich.table import Table

from mrasfm_engine import __version__
from mrasfm_engine.benchmark.scaling import Growth, GrowthRow
from mrasfm_engine.benchmark.side_by_side import Comparison, Row
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.evaluation.trajectory import TrajectoryErrors

Document = dict[str, Any]
MEGABYTE = 1e6


def versions(config: EngineConfig) -> Document:
    """Versions and machine of a measurement."""
    return {"mrasfm": __version__, "pycolmap": pycolmap.__version__, "threads": config.threads}


@dataclass(frozen=True)
class DriveOutput:
    """Table of one drive."""

    comparison: Comparison

    def document(self) -> Document:
        """Document for JSON."""
        return comparison_document(self.comparison)

    def print(self) -> None:
        """Measures down, mappers across: so it fits into a terminal."""
        found, prepared = self.comparison, self.comparison.prepared
        console = Console()
        console.print(
            f"{found.drive}: {found.units} units, {found.images} images, {prepared.keypoints} keypoints, "
            f"{prepared.verified_matches} verified matches of {prepared.verified_pairs} pairs",
            soft_wrap=True,
        )
        console.print(
            f"features {_seconds(prepared.features_s)}, matches {_seconds(prepared.matches_s)}, peak memory "
            f"{_megabytes(found.prepared_peak_memory_bytes)}; all mappers have the same",
            soft_wrap=True,
        )
        _print_rows(console, MEASURES, found.rows, found.images)


@dataclass(frozen=True)
class GrowthOutput:
    """Table of simulated routes."""

    routes: Sequence[Growth]

    def document(self) -> Document:
        """Document for JSON."""
        return {
            "routes": [
                {
                    **{key: value for key, value in asdict(route).items() if key != "rows"},
                    "mappers": [
                        {
                            **_row(row.row),
                            "per_unit_s": row.per_unit_s,
                            "end_error_percent": row.end_error_percent,
                            "route_error_percent": row.route_error_percent,
                        }
                        for row in route.rows
                    ],
                }
                for route in self.routes
            ]
        }

    def print(self) -> None:
        """Measures down, routes and mappers across."""
        console, table = Console(), Table()
        table.add_column("")
        columns = [(route, row) for route in self.routes for row in route.rows]
        for route, row in columns:
            table.add_column(f"{row.row.mapper}\n{route.rig}, {route.units} units", justify="right")
        for measure, of in GROWTH_MEASURES.items():
            table.add_row(measure, *(of(route, row) for route, row in columns))
        console.print(table)
        for route, row in columns:
            if row.row.failure:
                console.print(f"{row.row.mapper}, {route.units} units: {row.row.failure}", soft_wrap=True)


def comparison_document(found: Comparison) -> Document:
    """All mappers on one drive, as JSON has it."""
    return {
        "drive": found.drive,
        "units": found.units,
        "images": found.images,
        "features_and_matches": {
            **asdict(found.prepared),
            "peak_memory_bytes": found.prepared_peak_memory_bytes,
        },
        "mappers": [_row(row) for row in found.rows],
    }


def _row(row: Row) -> Document:
    document = {key: value for key, value in vars(row).items() if key not in ("world_from_rig", "errors")}
    return document | {"whole_s": row.whole_s, "errors": None if row.errors is None else asdict(row.errors)}


def _print_rows(
    console: Console, measures: Mapping[str, Callable[[Row], str]], rows: Sequence[Row], images: int
) -> None:
    table = Table()
    table.add_column("")
    for row in rows:
        table.add_column(row.mapper, justify="right")
    table.add_row("images registered", *(f"{row.registered_images} of {images}" for row in rows))
    for measure, value in measures.items():
        table.add_row(measure, *(value(row) for row in rows))
    console.print(table)
    for row in rows:
        if row.failure:
            console.print(f"{row.mapper}: {row.failure}", soft_wrap=True)


def number(value: float | None, digits: int) -> str:
    """A number in a table."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def _seconds(value: float | None) -> str:
    return "taken from an earlier run" if value is None else f"{value:.1f} s"


def _megabytes(value: int | None) -> str:
    return "unknown" if value is None else f"{value / MEGABYTE:.0f} MB"


def megabytes(value: int | None) -> str:
    """Bytes in a table."""
    return number(None if value is None else value / MEGABYTE, 0)


def _error(measure: Callable[[TrajectoryErrors], float], digits: int) -> Callable[[Row], str]:
    return lambda row: "-" if row.errors is None else number(measure(row.errors), digits)


def _count(value: int | None) -> str:
    return "-" if value is None else str(value)


MEASURES: Mapping[str, Callable[[Row], str]] = {
    "mapping, s": lambda row: number(row.mapping_s, 1),
    "refinement, s": lambda row: number(row.refinement_s, 1),
    "both, s": lambda row: number(row.whole_s, 1),
    "  fastest of the runs": lambda row: number(min(row.runs_s, default=None), 1),
    "  slowest of the runs": lambda row: number(max(row.runs_s, default=None), 1),
    "peak memory, MB": lambda row: megabytes(row.peak_memory_bytes),
    "  before mapping, MB": lambda row: megabytes(row.start_memory_bytes),
    "metric RMSE, m": _error(lambda e: e.metric_rmse_m, 4),
    "similarity RMSE, m": _error(lambda e: e.similarity_rmse_m, 4),
    "  scale": _error(lambda e: e.similarity_scale, 5),
    "rotation, deg": _error(lambda e: e.rotation_median_deg, 4),
}

GROWTH_MEASURES: Mapping[str, Callable[[Growth, GrowthRow], str]] = {
    "route, m": lambda route, row: number(route.route_m, 0),
    "images": lambda route, row: str(route.images),
    "keypoints": lambda route, row: str(route.keypoints),
    "verified matches": lambda route, row: _count(route.verified_matches or row.row.verified_matches),
    "units registered": lambda route, row: str(row.row.registered_units),
    "points": lambda route, row: _count(row.row.points),
    "observations": lambda route, row: _count(row.row.observations),
    "revisits believed, of tried": lambda route, row: (
        "-" if row.row.revisits_tried is None else f"{row.row.revisits_believed} of {row.row.revisits_tried}"
    ),
    "sub-maps": lambda route, row: str(row.row.submaps),
    "matching, s": lambda route, row: number(row.row.matching_s, 1),
    "mapping, s": lambda route, row: number(row.row.mapping_s, 1),
    "refinement, s": lambda route, row: number(row.row.refinement_s, 1),
    "both a unit, s": lambda route, row: number(row.per_unit_s, 3),
    "peak memory, MB": lambda route, row: megabytes(row.row.peak_memory_bytes),
    "  before mapping, MB": lambda route, row: megabytes(row.row.start_memory_bytes),
    "error of the end, % of the route": lambda route, row: number(row.end_error_percent, 4),
    "error of the whole route, %": lambda route, row: number(row.route_error_percent, 4),
    "similarity RMSE, m": lambda route, row: _error(lambda e: e.similarity_rmse_m, 4)(row.row),
}
