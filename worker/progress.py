"""How far an attempt is as a whole: percent and time to the end, from the engine's reports on its stages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from worker.child_protocol import Work

# Shares of the time, measured on drives of 100 images; what counts is that nothing seems to stand still. `fetch` and
# `publish` are the worker's own: the drive from the artifact store, and the results into it.
WEIGHTS: Mapping[Work, Mapping[str, float]] = MappingProxyType(
    {
        Work.RECONSTRUCTION: {
            "fetch": 3.0,
            "preflight": 4.0,
            "features": 32.0,
            "matches": 25.0,
            "mapping": 20.0,
            "refinement": 6.0,
            "pictures": 3.0,
            "export": 4.0,
            "publish": 3.0,
        },
        Work.AGGREGATION: {
            "fetch": 4.0,
            "scenes": 8.0,
            "association": 1.0,
            "seams": 52.0,
            "joint": 5.0,
            "adjustment": 16.0,
            "pictures": 4.0,
            "export": 6.0,
            "publish": 4.0,
        },
        Work.PREFLIGHT: {"fetch": 20.0, "preflight": 30.0, "calibration": 50.0},
    }
)
UNITS: Mapping[str, str] = MappingProxyType(
    {
        "fetch": "files",
        "scenes": "scenes",
        "preflight": "files",
        "features": "images",
        "matches": "pairs",
        "mapping": "units",  # rigid units: all cameras at one instant
        "refinement": "rounds",
        "pictures": "images",
        "publish": "files",
    }
)
REUSABLE = frozenset({"features", "matches", "mapping"})

_MIN_EARNED = 5.0  # percent that must have been worked for before a time to the end means something
_MIN_ELAPSED_S = 3.0
_DOUBT = 1.0  # at the beginning the end may be twice as far, or half; at the end there is no doubt left


@dataclass(frozen=True)
class Progress:
    """How far an attempt is.

    Attributes
    ----------
    stage
        Empty before the first one begins.
    done, total, unit
        Of the stage. Unit is None where the stage counts nothing: it was finished before, or has no parts.
    percent
        Of the attempt, 0 to 100; never falls.
    eta_s
        Seconds to the end, at least and at most; None until it means something.
    reused
        Stages whose results were there already, as far as the reports tell; the scene's report has the last word.
    """

    stage: str = ""
    done: int = 0
    total: int = 0
    unit: str | None = None
    percent: float = 0.0
    eta_s: tuple[float, float] | None = None
    reused: tuple[str, ...] = ()


class ProgressMeter:
    """Turns reports on stages into progress of the attempt.

    Parameters
    ----------
    work
        What the attempt does: it decides which stages there are.
    started_s
        When the attempt began, on the clock of the later times.
    """

    def __init__(self, work: Work, *, started_s: float) -> None:
        self._weights = WEIGHTS[work]
        self._started_s = started_s
        self._progress = Progress()
        self._skipped = 0.0  # percent that cost no time

    def update(self, stage: str, done: int, total: int) -> None:
        """Take in a report. Stages that are not known count nothing."""
        now = self._progress
        begins = stage != now.stage
        # The engine ends each of these with "1 of 1"; one that begins so was finished before.
        reused = begins and done == total == 1 and stage in REUSABLE
        if reused:
            self._skipped += self._weights.get(stage, 0.0)
        elif done == total == 1 and stage in REUSABLE:
            done = total = max(now.total, 1)
        self._progress = Progress(
            stage=stage,
            done=done,
            total=total,
            unit=None if reused else UNITS.get(stage),
            percent=max(now.percent, self._percent(stage, done, total)),
            reused=(*now.reused, stage) if reused else now.reused,
        )

    @property
    def stage(self) -> str:
        """The stage that was reported last; empty before the first."""
        return self._progress.stage

    def at(self, now_s: float) -> Progress:
        """The progress at a moment."""
        p = self._progress
        return Progress(p.stage, p.done, p.total, p.unit, p.percent, self._eta_s(now_s), p.reused)

    def _percent(self, stage: str, done: int, total: int) -> float:
        before = 0.0
        for name, weight in self._weights.items():
            if name == stage:
                return before + weight * min(1.0, max(0.0, done / total if total > 0 else 0.0))
            before += weight
        return self._progress.percent

    def _eta_s(self, now_s: float) -> tuple[float, float] | None:
        elapsed_s = now_s - self._started_s
        percent = self._progress.percent
        earned = percent - self._skipped
        if earned < _MIN_EARNED or elapsed_s < _MIN_ELAPSED_S:
            return None
        left_s = elapsed_s * (100.0 - percent) / earned
        doubt = 1.0 + _DOUBT * (100.0 - percent) / 100.0
        return left_s / doubt, left_s * doubt
