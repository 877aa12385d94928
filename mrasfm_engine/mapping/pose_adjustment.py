"""The adjustment of units during mapping: of camera sets, or of single images where the settings compare with that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mrasfm_engine.bundle_adjustment.observation_sampling import solve_with_chosen_points
from mrasfm_engine.bundle_adjustment.priors import Term
from mrasfm_engine.bundle_adjustment.solver import Report, SolverOptions
from mrasfm_engine.errors import CancelledError
from mrasfm_engine.mapping.free_image_adjustment import adjust_images
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.types import Bools, Cancel


def adjust_poses(
    mapper: Mapper,
    free_units: Bools,
    *,
    free_cameras: Bools | None = None,
    free_intrinsics: Bools | None = None,
    free_times: Bools | None = None,
    terms: Sequence[Term] = (),
    options: SolverOptions,
    an_image: int = 0,
    cancel: Cancel | None = None,
) -> Report:
    """Adjust units (and cameras) with the points that they observe, and take the result over into the mapper.

    With `an_image` poses are estimated from about so many observations of an image; points follow all of theirs.
    """
    if not mapper.config.bundle_adjustment.camera_set_adjustment:
        return adjust_images(mapper, free_units, terms=terms, options=options, an_image=an_image, cancel=cancel)
    mapper.renew_motion(np.flatnonzero(free_units & mapper.registered))
    problem, tracks = mapper.problem(
        free_units,
        free_cameras=free_cameras,
        free_intrinsics=free_intrinsics,
        free_times=free_times,
        terms=terms,
        options=options,
    )
    solution, report = solve_with_chosen_points(problem, mapper.image_size_px, an_image=an_image, cancel=cancel)
    if cancel is not None and cancel():
        raise CancelledError  # else a half-solved reconstruction would pass for a finished one
    points = mapper.state.points_m
    points[tracks] = solution.points_m
    mapper.state = replace(solution, points_m=points)
    return report
