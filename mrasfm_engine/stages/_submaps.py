"""A drive mapped: in one piece, or as sub-maps that are done stage by stage, in processes, and then joined."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import replace
from typing import Any

from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import ReconstructionError
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory
from mrasfm_engine.scene.submaps import Span
from mrasfm_engine.stages._features import features
from mrasfm_engine.stages._join import join_submaps
from mrasfm_engine.stages._mapping import MappedDrive, mapping
from mrasfm_engine.stages._matches import matches
from mrasfm_engine.stages._run import Run, new_report
from mrasfm_engine.stages._submap_run import SubmapRun
from mrasfm_engine.subprocess_run import run_in_subprocess
from mrasfm_engine.types import StageProgress
from schemas.artifacts import SUBMAP_STAGES, Stage

THREADS_A_PROCESS = 4  # one process has not enough to do for more all of the time: units are registered one by one


def mapped(run: Run, spans: Sequence[Span], known: PriorTrajectory) -> MappedDrive:
    """Features, matches and mapped components of a drive: of its sub-maps where it is cut, else in one piece.

    Raises
    ------
    InputError, ReconstructionError
        Where no image can be read, none has a keypoint, nothing matches or nothing can be mapped.
    """
    if spans:
        return join_submaps(run, run_submaps(run, spans), known)
    found = features(run)
    return mapping(run, found, matches(run, found, known), known)


def run_submaps(run: Run, spans: Sequence[Span]) -> list[SubmapRun]:
    """Do all sub-maps stage by stage, several at one time where the settings have processes for it.

    Raises
    ------
    ReconstructionError
        Where a process ended before its sub-map's stage was finished.
    """
    submaps = [SubmapRun(run, span) for span in spans]
    processes = min(_processes(run.config), len(submaps))
    for stage in SUBMAP_STAGES:
        run.begin(stage)
        tally = _Tally(run.progress, len(submaps))
        done = {}
        if processes > 1:
            done = _do_in_processes(run, stage, submaps, processes, tally)
        for submap in submaps:
            submap.run.progress = tally.step(submap.span.number)
            submap.do(stage)
            submap.entry(stage).update(done.get(submap.span.number, {}))
        if stage is Stage.FEATURES:  # the others go on with what no sub-map has
            run.progress(stage, 1, 1)
    return submaps


def _processes(config: EngineConfig) -> int:
    return config.submaps.processes or max(1, config.threads // THREADS_A_PROCESS)


def _do_in_processes(
    run: Run, stage: Stage, submaps: Sequence[SubmapRun], processes: int, tally: _Tally
) -> dict[int, dict[str, Any]]:
    """Do a stage of all sub-maps that are not finished, each in a process of its own that leaves it in the store.

    Returns
    -------
    dict
        How long it took and whether it was there already, by the number of the sub-map.
    """
    config = run.config.model_copy(update={"threads": max(1, run.config.threads // processes)})
    sent = replace(
        run,
        config=config,
        probed={},  # sub-maps extract their own images
        key=run.key or run.drive_key,
        progress=_report_to_nobody,
        cancel=_is_never_cancelled,
        report=new_report(),
    )
    failed = threading.Event()

    def one(span: Span) -> tuple[int, dict[str, Any]]:
        ended = run_in_subprocess(
            _do,
            sent,
            stage,
            span,
            progress=tally.step(span.number),
            cancel=lambda: failed.is_set() or run.cancel(),
        )
        if ended.result is None and not ended.failure.startswith("killed"):
            raise RuntimeError(f"the process of sub-map {span.number}, stage {stage}: {ended.failure}")
        if ended.result is None:
            raise ReconstructionError(
                f"the process of sub-map {span.number} ended early in stage {stage}: {ended.failure}",
                remedy="Run it again with fewer submaps.processes or less submaps.memory_mb: finished stages are "
                "reused.",
                code="submap-process",
            )
        return span.number, ended.result

    with ThreadPoolExecutor(processes) as pool:
        futures = [pool.submit(one, submap.span) for submap in submaps if not submap.is_finished]
        try:
            return dict(future.result() for future in as_completed(futures))
        except BaseException:
            failed.set()
            for future in futures:
                future.cancel()
            raise


def _do(progress: StageProgress, run: Run, stage: Stage, span: Span) -> dict[str, Any]:
    """Do a stage of a sub-map, in this process; how long it took, and whether it was there already."""
    submap = SubmapRun(replace(run, progress=progress), span)
    submap.do(stage)
    return {name: submap.entry(stage)[name] for name in ("seconds", "reused")}


def _report_to_nobody(stage: str, done: int, total: int) -> None:
    """Progress of a run that is sent to other processes, which have their own."""


def _is_never_cancelled() -> bool:
    """Answer in other processes: who cancels the run kills them."""
    return False


class _Tally:
    """Progress of a stage over all sub-maps: those that have not begun are taken to be as long as the others."""

    def __init__(self, progress: StageProgress, count: int) -> None:
        self._progress, self._count, self._lock = progress, count, threading.Lock()
        self._counts: dict[int, tuple[int, int]] = {}

    def step(self, number: int) -> StageProgress:
        """The progress callback of a sub-map."""

        def progress(stage: str, done: int, total: int) -> None:
            with self._lock:
                if (done, total) == (1, 1):
                    most = self._counts.get(number, (1, 1))[1]
                    self._counts[number] = (most, most)
                elif total:
                    self._counts[number] = (done, total)
                    every = sum(total for _, total in self._counts.values())
                    self._progress(
                        stage,
                        sum(done for done, _ in self._counts.values()),
                        every * self._count // len(self._counts),
                    )

        return progress
