"""Rigid alignment of the reconstruction with GNSS positions; gross errors are rejected.

The alignment does not change scale, which comes from the rig; positions take part in it only through the adjustment
that follows. Positions along a straight line leave the rotation about that line free; the vehicle's up direction
determines it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.alignment import rotation_between
from mrasfm_engine.types import Bools, Floats

SIGMA_ROLL_RAD = np.radians(2.0)  # a road's cross fall, as far as it does not average out over a drive
SIGMA_PITCH_RAD = np.radians(5.0)  # a road's grade
HYPOTHESES = 300
MAX_AT_ONCE = 200_000  # positions under hypotheses that are in memory at one time
LEAST_SCALE_RANGE = 1.25  # of the receiver's trajectory against the rig's, where the baselines are known better
SCALE_SIGMAS = 2.5
MIN_CONSENSUS = 0.3  # of the positions
# A trajectory whose calibration is off a little bends, by so much of its extent; a good receiver sees that first. The
# least of these is taken under which most positions agree.
BENDS = (0.01, 0.03, 0.1)
MOST = 0.7
MIRRORED = (1, 0, 2)  # axes of measured positions whose latitude and longitude are swapped
BENT = 1.5  # factor by which residuals exceed their sigmas where a scene does not have the shape of its positions
# Degrees of longitude are shorter than those of latitude, and not by as much at the place that swapped ones name.
STRETCHES = (0.5, 0.67, 0.8, 1.0, 1.25, 1.5, 2.0)
ANY_SCALE = (1e-4, 1e4)
MIRRORED_SHARE = 0.5  # of the residuals as measured: a bend by chance agrees with the mirror image less often
LOSS_SCALE = 2.0
MIN_EXTENT_SIGMAS = 3.0  # of the positions' spread, below which they show no direction


@dataclass(frozen=True, kw_only=True)
class GnssAlignment:
    """The receiver's frame and the scene's.

    Outliers and noise are judged after a similarity fit, as the scene's scale may be off by more than the receiver's
    noise; the transform itself is rigid.
    """

    world_from_model: Floats  # (4, 4), rigid
    inlier: Bools  # (n,)
    residual_m: Floats  # (n,) distance after the similarity fit
    scale: float  # factor on the reconstruction that fits the receiver best; the transform does not apply it
    sigma_scale: float  # its standard deviation, from independent positions with the noise that was seen
    noise_factor: float  # how much larger residuals are than the declared sigmas say, at least 1


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """The reason why positions do not fit the reconstruction.

    `is_of_scale` is True where they have its shape at another scale, and nothing else is wrong. `remedy` is what helps
    where it is not to check them.
    """

    reason: str
    is_of_scale: bool = False
    remedy: str = ""


def align_with_gnss(
    antenna_m: Floats,
    up: Floats,
    forward: Floats,
    measured_m: Floats,
    sigma_m: Floats,
    *,
    outlier_sigmas: float,
    sigma_rig_scale: float,
    may_bend: bool = True,
    rng: np.random.Generator,
) -> GnssAlignment | Refusal:
    """Rigid transform from the reconstruction's frame to the receiver's.

    The reconstruction may be bent, as it may have been made with a calibration that only the receiver corrects. Its
    positions are judged again once they have taken part in an adjustment, see `placement.reassess_positions`.

    Parameters
    ----------
    antenna_m
        Positions (n, 3) of the antenna in the reconstruction, lever arm applied.
    up, forward
        The vehicle's up and forward directions (n, 3) in the reconstruction.
    measured_m, sigma_m
        Positions and sigmas (n, 3) of the receiver, x east, y north, z up.
    outlier_sigmas
        Residuals beyond so many sigmas are outliers.
    sigma_rig_scale
        Of the reconstruction's scale, relative, by what is known of the rig's baselines.
    may_bend
        Whether positions will be judged again, so that a bent reconstruction may be aligned.
    rng
        Draws the hypotheses.

    Returns
    -------
    GnssAlignment or Refusal
        With the reason, where it is not possible.
    """
    if len(antenna_m) < 3:
        return Refusal(reason=f"only {len(antenna_m)} registered units have a position at their time, 3 are needed")
    level = _levelling(up)
    a = se3.apply(level, antenna_m)
    spread = np.linalg.norm(a[:, :2] - np.median(a[:, :2], axis=0), axis=1)
    if np.sqrt((spread**2).sum()) < MIN_EXTENT_SIGMAS * float(np.median(sigma_m[:, :2])):
        moved_m = 2 * float(spread.max())
        return Refusal(
            reason=f"the car moved by {moved_m:.1f} m, too little against the receiver's noise to tell directions",
            remedy="Give a longer piece of the drive, or sigmas in gnss.samples that are as small as the errors are.",
        )
    scale_range = _scale_range(sigma_rig_scale)
    start, inlier = _best_yaw(a, measured_m, sigma_m, outlier_sigmas, rng, scale_range)
    if may_bend and inlier.mean() < MOST:
        bent = _bent(a, measured_m, sigma_m, outlier_sigmas, rng, scale_range)
        if bent is not None:
            start, inlier = bent
    if inlier.sum() < 3 or inlier.mean() < MIN_CONSENSUS:
        return _why_not(a, measured_m, sigma_m, inlier, outlier_sigmas, rng, scale_range)
    similarity, factor = start @ level, 1.0
    for _ in range(4):
        similarity = _refine(similarity, antenna_m, up, forward, measured_m, sigma_m * factor, inlier)
        off_m = _apply(similarity, antenna_m) - measured_m
        inlier, factor = assess_residuals(off_m, sigma_m, inlier, outlier_sigmas=outlier_sigmas)
        if inlier.sum() < 3:
            return Refusal(reason="no consistent set of positions was found")
    off_median_m = float(np.median(np.linalg.norm(off_m[:, :2], axis=1)))
    if factor > BENT and _mirrored(a, measured_m, sigma_m, outlier_sigmas, rng, off_median_m):
        return Refusal(
            reason="the trajectory has the shape of the positions' mirror image: latitude and longitude are swapped"
        )
    scale = float(np.cbrt(np.linalg.det(similarity[:3, :3])))
    rotation, weight = similarity[:3, :3] / scale, 1.0 / (sigma_m[inlier] ** 2).mean(1)
    centre = np.average(antenna_m[inlier], axis=0, weights=weight)
    spread = float(((antenna_m[inlier] - centre) ** 2 / (factor * sigma_m[inlier]) ** 2).sum())
    sigma = 1.0 / np.sqrt(max(spread, 1e-12))  # of the scale: of a short one a large part
    if not scale_range[0] - 3 * sigma <= scale <= scale_range[1] + 3 * sigma:
        return _scale_is_off(scale)
    return GnssAlignment(
        world_from_model=se3.transform(rotation, _apply(similarity, centre[None])[0] - rotation @ centre),
        inlier=inlier,
        residual_m=np.linalg.norm(off_m, axis=1),
        scale=scale,
        sigma_scale=float(sigma / scale),
        noise_factor=factor,
    )


def has_shape(
    antenna_m: Floats,
    up: Floats,
    measured_m: Floats,
    sigma_m: Floats,
    *,
    outlier_sigmas: float,
    sigma_rig_scale: float,
    rng: np.random.Generator,
) -> bool:
    """Return whether most positions have the reconstruction's shape at the rig's scale, but for the least of `BENDS`.

    The parameters are those of `align_with_gnss`.
    """
    a = se3.apply(_levelling(up), antenna_m)
    sigma_m = np.hypot(sigma_m, BENDS[0] * _extent_m(a))
    _, inlier = _best_yaw(a, measured_m, sigma_m, outlier_sigmas, rng, _scale_range(sigma_rig_scale))
    return bool(inlier.mean() >= MOST)


def _levelling(up: Floats) -> Floats:
    """The turn (4, 4) that makes the mean of up directions (n, 3) vertical."""
    return se3.transform(rotation_between(np.array([0.0, 0.0, 1.0]), _unit(up.sum(0))), np.zeros(3))


def _scale_range(sigma_rig_scale: float) -> tuple[float, float]:
    """Factors on the reconstruction that what is known of the rig's baselines allows."""
    most = max(LEAST_SCALE_RANGE, float(np.exp(min(SCALE_SIGMAS * sigma_rig_scale, 1.0))))
    return 1.0 / most, most


def _extent_m(a: Floats) -> float:
    """Root mean square of the horizontal distances of places (n, 3) from their median."""
    return float(np.sqrt(((a[:, :2] - np.median(a[:, :2], axis=0)) ** 2).sum(1).mean()))


def assess_residuals(off_m: Floats, sigma_m: Floats, inlier: Bools, *, outlier_sigmas: float) -> tuple[Bools, float]:
    """Judge residuals (n, 3), in the order of time; which are no outliers, and the factor on their sigmas.

    The factor, at least 1, is that by which those exceed their sigmas that were no outliers before. An outlier exceeds
    them by more and jumps: a scene that bends moves residuals little by little, and its receiver is right.
    """
    whitened = np.linalg.norm(off_m / sigma_m, axis=1)
    # 1.54 is the median length of a standard normal 3-vector.
    factor = max(1.0, float(np.median(whitened[inlier])) / 1.54)
    fits = whitened < outlier_sigmas * factor
    jump = np.linalg.norm(np.diff(off_m, axis=0) / np.hypot(sigma_m[1:], sigma_m[:-1]), axis=1)
    follows = jump < outlier_sigmas * factor
    for order in (range(1, len(fits)), range(len(fits) - 2, -1, -1)):
        for i in order:
            before = i - 1 if order.step > 0 else i + 1
            fits[i] |= fits[before] and follows[min(i, before)]
    return fits, factor


def _bent(
    a: Floats,
    measured: Floats,
    sigma: Floats,
    outlier_sigmas: float,
    rng: np.random.Generator,
    scale_range: tuple[float, float],
) -> tuple[Floats, Bools] | None:
    """The similarity and its inliers under the least bend with which most positions agree.

    None where there is none, or where the positions' mirror image, of no rigid motion, agrees clearly better. Along a
    straight line it agrees just as well.
    """
    extent_m = _extent_m(a)
    for bend in BENDS:
        wide_m = np.hypot(sigma, bend * extent_m)
        start, inlier = _best_yaw(a, measured, wide_m, outlier_sigmas, rng, scale_range)
        if _mirrored(a, measured, wide_m, outlier_sigmas, rng, _median_residual_m(start, a, measured)):
            return None
        if inlier.mean() >= MOST:
            return start, inlier
    return None


def _mirrored(
    a: Floats, measured: Floats, sigma: Floats, outlier_sigmas: float, rng: np.random.Generator, off_m: float
) -> bool:
    """True where the mirror image of most positions fits clearly better than positions do, by their median residual."""
    for stretch in STRETCHES:
        mirrored = measured[:, MIRRORED] * [stretch, 1.0, 1.0]
        image, inlier = _best_yaw(a, mirrored, sigma, outlier_sigmas, rng, ANY_SCALE)
        if inlier.mean() >= MOST and _median_residual_m(image, a, mirrored) < MIRRORED_SHARE * off_m:
            return True
    return False


def _median_residual_m(similarity: Floats, a: Floats, measured: Floats) -> float:
    """Median horizontal distance after a similarity."""
    return float(np.median(np.linalg.norm((_apply(similarity, a) - measured)[:, :2], axis=1)))


def _scale_is_off(scale: float) -> Refusal:
    return Refusal(
        reason=f"the receiver's trajectory is {scale:.3g} times as long as the rig's (are latitude and longitude "
        "swapped, or are the baselines not in metres?)",
        is_of_scale=True,
    )


def _why_not(
    a: Floats,
    measured: Floats,
    sigma: Floats,
    inlier: Bools,
    outlier_sigmas: float,
    rng: np.random.Generator,
    scale_range: tuple[float, float],
) -> Refusal:
    """Reason for which positions do not fit: perhaps only the rig's units."""
    wide, fitting = _best_yaw(a, measured, sigma, outlier_sigmas, rng, ANY_SCALE)
    scale = float(np.cbrt(np.linalg.det(wide[:3, :3])))
    if fitting.mean() >= 2 * MIN_CONSENSUS and not scale_range[0] <= scale <= scale_range[1]:
        return _scale_is_off(scale)
    return Refusal(
        reason=f"only {int(inlier.sum())} of {len(a)} positions agree with the shape of the trajectory (are latitude "
        "and longitude swapped, or the receiver's clock off?)"
    )


def rigid_motions(place_m: Floats) -> Floats:
    """Ways (n, 3, 6) in which rigid motions move places (n, 3): along the axes, then about them."""
    return np.concatenate([np.tile(np.eye(3), (len(place_m), 1, 1)), -se3.skew(place_m)], axis=2)


def similarity_motions(place_m: Floats) -> Floats:
    """Ways (n, 3, 7) in which similarities move places (n, 3): rigid motions about their middle, and growth."""
    centred_m = place_m - place_m.mean(0)
    return np.concatenate([rigid_motions(centred_m), centred_m[:, :, None]], axis=2)


def _unit(v: Floats) -> Floats:
    result: Floats = v / max(float(np.linalg.norm(v)), 1e-12)
    return result


def _apply(similarity: Floats, points: Floats) -> Floats:
    result: Floats = points @ similarity[:3, :3].T + similarity[:3, 3]
    return result


def _best_yaw(
    a: Floats,
    measured: Floats,
    sigma: Floats,
    outlier_sigmas: float,
    rng: np.random.Generator,
    scale_range: tuple[float, float],
) -> tuple[Floats, Bools]:
    """RANSAC over pairs of positions for the turn about the vertical, the scale and the shift: a similarity (4, 4)."""
    first = rng.integers(len(a), size=HYPOTHESES)
    second = (first + rng.integers(1, len(a), size=HYPOTHESES)) % len(a)
    along, moved = a[second] - a[first], measured[second] - measured[first]
    length_m, moved_m = np.hypot(*along[:, :2].T), np.hypot(*moved[:, :2].T)
    slack_m = 4.0 * (sigma[first, 0] + sigma[second, 0])
    least, most = scale_range
    possible = (length_m >= 1e-3) & (moved_m >= least * length_m - slack_m) & (moved_m <= most * length_m + slack_m)
    best_score, best, best_inlier = -1.0, np.eye(4), np.zeros(len(a), dtype=np.bool_)
    at_once = max(1, MAX_AT_ONCE // len(a))
    hypotheses = np.flatnonzero(possible)
    for begin in range(0, len(hypotheses), at_once):
        h = hypotheses[begin : begin + at_once]
        turn = np.zeros((len(h), 3))
        turn[:, 2] = np.arctan2(*moved[h, 1::-1].T) - np.arctan2(*along[h, 1::-1].T)
        scale = np.clip(moved_m[h] / length_m[h], *scale_range)
        rotation = scale[:, None, None] * se3.exp_so3(turn)
        shift = measured - a @ np.swapaxes(rotation, -1, -2)  # (hypotheses, n, 3)
        of_pair = 0.5 * (shift[np.arange(len(h)), first[h]] + shift[np.arange(len(h)), second[h]])
        for t in (np.median(shift, axis=1), of_pair):
            off = np.linalg.norm((t[:, None] - shift) / sigma, axis=2)
            score = np.nan_to_num(np.maximum(0.0, outlier_sigmas**2 - off**2).sum(1), nan=-1.0)
            winner = int(score.argmax())
            if score[winner] > best_score:
                best_score, best = float(score[winner]), se3.transform(rotation[winner], t[winner])
                best_inlier = off[winner] < outlier_sigmas
    return best, best_inlier


def _refine(
    similarity: Floats,
    antenna: Floats,
    up: Floats,
    forward: Floats,
    measured: Floats,
    sigma: Floats,
    inlier: Bools,
) -> Floats:
    """Gauss-Newton on rotation, translation and scale: positions with a Cauchy loss, and the vehicle near upright."""
    left = np.cross(up, forward)
    pose = similarity
    for _ in range(15):
        p = _apply(pose, antenna)[inlier]
        centre = p.mean(0)
        s = sigma[inlier]
        r = (p - measured[inlier]) / s
        w = 1.0 / (1.0 + (r**2).sum(1) / LOSS_SCALE**2)
        arm = p - centre
        j = np.concatenate([-se3.skew(arm), np.broadcast_to(np.eye(3), (len(p), 3, 3)), arm[:, :, None]], axis=2)
        j = j / s[..., None]
        h = np.einsum("n,nij,nik->jk", w, j, j)
        g = np.einsum("n,nij,ni->j", w, j, r)
        turn = pose[:3, :3] / np.cbrt(np.linalg.det(pose[:3, :3]))
        for direction, prior in ((left, SIGMA_ROLL_RAD), (forward, SIGMA_PITCH_RAD)):
            d = direction @ turn.T
            # d (R v)_z / d omega = (v x e_z)' in turned axes; averaged over units, as one error is common to all.
            row = np.zeros((len(d), 7))
            row[:, :3] = np.cross(d, [0.0, 0.0, 1.0])
            weight = 1.0 / (prior**2 * len(d))
            h += weight * row.T @ row
            g += weight * row.T @ d[:, 2]
        step = -np.linalg.solve(h + 1e-12 * np.eye(7), g)
        change = np.exp(step[6]) * se3.exp_so3(step[:3])
        pose = se3.transform(change @ pose[:3, :3], change @ (pose[:3, 3] - centre) + centre + step[3:6])
        if np.abs(step).max() < 1e-9:
            break
    return pose
