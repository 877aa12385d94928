"""Matching and verification of chosen image pairs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from mrasfm_engine.config import BundleAdjustmentConfig, MatchConfig
from mrasfm_engine.errors import CancelledError
from mrasfm_engine.geometry.camera_model import pack_cameras
from mrasfm_engine.matching.prepared_images import Matcher, PreparedImages
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory
from mrasfm_engine.matching.prior_verification import PriorVerdict, verified_by_prior
from mrasfm_engine.matching.simultaneous import (
    RigEstimate,
    are_simultaneous,
    max_error_rad,
    rig_of_drive,
    verified_in_rig,
)
from mrasfm_engine.matching.verification import essential_inliers
from mrasfm_engine.parallel import in_order
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures, PairMatches
from mrasfm_engine.scene.semantics import may_match
from mrasfm_engine.types import Cancel, CountProgress, Floats, Ints

# Further pairs (n, 2) from those that matched so far, and the viewing rays of a pair's inliers.
Further = Callable[[Sequence[PairMatches], Callable[[PairMatches], tuple[Floats, Floats]]], Ints]
NO_PRIOR = PriorTrajectory(source="none", world_from_rig=None)


@dataclass(frozen=True, kw_only=True)
class SearchResult:
    """Verified pairs and what became of the others."""

    pairs: list[PairMatches]  # those of simultaneous images that contradict the calibration have no inliers
    candidates: int  # pairs that were tried
    few_matches: int  # pairs with too few matches
    few_inliers: int  # pairs whose matches fit no geometry
    across_classes: int  # matches that were dropped because their ends are of different semantic classes
    rig: RigEstimate  # as simultaneous images show it
    prior: PriorVerdict

    @property
    def against_calibration(self) -> int:
        """Pairs of simultaneous images that keep no inlier, as their matches contradict the calibration."""
        return sum(not pair.inliers.any() for pair in self.pairs)


def in_order_of_drive(pairs: Ints) -> Ints:
    """Pairs (n, 2) by their first images and then by their second ones: neighbours have images in common."""
    result: Ints = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    return result


def match_pairs(
    drive: Drive,
    features: Sequence[ImageFeatures],
    pairs: Ints,
    matcher: Matcher,
    config: MatchConfig,
    calibration: BundleAdjustmentConfig,
    *,
    threads: int,
    prior: PriorTrajectory = NO_PRIOR,
    further: Further | None = None,
    progress: CountProgress | None = None,
    cancel: Cancel | None = None,
) -> SearchResult:
    """Match and verify image pairs (n, 2), and those that `further` adds by what these show.

    An essential matrix must explain the matches of a pair. Between simultaneous images of one unit the calibration
    gives the geometry: all of their matches together correct it where they contradict it (see `simultaneous`), and
    matches far from the epipolar lines that follow, or behind a camera, are out as well. Between units the prior
    trajectory does the same where images do not contradict it (see `prior_verification`). Matches between different
    semantic classes are dropped before all that.
    """
    focal = pack_cameras(drive.cameras)[1][:, :2].mean(1)

    def one(pair: Ints) -> tuple[PairMatches | str, int]:
        if cancel is not None and cancel():
            raise CancelledError
        a, b = int(pair[0]), int(pair[1])
        of_a, of_b = images.prepared(a), images.prepared(b)
        matches = matcher.match(of_a.for_matcher, of_b.for_matcher)
        across = 0
        if config.same_class:
            fits = may_match(of_a.classes[matches[:, 0]], of_b.classes[matches[:, 1]])
            across = len(fits) - int(fits.sum())
            matches = matches[fits]
        if len(matches) < config.min_matches:
            return "few matches", across
        ra, rb = images.rays(a)[matches[:, 0]], images.rays(b)[matches[:, 1]]
        inliers = essential_inliers(ra, rb, max_error=max_error_rad(drive, a, b, focal, config))
        if inliers.sum() < config.min_matches:
            return "few inliers", across
        # A copy: a matcher may have given a part of a large array.
        return PairMatches(image_a=a, image_b=b, matches=matches.copy(), inliers=inliers), across

    def rays_of(pair: PairMatches) -> tuple[Floats, Floats]:
        a, b = pair.matches.T
        return images.rays(pair.image_a)[a], images.rays(pair.image_b)[b]

    def inlier_rays_of(pair: PairMatches) -> tuple[Floats, Floats]:
        a, b = rays_of(pair)
        return a[pair.inliers], b[pair.inliers]

    found: list[PairMatches] = []
    lost = {"few matches": 0, "few inliers": 0}
    across_classes, done, total = 0, 0, len(pairs)
    batch = in_order_of_drive(pairs)
    # Every thread multiplies matrices on its own core.
    with threadpool_limits(1, "blas"):
        while True:
            images, following = PreparedImages(drive, features, matcher, batch, threads=threads), batch[:0]
            if not len(batch) and further is not None:
                following, further = in_order_of_drive(further(found, inlier_rays_of)), None
                total = len(following)
            with closing(in_order(threads, one, batch)) as results:
                for number, (result, across) in enumerate(results, 1):
                    done, across_classes = done + 1, across_classes + across
                    if isinstance(result, str):
                        lost[result] += 1
                    else:
                        found.append(result)
                    if number == len(batch) and further is not None:
                        following, further = in_order_of_drive(further(found, inlier_rays_of)), None
                        total += len(following)
                    if progress is not None:
                        progress(done, total)
            if not len(following):
                break
            batch = following

    rig = rig_of_drive(drive, found, inlier_rays_of, config, calibration)
    by_prior = verified_by_prior(
        drive, found, rays_of, prior, rig, focal_px=focal, config=config, threads=threads, cancel=cancel
    )
    kept = []
    for pair in by_prior.pairs:
        if are_simultaneous(drive, pair.image_a, pair.image_b):
            max_error = max_error_rad(drive, pair.image_a, pair.image_b, focal, config)
            kept.append(verified_in_rig(drive, pair, rays_of(pair), rig, max_error=max_error, config=config))
        elif pair.inliers.sum() >= config.min_matches:
            kept.append(pair)
    return SearchResult(
        pairs=sorted(kept, key=lambda pair: (pair.image_a, pair.image_b)),
        candidates=total,
        few_matches=lost["few matches"],
        few_inliers=lost["few inliers"] + len(found) - len(kept),
        across_classes=across_classes,
        rig=rig,
        prior=by_prior,
    )
