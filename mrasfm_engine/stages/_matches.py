"""Verified matches of image pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mrasfm_engine.errors import ReconstructionError
from mrasfm_engine.io.stage_store import Arrays, StageWriter, StoredStage
from mrasfm_engine.matching.contradicted_rig import require_images_as_listed
from mrasfm_engine.matching.exchanged_by_motion import exchanged_by_motion
from mrasfm_engine.matching.pair_choice import PairChoice
from mrasfm_engine.matching.pair_matching import SearchResult, match_pairs
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory
from mrasfm_engine.matching.simultaneous import contradiction
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures, PairMatches
from mrasfm_engine.stages._run import Run
from schemas.artifacts import Stage
from schemas.findings import as_json

PAIR_ARRAYS = ("ends", "matches", "inliers", "is_revisit", "essential")
FINDINGS = ("contradiction", "exchanged_cameras", "unexplained")  # parts of the report that are one, or none
WINDOW_PAIRS = 4096  # written at once: some megabytes, with nearly nothing for headers


def matches(run: Run, found: Sequence[ImageFeatures], known: PriorTrajectory) -> list[PairMatches]:
    """Candidate pairs by the prior (or by window and similarity), matched and verified.

    Raises
    ------
    ReconstructionError
        Where nothing matches.
    """
    stage, report = match(run, found, known)
    require_matches(run, report)
    return read_pairs(stage)


def match(run: Run, found: Sequence[ImageFeatures], known: PriorTrajectory) -> tuple[StoredStage, dict[str, Any]]:
    """The stage of the matches and its report, whatever was found."""

    def work(stage: StageWriter) -> dict[str, Any]:
        chosen = PairChoice(run.drive, found, known, run.config, run.cancel)
        result = match_pairs(
            run.drive,
            found,
            chosen.first,
            run.components.matcher,
            run.config.matching,
            run.config.bundle_adjustment,
            threads=run.config.threads,
            prior=known,
            further=chosen.further,
            progress=run.step(Stage.MATCHES),
            cancel=run.cancel,
        )
        exchanged = exchanged_by_motion(run.drive, found, result.pairs, cancel=run.cancel)
        unexplained = require_images_as_listed(
            run.drive,
            found,
            result.pairs,
            run.components.matcher,
            run.config.matching,
            run.config.bundle_adjustment,
            max_depth_m=run.config.pairs.max_depth_m,
            rig_from_cam=result.rig.rig_from_cam,
            cancel=run.cancel,
        )
        write_pairs(stage, chosen.with_revisits(result.pairs))
        return {
            **describe_matches(run.drive, result),
            "exchanged_cameras": None if exchanged is None else as_json(exchanged),
            "unexplained": None if unexplained is None else as_json(unexplained),
        }

    return run.large_stage(Stage.MATCHES, match_settings(run), work)


def match_settings(run: Run) -> object:
    """Dependencies of the matches besides the features."""
    settings = [section.model_dump() for section in (run.config.pairs, run.config.matching, run.config.gnss)]
    priors = {"refine_calibration", "sigma_rotation_deg", "sigma_translation_m"}
    settings.append(run.config.bundle_adjustment.model_dump(include=priors))
    settings.append({"use_gnss": run.config.use_gnss, "models": run.components.fingerprint_of("matcher")})
    return settings


def describe_matches(drive: Drive, result: SearchResult) -> dict[str, Any]:
    """The report of the stage."""
    contradicted = contradiction([camera.name for camera in drive.cameras], drive.rig_from_cam, result.rig)
    return {
        "candidate_pairs": result.candidates,
        "verified_pairs": len(result.pairs) - result.against_calibration,
        "rejected_pairs": {
            "few matches": result.few_matches,
            "few inliers": result.few_inliers,
            "against the calibration": result.against_calibration,
        },
        "prior": {
            "pairs_predicted": result.prior.predicted,
            "pairs_against_the_prior": result.prior.against,
            "left_out": result.prior.left_out,
        },
        "dropped_between_classes": result.across_classes,
        "matches": sum(len(p.matches) for p in result.pairs),
        "verified_matches": sum(int(p.inliers.sum()) for p in result.pairs),
        "simultaneous": {
            "matches": result.rig.matches,
            "share_that_fits_calibration_as_given": round(result.rig.fitted_as_given, 4),
            "share_that_fits_calibration_as_corrected": round(result.rig.fitted, 4),
        },
        "contradiction": None if contradicted is None else as_json(contradicted),
    }


def require_matches(run: Run, report: Mapping[str, Any]) -> None:
    """Say what contradicts the calibration or the cameras' names, and refuse a drive of which nothing matches.

    Raises
    ------
    ReconstructionError
        Where nothing matches.
    """
    run.report["findings"] += [finding for name in FINDINGS if (finding := report.get(name)) is not None]
    if not report["verified_pairs"]:
        raise ReconstructionError(
            f"nothing matches: none of {report['candidate_pairs']} image pairs has a verified match",
            remedy="Check that consecutive frames show the same scene, and that images are sharp and not mixed up.",
            code="nothing-matches",
        )


def write_pairs(stage: StageWriter, pairs: Sequence[PairMatches]) -> None:
    """Write matches window by window, so that they are not in memory twice."""
    first = range(0, len(pairs), WINDOW_PAIRS)
    stage.add("windows", np.array(len(first), dtype=np.int64))
    for window, begin in enumerate(first):
        for name, array in pack_pairs(pairs[begin : begin + WINDOW_PAIRS]).items():
            stage.add(f"{name}.{window}", array)


def read_pairs(stage: StoredStage) -> list[PairMatches]:
    """Pairs that `write_pairs` wrote."""
    return [
        pair
        for window in range(int(stage.read("windows")))
        for pair in unpack_pairs({name: stage.read(f"{name}.{window}") for name in PAIR_ARRAYS})
    ]


def pack_pairs(pairs: Sequence[PairMatches]) -> Arrays:
    """Matches of all pairs in a few arrays."""
    none = np.full((3, 3), np.nan)
    return {
        "ends": np.array([(p.image_a, p.image_b, len(p.matches)) for p in pairs], dtype=np.int64).reshape(-1, 3),
        "matches": np.concatenate([p.matches for p in pairs] or [np.zeros((0, 2), np.int32)]),
        "inliers": np.concatenate([p.inliers for p in pairs] or [np.zeros(0, np.bool_)]),
        "is_revisit": np.array([p.is_revisit for p in pairs], dtype=np.bool_),
        "essential": np.array([none if p.essential is None else p.essential for p in pairs]).reshape(-1, 3, 3),
    }


def unpack_pairs(arrays: Arrays) -> list[PairMatches]:
    """Restore the matches from `pack_pairs`."""
    stops = np.cumsum(arrays["ends"][:, 2])
    return [
        PairMatches(
            image_a=int(a),
            image_b=int(b),
            matches=arrays["matches"][hi - n : hi],
            inliers=arrays["inliers"][hi - n : hi],
            is_revisit=bool(is_revisit),
            essential=None if np.isnan(essential).any() else essential,
        )
        for (a, b, n), hi, is_revisit, essential in zip(
            arrays["ends"], stops, arrays["is_revisit"], arrays["essential"], strict=True
        )
    ]
