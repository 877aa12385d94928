from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from mrasfm_engine.mapping.static_images import find_still_keypoints
from tests.helpers.simulated_drive import SimulatedDrive, make_model, make_simulated_drive, true_matches, with_lorry

UNITS = 5


def still_in(simulated: SimulatedDrive) -> tuple[np.ndarray, np.ndarray]:
    """What is found, and which keypoints show a lorry."""
    pairs = true_matches(simulated)
    model = make_model(simulated, pairs)
    found = find_still_keypoints(
        model.keypoints, model.image_unit, model.image_camera, simulated.drive.rig_from_cam, pairs
    )
    return found, np.concatenate(simulated.point_of_keypoint) >= len(simulated.truth.points_m)


def on(*cameras: int) -> Callable[[int, int], bool]:
    return lambda unit, camera: camera in cameras


def drive(**kwargs: object) -> SimulatedDrive:
    return make_simulated_drive(**{"units": UNITS, "points": 1500, **kwargs})


@pytest.mark.parametrize("straight", [False, True])
@pytest.mark.parametrize("cameras", [(1,), (3, 2), (0, 5)])
def test_what_covers_cameras_is_found_before_there_are_poses(straight: bool, cameras: tuple[int, ...]) -> None:
    found, lorry = still_in(with_lorry(drive(straight=straight), on(*cameras), keypoints=400))
    assert found[lorry].mean() > 0.9
    assert found[~lorry].mean() < 0.01


@pytest.mark.parametrize("spacing_m", [1.1, 0.15])
def test_a_drive_without_lorries_loses_nothing(spacing_m: float) -> None:
    found, _ = still_in(drive(spacing_m=spacing_m))
    assert not found.any()


def test_a_standing_car_stands_still_all_around() -> None:
    found, _ = still_in(drive(spacing_m=0.001))
    assert not found.any()


def test_of_two_cameras_one_that_moves_says_that_the_car_does() -> None:
    found, lorry = still_in(with_lorry(drive(cameras=2), on(1), keypoints=400))
    assert found[lorry].mean() > 0.9


def test_where_most_cameras_stand_still_nothing_is_said() -> None:
    """A lorry that passes a standing car looks like a world that moves, in a camera or two."""
    found, _ = still_in(with_lorry(drive(), on(1, 2, 3, 4, 5), keypoints=400))
    assert not found.any()
