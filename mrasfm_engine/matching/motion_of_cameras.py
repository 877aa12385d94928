"""Rotations of the cameras in the rig from how each sees the vehicle move: for cameras that share no view.

Images of one camera at two units determine its rotation and its direction of motion. All cameras of a rig make one
motion, so two cameras that are turned against each other by some degrees see the vehicle move in different directions.
That shows before any unit has a pose. A scene that begins with such a rig finds another explanation: a vehicle that
hardly moves while it turns, so that its cameras move in different directions about its middle, or one that leaves most
of a camera's matches out.

Corrections x of the cameras' rotations and motions of some pairs of units minimise

    sum of rho(e^2 / variance) + x' P^-1 x + priors of the motions

with the Sampson distances e of `sampson`. P is what simultaneous images have left uncertain of the rotations. Images
alone determine the directions and rotations of the motions. Their lengths count where cameras stand apart in a vehicle
that turns, and are those of a vehicle of unknown speed.

Errors within the standard deviations of the prior and of the directions of motion that cameras see are left to the
adjustment. Beyond, a correction is used if it is significant along one direction at least, and brings these directions
nearer to one another. Of roll about a straight street only matches between two cameras at different times say
something.

These directions are those of the cameras, not of one point of the rig: as lengths are unknown, so is how much of their
difference comes from lever arms. Round a circle of 5 m a camera at the rear axle and one 1.7 m ahead of it see
directions 19 deg apart, under any rotations. The correction takes lever arms into account. The angles by which
directions differ do not, neither before nor after it: a turn makes them large, also for a rig that is right.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np

from mrasfm_engine.config import BundleAdjustmentConfig, MatchConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.averaging import geometric_median, robust_mean_rotation
from mrasfm_engine.geometry.camera_model import pack_cameras
from mrasfm_engine.matching.motion_matches import MotionMatches, groups_that_share_views, motion_matches
from mrasfm_engine.matching.relative_pose import UncertainRig
from mrasfm_engine.matching.robust_correction import MEDIAN_SIGMAS, Correction, Errors, most_likely_correction
from mrasfm_engine.matching.sampson import epipolar_derivatives
from mrasfm_engine.matching.simultaneous import (
    INDEPENDENT_MATCHES,
    MIN_SIGMA_PX,
    MIN_UNITS,
    SIGNIFICANT_SIGMAS,
    WEAK_PRIOR,
    largest_turn_rad,
    turned_between,
)
from mrasfm_engine.matching.verification import relative_pose
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import PairMatches
from mrasfm_engine.types import Floats
from schemas.findings import Finding, warning

USUAL_SPEED_MPS = 8.0  # 30 km/h: of walking pace and of a motorway, neither is a factor of six away
SIGMA_SPEED = np.log(6.0) / 2.0  # so that both are two standard deviations away
# Of the logarithm of a motion's speed against the others'. On PandaSet 002, from a standstill on, these spread by 0.84,
# on KITTI 01, 02 and 06, which do not stop, by less than 0.1.
SIGMA_SPEED_CHANGES = np.log(2.0)
SIGMA_TURN = 0.5  # rad: images that match are turned by hardly more than a view, 60 deg, which are two sigmas
SIGMA_DIRECTION = 1.0  # rad about each axis: of any direction it is 1.2, so this is next to no prior
OPPOSITE_DEG = 90.0  # between directions of motion: two cameras that see the vehicle drive in opposite ones
UNKNOWNS = 7  # of a motion: its turn, the turn of its direction, and the logarithm of its length


@dataclass(frozen=True, kw_only=True)
class MotionEstimate:
    """The cameras' poses (c, 4, 4) with the corrections that their motions demand.

    Attributes
    ----------
    motions
        Number of pairs of units that are compared.
    apart_before_rad, apart_rad
        Medians over these (c, c) of the angles between the directions in which two cameras see themselves move, under
        the rig as it was and as corrected; zero where none are compared. Of cameras that stand apart they contain the
        effect of the lever arm in turns.
    """

    rig_from_cam: Floats
    motions: int
    apart_before_rad: Floats
    apart_rad: Floats

    @property
    def is_corrected(self) -> bool:
        """A rotation was corrected."""
        return not np.array_equal(self.apart_rad, self.apart_before_rad)


def motion_contradiction(names: Sequence[str], given: Floats, found: MotionEstimate) -> Finding | None:
    """Finding on a calibration (c, 4, 4) that the cameras' motions contradict.

    The directions that it compares are those of the cameras: see `MotionEstimate`.
    """
    if not found.is_corrected:
        return None
    nearer = found.apart_before_rad - found.apart_rad
    a, b = sorted(int(k) for k in np.unravel_index(int(nearer.argmax()), nearer.shape))
    turned, before, after = (
        float(np.degrees(of_cameras[a, b]))
        for of_cameras in (turned_between(given, found.rig_from_cam), found.apart_before_rad, found.apart_rad)
    )
    remedy = (
        "Mapping begins with the corrected rotations; take the result from calibration.json, and check the mounting."
    )
    if after > OPPOSITE_DEG:
        remedy = (
            "Look at the images of both: one that sees the vehicle drive backwards, also as corrected, has mirrored "
            "images or those of another camera, and its rotation in calibration.json is worth nothing."
        )
    return warning(
        "calibration-contradicted",
        f"the vehicle's motion shows cameras {names[a]} and {names[b]} turned by {turned:.2f} deg against each other "
        f"from where rig.cameras says: in {found.motions} motions the directions in which they see it move differ by "
        f"{before:.1f} deg (median), by {after:.1f} deg as corrected",
        remedy,
    )


def rig_by_motion(
    drive: Drive,
    pairs: Sequence[PairMatches],
    rays_of: Callable[[PairMatches], tuple[Floats, Floats]],
    rig: UncertainRig,
    match_config: MatchConfig,
    calibration: BundleAdjustmentConfig,
) -> MotionEstimate:
    """The rig as the motions of its cameras correct it; where settings hold the calibration, as it is.

    Parameters
    ----------
    rays_of
        Viewing rays (n, 3) of a pair's inliers in image_a and image_b.
    rig
        As simultaneous images correct it.
    """
    groups = groups_that_share_views(rig)
    compared = calibration.refine_calibration and len(set(groups)) > 1
    found, elapsed_s = motion_matches(drive, pairs if compared else (), groups, rays_of, match_config)
    return estimate_rig_by_motion(
        rig,
        found,
        elapsed_s=elapsed_s,
        focal_px=pack_cameras(drive.cameras)[1][:, :2].mean(1),
        max_error_px=match_config.max_error_px,
    )


def estimate_rig_by_motion(
    rig: UncertainRig, found: Sequence[MotionMatches], *, elapsed_s: Floats, focal_px: Floats, max_error_px: float
) -> MotionEstimate:
    """The rig from matches between units.

    Parameters
    ----------
    rig
        As it is known before.
    found
        Matches between images of pairs of units.
    elapsed_s
        Times (motions,) between the units of each pair.
    focal_px
        Of the cameras (c,): noise is in pixels.
    max_error_px
        Distance from its epipolar line at which a match counts as right.
    """
    problem = _MotionProblem.from_matches(rig, found, elapsed_s=elapsed_s, focal_px=focal_px, max_error_px=max_error_px)
    before = problem.apart_rad
    result = MotionEstimate(
        rig_from_cam=rig.rig_from_cam, motions=len(problem.alone), apart_before_rad=before, apart_rad=before
    )
    # What prior and noise let expect is left to the adjustment, which weighs it against everything else.
    expected, by_prior = problem.expected_apart_rad, np.hypot(problem.sigma_rad[:, None], problem.sigma_rad)
    # A lorry that fills one camera's images moves as well, but not between many pairs of units.
    if len(problem.alone) < MIN_UNITS or (before <= expected).all():
        return result
    for begin in problem.starts():
        corrected = problem.begun_with(problem.demanded(problem.most_likely(begin)))
        after = corrected.apart_rad
        is_better = ((before > expected) & (after < before)).any() and (after <= np.maximum(before, by_prior)).all()
        if is_better and corrected.is_calibration_of(rig):
            return replace(result, rig_from_cam=corrected.rig_from_cam, apart_rad=after)
    return result


@dataclass(frozen=True, kw_only=True)
class _OwnMotion:
    """A motion as one camera sees it.

    `turn` (3, 3) leads from the later to the earlier unit, `direction` (3,) is that in which the rig moves, both in rig
    axes, and `variance_rad2` is of the angle by which the direction errs.
    """

    turn: Floats
    direction: Floats
    variance_rad2: float

    def turned(self, by: Floats) -> _OwnMotion:
        """The motion under a rig whose camera is turned (3, 3)."""
        return replace(self, turn=by @ self.turn @ by.T, direction=by @ self.direction)


@dataclass(frozen=True, kw_only=True)
class _MotionProblem:
    """Corrections of rotations (3 c,), logarithm of the speed (1,), and motions (7 m,), in units of their priors."""

    rig_from_cam: Floats  # (c, 4, 4)
    turn_root: Floats  # (3 c, 3 c) root of the covariance of the cameras' turns, rad
    found: Sequence[MotionMatches]
    alone: Sequence[Mapping[int, _OwnMotion]]  # (m,) by camera
    usual_m: Floats  # (m,)
    focal_px: Floats  # (c,)
    max_error_px: float

    @staticmethod
    def from_matches(
        rig: UncertainRig, found: Sequence[MotionMatches], *, elapsed_s: Floats, focal_px: Floats, max_error_px: float
    ) -> _MotionProblem:
        """The problem of those motions that a camera determines by itself, and another one or matches of both."""
        alone: dict[int, dict[int, _OwnMotion]] = {}
        for one in found:
            pixel_rad = 1.0 / float(focal_px[one.camera_a])
            motion = _own_motion(rig, one, pixel_rad, max_error_px) if one.camera_a == one.camera_b else None
            if motion is not None:
                alone.setdefault(one.motion, {})[one.camera_a] = motion
        across = {one.motion for one in found if one.camera_a != one.camera_b}
        compared = sorted(number for number, of_cameras in alone.items() if len(of_cameras) > 1 or number in across)
        of_turns = rig.covariance.reshape(len(focal_px), 6, -1, 6)[:, :3, :, :3]
        variance, axes = np.linalg.eigh(of_turns.reshape(3 * len(focal_px), -1))
        row_of = {motion: row for row, motion in enumerate(compared)}
        return _MotionProblem(
            rig_from_cam=rig.rig_from_cam,
            turn_root=axes * np.sqrt(np.maximum(variance, 0.0)),
            found=[replace(one, motion=row_of[one.motion]) for one in found if one.motion in row_of],
            alone=[alone[number] for number in compared],
            usual_m=USUAL_SPEED_MPS * elapsed_s[np.array(compared, dtype=np.int64)],
            focal_px=focal_px,
            max_error_px=max_error_px,
        )

    @property
    def apart_rad(self) -> Floats:
        """Medians (c, c) of the angles between the directions of motion that two cameras see by themselves."""
        result = np.zeros((len(self.focal_px),) * 2)
        for a, b in combinations(range(len(result)), 2):
            cosine = [float(of[a].direction @ of[b].direction) for of in self.alone if a in of and b in of]
            if cosine:
                result[a, b] = result[b, a] = np.arccos(np.clip(np.median(cosine), -1.0, 1.0))
        return result

    @property
    def expected_apart_rad(self) -> Floats:
        """The angles (c, c) that right cameras have: of what is uncertain of their turns, and of their directions."""
        variance = self.sigma_rad[:, None] ** 2 + self.sigma_rad**2
        for a, b in combinations(range(len(variance)), 2):
            noise = [of[a].variance_rad2 + of[b].variance_rad2 for of in self.alone if a in of and b in of]
            if noise:
                variance[a, b] += np.median(noise)
                variance[b, a] = variance[a, b]
        return np.sqrt(variance)

    @cached_property
    def sigma_rad(self) -> Floats:
        """Largest standard deviations (c,) of the cameras' turns about any axis, before their motions count."""
        result: Floats = np.sqrt((self.turn_root**2).sum(1)).reshape(-1, 3).max(1)
        return result

    @property
    def turns(self) -> int:
        """Number of the unknowns that turn cameras."""
        return 3 * len(self.focal_px)

    @cached_property
    def weights(self) -> Mapping[tuple[int, int], float]:
        """Share of an independent match that each of two cameras counts as, over all motions.

        Of two cameras, matches from the one to the other are of other parts of their images than those back.
        """
        counts: Counter[tuple[int, int]] = Counter()
        for one in self.found:
            counts[one.camera_a, one.camera_b] += len(one.rays_a)
        return {cameras: min(1.0, INDEPENDENT_MATCHES / count) for cameras, count in counts.items()}

    def turned(self, x: Floats) -> Floats:
        """Poses (c, 4, 4) with the rotations corrected by x (3 c,)."""
        turned = se3.exp_so3((self.turn_root @ x).reshape(-1, 3)) @ self.rig_from_cam[:, :3, :3]
        return se3.transform(turned, self.rig_from_cam[:, :3, 3])

    def most_likely(self, begin: Floats) -> Correction:
        """The most likely corrections and motions, sought from some turns (3 c,)."""
        turn, direction = self._middle(begin)
        return most_likely_correction(
            lambda x: self._errors(x, turn, direction),
            np.concatenate([begin, np.zeros(1 + UNKNOWNS * len(self.alone))]),
            least_spread=MIN_SIGMA_PX * np.array([self.pixel_rad(one) for one in self.found]),
        )

    def begun_with(self, x: Floats) -> _MotionProblem:
        """The problem of the cameras turned by x (3 c,)."""
        by = se3.exp_so3((self.turn_root @ x).reshape(-1, 3))
        alone = [{camera: own.turned(by[camera]) for camera, own in motions.items()} for motions in self.alone]
        return replace(self, rig_from_cam=self.turned(x), alone=alone)

    def _middle(self, x: Floats) -> tuple[Floats, Floats]:
        """Turns (m, 3, 3) and directions (m, 3) of the motions: the middle of what cameras turned by x (3 c,) see."""
        begun = self.begun_with(x)
        turn, direction = np.empty((len(begun.alone), 3, 3)), np.empty((len(begun.alone), 3))
        for row, motions in enumerate(begun.alone):
            turn[row] = robust_mean_rotation(np.stack([own.turn for own in motions.values()]))
            middle = geometric_median(np.stack([own.direction for own in motions.values()]))
            direction[row] = middle / max(float(np.linalg.norm(middle)), 1e-9)
        return turn, direction

    def starts(self) -> Iterator[Floats]:
        """Turns (3 c,) to begin from: where matches lead with next to no prior, and by directions of motion alone.

        Matches between two cameras are all wrong by far where these are turned, and hardly pull.
        """
        aligned, wider = self._aligned(), np.sqrt(WEAK_PRIOR)
        weak = replace(self, turn_root=self.turn_root / wider)
        yield weak.most_likely(aligned * wider).x[: self.turns] / wider
        yield aligned

    def _aligned(self) -> Floats:
        """Turns (3 c,) by which the cameras see the vehicle move in the same directions, as a rule."""
        direction = self._middle(np.zeros(self.turns))[1]
        off: list[list[Floats]] = [[np.zeros(3)] for _ in self.focal_px]
        for middle, motions in zip(direction, self.alone, strict=True):
            for camera, own in motions.items():
                across = np.cross(own.direction, middle)
                sine = max(float(np.linalg.norm(across)), 1e-9)
                off[camera].append(np.arctan2(sine, own.direction @ middle) / sine * across)
        turned = np.concatenate([np.median(of_camera[1:] or of_camera, axis=0) for of_camera in off])
        result: Floats = np.linalg.pinv(self.turn_root) @ turned
        return result

    def demanded(self, correction: Correction) -> Floats:
        """The turns (3 c,) of a correction; none, if it is significant along no principal direction.

        One that is significant contradicts the rig as given: the others are taken for what is most likely as well.
        """
        turns = slice(0, self.turns)
        covariance = np.linalg.inv(np.eye(len(correction.x)) + correction.information)[turns, turns]
        variance, directions = np.linalg.eigh(covariance)
        along = directions.T @ correction.x[turns]
        is_significant = bool((along**2 > SIGNIFICANT_SIGMAS**2 * np.maximum(variance, 0.0)).any())
        return correction.x[turns] if is_significant else np.zeros(self.turns)

    def is_calibration_of(self, rig: UncertainRig) -> bool:
        """True where no two cameras are turned against one another by more than is a matter of calibration."""
        sigma, turned = self.sigma_rad, turned_between(rig.rig_from_cam, self.rig_from_cam)
        largest = np.array([[largest_turn_rad(float(a), float(b)) for b in sigma] for a in sigma])
        return bool((turned <= largest).all())

    def _errors(self, x: Floats, turn: Floats, direction: Floats) -> list[Errors]:
        """Errors of each pair of images, with no more information than of `INDEPENDENT_MATCHES` of two cameras."""
        rig, motions = self.turned(x[: self.turns]), x[self.turns + 1 :].reshape(-1, UNKNOWNS)
        turn = se3.exp_so3(SIGMA_TURN * motions[:, :3]) @ turn
        direction = (se3.exp_so3(SIGMA_DIRECTION * motions[:, 3:6]) @ direction[:, :, None])[..., 0]
        log_length = SIGMA_SPEED * x[self.turns] + SIGMA_SPEED_CHANGES * motions[:, 6]
        shift_m = (self.usual_m * np.exp(log_length))[:, None] * direction
        return [self._errors_of(one, rig, turn[one.motion], shift_m[one.motion]) for one in self.found]

    def _errors_of(self, one: MotionMatches, rig: Floats, turn: Floats, shift_m: Floats) -> Errors:
        a, b, first = one.camera_a, one.camera_b, self.turns + 1 + UNKNOWNS * one.motion
        error, derivatives, _ = epipolar_derivatives(
            rig[a], se3.transform(turn, shift_m) @ rig[b], one.rays_a, one.rays_b
        )
        root_a, root_b = (self.turn_root[3 * k : 3 * k + 3] for k in (a, b))
        # Of the rotations of both cameras and the place of a against b, by all unknowns that move them.
        moved = np.zeros((9, self.turns + 1 + UNKNOWNS))
        moved[:3, : self.turns], moved[3:6, : self.turns] = root_a, turn @ root_b
        moved[6:, self.turns] = -SIGMA_SPEED * shift_m
        of_motion = moved[:, self.turns + 1 :]
        of_motion[3:6, :3] = SIGMA_TURN * np.eye(3)
        of_motion[6:, :3] = SIGMA_TURN * se3.skew(turn @ rig[b, :3, 3])
        of_motion[6:, 3:6] = SIGMA_DIRECTION * se3.skew(shift_m)
        of_motion[6:, 6] = -SIGMA_SPEED_CHANGES * shift_m
        return Errors(
            rows=np.concatenate([np.arange(self.turns + 1), np.arange(first, first + UNKNOWNS)]),
            error=error,
            jacobian=derivatives @ moved,
            weight=self.weights[a, b],
        )

    def pixel_rad(self, one: MotionMatches) -> float:
        """Angle of a pixel of the coarser of two cameras."""
        return float(1.0 / self.focal_px[[one.camera_a, one.camera_b]].min())


def _own_motion(rig: UncertainRig, one: MotionMatches, pixel_rad: float, max_error_px: float) -> _OwnMotion | None:
    """The motion that matches of one camera's images show; None where these are too few."""
    found = relative_pose(one.rays_a, one.rays_b, max_error=max_error_px * pixel_rad)
    if found is None:
        return None
    rotation, translation = found
    rig_from_cam = rig.rig_from_cam[one.camera_a, :3, :3]
    shift = -rotation.T @ translation
    return _OwnMotion(
        turn=rig_from_cam @ rotation.T @ rig_from_cam.T,
        direction=rig_from_cam @ shift,
        variance_rad2=_variance_of_direction(one, rotation.T, shift, MIN_SIGMA_PX * pixel_rad),
    )


def _variance_of_direction(one: MotionMatches, turn: Floats, shift: Floats, least_spread: float) -> float:
    """Variance in rad^2 of the angle by which a motion's direction errs, which matches show together with its turn.

    Matches count as at most `INDEPENDENT_MATCHES`, as lens models err alike in all motions: their number takes nothing
    off that, nor do other motions.
    """
    error, derivatives, _ = epipolar_derivatives(np.eye(4), se3.transform(turn, shift), one.rays_a, one.rays_b)
    spread = max(least_spread, float(np.median(np.abs(error))) / MEDIAN_SIGMAS)
    across = np.linalg.svd(shift[None])[2][1:]  # the distances are the same at any length
    by = np.column_stack([derivatives[:, 3:6] * SIGMA_TURN, derivatives[:, 6:] @ across.T * SIGMA_DIRECTION])
    weight = min(1.0, INDEPENDENT_MATCHES / len(error)) / (spread**2 + error**2)
    covariance = np.linalg.inv(np.eye(5) + by.T @ (weight[:, None] * by))
    return float(SIGMA_DIRECTION**2 * np.trace(covariance[3:, 3:]))
