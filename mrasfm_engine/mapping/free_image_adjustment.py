"""Bundle adjustment without camera sets: every image is a variable of its own.

With `[bundle_adjustment] camera_set_adjustment = false` it replaces camera set bundle adjustment, with 6 n k unknowns
for n units of k cameras instead of 6 (n + k). Observations, points, priors, solver and tolerances are the same. Every
image becomes a unit of its own, whose rig holds that one camera at its calibrated pose; nothing ties the images of a
unit together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mrasfm_engine.bundle_adjustment.observation_sampling import solve_with_chosen_points
from mrasfm_engine.bundle_adjustment.priors import RotationPrior, Term, UprightPrior
from mrasfm_engine.bundle_adjustment.problem import Layout, Observations
from mrasfm_engine.bundle_adjustment.receiver_positions import ReceiverPositions
from mrasfm_engine.bundle_adjustment.solver import Problem, Report, SolverOptions
from mrasfm_engine.errors import CancelledError
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.averaging import geometric_median, robust_mean_rotation
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.scene.state import State
from mrasfm_engine.types import Bools, Cancel, Floats, Ints

MIN_OBSERVATIONS = 4  # of an image; one with fewer has no pose of its own and stays where its unit is


def adjust_images(
    mapper: Mapper,
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
    rows, tracks, point = mapper.observed(free_units)
    image = mapper.keypoints.image[rows]
    counts = np.bincount(image, minlength=len(mapper.image_unit))
    adjusted = (free_units & mapper.registered)[mapper.image_unit] & (counts >= MIN_OBSERVATIONS)
    state, image_bands = _state_of_images(mapper, mapper.state.points_m[tracks])
    problem = Problem(
        state=state,
        camera_kind=mapper.camera_kind,
        observations=Observations(
            unit=image,
            camera=mapper.keypoints.camera[rows],
            point=point,
            xy_px=mapper.keypoints.xy_px[rows],
            num_points=len(tracks),
            band=mapper.keypoints.band[rows] if image_bands else None,
        ),
        layout=Layout.from_free(adjusted, np.zeros(len(mapper.camera_kind), dtype=np.bool_)),
        terms=terms_of_images(terms, mapper.image_unit, adjusted),
        options=options,
    )
    solution, report = solve_with_chosen_points(problem, mapper.image_size_px, an_image=an_image, cancel=cancel)
    if cancel is not None and cancel():
        raise CancelledError
    mapper.state.points_m[tracks] = solution.points_m
    _take_over(mapper, np.flatnonzero(adjusted), solution.world_from_rig)
    return report


def _state_of_images(mapper: Mapper, points_m: Floats) -> tuple[State, bool]:
    """A state whose units are the images, and whether images have several row bands."""
    unit_from_image = mapper.motion.unit_from_image(mapper.state)
    pose = mapper.state.world_from_rig[mapper.image_unit] @ unit_from_image
    bands = mapper.motion.bands
    several = len(bands) > len(pose)
    moved = np.zeros((0, 4, 4))
    if several:
        moved = se3.inverse(unit_from_image)[bands.image] @ mapper.state.unit_from_band
    return replace(
        mapper.state,
        unit_rotation=np.ascontiguousarray(pose[:, :3, :3]),
        unit_position_m=np.ascontiguousarray(pose[:, :3, 3]),
        band_rotation=np.ascontiguousarray(moved[:, :3, :3]),
        band_position_m=np.ascontiguousarray(moved[:, :3, 3]),
        points_m=points_m,
    ), several


def terms_of_images(terms: Sequence[Term], image_unit: Ints, adjusted: Bools) -> list[Term]:
    """Convert terms over units and cameras to terms over adjusted images (images,), each a unit of its own."""
    result: list[Term] = []
    for term in terms:
        if isinstance(term, ReceiverPositions):
            image, row, share = _measured_images(term.unit, image_unit, adjusted)
            result.append(term.of_rows(row, image, share))
        elif isinstance(term, RotationPrior):
            image, row, share = _measured_images(term.unit, image_unit, adjusted)
            of_images = replace(term, unit=image, rotation=term.rotation[row], sigma_rad=term.sigma_rad[row] * share)
            result.append(of_images)
        elif isinstance(term, UprightPrior):
            result.append(replace(term, unit=np.flatnonzero(adjusted & np.isin(image_unit, term.unit))))
    return result


def _measured_images(units: Ints, image_unit: Ints, adjusted: Bools) -> tuple[Ints, Ints, Floats]:
    """Adjusted images (m,) of units (n,) with a measurement, its row, and the factor on its sigma: images share it."""
    row_of_unit = np.full(image_unit.max() + 1, -1)
    row_of_unit[units] = np.arange(len(units))
    image = np.flatnonzero(adjusted & (row_of_unit[image_unit] >= 0))
    row = row_of_unit[image_unit[image]]
    return image, row, np.sqrt(np.bincount(row, minlength=len(units)))[row]


def _take_over(mapper: Mapper, images: Ints, world_from_image: Floats) -> None:
    order = np.argsort(mapper.image_unit[images], kind="stable")
    units, first = np.unique(mapper.image_unit[images][order], return_index=True)
    for unit, members in zip(units, np.split(images[order], first[1:]), strict=True):
        poses = world_from_image[members]
        mean = se3.transform(robust_mean_rotation(poses[:, :3, :3]), geometric_median(poses[:, :3, 3]))
        mapper.set_pose(int(unit), mean)
        mapper.set_image_poses(members, se3.inverse(mean) @ poses)
    mapper.renew_motion(units)
    # What images moved against their unit is this adjustment's result, and nothing that depends on the units' motion.
    mapper.renew_motion(units)
