from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from mrasfm_engine.config import EngineConfig
from mrasfm_engine.mapping.components import map_drive
from mrasfm_engine.mapping.dynamic_objects import MovingAlong, find_moving_along, without_keypoints
from mrasfm_engine.mapping.incremental_mapping import MappingLog
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.scene.scene import PairMatches
from tests.helpers.simulated_drive import (
    SimulatedDrive,
    make_model,
    make_simulated_drive,
    metric_errors_m,
    rmse,
    true_matches,
    with_lorry,
    with_true_poses,
)
from tests.helpers.slow import slow

UNITS = 10


def in_the_middle(*cameras: int) -> Callable[[int, int], bool]:
    return lambda unit, camera: camera in cameras and 3 <= unit < 7


def found_in(simulated: SimulatedDrive) -> tuple[MovingAlong, Mapper, list[PairMatches]]:
    pairs = true_matches(simulated)
    mapper = with_true_poses(make_model(simulated, pairs), simulated, range(len(simulated.world_from_rig)))
    return find_moving_along(mapper, pairs), mapper, pairs


def drive(*, straight: bool = False, **kwargs: object) -> SimulatedDrive:
    return make_simulated_drive(units=UNITS, points=1000, straight=straight, **kwargs)


@pytest.mark.parametrize("straight", [False, True])
@pytest.mark.parametrize("cameras", [(1, 4), (0,), (5,)])
def test_covered_images_are_named_and_no_others(straight: bool, cameras: tuple[int, ...]) -> None:
    simulated = with_lorry(drive(straight=straight), in_the_middle(*cameras))
    found, mapper, _ = found_in(simulated)
    expected = [in_the_middle(*cameras)(i.unit, i.camera) for i in simulated.drive.images]
    np.testing.assert_array_equal(found.covered, expected)
    assert (found.share[found.covered] > 0.6).all()
    assert found.share[~found.covered].max() < 0.4
    # Keypoints of the lorry are taken out, and the world that is left stays.
    shows = np.concatenate(simulated.point_of_keypoint)
    lorry = shows >= len(simulated.truth.points_m)
    assert found.keypoint[lorry].mean() > 0.95
    matched = np.zeros(len(shows), dtype=np.bool_)
    matched[mapper.tracks.keypoints] = True
    assert found.keypoint[(shows >= 0) & ~lorry & matched].mean() < 0.05


@pytest.mark.parametrize("straight", [False, True])
def test_where_nothing_moves_along_nothing_is_named(straight: bool) -> None:
    found, _, _ = found_in(drive(straight=straight))
    assert not found.any
    assert not found.keypoint.any()


def test_a_standing_car_covers_nothing() -> None:
    simulated = make_simulated_drive(units=6, points=800, spacing_m=0.001)
    found, _, _ = found_in(simulated)
    assert not found.any


def test_images_that_see_nothing_are_not_called_covered() -> None:
    found, _, _ = found_in(drive(hidden=in_the_middle(2)))
    assert not found.any


def test_a_small_thing_that_moves_along_covers_no_image() -> None:
    found, _, _ = found_in(with_lorry(drive(), in_the_middle(1), keypoints=40, left=1.0))
    assert not found.any
    assert 0.05 < found.share.max() < 0.5
    assert found.keypoint.sum() == 0


def test_matches_of_removed_keypoints_are_no_inliers_any_more() -> None:
    simulated = drive()
    pairs = true_matches(simulated)
    mapper = make_model(simulated, pairs)
    removed = np.zeros(len(mapper.keypoints.image), dtype=np.bool_)
    removed[mapper.keypoints.first[3] : mapper.keypoints.first[4]] = True
    left = without_keypoints(pairs, mapper.keypoints.first, removed)
    assert [(p.image_a, p.image_b) for p in left] == [
        (p.image_a, p.image_b) for p in pairs if 3 not in (p.image_a, p.image_b)
    ]
    one = np.zeros_like(removed)
    one[mapper.keypoints.first[pairs[0].image_a] + pairs[0].matches[0, 0]] = True
    assert without_keypoints(pairs[:1], mapper.keypoints.first, one)[0].inliers.sum() == pairs[0].inliers.sum() - 1


def mapped(simulated: SimulatedDrive) -> tuple[Mapper, MappingLog]:
    mapper = make_model(simulated)
    whole = map_drive(simulated.drive, mapper.keypoints, true_matches(simulated), None, EngineConfig(threads=1))[0]
    return whole.mapper, whole.log


@pytest.mark.parametrize("cameras", [(0, 1, 2, 4, 5), *slow((1, 4))])
def test_a_lorry_bends_neither_poses_nor_calibration(cameras: tuple[int, ...]) -> None:
    """Two cameras of six, and all but one, are covered for half of the drive."""
    clean = drive()
    plain, nothing = mapped(clean)
    assert nothing.covered_images == {}
    covered = with_lorry(clean, in_the_middle(*cameras))
    mapper, log = mapped(covered)
    assert mapper.registered.all()
    expected = {i for i, image in enumerate(clean.drive.images) if in_the_middle(*cameras)(image.unit, image.camera)}
    assert set(log.covered_images) == expected
    assert all(0.75 <= share <= 1.0 for share in log.covered_images.values())
    assert 1e-5 < rmse(metric_errors_m(mapper, covered)) < max(0.02, 3 * rmse(metric_errors_m(plain, clean)))
    lorry = np.concatenate(covered.point_of_keypoint) >= len(clean.truth.points_m)
    assert mapper.is_inlier[lorry].mean() < 0.02


def test_a_camera_that_is_covered_all_the_way_costs_no_unit() -> None:
    """No unit is left to register the others against, so they keep the poses that they have."""
    simulated = with_lorry(drive(), lambda unit, camera: camera == 3)
    mapper, log = mapped(simulated)
    assert mapper.registered.all()
    assert len(log.covered_images) == UNITS
    assert 1e-5 < rmse(metric_errors_m(mapper, simulated)) < 0.03
