"""Two cameras that have each other's images, from how each sees the vehicle move: for cameras that share no view.

Images of one camera at two units determine its direction of motion, and a car drives along its forward axis. The
front left and the front right camera, exchanged, see it drive aside in all of the drive, and along that axis once
their poses are exchanged. Whatever else is wrong seldom does that of both: a camera that is turned leaves the other one
right, and directions that turns and lever arms change are the same before and after.

Traffic that overtakes fills a camera's images and turns its direction around: axes tell, whatever their sign. Cameras
that look left and right at right angles see the vehicle drive backwards when exchanged, on the same axis. As traffic on
both sides of a short drive shows that as well, it is a finding and no refusal.

A wall that fills an image leaves the direction of motion open, of which any explains its matches: it takes no part.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from threadpoolctl import threadpool_limits

from mrasfm_engine.errors import CancelledError
from mrasfm_engine.even_choice import even_choice
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_cameras, unproject_pixels
from mrasfm_engine.geometry.colmap_cameras import MIN_FORWARD
from mrasfm_engine.matching.calibration_check import (
    AGREE_DEG,
    CLEARLY_BETTER,
    CLEARLY_WORSE,
    MIN_INLIERS,
    MIN_PARALLAX_RAD,
)
from mrasfm_engine.matching.exchanged_cameras import Exchange, exchanged_error, exchanges
from mrasfm_engine.matching.simultaneous import LARGEST_TURN_DEG, MIN_UNITS, SIGNIFICANT_SIGMAS, are_simultaneous
from mrasfm_engine.matching.verification import direction_of_motion, epipolar_errors, parallax_rad, relative_pose
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures, PairMatches
from mrasfm_engine.types import Cancel, Floats, Ints32
from schemas.findings import Finding, warning

MAX_MOTIONS = 8  # pairs of units, evenly over the drive
MIN_MOTIONS = 4  # in which both cameras determine their directions
# A camera that sees the vehicle drive forwards in so many of them does not see it drive elsewhere in `CLEARLY_WORSE`.
CLEARED = 3
MAX_MATCHES = 300  # of two images: more cost time and say little
MAX_ERROR_PX, CONFIDENCE = 2.0, 0.999  # of matches between two units
FORWARD = np.array([1.0, 0.0, 0.0])  # in the rig's axes
# Share of the matches that are off a plane, and tell of the motion: of walls at 1 px noise 0.01, of rendered streets
# with flat houses 0.1, of PandaSet 002 0.5.
DEPTH_SHARE = 0.06
MAX_PLANE_MATCHES, PLANE_ERROR = 1_000, 2.0  # the latter times the error of a match


def exchanged_by_motion(
    drive: Drive, features: Sequence[ImageFeatures], pairs: Sequence[PairMatches], *, cancel: Cancel | None = None
) -> Finding | None:
    """Refuse a drive two of whose cameras have each other's images, by the axes along which they see it drive.

    Cameras whose simultaneous images fit the calibration are not in question: a drive of no others costs next to
    nothing. The others are compared in a few pairs of units, in no more of them than it takes to clear all but one.

    Parameters
    ----------
    features
        Of all images of the drive.
    pairs
        Matches that agree with an essential matrix, whatever their inliers are: a prior trajectory leaves none to
        cameras that are far from their given poses.

    Returns
    -------
    Finding or None
        On cameras that see the vehicle drive backwards, as each other they would see it drive forwards.

    Raises
    ------
    InputError
        Where the cameras see the vehicle drive along another axis than its own, and along that if exchanged.
    """
    doubted = set(range(len(drive.cameras))) - _confirmed(drive, pairs)
    if len(doubted) < 2:
        return None
    names = [camera.name for camera in drive.cameras]
    with threadpool_limits(1, "blas"):
        motions = _Motions(drive, features, pairs, cancel)
        doubted -= motions.cleared(doubted)
        possible = [one for one in exchanges(len(names)) if doubted >= {one.camera_a, one.camera_b}]
        axes = _likeliest(possible, [motions.votes(one, signed=False) for one in possible], CLEARLY_WORSE)
        if axes is not None:
            raise exchanged_error(names, axes[0], f"{axes[1]} aside, and along its own axis if they are exchanged")
        directions = _likeliest(possible, [motions.votes(one, signed=True) for one in possible], CLEARLY_BETTER)
    return None if directions is None else _backwards(names, *directions)


@dataclass(frozen=True)
class _Vote:
    """Evidence of a motion on an exchange: whether that explains both directions, and what is given neither.

    The vehicle's direction along its axis is that which the other cameras see: 1, -1 or, of none, 0.
    """

    explained: bool
    forwards: float


def _likeliest(
    possible: Sequence[Exchange], votes: Sequence[Sequence[_Vote]], share: float
) -> tuple[Exchange, str] | None:
    """The exchange that most motions explain, a `share` at least, and their number in words.

    Of several, the vehicle drives forwards under the likeliest.
    """
    best: tuple[float, float, int] = (0.0, 0.0, 0)
    for number, own in enumerate(votes):
        if len(own) >= MIN_MOTIONS:
            explained, forwards = np.mean([(vote.explained, vote.forwards) for vote in own], axis=0)
            best = max(best, (float(explained), float(forwards), number))
    if best[0] < share:
        return None
    own = votes[best[2]]
    count = sum(vote.explained for vote in own)
    return possible[best[2]], f"in {count} of {len(own)} motions they see the vehicle drive"


def _backwards(names: Sequence[str], exchange: Exchange, counted: str) -> Finding:
    """The finding on cameras that look aside and see the vehicle drive backwards."""
    return warning(
        "cameras-backwards",
        f"frames: the images of cameras {exchange.both(names)} look exchanged: {counted} the other way than the other "
        "cameras do",
        f"{exchange.remedy(names)} Nothing needs to be done where traffic that overtakes filled the images of both.",
    )


def _confirmed(drive: Drive, pairs: Sequence[PairMatches]) -> set[int]:
    """Cameras whose simultaneous images fit those of another one in some units."""
    units: Counter[tuple[int, int]] = Counter()
    for pair in pairs:
        if are_simultaneous(drive, pair.image_a, pair.image_b) and pair.inliers.sum() >= MIN_INLIERS:
            units[drive.images[pair.image_a].camera, drive.images[pair.image_b].camera] += 1
    return {camera for cameras, count in units.items() if count >= MIN_UNITS for camera in cameras}


class _Motions:
    """Directions of motion that cameras see between some pairs of units."""

    def __init__(
        self,
        drive: Drive,
        features: Sequence[ImageFeatures],
        pairs: Sequence[PairMatches],
        cancel: Cancel | None,
    ) -> None:
        self._kinds, self._params = pack_cameras(drive.cameras)
        self._rig, self._features, self._cancel = drive.rig_from_cam, features, cancel
        self._between = _evenly_chosen(drive, pairs)
        self._seen: dict[tuple[int, int, int], Floats | None] = {}
        self._depth: dict[int, bool] = {}

    def cleared(self, doubted: set[int]) -> set[int]:
        """Cameras that see the vehicle drive as the others do, along its axis, in `CLEARED` motions.

        The last one that is left has nobody to be exchanged with, and is not looked at any more.
        """
        count: Counter[int] = Counter()
        for motion in range(len(self._between)):
            given = self._given(motion)
            for camera in given:
                sign = _direction_along_axis(given, without={camera}) or np.sign(given[camera] @ FORWARD)
                count[camera] += bool(given[camera] @ FORWARD * sign > np.cos(np.radians(LARGEST_TURN_DEG)))
            if sum(count[camera] < CLEARED for camera in doubted) < 2:
                break
        return {camera for camera in doubted if count[camera] >= CLEARED}

    def votes(self, exchange: Exchange, *, signed: bool) -> list[_Vote]:
        """Evidence on an exchange of each motion in which both cameras determine their directions.

        Parameters
        ----------
        signed
            Compare directions, where the other cameras see the vehicle drive forwards, else axes whatever their sign.
        """
        both, result = {exchange.camera_a, exchange.camera_b}, []
        for motion in range(len(self._between)):
            given = self._given(motion)
            sign = _direction_along_axis(given, without=both)
            if not given.keys() >= both or (signed and sign <= 0.0):
                continue
            explained = self._is_explained(motion, exchange, given, signed=signed)
            result.append(_Vote(explained, sign))
        # Depth costs time to see, and is in question where all else speaks for an exchange.
        if any(vote.explained for vote in result) and not all(self._shows_depth(camera) for camera in both):
            return []
        return result

    def _is_explained(self, motion: int, exchange: Exchange, given: Mapping[int, Floats], *, signed: bool) -> bool:
        """True where both directions leave the vehicle's axis as given, and agree with it and others if exchanged."""
        a, b = exchange.camera_a, exchange.camera_b
        if max(_along(given[camera], signed=signed) for camera in (a, b)) > np.cos(np.radians(LARGEST_TURN_DEG)):
            return False
        exchanged = {a: self._direction(motion, a, b), b: self._direction(motion, b, a)}
        after = {**given, **{camera: seen for camera, seen in exchanged.items() if seen is not None}}
        along = min(_along(after[camera], signed=signed) for camera in (a, b))
        # Cameras that all see it drive aside, as of a rig in other axes, agree in its direction: those that are
        # exchanged and look 45 deg to the left and right see it drive to the right and to the left.
        agree = _agreeing(after, signed=signed), _agreeing(given, signed=True)
        return bool(
            along > np.cos(np.radians(LARGEST_TURN_DEG)) and agree[0] >= {a, b} and len(agree[0]) > len(agree[1])
        )

    def _given(self, motion: int) -> dict[int, Floats]:
        """Directions (3,) in the rig by those cameras that determine one, as given."""
        seen = {camera: self._direction(motion, camera, camera) for camera in sorted(self._between[motion])}
        return {camera: direction for camera, direction in seen.items() if direction is not None}

    def _direction(self, motion: int, camera: int, taken_by: int) -> Floats | None:
        """Direction (3,) in the rig, half way, by the images that are listed for a camera and taken by another one.

        The chord of a turn is straight ahead half way.
        """
        key = motion, camera, taken_by
        if key not in self._seen:
            if self._cancel is not None and self._cancel():
                raise CancelledError
            self._seen[key] = self._found(motion, camera, taken_by)
        return self._seen[key]

    def _found(self, motion: int, camera: int, taken_by: int) -> Floats | None:
        rays = self._rays(motion, camera, taken_by)
        if parallax_rad(*rays) < MIN_PARALLAX_RAD:
            return None
        pose = relative_pose(*rays, max_error=self._max_error(taken_by), confidence=CONFIDENCE)
        if pose is None:
            return None
        half_way = se3.exp_so3(0.5 * se3.log_so3(pose[0]))
        result: Floats = self._rig[taken_by, :3, :3] @ half_way @ direction_of_motion(pose)
        return result

    def _rays(self, motion: int, camera: int, taken_by: int, most: int = MAX_MATCHES) -> tuple[Floats, Floats]:
        """Rays (n, 3) of some matches in the earlier and in the later image."""
        images, matches = self._between[motion][camera]
        rows = matches[even_choice(len(matches), most)].T
        a, b = (
            unproject_pixels(int(self._kinds[taken_by]), self._params[taken_by], self._features[image].xy_px[of])
            for image, of in zip(images, rows, strict=True)
        )
        return a, b

    def _max_error(self, camera: int) -> float:
        return MAX_ERROR_PX / float(self._params[camera, 0])

    def _shows_depth(self, camera: int) -> bool:
        """True where a camera's matches tell its motion from the other one that a plane allows, over all motions.

        That other motion is what the plane's homography has beside the true one [Hartley and Zisserman, 13.3]. Matches
        off the plane tell, if it loses more of them than chance lets it.
        """
        if camera not in self._depth:
            counts = [self._fits_and_losses(motion, camera) for motion in range(len(self._between))]
            fits, lost, won = np.sum([count for count in counts if count is not None] or [(0, 0, 0)], axis=0)
            least = max(DEPTH_SHARE * fits, SIGNIFICANT_SIGMAS * np.sqrt(lost + won))
            self._depth[camera] = bool(lost - won > least)
        return self._depth[camera]

    def _fits_and_losses(self, motion: int, camera: int) -> tuple[int, int, int] | None:
        """Matches that a motion explains, and those that it alone does, and the likeliest other motion of a plane."""
        if camera not in self._given(motion):
            return None
        rays, max_error = self._rays(motion, camera, camera, most=MAX_PLANE_MATCHES), self._max_error(camera)
        pose = relative_pose(*rays, max_error=max_error, confidence=CONFIDENCE)
        if pose is None:
            return None
        fit = epipolar_errors(se3.transform(*pose), *rays) < max_error
        result = [int(fit.sum()), int(fit.sum()), 0]
        for other in _by_plane(*rays, PLANE_ERROR * max_error):
            if abs(direction_of_motion(pose) @ direction_of_motion(other)) < np.cos(np.radians(LARGEST_TURN_DEG)):
                other_fit = epipolar_errors(se3.transform(*other), *rays) < max_error
                lost, won = int((fit & ~other_fit).sum()), int((other_fit & ~fit).sum())
                if lost - won < result[1] - result[2]:
                    result[1:] = lost, won
        return result[0], result[1], result[2]


def _by_plane(rays_a: Floats, rays_b: Floats, max_error: float) -> list[tuple[Floats, Floats]]:
    """Rotations (3, 3) and translations (3,) b_from_a that explain the plane which most matches show."""
    ahead = (rays_a[:, 2] > MIN_FORWARD) & (rays_b[:, 2] > MIN_FORWARD)
    a, b = (rays[ahead, :2] / rays[ahead, 2:] for rays in (rays_a, rays_b))
    homography, _ = cv2.findHomography(a, b, cv2.RANSAC, max_error)
    if homography is None:
        return []
    _, rotations, translations, _ = cv2.decomposeHomographyMat(homography, np.eye(3))
    return [
        (np.asarray(rotation), np.asarray(translation).ravel() / np.linalg.norm(translation))
        for rotation, translation in zip(rotations, translations, strict=True)
        if np.linalg.norm(translation) > 0.0
    ]


def _evenly_chosen(drive: Drive, pairs: Sequence[PairMatches]) -> list[dict[int, tuple[tuple[int, int], Ints32]]]:
    """Images and matches (n, 2) of two units, the earlier one first, by camera: of some pairs of units.

    From each unit to that which most cameras match, and the farthest of these: there parallax is largest.
    """
    between: dict[tuple[int, int], dict[int, tuple[tuple[int, int], Ints32]]] = {}
    for pair in pairs:
        a, b = (drive.images[image] for image in (pair.image_a, pair.image_b))
        if a.camera == b.camera and a.unit != b.unit and len(pair.matches) >= MIN_INLIERS:
            in_order = a.unit < b.unit
            images = (pair.image_a, pair.image_b) if in_order else (pair.image_b, pair.image_a)
            units = min(a.unit, b.unit), max(a.unit, b.unit)
            between.setdefault(units, {})[a.camera] = images, pair.matches if in_order else pair.matches[:, ::-1]
    last: dict[int, tuple[int, int]] = {}
    for (first, second), cameras in between.items():
        if len(cameras) > 1:
            last[first] = max(last.get(first, (0, 0)), (len(cameras), second))
    starts = sorted(last)
    return [between[starts[k], last[starts[k]][1]] for k in even_choice(len(starts), MAX_MOTIONS).tolist()]


def _direction_along_axis(directions: Mapping[int, Floats], *, without: set[int]) -> float:
    """Sign of the vehicle's motion along its axis by all cameras but some: 1, -1 or 0."""
    return float(np.sign(sum(np.sign(seen @ FORWARD) for camera, seen in directions.items() if camera not in without)))


def _along(direction: Floats, *, signed: bool) -> float:
    """Cosine of the angle between a direction and the vehicle's forward direction or, if not signed, axis."""
    cosine = float(direction @ FORWARD)
    return cosine if signed else abs(cosine)


def _agreeing(directions: Mapping[int, Floats], *, signed: bool) -> set[int]:
    """The most cameras whose directions or, if not signed, axes agree with that of one of them."""
    cameras, seen = [*directions], np.stack([*directions.values()])
    cosine = seen @ seen.T if signed else np.abs(seen @ seen.T)
    near = cosine > np.cos(np.radians(AGREE_DEG))
    return {camera for camera, agrees in zip(cameras, near[int(near.sum(axis=1).argmax())], strict=True) if agrees}
