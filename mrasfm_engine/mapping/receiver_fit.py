"""Fit of a receiver's positions to the scene: outliers, jumps of its error, and the sizes of what scatters and what
wanders."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import scipy.linalg
from numpy.lib.stride_tricks import sliding_window_view
from scipy.optimize import minimize

from mrasfm_engine.bundle_adjustment.receiver_likelihood import restricted_log_likelihood
from mrasfm_engine.bundle_adjustment.receiver_positions import ReceiverPositions, time_of_process_s
from mrasfm_engine.geometry.gnss_track import GnssTrack
from mrasfm_engine.geometry.neighbours import nearest
from mrasfm_engine.mapping.georeferencing import BENT, MOST, GnssAlignment, assess_residuals, similarity_motions
from mrasfm_engine.mapping.lever_arm import LeverArm
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.receiver_clock import SIGMA_OF_WRONG_CLOCK_S, ReceiverClock
from mrasfm_engine.mapping.receiver_jumps import find_jumps, segment_of
from mrasfm_engine.types import Bools, Floats, Ints
from schemas.findings import Finding

MIN_POSITIONS = 3
MIN_WHITE = 0.01  # of the declared sigma: of a receiver that filters, positions scatter by nothing that shows
STEADY = 1.5
MAX_BETWEEN_UNITS = 3.0  # usual times between units, across which the antenna's way is a straight line
USUAL_LOG_SIGMA = np.log(2.0)  # standard deviation of the logarithm of a receiver's errors over what it declares
MOST_RESIDUALS, MIN_FOR_LIKELIHOOD = 150, 8


@dataclass(frozen=True, kw_only=True)
class ReceiverErrors:
    """Errors of a receiver's positions, of which some scatter and some wander, in the declared sigmas.

    Attributes
    ----------
    white
        Standard deviation of what differs from sample to sample,
    wander
        and of what wanders.
    positions_a_sample
        Number of units whose positions are interpolated between the same two samples.
    unseen
        Standard deviation that is left of the declared one by how positions scatter, where these are too few to say
        that anything wanders: all of them may be off by so much together.
    """

    white: float = 1.0
    wander: float = 0.0
    positions_a_sample: int = 1
    unseen: float = 0.0

    def is_as_large_as(self, other: ReceiverErrors) -> bool:
        """True where neither differs by more than a factor that a few samples leave open."""
        sizes = np.array([[e.white, e.wander] for e in (self, other)]) + MIN_WHITE
        return bool((np.abs(np.log(sizes[0] / sizes[1])) < np.log(STEADY)).all())


@dataclass(kw_only=True)
class Placement:
    """Fit of the reconstruction to the receiver's positions; without a prior it does not fit, for the reason given."""

    prior: ReceiverPositions | None = None
    reason: str = ""
    is_of_another_scale: bool = False  # which is all that the positions contradict
    remedy: str = ""  # for that reason, where it is not to check the positions
    alignment: GnssAlignment | None = None
    scale_of_rig: float = 1.0  # factor on the rig's lengths as given that makes the scene fit positions best
    known_m: Floats = field(default_factory=lambda: np.zeros((0, 3)))  # (u, 3) positions, NaN where there is none
    known_sigma_m: Floats = field(default_factory=lambda: np.zeros((0, 3)))  # (u, 3)
    lever_arm_m: Floats = field(default_factory=lambda: np.zeros(3))
    units: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # (n,) that were assessed last
    inlier: Bools = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))  # (n,)
    off_m: Floats = field(default_factory=lambda: np.zeros((0, 3)))  # (n, 3) scene minus measured, as assessed last
    interval_us: float = 0.0  # of the receiver's samples
    track: GnssTrack | None = None  # the receiver's, where jumps of its error are looked for
    clock: ReceiverClock | None = None  # at which the track has its times; None where it is taken to be right
    lever: LeverArm | None = None  # where the lever arm is estimated: by how much it is another one than was given
    noise_factor: float = 1.0  # by which residuals exceed their sigmas
    errors: ReceiverErrors = field(default_factory=ReceiverErrors)
    jumps: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # (k,) units from which on it is another
    blended: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # units between two samples of a jump
    level_m: Floats = field(default_factory=lambda: np.zeros((1, 3)))  # (k + 1, 3) what each part adds to positions
    findings: list[Finding] = field(default_factory=list)  # what a user should look at

    @property
    def unseen_m(self) -> Floats:
        """Standard deviations (3,) of an error that all positions may share, see `ReceiverErrors.unseen`."""
        units = self.units[self.inlier]
        if not len(units):
            return np.zeros(3)
        result: Floats = self.errors.unseen * np.median(self.known_sigma_m[units], axis=0)
        return result

    @property
    def residuals_m(self) -> Floats:
        """Scene minus measured (n, 3), without what the receiver's error jumps by."""
        result: Floats = self.off_m - self.level_m[segment_of(self.units, self.jumps)]
        return result

    @property
    def is_contradicted(self) -> bool:
        """True where the scene does not have the shape of most positions."""
        if self.prior is None:
            return False
        return bool(self.noise_factor > BENT or self.inlier[~np.isin(self.units, self.blended)].mean() < MOST)


def with_jumps(mapper: Mapper, placement: Placement) -> Placement:
    """The placement with the units at which the receiver's error jumps, and positions judged by how they lie to those
    of their own part.

    Outliers take part, as all positions behind a jump may be. What is interpolated across a jump is one. Parts lie to
    the largest one as the scene shows: of how far an error jumps no receiver says anything, and what is left of it is
    judged again when the scene has been adjusted.
    """
    none = np.zeros(0, dtype=np.int64)
    placement = replace(placement, jumps=none, blended=none, level_m=np.zeros((1, 3)))
    if placement.track is None or len(placement.units) < MIN_POSITIONS:
        return placement
    times_s = mapper.drive.timestamps_us[placement.units] / 1e6
    before_s, after_s = _jump_times_s(mapper, placement, times_s)
    if not len(after_s):
        return placement
    between = (times_s[:, None] > before_s) & (times_s[:, None] < after_s)
    blended = np.asarray(between.any(axis=1), dtype=np.bool_)
    segment = np.searchsorted(after_s, times_s, side="right")
    level_m = np.zeros((len(after_s) + 1, 3))
    for part in np.unique(segment):  # some may be shorter than the time between units
        level_m[part] = np.median(placement.off_m[segment == part], axis=0)
    # The scene may lie between them: an adjustment moves it to the largest one, as a whole.
    inlier, factor = assess_residuals(
        placement.off_m - level_m[segment],
        placement.known_sigma_m[placement.units],
        ~blended,
        outlier_sigmas=mapper.config.gnss.outlier_sigmas,
    )
    inlier &= ~blended
    if inlier.sum() < MIN_POSITIONS:
        return placement
    return replace(
        placement,
        inlier=inlier,
        noise_factor=factor,
        jumps=placement.units[np.searchsorted(times_s, after_s)],
        blended=placement.units[blended],
        level_m=level_m - level_m[np.bincount(segment).argmax()],
    )


def _jump_times_s(mapper: Mapper, placement: Placement, times_s: Floats) -> tuple[Floats, Floats]:
    """Times (k,) of the last samples before jumps of the receiver's error, and of the first ones after them.

    Of samples that come more often than units, those nearest to units take part.
    """
    track = placement.track
    assert track is not None
    rows, off_m = residuals_of_samples_m(mapper, track, placement.units, placement.lever_arm_m)
    at_s = track.timestamps_us[rows] / 1e6
    if len(rows) and placement.interval_us / 1e6 < 0.75 * float(np.median(np.diff(times_s))):
        near = np.unique(nearest(at_s[:, None], times_s[:, None])[1])
        rows, off_m, at_s = rows[near], off_m[near], at_s[near]
    first = find_jumps(off_m, track.sigma_m[rows], at_s, wander_time_s=mapper.config.gnss.wander_time_s)
    return at_s[first - 1], at_s[first]


def residuals_of_samples_m(mapper: Mapper, track: GnssTrack, units: Ints, lever_arm_m: Floats) -> tuple[Ints, Floats]:
    """Good samples (m,) of a receiver within the times of some units, and how far (m, 3) the scene is from them.

    A sample is compared with the scene at its own time: of positions that are interpolated, several have its error.
    Where no unit is near, the scene says nothing of where the antenna was.
    """
    times_s, sample_s = mapper.drive.timestamps_us[units] / 1e6, track.timestamps_us / 1e6
    if len(units) < 2:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3))
    rows = np.flatnonzero(track.good & (sample_s >= times_s[0]) & (sample_s <= times_s[-1]))
    after = np.clip(np.searchsorted(times_s, sample_s[rows]), 1, len(times_s) - 1)
    rows = rows[times_s[after] - times_s[after - 1] <= MAX_BETWEEN_UNITS * float(np.median(np.diff(times_s)))]
    antenna_m = antenna_places_m(mapper, units, lever_arm_m)
    there_m = [np.interp(sample_s[rows], times_s, antenna_m[:, axis]) for axis in range(3)]
    return rows, np.stack(there_m, axis=1) - track.position_m[rows]


def without_wrong_samples(mapper: Mapper, track: GnssTrack, units: Ints, lever_arm_m: Floats) -> GnssTrack:
    """The track without samples that jump against the scene, where these are fewer than the units (n,).

    Interpolated, one of them would be a ramp over all units between its neighbours, which looks like a scene that
    bends.
    """
    if track.good.sum() < MIN_POSITIONS or _units_a_sample(mapper, units, track.interval_us) < 2:
        return track
    rows, off_m = residuals_of_samples_m(mapper, track, units, lever_arm_m)
    if len(rows) < MIN_POSITIONS:
        return track
    fits, _ = assess_residuals(
        off_m, track.sigma_m[rows], np.ones(len(rows), dtype=np.bool_), outlier_sigmas=mapper.config.gnss.outlier_sigmas
    )
    good = track.good.copy()
    good[rows[~fits]] = False
    return replace(track, good=good)


def receiver_errors(mapper: Mapper, placement: Placement) -> ReceiverErrors:
    """Tell white errors from wandering ones by how positions scatter about the scene from one to the next.

    The scatter's share of the declared variance is white, and averages out; the rest wanders. Scatter that is not
    clearly less than declared is all of it, and so is one of which nothing is seen: few positions that all wander
    together would have the way between them exactly. What it is less by may be an error of all of them.
    """
    good = placement.inlier
    apart = _units_a_sample(mapper, placement.units[good], placement.interval_us)
    whitened = placement.off_m[good] / placement.known_sigma_m[placement.units[good]]
    if apart > 1 and placement.track is not None:  # positions between two samples are a blend of both
        track = without_wrong_samples(mapper, placement.track, placement.units[good], placement.lever_arm_m)
        rows, off_m = residuals_of_samples_m(mapper, track, placement.units[good], placement.lever_arm_m)
        steps = np.diff(off_m / track.sigma_m[rows], axis=0)
    else:
        steps = whitened[apart:] - whitened[:-apart]
    steps = steps.ravel() / (np.sqrt(2.0) * placement.noise_factor)
    white = float((np.median(np.abs(steps)) / 0.6745) ** 2) if len(steps) else 1.0
    # A variance from the median of n normal numbers is uncertain by 2.3 / sqrt(n) of itself; neighbouring steps
    # share a sample, which makes n half of them.
    rest = placement.noise_factor * float(np.sqrt(1.0 - min(white, 1.0)))
    if white > 1.0 - 2.0 * 2.3 / np.sqrt(0.5 * max(len(steps), 1)):
        return ReceiverErrors(white=placement.noise_factor, positions_a_sample=apart, unseen=rest)
    return ReceiverErrors(
        white=placement.noise_factor * max(float(np.sqrt(white)), MIN_WHITE), wander=rest, positions_a_sample=apart
    )


def most_likely_errors(mapper: Mapper, placement: Placement, *, clock_varies: bool = False) -> ReceiverErrors:
    """The sizes of both kinds of errors that residuals make most likely, and what was declared.

    Where the scene lies, how it is turned and how large it is takes no part in it, and, if `clock_varies`, nor does
    when its images were taken. Receivers that err by twice or half of what they declare are usual. What wanders is at
    most what residuals exceed their sigmas by: more, the scene makes of errors of its own.
    """
    begin = receiver_errors(mapper, placement)
    good = np.flatnonzero(placement.inlier)
    good = good[:: max(begin.positions_a_sample, -(-len(good) // MOST_RESIDUALS))]
    whitened = placement.off_m[good] / placement.known_sigma_m[placement.units[good]]
    good = good[_among_neighbours(whitened, mapper.config.gnss.outlier_sigmas)]
    if len(good) < MIN_FOR_LIKELIHOOD or begin.wander == 0.0:
        return begin  # what scatters by as much as is declared leaves nothing that wanders
    units, off_m = placement.units[good], placement.off_m[good]
    place_m = antenna_places_m(mapper, units, placement.lever_arm_m)
    segment, wander_time_s = segment_of(units, placement.jumps), mapper.config.gnss.wander_time_s
    # The size of a jump says nothing of what scatters and wanders.
    behind = segment[:, None] > np.arange(len(placement.jumps))
    ways = [similarity_motions(place_m), *(part[:, None, None] * np.eye(3) for part in behind.T)]
    if clock_varies:
        ways.append(mapper.motion.velocity_mps(mapper.state, mapper.registered)[units][:, :, None])
    # Along a straight line they are fewer.
    moves = scipy.linalg.orth(np.concatenate(ways, axis=2).reshape(3 * len(place_m), -1), rcond=1e-6)
    moves = moves.reshape(len(place_m), 3, -1)
    sigma_m, time_s = placement.known_sigma_m[units], mapper.drive.timestamps_us[units] / 1e6
    declared_errors = ReceiverPositions(
        unit=units,
        position_m=placement.known_m[units],
        sigma_m=sigma_m,
        wander_m=sigma_m,
        lever_arm_m=placement.lever_arm_m,
        time_s=time_s,
        knots_s=time_of_process_s(time_s, segment, wander_time_s),
        wander_time_s=wander_time_s,
        segment=segment,
        clock_m=clock_moves_m(mapper, placement, units),
        lever_m=lever_moves_m(mapper, placement, units),
    )
    least, most = np.log([MIN_WHITE, MIN_WHITE]), np.log([np.inf, placement.noise_factor])

    log_likelihood = restricted_log_likelihood(declared_errors, off_m, moves)

    def unlikelihood(log_sizes: Floats) -> float:
        white, wander = np.exp(np.clip(log_sizes, least, most))
        declared = float(np.log(np.hypot(white, wander)) / USUAL_LOG_SIGMA) ** 2
        return 0.5 * declared - log_likelihood(white, wander)

    start = np.log([max(begin.white, MIN_WHITE), max(begin.wander, 0.3)])
    simplex = start + np.array([[0.0, 0.0], [0.7, 0.0], [0.0, -0.7]])
    found = minimize(
        unlikelihood,
        start,
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 0.05, "fatol": 0.01, "maxiter": 60},
    )
    white, wander = np.exp(np.clip(found.x, least, most))
    return ReceiverErrors(white=float(white), wander=float(wander), positions_a_sample=begin.positions_a_sample)


def _among_neighbours(residuals: Floats, outlier_sigmas: float) -> Bools:
    """Residuals (n, 3) in the order of time that are no farther from their neighbours' median than others are.

    Of normal ones, half are within half a standard deviation of it: they may be twice as many away.
    """
    window = sliding_window_view(np.pad(residuals, ((2, 2), (0, 0)), mode="reflect"), 5, axis=0)
    away = residuals - np.median(window, axis=2)
    usual = float(np.median(np.abs(away))) / 0.6745
    result: Bools = np.linalg.norm(away, axis=1) <= 2.0 * outlier_sigmas * max(usual, 1e-9)
    return result


def _units_a_sample(mapper: Mapper, units: Ints, interval_us: float) -> int:
    """Number of units (n,) whose positions are interpolated between the same two samples, at least one."""
    if len(units) < MIN_POSITIONS:
        return 1
    return max(1, round(interval_us / float(np.median(np.diff(mapper.drive.timestamps_us[units])))))


def clock_moves_m(mapper: Mapper, placement: Placement, units: Ints) -> Floats | None:
    """Ways (n, 3) that positions at some units move if a clock is ahead by a sigma; None where it is right."""
    if placement.clock is None:
        return None
    result: Floats = SIGMA_OF_WRONG_CLOCK_S * mapper.motion.velocity_mps(mapper.state, mapper.registered)[units]
    return result


def lever_moves_m(mapper: Mapper, placement: Placement, units: Ints) -> Floats | None:
    """Ways (n, 3, 3) that positions at some units move if the antenna is off by a sigma; None where it is exact."""
    if placement.lever is None:
        return None
    result: Floats = placement.lever.sigma_before_m * mapper.state.unit_rotation[units]
    return result


def antenna_places_m(mapper: Mapper, units: Ints, lever_arm_m: Floats) -> Floats:
    """Places (n, 3) of the antenna at some units."""
    result: Floats = mapper.state.unit_position_m[units] + mapper.state.unit_rotation[units] @ lever_arm_m
    return result
