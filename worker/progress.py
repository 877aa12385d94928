"""The progress of an attempt as a whole: percent and time to the end, from the engine's reports on its stages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

from schemas.artifacts import CHECKPOINTED, Stage
from service.domain.jobs import ProgressNote
from worker.child_protocol import Work

# Shares of the time, measured on drives of 100 images; what counts is that nothing seems to stand still. `fetch` and
# `publish` are the worker's own: the drive from the artifact store, and the results into it.
WEIGHTS: Mapping[Work, Mapping[str, float]] = MappingProxyType(
    {
        Work.RECONSTRUCTION: {
            Stage.FETCH: 3.0,
            Stage.PREFLIGHT: 4.0,
            Stage.FEATURES: 32.0,
            Stage.MATCHES: 25.0,
            Stage.MAPPING: 20.0,
            Stage.REFINEMENT: 6.0,
            Stage.PICTURES: 3.0,
            Stage.EXPORT: 4.0,
            Stage.PUBLISH: 3.0,
        },
        Work.AGGREGATION: {
            Stage.FETCH: 4.0,
            Stage.SCENES: 8.0,
            Stage.ASSOCIATION: 1.0,
            Stage.SEAMS: 52.0,
            Stage.MULTI_SCENE_ADJUSTMENT: 5.0,
            Stage.MAP_ADJUSTMENT: 16.0,
            Stage.PICTURES: 4.0,
            Stage.EXPORT: 6.0,
            Stage.PUBLISH: 4.0,
        },
        Work.SUBMAP: {
            Stage.FETCH: 4.0,
            Stage.FEATURES: 39.0,
            Stage.MATCHES: 31.0,
            Stage.MAPPING: 25.0,
            Stage.PUBLISH: 1.0,
        },
        Work.EXPORT: {Stage.FETCH: 20.0, Stage.EXPORT: 65.0, Stage.PUBLISH: 15.0},
        Work.PREFLIGHT: {Stage.FETCH: 20.0, Stage.PREFLIGHT: 30.0, Stage.CALIBRATION: 50.0},
    }
)
UNITS: Mapping[str, str] = MappingProxyType(
    {
        Stage.FETCH: "files",
        Stage.SCENES: "scenes",
        Stage.PREFLIGHT: "files",
        Stage.FEATURES: "images",
        Stage.MATCHES: "pairs",
        Stage.MAPPING: "units",  # rigid units: all cameras at one instant
        Stage.REFINEMENT: "rounds",
        Stage.PICTURES: "images",
        Stage.PUBLISH: "files",
    }
)

_MIN_EARNED = 5.0  # percent that must have been worked for before a time to the end means something
_MIN_ELAPSED_S = 3.0
_DOUBT = 1.0  # at the beginning the end may be twice as far, or half; at the end there is no doubt left


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
        self._note = ProgressNote()
        self._skipped = 0.0  # percent that cost no time

    def update(self, stage: str, done: int, total: int) -> None:
        """Take in a report. Stages that are not known count nothing."""
        now = self._note
        # The engine ends each of these with "1 of 1"; one that begins so was finished before.
        ends = done == total == 1 and stage in CHECKPOINTED
        reused = ends and stage != now.stage
        if reused:
            self._skipped += self._weights.get(stage, 0.0)
        elif ends:
            done = total = max(now.total, 1)
        self._note = ProgressNote(
            stage=stage,
            done=done,
            total=total,
            unit=None if reused else UNITS.get(stage),
            percent=max(now.percent, self._percent(stage, done, total)),
            reused=(*now.reused, stage) if reused else now.reused,
            engine_ran=stage != Stage.FETCH,
        )

    @property
    def stage(self) -> str:
        """The stage that was reported last; empty before the first."""
        return self._note.stage

    def at(self, now_s: float) -> ProgressNote:
        """The progress at a moment, rounded; its time to the end is None until it means something."""
        note = self._note
        low_s, high_s = self._eta_s(note.percent, now_s)
        return replace(note, percent=round(note.percent, 2), eta_low_s=low_s, eta_high_s=high_s)

    def _percent(self, stage: str, done: int, total: int) -> float:
        before = 0.0
        for name, weight in self._weights.items():
            if name == stage:
                return before + weight * min(1.0, max(0.0, done / total if total > 0 else 0.0))
            before += weight
        return self._note.percent

    def _eta_s(self, percent: float, now_s: float) -> tuple[float, float] | tuple[None, None]:
        elapsed_s = now_s - self._started_s
        earned = percent - self._skipped
        if earned < _MIN_EARNED or elapsed_s < _MIN_ELAPSED_S:
            return None, None
        left_s = elapsed_s * (100.0 - percent) / earned
        doubt = 1.0 + _DOUBT * (100.0 - percent) / 100.0
        return round(left_s / doubt, 1), round(left_s * doubt, 1)
