"""Positions of a bag's receiver."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mrasfm_engine.errors import InputError
from mrasfm_engine.importers.bag_contents import BagContent, us_from_ns
from mrasfm_engine.importers.recording import antenna_on_vehicle, gnss_of_vehicle
from mrasfm_engine.types import Floats
from schemas import Gnss

NO_FIX, UNKNOWN_COVARIANCE = -1, 0  # of NavSatFix
VERTICAL_OVER_HORIZONTAL = 2.0  # where only one standard deviation is given


def gnss_of_bag(
    content: BagContent, rig_frame: str | None, antenna_m: Sequence[float] | None, sigma_m: float | None
) -> tuple[Gnss | None, list[str]]:
    """Positions with a fix, with the antenna's place on the vehicle, and notes of what is left out or assumed.

    Parameters
    ----------
    rig_frame
        The vehicle's frame in the transforms; None: they do not have it.
    antenna_m, sigma_m
        See `bags.read`.

    Raises
    ------
    InputError
        If the antenna's place or the standard deviations are known neither from the bag nor from the options.
    """
    by_stamp: dict[int, Any] = {}
    for stamp, fix in content.fixes:
        if fix.status.status > NO_FIX and np.isfinite([fix.latitude, fix.longitude, fix.altitude]).all():
            by_stamp.setdefault(us_from_ns(stamp), fix)
    left_out = len(content.fixes) - len(by_stamp)
    notes = [f"GNSS: {left_out} positions without a fix or with a repeated stamp are left out."] if left_out else []
    if not by_stamp:
        return None, notes
    times_us = sorted(by_stamp)
    fixes = [by_stamp[time_us] for time_us in times_us]
    horizontal_m, vertical_m = _sigmas_m(fixes, sigma_m, content.fix_topic)
    if sigma_m is not None:
        notes.append(f"GNSS: standard deviations are those of --gnss-sigma, {sigma_m:g} m; heights have twice that.")
    gnss = gnss_of_vehicle(
        np.array(times_us, dtype=np.int64),
        np.array([[fix.latitude, fix.longitude, fix.altitude] for fix in fixes]),
        horizontal_m,
        vertical_m,
        source=content.fix_topic,
    )
    antenna = (
        _antenna_m(content, fixes[0].header.frame_id.removeprefix("/"), rig_frame)
        if antenna_m is None
        else np.array(antenna_m)
    )
    return gnss.model_copy(update={"antenna_in_rig_m": antenna_on_vehicle(antenna.tolist())}), notes


def _antenna_m(content: BagContent, frame: str, rig_frame: str | None) -> Floats:
    remedy = "Give the antenna's position in the rig frame with --antenna X,Y,Z, in metres forward, left and up."
    if rig_frame is None or not {frame, rig_frame} <= set(content.transforms.frames):
        raise InputError(
            f"{content.fix_topic}: no transform says where the antenna, frame {frame!r}, is on the vehicle",
            remedy=remedy,
            code="missing-antenna",
        )
    antenna: Floats = content.transforms.fixed(rig_frame, frame, what=content.fix_topic)[:3, 3]
    return antenna


def _sigmas_m(fixes: list[Any], sigma_m: float | None, topic: str) -> tuple[Floats, Floats]:
    """Standard deviations (n,) of horizontal positions, per axis, and of heights."""
    if sigma_m is not None:
        given = np.full(len(fixes), sigma_m)
        return given, VERTICAL_OVER_HORIZONTAL * given
    variances = np.stack([np.asarray(fix.position_covariance, dtype=np.float64)[[0, 4, 8]] for fix in fixes])
    known = np.array([fix.position_covariance_type != UNKNOWN_COVARIANCE for fix in fixes])
    known &= np.isfinite(variances).all(axis=1) & (variances > 0).all(axis=1)
    if not known.all():
        raise InputError(
            f"{topic}: {int((~known).sum())} of {len(fixes)} positions have no covariance",
            remedy="Give the receiver's standard deviation with --gnss-sigma METRES.",
            code="missing-sigma",
        )
    return np.sqrt(variances[:, :2].mean(axis=1)), np.sqrt(variances[:, 2])
