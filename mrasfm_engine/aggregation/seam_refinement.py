"""Refinement of a seam: points that two scenes share, and the transform between the scenes that fits them best.

Transformation-based camera set bundle adjustment (MRASfM): the first scene is held, all units of the second move
rigidly together (see `bundle_adjustment.rigid_groups`), and the shared points vary. Points of one scene alone do not
constrain the transform. Matching, merging and adjusting are repeated, as a better transform finds more shared points.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mrasfm_engine.aggregation.assembly import Assembly
from mrasfm_engine.aggregation.scene_matching import CrossMatches
from mrasfm_engine.bundle_adjustment.observation_sampling import solve_with_chosen_points, thinned
from mrasfm_engine.bundle_adjustment.priors import Term
from mrasfm_engine.bundle_adjustment.problem import Layout
from mrasfm_engine.bundle_adjustment.rigid_groups import RigidGroups
from mrasfm_engine.bundle_adjustment.solver import Problem, Report, SolverOptions
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import reprojection_errors_focal
from mrasfm_engine.scene.state import State
from mrasfm_engine.triangulation.triangulate import cam_from_world
from mrasfm_engine.types import Bools, Floats, Ints

OBSERVATIONS_OF_IMAGE = 100  # from which transforms are estimated: each has those of many images
INITIAL_DAMPING = 1e-6  # scenes lie nearly right before they are adjusted
SCALE_LOSS = 3.0  # of residuals of shared points, in their median
CORRELATION = 4.0  # errors that keypoints of one image share: so many of them count once
# Newton decrement of the last step. Twice as much is how far the transforms, all together, are from the minimum where
# steps become shorter by half, in squared sigmas of independent errors: half a standard deviation of theirs. Scenes are
# more bent than that, and the robust weights of what does not fit would still move for as many steps again.
DECREMENT_TOLERANCE = CORRELATION / 8.0


@dataclass(frozen=True, kw_only=True)
class Shared:
    """Points of different scenes that are one: rows of points (n, 2) of an assembly, ascending and each once."""

    pairs: Ints

    def __len__(self) -> int:
        return len(self.pairs)


def merge_points(assembly: Assembly, matches: CrossMatches, fits: Bools) -> Shared:
    """Points of the two scenes of an assembly that matches (n,) which `fits` join, one to one: most matches win."""
    a, b = assembly.scenes
    pairs = np.column_stack([a.keypoint_point[matches.a[fits]], b.keypoint_point[matches.b[fits]]])
    unique, votes = np.unique(pairs, axis=0, return_counts=True)
    order = np.argsort(-votes, kind="stable")
    unique = unique[order]
    keep = np.ones(len(unique), dtype=np.bool_)
    for side in (0, 1):
        # The first row of each point is the one with most votes.
        first = np.zeros(len(unique), dtype=np.bool_)
        first[np.unique(unique[:, side], return_index=True)[1]] = True
        keep &= first
    result = unique[keep] + [0, assembly.first_point[1]]
    return Shared(pairs=result[np.lexsort((result[:, 1], result[:, 0]))])


def matches_fit(assembly: Assembly, state: State, matches: CrossMatches, max_error_focal: float) -> Bools:
    """Return which matches (n,) join points that both scenes place alike, to a share of the focal length."""
    a, b = assembly.scenes
    point_a = a.keypoint_point[matches.a]
    point_b = b.keypoint_point[matches.b] + assembly.first_point[1]
    row_a, row_b = matches.a, matches.b + assembly.first_keypoint[1]
    return (errors_focal(assembly, state, row_a, state.points_m[point_b]) < max_error_focal) & (
        errors_focal(assembly, state, row_b, state.points_m[point_a]) < max_error_focal
    )


def errors_focal(assembly: Assembly, state: State, rows: Ints, points_m: Floats) -> Floats:
    """Angles (n,), as shares of the focal length, between keypoints `rows` (n,) and points (n, 3)."""
    image = assembly.keypoint_image[rows]
    camera = assembly.image_camera[image]
    rotation, translation = cam_from_world(
        state, assembly.image_unit[image], camera, None if assembly.simultaneous else image
    )
    local = np.einsum("nij,nj->ni", rotation, points_m) + translation
    pixels = assembly.keypoint_xy_px[rows]
    return reprojection_errors_focal(assembly.camera_kind, state.camera_params, camera, local, pixels)


@dataclass(frozen=True, kw_only=True)
class Tracks:
    """Observations of joined points, sorted by joined point."""

    rows: Ints  # (n,) keypoints of the assembly
    point: Ints  # (n,) joined point
    members: Ints  # (m,) points of the assembly, sorted by joined point
    owner: Ints  # (m,) joined point of each

    @property
    def count(self) -> int:
        """Number of joined points."""
        return int(self.owner.max()) + 1 if len(self.owner) else 0


def tracks_of(assembly: Assembly, owner_of_point: Ints) -> Tracks:
    """Tracks of the assembly's points with an owner (p,), -1 for none; owners are numbered without gaps."""
    owner = np.where(assembly.keypoint_point >= 0, owner_of_point[assembly.keypoint_point], -1)
    rows = np.flatnonzero(owner >= 0)
    rows = rows[np.argsort(owner[rows], kind="stable")]
    members = np.flatnonzero(owner_of_point >= 0)
    members = members[np.argsort(owner_of_point[members], kind="stable")]
    return Tracks(rows=rows, point=owner[rows], members=members, owner=owner_of_point[members])


def joined_points_m(state: State, tracks: Tracks) -> Floats:
    """Initial joined points (count, 3): the middle of the points that they are made of."""
    sums = np.zeros((tracks.count, 3))
    np.add.at(sums, tracks.owner, state.points_m[tracks.members])
    result: Floats = sums / np.bincount(tracks.owner, minlength=tracks.count)[:, None].clip(1)
    return result


def transform_problem(
    assembly: Assembly,
    state: State,
    tracks: Tracks,
    sets: Ints,
    config: EngineConfig,
    *,
    terms: Sequence[Term] = (),
    iterations: int = 30,
) -> Problem:
    """The adjustment of scenes that move as one each.

    Parameters
    ----------
    sets
        The set (scenes,) that each scene's units belong to; -1 where it stays.
    """
    of_unit = np.where(assembly.registered, sets[assembly.scene_of_unit], -1)
    cameras = len(assembly.camera_kind)
    return Problem(
        state=replace(state, points_m=joined_points_m(state, tracks)),
        camera_kind=assembly.camera_kind,
        observations=assembly.observations(tracks.rows, tracks.point, tracks.count),
        layout=Layout.from_free(of_unit >= 0, np.zeros(cameras, dtype=np.bool_)),
        terms=terms,
        options=SolverOptions(
            max_iterations=iterations,
            function_tolerance=1e-6,
            decrement_tolerance=DECREMENT_TOLERANCE,
            initial_damping=INITIAL_DAMPING,
            loss_scale=config.bundle_adjustment.loss_scale,
            threads=config.threads,
        ),
        motion=assembly.motion,
        sets=RigidGroups(of_unit=of_unit, count=int(sets.max()) + 1),
    )


def moved_scenes(assembly: Assembly, world_from_scene: Floats, solution: State) -> Floats:
    """Poses (scenes, 4, 4) of scenes after an adjustment in which each moved rigidly."""
    result = world_from_scene.copy()
    for k, scene in enumerate(assembly.scenes):
        unit = int(np.flatnonzero(scene.unit_registered)[0])
        result[k] = solution.world_from_rig[assembly.first_unit[k] + unit] @ se3.inverse(scene.world_from_rig[unit])
    return result


@dataclass(frozen=True, kw_only=True)
class RefinedSeam:
    """A seam after its adjustment."""

    a_from_b: Floats
    covariance: Floats  # (6, 6) of b's step [omega (rad), v (m)] about the mean position of all of b's units
    shared: Shared
    errors_px: Floats  # (n,) of the observations of shared points
    report: Report


def adjust_transform(
    assembly: Assembly, a_from_b: Floats, shared: Shared, config: EngineConfig, *, cancel: Callable[[], bool]
) -> RefinedSeam:
    """Transformation-based adjustment of scene b against scene a, and a second one without points that do not fit."""
    poses = np.stack([np.eye(4), a_from_b])
    limit_px = config.mapping.max_error_px
    for last in (False, True):
        state = assembly.state(poses)
        owner = np.full(assembly.first_point[-1], -1, dtype=np.int64)
        owner[shared.pairs[:, 0]] = owner[shared.pairs[:, 1]] = np.arange(len(shared))
        tracks = tracks_of(assembly, owner)
        problem = transform_problem(assembly, state, tracks, np.array([-1, 0]), config)
        solution, report = solve_with_chosen_points(
            problem, assembly.image_size_px, an_image=OBSERVATIONS_OF_IMAGE, cancel=cancel
        )
        poses = moved_scenes(assembly, poses, solution)
        errors_px = np.sqrt(problem.errors_px2(solution))
        if last:
            break
        # Joined points of which one scene's observations do not fit are not one point.
        of_scene_b = tracks.rows >= assembly.first_keypoint[1]
        bad = np.zeros(len(shared), dtype=np.bool_)
        for side in (of_scene_b, ~of_scene_b):
            total = np.bincount(tracks.point[side], minlength=len(shared))
            fitting = np.bincount(tracks.point[side], errors_px[side] < limit_px, minlength=len(shared))
            bad |= fitting < np.maximum(1, 0.5 * total)
        shared = Shared(pairs=shared.pairs[~bad])
        if len(shared) < 3:
            break
    sets = problem.sets
    assert sets is not None
    sigma2 = max(0.25, float(np.median(errors_px**2)) / (2 * np.log(2)) if len(errors_px) else 1.0)
    problem = replace(problem, observations=thinned(problem.observations, problem.layout.unit_slot >= 0))
    return RefinedSeam(
        a_from_b=se3.inverse(poses[0]) @ poses[1],
        covariance=_covariance(problem, solution, sets, _sigmas_of_cameras(assembly), sigma2 * CORRELATION),
        shared=shared,
        errors_px=errors_px,
        report=report,
    )


def _sigmas_of_cameras(assembly: Assembly) -> Floats:
    """Sigmas (c, 6) of all scenes' cameras, rotation (rad) and translation (m); zero where a scene states none."""
    parts = []
    for scene in assembly.scenes:
        known = scene.certainty_of_cameras
        parts.append(np.zeros((len(scene.drive.cameras), 6)) if known is None else known[0])
    return np.concatenate(parts)


def _covariance(problem: Problem, state: State, sets: RigidGroups, sigma: Floats, variance: float) -> Floats:
    """Covariance (6, 6) of the set's step: by errors of observations of a variance, and of cameras of sigma (c, 6).

    A camera that looks elsewhere than its scene thinks has its points where the other scene does not: it turns and
    shifts the seam, and no residual shows it [a consider covariance: Bierman, Factorization Methods for Discrete
    Sequential Estimation, 1977].
    """
    layout = Layout.from_free(problem.layout.unit_slot >= 0, np.ones(len(sigma), dtype=np.bool_))
    system = replace(problem, layout=layout).normal_equations(state, 0.0)
    inverse: Floats = sets.covariances(system, state)[0]
    if not np.isfinite(inverse).all():
        return inverse
    by_error = sets.with_cameras(system, state).reshape(-1, len(sigma), layout.camera_dof)[:, :, :6] * sigma
    moved = inverse @ by_error.reshape(len(by_error), -1)
    result: Floats = variance * inverse + moved @ moved.T
    return result


def scale_ratio(assembly: Assembly, a_from_b: Floats, shared: Shared) -> tuple[float, float]:
    """Lengths of scene a in those of scene b, by the shared points as each scene has them, and the standard deviation.

    Pairs of points of one length each are compared by a robust regression of centred coordinates.
    """
    a, b = assembly.scenes
    if len(shared) < 3:
        return float("nan"), float("inf")
    xa = a.points_m[shared.pairs[:, 0]]
    xb = se3.apply(a_from_b, b.points_m[shared.pairs[:, 1] - assembly.first_point[1]])
    weight = np.ones(len(xa))
    scale, rotation, spread, rms = 1.0, np.eye(3), 1.0, 1.0
    for _ in range(10):
        w = weight / weight.sum()
        ca, cb = xa - w @ xa, (xb - w @ xb) @ rotation.T
        spread = float(w @ (cb**2).sum(1))
        scale = float(w @ (ca * cb).sum(1)) / max(spread, 1e-9)
        u, _, vt = np.linalg.svd((ca * w[:, None]).T @ (xb - w @ xb))
        rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
        residual = np.linalg.norm(ca - scale * cb, axis=1)
        usual = max(float(np.median(residual)), 1e-6)
        weight = 1.0 / (1.0 + (residual / (SCALE_LOSS * usual)) ** 2) ** 2
        rms = float(np.sqrt((weight * residual**2).sum() / weight.sum()))
    sigma = rms / np.sqrt(max(spread, 1e-9) * weight.sum() / CORRELATION)
    return scale, float(sigma)
