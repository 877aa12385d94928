"""Check on the first units, before the long work, that `rig_from_cam` is given the right way round."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from enum import Enum

import numpy as np

from mrasfm_engine.config import MatchConfig
from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_cameras, unproject_pixels
from mrasfm_engine.io.axes import flu_from_body as flu_from_axes
from mrasfm_engine.matching.prepared_images import Matcher
from mrasfm_engine.matching.simultaneous import LARGEST_TURN_DEG
from mrasfm_engine.matching.verification import (
    epipolar_errors,
    essential_inliers,
    in_front_of_both,
    parallax_rad,
    relative_pose,
)
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.types import Floats
from schemas import BodyAxes

MIN_INLIERS = 50
MIN_PARALLAX_RAD = np.radians(0.3)  # about 3 px at a focal length of 600 px
MOTION_ERROR = 2e-3  # of a match between two units, in the plane z = 1
PAIR_ERROR_PX = 4.0  # from the epipolar line of a calibration that is the right way round
AGREE_DEG = 10.0  # between two cameras' directions of motion, of a small parallax and a calibration of some degrees
CLEARLY_BETTER, CLEARLY_WORSE = 0.9, 0.75  # agreement of another reading, and of what was given, for a verdict
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
    """Refuse a rig whose inverse, or whose quaternions in another order, explain the images clearly better.

    Two signs are looked for. Most cameras must find the car moving in one direction of the rig; under the inverse of
    differently turned cameras they don't. And matches between cameras of one unit must lie near their epipolar lines
    and in front of both cameras; with the baseline reversed they don't. The numbers may have been written in any axes
    that a manifest can have, before they became the engine's.

    Parameters
    ----------
    images, features
        Indices of some images of the drive's first units, and their features.

    Raises
    ------
    InputError
        Where the calibration is the wrong way round, or its quaternions are in another order.
    """
    kinds, params = pack_cameras(drive.cameras)
    cameras = [drive.cameras[drive.images[i].camera] for i in images]
    prepared = [matcher.prepare(f, width=c.width, height=c.height) for f, c in zip(features, cameras, strict=True)]
    rays = [
        unproject_pixels(int(kinds[drive.images[i].camera]), params[drive.images[i].camera], f.xy_px)
        for i, f in zip(images, features, strict=True)
    ]
    readings = [*_readings(drive.rig_from_cam)]
    rigs = [drive.rig_from_cam, *(rig for _, rig in readings)]
    where = {(drive.images[i].unit, drive.images[i].camera): k for k, i in enumerate(images)}

    def verified(a: int, b: int) -> tuple[Floats, Floats] | None:
        matches = matcher.match(prepared[a], prepared[b])
        ra, rb = rays[a][matches[:, 0]], rays[b][matches[:, 1]]
        good = essential_inliers(ra, rb, max_error=config.max_error_px / float(params[:, 0].min()))
        return (ra[good], rb[good]) if good.sum() >= MIN_INLIERS else None

    by_motion = [
        agreement
        for u in sorted({unit for unit, _ in where})
        if (agreement := _motion_agreement(rigs, u, where, verified)) is not None
    ]
    by_depth = []
    for (u, ca), a in where.items():
        for cb in range(ca + 1, len(drive.cameras)):
            if (u, cb) in where and (found := verified(a, where[u, cb])) is not None:
                gate = PAIR_ERROR_PX / float(params[[ca, cb], 0].min())
                by_depth.append([share_explained(rig[ca], rig[cb], *found, gate) for rig in rigs])
    for evidence in (by_motion, by_depth):
        if len(evidence) >= MIN_EVIDENCE:
            given_ok, *others_ok = np.median(np.array(evidence), axis=0)
            if given_ok < CLEARLY_WORSE:
                _require_no_better(
                    float(given_ok), [(float(ok), kind) for ok, (kind, _) in zip(others_ok, readings, strict=True)]
                )


def _require_no_better(given_ok: float, others: Sequence[tuple[float, _Reading]]) -> None:
    """Refuse what was given where another reading agrees clearly better; of two that do, both are named."""
    best = {kind: max((ok for ok, other in others if other is kind), default=0.0) for kind in _Reading}
    better = sorted((kind for kind in best if best[kind] > CLEARLY_BETTER), key=lambda kind: -best[kind])
    if not better:
        return
    name, code, _ = better[0].value
    remedies = [kind.value[2] for kind in better]
    raise InputError(
        f"rig.cameras: rig_from_cam looks like {name}: the first units agree {best[better[0]]:.0%} with that and "
        f"{given_ok:.0%} with what is given",
        remedy=f"{' If it is not that: '.join(remedies)} Check as well that no two cameras' images are swapped.",
        code=code,
    )


def _motion_agreement(
    rigs: Sequence[Floats],
    unit: int,
    where: dict[tuple[int, int], int],
    verified: Callable[[int, int], tuple[Floats, Floats] | None],
) -> list[float] | None:
    """Agreement (0..1) of the cameras' directions of motion in every hypothesis of the rig."""
    directions = []
    for camera in range(len(rigs[0])):
        if (unit, camera) not in where or (unit + 1, camera) not in where:
            continue
        found = verified(where[unit, camera], where[unit + 1, camera])
        if found is None or parallax_rad(*found) < MIN_PARALLAX_RAD:
            continue  # a standing car moves in any direction
        direction = _direction(*found)
        if direction is not None:
            directions.append([rig[camera, :3, :3] @ direction for rig in rigs])
    if len(directions) < 2:
        return None
    given, *others = np.swapaxes(np.array(directions), 0, 1)
    # What was given may be rough, and of two cameras neither is in the majority; what is meant instead has to fit.
    most_deg = LARGEST_TURN_DEG + AGREE_DEG if len(directions) > 2 else 180.0
    return [_agreement(given, most_deg), *(_agreement(of_rig, AGREE_DEG) for of_rig in others)]


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


def _direction(rays_a: Floats, rays_b: Floats) -> Floats | None:
    """Direction from camera a to camera b: a unit vector."""
    found = relative_pose(rays_a, rays_b, max_error=MOTION_ERROR, confidence=0.999)
    if found is None:
        return None
    rotation, translation = found
    result: Floats = -(rotation.T @ translation)
    return result
