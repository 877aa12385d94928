"""The sub-maps of a long drive joined: their features and matches, and those across them, and one map of all."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from mrasfm_engine.features.stored_features import JoinedFeatures
from mrasfm_engine.io.stage_store import Arrays, StageWriter, fingerprint
from mrasfm_engine.mapping.submaps import join
from mrasfm_engine.matching.pair_choice import PairChoice
from mrasfm_engine.matching.pair_matching import match_pairs
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory
from mrasfm_engine.scene.drive import LeftOut
from mrasfm_engine.scene.scene import PairMatches
from mrasfm_engine.scene.semantics import count_classes
from mrasfm_engine.scene.submaps import share_a_submap
from mrasfm_engine.stages._features import describe_features, left_out_of, require_features
from mrasfm_engine.stages._mapping import MappedDrive, map_once, mapping_of, packed
from mrasfm_engine.stages._matches import (
    FINDINGS,
    describe_matches,
    match_settings,
    read_pairs,
    require_matches,
    write_pairs,
)
from mrasfm_engine.stages._run import Run
from mrasfm_engine.stages._submap_run import SubmapRun
from mrasfm_engine.triangulation.tracks import Keypoints
from mrasfm_engine.types import Bools, Ints
from schemas.artifacts import Stage

_COUNTED = ("candidate_pairs", "rejected_pairs", "prior", "dropped_between_classes")  # of the matches' reports


def join_submaps(run: Run, submaps: Sequence[SubmapRun], known: PriorTrajectory) -> MappedDrive:
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

    def work(keypoints: Keypoints, numbered_pairs: list[PairMatches]) -> tuple[Arrays, dict[str, Any]]:
        parts = [part for submap in submaps for part in submap.parts()]
        joined = join(mapping_of(run, keypoints, numbered_pairs, known), parts, _keyframes(run, submaps))
        arrays, report = packed(joined, found)
        return arrays, report | _joined_counts([report, *(submap.entry(Stage.MAPPING) for submap in submaps)])

    return map_once(run, found, pairs, known, work)


def _joined_features(run: Run, submaps: Sequence[SubmapRun]) -> JoinedFeatures:
    """Features of all images, and what the stage says of them."""
    found = JoinedFeatures([(submap.features, submap.images) for submap in submaps])
    reports = [submap.entry(Stage.FEATURES) for submap in submaps]
    left_out: dict[str, LeftOut] = {}
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
        reports = [describe_matches(run.drive, result), *(submap.entry(Stage.MATCHES) for submap in submaps)]
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
    findings = {
        name: next((found for report in by_matches if (found := report.get(name)) is not None), None)
        for name in FINDINGS
    }
    summed = _summed([{name: report[name] for name in _COUNTED} for report in reports])
    return {
        **summed,
        "verified_pairs": sum(bool(pair.inliers.any()) for pair in pairs),
        "matches": sum(len(pair.matches) for pair in pairs),
        "verified_matches": sum(int(pair.inliers.sum()) for pair in pairs),
        "simultaneous": by_matches[0]["simultaneous"],
        **findings,
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
