from __future__ import annotations

import numpy as np
import pytest

from mrasfm_engine.config import EngineConfig
from mrasfm_engine.mapping.incremental_mapping import run_incremental_mapping
from mrasfm_engine.mapping.keyframes import nearest_keyframes, register_between_keyframes, select_keyframes
from mrasfm_engine.mapping.mapper import Mapper
from tests.helpers.simulated_drive import (
    SimulatedDrive,
    make_model,
    make_simulated_drive,
    metric_errors_m,
    rmse,
    true_matches,
)

STEP_M = 1.1
HELD = EngineConfig(threads=1).model_copy(
    update={"bundle_adjustment": EngineConfig().bundle_adjustment.model_copy(update={"refine_calibration": False})}
)
# Steps before every unit: units of a stop are where the one before the stop is.
STOPS = {
    "in the middle": [0] + [STEP_M] * 4 + [0.0] * 12 + [STEP_M] * 4,
    "at the beginning": [0] + [0.0] * 12 + [STEP_M] * 7,
    "at the end": [0] + [STEP_M] * 7 + [0.0] * 12,
}


def drive(steps_m: list[float], **options: object) -> SimulatedDrive:
    way = np.cumsum(steps_m)
    values = {"units": len(way), "cameras": 4, "points": 900, "travelled_m": way, "noise_px": 0.3}
    return make_simulated_drive(**{**values, **options})


def model_of(simulated: SimulatedDrive) -> Mapper:
    mapper = make_model(simulated, config=HELD)
    mapper.keyframe = select_keyframes(mapper)
    return mapper


def reconstruct(simulated: SimulatedDrive) -> Mapper:
    pairs = true_matches(simulated)
    mapper = make_model(simulated, pairs, HELD)
    mapper.keyframe = select_keyframes(mapper)
    run_incremental_mapping(mapper, pairs, None)
    assert (mapper.registered == mapper.keyframe).all()
    results = register_between_keyframes(mapper, max_error_px=3.0)
    assert len(results) == (~mapper.keyframe).sum()
    return mapper


@pytest.mark.parametrize("where", STOPS)
def test_a_stop_has_one_keyframe_and_all_its_units_have_poses(where: str) -> None:
    simulated = drive(STOPS[where])
    mapper = reconstruct(simulated)
    stands = np.diff(np.cumsum(STOPS[where]), prepend=-1.0) == 0
    np.testing.assert_array_equal(mapper.keyframe, ~stands)
    assert mapper.registered.all()
    errors = metric_errors_m(mapper, simulated)
    assert 1e-4 < rmse(errors) < 0.02
    # None of them drifts from where the car stood.
    place = mapper.state.unit_position_m[stands]
    assert 0 < np.linalg.norm(place - place.mean(0), axis=1).max() < 0.02
    own = mapper.keypoints.unit[mapper.is_inlier]
    assert np.bincount(own, minlength=len(stands))[stands].min() > 100


def test_standing_units_do_not_bend_the_scene() -> None:
    steps = STOPS["in the middle"]
    with_stop, without = drive(steps), drive([s for k, s in enumerate(steps) if k == 0 or s > 0])
    errors = [rmse(metric_errors_m(reconstruct(s), s)) for s in (with_stop, without)]
    assert 1e-4 < errors[0] < 2 * max(errors[1], 0.003)


def test_a_moving_drive_has_keyframes_only() -> None:
    mapper = model_of(drive([0.0] + [STEP_M] * 8))
    assert mapper.keyframe.all()
    assert register_between_keyframes(mapper, max_error_px=3.0) == []
    np.testing.assert_array_equal(nearest_keyframes_of_all(mapper), np.arange(9))


def nearest_keyframes_of_all(mapper: Mapper) -> np.ndarray:
    mapper.registered[:] = True
    return nearest_keyframes(mapper)


def test_a_creeping_car_has_a_keyframe_now_and_then() -> None:
    """Steps of 2 cm: it is measured against the last keyframe, so they add up."""
    mapper = model_of(drive([0.0] + [0.02] * 39))
    gaps = np.diff(np.flatnonzero(mapper.keyframe))
    assert gaps.min() >= 2
    assert gaps.max() < 20


def test_others_that_drive_past_do_not_make_a_standing_car_move() -> None:
    steps = STOPS["in the middle"]
    simulated = drive(steps)
    rng = np.random.default_rng(0)
    on_cars = rng.random(len(simulated.truth.points_m)) < 0.35
    for image, features, point in zip(
        simulated.drive.images, simulated.features, simulated.point_of_keypoint, strict=True
    ):
        rows = (point >= 0) & on_cars[np.maximum(point, 0)]
        features.xy_px[rows] += [12.0 * image.unit, 1.0]
    mapper = model_of(simulated)
    stands = np.diff(np.cumsum(steps), prepend=-1.0) == 0
    np.testing.assert_array_equal(mapper.keyframe, ~stands)


def test_a_drive_that_only_stands_keeps_all_its_units() -> None:
    assert model_of(drive([0.0] * 6)).keyframe.all()


def test_zero_makes_every_unit_a_keyframe() -> None:
    off = HELD.model_copy(update={"mapping": HELD.mapping.model_copy(update={"keyframe_motion_px": 0.0})})
    mapper = make_model(drive(STOPS["at the end"]), config=off)
    assert select_keyframes(mapper).all()


def test_where_cameras_are_apart_the_ends_of_a_stop_tell_that_the_car_stood() -> None:
    steps = STOPS["in the middle"]
    mapper = model_of(drive(steps, time_offset_ms=[0, 0, 0, 45]))
    # The late camera sees the car start at unit 16 already, so unit 15 is the last one that stands.
    assert np.flatnonzero(~mapper.keyframe).tolist() == list(range(6, 15))
    stands = np.diff(np.cumsum(steps), prepend=-1.0) == 0
    assert np.flatnonzero(stands).tolist() == list(range(5, 17))
