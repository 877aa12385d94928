"""Loop closure: find revisits, verify them, and distribute the drift.

Mapping first uses the matches of neighbouring units alone, so that no wrong revisit bends the reconstruction. Then
every pair of units that matches across a larger gap is tried: the later unit is registered against points that the
earlier one observes. The difference to its current pose is the drift since, as this pair measures it. Drift changes
slowly: a revisit is accepted if several pairs of neighbouring units measure the same drift, and if that drift is
plausible for the trajectory in between. A pose graph then distributes it over the loop.

Both are chi-square tests. Registrations have a covariance; the vehicle sees new points once it has travelled about a
viewing depth, and what poses and scale hand on there is as uncertain as such a registration. So uncertainty grows with
the metres travelled in viewing depths, not with the number of units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from mrasfm_engine.geometry import se3
from mrasfm_engine.mapping.calibration import median_depth_m
from mrasfm_engine.mapping.inlier_gates import TURN_RAD
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.per_camera_pnp import squared_lengths
from mrasfm_engine.mapping.pose_graph import Edges, optimise_pose_graph
from mrasfm_engine.mapping.unit_registration import (
    Correspondences2D3D,
    inliers_of,
    pose_covariance,
    register_from_correspondences,
)
from mrasfm_engine.matching.simultaneous import calibration_sigmas
from mrasfm_engine.scene.scene import PairMatches
from mrasfm_engine.types import Floats

MIN_INLIERS = 30
MIN_SUPPORT = 3  # pairs of units that report one drift
UNLIKELY = 1e-3  # chance of a drift, or of a difference between two, that covariances allow: such ones are not believed
LEAST_STEP = 1e-3  # of a viewing depth: a vehicle that stands has moved by no less


@dataclass(frozen=True, kw_only=True)
class Revisit:
    """Two units that see the same place."""

    earlier: int
    later: int
    world_from_rig: Floats  # pose of the later unit from points that the earlier one sees
    drift: Floats  # (4, 4) that moves the later unit's current pose there: world_from_rig @ inverse(current)
    covariance: Floats  # (6, 6) of steps [omega, tau] of that pose in world axes, by the registration


@dataclass(frozen=True, kw_only=True)
class DriftModel:
    """Uncertainty of relative poses along the trajectory.

    Attributes
    ----------
    travelled_m
        (units,) along the trajectory up to every registered unit; NaN for others.
    position_m
        (units, 3)
    depth_m
        Distance of points as a rule: after so many metres the vehicle sees others.
    sigma_rotation_rad, sigma_translation_m
        Per axis, of a registration: what a pose is off by against poses from which other points are seen.
    """

    travelled_m: Floats
    position_m: Floats
    depth_m: float
    sigma_rotation_rad: float
    sigma_translation_m: float

    @staticmethod
    def from_registrations(mapper: Mapper, covariances: Floats) -> DriftModel:
        """The model of a scene whose units are registered as uncertainly as some (n, 6, 6) are."""
        known, position_m = np.flatnonzero(mapper.registered), mapper.state.unit_position_m
        steps_m = np.linalg.norm(np.diff(position_m[known], axis=0), axis=1)
        travelled_m = np.full(len(position_m), np.nan)
        travelled_m[known] = np.concatenate([[0.0], np.cumsum(steps_m)])
        sigma_rotation_rad, sigma_translation_m = np.median(_sigmas(covariances), axis=0)
        return DriftModel(
            travelled_m=travelled_m,
            position_m=position_m,
            depth_m=max(median_depth_m(mapper), float(np.finfo(np.float64).tiny)),
            sigma_rotation_rad=float(sigma_rotation_rad),
            sigma_translation_m=float(sigma_translation_m),
        )

    def covariance(self, earlier: int, later: int) -> Floats:
        """Covariance (6, 6) of the drift of a unit against an earlier one.

        Errors of lens models are alike all along, so at worst they add up: what poses hand on grows with the number of
        viewing depths. A rotation error shifts all that follows, and scale has drifted as well.
        """
        between = (self.travelled_m >= self.travelled_m[earlier]) & (self.travelled_m <= self.travelled_m[later])
        arms_m = self.position_m[between] - self.position_m[later]
        length_m, renewals = self.travelled_m[later] - self.travelled_m[earlier], self.renewals(earlier, later)
        rotation = (renewals * self.sigma_rotation_rad) ** 2
        shift = (renewals * self.sigma_translation_m) ** 2
        shift += rotation * (arms_m**2).sum(1).mean() + (self.scale_sigma(earlier, later) * length_m) ** 2
        return np.diag(np.repeat([rotation, shift], 3))

    def scale_sigma(self, earlier: int, later: int) -> float:
        """Standard deviation of a unit's scale to an earlier one's: rays hand it on that turn by `TURN_RAD`."""
        return float(np.sqrt(self.renewals(earlier, later)) * self.sigma_rotation_rad / TURN_RAD)

    def renewals(self, earlier: int, later: int) -> float:
        """Number of registrations on other points that a unit's pose rests on since an earlier one.

        Its own, and one for every viewing depth between.
        """
        return float(1.0 + (self.travelled_m[later] - self.travelled_m[earlier]) / self.depth_m)

    def step_sigmas(self, metres: Floats) -> Floats:
        """Standard deviations (n, 2), rotation (rad) and translation (m) per axis, of steps of some metres (n,)."""
        renewals = np.maximum(metres / self.depth_m, LEAST_STEP)
        result: Floats = np.sqrt(renewals)[:, None] * [self.sigma_rotation_rad, self.sigma_translation_m]
        return result


def split_pairs(pairs: Sequence[PairMatches]) -> tuple[list[PairMatches], list[PairMatches]]:
    """Pairs of units that follow one another, and pairs that may be revisits."""
    return [pair for pair in pairs if not pair.is_revisit], [pair for pair in pairs if pair.is_revisit]


def find_revisits(mapper: Mapper, far_pairs: Sequence[PairMatches]) -> tuple[list[Revisit], int]:
    """Believed revisits, and how many pairs of units were tried."""
    by_units: dict[tuple[int, int], list[PairMatches]] = {}
    for pair in far_pairs:
        units = sorted((int(mapper.image_unit[pair.image_a]), int(mapper.image_unit[pair.image_b])))
        if mapper.registered[units].all():
            by_units.setdefault((units[0], units[1]), []).append(pair)
    found = []
    for (earlier, later), own in sorted(by_units.items()):
        current = mapper.state.world_from_rig_of(np.array([later]))[0]
        revisit = seen_again(mapper, earlier, later, own, current=current, expected=current)
        found += [] if revisit is None else [revisit]
    if not found:
        return [], len(by_units)
    model = DriftModel.from_registrations(mapper, np.stack([r.covariance for r in found]))
    calibration = _calibration_covariance(mapper)
    plausible = [r for r in found if _square(r, model, calibration) <= _limit()]
    return supported(plausible, model), len(by_units)


def seen_again(
    mapper: Mapper,
    earlier: int,
    later: int,
    pairs: Sequence[PairMatches],
    *,
    current: Floats,
    expected: Floats | None = None,
) -> Revisit | None:
    """Register the later unit against points that the earlier one observes.

    Parameters
    ----------
    current
        Pose (4, 4) of the later unit that its drift is counted from, be it in another frame.
    expected
        Where it (4, 4) may be; without it, it is searched.
    """
    rows_later, tracks = [], []
    for pair in pairs:
        a, b = mapper.matched_keypoints(pair, earlier)
        observed = mapper.is_inlier[a]
        rows_later.append(b[observed])
        tracks.append(mapper.tracks.of_keypoint[a[observed]])
    rows, track = np.concatenate(rows_later), np.concatenate(tracks)
    matched = Correspondences2D3D(
        xy_px=mapper.keypoints.xy_px[rows],
        points_m=mapper.state.points_m[track],
        camera=mapper.keypoints.camera[rows],
        band=mapper.keypoints.band[rows],
    )
    pose = register_from_correspondences(
        mapper, later, matched, min_inliers=MIN_INLIERS, by_vote=False, expected=expected
    ).world_from_rig
    if pose is None:
        return None
    return Revisit(
        earlier=earlier,
        later=later,
        world_from_rig=pose,
        drift=pose @ se3.inverse(current),
        covariance=pose_covariance(mapper, pose, matched.select(inliers_of(mapper, pose, matched))),
    )


def largest_agreement(mapper: Mapper, other: Mapper, revisits: Sequence[Revisit]) -> list[Revisit]:
    """Most of the revisits of two frames' units that report one transform between the frames.

    Earlier units are registered in `mapper`, later ones in `other`. What both have drifted by between two revisits
    takes part in the test, and a rotation's error over the distance.
    """
    if not revisits:
        return []
    own = np.stack([revisit.covariance for revisit in revisits])
    drifts = np.stack([revisit.drift for revisit in revisits])
    here, there = (DriftModel.from_registrations(one, own) for one in (mapper, other))
    earlier, later = np.array([(revisit.earlier, revisit.later) for revisit in revisits]).T
    way_here_m, way_there_m = here.travelled_m[earlier], there.travelled_m[later]
    at_m, turn_sigma_rad = there.position_m[later], _sigmas(own)[:, 0]
    best = np.zeros(len(revisits), dtype=np.bool_)
    for i in range(len(revisits)):
        sigmas = np.hypot(
            here.step_sigmas(np.abs(way_here_m - way_here_m[i])),
            there.step_sigmas(np.abs(way_there_m - way_there_m[i])),
        )
        sigmas[:, 1] = np.hypot(sigmas[:, 1], turn_sigma_rad * np.linalg.norm(at_m - at_m[i], axis=1))
        difference = _steps(drifts, at_m[i]) - _steps(drifts[i : i + 1], at_m[i])
        agrees = squared_lengths(difference, own + own[i] + _diagonal(sigmas)) <= _limit()
        if agrees.sum() > best.sum():
            best = agrees
    return [revisit for revisit, agrees in zip(revisits, best, strict=True) if agrees]


def _limit() -> float:
    return float(chdtri(6, UNLIKELY))


def _sigmas(covariances: Floats) -> Floats:
    """Standard deviations (n, 2) of rotation (rad) and translation (m), per axis, of covariances (n, 6, 6)."""
    variances = np.diagonal(covariances, axis1=1, axis2=2).reshape(-1, 2, 3)
    result: Floats = np.sqrt(variances.mean(2))
    return result


def _diagonal(sigmas: Floats) -> Floats:
    """Covariances (n, 6, 6) of standard deviations (n, 2) of rotation and translation per axis."""
    result: Floats = np.repeat(sigmas**2, 3, axis=1)[:, :, None] * np.eye(6)
    return result


def _calibration_covariance(mapper: Mapper) -> Floats:
    """Covariance (6, 6) of a drift that one camera measures on points of another, by the calibration's prior."""
    if mapper.drive.has_single_camera:
        return np.zeros((6, 6))
    sigma_rotation_rad, sigma_translation_m = calibration_sigmas(mapper.drive, mapper.config.bundle_adjustment)
    arms_m = np.linalg.norm(mapper.state.camera_position_m, axis=1)
    shift_m2 = sigma_translation_m**2 + (arms_m * sigma_rotation_rad) ** 2
    return 2.0 * np.diag(np.repeat([(sigma_rotation_rad**2).max(), shift_m2.max()], 3))


def _steps(drifts: Floats, at_m: Floats) -> Floats:
    """Steps [omega, tau] (n, 6) by which drifts (n, 4, 4) move a unit at a position (3,)."""
    return np.concatenate([se3.log_so3(drifts[:, :3, :3]), se3.apply(drifts, at_m[None])[:, 0] - at_m], axis=1)


def _square(revisit: Revisit, model: DriftModel, calibration: Floats | float = 0.0) -> float:
    """Squared Mahalanobis length of a drift, by the trajectory between, the registration and the calibration."""
    step = _steps(revisit.drift[None], model.position_m[revisit.later])[0]
    covariance = revisit.covariance + model.covariance(revisit.earlier, revisit.later) + calibration
    return float(step @ np.linalg.solve(covariance, step))


def supported(revisits: Sequence[Revisit], model: DriftModel) -> list[Revisit]:
    """The revisits that several neighbours, themselves among them, agree with: they report the same drift.

    Neighbours are less than a viewing depth apart at both visits, so that they show the same place.
    """
    if not revisits:
        return []
    units = np.array([(r.earlier, r.later) for r in revisits])
    drifts, own = np.stack([r.drift for r in revisits]), np.stack([r.covariance for r in revisits])
    travelled_m = model.travelled_m[units]
    result = []
    for i, revisit in enumerate(revisits):
        # Revisits are in the order of their earlier units.
        low, high = np.searchsorted(travelled_m[:, 0], travelled_m[i, 0] + model.depth_m * np.array([-1.0, 1.0]))
        apart_m = np.abs(travelled_m[low:high] - travelled_m[i])
        near = low + np.flatnonzero(apart_m[:, 1] <= model.depth_m)
        at_m = model.position_m[revisit.later]
        difference = _steps(drifts[near], at_m) - _steps(drifts[i : i + 1], at_m)
        sigmas = model.step_sigmas(apart_m[near - low].sum(1))
        # Drift as one rigid motion knows of no scale, which makes it change from unit to unit.
        sigmas[:, 1] = np.hypot(sigmas[:, 1], model.scale_sigma(*units[i]) * apart_m[near - low].max(1))
        covariance = own[near] + own[i] + _diagonal(sigmas)
        if np.count_nonzero(squared_lengths(difference, covariance) <= _limit()) >= MIN_SUPPORT:
            result.append(revisit)
    return result


def close_loops(mapper: Mapper, revisits: Sequence[Revisit]) -> float:
    """Move the units by a pose graph of the drive's own steps and the revisits; by how much at most, in metres.

    Points stay where they are: they have to be triangulated anew.
    """
    poses = mapper.state.world_from_rig
    units = np.flatnonzero(mapper.registered)
    chain = np.stack([units[:-1], units[1:]], axis=1)
    loops = np.array([(r.earlier, r.later) for r in revisits], dtype=np.int64).reshape(-1, 2)
    measured = [
        se3.inverse(poses[chain[:, 0]]) @ poses[chain[:, 1]],
        se3.inverse(poses[loops[:, 0]]) @ np.stack([r.world_from_rig for r in revisits]),
    ]
    covariances = np.stack([r.covariance for r in revisits])
    model = DriftModel.from_registrations(mapper, covariances)
    # The drift that is believed tells how uncertain steps really are [a posteriori variance factor].
    squares = np.median([_square(r, model) for r in revisits])
    factor = max(1.0, float(np.sqrt(squares / chdtri(6, 0.5))))
    sigmas = np.concatenate([factor * model.step_sigmas(np.diff(model.travelled_m[units])), _sigmas(covariances)])
    edges = Edges(
        units=np.concatenate([chain, loops]),
        a_from_b=np.concatenate(measured),
        sigma_rotation_rad=sigmas[:, 0],
        sigma_translation_m=sigmas[:, 1],
        robust=np.arange(len(chain) + len(loops)) >= len(chain),
    )
    closed = optimise_pose_graph(poses, edges)
    moved = float(np.linalg.norm(closed[units, :3, 3] - poses[units, :3, 3], axis=1).max())
    for unit in units:
        mapper.set_pose(int(unit), closed[unit])
    return moved
