"""Cameras that are late by whole frames, or turned, in drives whose cameras have a common view."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from mrasfm_engine.config import BundleAdjustmentConfig, MatchConfig
from mrasfm_engine.errors import CancelledError, InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.matching.contradicted_rig import require_images_as_listed
from mrasfm_engine.matching.nearest_neighbour import NearestNeighbourMatcher
from mrasfm_engine.matching.pair_matching import match_pairs
from mrasfm_engine.matching.relisted_images import MAX_LAG, RelistedImages, _common_rotation
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures
from schemas.findings import Finding
from tests.helpers.simulated_drive import make_drive, random_descriptors
from tests.helpers.slow import slow

UNITS, POINTS, FOCAL_PX, WIDTH, HEIGHT = 12, 2000, 700.0, 960, 540
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
CONFIG = MatchConfig()


def looking_ahead(cameras: int) -> np.ndarray:
    """Parallel cameras (c, 4, 4) across the vehicle."""
    across = np.linspace(0.6, -0.6, cameras)
    return se3.transform(np.tile(FORWARD, (cameras, 1, 1)), [[1.7, y, 1.5] for y in across])


@dataclass(frozen=True)
class Street:
    """A street along which parallel cameras drive, and the images that a manifest lists."""

    drive: Drive
    features: list[ImageFeatures]
    calibration: BundleAdjustmentConfig = field(default_factory=BundleAdjustmentConfig)

    def check(self, *, cancel: bool = False) -> Finding | None:
        images = self.drive.images
        pairs = np.array(
            [
                (i, j)
                for i, a in enumerate(images)
                for j, b in enumerate(images)
                if i < j and (a.unit == b.unit or (a.camera == b.camera and b.unit == a.unit + 1))
            ]
        )
        matcher = NearestNeighbourMatcher(CONFIG)
        found = match_pairs(self.drive, self.features, pairs, matcher, CONFIG, self.calibration, threads=1)
        return require_images_as_listed(
            self.drive,
            self.features,
            found.pairs,
            matcher,
            CONFIG,
            self.calibration,
            max_depth_m=50.0,
            rig_from_cam=found.rig.rig_from_cam,
            cancel=lambda: cancel,
        )


def street(
    *,
    cameras: int = 2,
    units: int = UNITS,
    late: int | None = None,
    lag: int = 0,
    late_units: Collection[int] | None = None,
    true: np.ndarray | None = None,
    points: np.ndarray | None = None,
    noise_px: float = 0.3,
    given: np.ndarray | None = None,
    speed_m: float = 1.2,
    turn_deg: float = 1.7,
    steady: bool = False,
    seed: int = 0,
) -> Street:
    """Images of a street; those of the camera `late` were taken `lag` frames before the ones they are listed with,
    in some units."""
    rng = np.random.default_rng(seed)
    true = looking_ahead(cameras) if true is None else true
    params = np.array([[FOCAL_PX, FOCAL_PX, WIDTH / 2, HEIGHT / 2]] * cameras)
    drive = make_drive(true if given is None else given, params, units=units)
    side = rng.choice([-1.0, 1.0], POINTS)
    if points is None:
        x, y, z = rng.uniform(-10, 60, POINTS), side * rng.uniform(4, 12, POINTS), rng.uniform(-1, 8, POINTS)
        points = np.stack([x, y, z], 1)
    descriptors, features = random_descriptors(POINTS, rng), []
    for image in drive.images:
        unit = image.unit - (lag if image.camera == late and image.unit in (late_units or range(units)) else 0)
        # It turns, and not always by as much: else a lag looks like a camera that is mounted otherwise.
        heading = np.radians(turn_deg) * (unit + (0.0 if steady else 2.0 * np.sin(0.9 * unit)))
        vehicle = se3.transform(se3.exp_so3([0.0, 0.0, heading]), [speed_m * unit, 0.5 * speed_m * heading * unit, 0.0])
        in_camera = se3.apply(se3.inverse(vehicle @ true[image.camera]), points)
        depth = np.maximum(in_camera[:, 2:], 1e-3)
        xy = FOCAL_PX * in_camera[:, :2] / depth + [WIDTH / 2, HEIGHT / 2] + rng.normal(size=(POINTS, 2)) * noise_px
        seen = (in_camera[:, 2] > 1) & (xy > 0).all(1) & (xy < [WIDTH, HEIGHT]).all(1)
        features.append(
            ImageFeatures(
                xy_px=xy[seen].astype(np.float32),
                descriptors=descriptors[seen],
                colors=np.zeros((int(seen.sum()), 3), dtype=np.uint8),
            )
        )
    return Street(drive, features)


def turned(camera: int, axis: tuple[float, float, float], turn_deg: float, *, cameras: int = 2) -> np.ndarray:
    """The rig with a camera turned about an axis of its own."""
    rig_from_cam = looking_ahead(cameras)
    rig_from_cam[camera, :3, :3] = rig_from_cam[camera, :3, :3] @ se3.exp_so3(np.radians(turn_deg) * np.array(axis))
    return rig_from_cam


@pytest.mark.parametrize("cameras", [2, 3])
def test_images_that_are_listed_as_they_were_taken_pass(cameras: int) -> None:
    assert street(cameras=cameras).check() is None


@pytest.mark.parametrize("lag", [-1, MAX_LAG, *slow(1, 2)])
def test_a_camera_that_is_late_by_whole_frames_is_refused_with_their_number(lag: int) -> None:
    with pytest.raises(InputError) as caught:
        street(late=1, lag=lag).check()
    assert caught.value.code == "camera-late"
    frames = "1 frame" if abs(lag) == 1 else f"{abs(lag)} frames"
    assert f"listed {frames} {'before' if lag > 0 else 'after'} them, and not" in caught.value.what
    assert frames in caught.value.remedy


@pytest.mark.parametrize("lag", [MAX_LAG + 1, *slow(13, -20)])
def test_a_camera_that_is_late_by_so_much_that_it_sees_other_things_is_refused_with_the_number(lag: int) -> None:
    with pytest.raises(InputError) as caught:
        street(units=40, late=1, lag=lag, speed_m=0.8, turn_deg=0.4).check()
    assert caught.value.code == "camera-late"
    assert f"listed {abs(lag)} frames {'before' if lag > 0 else 'after'} them, and not" in caught.value.what


def test_cameras_that_match_nowhere_are_not_late_but_a_finding() -> None:
    """One of them looks through a filter, or is mirrored: both match themselves, and neither the other."""
    made = street(units=24, speed_m=0.8, turn_deg=0.4)
    other = street(units=24, speed_m=0.8, turn_deg=0.4, seed=1)
    images = zip(made.drive.images, made.features, other.features, strict=True)
    found = Street(made.drive, [b if image.camera == 1 else a for image, a, b in images]).check()
    assert found is not None
    assert found.code == "calibration-unexplained"
    assert "none of their matches fit" in found.what
    assert "Check of camera0 and camera1 that" in found.remedy


@pytest.mark.parametrize("focal", [0.9, 1.1])
def test_a_focal_length_that_is_wrong_by_a_tenth_is_a_finding(focal: float) -> None:
    params = np.array([[FOCAL_PX, FOCAL_PX, WIDTH / 2, HEIGHT / 2]] * 3)
    params[2, :2] *= focal
    found = replace(street(cameras=3), drive=make_drive(looking_ahead(3), params, units=UNITS)).check()
    assert found is not None
    assert found.code == "calibration-unexplained"
    assert "camera2 contradict rig.cameras" in found.what
    assert "Check of camera2 that" in found.remedy


@pytest.mark.parametrize(
    ("late_units", "span"),
    [
        (range(5, UNITS), "from {5} us on"),
        (range(7, UNITS), "from {7} us on"),
        (range(4), "until {3} us"),
        (range(4, 8), "from {4} us to {7} us"),
    ],
)
@pytest.mark.parametrize("lag", [1, *slow(-1)])
def test_a_camera_that_is_late_from_somewhere_on_is_refused_with_the_time(
    late_units: range, span: str, lag: int
) -> None:
    made = street(late=1, lag=lag, late_units=late_units, speed_m=2.0)
    with pytest.raises(InputError) as caught:
        made.check()
    assert caught.value.code == "camera-late"
    at = span.format(*made.drive.timestamps_us)
    assert f"listed 1 frame {'before' if lag > 0 else 'after'} them {at}, and not" in caught.value.what
    assert f"by 1 frame {at}, so that" in caught.value.remedy


def test_some_units_that_agree_by_chance_part_no_span() -> None:
    with pytest.raises(InputError) as caught:
        street(late=1, lag=1, late_units={*range(4), *range(6, UNITS)}).check()
    assert "before them, and not" in caught.value.what


@pytest.mark.parametrize("apart_m", [0.12, 0.5])
@pytest.mark.parametrize("off_deg", [0.0, 0.05])
def test_cameras_behind_each_other_that_look_aside_into_open_country_pass(apart_m: float, off_deg: float) -> None:
    """Noise puts their far points behind them, and less of it in images that were taken farther apart."""
    rng = np.random.default_rng(2)
    left = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    true = se3.transform(np.tile(left, (2, 1, 1)), [[1.7 + apart_m, 0.8, 1.5], [1.7, 0.8, 1.5]])
    given = true.copy()
    given[1, :3, :3] = given[1, :3, :3] @ se3.exp_so3([0.0, np.radians(off_deg), 0.0])
    x, y, z = rng.uniform(-150, 150, POINTS), rng.uniform(20, 300, POINTS), rng.uniform(-5, 30, POINTS)
    far = np.stack([x, y, z], 1)
    assert street(true=true, given=given, points=far, noise_px=0.7, turn_deg=0.3).check() is None


@pytest.mark.parametrize("off_m", [0.09, -0.09])
def test_a_camera_that_comes_to_the_place_of_another_one_is_not_late(off_m: float) -> None:
    """Two frames later it sees what the other one saw, without parallax, and its wrong height no longer shows."""
    rng = np.random.default_rng(3)
    left = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    true = se3.transform(np.tile(left, (2, 1, 1)), [[1.5, 0.6, 1.5], [0.6, 0.6, 1.5]])
    given = true.copy()
    given[1, 2, 3] += off_m
    x, y, z = rng.uniform(-8, 16, POINTS), rng.uniform(3, 9, POINTS), rng.uniform(-1, 6, POINTS)
    points = np.stack([x, y, z], 1)
    assert street(true=true, given=given, points=points, speed_m=0.45, turn_deg=0.05).check() is None


def test_one_frame_that_is_late_is_left_to_the_mapping() -> None:
    assert street(late=1, lag=1, late_units=range(6, 8)).check() is None


def test_of_three_cameras_the_late_one_is_named() -> None:
    made = street(cameras=3, late=2, lag=1)
    with pytest.raises(InputError) as caught:
        made.check()
    names = [camera.name for camera in made.drive.cameras]
    assert f"Move the images of {names[2]} by 1 frame" in caught.value.remedy


@pytest.mark.parametrize(
    ("axis", "turn_deg"),
    [
        ((0, 0, 1), 180.0),
        ((0, 0, 1), 90.0),
        ((0, 1, 0), 45.0),
        ((1, 0, 0), 22.0),
        ((0, 0, 1), 25.0),
        ((0, 1, 0), 90.0),
        ((0, 1, 0), 180.0),
        ((1, 0, 0), 60.0),
    ],
)
def test_a_camera_that_is_turned_far_from_where_it_is_given_is_refused_with_the_angle(
    axis: tuple[float, float, float], turn_deg: float
) -> None:
    with pytest.raises(InputError) as caught:
        street(given=turned(1, axis, turn_deg)).check()
    assert caught.value.code == "camera-turned"
    assert f"turned by {turn_deg:.0f} deg" in caught.value.what


@pytest.mark.parametrize("apart_m", [0.06, 0.005, 0.0])
def test_cameras_close_to_one_another_are_not_turned_by_half_a_turn(apart_m: float) -> None:
    """Their essential matrix hardly tells on which side of the cameras points are."""
    b_from_a, off_deg = se3.exp_so3(np.radians([3.0, 1.0, 0.5])), []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        points = rng.uniform([-10, -3, 8], [10, 3, 40], (5, 400, 3))
        rays = [points, (points - [apart_m, 0, 0]) @ b_from_a.T]
        a, b = (one / one[..., 2:] + rng.normal(0.0, 0.4 / FOCAL_PX, one.shape) * [1, 1, 0] for one in rays)
        found = _common_rotation(list(a), list(b), 4.0 / FOCAL_PX)
        assert found is not None
        off_deg.append(float(se3.rotation_angle_deg(b_from_a.T @ found)))
    assert max(off_deg) < 1.0


def test_cameras_that_look_apart_pass() -> None:
    assert street(true=turned(1, (0, 1, 0), 180.0)).check() is None
    assert street(true=turned(1, (0, 1, 0), 90.0)).check() is None


@pytest.mark.parametrize("turn_deg", [1.0, 5.0, 18.0])
def test_a_camera_that_is_a_little_off_is_left_to_the_calibrations_own_estimate(turn_deg: float) -> None:
    assert street(given=turned(1, (1, 0, 0), turn_deg)).check() is None


@pytest.mark.parametrize("off_deg", [0.0, 60.0])
def test_cameras_that_fit_as_given_are_not_turned_however_else_they_fit(
    off_deg: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cameras that hardly share a view have no matches in the pairs, and a few at the edges of some images."""
    made = street(given=turned(1, (0, 0, 1), off_deg))
    matcher, images = NearestNeighbourMatcher(CONFIG), made.drive.images
    apart = np.array([(i, i + 2) for i in range(len(images) - 2)])  # of one camera each
    found = match_pairs(made.drive, made.features, apart, matcher, CONFIG, made.calibration, threads=1)
    monkeypatch.setattr(RelistedImages, "turn_deg", lambda self: 60.0)
    arguments = (made.drive, made.features, found.pairs, matcher, CONFIG, made.calibration)
    if off_deg:
        with pytest.raises(InputError) as caught:
            require_images_as_listed(*arguments, max_depth_m=50.0)
        assert caught.value.code == "camera-turned"
    else:
        assert require_images_as_listed(*arguments, max_depth_m=0.1) is None


def test_a_vehicle_that_stands_shows_no_lag() -> None:
    assert street(late=1, lag=1, speed_m=0.0, given=turned(1, (1, 0, 0), 3.0)).check() is None


def test_a_declared_uncertainty_of_the_rotations_is_left_to_the_estimate() -> None:
    made = street(given=turned(1, (0, 0, 1), 60.0))
    with pytest.raises(InputError):
        made.check()
    replace(made, calibration=BundleAdjustmentConfig(sigma_rotation_deg=15.0)).check()


@pytest.mark.parametrize("off_deg", [-3.0, 3.0])
def test_a_camera_that_is_turned_by_as_much_as_the_vehicle_turns_in_a_frame_is_not_late(off_deg: float) -> None:
    """On a ramp, where only the place of the cameras between two frames tells both apart."""
    assert street(given=turned(1, (0, 1, 0), off_deg), speed_m=0.2, turn_deg=3.0, steady=True).check() is None


@pytest.mark.parametrize(("moved_px", "scale"), [((0, 0), 1.0), ((30, 0), 1.0), ((0, 300), 1.0), ((40, 10), 0.8)])
def test_what_is_drawn_into_all_images_turns_no_camera(moved_px: tuple[float, float], scale: float) -> None:
    """The time of day at one place of each camera's images, and nothing else in common: the cameras look apart."""
    rng = np.random.default_rng(1)
    apart = looking_ahead(2)
    apart[1, :3, :3] = se3.exp_so3([0.0, 0.0, np.pi]) @ apart[1, :3, :3]
    drive = make_drive(apart, np.array([[FOCAL_PX, FOCAL_PX, WIDTH / 2, HEIGHT / 2]] * 2), units=UNITS)
    drawn = rng.uniform([100, 20], [800, 120], (150, 2))
    common = random_descriptors(150, rng)
    features = []
    for image in drive.images:
        place = drawn if image.camera == 0 else scale * drawn + moved_px
        features.append(
            ImageFeatures(
                xy_px=(place + rng.normal(size=place.shape) * 0.2).astype(np.float32),
                descriptors=common,
                colors=np.zeros((150, 3), dtype=np.uint8),
            )
        )
    assert Street(drive, features).check() is None


def test_the_search_ends_when_it_is_cancelled() -> None:
    with pytest.raises(CancelledError):
        street(late=1, lag=1).check(cancel=True)


def test_a_drive_of_one_camera_has_nothing_to_compare() -> None:
    made = street(cameras=1)
    matcher = NearestNeighbourMatcher(CONFIG)
    pairs = np.array([(i, i + 1) for i in range(UNITS - 1)])
    found = match_pairs(made.drive, made.features, pairs, matcher, CONFIG, made.calibration, threads=1)
    assert found.pairs
    require_images_as_listed(
        made.drive, made.features, found.pairs, matcher, CONFIG, made.calibration, max_depth_m=50.0
    )
