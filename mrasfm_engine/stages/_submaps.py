"""Sub-maps of a long drive: each is extracted, matched and mapped by itself, and then all are joined."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, replace
from functools import cached_property
from typing import Any

import numpy as np

from mrasfm_engine.config import EngineConfig
from mrasfm_engine.errors import ReconstructionError
from mrasfm_engine.features.stored_features import JoinedFeatures, StoredFeatures
from mrasfm_engine.io.stage_store import Arrays, StageWriter, StoredStage, fingerprint
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.submaps import Part, join, part_arrays, part_from_arrays
from mrasfm_engine.matching.pair_choice import PairChoice
from mrasfm_engine.matching.pair_matching import match_pairs
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory
from mrasfm_engine.scene.drive import Incomplete
from mrasfm_engine.scene.scene import ImageFeatures, PairMatches
from mrasfm_engine.scene.semantics import count_classes
from mrasfm_engine.scene.submaps import Span, count_for_memory, count_for_workers, cut, share_a_submap, spans_between
from mrasfm_engine.stages._begin import prior
from mrasfm_engine.stages._features import describe_features, extract, features, left_out_of, require_features
from mrasfm_engine.stages._mapping import (
    described,
    keypoints_of,
    mappers,
    mapping,
    mapping_of,
    mapping_settings,
    numbered,
    packed,
)
from mrasfm_engine.stages._matches import (
    describe_matches,
    match,
    match_settings,
    matches,
    read_pairs,
    require_matches,
    write_pairs,
)
from mrasfm_engine.stages._run import Run, new_report
from mrasfm_engine.stages._standing import in_units, keep_nothing_left_out
from mrasfm_engine.subprocess_run import run_in_subprocess
from mrasfm_engine.types import Bools, Ints, StageProgress
from schemas.artifacts import Stage, submap_checkpoint

SUBMAPS, SUBMAPS_VERSION = "submaps", 1
STAGES = (Stage.FEATURES, Stage.MATCHES, Stage.MAPPING)
THREADS_A_PROCESS = 4  # one process has not enough to do for more all of the time: units are registered one by one
BYTES_PER_MB = 1_000_000
_COUNTED = ("candidate_pairs", "rejected_pairs", "prior", "dropped_between_classes")  # of the matches' reports


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
    return settings.count or max(for_memory, count_for_workers(run.drive, workers, settings.overlap_units))


def mapped(
    run: Run, spans: Sequence[Span], known: PriorTrajectory
) -> tuple[Sequence[ImageFeatures], list[PairMatches], list[Mapper]]:
    """Features, matches and mapped components of a drive: of its sub-maps where it is cut, else in one piece.

    Raises
    ------
    InputError, ReconstructionError
        Where no image can be read, none has a keypoint, nothing matches or nothing can be mapped.
    """
    if spans:
        return join_submaps(run, run_submaps(run, spans), known)
    found = features(run)
    pairs = matches(run, found, known)
    return found, pairs, mapping(run, found, pairs, known)


class SubmapRun:
    """The stages of one sub-map: done, or found in the store, as soon as their results are asked for.

    Parameters
    ----------
    run
        The whole drive's, whose own car and sizes of extraction are known.
    """

    def __init__(self, run: Run, span: Span) -> None:
        self.span = span
        units = np.zeros(len(run.drive.manifest.frames), dtype=np.bool_)
        units[span.units] = True
        self.images = span.images_of(run.drive)
        self.run = Run(
            run.drive.restricted_to(units),
            run.config,
            run.store.with_prefix(submap_checkpoint(span.number, "")),
            run.progress,
            run.cancel,
            own_cars=run.own_cars,
            side_px=run.side_px,
            key=fingerprint(run.key or run.drive_key, SUBMAPS, asdict(span)),
        )
        self.run.share_models(run)

    @cached_property
    def is_finished(self) -> bool:
        """True where its last stage is in the store."""
        last = replace(self.run)
        last.share_models(self.run)
        last.key = last.next_key(Stage.FEATURES, last.feature_settings)
        last.key = last.next_key(Stage.MATCHES, match_settings(last))
        return last.store.has(Stage.MAPPING, last.next_key(Stage.MAPPING, mapping_settings(last)))

    @cached_property
    def known(self) -> PriorTrajectory:
        """The prior trajectory of its units."""
        return prior(self.run)

    @cached_property
    def features(self) -> StoredFeatures:
        """Features of its images."""
        return extract(self.run)[0]

    @cached_property
    def matches(self) -> StoredStage:
        """Matches among its images."""
        return match(self.run, self.features, self.known)[0]

    @cached_property
    def mapped(self) -> Arrays:
        """Its components as arrays, see `part_arrays`, and its keyframes."""
        features, matches = self.features, self.matches  # in their order

        def work() -> tuple[Arrays, dict[str, Any]]:
            begun = mapping_of(self.run, *keypoints_of(self.run, features, read_pairs(matches)), self.known)
            arrays: Arrays = {"keyframe": begun.mapper.keyframe.copy()}
            begun.mapper.keyframe |= self.span.is_shared  # else creeping units might have no pose in common
            try:
                begun.map_from_seeds()
            except ReconstructionError as problem:
                return arrays, {"components": [], "reason": str(problem)}
            parts = begun.put_together()
            for number, part in enumerate(parts):
                arrays |= {f"{number}.{name}": array for name, array in part_arrays(part).items()}
            # What they find, the joined scene finds as well.
            return arrays, {**described(parts), "findings": []}

        return self.run.stage(Stage.MAPPING, mapping_settings(self.run), work)[0]

    def do(self, stage: Stage) -> None:
        """Do a stage and those before it, as far as they are not in the store."""
        match stage:
            case Stage.FEATURES:
                _ = self.features
            case Stage.MATCHES:
                _ = self.matches
            case _:
                _ = self.mapped

    @property
    def report(self) -> dict[str, Any]:
        """Its entry in the drive's report, in the drive's units."""
        stages = in_units(self.run.report["stages"], self.span.units)
        return {"number": self.span.number, "spans": [[self.span.first, self.span.last]], "stages": stages}

    def parts(self) -> list[Part]:
        """Its components in the whole drive's units."""
        components = _entry(self, Stage.MAPPING)["components"]
        return [
            part_from_arrays(numbered(self.mapped, number), self.span.units, self.images)
            for number in range(len(components))
        ]

    def pairs(self) -> list[PairMatches]:
        """Its pairs in the whole drive's images."""
        return [
            replace(pair, image_a=int(self.images[pair.image_a]), image_b=int(self.images[pair.image_b]))
            for pair in read_pairs(self.matches)
        ]


def run_submaps(run: Run, spans: Sequence[Span]) -> list[SubmapRun]:
    """Do all sub-maps stage by stage, several at one time where the settings have processes for it.

    Raises
    ------
    ReconstructionError
        Where a process ended before its sub-map's stage was finished.
    """
    submaps = [SubmapRun(run, span) for span in spans]
    processes = min(_processes(run.config), len(submaps))
    for stage in STAGES:
        run.begin(stage)
        tally = _Tally(run.progress, len(submaps))
        done = {}
        if processes > 1:
            done = _do_in_processes(run, stage, submaps, processes, tally)
        for submap in submaps:
            submap.run.progress = tally.step(submap.span.number)
            submap.do(stage)
            _entry(submap, stage).update(done.get(submap.span.number, {}))
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
    return {name: _entry(submap, stage)[name] for name in ("seconds", "reused")}


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


def join_submaps(
    run: Run, submaps: Sequence[SubmapRun], known: PriorTrajectory
) -> tuple[JoinedFeatures, list[PairMatches], list[Mapper]]:
    """Features, matches and mapped components of the whole drive, from those of its sub-maps.

    Raises
    ------
    InputError, ReconstructionError
        Where no image can be read, none has a keypoint, nothing matches or no sub-map could begin.
    """
    run.report["submaps"] = [submap.report for submap in submaps]
    run.key = fingerprint(run.key or run.drive_key, [submap.run.key for submap in submaps])
    found = _joined_features(run, submaps)
    pairs = _joined_matches(run, submaps, found, known)
    keypoints, numbered_pairs = keypoints_of(run, found, pairs)
    parts = [part for submap in submaps for part in submap.parts()]
    keyframe = _keyframes(run, submaps)

    def work() -> tuple[Arrays, dict[str, Any]]:
        arrays, report = packed(join(mapping_of(run, keypoints, numbered_pairs, known), parts, keyframe), found)
        return arrays, report | _joined_counts([report, *(_entry(submap, Stage.MAPPING) for submap in submaps)])

    return found, pairs, mappers(run, keypoints, known, work)


def _joined_features(run: Run, submaps: Sequence[SubmapRun]) -> JoinedFeatures:
    """Features of all images, and what the stage says of them."""
    found = JoinedFeatures([(submap.features, submap.images) for submap in submaps])
    reports = [_entry(submap, Stage.FEATURES) for submap in submaps]
    left_out: dict[str, Incomplete] = {}
    for report in reports:
        left_out |= left_out_of(report)
    by_class: Counter[str] = Counter()
    for image in found:
        by_class.update(count_classes([image.classes]))
    made = int((found.mask_bytes > 0).sum())
    described = describe_features(run.drive, found.counts, by_class, made, left_out)
    run.report["stages"].append({"stage": Stage.FEATURES, **_times(reports), **described})
    require_features(run, found, left_out)
    return found


def _joined_matches(
    run: Run, submaps: Sequence[SubmapRun], found: JoinedFeatures, known: PriorTrajectory
) -> list[PairMatches]:
    """Matches of all sub-maps, and of pairs of images that no sub-map has both of."""
    spans = [submap.span for submap in submaps]
    unit = np.array([image.unit for image in run.drive.images], dtype=np.int64)

    def work(stage: StageWriter) -> dict[str, Any]:
        unlike = [_unlike_images(submap, found) for submap in submaps]
        inside = {
            (pair.image_a, pair.image_b): pair
            for submap, others in zip(reversed(submaps), reversed(unlike), strict=True)
            for pair in submap.pairs()
            if not (others[pair.image_a] or others[pair.image_b])
        }
        again = np.any(unlike, axis=0)

        def across(pairs: Ints) -> Ints:
            is_apart = ~share_a_submap(spans, unit[pairs[:, 0]], unit[pairs[:, 1]]) | again[pairs].any(axis=1)
            return np.array([pair for pair in pairs[is_apart].tolist() if tuple(pair) not in inside]).reshape(-1, 2)

        chosen = PairChoice(run.drive, found, known, run.config, run.cancel)
        further = chosen.further
        result = match_pairs(
            run.drive,
            found,
            across(chosen.first),
            run.components.matcher,
            run.config.matching,
            run.config.bundle_adjustment,
            threads=run.config.threads,
            prior=known,
            further=None
            if further is None
            else lambda pairs, rays_of: across(further([*inside.values(), *pairs], rays_of)),
            progress=run.step(Stage.MATCHES),
            cancel=run.cancel,
        )
        every = sorted([*inside.values(), *result.pairs], key=lambda pair: (pair.image_a, pair.image_b))
        write_pairs(stage, chosen.with_revisits(every))
        reports = [describe_matches(run.drive, result), *(_entry(submap, Stage.MATCHES) for submap in submaps)]
        return {**_joined_match_report(reports, every), "images_with_unlike_keypoints": int(again.sum())}

    settings = [match_settings(run), [(span.first, span.last) for span in spans]]
    stage, report = run.large_stage(Stage.MATCHES, settings, work)
    require_matches(run, report)
    return read_pairs(stage)


def _unlike_images(submap: SubmapRun, found: JoinedFeatures) -> Bools:
    """Images (i,) whose keypoints are others in this sub-map than in the drive: other machines extracted them.

    The same image gives the same keypoints, but for the last digits of networks on another processor: an order by
    score may then differ.
    """
    result = np.zeros(len(found), dtype=np.bool_)
    for row, image in enumerate(submap.images.tolist()):
        if found.is_from(image, submap.features):
            continue
        result[image] = not np.array_equal(found[image].xy_px, submap.features[row].xy_px)
    return result


def _joined_match_report(reports: Sequence[dict[str, Any]], pairs: Sequence[PairMatches]) -> dict[str, Any]:
    """Report of pairs across sub-maps and of those within each; pairs that two of them share were tried in both."""
    by_matches = sorted(reports, key=lambda report: -int(report["simultaneous"]["matches"]))
    contradictions = [report["contradiction"] for report in by_matches if report["contradiction"] is not None]
    summed = _summed([{name: report[name] for name in _COUNTED} for report in reports])
    return {
        **summed,
        "verified_pairs": sum(bool(pair.inliers.any()) for pair in pairs),
        "matches": sum(len(pair.matches) for pair in pairs),
        "verified_matches": sum(int(pair.inliers.sum()) for pair in pairs),
        "simultaneous": by_matches[0]["simultaneous"],
        "contradiction": next(iter(contradictions), None),
    }


def _summed(reports: Sequence[Any]) -> Any:
    """Reports of one form with their counts added up."""
    if isinstance(reports[0], dict):
        return {name: _summed([report[name] for report in reports]) for name in reports[0]}
    return sum(reports)


def _joined_counts(reports: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Counts of registrations in sub-maps and as they were joined; units that two sub-maps share count twice."""
    result: dict[str, Any] = {"local_adjustments": sum(report.get("local_adjustments", 0) for report in reports)}
    for name in ("registered_by", "cameras_voted_out", "cameras_without_a_vote"):
        counts: Counter[str] = Counter()
        for report in reports:
            counts.update(report.get(name, {}))
        result[name] = dict(counts)
    return result


def _entry(submap: SubmapRun, stage: Stage) -> dict[str, Any]:
    """Report of one of a sub-map's stages."""
    return next(entry for entry in submap.run.report["stages"] if entry["stage"] == stage)


def _times(reports: Sequence[dict[str, Any]]) -> dict[str, Any]:
    return {
        "seconds": round(sum(report["seconds"] for report in reports), 3),
        "reused": all(report["reused"] for report in reports),
    }


def _keyframes(run: Run, submaps: Sequence[SubmapRun]) -> Bools:
    """Units (u,) that any sub-map used."""
    result = np.zeros(len(run.drive.manifest.frames), dtype=np.bool_)
    for submap in submaps:
        result[submap.span.units] |= submap.mapped["keyframe"]
    return result
