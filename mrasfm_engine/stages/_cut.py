"""The cut of a long drive into sub-maps."""

from __future__ import annotations

import numpy as np

from mrasfm_engine.io.stage_store import fingerprint
from mrasfm_engine.scene.submaps import Span, count_for_memory, count_for_workers, count_in_rounds, cut, spans_between
from mrasfm_engine.stages._run import Run
from mrasfm_engine.stages._standing import keep_nothing_left_out

SUBMAPS, SUBMAPS_VERSION = "submaps", 1
BYTES_PER_MB = 1_000_000


def cut_drive(run: Run, workers: int = 1) -> list[Span]:
    """The sub-maps of the run's drive, along its path; none where it is one piece.

    A cut that is in the store stays, whatever number of workers there are now.
    """
    stored = _stored_cut(run)
    if stored is not None:
        return stored
    run.require_unplanned()
    overlap = run.config.submaps.overlap_units
    spans = cut(len(run.drive.manifest.frames), count_of_submaps(run, workers), overlap)
    run.store.remove("submap-*")  # of another cut: they hold all features
    if len(spans) < 2:
        return []
    keep_nothing_left_out(run)
    ends = np.array([(span.first, span.last) for span in spans])
    run.store.save(SUBMAPS, _cut_key(run), {"ends": ends}, {})
    return spans


def is_cut(run: Run) -> bool:
    """True where a cut of the run's drive is in the store."""
    return _stored_cut(run) is not None


def _stored_cut(run: Run) -> list[Span] | None:
    stored = run.store.load(SUBMAPS, _cut_key(run))
    if stored is None:
        return None
    return spans_between([(first, last) for first, last in stored[0]["ends"].tolist()])


def _cut_key(run: Run) -> str:
    settings = [run.config.submaps.model_dump(exclude={"processes"}), run.config.features.max_keypoints]
    return fingerprint(run.key or run.drive_key, SUBMAPS, settings, SUBMAPS_VERSION)


def count_of_submaps(run: Run, workers: int) -> int:
    """Number of sub-maps that the settings, the expected memory and the workers ask for."""
    settings = run.config.submaps
    for_memory = count_for_memory(
        run.drive,
        keypoints_per_image=run.config.features.max_keypoints,
        memory_bytes=settings.memory_mb * BYTES_PER_MB,
    )
    for_workers = count_for_workers(run.drive, workers, settings.overlap_units)
    return settings.count or count_in_rounds(for_memory, for_workers)
