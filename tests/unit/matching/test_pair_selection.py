from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.config import PairConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.matching.pair_selection import (
    motion_from_poses,
    motion_unknown,
    pairs_from_poses,
    pairs_without_selection,
)
from mrasfm_engine.matching.pair_selection import pairs_from_window as pairs_by_motion
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.synthetic.rigs import true_cameras
from tests.helpers.simulated_drive import make_drive


def drive_of(cameras: int, units: int, **kwargs: object) -> Drive:
    rig = true_cameras(cameras, width=960, height=540, rng=np.random.default_rng(0))
    return make_drive(
        np.stack([c.rig_from_cam for c in rig]),
        np.array([c.params for c in rig]),
        units=units,
        names=[c.name for c in rig],
        **kwargs,
    )


def pairs_from_window(drive: Drive, config: PairConfig) -> np.ndarray:
    return pairs_by_motion(drive, config, motion_unknown(drive, config))


def straight_road(units: int, step_m: float = 1.1) -> np.ndarray:
    return se3.transform(np.eye(3), np.arange(units)[:, None] * np.array([step_m, 0.0, 0.0]))


def round_the_block(units: int, radius_m: float = 40.0, rounds: float = 1.1) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi * rounds, units)
    position = radius_m * np.stack([np.sin(angle), 1 - np.cos(angle), 0 * angle], 1)
    return se3.transform(se3.exp_so3(angle[:, None] * [0.0, 0.0, 1.0]), position)


def units_and_cameras(drive: Drive, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    unit = np.array([i.unit for i in drive.images])
    camera = np.array([i.camera for i in drive.images])
    return unit[pairs], camera[pairs]


def check_form(drive: Drive, pairs: np.ndarray) -> None:
    assert pairs.dtype == np.int64
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert pairs.max() < len(drive.images)
    assert len(np.unique(pairs, axis=0)) == len(pairs)


@pytest.mark.parametrize("prior", [True, False])
def test_pairs_grow_linearly_with_the_drive(prior: bool) -> None:
    counts = []
    for units in (40, 80, 160):
        drive = drive_of(6, units)
        pairs = (
            pairs_from_poses(drive, straight_road(units), PairConfig())
            if prior
            else pairs_from_window(drive, PairConfig())
        )
        check_form(drive, pairs)
        counts.append(len(pairs))
    grown = np.diff(counts) / [40, 80]
    assert grown[1] == pytest.approx(grown[0], rel=0.05)
    assert 6 * 2 < grown[1] < 6 * 17  # pairs a unit
    assert counts[-1] < 0.05 * (6 * 160) ** 2 / 2


@pytest.mark.parametrize("prior", [True, False])
def test_pairs_hold_neighbours_in_time_and_across_cameras(prior: bool) -> None:
    drive = drive_of(6, 12)
    pairs = (
        pairs_from_poses(drive, straight_road(12), PairConfig()) if prior else pairs_from_window(drive, PairConfig())
    )
    unit, camera = units_and_cameras(drive, pairs)
    gap, same_camera = unit[:, 1] - unit[:, 0], camera[:, 0] == camera[:, 1]
    for wanted in (1, 2):
        for c in range(6):
            assert ((gap == wanted) & same_camera & (camera[:, 0] == c)).sum() == 12 - wanted
    assert ((gap == 0) & ~same_camera).any()
    assert ((gap > 0) & ~same_camera).any()
    # Front and front left see the same; front and back never do.
    names = [c.name for c in drive.cameras]
    front, left, back = names.index("front"), names.index("front_left"), names.index("back")
    assert ((np.sort(camera, axis=1) == sorted([front, left])).all(1)).any()
    assert not ((np.sort(camera, axis=1) == sorted([front, back])).all(1)).any()


def test_a_stereo_pair_is_matched_within_every_unit() -> None:
    drive = drive_of(2, 15)
    for pairs in (pairs_from_window(drive, PairConfig()), pairs_from_poses(drive, straight_road(15), PairConfig())):
        unit, camera = units_and_cameras(drive, pairs)
        inside = (unit[:, 0] == unit[:, 1]) & (camera[:, 0] != camera[:, 1])
        assert sorted(unit[inside, 0]) == list(range(15))


def test_the_window_is_kept() -> None:
    drive = drive_of(3, 30)
    config = PairConfig(window_units=5, cross_window_units=1)
    unit, camera = units_and_cameras(drive, pairs_from_window(drive, config))
    gap, same = unit[:, 1] - unit[:, 0], camera[:, 0] == camera[:, 1]
    assert gap[same].max() == 5
    assert gap[same].min() == 1
    assert gap[~same].max() == 1
    assert same.sum() == 3 * sum(30 - g for g in range(1, 6))


def test_a_route_that_returns_has_loop_pairs() -> None:
    units = 220
    drive = drive_of(6, units)
    poses = round_the_block(units)
    pairs = pairs_from_poses(drive, poses, PairConfig())
    check_form(drive, pairs)
    unit, _ = units_and_cameras(drive, pairs)
    loop = unit[:, 1] - unit[:, 0] > 150
    assert 60 < loop.sum() < 0.5 * len(pairs)
    distance = np.linalg.norm(poses[unit[loop, 0], :3, 3] - poses[unit[loop, 1], :3, 3], axis=1)
    assert distance.max() < 60.0
    # Every unit of the second round is tied to the first.
    second_round = set(range(int(units / 1.1) + 3, units))
    assert second_round <= set(unit[loop, 1].tolist())
    assert len(pairs) < units * 6 * 17


@pytest.mark.parametrize("prior", [True, False])
@pytest.mark.parametrize(
    ("step_m", "last"),
    [(0.17, (7, 18)), (1.1, (3, 4)), (7.5, (2, 4))],  # 5 m/s at 30 Hz, 11 m/s at 10 Hz, 15 m/s at 2 Hz
)
def test_windows_count_metres(prior: bool, step_m: float, last: tuple[int, int]) -> None:
    """The next two units, and others as far apart as depth needs, however many units that is."""
    units, config = 60, PairConfig()
    drive, poses = drive_of(2, units), straight_road(units, step_m)
    motion = motion_from_poses(drive, poses)
    pairs = pairs_from_poses(drive, poses, config) if prior else pairs_by_motion(drive, config, motion)
    unit, camera = units_and_cameras(drive, pairs)
    same = camera[:, 0] == camera[:, 1]
    inner = same & (unit[:, 0] >= 10) & (unit[:, 0] < 30) & (camera[:, 0] == 0)
    gap = unit[inner, 1] - unit[inner, 0]
    assert {1, 2} <= set(gap.tolist())
    assert last[0] <= gap.max() <= last[1]
    assert 2 * 20 <= inner.sum() <= config.window_units * 20
    beyond = np.diff(sorted(set(unit[inner & (unit[:, 0] == 20), 1])))[1:]
    assert (beyond * step_m >= 0.8).all()


def test_a_window_ends_where_no_matches_are_expected() -> None:
    """At 2 Hz on a motorway the third unit shows hardly anything of the first."""
    drive = drive_of(1, 20)
    known = motion_from_poses(drive, straight_road(20, 15.0))
    gaps = {}
    for lost_per_m in (0.01, 0.2):
        motion = replace(
            known, lost_per_m=np.full_like(known.lost_per_m, lost_per_m), matches=np.full_like(known.matches, 120.0)
        )
        unit, _ = units_and_cameras(drive, pairs_by_motion(drive, PairConfig(), motion, min_matches=15))
        gaps[lost_per_m] = int((unit[:, 1] - unit[:, 0]).max())
    assert gaps == {0.01: 4, 0.2: 2}


def test_a_standing_car_has_neighbours_and_no_more() -> None:
    drive = drive_of(2, 60)
    pairs = pairs_from_poses(drive, straight_road(60, step_m=0.0), PairConfig())
    unit, _ = units_and_cameras(drive, pairs)
    assert (unit[:, 1] - unit[:, 0]).max() <= PairConfig().window_units


def test_opposite_directions_are_paired_only_where_cameras_look_the_same_way() -> None:
    units = 60
    there, back = straight_road(units), straight_road(units)[::-1] @ se3.transform(se3.exp_so3([0, 0, np.pi]), [0] * 3)
    poses = np.concatenate([there, back + se3.transform(np.zeros((3, 3)), [0, 4.0, 0]) - np.diag([0, 0, 0, 1.0])])
    drive = drive_of(6, 2 * units)
    unit, camera = units_and_cameras(drive, pairs_from_poses(drive, poses, PairConfig()))
    across = (unit[:, 0] < units - 10) & (unit[:, 1] >= units + 10)
    assert across.sum() > 20
    names = np.array([c.name for c in drive.cameras])[camera[across]]
    assert not ((names == "front").all(1)).any()


@pytest.mark.parametrize("prior", [True, False])
def test_missing_images_are_no_trouble(prior: bool) -> None:
    drive = drive_of(6, 20, present=lambda unit, camera: (unit + camera) % 3 != 0)
    assert len(drive.images) == 80
    pairs = (
        pairs_from_poses(drive, straight_road(20), PairConfig()) if prior else pairs_from_window(drive, PairConfig())
    )
    check_form(drive, pairs)
    unit, _ = units_and_cameras(drive, pairs)
    assert set(unit.ravel().tolist()) == set(range(20))


@pytest.mark.parametrize("units", [1, 2])
@pytest.mark.parametrize("cameras", [1, 2])
def test_tiny_drives(units: int, cameras: int) -> None:
    drive = drive_of(cameras, units)
    expected = units * cameras * (units * cameras - 1) // 2
    assert 0 <= len(pairs_from_window(drive, PairConfig())) <= expected
    assert 0 <= len(pairs_from_poses(drive, straight_road(units), PairConfig())) <= expected
    if units == 2:
        assert len(pairs_from_poses(drive, straight_road(units), PairConfig())) >= cameras


def test_the_quota_per_image_is_kept() -> None:
    drive = drive_of(6, 60)
    config = PairConfig(pairs_per_image=4, window_units=8)
    few = pairs_from_poses(drive, straight_road(60), config)
    many = pairs_from_poses(drive, straight_road(60), PairConfig(pairs_per_image=16, window_units=8))
    # Chosen by either end: at most twice the quota on average, and two neighbours.
    assert len(few) <= len(drive.images) * (4 + 2)
    assert len(few) < 0.6 * len(many)


def test_without_selection_all_images_of_near_units_are_paired() -> None:
    drive = drive_of(3, 6, present=lambda unit, camera: (unit, camera) != (2, 1))
    pairs = pairs_without_selection(drive, PairConfig(window_units=2))
    check_form(drive, pairs)
    unit = [image.unit for image in drive.images]
    expected = {(i, j) for i in range(17) for j in range(i + 1, 17) if unit[j] - unit[i] <= 2}
    assert {(int(a), int(b)) for a, b in pairs} == expected
    # Also cameras that look in opposite directions, which the selection leaves out.
    assert set(map(tuple, pairs_from_window(drive, PairConfig(window_units=2)).tolist())) < expected


def test_grey_images_do_not_cut_the_drive() -> None:
    drive, config = drive_of(2, 14), PairConfig()
    unit = np.array([image.unit for image in drive.images])
    usable = (unit < 4) | (unit > 9)
    by_motion = pairs_by_motion(drive, config, motion_unknown(drive, config), usable=usable)
    for pairs in (by_motion, pairs_from_poses(drive, straight_road(14), config, usable)):
        assert usable[pairs].all()
        units = np.sort(unit[pairs], axis=1)
        across = units[(units[:, 0] < 4) & (units[:, 1] > 9)]
        assert {tuple(row) for row in across.tolist()} >= {(3, 10), (3, 11), (2, 10)}
