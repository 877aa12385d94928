"""Places at which the scene lets the vehicle jump: what no vehicle does, images of places that look alike do.

Facades, fences and segments of tunnels repeat. Where more of what two units see is alike than the same, they are put
one period apart from where they are, and all that follows with them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mrasfm_engine.geometry.gnss_track import ACCELERATION_SIGMA_MPS2
from mrasfm_engine.geometry.local_motion import MAX_GAP_S
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.types import Floats, Ints
from schemas.findings import Finding, error

MIN_STEPS = 4  # of which some tell how exactly positions follow one another
NORMAL_MAD = 1.4826  # sigmas of a normal error in the median of its absolute value: most of it is along the way
IMPOSSIBLE_SIGMAS = 4.0


@dataclass(frozen=True, kw_only=True)
class Jumps:
    """Jumps of a trajectory: units after them (n,), and distances (n,) from where the motion around leads."""

    unit: Ints
    distance_m: Floats


def find_jumps(time_s: Floats, position_m: Floats) -> Jumps:
    """Steps of a trajectory that its steps before and after contradict, by more than a vehicle's accelerations explain.

    Parameters
    ----------
    time_s
        Ascending (n,).
    position_m
        (n, 3).

    Notes
    -----
    A step with the mean velocity of its neighbours is off by half the acceleration times the product of the times to
    both, as in `RigMotion.expected_sigma_m`. Positions err besides, which most steps
    tell: as the median of what they are off.
    """
    none = Jumps(unit=np.zeros(0, dtype=np.int64), distance_m=np.zeros(0))
    elapsed_s = np.diff(time_s)
    if len(elapsed_s) < MIN_STEPS:
        return none
    velocity = np.diff(position_m, axis=0) / elapsed_s[:, None]
    around_s = np.stack([elapsed_s[:-2], elapsed_s[1:-1], elapsed_s[2:]])
    off_m = elapsed_s[1:-1] * np.linalg.norm(velocity[1:-1] - 0.5 * (velocity[:-2] + velocity[2:]), axis=1)
    by_motion_m = 0.5 * ACCELERATION_SIGMA_MPS2 * elapsed_s[1:-1] * around_s.sum(0)
    sigma_m = np.hypot(by_motion_m, NORMAL_MAD * np.median(off_m))
    jumped = np.flatnonzero((off_m > IMPOSSIBLE_SIGMAS * sigma_m) & (around_s.max(0) <= MAX_GAP_S))
    # The steps beside a jump have it as their neighbour: of a run, the one that is off most.
    largest = [k for k in jumped.tolist() if off_m[k] == off_m[max(k - 1, 0) : k + 2].max()]
    rows = np.array(largest, dtype=np.int64)
    return Jumps(unit=rows + 2, distance_m=off_m[rows])


def motion_jump_findings(mapper: Mapper) -> list[Finding]:
    """Say where the scene's trajectory jumps."""
    units = np.flatnonzero(mapper.registered)
    time_s = mapper.drive.timestamps_us[units] / 1e6
    jumps = find_jumps(time_s - time_s[:1], mapper.state.unit_position_m[units])
    if not len(jumps.unit):
        return []
    largest = int(np.argmax(jumps.distance_m))
    after, off_m = int(jumps.unit[largest]), float(jumps.distance_m[largest])
    frames = [mapper.drive.manifest.frames[unit].source_frame for unit in units[after - 1 : after + 1].tolist()]
    more = f", and at {len(jumps.unit) - 1} more places" if len(jumps.unit) > 1 else ""
    return [
        error(
            "impossible-motion",
            f"in the scene the vehicle moves as none does: between frames {frames[0]} and {frames[1]} "
            f"it jumps {off_m:.1f} m off its motion{more}. Places that look alike, as of facades that repeat, "
            "were taken for one, or timestamps are wrong",
            "Look at the trajectory in report.html and check frames' timestamps there. Rough poses or GNSS positions "
            "that are exact enough to tell such places apart, and frames that are closer together, keep them apart.",
        )
    ]
