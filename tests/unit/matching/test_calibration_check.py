from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from mrasfm_engine.config import MatchConfig
from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.io.axes import flu_from_body
from mrasfm_engine.matching.calibration_check import require_calibration_direction
from mrasfm_engine.matching.nearest_neighbour import NearestNeighbourMatcher
from mrasfm_engine.scene.scene import ImageFeatures
from schemas import BodyAxes
from tests.helpers.simulated_drive import SimulatedDrive, inverted, make_drive, make_simulated_drive, random_descriptors

UNITS = 4
# KITTI's arrangement: two forward cameras that are parallel to the last bit, 0.5 m apart.
RECTIFIED = se3.transform(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), [[1.7, 0.25, 1.5], [1.7, -0.25, 1.5]])


def check(simulated: SimulatedDrive) -> None:
    config = MatchConfig()
    require_calibration_direction(
        simulated.drive,
        range(len(simulated.drive.images)),
        simulated.features,
        NearestNeighbourMatcher(config),
        config,
    )


@pytest.mark.parametrize("straight", [True, False])
@pytest.mark.parametrize("cameras", [2, 4, 6])
def test_the_right_calibration_passes(cameras: int, straight: bool) -> None:
    check(make_simulated_drive(units=UNITS, cameras=cameras, points=2500, straight=straight))


@pytest.mark.parametrize("cameras", [2, 4, 6])
def test_an_inverted_calibration_is_refused(cameras: int) -> None:
    simulated = make_simulated_drive(units=UNITS, cameras=cameras, points=2500, given=inverted)
    with pytest.raises(InputError, match="inverse") as caught:
        check(simulated)
    assert caught.value.code == "calibration-inverted"
    assert "translation" in caught.value.remedy


def reordered(rig_from_cam: np.ndarray) -> np.ndarray:
    """Poses of quaternions w, x, y, z that are read as x, y, z, w."""
    wxyz = np.roll(se3.quaternion_from_rotation(rig_from_cam[:, :3, :3]), 1, axis=-1)
    return se3.transform(se3.rotation_from_quaternion(wxyz), rig_from_cam[:, :3, 3])


def in_axes_of(flu_from_body: np.ndarray, change: Callable[[np.ndarray], np.ndarray]) -> Callable[..., np.ndarray]:
    return lambda rig_from_cam: flu_from_body @ change(se3.inverse(flu_from_body) @ rig_from_cam)


def with_quaternions_reordered(cameras: int, axes: BodyAxes) -> SimulatedDrive:
    given = in_axes_of(flu_from_body(axes), reordered)
    return make_simulated_drive(units=UNITS, cameras=cameras, points=2500, given=given)


@pytest.mark.parametrize("axes", [BodyAxes.FLU, BodyAxes.FRD])
def test_an_order_that_is_worth_a_degree_is_left_to_the_estimate_of_the_calibration(axes: BodyAxes) -> None:
    """Of cameras that look straight ahead, the numbers of a quaternion are the same in both orders."""
    check(with_quaternions_reordered(2, axes))


@pytest.mark.parametrize(("cameras", "axes"), [(2, BodyAxes.RDF), *((6, axes) for axes in BodyAxes)])
def test_quaternions_in_another_order_are_refused_as_that(cameras: int, axes: BodyAxes) -> None:
    simulated = with_quaternions_reordered(cameras, axes)
    with pytest.raises(InputError, match="order w, x, y, z") as caught:
        check(simulated)
    assert caught.value.code == "quaternion-order"
    assert "Give rotation_xyzw in the order x, y, z, w." in caught.value.remedy


def seen_by(
    rig_from_cam: np.ndarray,
    rig_from_cam_given: np.ndarray,
    *,
    low_m: tuple[float, float],
    backwards: int | None = None,
) -> SimulatedDrive:
    """Features of a rig under any calibration in the manifest, of points from x and y of `low_m` to 45 m and 12 m.

    The camera `backwards` sees the world as if the vehicle drove backwards.
    """
    rng = np.random.default_rng(0)
    params = np.array([[700.0, 700.0, 480.0, 270.0]] * len(rig_from_cam))
    drive = make_drive(rig_from_cam_given, params, units=UNITS)
    count = 900 if low_m[0] > 0 else 4000
    points = np.stack(
        [rng.uniform(low_m[0], 45, count), rng.uniform(low_m[1], -low_m[1], count), rng.uniform(-1, 8, count)], 1
    )
    descriptors, features = random_descriptors(count, rng), []
    for image in drive.images:
        unit = UNITS - 1 - image.unit if image.camera == backwards else image.unit
        vehicle = se3.transform(np.eye(3), [1.1 * unit, 0.0, 0.0])
        in_camera = se3.apply(se3.inverse(vehicle @ rig_from_cam[image.camera]), points)
        xy = 700.0 * in_camera[:, :2] / in_camera[:, 2:] + [480.0, 270.0] + rng.normal(size=(count, 2)) * 0.3
        seen = (in_camera[:, 2] > 1) & (xy > 0).all(1) & (xy < [960, 540]).all(1)
        features.append(
            ImageFeatures(
                xy_px=xy[seen].astype(np.float32),
                descriptors=descriptors[seen],
                colors=np.zeros((int(seen.sum()), 3), np.uint8),
            )
        )
    truth = make_simulated_drive(units=1, cameras=1, points=50).truth  # not looked at
    return SimulatedDrive(truth=truth, drive=drive, features=features, point_of_keypoint=[])


def rectified_stereo(rig_from_cam_given: np.ndarray) -> SimulatedDrive:
    """Features of the rectified pair under any calibration in the manifest."""
    return seen_by(RECTIFIED, rig_from_cam_given, low_m=(8.0, -12.0))


def looking(yaw_deg: float) -> np.ndarray:
    """Pose of a camera at the rim of a roof that looks into a direction."""
    turn = se3.exp_so3(np.array([0.0, 0.0, np.radians(yaw_deg)]))
    return se3.transform(turn @ RECTIFIED[0, :3, :3], turn @ [1.0, 0.0, 0.0] + [0.0, 0.0, 1.5])


def test_a_vehicle_that_overtakes_is_no_reason_to_refuse() -> None:
    """The camera that it fills says the opposite of the others, which agree; other orders scatter all of them."""
    rig_from_cam = np.stack([looking(yaw_deg) for yaw_deg in (-60.0, 60.0, 90.0)])
    check(seen_by(rig_from_cam, rig_from_cam, low_m=(-45.0, -45.0), backwards=0))
    with pytest.raises(InputError, match="If it is not that: Give rotation_xyzw in the order"):
        check(seen_by(rig_from_cam, reordered(rig_from_cam), low_m=(-45.0, -45.0)))


def test_a_rectified_stereo_pair_passes_and_its_inverse_does_not() -> None:
    check(rectified_stereo(RECTIFIED))
    with pytest.raises(InputError, match="inverse"):
        check(rectified_stereo(se3.inverse(RECTIFIED)))


def test_an_inverted_rectified_stereo_pair_in_kittis_axes_is_refused() -> None:
    flu_from_rdf = se3.transform(RECTIFIED[0, :3, :3], np.zeros(3))
    given = flu_from_rdf @ se3.inverse(se3.inverse(flu_from_rdf) @ RECTIFIED)
    with pytest.raises(InputError, match="inverse"):
        check(rectified_stereo(given))


@pytest.mark.parametrize("off_deg", [[0.0, 0.0, 12.0], [0.0, 0.0, 18.0], [0.0, 60.0, 0.0]])
def test_a_stereo_pair_given_far_off_is_not_called_inverted(off_deg: list[float]) -> None:
    """Some reading makes their directions agree: the inverse does not show a turn about the vehicle's up axis."""
    given = RECTIFIED.copy()
    given[1, :3, :3] = se3.exp_so3(np.radians(off_deg)) @ given[1, :3, :3]
    check(rectified_stereo(given))


def test_one_camera_off_by_3_degrees_is_not_called_inverted() -> None:
    def given(rig_from_cam: np.ndarray) -> np.ndarray:
        rig_from_cam[1, :3, :3] = se3.exp_so3(np.radians([0, 0, 3.0])) @ rig_from_cam[1, :3, :3]
        return rig_from_cam

    check(make_simulated_drive(units=UNITS, cameras=6, points=2500, given=given))


def test_a_standing_car_is_no_reason_to_refuse() -> None:
    check(make_simulated_drive(units=UNITS, cameras=6, points=2500, spacing_m=1e-4))


def test_images_without_features_give_no_verdict() -> None:
    check(make_simulated_drive(units=UNITS, cameras=2, points=400, hidden=lambda unit, camera: True, given=inverted))


def test_a_single_camera_gives_no_verdict() -> None:
    check(make_simulated_drive(units=UNITS, cameras=1, points=800, given=inverted))


def with_images_exchanged(simulated: SimulatedDrive, a: int, b: int) -> SimulatedDrive:
    """The drive whose manifest lists the images of two cameras as each other's."""
    images = simulated.drive.images
    where = {(image.unit, image.camera): i for i, image in enumerate(images)}
    other = {a: b, b: a}
    taken = [where[image.unit, other.get(image.camera, image.camera)] for image in images]
    return replace(simulated, features=[simulated.features[i] for i in taken])


def across(*y_m: float) -> np.ndarray:
    """Parallel forward cameras (c, 4, 4) at places across the vehicle."""
    return se3.transform(np.tile(RECTIFIED[0, :3, :3], (len(y_m), 1, 1)), [[1.7, y, 1.5] for y in y_m])


# KITTI's raw drives: a grey and a colour pair, 6 cm apart.
GREY_AND_COLOUR = across(-0.31, -0.85, -0.25, -0.78)


@pytest.mark.parametrize("exchanged", [(0, 1), (2, 3), (0, 3), (1, 2)])
def test_exchanged_cameras_of_several_parallel_ones_are_refused_by_name(exchanged: tuple[int, int]) -> None:
    """That of cameras 1 and 2 turns around nearly all baselines, as the inverse does."""
    simulated = seen_by(GREY_AND_COLOUR, GREY_AND_COLOUR, low_m=(8.0, -12.0))
    check(simulated)
    a, b = exchanged
    with pytest.raises(InputError, match=f"cameras camera{a} and camera{b} look exchanged: if they are") as caught:
        check(with_images_exchanged(simulated, a, b))
    assert caught.value.code == "cameras-exchanged"
    assert f"Exchange the files of camera{a} and camera{b}" in caught.value.remedy


def test_exchanged_cameras_of_a_stereo_pair_are_named_beside_the_inverse() -> None:
    """Matches of two cameras do not tell one from the other."""
    with pytest.raises(
        InputError, match="its inverse, cam_from_rig, or the images of cameras camera0 and camera1"
    ) as c:
        check(with_images_exchanged(rectified_stereo(RECTIFIED), 0, 1))
    assert "cam_from_rig" in c.value.what
    assert "Exchange the files of camera0 and camera1" in c.value.remedy


def test_exchanged_cameras_of_a_fan_are_named_beside_the_inverse_that_turns_it_around() -> None:
    """In axes of a camera, the inverse of looking left is looking right."""
    rig_from_cam = np.stack([looking(yaw_deg) for yaw_deg in (60.0, 0.0, -60.0)])
    simulated = seen_by(rig_from_cam, rig_from_cam, low_m=(-45.0, -45.0))
    check(simulated)
    with pytest.raises(InputError, match="or the images of cameras camera0 and camera2 look exchanged"):
        check(with_images_exchanged(simulated, 0, 2))


@pytest.mark.parametrize("camera", [0, 1])
@pytest.mark.parametrize("yaw_deg", [-5.0, -2.0, 2.0, 5.0])
def test_parallel_cameras_that_are_turned_apart_are_neither_inverted_nor_exchanged(camera: int, yaw_deg: float) -> None:
    """Far points seem to be behind them, and before them if each had the other one's place."""
    true = RECTIFIED.copy()
    true[camera, :3, :3] = se3.exp_so3(np.radians([0, 0, yaw_deg])) @ true[camera, :3, :3]
    check(seen_by(true, RECTIFIED, low_m=(8.0, -12.0)))


@pytest.mark.parametrize("yaw_deg", [-3.0, -0.3, 0.3, 3.0])
@pytest.mark.parametrize("camera", [0, 3])
def test_one_of_several_parallel_cameras_that_is_turned_is_not_exchanged(camera: int, yaw_deg: float) -> None:
    true = GREY_AND_COLOUR.copy()
    true[camera, :3, :3] = se3.exp_so3(np.radians([0, 0, yaw_deg])) @ true[camera, :3, :3]
    check(seen_by(true, GREY_AND_COLOUR, low_m=(8.0, -12.0)))


@pytest.mark.parametrize("off_deg", [-0.3, -0.1, 0.1, 0.3])
def test_cameras_next_to_one_another_are_not_called_exchanged_by_noise(off_deg: float) -> None:
    near = across(0.03, -0.03)
    given = near.copy()
    given[1, :3, :3] = se3.exp_so3(np.radians([0, 0, off_deg])) @ given[1, :3, :3]
    check(seen_by(near, given, low_m=(15.0, -12.0)))
    check(seen_by(given, near, low_m=(15.0, -12.0)))
