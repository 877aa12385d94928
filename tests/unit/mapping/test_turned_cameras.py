"""Drives whose cameras share hardly a view and are turned against each other beyond their prior."""

from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.config import EngineConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.alignment import align_similarity
from mrasfm_engine.mapping.components import map_drive
from mrasfm_engine.stages._mapping import described
from tests.helpers.simulated_drive import SimulatedDrive, keypoints_of, make_simulated_drive, rmse, true_matches

CONFIG = EngineConfig(threads=1)
FRONT, FRONT_LEFT = 0, 1  # of six: 17 degrees of their views are common
OFF_DEG = 3.0


def drive_of_turned_cameras(seed: int, off_deg: float) -> SimulatedDrive:
    rng = np.random.default_rng(seed)
    turn = [se3.exp_so3(np.radians(off_deg) * rng.choice([-1, 1], 3)) for _ in range(6)]

    def given(rig_from_cam: np.ndarray) -> np.ndarray:
        for camera in (FRONT, FRONT_LEFT):
            rig_from_cam[camera, :3, :3] = rig_from_cam[camera, :3, :3] @ turn[camera]
        return rig_from_cam

    return make_simulated_drive(
        units=10,
        cameras=6,
        points=900,
        straight=True,
        given=given,
        hidden=lambda unit, camera: camera not in (FRONT, FRONT_LEFT),
        seed=seed,
    )


@pytest.mark.parametrize("seed", [0, 1])
def test_a_straight_drive_of_two_turned_cameras_has_its_shape_and_length(seed: int) -> None:
    """It became 6 and 25 times too short, bent by 6 and 25 cm, and nothing said so."""
    simulated = drive_of_turned_cameras(seed, OFF_DEG)
    parts = map_drive(simulated.drive, keypoints_of(simulated, CONFIG), true_matches(simulated), None, CONFIG)
    mapper, true_m = parts[0].mapper, simulated.world_from_rig[:, :3, 3]
    assert mapper.registered.all()
    alignment = align_similarity(true_m, mapper.state.unit_position_m)
    assert 0.8 < alignment.scale < 1.25
    off_m = np.linalg.norm(alignment.apply(mapper.state.unit_position_m) - true_m, axis=1)
    assert 0.0 < rmse(off_m) < 0.01
    (finding,) = described(parts)["findings"]
    assert finding["code"] == "calibration-contradicted"
    assert "front and front_left turned by" in finding["what"]


def test_cameras_that_are_given_well_are_no_finding() -> None:
    simulated = drive_of_turned_cameras(0, 0.0)
    parts = map_drive(simulated.drive, keypoints_of(simulated, CONFIG), true_matches(simulated), None, CONFIG)
    np.testing.assert_array_equal(parts[0].mapper.rig_as_begun, simulated.drive.rig_from_cam)
    assert described(parts)["findings"] == []
