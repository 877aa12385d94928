"""Check on the first units, before the long work, that `rig_from_cam` is given the right way round, and that no two
cameras have each other's images.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import numpy as np

from mrasfm_engine.config import MatchConfig
from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_cameras, unproject_pixels
from mrasfm_engine.io.axes import flu_from_body as flu_from_axes
from mrasfm_engine.matching.exchanged_cameras import Exchange, exchanged_error, exchanges
from mrasfm_engine.matching.prepared_images import Matcher
from mrasfm_engine.matching.simultaneous import LARGEST_TURN_DEG
from mrasfm_engine.matching.verification import (
    direction_of_motion,
    epipolar_errors,
    essential_inliers,
    in_front_of_both,
    parallax_rad,
    relative_pose,
)
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.types import Floats, Ints, Ints32
from schemas import BodyAxes

MIN_INLIERS = 50
MIN_PARALLAX_RAD = np.radians(0.3)  # about 3 px at a focal length of 600 px
MOTION_ERROR = 2e-3  # of a match between two units, in the plane z = 1
PAIR_ERROR_PX = 4.0  # from the epipolar line of a calibration that is the right way round
AGREE_DEG = 10.0  # between two cameras' directions of motion, of a small parallax and a calibration of some degrees
CLEARLY_BETTER, CLEARLY_WORSE = 0.9, 0.75  # agreement of another reading, and of what was given, for a verdict
MIN_BASELINE_RAD = np.radians(0.15)  # parallax between two cameras: noise and a rough calibration reverse less
SAME_BASELINE = 0.5  # cosine of the angle between two baselines, 60 deg: along the view matches say little of it
MIN_EVIDENCE = 2  # unit pairs, or image pairs, that must say so


class _Reading(Enum):
    """Another pose that the numbers of `rig_from_cam` may have meant: name, code and remedy."""

    INVERSE = (
        "its inverse, cam_from_rig",
        "calibration-inverted",
        "Give the camera's pose in the rig: its translation is where the camera sits on the vehicle.",
    )
    QUATERNION_ORDER = (
        "a pose with its quaternion in the order w, x, y, z",
        "quaternion-order",
        "Give rotation_xyzw in the order x, y, z, w.",
    )


def require_calibration_direction(
    drive: Drive, images: Sequence[int], features: Sequence[ImageFeatures], matcher: Matcher, config: MatchConfig
) -> None:
    """Refuse a rig whose inverse, or whose quaternions in another order, explain the images clearly better, and one
    that explains them if two cameras are exchanged.

    Two signs are looked for. Most cameras must find the car moving in one direction of the rig; under the inverse of
    differently turned cameras they don't. And matches between cameras of one unit must lie near their epipolar lines
    and in front of both cameras; with the baseline reversed they don't. The numbers may have been written in any axes
    that a manifest can have, before they became the engine's.

    The second sign alone shows that cameras are exchanged: the first one is of few units here (see
    `exchanged_by_motion`). To two cameras an exchange is what the inverse is. All that explain the images are named.

    Parameters
    ----------
    images, features
        Indices of some images of the drive's first units, and their features.

    Raises
    ------
    InputError
        Where the calibration is the wrong way round, its quaternions are in another order, or cameras are exchanged.
    """
    found = _FirstUnits(drive, images, features, matcher, config)
    given_ok, better = _better_readings(found, drive.rig_from_cam)
    exchanged = found.exchanges_by_depth()
    if exchanged:
        better = [one for one in better if found.worst_share(one.rig_from_cam) >= CLEARLY_WORSE]
    elif better:
        exchanged = found.exchanges_by_motion()
    if better:
        raise _misread(found.names, given_ok, better, exchanged)
    if exchanged:
        cameras = len(found.names)
        shares = [found.worst_share(drive.rig_from_cam, one.taken_by(cameras)) for one in exchanged]
        best = int(np.argmax(shares))
        raise exchanged_error(
            found.names,
            exchanged[best],
            f"if they are, simultaneous images of any two cameras fit rig.cameras by {shares[best]:.0%} of their "
            f"matches and more, as given those of some by {found.worst_share(drive.rig_from_cam):.0%}",
        )


@dataclass(frozen=True)
class _Better:
    """A reading, its poses (c, 4, 4), and how well they agree with the images: 0 to 1."""

    reading: _Reading
    rig_from_cam: Floats
    agreement: float


def _better_readings(found: _FirstUnits, rig_from_cam: Floats) -> tuple[float, list[_Better]]:
    """Agreement of what was given, and those readings that agree clearly better: the best of each kind, in order."""
    readings = [*_readings(rig_from_cam)]
    rigs = [rig_from_cam, *(rig for _, rig in readings)]
    for evidence in (found.motion_agreement(rigs), found.depth_agreement(rigs)):
        if len(evidence) >= MIN_EVIDENCE:
            given_ok, *others_ok = np.median(np.array(evidence), axis=0)
            others = [_Better(kind, rig, float(ok)) for ok, (kind, rig) in zip(others_ok, readings, strict=True)]
            others.sort(key=lambda other: -other.agreement)
            better: dict[_Reading, _Better] = {}
            for other in others:
                if other.agreement > CLEARLY_BETTER:
                    better.setdefault(other.reading, other)
            if given_ok < CLEARLY_WORSE and better:
                return float(given_ok), [*better.values()]
    return 1.0, []


def _misread(
    names: Sequence[str], given_ok: float, better: Sequence[_Better], exchanged: Sequence[Exchange]
) -> InputError:
    """The error of a rig that other readings explain, with the exchanges of two cameras that do so as well."""
    name, code, _ = better[0].reading.value
    sentences = [
        f"rig_from_cam looks like {name}",
        *(f"the images of cameras {one.both(names)} look exchanged" for one in exchanged),
    ]
    remedies = [*(one.reading.value[2] for one in better), *(one.remedy(names) for one in exchanged)]
    otherwise = "" if exchanged else " Check as well that no two cameras' images are swapped."
    return InputError(
        f"rig.cameras: {', or '.join(sentences)}: the first units agree {better[0].agreement:.0%} with that and "
        f"{given_ok:.0%} with what is given",
        remedy=f"{' If it is not that: '.join(remedies)}{otherwise}",
        code=code,
    )


@dataclass(frozen=True)
class _ImagePair:
    """Numbers of two images of one unit, and the keypoints (n, 2) of their verified matches."""

    image_a: int
    image_b: int
    matches: Ints32


@dataclass(frozen=True)
class _Simultaneous:
    """Pairs of simultaneous images of two cameras, and their baseline where they contradict the given poses.

    The baseline is the direction (3,) of b_from_a that images alone show. Parallel cameras that are in truth turned
    apart by 2 deg see what is far behind them, as if each had the other one's place: another reading has to explain the
    baseline as well.
    """

    pairs: Sequence[_ImagePair]
    baseline: Floats | None = None


class _FirstUnits:
    """Images of some units, and what poses of the cameras explain of their matches."""

    def __init__(
        self,
        drive: Drive,
        images: Sequence[int],
        features: Sequence[ImageFeatures],
        matcher: Matcher,
        config: MatchConfig,
    ) -> None:
        self._kinds, self._params = pack_cameras(drive.cameras)
        self._rig, self._features, self._matcher = drive.rig_from_cam, features, matcher
        self._max_error = config.max_error_px / float(self._params[:, 0].min())
        self._camera = [drive.images[i].camera for i in images]
        self._prepared = [
            matcher.prepare(f, width=drive.cameras[c].width, height=drive.cameras[c].height)
            for f, c in zip(features, self._camera, strict=True)
        ]
        self._rays_of: dict[tuple[int, int], Floats] = {}
        self._where = {(drive.images[i].unit, drive.images[i].camera): k for k, i in enumerate(images)}
        self.names = [camera.name for camera in drive.cameras]

    @cached_property
    def _motions(self) -> list[dict[int, Floats]]:
        """Direction (3,) in which each camera sees itself move, in its own axes, by pair of units."""
        result = []
        for unit in sorted({unit for unit, _ in self._where}):
            directions = {}
            for camera in range(len(self._rig)):
                if (unit, camera) in self._where and (unit + 1, camera) in self._where:
                    direction = self._direction(self._where[unit, camera], self._where[unit + 1, camera])
                    if direction is not None:
                        directions[camera] = direction
            if len(directions) > 1:
                result.append(directions)
        return result

    @cached_property
    def _simultaneous(self) -> dict[tuple[int, int], _Simultaneous]:
        """Simultaneous images of two cameras; of none that contradict the given poses by what noise may do."""
        matched: dict[tuple[int, int], list[_ImagePair]] = {}
        for (unit, ca), a in self._where.items():
            for cb in range(ca + 1, len(self._rig)):
                b = self._where.get((unit, cb))
                if b is not None and (matches := self._verified(a, b)) is not None:
                    matched.setdefault((ca, cb), []).append(_ImagePair(a, b, matches))
        result = {}
        for cameras, pairs in matched.items():
            found = _Simultaneous(pairs)
            if self._median_share(found, self._rig) < CLEARLY_WORSE:
                baseline = self._baseline(pairs)
                if baseline is None:
                    continue
                found = _Simultaneous(pairs, baseline)
            result[cameras] = found
        return result

    def _baseline(self, pairs: Sequence[_ImagePair]) -> Floats | None:
        """Direction (3,) of b_from_a that the images of two cameras show; None for cameras too near one another."""
        rays_a = np.concatenate([self._own_rays(one.image_a)[one.matches[:, 0]] for one in pairs])
        rays_b = np.concatenate([self._own_rays(one.image_b)[one.matches[:, 1]] for one in pairs])
        if parallax_rad(rays_a, rays_b) < MIN_BASELINE_RAD:
            return None
        pose = relative_pose(rays_a, rays_b, max_error=self._max_error)
        return None if pose is None else pose[1]

    def motion_agreement(self, rigs: Sequence[Floats]) -> list[list[float]]:
        """Agreement of the cameras' directions of motion under each of some rigs, by pair of units.

        The first rig was given and may be rough, and of two cameras neither is in the majority; what is meant instead
        has to fit.
        """
        result = []
        for motion in self._motions:
            most_deg = LARGEST_TURN_DEG + AGREE_DEG if len(motion) > 2 else 180.0
            directions = [np.array([rig[camera, :3, :3] @ motion[camera] for camera in motion]) for rig in rigs]
            given, *others = directions
            result.append([_agreement(given, most_deg), *(_agreement(of_rig, AGREE_DEG) for of_rig in others)])
        return result

    def depth_agreement(self, rigs: Sequence[Floats]) -> list[list[float]]:
        """Share of the matches of two cameras that each of some rigs explains, by pair of simultaneous images.

        The first rig was given, and may be turned.
        """
        given, *others = rigs
        return [
            [self._share(one, given), *(self._share(one, rig, baseline=found.baseline) for rig in others)]
            for found in self._simultaneous.values()
            for one in found.pairs
        ]

    def worst_share(self, rig_from_cam: Floats, taken_by: Ints | None = None) -> float:
        """Share of their matches that a rig explains, of the two cameras of which it explains least.

        Images may be taken by other cameras (c,) than those that list them.
        """
        several = [found for found in self._simultaneous.values() if len(found.pairs) >= MIN_EVIDENCE]
        return min((self._median_share(found, rig_from_cam, taken_by) for found in several), default=1.0)

    def exchanges_by_depth(self) -> list[Exchange]:
        """Exchanges of two cameras that explain the matches of each with any other, where what is given does not.

        Both contradict what is given: where one camera alone is given wrong, another one that takes its place
        contradicts what was right.
        """
        given = {cameras: self._median_share(of, self._rig) for cameras, of in self._simultaneous.items()}
        against = [
            cameras
            for cameras, share in given.items()
            if share < CLEARLY_WORSE and len(self._simultaneous[cameras].pairs) >= MIN_EVIDENCE
        ]
        doubted = {camera for cameras in against for camera in cameras}
        return [
            one
            for one in exchanges(len(self._rig))
            if doubted >= {one.camera_a, one.camera_b} and self._explains_its_cameras(one)
        ]

    def exchanges_by_motion(self) -> list[Exchange]:
        """Exchanges under which the cameras' directions of motion agree, and which no matches contradict."""
        every = [*exchanges(len(self._rig))]
        evidence = self.motion_agreement([self._rig, *(one.poses(self._rig) for one in every)])
        if len(evidence) < MIN_EVIDENCE:
            return []
        agreement = np.median(np.array(evidence), axis=0)[1:]
        return [
            one
            for one, agrees in zip(every, agreement, strict=True)
            if agrees > CLEARLY_BETTER and self.worst_share(self._rig, one.taken_by(len(self._rig))) >= CLEARLY_WORSE
        ]

    def _explains_its_cameras(self, exchange: Exchange) -> bool:
        """True where an exchange explains the matches of its cameras with any other; of near ones noise may not."""
        taken_by, own = exchange.taken_by(len(self._rig)), {exchange.camera_a, exchange.camera_b}
        concerned = [of for cameras, of in self._simultaneous.items() if own & set(cameras)]
        shares = [self._median_share(of, self._rig, taken_by) for of in concerned]
        return min(shares) >= CLEARLY_WORSE and float(np.mean(shares)) > CLEARLY_BETTER

    def _median_share(self, found: _Simultaneous, rig_from_cam: Floats, taken_by: Ints | None = None) -> float:
        shares = [self._share(one, rig_from_cam, taken_by, baseline=found.baseline) for one in found.pairs]
        return float(np.median(shares))

    def _share(
        self,
        one: _ImagePair,
        rig_from_cam: Floats,
        taken_by: Ints | None = None,
        *,
        baseline: Floats | None = None,
    ) -> float:
        """Share of the matches of two images that a rig explains; none if it contradicts their baseline."""
        images = one.image_a, one.image_b
        listed = self._camera[one.image_a], self._camera[one.image_b]
        a, b = listed if taken_by is None else taken_by[list(listed)].tolist()
        if baseline is not None:
            b_from_a = se3.inverse(rig_from_cam[b]) @ rig_from_cam[a]
            if _cosine(b_from_a[:3, 3], baseline) < SAME_BASELINE:
                return 0.0
        rays_a, rays_b = (
            self._rays(k, camera)[rows] for k, camera, rows in zip(images, (a, b), one.matches.T, strict=True)
        )
        gate = PAIR_ERROR_PX / float(self._params[[a, b], 0].min())
        return share_explained(rig_from_cam[a], rig_from_cam[b], rays_a, rays_b, gate)

    def _own_rays(self, image: int) -> Floats:
        return self._rays(image, self._camera[image])

    def _rays(self, image: int, camera: int) -> Floats:
        """Rays (n, 3) of an image's keypoints through the lens of a camera."""
        if (image, camera) not in self._rays_of:
            xy_px = self._features[image].xy_px
            self._rays_of[image, camera] = unproject_pixels(int(self._kinds[camera]), self._params[camera], xy_px)
        return self._rays_of[image, camera]

    def _verified(self, a: int, b: int) -> Ints32 | None:
        """Matches (n, 2) of two images that agree with an essential matrix; None where they are few."""
        matches = self._matcher.match(self._prepared[a], self._prepared[b])
        rays_a, rays_b = (self._own_rays(k)[rows] for k, rows in zip((a, b), matches.T, strict=True))
        good = essential_inliers(rays_a, rays_b, max_error=self._max_error)
        return matches[good] if good.sum() >= MIN_INLIERS else None

    def _direction(self, a: int, b: int) -> Floats | None:
        """Direction (3,) from an image of a camera to its next one; None for a standing car: it moves in any."""
        matches = self._verified(a, b)
        if matches is None:
            return None
        rays = [self._own_rays(k)[rows] for k, rows in zip((a, b), matches.T, strict=True)]
        return None if parallax_rad(*rays) < MIN_PARALLAX_RAD else _direction(*rays)


def _agreement(directions: Floats, within_deg: float) -> float:
    """Share of unit vectors (n, 3) that agree with one of them, less what they differ by: 0 to 1.

    A vehicle that overtakes fills one camera's image and turns its direction around. The mean of all would be shorter
    under the right rig, where the others agree to a degree, than under one that scatters all of them.
    """
    near = directions @ directions.T >= np.cos(np.radians(within_deg))
    most = near[int(near.sum(axis=1).argmax())]
    return float(np.linalg.norm(directions[most].sum(axis=0)) / len(directions))


def _readings(rig_from_cam: Floats) -> Iterator[tuple[_Reading, Floats]]:
    """Poses that were meant, if the numbers were written in another way, in any axes that a manifest can have."""
    for flu_from_body in map(flu_from_axes, BodyAxes):
        given = se3.inverse(flu_from_body) @ rig_from_cam
        yield _Reading.INVERSE, flu_from_body @ se3.inverse(given)
        wxyz = se3.quaternion_from_rotation(given[..., :3, :3])
        meant = se3.rotation_from_quaternion(np.roll(wxyz, -1, axis=-1))
        # Where the order hardly matters, another one may fit better by chance, and the given one is off by as little.
        if se3.rotation_angle_deg(np.swapaxes(given[..., :3, :3], -1, -2) @ meant).max() > LARGEST_TURN_DEG:
            yield _Reading.QUATERNION_ORDER, flu_from_body @ se3.transform(meant, given[..., :3, 3])


def share_explained(rig_from_a: Floats, rig_from_b: Floats, rays_a: Floats, rays_b: Floats, gate: float) -> float:
    """Share of matches whose rays (n, 3) lie within `gate` (rad) of their epipolar planes and meet before both cameras.

    The cameras' poses in the rig are (4, 4).
    """
    b_from_a = se3.inverse(rig_from_b) @ rig_from_a
    near = epipolar_errors(b_from_a, rays_a, rays_b) < gate
    return float((near & in_front_of_both(b_from_a, rays_a, rays_b)).mean())


def _cosine(a: Floats, b: Floats) -> float:
    """Cosine of the angle between two vectors (3,); 0 for none."""
    return float(a @ b) / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-9)


def _direction(rays_a: Floats, rays_b: Floats) -> Floats | None:
    """Direction from camera a to camera b: a unit vector."""
    found = relative_pose(rays_a, rays_b, max_error=MOTION_ERROR, confidence=0.999)
    return None if found is None else direction_of_motion(found)
