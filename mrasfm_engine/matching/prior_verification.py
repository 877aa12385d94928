"""Verification of matches between units by the prior trajectory.

The prior predicts the relative pose of two images with a covariance: of the trajectory, of the calibration. Matches
correct that pose as far as the covariance lets them, and must then lie near its epipolar lines and in front of both
cameras, within what is still uncertain. So an inexact prior takes nothing from a pair; a prior of another place or time
contradicts the images, and is left out, for one pair or for the drive.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammainc, gammaincinv

from mrasfm_engine.config import MatchConfig
from mrasfm_engine.errors import CancelledError
from mrasfm_engine.geometry import se3
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory
from mrasfm_engine.matching.relative_pose import GATE_SIGMAS, RelativePose, UncertainRig
from mrasfm_engine.matching.simultaneous import max_error_rad
from mrasfm_engine.matching.verification import signed_parallax
from mrasfm_engine.parallel import mapped
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import PairMatches
from mrasfm_engine.types import Bools, Cancel, Floats

# Matches show five directions of a relative pose, all but the distance. As improbable as an error of `GATE_SIGMAS`.
# The quantile of chi-squared with 5 degrees of freedom, without scipy.stats, which takes half a second to import.
MAX_CORRECTION = float(2.0 * gammaincinv(5 / 2, float(gammainc(1 / 2, GATE_SIGMAS**2 / 2))))
# Rotations known worse than this (20 degrees) predict nothing that derivatives could be taken of.
MAX_SIGMA_RAD = np.radians(20.0)
MAX_WRONG = 0.1  # share of the matches that fit one essential matrix and are wrong all the same
MOST = 0.5  # share of the matches, or of the pairs: a prior that most contradict is wrong


@dataclass(frozen=True, kw_only=True)
class PriorVerdict:
    """Pairs as the prior leaves them.

    Attributes
    ----------
    pairs
        All pairs given, those that the prior predicts with the inliers that agree with it.
    predicted
        How many it predicts.
    against
        How many of these contradict it, and are as before.
    left_out
        Whether these are most, so that the prior changes no pair.
    """

    pairs: list[PairMatches]
    predicted: int = 0
    against: int = 0
    left_out: bool = False


def verified_by_prior(
    drive: Drive,
    pairs: Sequence[PairMatches],
    rays_of: Callable[[PairMatches], tuple[Floats, Floats]],
    prior: PriorTrajectory,
    rig: UncertainRig,
    *,
    focal_px: Floats,
    config: MatchConfig,
    threads: int,
    cancel: Cancel | None = None,
) -> PriorVerdict:
    """Judge the inliers of pairs between units by the prior trajectory; `rays_of` gives those of all their matches.

    Raises
    ------
    CancelledError
        Where `cancel` answers True.
    """
    predictions = _Predictions.from_prior(drive, prior, rig)
    if predictions is None:
        return PriorVerdict(pairs=list(pairs))

    def judged(pair: PairMatches) -> Bools | bool | None:
        """Inliers that agree with the prior, False where they contradict it, None where it predicts nothing."""
        if cancel is not None and cancel():
            raise CancelledError
        predicted = predictions.of_pair(pair)
        if predicted is None:
            return None
        max_error = max_error_rad(drive, pair.image_a, pair.image_b, focal_px, config)
        rays_a, rays_b = (rays[pair.inliers] for rays in rays_of(pair))
        agree = agreeing(predicted, rays_a, rays_b, max_error=max_error)
        return False if agree is None else agree

    verdicts = list(mapped(threads, judged, pairs))
    predicted = sum(verdict is not None for verdict in verdicts)
    against = sum(verdict is False for verdict in verdicts)
    left_out = against > MOST * predicted
    result = []
    for pair, verdict in zip(pairs, verdicts, strict=True):
        inliers = pair.inliers.copy()
        if isinstance(verdict, np.ndarray) and not left_out:
            inliers[pair.inliers] = verdict
        result.append(replace(pair, inliers=inliers))
    return PriorVerdict(pairs=result, predicted=predicted, against=against, left_out=left_out)


def agreeing(predicted: RelativePose, rays_a: Floats, rays_b: Floats, *, max_error: float) -> Bools | None:
    """Mask (n,) of the matches that agree with a predicted pose; None where the matches contradict it.

    They contradict it where they demand a correction that it makes too unlikely, or where more than can be wrong do not
    fit even the corrected pose, or most of those that tell by their parallax: distant points fit any position.
    """
    refined, correction = predicted.refined(rays_a, rays_b, sigma_rad=max_error / GATE_SIGMAS)
    if correction > MAX_CORRECTION:
        return None
    fits = refined.fits(rays_a, rays_b, max_error=max_error)
    slack = refined.parallax_slack(refined.linearise(rays_a, rays_b)[2], max_error=max_error)
    tell = ~fits | (np.abs(signed_parallax(refined.b_from_a, rays_a, rays_b)) > slack)
    denied = fits.mean() < 1.0 - MAX_WRONG or (tell.any() and fits[tell].mean() < MOST)
    return None if denied else fits


@dataclass(frozen=True, kw_only=True)
class _Predictions:
    """Poses of the images by the prior; NaN where unknown."""

    drive: Drive
    rig: UncertainRig
    world_from_rig: Floats  # (images, 4, 4) at the images' own times
    sigma: Floats  # (images, 6) as in `PriorTrajectory`

    @staticmethod
    def from_prior(drive: Drive, prior: PriorTrajectory, rig: UncertainRig) -> _Predictions | None:
        if prior.world_from_rig is None or prior.sigma is None:
            return None
        known = np.isfinite(prior.world_from_rig[:, 0, 3])
        unit = np.array([image.unit for image in drive.images], dtype=np.int64)
        times = np.array([image.timestamp_us for image in drive.images], dtype=np.int64)
        poses = se3.interpolate(drive.timestamps_us[known], prior.world_from_rig[known], times)
        poses[~known[unit]] = np.nan
        return _Predictions(drive=drive, rig=rig, world_from_rig=poses, sigma=prior.sigma[unit])

    def of_pair(self, pair: PairMatches) -> RelativePose | None:
        """Predicted pose of two images of different units; None where the prior does not tell where one is from the
        other.
        """
        images = [pair.image_a, pair.image_b]
        a, b = (self.drive.images[i] for i in images)
        if a.unit == b.unit or not np.isfinite(self.world_from_rig[images, 0, 3]).all():
            return None
        # Errors of two rotations may be one and the same, or opposite: twice the variance is enough for either.
        # Positions err by the same rather than by the opposite, which does not matter here.
        variance = self.sigma[images] ** 2 * np.array([2.0, 2.0, 2.0, 1.0, 1.0, 1.0])
        predicted = self.rig.relative_pose_between(
            a.camera, b.camera, self.world_from_rig[images], np.diag(variance.ravel())
        )
        between_m = predicted.base_from_a[:3, 3] - predicted.base_from_b[:3, 3]
        sigma_m = np.sqrt(np.linalg.eigvalsh(predicted.covariance[6:, 6:])[-1])
        known = GATE_SIGMAS * sigma_m < np.linalg.norm(between_m)
        return predicted if known and np.sqrt(variance[:, :3].max()) < MAX_SIGMA_RAD else None
