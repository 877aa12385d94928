"""Matching and verification of chosen image pairs."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from threadpoolctl import threadpool_limits

from mrasfm_engine.config import BundleAdjustmentConfig, MatchConfig
from mrasfm_engine.errors import CancelledError
from mrasfm_engine.geometry.camera_model import pack_cameras, unproject_pixels
from mrasfm_engine.matching.simultaneous import RigEstimate, SimultaneousMatches, are_simultaneous, rig_of_drive
from mrasfm_engine.matching.verification import essential_inliers
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures, PairMatches
from mrasfm_engine.scene.semantics import may_match
from mrasfm_engine.types import Cancel, CountProgress, Floats, Ints, Ints32


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
    across_classes: int  # matches that were dropped because their ends are of different semantic classes
    rig: RigEstimate  # as simultaneous images show it


def match_pairs(
    drive: Drive,
    features: Sequence[ImageFeatures],
    pairs: Ints,
    matcher: Matcher,
    config: MatchConfig,
    calibration: BundleAdjustmentConfig,
    *,
    threads: int,
    progress: CountProgress | None = None,
    cancel: Cancel | None = None,
) -> SearchResult:
    """Match and verify image pairs (n, 2).

    An essential matrix must explain the matches of a pair. Between simultaneous images of one unit the calibration
    gives the geometry: all of their matches together correct it where they contradict it (see `simultaneous`), and
    matches far from the epipolar lines that follow, or behind a camera, are out as well. Matches between different
    semantic classes are dropped before either.
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

    def rays_of(pair: PairMatches) -> tuple[Floats, Floats]:
        a, b = pair.matches[pair.inliers].T
        return rays[pair.image_a][a], rays[pair.image_b][b]

    rig = rig_of_drive(drive, found, rays_of, config, calibration)
    checked = [
        _in_rig(
            drive,
            pair,
            rays_of(pair),
            rig,
            max_error=config.max_error_px / focal[[drive.images[i].camera for i in (pair.image_a, pair.image_b)]].min(),
        )
        if are_simultaneous(drive, pair.image_a, pair.image_b)
        else pair
        for pair in found
    ]
    kept = [pair for pair in checked if pair.inliers.sum() >= config.min_matches]
    return SearchResult(
        pairs=kept,
        few_matches=lost["few matches"],
        few_inliers=lost["few inliers"] + len(found) - len(kept),
        across_classes=int(across_classes.sum()),
        rig=rig,
    )


def _in_rig(
    drive: Drive, pair: PairMatches, rays: tuple[Floats, Floats], rig: RigEstimate, *, max_error: float
) -> PairMatches:
    """A simultaneous pair with those inliers that agree with the rig."""
    a, b = (drive.images[image].camera for image in (pair.image_a, pair.image_b))
    inliers = pair.inliers.copy()
    found = SimultaneousMatches(camera_a=a, camera_b=b, rays_a=rays[0], rays_b=rays[1])
    inliers[pair.inliers] = rig.fits(found, max_error=max_error)
    return replace(pair, inliers=inliers)
