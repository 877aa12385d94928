"""Relocalisation of several units of one scene in another, and the transform on which they agree.

Every unit of scene b that observes points of scene a gets a pose in a by generalised PnP over its cameras. Each pose is
a hypothesis of the transform: a_from_b = a_from_rig * inverse(b_from_rig). One unit alone can be wrong: a repeated
facade gives it a perfect pose at another house. So the hypothesis with which most units agree wins. It needs a clear
majority of the units with enough matches, and no second hypothesis may have a similar number of inliers: every unit is
relocalised again from the matches that do not fit, and several units with a good second pose mean a repeated structure.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from mrasfm_engine.aggregation.source import SourceScene, scaled
from mrasfm_engine.config import AggregationConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_cameras, reprojection_errors_focal
from mrasfm_engine.geometry.colmap_cameras import SolverCameras
from mrasfm_engine.mapping.resection import resect
from mrasfm_engine.types import Bools, Floats, Ints

MAX_ERROR_FOCAL = 0.012  # of the focal length: reprojection error of an inlier between two scenes, which may be bent
MIN_SHARE = 0.35  # of a unit's matches that must fit, for it to agree
MIN_MAJORITY = 0.5  # of the units that have something to say
MAX_RUNNER_UP = 0.5  # of the winner's units for which another place may be nearly as good
RIVAL_SHARE = 0.3  # of a unit's inliers at the winner's place that make another place nearly as good
SAME_PLACE_M, SAME_PLACE_DEG = 1.5, 4.0  # hypotheses nearer than that are one place
TRIALS = 2000


@dataclass(frozen=True, kw_only=True)
class Matches2D3D:
    """Observations of scene a's points in images of scene b."""

    unit: Ints  # (n,) of b
    image: Ints  # (n,) of b
    xy_px: Floats  # (n, 2)
    points_m: Floats  # (n, 3) in a's frame

    def select(self, rows: Ints | Bools) -> Matches2D3D:
        """Select some of them."""
        return Matches2D3D(
            unit=self.unit[rows], image=self.image[rows], xy_px=self.xy_px[rows], points_m=self.points_m[rows]
        )


@dataclass(frozen=True, kw_only=True)
class Relocalization:
    """Transform from b to a with the units that agree on it; where they do not agree, the reason says why."""

    a_from_b: Floats | None
    reason: str
    units_tried: int  # units with matches enough to have something to say
    units_agreeing: tuple[int, ...]  # units of b
    runner_up: int  # units for which the best other place is nearly as good
    inliers: int  # image points that fit


def matches_2d3d(a: SourceScene, b: SourceScene, keypoints_a: Ints, keypoints_b: Ints) -> Matches2D3D:
    """Matches (n,) of keypoints as image points of b and points of a, each pair of these once."""
    pairs = np.column_stack([keypoints_b, a.keypoint_point[keypoints_a]])
    _, first = np.unique(pairs, axis=0, return_index=True)
    image = b.keypoint_image[keypoints_b[first]]
    return Matches2D3D(
        unit=b.image_unit[image],
        image=image,
        xy_px=b.keypoint_xy_px[keypoints_b[first]].astype(np.float64),
        points_m=a.points_m[a.keypoint_point[keypoints_a[first]]],
    )


class Relocaliser:
    """Finds units of a scene among another scene's points."""

    def __init__(self, b: SourceScene, config: AggregationConfig, *, seed: int) -> None:
        self._b, self._config, self._seed = b, config, seed
        self._kind, self._params = pack_cameras(b.drive.cameras)
        self._cameras = SolverCameras.from_cameras(b.drive.cameras, self._kind, self._params)
        self.b_from_rig, self._b_from_cam = b.world_from_rig, b.world_from_cam

    def of_length(self, factor: float) -> Relocaliser:
        """The same for the scene with all of its lengths times a factor."""
        result = copy.copy(self)
        result.b_from_rig, result._b_from_cam = scaled(self.b_from_rig, factor), scaled(self._b_from_cam, factor)
        return result

    def errors_focal(self, a_from_b: Floats, seen: Matches2D3D) -> Floats:
        """Reprojection errors (n,) in focal lengths if b lies so in a; infinite where a camera shows nothing."""
        cam_from_a = se3.inverse(a_from_b @ self._b_from_cam[seen.image])
        points = np.einsum("nij,nj->ni", cam_from_a[:, :3, :3], seen.points_m) + cam_from_a[:, :3, 3]
        camera = self._b.image_camera[seen.image]
        return reprojection_errors_focal(self._kind, self._params, camera, points, seen.xy_px)

    def hypothesis(self, unit: int, seen: Matches2D3D) -> Floats | None:
        """Transform a_from_b (4, 4) by one unit alone."""
        own = seen.select(seen.unit == unit)
        if len(own.unit) < self._config.min_unit_inliers:
            return None
        found = self._unit_pose(unit, own)
        if found is None:
            return None
        a_from_b: Floats = found @ se3.inverse(self.b_from_rig[unit])
        refined = self.refined(a_from_b, own)
        return a_from_b if refined is None else refined

    def _unit_pose(self, unit: int, own: Matches2D3D) -> Floats | None:
        """a_from_rig of a unit."""
        xy_px, usable = self._cameras.pixels(self._b.image_camera[own.image], own.xy_px)
        own, xy_px = own.select(usable), xy_px[usable]
        if len(own.unit) < self._config.min_unit_inliers:
            return None
        images, eye = np.unique(own.image, return_inverse=True)
        rig_from_eye = se3.inverse(self.b_from_rig[unit]) @ self._b_from_cam[images]
        cameras = [self._cameras.cameras[int(self._b.image_camera[i])] for i in images]
        ransac = pycolmap.RANSACOptions()
        focal = float(np.mean([self._params[int(self._b.image_camera[i]), :2].mean() for i in images]))
        ransac.max_error = MAX_ERROR_FOCAL * focal
        ransac.min_num_trials, ransac.max_num_trials = 50, TRIALS
        ransac.random_seed = self._seed
        if len(images) == 1:
            options = pycolmap.AbsolutePoseEstimationOptions()
            options.ransac = ransac
            result = pycolmap.estimate_and_refine_absolute_pose(
                xy_px, own.points_m, cameras[0], estimation_options=options
            )
            key, eye_from_rig = "cam_from_world", se3.inverse(rig_from_eye[0])
        else:
            poses = [pycolmap.Rigid3d(pycolmap.Rotation3d(m[:3, :3]), m[:3, 3]) for m in se3.inverse(rig_from_eye)]
            result = pycolmap.estimate_and_refine_generalized_absolute_pose(
                xy_px, own.points_m, [int(e) for e in eye], poses, cameras, estimation_options=ransac
            )
            key, eye_from_rig = "rig_from_world", np.eye(4)
        if result is None or result["num_inliers"] < self._config.min_unit_inliers:
            return None
        pose = result[key]
        eye_from_a = se3.transform(pose.rotation.matrix(), pose.translation)
        return se3.inverse(eye_from_a) @ eye_from_rig

    def refined(self, a_from_b: Floats, seen: Matches2D3D) -> Floats | None:
        """The transform near a given one that fits best what all units see, b being one rig with an eye an image."""
        images, eye = np.unique(seen.image, return_inverse=True)
        camera = self._b.image_camera[images]
        return resect(
            a_from_b,
            seen.xy_px,
            seen.points_m,
            eye.astype(np.int64),
            self._b_from_cam[images],
            self._kind[camera],
            self._params[camera],
        )

    def agreeing(self, a_from_b: Floats, seen: Matches2D3D) -> tuple[Ints, Bools]:
        """Units that agree with a transform, and which image points (n,) fit."""
        fits = self.errors_focal(a_from_b, seen) < MAX_ERROR_FOCAL
        units, index = np.unique(seen.unit, return_inverse=True)
        counts, inliers = np.bincount(index), np.bincount(index, fits)
        good = (inliers >= self._config.min_unit_inliers) & (inliers >= MIN_SHARE * counts)
        return units[good], fits

    def relocalise(self, seen: Matches2D3D) -> Relocalization:
        """Find the transform a_from_b on which the units that observe points of a agree."""
        units, counts = np.unique(seen.unit, return_counts=True)
        tried = units[counts >= self._config.min_unit_inliers]
        if not self._config.agreeing_units and len(tried):
            return self._best_unit_alone(seen, int(units[counts.argmax()]), len(tried))
        proposals: list[tuple[Floats, Ints, int]] = []
        for unit in tried:
            a_from_b = self.hypothesis(int(unit), seen)
            if a_from_b is not None:
                proposals.append(self._with_all_units(a_from_b, seen))
        if not proposals:
            return _none(_why_none(len(tried)), len(tried))
        best = max(proposals, key=lambda p: (len(p[1]), p[2]))
        return self._judged(best, self._rivals(best, proposals, tried, seen), tried)

    def _with_all_units(self, a_from_b: Floats, seen: Matches2D3D) -> tuple[Floats, Ints, int]:
        """A transform refined by all units that agree with it, these, and how many image points of theirs fit."""
        for _ in range(2):
            agreeing, fits = self.agreeing(a_from_b, seen)
            better = self.refined(a_from_b, seen.select(fits & np.isin(seen.unit, agreeing)))
            if better is None or not len(agreeing):
                break
            a_from_b = better
        agreeing, fits = self.agreeing(a_from_b, seen)
        return a_from_b, agreeing, int((fits & np.isin(seen.unit, agreeing)).sum())

    def _rivals(
        self,
        best: tuple[Floats, Ints, int],
        proposals: Sequence[tuple[Floats, Ints, int]],
        tried: Ints,
        seen: Matches2D3D,
    ) -> int:
        """Number of units for which the best other place is nearly as good."""
        a_from_b, agreeing, _ = best
        _, fits = self.agreeing(a_from_b, seen)
        rest = seen.select(~fits)
        at_best = {int(u): int((fits & (seen.unit == u)).sum()) for u in tried}
        others = [p[0] for p in proposals]
        others += [h for u in tried if (h := self.hypothesis(int(u), rest)) is not None]
        most = 0
        for other in others:
            if self._same_place(other, a_from_b, agreeing):
                continue
            fitting = self.errors_focal(other, rest) < MAX_ERROR_FOCAL
            counts = {u: int((fitting & (rest.unit == u)).sum()) for u in at_best}
            needed = {u: max(self._config.min_unit_inliers, RIVAL_SHARE * at_best[u]) for u in at_best}
            most = max(most, sum(counts[u] >= needed[u] for u in at_best))
        return most

    def _best_unit_alone(self, seen: Matches2D3D, unit: int, tried: int) -> Relocalization:
        """The one unit that sees most decides, as in the paper."""
        a_from_b = self.hypothesis(unit, seen)
        if a_from_b is None:
            return _none("the unit that sees most finds no pose", tried)
        _, fits = self.agreeing(a_from_b, seen)
        return _found((a_from_b, np.array([unit]), int(fits.sum())), tried, 0, "the best unit alone decides")

    def _judged(self, best: tuple[Floats, Ints, int], runner_up: int, tried: Ints) -> Relocalization:
        agreeing = best[1]
        reason = ""
        if len(agreeing) < self._config.min_units:
            agree = "1 unit agrees" if len(agreeing) == 1 else f"{len(agreeing)} units agree"
            reason = f"{agree} how the scenes lie, {self._config.min_units} are needed"
        elif len(agreeing) < MIN_MAJORITY * len(tried):
            reason = f"only {len(agreeing)} of {len(tried)} units agree how the scenes lie"
        elif runner_up > MAX_RUNNER_UP * len(agreeing):
            reason = f"{len(agreeing)} units agree on one place, but for {runner_up} another is nearly as good"
        if reason:
            return _none(reason, len(tried), runner_up=runner_up)
        return _found(best, len(tried), runner_up, "")

    def _same_place(self, one: Floats, other: Floats, units: Ints) -> bool:
        at = self.b_from_rig[units].mean(0)[:3, 3] if len(units) else np.zeros(3)
        shift = np.linalg.norm(se3.apply(one, at[None])[0] - se3.apply(other, at[None])[0])
        turn = float(se3.rotation_angle_deg(one[:3, :3] @ other[:3, :3].T))
        return bool(shift <= SAME_PLACE_M and turn <= SAME_PLACE_DEG)


def _why_none(tried: int) -> str:
    return (
        f"of {tried} units with enough matches none finds a pose" if tried else "none of the units has enough matches"
    )


def _none(reason: str, tried: int, *, runner_up: int = 0) -> Relocalization:
    return Relocalization(
        a_from_b=None, reason=reason, units_tried=tried, units_agreeing=(), runner_up=runner_up, inliers=0
    )


def _found(best: tuple[Floats, Ints, int], tried: int, runner_up: int, reason: str) -> Relocalization:
    return Relocalization(
        a_from_b=best[0],
        reason=reason,
        units_tried=tried,
        units_agreeing=tuple(int(u) for u in best[1]),
        runner_up=runner_up,
        inliers=best[2],
    )
