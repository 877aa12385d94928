"""Output of `mrasfm bench` for published data sets, beside the published figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

from rich.console import Console
from rich.table import Table

from mrasfm_engine.benchmark.datasets import SceneResult, planar_rmse_m
from mrasfm_engine.benchmark.published import KITTI, METHODS, NUSCENES_RMSE_M
from mrasfm_engine.benchmark.side_by_side import BASELINES, OURS, Row
from mrasfm_engine.commands.bench_output import Document, comparison_document, megabytes, number


@dataclass(frozen=True)
class KittiOutput:
    """Table of sequences of KITTI odometry, beside the published figures."""

    results: Sequence[SceneResult]

    def document(self) -> Document:
        """Document for JSON."""
        return {
            "sequences": [
                {**_scene(result), "published": asdict(KITTI[result.name]) if result.name in KITTI else None}
                for result in self.results
            ]
        }

    def print(self) -> None:
        """Sequences down, methods across."""
        console, table = Console(), Table(title="median absolute translation error, m (rotation, deg)")
        mappers = _mappers(self.results)
        here = [f"{heading}\nhere" for heading in (*mappers, "min", "MB", "images")]
        for heading in ("", *METHODS, "min", *here):
            table.add_column(heading, justify="right")
        for result in self.results:
            rows = _by_mapper(result)
            known = KITTI.get(result.name)
            published = [known.by_method[method] for method in METHODS] if known else []
            table.add_row(
                result.name,
                *([f"{e.translation_m:.1f} ({e.rotation_deg:.1f})" for e in published] or ["-"] * len(METHODS)),
                f"{known.mrasfm_minutes:g}" if known else "-",
                *(_medians(rows.get(mapper)) for mapper in mappers),
                _minutes(result),
                _peak(result),
                _images(result),
            )
        console.print(table)
        console.print(
            "Columns without 'here' are published (arXiv 2510.15467), of other machines. Here: errors of the vehicle's "
            "positions after one rigid alignment, without scale; minutes of ours with features and matches, memory "
            "at its peak in our mapping.",
            soft_wrap=True,
        )
        _print_failures(console, self.results)


@dataclass(frozen=True)
class NuScenesOutput:
    """Table of scenes of nuScenes, beside the published figures.

    Parameters
    ----------
    setting
        A sentence on what was reconstructed.
    """

    results: Sequence[SceneResult]
    setting: str = ""

    def document(self) -> Document:
        """Document for JSON."""
        scenes = []
        for result in self.results:
            document = _scene(result)
            for row, of in zip(document.get("mappers", []), _rows_of(result), strict=True):
                row["planar_rmse_m"] = _planar(result, of)
            scenes.append(document)
        return {"setting": self.setting, "scenes": scenes, "published_rmse_m": dict(NUSCENES_RMSE_M)}

    def print(self) -> None:
        """Scenes down, mappers across; then the mean over scenes beside what is published."""
        console, table = Console(), Table(title="RMSE, m: in x and y / in space")
        mappers = _mappers(self.results)
        for heading in ("", *mappers, "min", "MB", "images"):
            table.add_column(heading, justify="right")
        for result in self.results:
            rows = _by_mapper(result)
            table.add_row(
                result.name,
                *(self._pair(result, rows.get(mapper)) for mapper in mappers),
                _minutes(result),
                _peak(result),
                _images(result),
            )
        table.add_row("mean", *(self._mean(mapper) for mapper in mappers), "", "", "", end_section=True)
        console.print(table)
        if self.setting:
            console.print(self.setting, soft_wrap=True)
        published = ", ".join(f"{name} {rmse_m:.3f}" for name, rmse_m in NUSCENES_RMSE_M.items())
        console.print(f"Published (arXiv 2510.15467), RMSE in m: {published}", soft_wrap=True)
        console.print(
            "The truth is plane (z = 0) and good to about 0.1 m. Errors are after one rigid alignment a scene, without "
            "scale; the mean is over scenes that have an error.",
            soft_wrap=True,
        )
        _print_failures(console, self.results)

    def _pair(self, result: SceneResult, row: Row | None) -> str:
        if row is None or row.errors is None:
            return "-"
        return f"{number(_planar(result, row), 3)} / {row.errors.metric_rmse_m:.3f}"

    def _mean(self, mapper: str) -> str:
        rows = [(result, _by_mapper(result).get(mapper)) for result in self.results]
        known = [(_planar(result, row), row.errors.metric_rmse_m) for result, row in rows if row and row.errors]
        if not known:
            return "-"
        planar, spatial = (sum(value or 0.0 for value in column) / len(known) for column in zip(*known, strict=True))
        return f"{planar:.3f} / {spatial:.3f}"


def _scene(result: SceneResult) -> Document:
    if result.comparison is None:
        return {"name": result.name, "failure": result.failure}
    return {"name": result.name, **comparison_document(result.comparison)}


def _rows_of(result: SceneResult) -> list[Row]:
    return [] if result.comparison is None else result.comparison.rows


def _by_mapper(result: SceneResult) -> dict[str, Row]:
    return {row.mapper: row for row in _rows_of(result)}


def _mappers(results: Sequence[SceneResult]) -> list[str]:
    return [name for name in (OURS, *BASELINES) if name == OURS or any(name in _by_mapper(r) for r in results)]


def _planar(result: SceneResult, row: Row) -> float | None:
    found = result.comparison
    if found is None or found.truth_world_from_rig is None or not len(row.world_from_rig):
        return None
    return planar_rmse_m(row.world_from_rig, found.truth_world_from_rig[: len(row.world_from_rig)])


def _medians(row: Row | None) -> str:
    if row is None or row.errors is None:
        return "-"
    return f"{row.errors.metric_median_m:.2f} ({row.errors.rotation_median_deg:.2f})"


def _minutes(result: SceneResult) -> str:
    """Minutes of all our stages; without a sum where some were taken from an earlier run."""
    if result.comparison is None:
        return "-"
    prepared = result.comparison.prepared
    stages = (prepared.features_s, prepared.matches_s, result.comparison.rows[0].whole_s)
    return "-" if None in stages else f"{sum(s or 0.0 for s in stages) / 60:.1f}"


def _peak(result: SceneResult) -> str:
    return "-" if result.comparison is None else megabytes(result.comparison.rows[0].peak_memory_bytes)


def _images(result: SceneResult) -> str:
    found = result.comparison
    return "-" if found is None else f"{found.rows[0].registered_images} of {found.images}"


def _print_failures(console: Console, results: Sequence[SceneResult]) -> None:
    for result in results:
        if result.failure:
            console.print(f"{result.name}: {result.failure}", soft_wrap=True)
        for row in _rows_of(result):
            if row.failure:
                console.print(f"{result.name}, {row.mapper}: {row.failure}", soft_wrap=True)
