"""Figures with their bounds, and how they are shown."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table


@dataclass(frozen=True, kw_only=True)
class Figure:
    """One measured figure. Without bounds it is there for information.

    A figure passes where `above < value <= most`: an error of exactly zero is a defect of the measurement.
    """

    line: str
    what: str
    value: float
    unit: str = ""
    above: float = 0.0
    most: float | None = None
    remark: str = ""

    @property
    def bounded(self) -> bool:
        return self.most is not None

    @property
    def passed(self) -> bool:
        return self.most is None or bool(math.isfinite(self.value) and self.above < self.value <= self.most)

    @property
    def bound(self) -> str:
        if self.most is None:
            return "for information"
        if self.above == 0:
            return f"<= {self.most:.4g}"
        return f"{self.above:.4g} < .. <= {self.most:.4g}"


def exactly(line: str, what: str, value: int, expected: int) -> Figure:
    """A count that must be right."""
    return Figure(line=line, what=what, value=value, above=expected - 0.5, most=expected)


def failed(line: str, what: str, why: str) -> Figure:
    """A figure that could not be measured."""
    return Figure(line=line, what=what, value=math.nan, most=math.inf, remark=why)


def reference_loop_s() -> float:
    """Seconds that ten million additions take here and now."""
    started_s, total = time.perf_counter(), 0
    for number in range(10_000_000):
        total += number
    return time.perf_counter() - started_s


def show(figures: Sequence[Figure], console: Console) -> None:
    """Print the table of all lines."""
    table = Table("line", "what", "figure", "bound", "")
    for figure in figures:
        verdict = "" if not figure.bounded else "pass" if figure.passed else "[bold red]FAIL"
        remark = f"\n  {figure.remark}" if figure.remark else ""
        table.add_row(
            figure.line, figure.what + remark, f"{figure.value:.4g} {figure.unit}".strip(), figure.bound, verdict
        )
    console.print(table)


def save(figures: Sequence[Figure], path: Path, about: dict[str, Any]) -> None:
    """Write the figures as JSON; what could not be measured is null."""
    rows = [{**asdict(f), "passed": f.passed if f.bounded else None} for f in figures]
    for row in rows:
        for key in ("value", "most"):
            row[key] = float(row[key]) if row[key] is not None and math.isfinite(row[key]) else None
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f"{path.name}.new")  # no reader sees half a file
    beside.write_text(json.dumps({**about, "figures": rows}, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    beside.replace(path)


def load(path: Path) -> tuple[dict[str, Any], list[Figure]]:
    """Read what `save` wrote: what the figures are about, and the figures."""
    about = json.loads(path.read_text(encoding="utf-8"))
    rows = about.pop("figures")
    for row in rows:
        row["most"] = math.inf if row["passed"] is not None and row["most"] is None else row["most"]
        row["value"] = math.nan if row["value"] is None else row["value"]
        del row["passed"]
    return about, [Figure(**row) for row in rows]
