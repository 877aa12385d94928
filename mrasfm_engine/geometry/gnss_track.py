"""A receiver's track in a local frame: gross errors found, positions and headings at other times."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.neighbours import nearest_sorted
from mrasfm_engine.types import Bools, Floats, Ints

MAX_BEYOND_S = 0.5  # before the first and after the last sample nothing is known
NEIGHBOURS = 5  # samples on each side that a sample is compared with
MIN_NEIGHBOURS, ENOUGH_NEIGHBOURS = 4, 6  # of both sides, so that one that is wrong itself does little
USUAL_SPAN_S, NEIGHBOUR_SPAN_S = 0.5, 3.0  # on each side: where that holds enough of them, and at most
MIN_JUMP_M = 2.0  # a smaller disagreement is left to the robust losses
HARDEST_MPS2 = 10.0  # a vehicle accelerates and brakes by less
ACCELERATION_SIGMA_MPS2 = HARDEST_MPS2 / 2.0  # the hardest is two sigmas
BRAKING_S, HELD_SIGMAS = 1.0, 3.0  # before a receiver's last positions, which are all the same
HEADING_WINDOWS_S = (0.5, 1.0, 2.0, 4.0, 8.0)  # half widths tried, the narrowest that shows a direction is used
# Of roll, pitch, and the heading against the antenna's track: roads climb by up to 10 % and lean by some per cent, and
# an antenna 1.5 m before the rear axle moves 3 degrees across the heading where the car turns on a radius of 30 m.
ATTITUDE_SIGMA_RAD = np.radians(3.0)
MIN_WAY_M, MIN_WAY_SIGMAS = 1.0, 6.0  # in a window, below which it may be the receiver's drift while the car stands


@dataclass(frozen=True, kw_only=True)
class GnssTrack:
    """Positions of the antenna in a local east-north-up frame, ascending in time.

    `swapped_from_local` (3, 3) takes them to where they would be with latitude and longitude swapped, but for a shift;
    None where these would be no coordinates, or are not known.
    """

    timestamps_us: Ints  # (n,)
    position_m: Floats  # (n, 3)
    sigma_m: Floats  # (n, 3)
    good: Bools  # (n,) False for gross errors and what is held
    swapped_from_local: Floats | None = None
    # (n,) repetitions of the position before, which are not good either; empty where they are not known
    held: Bools = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))

    @property
    def interval_us(self) -> float:
        """Usual time between good samples; 0 where there are not two."""
        return float(np.median(np.diff(self.timestamps_us[self.good]))) if self.good.sum() > 1 else 0.0

    def later_by(self, offset_s: float) -> GnssTrack:
        """The track if its positions were taken by so much later."""
        return replace(self, timestamps_us=self.timestamps_us + round(offset_s * 1e6))

    def at(self, timestamps_us: Ints, *, max_gap_us: int, way_m: Floats | None = None) -> tuple[Floats, Floats]:
        """Positions and sigmas (m, 3) at other times, between good samples; NaN outside and in larger gaps.

        Between two samples they follow the antenna's way, where it is known: they are off it by as much as the samples
        are. Elsewhere they are linear. Where either is a chord, a bend that its neighbours show makes them uncertain.

        Parameters
        ----------
        timestamps_us
            (m,) ascending.
        way_m
            (m, 3) where the antenna was at these times, in axes of the local frame, NaN where that is not known.
        """
        t, p, s = self.timestamps_us[self.good], self.position_m[self.good], self.sigma_m[self.good]
        position, sigma = np.full((len(timestamps_us), 3), np.nan), np.full((len(timestamps_us), 3), np.nan)
        if len(t) < 2:
            same = np.isin(timestamps_us, t)
            position[same], sigma[same] = p[:1], s[:1]
            return position, sigma
        after = np.clip(np.searchsorted(t, timestamps_us), 1, len(t) - 1)
        gap = t[after] - t[after - 1]
        fraction = (timestamps_us - t[after - 1]) / gap
        inside = (fraction >= 0) & (fraction <= 1) & ((gap <= max_gap_us) | (fraction == 0) | (fraction == 1))
        share = fraction[:, None]
        blend = p[after - 1] + share * (p[after] - p[after - 1])
        bend_m = _bend_on_chord_m(fraction, _bends_m(t / 1e6, p, s)[after - 1])
        if way_m is not None:
            (before_m, bend_before_m), (after_m, bend_after_m) = (
                _place_at(t[k], timestamps_us, way_m, gap) for k in (after - 1, after)
            )
            follows_m = way_m - before_m - share * (after_m - before_m)
            known = np.isfinite(follows_m[:, 0])
            blend[known] += follows_m[known]
            bend_m[known] = (bend_before_m + fraction * (bend_after_m - bend_before_m))[known]
        position[inside] = blend[inside]
        sigma[inside] = np.hypot(np.maximum(s[after - 1], s[after]), bend_m[:, None])[inside]
        return position, sigma


def _bends_m(time_s: Floats, position_m: Floats, sigma_m: Floats) -> Floats:
    """Distance (n - 1,) of the middle of every chord between places from a way that bends as its neighbours show.

    What the places' errors (n, 3) make of a bend is taken from it, and no vehicle bends its way as it likes.
    """
    inverse_s, bend_mps2 = 1.0 / np.diff(time_s)[:, None], np.zeros(len(time_s))
    change = np.diff(np.diff(position_m, axis=0) * inverse_s, axis=0)
    after, before = inverse_s[1:], inverse_s[:-1]
    noise = [sigma_m[2:] * after, sigma_m[1:-1] * (after + before), sigma_m[:-2] * before]
    known = np.maximum((change**2).sum(axis=1) - (np.array(noise) ** 2).sum(axis=(0, 2)), 0.0)
    step_s = np.diff(time_s)
    bend_mps2[1:-1] = np.minimum(2.0 * np.sqrt(known) / (step_s[1:] + step_s[:-1]), HARDEST_MPS2)
    result: Floats = np.maximum(bend_mps2[1:], bend_mps2[:-1]) * step_s**2 / 8.0
    return result


def _bend_on_chord_m(fraction: Floats, bend_m: Floats) -> Floats:
    """Distance (m,) from a way at fractions of its chords, whose middles are `bend_m` away."""
    result: Floats = 4.0 * fraction * (1.0 - fraction) * bend_m
    return result


def _place_at(time_us: Ints, known_us: Ints, way_m: Floats, gap_us: Ints) -> tuple[Floats, Floats]:
    """A way (k, 3) at some times (m,), and how far it bends away from there (m,).

    NaN where times at which it is known are as far apart as `gap_us` (m,).
    """
    known = np.isfinite(way_m[:, 0])
    place_m, bend_m = np.full((len(time_us), 3), np.nan), np.full(len(time_us), np.nan)
    if known.sum() < 2:
        return place_m, bend_m
    at_us = known_us[known]
    after = np.clip(np.searchsorted(at_us, time_us), 1, len(at_us) - 1)
    inside = (time_us >= at_us[0]) & (time_us <= at_us[-1])
    # An end of a chord that is one of these times itself needs no other near it.
    fine = inside & ((at_us[after] - at_us[after - 1] < gap_us) | np.isin(time_us, at_us))
    for axis in range(3):
        place_m[fine, axis] = np.interp(time_us[fine], at_us, way_m[known, axis])
    fraction = (time_us - at_us[after - 1]) / (at_us[after] - at_us[after - 1])
    bends_m = _bends_m(at_us / 1e6, way_m[known], np.zeros((len(at_us), 3)))
    bend_m[fine] = _bend_on_chord_m(fraction, bends_m[after - 1])[fine]
    return place_m, bend_m


def find_gross_errors(timestamps_us: Ints, position_m: Floats, sigma_m: Floats, *, outlier_sigmas: float) -> Bools:
    """Mask (n,) of samples far from the line through their neighbours in time.

    The line is fitted with L1 weights, so that single neighbours that are wrong themselves do little. It may be as far
    off as a vehicle gets from a straight line that accelerates as hard as it can meanwhile: of a receiver with few
    samples a second only large errors show here, and the scene shows the others. A sample that only wrong neighbours
    have drawn the line away from, as at the ends of a short drive, is none: each is judged again without them.
    """
    everyone, time_s = np.arange(len(timestamps_us)), timestamps_us / 1e6

    def far(i: int, near: Ints) -> bool:
        if len(near) < MIN_NEIGHBOURS:
            return False
        dt = time_s[near] - time_s[i]
        off_m = position_m[i] - _line_at(dt, position_m[near])
        bend_m = 0.5 * HARDEST_MPS2 * float((dt**2).mean())
        return bool(
            np.linalg.norm(off_m / sigma_m[i]) > outlier_sigmas and np.linalg.norm(off_m) > max(MIN_JUMP_M, bend_m)
        )

    bad = np.array([far(i, _neighbours(i, everyone, time_s)) for i in range(len(time_s))], dtype=np.bool_)
    others = np.flatnonzero(~bad)
    for i in np.flatnonzero(bad).tolist():
        near = _neighbours(i, others, time_s)
        bad[i] = len(near) < MIN_NEIGHBOURS or far(i, near)
    return bad


def _neighbours(i: int, among: Ints, time_s: Floats) -> Ints:
    """Samples out of `among`, ascending, beside sample `i`: a few on each side, in a span that holds enough of them.

    The span is no wider than some need, as the way bends in it.
    """
    k = int(np.searchsorted(among, i))
    after = k + int(k < len(among) and among[k] == i)
    near = np.concatenate([among[max(0, k - NEIGHBOURS) : k], among[after : after + NEIGHBOURS]])
    if not len(near):
        return near
    apart_s = np.abs(time_s[near] - time_s[i])
    enough_s = np.sort(apart_s)[min(ENOUGH_NEIGHBOURS, len(near)) - 1]
    result: Ints = near[apart_s <= np.clip(enough_s, USUAL_SPAN_S, NEIGHBOUR_SPAN_S)]
    return result


def find_held(timestamps_us: Ints, position_m: Floats, sigma_m: Floats) -> Bools:
    """Mask (n,) of samples that repeat the one before them, to the last digit, while the vehicle drives on.

    Loggers write a receiver's last position again until it has a new one, and receivers repeat theirs when they lose
    their fix. The next position then lies farther away than a vehicle gets that moves off from where it stood; at the
    end, where none follows, the vehicle was faster than any that brakes to a stop.
    """
    same = np.concatenate([[False], (np.diff(position_m, axis=0) == 0.0).all(axis=1)])
    held, time_s = np.zeros(len(same), dtype=np.bool_), (timestamps_us - timestamps_us[0]) / 1e6
    first = np.flatnonzero(~same)  # of each run
    for begin, end in zip(first, [*first[1:], len(same)], strict=True):
        if end - begin < 2:
            continue
        if end < len(same):
            moved_m = float(np.linalg.norm(position_m[end] - position_m[begin]))
            held[begin + 1 : end] = moved_m > 0.5 * HARDEST_MPS2 * (time_s[end] - time_s[end - 1]) ** 2
        elif time_s[begin] - time_s[0] >= BRAKING_S:
            earlier = int(np.searchsorted(time_s, time_s[begin] - BRAKING_S, side="right")) - 1
            way_m = float(np.linalg.norm(position_m[begin] - position_m[earlier]))
            noise_m = HELD_SIGMAS * float(np.linalg.norm([sigma_m[earlier], sigma_m[begin]]))
            held[begin + 1 :] = way_m > 0.5 * HARDEST_MPS2 * (time_s[begin] - time_s[earlier]) ** 2 + noise_m
    return held


def _line_at(dt: Floats, position: Floats) -> Floats:
    """Value (3,) at dt = 0 of the line through positions (n, 3), fitted with L1 weights."""
    a = np.stack([np.ones_like(dt), dt], 1)
    weights = np.ones(len(dt))
    line: Floats = np.zeros((2, position.shape[1]))
    for _ in range(60):
        before = line[0]
        line = np.asarray(np.linalg.lstsq(a * weights[:, None], position * weights[:, None], rcond=None)[0])
        if np.abs(line[0] - before).max() < 0.01:
            break
        weights = 1.0 / np.sqrt(np.maximum(np.linalg.norm(position - a @ line, axis=1), 0.1))
    result: Floats = line[0]
    return result


@dataclass(frozen=True, kw_only=True)
class RoughTrajectory:
    """Poses from positions alone, NaN for times that the track does not cover.

    Attributes
    ----------
    world_from_rig
        (m, 4, 4)
    sigma
        (m, 6) standard deviations of the rotation about the axes of the world (rad), and of the position (m).
    """

    world_from_rig: Floats
    sigma: Floats


def rough_trajectory(track: GnssTrack, timestamps_us: Ints, antenna_in_rig_m: Floats) -> RoughTrajectory | None:
    """Poses at some times (m,): heading along the track, level, lever arm applied.

    Where the car stands, it keeps the heading it came with (or leaves with): there, any is possible. None where the
    track shows no direction at all, or does not cover most of the times.
    """
    t, p = track.timestamps_us[track.good] / 1e6, track.position_m[track.good]
    if len(t) < 3:
        return None
    noise = float(np.median(track.sigma_m[track.good, :2]))
    times = np.clip(timestamps_us / 1e6, t[0], t[-1])
    position, heading = np.empty((len(times), 3)), np.full(len(times), np.nan)
    sigma = np.full((len(times), 6), ATTITUDE_SIGMA_RAD)
    sigma[:, 2] = np.pi
    sigma[:, 3:] = track.sigma_m[track.good][nearest_sorted(t, times)]
    for i, now in enumerate(times):
        for half in HEADING_WINDOWS_S:
            near = slice(*np.searchsorted(t, [now - half, np.nextafter(now + half, np.inf)]))
            if near.stop - near.start < 3:
                continue
            centre, velocity, left_m = _fit_motion(t[near] - now, p[near])
            position[i] = centre
            spread = float(np.sqrt(((t[near] - t[near].mean()) ** 2).sum()))
            speed = float(np.linalg.norm(velocity[:2]))
            if speed * spread > 3.0 * noise and speed * np.ptp(t[near]) > max(MIN_WAY_M, MIN_WAY_SIGMAS * noise):
                heading[i] = np.arctan2(velocity[1], velocity[0])
                # Noise averages out over a window, a bend does not.
                across_m = np.sqrt(np.mean((left_m @ [-velocity[1], velocity[0]] / speed) ** 2))
                turn = np.hypot(noise / spread, across_m / np.std(t[near])) / speed
                sigma[i, 2] = np.hypot(ATTITUDE_SIGMA_RAD, turn)
                sigma[i, 3:] = np.hypot(sigma[i, 3:], np.sqrt((left_m**2).sum(1).mean()))
                break
        else:
            position[i] = np.array([np.interp(now, t, p[:, k]) for k in range(3)])
    known = np.flatnonzero(np.isfinite(heading))
    if not len(known):
        return None
    heading = heading[known[nearest_sorted(times[known], times)]]
    rotation = se3.exp_so3(np.stack([np.zeros_like(heading), np.zeros_like(heading), heading], -1))
    poses = se3.transform(rotation, position - rotation @ antenna_in_rig_m)
    beyond = np.abs(times - timestamps_us / 1e6) > MAX_BEYOND_S
    if beyond.mean() > 0.5:
        return None
    poses[beyond], sigma[beyond] = np.nan, np.nan
    return RoughTrajectory(world_from_rig=poses, sigma=sigma)


def _fit_motion(dt: Floats, position: Floats) -> tuple[Floats, Floats, Floats]:
    """Position at dt = 0 and mean velocity by least squares, and what is left of the horizontal positions (n, 2)."""
    a = np.stack([np.ones_like(dt), dt], 1)
    line = np.linalg.lstsq(a, position, rcond=None)[0]
    return line[0], line[1], (position - a @ line)[:, :2]
