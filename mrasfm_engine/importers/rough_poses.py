"""Rough poses from a recording's true ones: trials of what a vehicle without a good receiver would know."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.importers.recording import Recording, RoughQuality, flu_world


def with_rough_poses(recording: Recording, quality: RoughQuality) -> Recording:
    """The recording with its poses, with noise added, as rough poses.

    The noise follows from the recording's name: importing it again gives the same.

    Raises
    ------
    InputError
        If the recording has no poses, or no axis of their world points up.
    """
    known = [unit.world_from_rig for unit in recording.units if unit.world_from_rig is not None]
    upright = flu_world(np.stack(known)) if known else None
    if upright is None:
        problem = "no axis of its poses' world points up" if known else "it has no poses"
        raise InputError(
            f"recording {recording.name}: rough poses cannot be made: {problem}",
            remedy="Import without --rough-noise.",
            code="no-poses",
        )
    digest = hashlib.sha256(recording.name.encode()).digest()
    rng = np.random.default_rng(np.frombuffer(digest, np.uint32))
    sigmas = np.array([np.radians(quality.sigma_deg)] * 3 + [quality.sigma_m] * 3)
    noise = iter(se3.exp_se3(rng.normal(size=(len(known), 6)) * sigmas))
    units = [
        unit
        if unit.world_from_rig is None
        else replace(unit, rough_world_from_rig=upright @ unit.world_from_rig @ next(noise))
        for unit in recording.units
    ]
    note = (
        f"Rough poses: the recording's own with noise of {quality.sigma_m:g} m and {quality.sigma_deg:g} deg along and "
        "about each axis. They are a trial, not a measurement."
    )
    return replace(recording, units=units, rough_quality=quality, notes=[*recording.notes, note])
