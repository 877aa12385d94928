"""The refined scene compared with itself adjusted from other sizes, of which it takes the one that is most likely."""

from __future__ import annotations

from mrasfm_engine.mapping.adjustment_rounds import (
    adjust,
    adjust_all_cameras,
    choose_observations,
    hear_given_rotations,
    reassess_positions,
    reassesses,
    weigh_shared_errors,
)
from mrasfm_engine.mapping.calibration import CalibrationDecision, has_few_units
from mrasfm_engine.mapping.inlier_gates import observation_sigma_px
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.other_sizes import (
    CLEAR_SIGMAS,
    SizedScenes,
    cost_as_found,
    is_another_size,
    scenes_of_other_sizes,
    size_m,
    with_other_sizes,
)
from mrasfm_engine.mapping.refinement_result import Refinement, certainty_of, solver_options, terms_of_all_cameras
from mrasfm_engine.mapping.time_offsets import times_may_vary
from mrasfm_engine.types import Bools, Cancel

OF_ANOTHER_SIZE = "a scene of another size, with cameras that vary, is clearly more likely"
MOST_COMPARISONS = 3  # with other sizes, each from the one that the last has found


def take_most_likely_size(mapper: Mapper, result: Refinement, free_units: Bools, *, cancel: Cancel | None) -> None:
    """Compare the scene with itself adjusted from other sizes, and take the one that is clearly more likely.

    What was taken is compared again: it may have been on its way. The sizes of the last comparison widen the certainty
    as far as they are likely; they do no more where cameras have to stay as they are.
    """
    if result.georeferenced or mapper.drive.has_single_camera:
        return
    compared: SizedScenes | None = None
    for _ in range(MOST_COMPARISONS):
        scenes = None if result.certainty is None else _scenes_of_other_sizes(mapper, result, free_units, cancel)
        if scenes is None:
            break
        compared = scenes
        if not _is_of_another_size(mapper, result, scenes):
            break
        scenes.take(scenes.likely, mapper)
        _refine_with_all_cameras(mapper, result, free_units, cancel)
    if compared is not None and result.certainty is not None:
        result.certainty = with_other_sizes(mapper, result.certainty, compared)


def _scenes_of_other_sizes(
    mapper: Mapper, result: Refinement, free_units: Bools, cancel: Cancel | None
) -> SizedScenes | None:
    """The scene adjusted from several sizes, with all cameras free; None where images know its scale."""
    assert result.certainty is not None
    return scenes_of_other_sizes(
        mapper,
        result.certainty,
        lambda terms: adjust_all_cameras(mapper, result, free_units, terms, cancel=cancel),
        lambda: terms_of_all_cameras(mapper, result),
        solver_options(mapper, result),
        as_grown=result.as_grown,
    )


def _is_of_another_size(mapper: Mapper, result: Refinement, scenes: SizedScenes) -> bool:
    """True where a scene of another size is clearly more likely than the one that was found, and may take its place.

    A scene whose cameras have varied is at a minimum, whose certainty holds the sizes near it. What others cost, errors
    that observations share may decide there. Of few units that certainty is no more than the curvature somewhere along
    a flat tail.
    """
    assert result.certainty is not None
    if not (result.calibration.free or result.calibration.is_open) or not reassesses(mapper):
        return False
    is_at_minimum = result.calibration.free and not has_few_units(mapper)
    near = CLEAR_SIGMAS * result.certainty.sigma_scale if is_at_minimum else 0.0
    if not is_another_size(scenes.size_m[scenes.likely], size_m(mapper), near=near):
        return False
    return scenes.costs[scenes.likely].is_clearly_below(cost_as_found(mapper, solver_options(mapper, result)))


def _refine_with_all_cameras(mapper: Mapper, result: Refinement, free_units: Bools, cancel: Cancel | None) -> None:
    """Adjust a scene in which all cameras have varied, as the last round does, and choose its observations."""
    if not result.calibration.free:
        result.calibration = CalibrationDecision(True, OF_ANOTHER_SIZE)
    result.recalibrated[:] = True
    result.as_grown = None
    result.times_vary = times_may_vary(mapper)
    result.given_scale, result.sigma_factor = None, 1.0
    result.sigma_px = observation_sigma_px(mapper)
    hear_given_rotations(mapper, result, free_units)
    weigh_shared_errors(mapper, result)
    adjust(mapper, result, free_units, rough=False, cancel=cancel)
    reassess_positions(mapper, result)
    choose_observations(mapper, result, is_last=True)
    result.certainty = certainty_of(mapper, result)
