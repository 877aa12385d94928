"""Usual errors of lens models."""

from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.config import EngineConfig
from mrasfm_engine.geometry.camera_model import project_points
from mrasfm_engine.mapping.lens_errors import LENS_SIGMA_PX, lens_sigmas
from tests.helpers.simulated_drive import make_model, make_simulated_drive, with_cameras


@pytest.mark.parametrize(
    ("model", "more"), [("OPENCV", [-0.1, 0.02, 1e-3, -1e-3]), ("OPENCV_FISHEYE", [0.05, -0.01, 3e-3, -1e-3])]
)
def test_every_parameter_of_a_lens_moves_pixels_by_as_much(model: str, more: list[float]) -> None:
    simulated = make_simulated_drive(units=4, cameras=1, points=800)
    (camera,) = simulated.drive.manifest.rig.cameras
    given = camera.model_copy(update={"model": model, "params": [*camera.params, *more]})
    mapper = make_model(with_cameras(simulated, [given]), config=EngineConfig(threads=1))
    kind, params = int(mapper.camera_kind[0]), mapper.state.camera_params[0]
    sigma = lens_sigmas(kind, params, mapper.keypoints.xy_px, mapper.keypoints.rays)
    seen = project_points(kind, params, mapper.keypoints.rays)
    for place, step in enumerate(sigma):
        moved = params.copy()
        if place < 2:
            moved[place:2] *= 1.0 + step
        else:
            moved[place] += step
        off_px = np.linalg.norm(project_points(kind, moved, mapper.keypoints.rays) - seen, axis=1)
        assert np.sqrt((off_px**2).mean()) == pytest.approx(LENS_SIGMA_PX, rel=0.3), place


def test_a_lens_of_which_no_image_shows_anything_takes_no_part() -> None:
    assert (lens_sigmas(0, np.ones(8), np.zeros((0, 2)), np.zeros((0, 3))) < 1e-6).all()
