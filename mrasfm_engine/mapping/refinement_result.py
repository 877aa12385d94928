"""Decisions and results of the refinement, and the terms, options and certainty that follow from them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from mrasfm_engine.bundle_adjustment.marginal_covariances import (
    MAX_UNKNOWNS_FOR_COVARIANCE,
    Covariances,
    covariances,
)
from mrasfm_engine.bundle_adjustment.observability_analysis import Observability
from mrasfm_engine.bundle_adjustment.priors import CalibrationPrior, ReadoutPrior, ScalePrior, Term
from mrasfm_engine.bundle_adjustment.problem import INTRINSICS
from mrasfm_engine.bundle_adjustment.receiver_positions import ReceiverPositions
from mrasfm_engine.bundle_adjustment.solver import Problem, Report, SolverOptions
from mrasfm_engine.mapping.absolute_priors import AbsolutePriors
from mrasfm_engine.mapping.calibration import CalibrationDecision, calibration_prior, of_cameras_alone
from mrasfm_engine.mapping.intrinsics import IntrinsicsDecision, intrinsics_prior
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.miscalibration import MiscalibratedPair, Miscalibration
from mrasfm_engine.mapping.moving_objects import MovingTracks
from mrasfm_engine.mapping.other_sizes import Parts
from mrasfm_engine.mapping.receiver_fit import Placement
from mrasfm_engine.mapping.road import RoadAssessment
from mrasfm_engine.mapping.systematic_errors import SystematicErrors, systematic_errors
from mrasfm_engine.mapping.time_offsets import (
    SIGMA_READOUT_S,
    TimeCertainty,
    time_prior,
    times_may_vary,
    undeclared_readouts,
)
from mrasfm_engine.types import Bools, Floats
from schemas.findings import Finding

# Of a position, in the inverse that says how certain everything is. Heights that nobody knows are declared to a
# kilometre; beside images, which know units among one another to a tenth of a millimetre, the square of that is lost in
# rounding, and with it what all else is known to. An error that all positions share changes nothing else.
LARGEST_SIGMA_M = 30.0
TOLERANCE = 1e-6
DECREMENT_TOLERANCE = 0.1  # of the last step of the last round: less than half a standard deviation of all together
ROUGH_DECREMENT_TOLERANCE = 1.0  # in those before, after which observations change anyway
INITIAL_DAMPING = 1e-6  # scale is a weak direction, which damping holds up: it must arrive as well


@dataclass(kw_only=True)
class Refinement:
    """Result of the refinement."""

    sigma_px: float = 1.0
    sigma_factor: float = 1.0  # on it beside priors, for what observations share, see `shared_errors`
    absolute: AbsolutePriors = field(default_factory=AbsolutePriors)
    calibration: CalibrationDecision = field(default_factory=lambda: CalibrationDecision(False, ""))
    scale_of_rough_poses: float | None = None  # factor on the rig's lengths as given, where they contradict these
    given_scale: ScalePrior | None = None  # what the rotations as given say of it, where positions do not
    intrinsics: IntrinsicsDecision | None = None  # decided once the calibration is
    is_of_one_camera: bool = False  # by its images; its intrinsics may vary, at its place in the rig as given
    times_vary: bool = False
    mean_time_varies: bool = False
    times: TimeCertainty | None = None  # of the cameras' time offsets; None where it is not known
    recalibrated: Bools = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))  # (cameras,) whose pose varied
    as_grown: Parts | None = None  # the scene before cameras were put back to where they began
    adjustments: list[Report] = field(default_factory=list)
    is_steady: bool = True  # the last one left the weights of positions and the cameras' time offsets as they were
    observations_dropped: int = 0
    points_dropped: int = 0
    units_dropped: list[int] = field(default_factory=list)
    certainty: Covariances | None = None
    systematic: SystematicErrors | None = None  # what comes on top for the cameras; None where it is not known
    directions: Observability | None = None  # of the cameras' poses; None where it is not known
    held: Bools | None = None  # (cameras, 6) directions that were not observed and stay as given
    held_times: Bools | None = None  # (cameras,) time offsets that were not observed and stay zero
    miscalibrations: list[Miscalibration] = field(default_factory=list)
    late_cameras: list[Finding] = field(default_factory=list)
    wrong_pair: MiscalibratedPair | None = None  # of a rig of two cameras
    moving: MovingTracks = field(default_factory=MovingTracks)
    road: RoadAssessment | str = "semantic_triangulation is switched off"  # the last one, or why there is none

    @property
    def intrinsics_are_asked(self) -> bool:
        """True where any camera's intrinsics might vary."""
        return self.intrinsics is not None and bool(self.intrinsics.asked.any())

    @property
    def intrinsics_vary(self) -> bool:
        """True where any camera's intrinsics are free."""
        return self.intrinsics is not None and bool(self.intrinsics.free.any())

    @property
    def placement(self) -> Placement | None:
        """Fit of the receiver's positions, where these were to be used."""
        return self.absolute.placement

    @property
    def placed_by_rough_poses(self) -> bool:
        """The scene stands where rough poses say."""
        return self.absolute.placed_by_rough_poses

    @property
    def georeferenced(self) -> bool:
        """The scene stands where the receiver says."""
        return self.absolute.positions is not None

    @property
    def is_placed(self) -> bool:
        """Positions or rough poses say where the scene stands, and may say how large it is."""
        return self.georeferenced or self.placed_by_rough_poses


def solver_options(mapper: Mapper, result: Refinement, *, rough: bool = False) -> SolverOptions:
    """Options of adjustments whose observations err as is known by now; `rough` ones end earlier.

    What observations share takes weight from all of them beside the priors. In pixels their loss stays as it is.
    """
    return SolverOptions(
        max_iterations=15 if rough else 40,
        function_tolerance=TOLERANCE,
        decrement_tolerance=ROUGH_DECREMENT_TOLERANCE if rough else DECREMENT_TOLERANCE,
        initial_damping=INITIAL_DAMPING,
        loss_scale=mapper.config.bundle_adjustment.loss_scale / result.sigma_factor,
        sigma_px=result.sigma_px * result.sigma_factor,
        threads=mapper.config.threads,
    )


def free_units_of(mapper: Mapper, absolute: AbsolutePriors) -> Bools:
    """All registered units; where nothing else holds the frame, the first one does."""
    free = mapper.registered.copy()
    if not (absolute.hold_the_frame and mapper.config.bundle_adjustment.priors):
        free[np.flatnonzero(free)[0]] = False
    return free


def terms_of(mapper: Mapper, result: Refinement) -> list[Term]:
    """Priors of everything that varies, and of where the scene lies."""
    terms: list[Term] = []
    if not mapper.config.bundle_adjustment.priors:
        return terms
    if result.calibration.free:
        terms.append(calibration_prior(mapper, result.held))
        terms += [] if result.given_scale is None else [result.given_scale]
    elif result.recalibrated.any():
        # The cameras that stay hold the gauge.
        of_others = (~result.recalibrated).astype(np.float64)
        terms.append(replace(calibration_prior(mapper, result.held), gauge_weights=of_others))
    if result.is_of_one_camera:
        terms.append(calibration_prior(mapper, np.ones((len(mapper.camera_kind), 6), dtype=np.bool_)))
    if result.intrinsics_vary:
        terms.append(intrinsics_prior(mapper))
    if result.times_vary:
        terms.append(time_prior(mapper, mean_varies=result.mean_time_varies, held=result.held_times))
    return terms + result.absolute.terms(mapper)


def terms_of_all_cameras(mapper: Mapper, result: Refinement) -> list[Term]:
    """The same where all cameras and their times vary under their priors, also where these were held: their errors are
    there as well.
    """
    is_kept = result.calibration.free or result.is_of_one_camera
    terms = [term for term in terms_of(mapper, result) if is_kept or not isinstance(term, CalibrationPrior)]
    if not mapper.drive.has_single_camera and not result.calibration.free:
        terms.append(calibration_prior(mapper))
    if times_may_vary(mapper) and not result.times_vary:
        terms.append(time_prior(mapper, mean_varies=False))
    return terms


def certainty_of(mapper: Mapper, result: Refinement) -> Covariances | None:
    """Covariances with the calibration free under its prior, also where it was held: its error is there as well.

    None where they would not be those of what was adjusted, and where there is too much for an inverse.
    """
    problem = problem_of_all_unknowns(mapper, result)
    if problem is None:
        return None
    problem, left_out_m = _with_bounded_positions(problem)
    certainty = of_cameras_alone(mapper, covariances(problem, problem.state))
    certainty = replace(certainty, sigma_unit_position_m=np.hypot(certainty.sigma_unit_position_m, left_out_m))
    return _with_errors_of_given_scale(mapper, result, certainty)


def _with_bounded_positions(problem: Problem) -> tuple[Problem, Floats]:
    """The problem with no position less known than `LARGEST_SIGMA_M`, and the common error (3,) that leaves out."""
    left_out_m, terms = np.zeros(3), list[Term]()
    for term in problem.terms:
        if isinstance(term, ReceiverPositions):
            bounded, left_out_m = term.bounded(LARGEST_SIGMA_M)
            terms.append(bounded)
        else:
            terms.append(term)
    return replace(problem, terms=terms), left_out_m


def problem_of_all_unknowns(mapper: Mapper, result: Refinement) -> Problem | None:
    """The adjustment whose inverse says how certain everything is; None as for `certainty_of`."""
    if not (mapper.config.bundle_adjustment.priors and mapper.config.bundle_adjustment.camera_set_adjustment):
        return None
    several, terms = not mapper.drive.has_single_camera, terms_of_all_cameras(mapper, result)
    free_intrinsics = None
    if result.intrinsics_are_asked:
        # Whoever lets the focal length vary is not certain of the others either.
        free_intrinsics = np.ones((len(mapper.camera_kind), INTRINSICS), dtype=np.bool_)
        if not result.intrinsics_vary:
            terms.append(intrinsics_prior(mapper))
    times_vary = several and times_may_vary(mapper)
    if times_vary:
        terms.append(ReadoutPrior(sigma_s=SIGMA_READOUT_S))
    problem, _ = mapper.problem(
        free_units_of(mapper, result.absolute),
        free_cameras=np.full(len(mapper.camera_kind), several or result.is_of_one_camera),
        free_intrinsics=free_intrinsics,
        free_times=np.full(len(mapper.camera_kind), times_vary),
        free_readouts=undeclared_readouts(mapper) & times_vary,
        terms=terms,
        options=solver_options(mapper, result),
    )
    return None if problem.layout.size > MAX_UNKNOWNS_FOR_COVARIANCE else problem


def systematic_errors_of(mapper: Mapper, result: Refinement, free_units: Bools) -> SystematicErrors | None:
    """Errors of the cameras that all images share, as those of lens models, which the certainty does not have.

    None where cameras were held, and where intrinsics varied: then what lenses err by is in the certainty.
    """
    if result.certainty is None or not result.calibration.free or result.intrinsics_vary:
        return None
    return systematic_errors(
        mapper,
        free_units=free_units & mapper.registered,
        free_times=result.recalibrated if result.times_vary else None,
        terms=[term for term in terms_of(mapper, result) if not isinstance(term, ScalePrior)],
        given_scale=result.given_scale,
        options=solver_options(mapper, result),
    )


def _with_errors_of_given_scale(mapper: Mapper, result: Refinement, certainty: Covariances) -> Covariances:
    """The certainty with what lens models and given rotations leave open, where positions do not tell the scale.

    That is of the scale, and of the rotations that were asked to come to it.
    """
    if result.given_scale is None:
        return certainty
    of_cameras = np.zeros((len(mapper.camera_kind), 6))
    of_cameras[:, :3] = result.given_scale.by_steps(mapper.state)
    certainty = certainty.with_scale_error(result.given_scale.sigma_scale)
    return certainty.with_calibration_error(of_cameras.ravel(), result.given_scale.sigma_of_corrections)
