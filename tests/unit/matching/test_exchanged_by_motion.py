"""Cameras that have each other's images, in drives whose cameras share no view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest

from mrasfm_engine.errors import CancelledError, InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.matching import exchanged_by_motion as module
from mrasfm_engine.matching.exchanged_by_motion import MIN_MOTIONS, exchanged_by_motion
from mrasfm_engine.matching.verification import relative_pose
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures, PairMatches
from schemas.findings import Finding
from tests.helpers.simulated_drive import make_drive
from tests.helpers.slow import slow

UNITS, WINDOW = 10, 3
WIDTH, HEIGHT, FOCAL_PX = 960, 540, 700.0
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
SIX = (0.0, 55.0, -55.0, 110.0, -110.0, 180.0)
EIGHT = (0.0, 45.0, 90.0, 135.0, 180.0, -135.0, -90.0, -45.0)


def looking(yaws_deg: Sequence[float]) -> np.ndarray:
    """Poses (c, 4, 4) of cameras at the rim of a roof, 1 m from its middle, which is 1 m ahead of the rear axle."""
    turns = se3.exp_so3(np.radians([[0.0, 0.0, yaw] for yaw in yaws_deg]))
    return se3.transform(turns @ FORWARD, turns @ [1.0, 0.0, 0.0] + [1.0, 0.0, 1.5])


def turned(rig_from_cam: np.ndarray, camera: int, yaw_deg: float) -> np.ndarray:
    """A rig with a camera turned about the vehicle's up axis."""
    result = rig_from_cam.copy()
    result[camera, :3, :3] = se3.exp_so3(np.radians([0.0, 0.0, yaw_deg])) @ result[camera, :3, :3]
    return result


def street(rng: np.random.Generator, count: int = 6000) -> np.ndarray:
    """Points (n, 3) of houses and trees along a street."""
    x, side = rng.uniform(-60, 80, count), rng.choice([-1.0, 1.0], count)
    return np.stack([x, side * rng.uniform(5, 30, count), rng.uniform(-1, 10, count)], 1)


def walls(rng: np.random.Generator, count: int = 6000) -> np.ndarray:
    """Points (n, 3) of two straight walls that part no camera's view."""
    points = street(rng, count)
    points[:, 1] = np.sign(points[:, 1]) * 6.0
    return points


@dataclass(frozen=True)
class Made:
    """A drive whose images show points, and the matches of each camera's own images and of simultaneous ones."""

    drive: Drive
    features: list[ImageFeatures]
    points: list[np.ndarray]  # of every keypoint

    def pairs(self) -> list[PairMatches]:
        images, result = self.drive.images, []
        for a, one in enumerate(images):
            for b in range(a + 1, len(images)):
                other = images[b]
                is_own = one.camera == other.camera and other.unit - one.unit <= WINDOW
                if not (is_own or one.unit == other.unit):
                    continue
                _, i, j = np.intersect1d(self.points[a], self.points[b], return_indices=True)
                if len(i) >= 15:
                    none = np.zeros(len(i), dtype=np.bool_)  # a prior that the images contradict leaves none
                    matches = np.stack([i, j], 1).astype(np.int32)
                    result.append(PairMatches(image_a=a, image_b=b, matches=matches, inliers=none))
        return result

    def check(self, *, cancel: bool = False) -> Finding | None:
        return exchanged_by_motion(self.drive, self.features, self.pairs(), cancel=lambda: cancel)


def made(
    true: np.ndarray,
    *,
    given: np.ndarray | None = None,
    exchanged: tuple[int, int] = (0, 0),
    points: np.ndarray | None = None,
    backwards: Sequence[int] = (),
    backwards_units: Sequence[int] = range(UNITS),
    focal_px: Sequence[float] | None = None,
    units: int = UNITS,
    speed_m: float = 1.5,
    turn_deg: float = 0.0,
    noise_px: float = 0.3,
) -> Made:
    """Images of a rig in a street. Two cameras have each other's images; traffic that overtakes fills some views,
    `backwards`: they show the street as if the vehicle drove the other way."""
    rng = np.random.default_rng(0)
    points = street(rng) if points is None else points
    focal = np.full(len(true), FOCAL_PX) if focal_px is None else np.array(focal_px)
    params = np.array([[f, f, WIDTH / 2, HEIGHT / 2] for f in focal])
    drive = make_drive(true if given is None else given, params, units=units)
    taken_by = np.arange(len(true))
    taken_by[list(exchanged)] = taken_by[list(exchanged)[::-1]]
    features, of_points = [], []
    for image in drive.images:
        camera = int(taken_by[image.camera])
        way = -image.unit if camera in backwards and image.unit in backwards_units else image.unit
        heading = np.radians(turn_deg)
        steps = np.cumsum(
            [[0.0, 0.0], *([np.cos(heading * (k + 0.5)), np.sin(heading * (k + 0.5))] for k in range(abs(way)))], 0
        )
        place = np.sign(way) * speed_m * steps[-1]
        vehicle = se3.transform(se3.exp_so3([0.0, 0.0, heading * way]), [place[0], place[1], 0.0])
        in_camera = se3.apply(se3.inverse(vehicle @ true[camera]), points)
        depth = np.maximum(in_camera[:, 2:], 1e-3)
        xy = focal[camera] * in_camera[:, :2] / depth + [WIDTH / 2, HEIGHT / 2]
        xy += rng.normal(size=xy.shape) * noise_px
        seen = np.flatnonzero((in_camera[:, 2] > 1) & (xy > 0).all(1) & (xy < [WIDTH, HEIGHT]).all(1))
        of_points.append(rng.permutation(seen))
        xy_px = xy[of_points[-1]].astype(np.float32)
        features.append(
            ImageFeatures(
                xy_px=xy_px,
                descriptors=np.zeros((len(xy_px), 128), dtype=np.uint8),
                colors=np.zeros((len(xy_px), 3), dtype=np.uint8),
            )
        )
    return Made(drive, features, of_points)


def refused(drive: Made) -> InputError:
    with pytest.raises(InputError) as caught:
        drive.check()
    assert caught.value.code == "cameras-exchanged"
    return caught.value


@pytest.mark.parametrize("turn_deg", [0.0, 3.0, *slow(12.0)])
@pytest.mark.parametrize("yaws_deg", [(60.0, -60.0), (60.0, -60.0, 0.0), SIX, EIGHT])
def test_a_right_rig_passes(yaws_deg: tuple[float, ...], turn_deg: float) -> None:
    """Round a circle of 7 m as well, where lever arms change directions."""
    assert made(looking(yaws_deg), turn_deg=turn_deg).check() is None


# Cameras that are exchanged; every other vehicle turns.
EXCHANGED = [
    ((60.0, -60.0), (0, 1), 0.0),
    ((45.0, -45.0), (0, 1), 3.0),
    ((60.0, -60.0, 0.0), (0, 1), 0.0),
    ((60.0, -60.0, 0.0), (0, 2), 3.0),
    (SIX, (1, 2), 0.0),
    (SIX, (3, 4), 3.0),
    (SIX, (0, 3), 0.0),
    (EIGHT, (1, 7), 3.0),
    (EIGHT, (2, 3), 0.0),
]


@pytest.mark.parametrize(
    ("yaws_deg", "exchanged", "turn_deg"),
    [
        *EXCHANGED,
        *(pytest.param(yaws, pair, 3.0 - turn, marks=pytest.mark.slow) for yaws, pair, turn in EXCHANGED),
    ],
)
def test_exchanged_cameras_are_refused_by_name(
    yaws_deg: tuple[float, ...], exchanged: tuple[int, int], turn_deg: float
) -> None:
    error = refused(made(looking(yaws_deg), exchanged=exchanged, turn_deg=turn_deg))
    a, b = exchanged
    assert f"the images of cameras camera{a} and camera{b} look exchanged: in " in error.what
    assert error.remedy.startswith(f"Exchange the files of camera{a} and camera{b} in all frames, or their entries in")


def test_exchanged_cameras_of_other_lenses_are_refused() -> None:
    drive = made(looking(SIX), exchanged=(0, 1), focal_px=[1400.0, *[700.0] * 5])
    assert "camera0 and camera1 look exchanged" in refused(drive).what


def test_exchanged_cameras_are_refused_where_traffic_fills_one_of_them_at_times() -> None:
    drive = made(looking(SIX), exchanged=(1, 2), backwards=(1,), backwards_units=range(4, UNITS))
    assert "camera1 and camera2 look exchanged" in refused(drive).what


def test_exchanged_cameras_that_look_aside_are_a_finding() -> None:
    """Both see the vehicle drive backwards, and traffic on both sides would look so as well."""
    finding = made(looking((0.0, 180.0, 90.0, -90.0)), exchanged=(2, 3)).check()
    assert finding is not None
    assert (finding.severity, finding.code) == ("warning", "cameras-backwards")
    assert "camera2 and camera3 look exchanged" in finding.what
    assert "the other way than the other cameras do" in finding.what
    assert "traffic" in finding.remedy


def test_two_cameras_that_see_the_vehicle_drive_backwards_say_nothing() -> None:
    """It may do so."""
    assert made(looking((90.0, -90.0)), exchanged=(0, 1)).check() is None


@pytest.mark.parametrize("backwards", [(1,), (1, 2), (1, 2, 3)])
def test_traffic_that_overtakes_is_no_reason_to_refuse(backwards: tuple[int, ...]) -> None:
    """Cameras of right rigs that it fills all along, of which no two as each other would see it drive forwards."""
    assert made(looking(SIX), backwards=backwards).check() is None


@pytest.mark.parametrize("noise_px", [0.3, 1.0, *slow(0.01)])
@pytest.mark.parametrize("yaws_deg", [(45.0, -45.0), (45.0, -45.0, 180.0), SIX, EIGHT])
def test_walls_are_no_reason_to_refuse(yaws_deg: tuple[float, ...], noise_px: float) -> None:
    assert made(looking(yaws_deg), points=walls(np.random.default_rng(0)), noise_px=noise_px).check() is None


@pytest.mark.parametrize("noise_px", [0.05, 0.3, 1.0])
def test_the_other_motion_that_a_wall_allows_is_no_reason_to_refuse(
    noise_px: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One along its normal explains it as well: as each other, both cameras would see the vehicle drive forwards."""

    def other_motion(*rays: np.ndarray, **options: float) -> tuple[np.ndarray, np.ndarray] | None:
        inwards = np.sign(rays[0][:, 0].mean())
        by_plane = module._by_plane(rays[0], rays[1], 2.0 * options["max_error"])
        return next(
            (pose for pose in by_plane if pose[1][0] * inwards > 0.5 > 0.0 > pose[1][2]),
            relative_pose(rays[0], rays[1], **options),
        )

    monkeypatch.setattr(module, "relative_pose", other_motion)
    drive = made(looking((45.0, -45.0)), noise_px=noise_px, points=walls(np.random.default_rng(0)))
    assert drive.check() is None
    monkeypatch.setattr(module._Motions, "_shows_depth", lambda motions, camera: True)
    refused(drive)


@pytest.mark.parametrize("speed_m", [0.0, 0.01])
def test_a_standing_vehicle_says_nothing(speed_m: float) -> None:
    assert made(looking(SIX), exchanged=(1, 2), speed_m=speed_m).check() is None


@pytest.mark.parametrize("yaw_deg", [120.0, -120.0, 180.0, 90.0, 30.0, *slow(60.0, -60.0, -90.0)])
@pytest.mark.parametrize("yaws_deg", [(60.0, -60.0), (60.0, -60.0, 0.0), SIX[1:3] + SIX[:1] + SIX[3:]])
@pytest.mark.parametrize("camera", [0, *slow(1)])  # the rigs are alike on both sides
def test_a_camera_that_is_turned_is_not_exchanged(yaws_deg: tuple[float, ...], yaw_deg: float, camera: int) -> None:
    true = looking(yaws_deg)
    assert made(true, given=turned(true, camera, yaw_deg)).check() is None


@pytest.mark.parametrize("yaw_deg", [5.0, -8.0])
@pytest.mark.parametrize("yaws_deg", [(60.0, -60.0), (12.0, -12.0), SIX])
def test_a_calibration_that_is_off_by_some_degrees_passes(yaws_deg: tuple[float, ...], yaw_deg: float) -> None:
    true = looking(yaws_deg)
    assert made(true, given=turned(turned(true, 0, yaw_deg), 1, -yaw_deg)).check() is None


@pytest.mark.parametrize("yaws_deg", [(45.0, -45.0), SIX, EIGHT])
def test_a_rig_in_other_axes_passes(yaws_deg: tuple[float, ...]) -> None:
    """Its cameras agree, whatever direction they call forwards."""
    true = looking(yaws_deg)
    aside = se3.transform(se3.exp_so3(np.radians([0.0, 0.0, 90.0])), np.zeros(3))
    assert made(true, given=aside @ true).check() is None


def test_a_vehicle_that_drives_backwards_passes() -> None:
    assert made(looking(SIX), speed_m=-1.5).check() is None


def test_few_motions_say_nothing() -> None:
    assert made(looking(SIX), exchanged=(1, 2), units=MIN_MOTIONS).check() is None
    refused(made(looking(SIX), exchanged=(1, 2), units=MIN_MOTIONS + 1))


def test_cameras_whose_simultaneous_images_fit_are_not_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    drive = made(looking((5.0, -5.0)))
    monkeypatch.setattr(module, "_Motions", None)
    fitting = [
        PairMatches(image_a=p.image_a, image_b=p.image_b, matches=p.matches, inliers=~p.inliers) for p in drive.pairs()
    ]
    assert exchanged_by_motion(drive.drive, drive.features, fitting) is None


def test_a_right_rig_costs_a_few_motions(monkeypatch: pytest.MonkeyPatch) -> None:
    drive, count = made(looking(SIX)), list[int]()

    def counted(*rays: np.ndarray, **options: float) -> tuple[np.ndarray, np.ndarray] | None:
        count.append(len(rays[0]))
        return relative_pose(rays[0], rays[1], **options)

    monkeypatch.setattr(module, "relative_pose", counted)
    assert drive.check() is None
    assert 0 < len(count) <= 3 * len(SIX)


def test_a_single_camera_has_nobody_to_be_exchanged_with() -> None:
    assert made(looking((0.0,))).check() is None


def test_it_stops_when_asked_to() -> None:
    with pytest.raises(CancelledError):
        made(looking(SIX)).check(cancel=True)
