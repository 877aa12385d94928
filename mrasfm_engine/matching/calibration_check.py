"""Check on the first units, before the long work, that `rig_from_cam` is not given as its inverse."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from mrasfm_engine.config import MatchConfig
from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_cameras, unproject_pixels
from mrasfm_engine.io.axes import flu_from_body
from mrasfm_engine.matching.prepared_images import Matcher
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
CLEARLY_BETTER, CLEARLY_WORSE = 0.9, 0.75  # agreement of the inverse, and of what was given, for a verdict
MIN_EVIDENCE = 2  # unit pairs, or image pairs, that must say so


def require_calibration_direction(
    drive: Drive, images: Sequence[int], features: Sequence[ImageFeatures], matcher: Matcher, config: MatchConfig
) -> None:
    """Refuse a rig whose inverse explains the images clearly better.

    Two signs are looked for. All cameras must find the car moving in one direction of the rig; under the inverse of
    differently turned cameras they don't. And matches between cameras of one unit must lie near their epipolar lines
    and in front of both cameras; with the baseline reversed they don't. The inverse may have been taken in any axes
    that a manifest can have, before they became the engine's.

    Parameters
    ----------
    images, features
        Indices of some images of the drive's first units, and their features.

    Raises
    ------
    InputError
        Where the calibration is the wrong way round.
    """
    kinds, params = pack_cameras(drive.cameras)
    cameras = [drive.cameras[drive.images[i].camera] for i in images]
    prepared = [matcher.prepare(f, width=c.width, height=c.height) for f, c in zip(features, cameras, strict=True)]
    rays = [
        unproject_pixels(int(kinds[drive.images[i].camera]), params[drive.images[i].camera], f.xy_px)
        for i, f in zip(images, features, strict=True)
    ]
    rigs = [drive.rig_from_cam, *_inverses(drive.rig_from_cam)]
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
            given_ok, *inverse = np.median(np.array(evidence), axis=0)
            inverse_ok = max(inverse)
            if inverse_ok > CLEARLY_BETTER and given_ok < CLEARLY_WORSE:
                raise InputError(
                    "rig.cameras: rig_from_cam looks like its inverse, cam_from_rig: the first units agree "
                    f"{inverse_ok:.0%} with the inverse and {given_ok:.0%} with what is given",
                    remedy="Give the camera's pose in the rig: its translation is where the camera sits on the "
                    "vehicle. Check as well that no two cameras' images are swapped.",
                    code="calibration-inverted",
                )


def _motion_agreement(
    rigs: Sequence[Floats],
    unit: int,
    where: dict[tuple[int, int], int],
    verified: Callable[[int, int], tuple[Floats, Floats] | None],
) -> list[float] | None:
    """Length (0..1) of the mean of the cameras' directions of motion in every hypothesis of the rig."""
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
    return [float(length) for length in np.linalg.norm(np.array(directions).mean(0), axis=1)]


def _inverses(rig_from_cam: Floats) -> list[Floats]:
    """Poses that were meant, if the inverse was given in forward-left-up, right-down-forward or forward-right-down
    axes.
    """
    return [flu @ se3.inverse(se3.inverse(flu) @ rig_from_cam) for flu in map(flu_from_body, BodyAxes)]


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
