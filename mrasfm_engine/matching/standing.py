"""Units of a standing car, found in small images before anything is extracted.

A minute at a red light is hundreds of units that show the same. Of a stop the first and the last unit are included,
those between take no part in the reconstruction and get their poses from these two (see `scene.standing_units`).

Each unit is compared with the last one that moved, so that the steps of a creeping car add up. While the car stands
two units a second are, and what lies between two that stand where the same unit does stands there as well. Where the
prior trajectory shows motion no image is read.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from itertools import chain, pairwise
from pathlib import Path

import numpy as np

from mrasfm_engine.errors import CancelledError, InputError
from mrasfm_engine.features.extraction import one_opencv_thread
from mrasfm_engine.io.image_header import read_header
from mrasfm_engine.io.images import check_image_header
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory
from mrasfm_engine.matching.small_image_motion import small_images, unit_motion_px
from mrasfm_engine.scene.drive import Drive, DriveImage
from mrasfm_engine.types import Bools, Cancel, Floats, Floats32, Ints

# The prior shows motion where it went this many sigmas, and a metre, within a window.
MOVED_SIGMAS, MOVED_M = 6.0, 1.0
WINDOWS_S = (0.5, 1.0, 2.0)  # before the unit, and after it: a stop of two seconds and more is seen
# A car that accelerates and brakes by 4 m/s^2 gets no farther than 6 cm and back within this time.
UNREAD_S = 0.5
AHEAD = 2  # units that wait to be looked at, by thread


@dataclass(frozen=True, kw_only=True)
class Standing:
    """Units of a drive by what small images show.

    Attributes
    ----------
    included
        (units,) those that are reconstructed; the others stand between two of them.
    moved_px
        (units,) how far a unit that is left out moved against the first of its stop, at full size: in the camera that
        moved most, but for cameras that show something else; NaN for the other units.
    compared
        Number of units whose images were read.
    """

    included: Bools
    moved_px: Floats
    compared: int

    def spans(self) -> list[tuple[int, int]]:
        """First and last unit, both included, of each stop."""
        included = np.flatnonzero(self.included).tolist()
        return [(a, b) for a, b in pairwise(included) if b - a > 1]


def find_standing(
    drive: Drive,
    prior: PriorTrajectory,
    *,
    min_motion_px: float,
    repeated: Collection[str] = (),
    threads: int,
    cancel: Cancel | None = None,
) -> Standing:
    """Find the units that moved less than `min_motion_px`, in pixels of full images.

    A drive without any motion keeps all units, as mapping does. Units with an image that is missing or ends early are
    not left out, nor any with one that is looked at and cannot be read: the extraction says what is wrong with it.

    Files that are `repeated` say nothing of the vehicle. Units without others stand if the next unit that has any does.

    Raises
    ------
    CancelledError
        Where `cancel` answers True.
    """
    moves, of_unit = moving_by_prior(drive, prior), _by_unit(drive)
    tells = np.array([not images or any(i.file not in repeated for i in images) for images in of_unit])
    # A standing unit is compared with one before it: the last that moves is read as well.
    telling = np.flatnonzero(tells)
    wanted = telling[~moves[telling] | np.append(~moves[telling[1:]], False)]

    def small(place: int) -> dict[int, Floats32]:
        if cancel is not None and cancel():
            raise CancelledError
        return small_images(drive, [image for image in of_unit[wanted[place]] if image.file not in repeated])

    def are_whole(units: Ints) -> bool:
        return all(is_whole(drive.path_of(image.file)) for unit in units for image in of_unit[unit])

    last = _LastMoved(moves, _PriorWay.from_prior(drive, prior), min_motion_px)
    stands, moved_px = np.zeros(len(moves), dtype=np.bool_), np.full(len(moves), np.nan)
    following = _following(drive.timestamps_us[wanted], np.searchsorted(telling, wanted), moves[wanted])
    place, one_by_one = 0, 1  # in `wanted`: of the first unit that is not judged, and until where none goes unread
    with one_opencv_thread(), closing(_ReadAhead(threads, small)) as images:
        while place < len(wanted):
            goes_on = place >= one_by_one and bool(stands[wanted[place - 1]])
            looked_at = following[place - 1] if goes_on else place
            now = images.at(looked_at, _upcoming(looked_at, following, standing=goes_on))
            unit, unread = int(wanted[looked_at]), wanted[place:looked_at]
            all_px, most_px = last.motion_px(unit, now)
            if len(unread) and (all_px >= min_motion_px or not are_whole(unread)):
                one_by_one = looked_at + 1
                continue
            if all_px < min_motion_px:
                stands[wanted[place : looked_at + 1]] = True
                moved_px[unread] = max(moved_px[wanted[place - 1]], most_px)
                moved_px[unit] = most_px
            else:
                last.unit, last.images = unit, now
            place = looked_at + 1
            images.forget(place)
    _judge_by_next(stands, moved_px, tells=tells, moves=moves)
    included = ~(stands & np.append(stands[1:], False))  # the last one of a stop is included
    if stands[telling].sum() >= len(telling) - 1:
        included[:] = True
    return Standing(included=included, moved_px=np.where(included, np.nan, moved_px), compared=len(images.asked))


def _judge_by_next(stands: Bools, moved_px: Floats, *, tells: Bools, moves: Bools) -> None:
    """Judge units (u,) that tell nothing by the next one that does: where that stands, nothing moved before it."""
    for unit in np.flatnonzero(~tells)[::-1].tolist():
        if unit + 1 < len(stands) and not moves[unit]:
            stands[unit], moved_px[unit] = stands[unit + 1], moved_px[unit + 1]


def is_whole(path: Path) -> bool:
    """Return whether an image has a sound header and its end; no pixel is decoded."""
    try:
        check_image_header(read_header(path), path)
    except InputError:
        return False
    return True


class _LastMoved:
    """The last unit that moved, with which those after it are compared."""

    def __init__(self, moves: Bools, way: _PriorWay, min_motion_px: float) -> None:
        self._moves, self._way, self._min_motion_px = moves, way, min_motion_px
        self.unit, self.images = 0, dict[int, Floats32]()

    def motion_px(self, unit: int, images: dict[int, Floats32]) -> tuple[float, float]:
        """Motion of a unit since then, see `unit_motion_px`; infinite where the prior shows motion."""
        if self._moves[unit] or self._way.shows_motion(self.unit, unit):
            return np.inf, np.inf
        return unit_motion_px(self.images, images, min_motion_px=self._min_motion_px)


class _ReadAhead:
    """Small images, read in threads before they are asked for."""

    def __init__(self, threads: int, read: Callable[[int], dict[int, Floats32]]) -> None:
        self._pool, self._read, self._most = ThreadPoolExecutor(threads), read, AHEAD * threads
        self._futures: dict[int, Future[dict[int, Floats32]]] = {}
        self.asked: set[int] = set()

    def at(self, place: int, upcoming: Iterable[int]) -> dict[int, Floats32]:
        """Images at a place; of upcoming ones some are read meanwhile, the first ones first."""
        for one in chain((place,), upcoming):
            if one not in self._futures:
                if one != place and len(self._futures) >= self._most:
                    break
                self._futures[one] = self._pool.submit(self._read, one)
        self.asked.add(place)
        return self._futures[place].result()

    def forget(self, before: int) -> None:
        """Let go of what lies before a place."""
        self._futures = {place: future for place, future in self._futures.items() if place >= before}

    def close(self) -> None:
        """Wait for what is being read, and read no more."""
        self._pool.shutdown(wait=True, cancel_futures=True)


def _upcoming(place: int, following: Sequence[int], *, standing: bool) -> Iterator[int]:
    """Places that are looked at after one if the car goes on to stand, or does not."""
    while (place := following[place] if standing else place + 1) < len(following):
        yield place


def _following(times_us: Ints, number: Ints, moves: Bools) -> list[int]:
    """The place that is looked at after each of some places while the car stands: the next one or a farther one.

    Between the two lie units that follow one another by their `number`, of which none moves by the prior, and no more
    time than may go unread.
    """
    count = len(number)
    ends = np.append(np.flatnonzero((np.diff(number) > 1) | moves[1:]), count - 1)
    end = ends[np.searchsorted(ends, np.arange(count))]
    in_time = np.searchsorted(times_us, times_us + round(UNREAD_S * 1e6), side="right") - 1
    result: list[int] = np.maximum(np.minimum(in_time, end), np.arange(count) + 1).tolist()
    return result


def moving_by_prior(drive: Drive, prior: PriorTrajectory) -> Bools:
    """Units (u,) before and after which the prior trajectory shows motion far beyond its own error.

    Stops shorter than the window are not seen then, and their units are reconstructed.
    """
    way, times_s = _PriorWay.from_prior(drive, prior), drive.timestamps_us / 1e6
    moves = np.zeros(len(times_s), dtype=np.bool_)
    for window_s in WINDOWS_S:
        moves |= way.known & way.moved(times_s - window_s, times_s) & way.moved(times_s, times_s + window_s)
    return moves


@dataclass(frozen=True, kw_only=True)
class _PriorWay:
    """Horizontal way by the prior trajectory, where there is one."""

    times_s: Floats  # (units,)
    known: Bools  # (units,)
    position_m: Floats  # (known units, 2)
    sigma_m: Floats  # (known units,)

    @staticmethod
    def from_prior(drive: Drive, prior: PriorTrajectory) -> _PriorWay:
        times_s = drive.timestamps_us / 1e6
        if prior.world_from_rig is None or prior.sigma is None:
            none = np.zeros(0)
            return _PriorWay(
                times_s=times_s,
                known=np.zeros(len(times_s), dtype=np.bool_),
                position_m=none.reshape(0, 2),
                sigma_m=none,
            )
        known = np.isfinite(prior.world_from_rig[:, 0, 3]) & np.isfinite(prior.sigma).all(axis=1)
        return _PriorWay(
            times_s=times_s,
            known=known,
            position_m=prior.world_from_rig[known, :2, 3],
            sigma_m=prior.sigma[known, 3:5].max(axis=1),
        )

    def moved(self, from_s: Floats, to_s: Floats) -> Bools:
        """Between pairs of times (n,): whether the way is far beyond what the positions may be wrong by."""
        if not self.known.any():
            return np.zeros(len(from_s), dtype=np.bool_)
        (xa, ya, sa), (xb, yb, sb) = (
            [np.interp(at, self.times_s[self.known], v) for v in (*self.position_m.T, self.sigma_m)]
            for at in (from_s, to_s)
        )
        result: Bools = np.hypot(xb - xa, yb - ya) > np.maximum(MOVED_M, MOVED_SIGMAS * np.hypot(sa, sb))
        return result

    def shows_motion(self, unit_a: int, unit_b: int) -> bool:
        """Answer `moved` for two units of which the prior knows something."""
        units = np.array([unit_a, unit_b])
        return bool(self.known[units].all() and self.moved(self.times_s[units[:1]], self.times_s[units[1:]])[0])


def _by_unit(drive: Drive) -> list[list[DriveImage]]:
    result: list[list[DriveImage]] = [[] for _ in drive.timestamps_us]
    for image in drive.images:
        result[image.unit].append(image)
    return result
