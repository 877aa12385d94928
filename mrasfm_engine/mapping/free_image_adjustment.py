"""Bundle adjustment as it is without camera sets: every image is a variable of its own.

With `[adjustment] camera_set_adjustment = false` this takes the place of camera set bundle adjustment: 6 n k unknowns
for n units of k cameras instead of 6 (n + k). Observations, points, priors, solver and tolerances are the same. An
image is treated as a unit that has only this image, so that the rig's calibration says where its camera is on a vehicle
that is its alone; nothing ties the images of a unit together any more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from mrasfm_engine.bundle_adjustment.observation_sampling import solve_with_chosen_points
from mrasfm_engine.bundle_adjustment.priors import PositionPrior, Term, UprightPrior
from mrasfm_engine.bundle_adjustment.problem import Layout, Observations
from mrasfm_engine.bundle_adjustment.solver import Problem, Report, SolverOptions
from mrasfm_engine.errors import CancelledError
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.averaging import geometric_median, robust_mean_rotation
from mrasfm_engine.scene.state import State
from mrasfm_engine.types import Bools, Cancel, Floats, Ints

if TYPE_CHECKING:
    from mrasfm_engine.mapping.mapper import Model


MIN_OBSERVATIONS = 4  # of an image; one with fewer has no pose of its own and stays where its unit is


def adjust_images(
    model: Model,
    free_units: Bools,
    *,
    terms: Sequence[Term],
    options: SolverOptions,
    an_image: int,
    cancel: Cancel | None,
) -> Report:
    """Adjust the images of some units one by one, and take over their poses; a unit's pose is their robust mean.

    Of the terms, positions hold for every image of a unit, with as much weight in sum as for the unit, and vehicles are
    upright in every image; there is no calibration that could have a prior.
    """
    rows, tracks, point = model.observed(free_units)
    image = model.keypoints.image[rows]
    counts = np.bincount(image, minlength=len(model.image_unit))
    adjusted = (free_units & model.registered)[model.image_unit] & (counts >= MIN_OBSERVATIONS)
    state, image_shots = _state_of_images(model, model.state.points_m[tracks])
    problem = Problem(
        state=state,
        camera_kind=model.camera_kind,
        observations=Observations(
            unit=image,
            camera=model.keypoints.camera[rows],
            point=point,
            xy_px=model.keypoints.xy_px[rows],
            num_points=len(tracks),
            shot=model.keypoints.shot[rows] if image_shots else None,
        ),
        layout=Layout.of(adjusted, np.zeros(len(model.camera_kind), dtype=np.bool_)),
        terms=terms_of_images(terms, model.image_unit, adjusted),
        options=options,
    )
    solution, report = solve_with_chosen_points(problem, model.image_size_px, an_image=an_image, cancel=cancel)
    if cancel is not None and cancel():
        raise CancelledError
    model.state.points_m[tracks] = solution.points_m
    _take_over(model, np.flatnonzero(adjusted), solution.world_from_rig)
    return report


def _state_of_images(model: Model, points_m: Floats) -> tuple[State, bool]:
    """A state whose units are the images, and whether images have several shots."""
    unit_from_image = model.motion.unit_from_image(model.state)
    pose = model.state.world_from_rig[model.image_unit] @ unit_from_image
    shots = model.motion.shots
    several = len(shots) > len(pose)
    moved = np.zeros((0, 4, 4))
    if several:
        moved = se3.inverse(unit_from_image)[shots.image] @ model.state.unit_from_shot
    return replace(
        model.state,
        unit_rotation=np.ascontiguousarray(pose[:, :3, :3]),
        unit_position_m=np.ascontiguousarray(pose[:, :3, 3]),
        shot_rotation=np.ascontiguousarray(moved[:, :3, :3]),
        shot_position_m=np.ascontiguousarray(moved[:, :3, 3]),
        points_m=points_m,
    ), several


def terms_of_images(terms: Sequence[Term], image_unit: Ints, adjusted: Bools) -> list[Term]:
    """What terms over units and cameras say of adjusted images (images,), each a unit of its own."""
    result: list[Term] = []
    for term in terms:
        if isinstance(term, PositionPrior):
            row_of_unit = np.full(image_unit.max() + 1, -1)
            row_of_unit[term.unit] = np.arange(len(term.unit))
            image = np.flatnonzero(adjusted & (row_of_unit[image_unit] >= 0))
            row = row_of_unit[image_unit[image]]
            share = np.sqrt(np.bincount(row, minlength=len(term.unit)))[row]
            result.append(
                replace(term, unit=image, position_m=term.position_m[row], sigma_m=term.sigma_m[row] * share[:, None])
            )
        elif isinstance(term, UprightPrior):
            result.append(replace(term, unit=np.flatnonzero(adjusted & np.isin(image_unit, term.unit))))
    return result


def _take_over(model: Model, images: Ints, world_from_image: Floats) -> None:
    order = np.argsort(model.image_unit[images], kind="stable")
    units, first = np.unique(model.image_unit[images][order], return_index=True)
    for unit, members in zip(units, np.split(images[order], first[1:]), strict=True):
        poses = world_from_image[members]
        mean = se3.transform(robust_mean_rotation(poses[:, :3, :3]), geometric_median(poses[:, :3, 3]))
        model.set_pose(int(unit), mean)
        model.set_image_poses(members, se3.inverse(mean) @ poses)
    model.renew_motion(units)
    # What images moved against their unit is this adjustment's result, and nothing that depends on the units' motion.
    model.renew_motion(units)
