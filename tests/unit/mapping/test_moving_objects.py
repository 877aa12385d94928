from __future__ import annotations

import time

import numpy as np
import pytest

from mrasfm_engine.config import EngineConfig, MappingConfig
from mrasfm_engine.mapping.ground_path import ground_path
from mrasfm_engine.mapping.mapper import Mapper
from mrasfm_engine.mapping.moving_objects import REASONS, drop_moving, views_of
from mrasfm_engine.mapping.refinement import refine
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.semantics import CLASS_CODES
from mrasfm_engine.triangulation.point_hypotheses import Views
from mrasfm_engine.triangulation.track_motion import GroundPath, TrackMotion, weigh_tracks
from schemas import LabelMap, SemanticClass
from tests.helpers.simulated_drive import (
    SimulatedDrive,
    make_model,
    make_simulated_drive,
    metric_errors_m,
    rmse,
    shown_points,
    true_matches,
    with_true_poses,
)
from tests.helpers.simulated_traffic import Car, with_cars

OWN_M_S = 11.0  # 1.1 m a unit, at 10 Hz
AHEAD = Car(place_m=(14.0, 0.0), velocity_m_s=(OWN_M_S, 0.0))  # its keypoints stand still in the image
FALLS_BACK = Car(place_m=(16.0, 3.5), velocity_m_s=(8.0, 0.0))
ONCOMING = Car(place_m=(40.0, 3.5), velocity_m_s=(-9.0, 0.0))
BEHIND = Car(place_m=(-14.0, 0.0), velocity_m_s=(OWN_M_S, 0.0))
ACROSS = Car(place_m=(25.0, -10.0), velocity_m_s=(0.0, 7.0))
PARKED = Car(place_m=(20.0, -4.0), velocity_m_s=(0.0, 0.0))


def mapped(simulated: SimulatedDrive, config: EngineConfig | None = None) -> Mapper:
    """The drive's mapper at the true poses, with a point for whatever can be triangulated."""
    mapper = make_model(simulated, true_matches(simulated), config)
    return with_true_poses(mapper, simulated, range(len(simulated.world_from_rig)))


def drive(*, straight: bool = True, **kwargs: object) -> SimulatedDrive:
    return make_simulated_drive(units=12, points=1200, straight=straight, **kwargs)


@pytest.mark.parametrize(
    ("car", "straight"),
    [
        *((car, False) for car in (AHEAD, FALLS_BACK, ONCOMING, BEHIND, ACROSS)),
        # On a straight street at constant speeds, one camera cannot tell an oncoming car from a nearer standing object.
        *((car, True) for car in (AHEAD, BEHIND, ACROSS)),
    ],
)
def test_the_points_of_a_car_that_moves_go_and_those_of_the_street_stay(car: Car, straight: bool) -> None:
    simulated = with_cars(drive(straight=straight), [car])
    mapper = mapped(simulated)
    before = mapper.triangulated.copy()
    found = drop_moving(mapper, for_map=True)
    on_car = shown_points(mapper, simulated) >= len(simulated.truth.points_m)
    assert on_car.sum() > 20
    left = (on_car & mapper.triangulated).sum() / on_car.sum()
    lost = (before & ~mapper.triangulated & ~on_car).sum() / (before & ~on_car).sum()
    assert left <= 0.1
    assert lost <= 0.03  # those beside the car; in a drive of few units they are many
    assert found.points == (before & ~mapper.triangulated).sum()
    assert set(found.reason) <= set(REASONS)


def test_the_ground_reveals_a_car_ahead() -> None:
    """No residual does, as its keypoints stay where they are in the image: a point far away explains them."""
    simulated = with_cars(make_simulated_drive(units=30, points=2000, straight=True), [AHEAD])
    mapper = mapped(simulated)
    on_car = np.flatnonzero(shown_points(mapper, simulated) >= len(simulated.truth.points_m))
    views, path = views_of(mapper), ground_path(mapper)
    abyss = path._replace(ground_m=path.ground_m - 1000.0 * path.up)
    with_ground, without = (weighed(mapper, on_car, views, ground) for ground in (path, abyss))
    assert np.nanmean(with_ground) > np.nanmean(without) + 10.0


def weighed(mapper: Mapper, tracks: np.ndarray, views: Views, path: GroundPath) -> np.ndarray:
    """Log evidence (n,) of tracks for motion."""
    motion = TrackMotion.empty(len(mapper.tracks))
    weigh_tracks(
        motion, tracks, mapper.keypoints, mapper.tracks, mapper.state.points_m, mapper.triangulated, views, path,
        only_unsure=False,
    )  # fmt: skip
    result: np.ndarray = motion.log_evidence[tracks]
    return result


@pytest.mark.parametrize("kwargs", [{}, {"spacing_m": 0.001}, {"straight": False}, {"spacing_m": 0.35}])
def test_a_street_without_traffic_stays_whole(kwargs: dict[str, float]) -> None:
    simulated = with_cars(drive(**kwargs), [PARKED])
    mapper = mapped(simulated)
    before = mapper.triangulated.sum()
    drop_moving(mapper, for_map=True)
    assert mapper.triangulated.sum() >= 0.98 * before


def test_nothing_is_dropped_where_it_is_switched_off() -> None:
    config = EngineConfig(threads=1, mapping=MappingConfig(drop_moving=False))
    mapper = mapped(with_cars(drive(), [ACROSS]), config)
    before = mapper.triangulated.copy()
    found = drop_moving(mapper, for_map=True)
    assert found.judged == len(found.tracks) == 0
    np.testing.assert_array_equal(mapper.triangulated, before)


def test_what_a_mask_calls_static_is_not_judged() -> None:
    mapper = mapped(with_cars(drive(), [ACROSS]))
    label_map = LabelMap(ids={0: SemanticClass.STATIC, 1: SemanticClass.DYNAMIC})
    manifest = mapper.drive.manifest.model_copy(update={"label_map": label_map})
    mapper.drive = Drive(mapper.drive.root, manifest)
    mapper.track_class[:] = CLASS_CODES[SemanticClass.STATIC]
    assert drop_moving(mapper, for_map=True).judged == 0
    mapper.track_class[::2] = 0
    assert drop_moving(mapper, for_map=True).judged == len(mapper.track_class[::2])


def test_a_refined_scene_has_no_points_of_a_car_ahead() -> None:
    simulated = with_cars(drive(straight=False), [AHEAD, ONCOMING])
    mapper = mapped(simulated)
    result = refine(mapper)
    on_car = shown_points(mapper, simulated) >= len(simulated.truth.points_m)
    assert (mapper.triangulated & on_car).sum() <= 0.1 * on_car.sum()
    assert len(result.moving.tracks) >= 0.5 * on_car.sum()
    assert rmse(metric_errors_m(mapper, simulated)) < 0.02


def test_time_grows_with_the_observations() -> None:
    """Twice as many take 2.3 times as long at most, and these are four times as many.

    Both drives take turns, and the least of their CPU times counts: what else runs slows both down, but for what of the
    larger one it takes out of the caches.
    """

    def mapped_with_cars(units: int) -> Mapper:
        return mapped(with_cars(make_simulated_drive(units=units, points=110 * units), [AHEAD, ONCOMING]))

    def cpu_seconds(mapper: Mapper) -> float:
        begun = time.process_time()
        drop_moving(mapper, for_map=True)
        spent = time.process_time() - begun
        mapper.readmit()
        return spent

    few, many = mapped_with_cars(16), mapped_with_cars(32)
    cpu_seconds(few)  # compiles
    times = np.array([(cpu_seconds(few), cpu_seconds(many)) for _ in range(12)])
    of_few, of_many = times.min(axis=0)
    doublings = np.log2(len(many.tracks.keypoints) / len(few.tracks.keypoints))
    assert of_many / of_few < 2.3**doublings
