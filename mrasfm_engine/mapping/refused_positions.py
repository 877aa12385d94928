"""Positions that were refused, compared once more with the scene that images and the rig's prior make without them.

While the scene grows, damping holds up a scale that images hardly observe, and right positions contradict it. So the
scene is adjusted first. Its cameras vary under their prior: held where they were when the scene had grown, a little
turned, they pull it to another scale, which is no minimum, and the curvature there does not say how far off it is.

A minimum whose scale is not that of positions may be one of several, as its observations were chosen by it. So the
scene is adjusted from the size that positions give as well, and the more likely of both is compared with them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mrasfm_engine.bundle_adjustment.marginal_covariances import (
    MAX_UNKNOWNS_FOR_COVARIANCE,
    Covariances,
    covariances,
)
from mrasfm_engine.bundle_adjustment.priors import Term
from mrasfm_engine.bundle_adjustment.solver import Report, SolverOptions
from mrasfm_engine.mapping.calibration import calibration_prior, has_few_units, sigma_scale_of_images
from mrasfm_engine.mapping.given_scale import scale_of_given_rotations
from mrasfm_engine.mapping.inlier_gates import observation_sigma_px
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.other_sizes import scenes_of_sizes, size_m
from mrasfm_engine.mapping.pose_adjustment import adjust_poses
from mrasfm_engine.mapping.refinement_result import Refinement, free_units_of, solver_options
from mrasfm_engine.types import Bools, Cancel


def compare_positions_again(mapper: Mapper, result: Refinement, cancel: Cancel | None) -> None:
    """Adjust without positions that were refused, and place the scene by them if they agree with it then."""
    scene = _WithoutPositions(mapper=mapper, result=result, free_units=free_units_of(mapper, result.absolute))
    result.sigma_px = observation_sigma_px(mapper)
    result.adjustments.append(scene.adjust(scene.terms(), cancel))
    mapper.complete()
    known = scene.certainty()
    if known is None:
        return
    scene.place(known)
    if result.placement is None or not result.placement.is_of_another_scale:
        return
    result.sigma_px = observation_sigma_px(mapper)
    weighed = replace(scene, sigma_factor=known.sigma_factor)
    scenes = scenes_of_sizes(
        mapper,
        (1.0, result.absolute.factor_by_positions(mapper)),
        lambda terms: weighed.adjust(terms, cancel),
        weighed.terms,
        weighed.options,
    )
    scenes.take(scenes.best, mapper)
    scene.place(scene.certainty() or known, sigma_of_sizes=scenes.sigma_of_scale(size_m(mapper)))


@dataclass(frozen=True, kw_only=True)
class _WithoutPositions:
    """The scene under its priors but for the positions that were refused.

    `sigma_factor` is that of errors that observations share, once they are known.
    """

    mapper: Mapper
    result: Refinement
    free_units: Bools
    sigma_factor: float = 1.0

    @property
    def _cameras(self) -> Bools:
        return np.ones(len(self.mapper.camera_kind), dtype=np.bool_)

    @property
    def options(self) -> SolverOptions:
        """Settings of its adjustments."""
        return solver_options(self.mapper, replace(self.result, sigma_factor=self.sigma_factor))

    def terms(self) -> list[Term]:
        """Priors by the scene as it is."""
        return [calibration_prior(self.mapper), *self.result.absolute.terms(self.mapper)]

    def adjust(self, terms: Sequence[Term], cancel: Cancel | None) -> Report:
        """Adjust units, and cameras unless the settings hold them."""
        return adjust_poses(
            self.mapper,
            self.free_units,
            free_cameras=self._cameras & self.mapper.config.bundle_adjustment.refine_calibration,
            terms=terms,
            options=self.options,
            cancel=cancel,
        )

    def certainty(self) -> Covariances | None:
        """Covariances with all cameras free under their prior; None where there is too much for an inverse."""
        problem, _ = self.mapper.problem(
            self.free_units, free_cameras=self._cameras, terms=self.terms(), options=self.options
        )
        if problem.layout.size > MAX_UNKNOWNS_FOR_COVARIANCE:
            return None
        # Where cameras are held, what a wrong one leaves in each of few units passes for an error that they share.
        are_held = not self.mapper.config.bundle_adjustment.refine_calibration
        return covariances(problem, problem.state, shared_errors=not (are_held and has_few_units(self.mapper)))

    def place(self, known: Covariances, *, sigma_of_sizes: float = 0.0) -> None:
        """Place the scene by positions if they fit it: its scale is as certain as its curvature and other sizes say.

        Errors of lens models, which no residual shows, come on top.
        """
        lens = scale_of_given_rotations(
            self.mapper, free_units=self.free_units, free_times=None, terms=self.terms(), options=self.options
        )
        of_images = max(sigma_scale_of_images(self.mapper, known), sigma_of_sizes)
        sigma_scale = float(np.hypot(of_images, 0.0 if lens is None else lens.sigma_scale))
        if np.isfinite(sigma_scale):
            self.result.absolute.place(self.mapper, sigma_scale=sigma_scale)
