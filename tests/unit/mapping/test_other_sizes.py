from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.bundle_adjustment.marginal_covariances import Covariances, covariances
from mrasfm_engine.bundle_adjustment.solver import Report, SolverOptions
from mrasfm_engine.mapping.calibration import calibration_prior
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.other_sizes import FACTORS, UNSURE, with_other_sizes
from mrasfm_engine.mapping.pose_adjustment import adjust_poses
from tests.unit.mapping.test_calibration import UNITS, true_model

FREE = np.arange(UNITS) > 0
OPTIONS = SolverOptions(sigma_px=0.5)


def assessed(mapper: Mapper, sigma_scale: float) -> Covariances:
    """The certainty of a scene, with another curvature along its scale; images alone say it."""
    problem, _ = mapper.problem(
        FREE, free_cameras=np.ones(2, dtype=np.bool_), terms=[calibration_prior(mapper)], options=OPTIONS
    )
    certainty = covariances(problem, problem.state, shared_errors=False)
    unknown = np.full_like(certainty.scale_with_calibration, np.nan)
    certainty = replace(certainty, sigma_scale=sigma_scale, scale_with_calibration=unknown)

    def adjust() -> Report:
        return adjust_poses(
            mapper, FREE, free_cameras=np.ones(2, dtype=np.bool_), terms=[calibration_prior(mapper)], options=OPTIONS
        )

    return with_other_sizes(mapper, certainty, adjust)


def test_a_scene_that_costs_the_same_at_other_sizes_is_as_uncertain_as_these_are_apart() -> None:
    """One of two cameras sees nothing: images of the other say nothing of how large the scene is."""
    mapper = true_model(cameras=2)
    mapper.is_inlier[mapper.keypoints.camera == 1] = False
    before = mapper.state.unit_position_m.copy()
    found = assessed(mapper, sigma_scale=0.1)
    assert found.sigma_scale == pytest.approx(np.log(max(FACTORS)), rel=0.2)
    np.testing.assert_array_equal(mapper.state.unit_position_m, before)


def test_a_scene_that_comes_back_from_other_sizes_is_as_certain_as_it_was() -> None:
    found = assessed(true_model(cameras=2), sigma_scale=0.1)
    assert found.sigma_scale == pytest.approx(0.1, rel=0.01)


@pytest.mark.parametrize("sigma_scale", [0.5 * UNSURE, np.inf])
def test_other_sizes_are_tried_only_where_images_know_the_scale_badly(sigma_scale: float) -> None:
    mapper = true_model(cameras=2)
    mapper.is_inlier[mapper.keypoints.camera == 1] = False
    assert assessed(mapper, sigma_scale=sigma_scale).sigma_scale == sigma_scale
