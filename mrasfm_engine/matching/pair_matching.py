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
from mrasfm_engine.matching.verification import fit_essential
from mrasfm_engine.parallel import in_order
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures, PairMatches
from mrasfm_engine.scene.semantics import may_match
from mrasfm_engine.types import Cancel, CountProgress, Floats, Ints

# Further pairs (n, 2) from those that matched so far, and the viewing rays of a pair's inliers.
Further = Callable[[Sequence[PairMatches], Callable[[PairMatches], tuple[Floats, Floats]]], Ints]
NO_PRIOR = PriorTrajectory(source="none", world_from_rig=None)
FEW_MATCHES, FEW_INLIERS = "few matches", "few inliers"


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
    search = _Search(drive, features, matcher, config, threads, cancel)
    # Every thread multiplies matrices on its own core.
    with threadpool_limits(1, "blas"):
        search.run(pairs, further, progress)
    rig = rig_of_drive(drive, search.found, search.inlier_rays_of, config, calibration)
    by_prior = verified_by_prior(
        drive,
        search.found,
        search.rays_of,
        prior,
        rig,
        focal_px=search.focal_px,
        config=config,
        threads=threads,
        cancel=cancel,
    )
    kept = []
    for pair in by_prior.pairs:
        if are_simultaneous(drive, pair.image_a, pair.image_b):
            max_error = search.max_error_rad(pair.image_a, pair.image_b)
            kept.append(verified_in_rig(drive, pair, search.rays_of(pair), rig, max_error=max_error, config=config))
        elif pair.inliers.sum() >= config.min_matches:
            kept.append(pair)
    return SearchResult(
        pairs=sorted(kept, key=lambda pair: (pair.image_a, pair.image_b)),
        candidates=search.candidates,
        few_matches=search.few_matches,
        few_inliers=search.few_inliers + len(search.found) - len(kept),
        across_classes=search.across_classes,
        rig=rig,
        prior=by_prior,
    )


class _Search:
    """Matches pairs, and keeps those whose matches an essential matrix explains."""

    def __init__(
        self,
        drive: Drive,
        features: Sequence[ImageFeatures],
        matcher: Matcher,
        config: MatchConfig,
        threads: int,
        cancel: Cancel | None,
    ) -> None:
        self._drive, self._features, self._matcher, self._config = drive, features, matcher, config
        self._threads, self._cancel = threads, cancel
        self.focal_px = pack_cameras(drive.cameras)[1][:, :2].mean(1)
        self._images: PreparedImages  # those of the pairs at hand
        self.found: list[PairMatches] = []
        self.candidates = self.few_matches = self.few_inliers = self.across_classes = 0

    def run(self, pairs: Ints, further: Further | None, progress: CountProgress | None) -> None:
        """Match pairs (n, 2), and those that `further` adds once these are matched."""
        done, batch = 0, in_order_of_drive(pairs)
        while True:
            self._images = PreparedImages(self._drive, self._features, self._matcher, batch, threads=self._threads)
            self.candidates += len(batch)
            with closing(in_order(self._threads, self._matched, batch)) as results:
                for result in results:
                    done += 1
                    self._count(*result)
                    if progress is not None and done < self.candidates:  # else there may be further ones
                        progress(done, self.candidates)
            batch, further = batch[:0] if further is None else further(self.found, self.inlier_rays_of), None
            if progress is not None and self.candidates + len(batch):
                progress(done, self.candidates + len(batch))
            if not len(batch):
                return
            batch = in_order_of_drive(batch)

    def rays_of(self, pair: PairMatches) -> tuple[Floats, Floats]:
        """Viewing rays (n, 3) of a pair's matches in each of its images."""
        a, b = pair.matches.T
        return self._images.rays(pair.image_a)[a], self._images.rays(pair.image_b)[b]

    def inlier_rays_of(self, pair: PairMatches) -> tuple[Floats, Floats]:
        """The same of its inliers alone."""
        a, b = self.rays_of(pair)
        return a[pair.inliers], b[pair.inliers]

    def max_error_rad(self, a: int, b: int) -> float:
        """See `simultaneous.max_error_rad`, for two images."""
        return max_error_rad(self._drive, a, b, self.focal_px, self._config)

    def _matched(self, pair: Ints) -> tuple[PairMatches | str, int]:
        """Matches of a pair or why there are none, and how many were dropped as they join different classes."""
        if self._cancel is not None and self._cancel():
            raise CancelledError
        a, b = int(pair[0]), int(pair[1])
        of_a, of_b = self._images.prepared(a), self._images.prepared(b)
        matches = self._matcher.match(of_a.for_matcher, of_b.for_matcher)
        across = 0
        if self._config.same_class:
            fits = may_match(of_a.classes[matches[:, 0]], of_b.classes[matches[:, 1]])
            across = len(fits) - int(fits.sum())
            matches = matches[fits]
        if len(matches) < self._config.min_matches:
            return FEW_MATCHES, across
        ra, rb = self._images.rays(a)[matches[:, 0]], self._images.rays(b)[matches[:, 1]]
        fit = fit_essential(ra, rb, max_error=self.max_error_rad(a, b))
        if fit.inliers.sum() < self._config.min_matches:
            return FEW_INLIERS, across
        # A copy: a matcher may have given a part of a large array.
        found = PairMatches(image_a=a, image_b=b, matches=matches.copy(), inliers=fit.inliers, essential=fit.essential)
        return found, across

    def _count(self, result: PairMatches | str, across: int) -> None:
        self.across_classes += across
        if isinstance(result, PairMatches):
            self.found.append(result)
        elif result == FEW_MATCHES:
            self.few_matches += 1
        else:
            self.few_inliers += 1
