"""Last adjustment of a map: units vary on their own again, those at the seams or all of them.

Scenes that moved rigidly are still bent as before. Where two scenes overlap, the observations of both now determine
their units. Every drive keeps its own calibration, which varies within its scene's uncertainty (see `calibrations`),
and its GNSS positions as prior, with a constant offset per drive that is estimated in turns with the units.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mrasfm_engine.aggregation.assembly import Assembly
from mrasfm_engine.aggregation.calibrations import MapCalibrations, map_calibrations, scenes_of_told_length
from mrasfm_engine.aggregation.positions import DrivePositions, with_bias
from mrasfm_engine.aggregation.seam_refinement import joined_points_m, tracks_of
from mrasfm_engine.aggregation.vehicles import Vehicle
from mrasfm_engine.bundle_adjustment.observation_sampling import solve_with_chosen_points
from mrasfm_engine.bundle_adjustment.priors import Term, UprightPrior
from mrasfm_engine.bundle_adjustment.problem import Layout
from mrasfm_engine.bundle_adjustment.solver import Problem, Report, SolverOptions
from mrasfm_engine.config import EngineConfig
from mrasfm_engine.mapping.georeferencing import SIGMA_PITCH_RAD, SIGMA_ROLL_RAD
from mrasfm_engine.scene.state import State
from mrasfm_engine.types import Bools, Floats, Ints

ROUNDS = 2
MIN_SHARED_POINTS = 12  # of other scenes that a unit sees, to vary on its own in the overlap
OBSERVATIONS_OF_IMAGE = 300  # from which poses are estimated
# Lengths of scenes, beyond which the adjustment has no business: in sigmas that the scene states, of at least so much.
MOST_LENGTHENED, LEAST_SIGMA_LENGTH, LEAST_SPREAD_M = 3.0, 0.01, 1.0


@dataclass(frozen=True, kw_only=True)
class MapModel:
    """Everything of a map in its frame: poses, points, and what observes them."""

    state: State  # points are the map's
    rows: Ints  # (n,) keypoints of the assembly that observe a point, sorted by point
    point: Ints  # (n,)
    owner: Ints  # (p,) the map's point that every scene's point became, -1 where it was dropped
    joined: Bools  # (points,) which several scenes see
    errors_px: Floats  # (n,)


@dataclass(frozen=True, kw_only=True)
class AdjustedMap:
    """The map's model and how its last adjustment went."""

    model: MapModel
    positions: dict[int, DrivePositions]  # by scene
    reports: tuple[Report, ...]
    free_units: int
    free_cameras: int
    learning: tuple[int, ...]  # scenes whose calibration took what other drives of their vehicle observed
    too_many_cameras: bool  # for the solver: no scene learns, or even varies its calibration
    dropped_observations: int
    dropped_points: int
    lengthened: Mapping[int, float]  # scenes that are longer by a factor than they may be by themselves


def all_points(owner: Ints) -> Ints:
    """Owners (p,) with every point that is not joined as one of its own, joined ones first."""
    result = owner.copy()
    alone = np.flatnonzero(owner < 0)
    result[alone] = (int(owner.max()) + 1 if len(owner) else 0) + np.arange(len(alone))
    return result


def adjust_map(
    assembly: Assembly,
    world_from_scene: Floats,
    owner: Ints,
    positions: dict[int, DrivePositions],
    config: EngineConfig,
    *,
    vehicles: Sequence[Vehicle] = (),
    cancel: Callable[[], bool],
) -> AdjustedMap:
    """Adjust the units at the seams (or all, or none, as the settings say); then filter what does not fit.

    Parameters
    ----------
    owner
        The joined point (p,) of the assembly's points, -1 for points of one scene alone.
    positions
        Of the assembly's scenes that have any; their bias is estimated here.
    vehicles
        Those that several of the scenes' drives name: what the drives tell of their cameras is shared.
    """
    state = assembly.state(world_from_scene)
    owners = all_points(owner)
    tracks = tracks_of(assembly, owners)
    joined = np.arange(tracks.count) <= int(owner.max(initial=-1))
    state = replace(state, points_m=joined_points_m(state, tracks))
    none = np.zeros(len(assembly.camera_kind), dtype=np.bool_)
    problem = Problem(
        state=state,
        camera_kind=assembly.camera_kind,
        observations=assembly.observations(tracks.rows, tracks.point, tracks.count),
        layout=Layout.from_free(np.zeros(len(assembly.registered), dtype=np.bool_), none),
        options=_options(config),
        motion=assembly.motion,
    )
    free = _free_units(assembly, problem, joined, config)
    if config.aggregation.final_adjustment == "none":
        vehicles = ()
    calibrations = map_calibrations(
        assembly,
        state,
        free,
        vehicles,
        config.bundle_adjustment,
        told_lengths=scenes_of_told_length(assembly, owner),
    )
    free = calibrations.free_units
    as_found, problem = problem, _with_cameras(problem, calibrations.at_priors(state))
    o, seen = problem.observations, np.zeros(tracks.count, dtype=np.bool_)
    seen[o.point[free[o.unit]]] = True
    attempts = [(problem, one) for one in calibrations.with_looser_places()]
    if calibrations.cameras.any():
        attempts.append((as_found, calibrations.as_found()))
    varied = _least_lengthened(assembly, attempts, seen, positions, cancel=cancel)
    problem, calibrations = varied.problem, varied.calibrations
    problem = _others_refined(problem, seen, calibrations.cameras)
    model, observations, points_dropped = _filtered(assembly, problem, tracks.rows, owners, config)
    return AdjustedMap(
        model=model,
        positions=varied.positions,
        reports=tuple(varied.reports),
        free_units=int(free.sum()),
        free_cameras=int(calibrations.cameras.sum()),
        learning=calibrations.learning,
        too_many_cameras=calibrations.too_many,
        dropped_observations=observations,
        dropped_points=points_dropped,
        lengthened=varied.lengthened,
    )


@dataclass(frozen=True, kw_only=True)
class _Varied:
    """A problem after its units and calibrations have varied, and the scenes that got longer than they may."""

    problem: Problem
    calibrations: MapCalibrations
    positions: dict[int, DrivePositions]
    reports: Sequence[Report]
    lengthened: Mapping[int, float]

    @property
    def worst(self) -> float:
        """The largest change of a scene's length that is more than it may be, as a logarithm."""
        return max((abs(float(np.log(factor))) for factor in self.lengthened.values()), default=0.0)


def _least_lengthened(
    assembly: Assembly,
    attempts: Sequence[tuple[Problem, MapCalibrations]],
    seen: Bools,
    positions: dict[int, DrivePositions],
    *,
    cancel: Callable[[], bool],
) -> _Varied:
    """The first of some attempts after which no scene is longer than it may be, or the one nearest to that."""
    found = list[_Varied]()
    for begun, calibrations in attempts:
        free = calibrations.free_units
        problem, biased, reports = _varied(assembly, begun, seen, free, positions, calibrations, cancel=cancel)
        lengthened = lengthened_scenes(assembly, begun.state, problem.state, free)
        one = _Varied(
            problem=problem, calibrations=calibrations, positions=biased, reports=reports, lengthened=lengthened
        )
        found.append(one)
        if not lengthened:
            break
    return min(found, key=lambda one: one.worst)


def _varied(
    assembly: Assembly,
    problem: Problem,
    seen: Bools,
    free: Bools,
    positions: dict[int, DrivePositions],
    calibrations: MapCalibrations,
    *,
    cancel: Callable[[], bool],
) -> tuple[Problem, dict[int, DrivePositions], list[Report]]:
    """The problem after free units (u,), the points (p,) that they see and calibrations have varied; in turns with the
    constant errors of positions.
    """
    reports: list[Report] = []
    positions = {k: with_bias(p, problem.state) for k, p in positions.items()}
    for _ in range(ROUNDS if free.any() else 0):
        part = replace(
            problem.of_points(seen),
            layout=Layout.from_free(free, calibrations.cameras, free_intrinsics=calibrations.free_intrinsics),
            terms=[*_terms(assembly, positions, free), *calibrations.terms],
        )
        solution, report = solve_with_chosen_points(
            part, assembly.image_size_px, an_image=OBSERVATIONS_OF_IMAGE, cancel=cancel
        )
        reports.append(report)
        points = problem.state.points_m.copy()
        points[seen] = solution.points_m
        problem = replace(problem, state=replace(solution, points_m=points))
        positions = {k: with_bias(p, problem.state) for k, p in positions.items()}
    return problem, positions, reports


def lengthened_scenes(assembly: Assembly, before: State, after: State, free: Bools) -> dict[int, float]:
    """Factors by which placed scenes got longer, of those that got it by more than they may by their own certainty.

    Those of which no units (u,) vary, or units at one place, have no length.
    """
    result = {}
    for k, scene in enumerate(assembly.scenes):
        units = np.flatnonzero(free & (assembly.scene_of_unit == k))
        if not scene.is_placed or len(units) < 2:
            continue
        was_m, is_m = (float(np.sqrt(state.unit_position_m[units].var(0).sum())) for state in (before, after))
        sigma = max(scene.sigma_scale or 0.0, LEAST_SIGMA_LENGTH)
        if was_m > LEAST_SPREAD_M and abs(np.log(is_m / was_m)) > MOST_LENGTHENED * sigma:
            result[k] = is_m / was_m
    return result


def _with_cameras(problem: Problem, state: State) -> Problem:
    """The problem with another state's cameras, and the points that those observe which are elsewhere now."""
    before = problem.state
    moved = np.zeros(len(problem.camera_kind), dtype=np.bool_)
    for name in ("camera_rotation", "camera_position_m", "camera_params"):
        moved |= (getattr(state, name) != getattr(before, name)).reshape(len(moved), -1).any(1)
    varied = np.zeros(problem.observations.num_points, dtype=np.bool_)
    return _others_refined(replace(problem, state=state), varied, moved)


def _others_refined(problem: Problem, varied: Bools, free_cameras: Bools) -> Problem:
    """The problem with points where calibrations that vary have got, but for those (p,) that varied with units."""
    o, follow = problem.observations, np.zeros_like(varied)
    follow[o.point[free_cameras[o.camera]]] = True
    follow &= ~varied
    if not follow.any():
        return problem
    part = problem.of_points(follow)
    points = problem.state.points_m.copy()
    points[follow] = part.with_points_refined(part.state).points_m
    return replace(problem, state=replace(problem.state, points_m=points))


def _options(config: EngineConfig) -> SolverOptions:
    return SolverOptions(
        max_iterations=20,
        function_tolerance=1e-5,
        loss_scale=config.bundle_adjustment.loss_scale,
        threads=config.threads,
    )


def _free_units(assembly: Assembly, problem: Problem, joined: Bools, config: EngineConfig) -> Bools:
    """Select the units (u,) that vary: all registered ones, those that observe shared points, or none."""
    which = config.aggregation.final_adjustment
    if which == "none":
        return np.zeros(len(assembly.registered), dtype=np.bool_)
    if which == "all":
        return assembly.registered.copy()
    o = problem.observations
    counts = np.bincount(o.unit[joined[o.point]], minlength=len(assembly.registered))
    result: Bools = assembly.registered & (counts >= MIN_SHARED_POINTS)
    return result


def _terms(assembly: Assembly, positions: dict[int, DrivePositions], free: Bools) -> Sequence[Term]:
    terms: list[Term] = []
    for k, p in positions.items():
        terms.append(p.prior)
        units = np.flatnonzero((assembly.scene_of_unit == k) & free)
        if len(units) and assembly.scenes[k].common_world is None:
            terms.append(
                UprightPrior(
                    unit=units,
                    sigma_roll_rad=float(SIGMA_ROLL_RAD),
                    sigma_pitch_rad=float(SIGMA_PITCH_RAD),
                    up=p.up,
                )
            )
    return terms


def _filtered(
    assembly: Assembly, problem: Problem, rows: Ints, owners: Ints, config: EngineConfig
) -> tuple[MapModel, int, int]:
    """The model without observations that do not fit and points that are left with fewer than two."""
    o = problem.observations
    errors = np.sqrt(problem.errors_px2(problem.state))
    keep = errors < config.mapping.filter_error_px
    left = np.bincount(o.point[keep], minlength=o.num_points)
    alive = left >= 2
    keep &= alive[o.point]
    number = np.where(alive, np.cumsum(alive) - 1, -1)
    # What was to be joined may be left to one scene.
    scene = assembly.scene_of_unit[o.unit[keep]]
    first, last = np.full(o.num_points, len(assembly.scenes)), np.full(o.num_points, -1)
    np.minimum.at(first, o.point[keep], scene)
    np.maximum.at(last, o.point[keep], scene)
    model = MapModel(
        state=replace(problem.state, points_m=problem.state.points_m[alive]),
        rows=rows[keep],
        point=number[o.point[keep]],
        owner=np.where(owners >= 0, number[owners], -1),
        joined=(first < last)[alive],
        errors_px=errors[keep],
    )
    return model, int((~keep).sum()), int((~alive).sum())
