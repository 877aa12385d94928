"""Matching and verification of chosen image pairs."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from threadpoolctl import threadpool_limits

from mrasfm_engine.config import MatchConfig
from mrasfm_engine.errors import CancelledError
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_cameras, unproject_pixels
from mrasfm_engine.matching.verification import epipolar_errors, essential_inliers, in_front_of_both
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures, PairMatches
from mrasfm_engine.scene.semantics import may_match
from mrasfm_engine.types import Cancel, CountProgress, Ints, Ints32

SIMULTANEOUS_US = 2_000  # cameras less apart than this are one rig: a fast car goes 6 cm


class Matcher(Protocol):
    """Matches two images' features."""

    def prepare(self, features: ImageFeatures, *, width: int, height: int) -> Any:
        """Prepare one image of width x height pixels for the matcher, once."""
        ...

    def match(self, a: Any, b: Any) -> Ints32:
        """Pairs (m, 2) of keypoint indices of two prepared images."""
        ...


@dataclass(frozen=True, kw_only=True)
class SearchResult:
    """Verified pairs and what became of the others."""

    pairs: list[PairMatches]
    few_matches: int  # pairs with too few matches
    few_inliers: int  # pairs whose matches fit no geometry
    across_classes: int = 0  # matches that were dropped because their ends are of different semantic classes


def match_pairs(
    drive: Drive,
    features: Sequence[ImageFeatures],
    pairs: Ints,
    matcher: Matcher,
    config: MatchConfig,
    *,
    threads: int,
    progress: CountProgress | None = None,
    cancel: Cancel | None = None,
) -> SearchResult:
    """Match and verify image pairs (n, 2).

    Between units an essential matrix must explain the matches. Between cameras of one unit the calibration gives the
    geometry, up to its error: matches far from its epipolar lines or behind a camera are out as well. Matches between
    different semantic classes are dropped before either.
    """
    cameras = [drive.cameras[i.camera] for i in drive.images]
    prepared = [matcher.prepare(f, width=c.width, height=c.height) for f, c in zip(features, cameras, strict=True)]
    kinds, params = pack_cameras(drive.cameras)
    rays = [
        unproject_pixels(int(kinds[i.camera]), params[i.camera], f.xy_px)
        for i, f in zip(drive.images, features, strict=True)
    ]
    focal = params[:, :2].mean(1)
    across_classes = np.zeros(len(pairs), dtype=np.int64)

    def one(index: int, pair: Ints) -> PairMatches | str:
        if cancel is not None and cancel():
            raise CancelledError
        a, b = int(pair[0]), int(pair[1])
        matches = matcher.match(prepared[a], prepared[b])
        if config.same_class:
            fits = may_match(features[a].classes[matches[:, 0]], features[b].classes[matches[:, 1]])
            across_classes[index] = len(fits) - int(fits.sum())
            matches = matches[fits]
        if len(matches) < config.min_matches:
            return "few matches"
        ra, rb = rays[a][matches[:, 0]], rays[b][matches[:, 1]]
        ca, cb = drive.images[a].camera, drive.images[b].camera
        inliers = essential_inliers(ra, rb, max_error=config.max_error_px / min(focal[ca], focal[cb]))
        apart_us = abs(drive.images[a].timestamp_us - drive.images[b].timestamp_us)
        # The vehicle's motion between two instants is part of the geometry, and not known yet.
        if drive.images[a].unit == drive.images[b].unit and apart_us <= SIMULTANEOUS_US:
            b_from_a = se3.inverse(drive.rig_from_cam[cb]) @ drive.rig_from_cam[ca]
            gate = config.calibration_error_px / min(focal[ca], focal[cb])
            inliers &= (epipolar_errors(b_from_a, ra, rb) < gate) & in_front_of_both(b_from_a, ra, rb)
        if inliers.sum() < config.min_matches:
            return "few inliers"
        return PairMatches(image_a=a, image_b=b, matches=matches, inliers=inliers)

    found: list[PairMatches] = []
    lost = {"few matches": 0, "few inliers": 0}
    # Every thread multiplies matrices on its own core.
    with threadpool_limits(1, "blas"), ThreadPoolExecutor(threads) as pool:
        futures = [pool.submit(one, index, pair) for index, pair in enumerate(pairs)]
        try:
            for done, future in enumerate(futures, 1):
                result = future.result()
                if isinstance(result, str):
                    lost[result] += 1
                else:
                    found.append(result)
                if progress is not None:
                    progress(done, len(futures))
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return SearchResult(
        pairs=found,
        few_matches=lost["few matches"],
        few_inliers=lost["few inliers"],
        across_classes=int(across_classes.sum()),
    )
