"""The first two units: which ones, and their poses to one another."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from mrasfm_engine.bundle_adjustment.solver import SolverOptions
from mrasfm_engine.errors import ReconstructionError
from mrasfm_engine.even_choice import even_choice
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.colmap_cameras import SolverCameras
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.pose_adjustment import adjust_poses
from mrasfm_engine.mapping.unit_registration import CameraViews, cameras_of, matrix_of, register_unit, rigid3d
from mrasfm_engine.mapping.vehicle_speed import MAX_SPEED_MPS, speeds_mps, usual_distance_m
from mrasfm_engine.matching.verification import parallax_rad
from mrasfm_engine.scene.scene import PairMatches
from mrasfm_engine.types import Floats, Ints

CANDIDATES = 4  # pairs of units that are tried
MAX_RELATIVE_MATCHES = 1200
RELATIVE_ERROR_PX = 4.0
ROUGH_ERROR_PX = 12.0  # while the second unit's pose is a guess
MOTION_ROUNDS = 3
FULL_PARALLAX_RAD = np.radians(0.5)
MAX_PARALLAX_MATCHES = 100  # looked at of a pair
MIN_POINTS = 30
GOOD_START_POINTS = 300  # with so many, no other source of the pose is tried
INSIDE = "points inside the first unit"


@dataclass(frozen=True, kw_only=True)
class Initialisation:
    """First units of a reconstruction."""

    units: tuple[int, int]
    points: int
    method: str


@dataclass(frozen=True, kw_only=True)
class UnitScores:
    """Scores of pairs of units by their matches.

    Parallax takes its time to compute, and no pair of units has more matches that show motion than it has matches:
    the candidates are tried first.
    """

    mapper: Mapper
    inside: Ints  # (units,) verified matches between the images of a unit
    between: dict[tuple[int, int], list[PairMatches]]  # by unit and later unit

    @staticmethod
    def from_pairs(mapper: Mapper, pairs: Sequence[PairMatches]) -> UnitScores:
        """Count the matches of a drive's keyframes."""
        inside = np.zeros(len(mapper.registered), dtype=np.int64)
        between: dict[tuple[int, int], list[PairMatches]] = {}
        for pair in pairs:
            u, v = sorted((int(mapper.image_unit[pair.image_a]), int(mapper.image_unit[pair.image_b])))
            if not (mapper.keyframe[u] and mapper.keyframe[v]):
                continue
            if u == v:
                inside[u] += np.count_nonzero(pair.inliers)
            else:
                between.setdefault((u, v), []).append(pair)
        return UnitScores(mapper=mapper, inside=inside, between=between)

    def moving(self, u: int, v: int) -> int:
        """Verified matches between two units that show motion."""
        return sum(
            round(np.count_nonzero(pair.inliers) * _share_that_moves(self.mapper, pair)) for pair in self.between[u, v]
        )

    def best_of_gap(self, gap: int) -> tuple[int, int]:
        """The units, so many apart, with most matches inside them and such between them."""
        most = {
            (u, v): int(self.inside[u] + self.inside[v]) + sum(np.count_nonzero(pair.inliers) for pair in between)
            for (u, v), between in self.between.items()
            if v - u == gap
        }
        best, best_score = (-1, -1), -1
        for units in sorted(most, key=lambda units: -most[units]):
            if most[units] <= best_score:
                break
            score = int(self.inside[list(units)].sum()) + self.moving(*units)
            if score > best_score:
                best, best_score = units, score
        return best


def _share_that_moves(mapper: Mapper, pair: PairMatches) -> float:
    """Share of the matches that show motion: units at which the car stands match best, but give no points."""
    matches = pair.matches[pair.inliers]
    matches = matches[:: 1 + len(matches) // MAX_PARALLAX_MATCHES]
    a = mapper.keypoints.rays[mapper.keypoints.first[pair.image_a] + matches[:, 0]]
    b = mapper.keypoints.rays[mapper.keypoints.first[pair.image_b] + matches[:, 1]]
    return min(1.0, parallax_rad(a, b) / float(FULL_PARALLAX_RAD))


def initialise(mapper: Mapper, pairs: Sequence[PairMatches], prior_world_from_rig: Floats | None) -> Initialisation:
    """Register the two best-connected units.

    For each of the best pairs of units by verified matches inside and between them, the sources of a relative pose are
    tried: points triangulated inside the first unit, and where these give no good start the prior poses and the
    generalised relative pose. Each is adjusted; the pair with the most points of good angle is kept, one between which
    no road vehicle drives so fast only where there is no other.

    Raises
    ------
    ReconstructionError
        Where no pair of units gives points.
    """
    prior = prior_world_from_rig
    known = np.isfinite(prior[:, 0, 3]) if prior is not None else np.zeros(len(mapper.registered), dtype=np.bool_)
    scores = UnitScores.from_pairs(mapper, pairs)
    best: tuple[tuple[bool, int], Initialisation, Floats, Floats] | None = None
    # Not the same gap over and over: with a longer step points get better angles.
    for gap in sorted({v - u for u, v in scores.between})[:CANDIDATES]:
        u, v = scores.best_of_gap(gap)
        anchor = np.eye(4) if prior is None or not known[u] else prior[u]
        for method, pose in _proposals(mapper, pairs, u, v, anchor, prior if known[[u, v]].all() else None):
            points = _evaluate(mapper, u, v, anchor, pose, is_guess=method != INSIDE)
            rank = points >= MIN_POINTS and bool(speeds_mps(mapper)[0] <= MAX_SPEED_MPS), points
            if best is None or rank > best[0]:
                best = (
                    rank,
                    Initialisation(units=(u, v), points=points, method=method),
                    mapper.state.world_from_rig[u],
                    mapper.state.world_from_rig[v],
                )
            if method == INSIDE and points >= GOOD_START_POINTS:
                break  # the others are for cameras that share no view; that from images alone costs most
    mapper.clear()
    if best is None or best[1].points < MIN_POINTS:
        raise ReconstructionError(
            f"no two units of the drive have enough in common to begin: {len(pairs)} image pairs were verified, the "
            f"best two units share {0 if best is None else best[1].points} points",
            remedy="Check that the images show a textured scene while the car moves, that cameras and files are not "
            "mixed up, that intrinsics fit the images, and that rig_from_cam of every camera is right.",
            code="nothing-matches",
        )
    _, result, pose_u, pose_v = best
    mapper.set_pose(result.units[0], pose_u)
    mapper.set_pose(result.units[1], pose_v)
    mapper.renew_motion()
    mapper.triangulate()
    return result


def _proposals(
    mapper: Mapper,
    pairs: Sequence[PairMatches],
    u: int,
    v: int,
    anchor: Floats,
    prior_world_from_rig: Floats | None,
) -> Iterator[tuple[str, Floats]]:
    """Poses of unit v, given that of u, and where they come from."""
    mapper.clear()
    mapper.set_pose(u, anchor)
    mapper.renew_motion()
    if mapper.triangulate(mapper.tracks_of_units(np.array([u]))) >= MIN_POINTS:
        mapper.motion.predict(mapper.state, mapper.registered, v)
        registration = register_unit(mapper, v)
        if registration.world_from_rig is not None:
            yield INSIDE, registration.world_from_rig
    if prior_world_from_rig is not None:
        yield "prior poses", anchor @ se3.inverse(prior_world_from_rig[u]) @ prior_world_from_rig[v]
    relative = (
        _single_camera_relative_pose(mapper, pairs, u, v, prior_world_from_rig)
        if mapper.drive.has_single_camera
        else _generalised_relative_pose(mapper, pairs, u, v)
    )
    if relative is None:
        return
    yield "generalised relative pose", anchor @ relative
    if prior_world_from_rig is None and not mapper.drive.has_single_camera:
        # Cameras that share no view hardly tell how far a vehicle goes that does not turn: an adjustment stays at the
        # length that it begins with, be that many kilometres.
        length_m = float(np.linalg.norm(relative[:3, 3]))
        usual = relative.copy()
        usual[:3, 3] *= usual_distance_m(mapper, u, v) / max(length_m, 1e-9)
        yield "generalised relative pose, at a usual speed", anchor @ usual


def _generalised_relative_pose(mapper: Mapper, pairs: Sequence[PairMatches], u: int, v: int) -> Floats | None:
    """rig_u_from_rig_v from matches between all cameras of the two units."""
    a, b = _matches_between(mapper, pairs, u, v)
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = RELATIVE_ERROR_PX, mapper.config.seed
    options.min_num_trials, options.max_num_trials = 100, 2000
    cameras = cameras_of(mapper)
    a, b, xy_a, xy_b = _for_solver(mapper, cameras, a, b)
    if not len(a):
        return None
    both = np.concatenate([a, b])
    views = CameraViews.from_keypoints(mapper, mapper.keypoints.camera[both], mapper.keypoints.band[both])
    result = pycolmap.estimate_generalized_relative_pose(
        xy_a,
        xy_b,
        [int(i) for i in views.index[: len(a)]],
        [int(i) for i in views.index[len(a) :]],
        [rigid3d(m) for m in se3.inverse(views.rig_from_view)],
        [cameras.cameras[c] for c in views.camera],
        estimation_options=options,
    )
    if result is None or "rig2_from_rig1" not in result:
        return None
    return se3.inverse(matrix_of(result["rig2_from_rig1"]))


def _single_camera_relative_pose(
    mapper: Mapper, pairs: Sequence[PairMatches], u: int, v: int, prior_world_from_rig: Floats | None
) -> Floats | None:
    """rig_u_from_rig_v of a rig with one camera: its length, which no image observes, is the prior's or a usual one."""
    a, b = _matches_between(mapper, pairs, u, v)
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = RELATIVE_ERROR_PX, mapper.config.seed
    index, cameras = int(mapper.image_camera[0]), cameras_of(mapper)
    camera = cameras.cameras[index]
    a, b, xy_a, xy_b = _for_solver(mapper, cameras, a, b)
    if not len(a):
        return None
    result = pycolmap.estimate_essential_matrix(xy_a, xy_b, camera, camera, estimation_options=options)
    if result is None:
        return None
    length_m = usual_distance_m(mapper, u, v)
    if prior_world_from_rig is not None:
        length_m = max(float(np.linalg.norm(prior_world_from_rig[v, :3, 3] - prior_world_from_rig[u, :3, 3])), 0.1)
    u_from_v = se3.inverse(matrix_of(result["cam2_from_cam1"]))
    u_from_v[:3, 3] *= length_m / max(float(np.linalg.norm(u_from_v[:3, 3])), 1e-9)
    rig_from_view = np.stack(
        [mapper.motion.unit_from_image(mapper.state)[mapper.keypoints.image[k[0]]] for k in (a, b)]
    )
    rig_from_view = rig_from_view @ mapper.state.rig_from_cam[index]
    result_pose: Floats = rig_from_view[0] @ u_from_v @ se3.inverse(rig_from_view[1])
    return result_pose


def _for_solver(mapper: Mapper, cameras: SolverCameras, a: Ints, b: Ints) -> tuple[Ints, Ints, Floats, Floats]:
    """Matching keypoints (n,) that COLMAP's solvers can use, and their pixels (n, 2) as these take them."""
    keypoints = mapper.keypoints
    (xy_a, usable_a), (xy_b, usable_b) = (cameras.pixels(keypoints.camera[k], keypoints.xy_px[k]) for k in (a, b))
    both = usable_a & usable_b
    return a[both], b[both], xy_a[both], xy_b[both]


def _matches_between(mapper: Mapper, pairs: Sequence[PairMatches], u: int, v: int) -> tuple[Ints, Ints]:
    """Keypoints of unit u and of unit v that match, over all cameras; a sample where there are many."""
    rows_u, rows_v = [], []
    for pair in pairs:
        if {int(mapper.image_unit[pair.image_a]), int(mapper.image_unit[pair.image_b])} != {u, v}:
            continue
        a, b = mapper.matched_keypoints(pair, u)
        rows_u.append(a)
        rows_v.append(b)
    a, b = np.concatenate(rows_u), np.concatenate(rows_v)
    keep = even_choice(len(a), MAX_RELATIVE_MATCHES)
    return a[keep], b[keep]


def _evaluate(mapper: Mapper, u: int, v: int, anchor: Floats, pose: Floats, *, is_guess: bool) -> int:
    """Points of the two units after adjusting the second; the mapper is left in that state."""
    mapper.clear()
    mapper.set_pose(u, anchor)
    mapper.set_pose(v, pose)
    mapper.renew_motion()
    tracks = mapper.tracks_of_units(np.array([u, v]))
    free = np.zeros(len(mapper.registered), dtype=np.bool_)
    free[v] = True
    options = SolverOptions(max_iterations=30, function_tolerance=1e-3, threads=mapper.config.threads)
    threshold = mapper.triangulator.max_error_px
    # Baselines between cameras that are not simultaneous follow from the pose that is sought: it takes some turns.
    rough_rounds = int(is_guess) if mapper.state.simultaneous else MOTION_ROUNDS
    try:
        for error_px in (*([ROUGH_ERROR_PX] * rough_rounds), ROUGH_ERROR_PX / 2, threshold):
            mapper.triangulator.max_error_px = max(error_px, threshold)
            if mapper.triangulate(tracks) < MIN_POINTS:
                return 0
            adjust_poses(mapper, free, options=options, an_image=mapper.config.mapping.pose_observations)
    finally:
        mapper.triangulator.max_error_px = threshold
    return mapper.triangulate(tracks)
