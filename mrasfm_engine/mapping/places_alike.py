"""Places that look alike, found from matches alone, before there are poses.

Along facades, fences or segments of a tunnel that repeat, what looks most like a point, after more than half a period,
is its copy one period farther on: for the images, the camera went back. An essential matrix is the same for a motion
and for its opposite, so such matches pass it together with right ones, and meet behind the cameras for the motion that
there was. Images of a camera that follow one another are mostly less than half a period apart, and nearly all of their
matches are right. One after the other they say which way the camera moved between images farther apart, and so which
of their matches meet in front of it.

Where more than a few pairs of images show the camera moving the other way, none but those of images that follow one
another are believed: after a whole period copies lie where the points lay, as if they were infinitely far, and after
more of it they meet in front of the cameras as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby
from operator import itemgetter

import cv2
import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.config import MatchConfig
from mrasfm_engine.errors import CancelledError
from mrasfm_engine.geometry.camera_model import pack_cameras
from mrasfm_engine.matching.image_motion import NEXT_UNITS
from mrasfm_engine.matching.prior_verification import MAX_WRONG
from mrasfm_engine.matching.simultaneous import max_error_rad
from mrasfm_engine.matching.verification import signed_parallax
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import PairMatches
from mrasfm_engine.triangulation.tracks import Keypoints
from mrasfm_engine.types import Bools, Cancel, Floats, Ints

# The parallax that shows on which side of the cameras rays meet: more than both ends of a match may be off by.
ENDS = 2.0


@dataclass(frozen=True, kw_only=True)
class SoundPairs:
    """Pairs without the matches that meet behind their cameras.

    Attributes
    ----------
    pairs
        Those that the scene may grow from.
    set_aside
        Those of units around which places look alike, but for images that follow one another.
    alike
        These units (u,).
    told, turned
        How many pairs of a camera's images the images between tell the direction of, and how many of these have most
        matches on the other side.
    """

    pairs: list[PairMatches]
    set_aside: list[PairMatches]
    alike: Bools
    told: int = 0
    turned: int = 0


@dataclass(frozen=True, kw_only=True)
class _TwoViews:
    """Motion of a camera between two of its images, by the essential matrix of their matches.

    Attributes
    ----------
    later_from_earlier
        Rotation (3, 3).
    direction
        (3,) along or against the motion, in the axes of the earlier image.
    side
        (n,) of the inliers: 1 where rays meet in front of the cameras if the motion is along `direction`, -1 if it is
        against it, 0 where they do not tell.
    """

    later_from_earlier: Floats
    direction: Floats
    side: NDArray[np.int8]

    @cached_property
    def votes(self) -> tuple[int, int]:
        """Number of matches that meet in front for a motion along the direction, and against it."""
        return int(np.count_nonzero(self.side > 0)), int(np.count_nonzero(self.side < 0))

    @property
    def majority(self) -> int:
        """The sign that most matches have; 0 without any."""
        along, against = self.votes
        return int(np.sign(along - against))


def sound_pairs(
    drive: Drive,
    keypoints: Keypoints,
    pairs: Sequence[PairMatches],
    config: MatchConfig,
    cancel: Cancel | None = None,
) -> SoundPairs:
    """Leave out the matches of following units that meet behind their cameras, and pairs of places that look alike.

    Raises
    ------
    CancelledError
        Where `cancel` answers True.
    """
    focal_px, images = pack_cameras(drive.cameras)[1][:, :2].mean(axis=1), drive.images
    views = {}
    for n, pair in enumerate(pairs):
        if cancel is not None and cancel():
            raise CancelledError
        if pair.essential is not None and images[pair.image_a].camera == images[pair.image_b].camera:
            max_error = max_error_rad(drive, pair.image_a, pair.image_b, focal_px, config)
            views[n] = _two_views(pair.essential, *_rays(keypoints, pair), max_error=max_error)
    return _Judge(drive, pairs, views, config.min_matches).judged()


def _rays(keypoints: Keypoints, pair: PairMatches) -> tuple[Floats, Floats]:
    """Viewing rays (n, 3) of a pair's inliers."""
    a, b = pair.matches[pair.inliers].T.astype(np.int64)
    first = keypoints.first
    return keypoints.rays.take(first[pair.image_a] + a, axis=0), keypoints.rays.take(first[pair.image_b] + b, axis=0)


def _two_views(essential: Floats, earlier: Floats, later: Floats, *, max_error: float) -> _TwoViews:
    """The motion by an essential matrix, and what inliers (n, 3) say of its direction."""
    *rotations, direction_in_later = cv2.decomposeEssentialMat(essential)
    # Of the two, one is turned by half a circle about the motion: not what a camera sees the same after.
    turn = np.asarray(max(rotations, key=np.trace), dtype=np.float64)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, np.ravel(direction_in_later)
    parallax = signed_parallax(pose, earlier, later)
    side = np.sign(np.where(np.abs(parallax) > ENDS * max_error, parallax, 0.0)).astype(np.int8)
    return _TwoViews(later_from_earlier=turn, direction=-turn.T @ pose[:3, 3], side=side)


@dataclass(frozen=True, kw_only=True)
class _Chain:
    """Motions of a camera from image to image.

    Attributes
    ----------
    link
        Number (k,) of the stretch without a gap that an image belongs to.
    common_from_image
        Rotations (k, 3, 3) to axes that a stretch has in common.
    motion
        Directions (k - 1, 3) from each image to the next one in these axes; zeros where there is none, or no image
        tells.
    """

    link: Ints
    common_from_image: Floats
    motion: Floats

    @staticmethod
    def of_steps(count: int, steps: Mapping[int, _TwoViews], min_matches: int) -> _Chain:
        """The chain of some images, given what each and the next one show, by the earlier one's place."""
        link, turns = np.zeros(count, dtype=np.int64), np.tile(np.eye(3), (count, 1, 1))
        motion, is_clear = np.zeros((count - 1, 3)), np.zeros(count - 1, dtype=np.bool_)
        for k in range(count - 1):
            step = steps.get(k)
            link[k + 1] = link[k] + (step is None)
            if step is None:
                continue
            turns[k + 1] = turns[k] @ step.later_from_earlier.T
            fewer, more = sorted(step.votes)
            if fewer + more >= min_matches:
                motion[k] = turns[k] @ step.direction * step.majority
                is_clear[k] = fewer <= MAX_WRONG * (fewer + more)
        _follow_clear(motion, is_clear, link)
        return _Chain(link=link, common_from_image=turns, motion=motion)

    def sign(self, view: _TwoViews, first: int, last: int) -> int:
        """1 where the camera moved along a view's direction between two images, -1 for against it, 0 if unknown.

        The way between two images is a sum of the motions, each in its direction: one of them, at least, is less than a
        right angle from it.
        """
        if self.link[first] != self.link[last]:
            return 0
        along = self.motion[first:last] @ (self.common_from_image[first] @ view.direction)
        along = along[along != 0.0]
        return int(np.sign(along[0])) if len(along) and (np.sign(along) == np.sign(along[0])).all() else 0


def _follow_clear(motion: Floats, is_clear: Bools, link: Ints) -> None:
    """Turn motions (n, 3) whose own matches do not agree on a sign the way that the clear ones around them go."""
    clear = np.flatnonzero(is_clear)
    for k in np.flatnonzero(~is_clear & motion.any(axis=1)).tolist():
        after = int(np.searchsorted(clear, k))
        around = [c for c in clear[max(after - 1, 0) : after + 1].tolist() if link[c] == link[k]]
        signs = {float(np.sign(motion[c] @ motion[k])) for c in around}
        if signs == {-1.0}:
            motion[k] *= -1.0


@dataclass
class _Judge:
    """Judges pairs by the motions between images of a camera that follow one another."""

    drive: Drive
    pairs: Sequence[PairMatches]
    views: Mapping[int, _TwoViews]  # of pairs of one camera, by their place among the pairs
    min_matches: int
    place: dict[int, int] = field(default_factory=dict)  # of an image among those of its camera that have a view
    chains: dict[int, _Chain] = field(default_factory=dict)  # by camera

    def __post_init__(self) -> None:
        images: dict[int, set[int]] = {}
        for n in self.views:
            images.setdefault(self._camera(n), set()).update((self.pairs[n].image_a, self.pairs[n].image_b))
        for of_camera in images.values():
            self.place |= {image: k for k, image in enumerate(sorted(of_camera))}
        steps: dict[int, dict[int, _TwoViews]] = {camera: {} for camera in images}
        for n, view in self.views.items():
            first, last = self._places(n)
            if last == first + 1:
                steps[self._camera(n)][first] = view
        for camera, of_camera in images.items():
            self.chains[camera] = _Chain.of_steps(len(of_camera), steps[camera], self.min_matches)

    def judged(self) -> SoundPairs:
        """The pairs without the matches on the wrong side, and apart from them those of places that look alike."""
        result = dict(enumerate(self.pairs))
        told, turned = list[tuple[int, int]](), list[tuple[int, int]]()
        for n, view in self.views.items():
            pair, (first, last) = self.pairs[n], self._places(n)
            sign = self.chains[self._camera(n)].sign(view, first, last)
            if sign and last > first + 1 and sum(view.votes) >= self.min_matches:
                told.append(self._units(pair))
                turned += [self._units(pair)] if view.majority == -sign else []
            inliers = pair.inliers.copy()
            inliers[inliers] = view.side != -(sign or view.majority or 1)
            if inliers.sum() >= self.min_matches:
                result[n] = replace(pair, inliers=inliers)
            else:
                del result[n]
        units = len(self.drive.timestamps_us)
        alike = _spanning(turned, units) > MAX_WRONG * _spanning(told, units)
        believed = self._believed(result, alike)
        return SoundPairs(
            pairs=[pair for n, pair in result.items() if n in believed],
            set_aside=[pair for n, pair in result.items() if n not in believed],
            alike=alike,
            told=len(told),
            turned=len(turned),
        )

    def _believed(self, pairs: Mapping[int, PairMatches], alike: Bools) -> set[int]:
        """Pairs that the scene may grow from: where places look alike, those that link units by the shortest ways.

        Of images that follow one another, ones that several missing images lie between may be a period apart.
        """
        result, following = set[int](), list[tuple[int, int]]()
        for n, pair in pairs.items():
            first, last = self._units(pair)
            if first == last or not (alike[first] or alike[last]):
                result.add(n)
            elif n in self.views and self._places(n)[1] == self._places(n)[0] + 1:
                following.append((last - first, n))
        linked = np.arange(len(alike))
        for _, group in groupby(sorted(following), key=itemgetter(0)):
            new = [n for gap, n in group if gap <= NEXT_UNITS or not np.equal(*linked[list(self._units(pairs[n]))])]
            result.update(new)
            for n in new:
                first, last = linked[list(self._units(pairs[n]))]
                if first != last:
                    linked[linked == last] = first
        return result

    def _camera(self, n: int) -> int:
        return self.drive.images[self.pairs[n].image_a].camera

    def _units(self, pair: PairMatches) -> tuple[int, int]:
        return self.drive.images[pair.image_a].unit, self.drive.images[pair.image_b].unit

    def _places(self, n: int) -> tuple[int, int]:
        return self.place[self.pairs[n].image_a], self.place[self.pairs[n].image_b]


def _spanning(spans: Sequence[tuple[int, int]], units: int) -> Ints:
    """Number of spans of units, both ends included, that each unit (units,) is in."""
    begin, end = np.array(spans, dtype=np.int64).reshape(-1, 2).T
    result: Ints = np.cumsum(np.bincount(begin, minlength=units + 1) - np.bincount(end + 1, minlength=units + 1))[:-1]
    return result
