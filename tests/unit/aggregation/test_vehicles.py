"""Drives of one vehicle: what each may expect of its cameras from the others, and cameras that were knocked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from mrasfm_engine.aggregation import vehicles
from mrasfm_engine.aggregation.lenses import Lens, turn_and_length
from mrasfm_engine.aggregation.source import SourceScene
from mrasfm_engine.aggregation.vehicles import Vehicle, corrected, corrections, vehicles_of
from mrasfm_engine.config import BundleAdjustmentConfig
from mrasfm_engine.geometry import se3
from mrasfm_engine.scene.drive import pose_from_matrix
from tests.helpers.small_scenes import drive_along, make_street

CONFIG = BundleAdjustmentConfig()
CAMERAS = 6
SIGMA_GIVEN = np.repeat([np.radians(CONFIG.sigma_rotation_deg), CONFIG.sigma_translation_m], 3)
DEVIATION = np.repeat([np.radians(0.05), 0.004], 3)
WELL, BADLY = np.repeat([np.radians(0.02), 0.002], 3), np.repeat([np.radians(0.6), 0.03], 3)


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> SourceScene:
    folder = tmp_path_factory.mktemp("vehicles") / "base"
    street = make_street(length_m=6.0, points=150)
    return drive_along(street, folder, np.arange(0.0, 6.0, 2.0), cameras=CAMERAS).source


@dataclass(frozen=True, kw_only=True)
class Truth:
    given: np.ndarray  # (c, 4, 4)
    common: np.ndarray  # (c, 6) from given
    own: np.ndarray  # (drives, c, 6) from given


def true_vehicle(base: SourceScene, drives: int, rng: np.random.Generator) -> Truth:
    """The truth as drives of the vehicle can see it: cameras have no common motion."""
    common = 0.5 * SIGMA_GIVEN * rng.normal(size=(CAMERAS, 6))
    own = common + DEVIATION * rng.normal(size=(drives, CAMERAS, 6))
    own -= own.mean(1, keepdims=True)
    return Truth(given=base.drive.rig_from_cam, common=common - common.mean(0), own=own)


def seen(
    base: SourceScene,
    name: str,
    truth: Truth,
    k: int,
    sigma: np.ndarray,
    rng: np.random.Generator,
    *,
    vehicle: str | None = "van-7",
) -> SourceScene:
    """The scene of a drive whose images say so much of each direction (6,); infinite: nothing."""
    with np.errstate(divide="ignore"):
        information = np.broadcast_to(sigma**-2.0, (CAMERAS, 6))
    by_images = truth.own[k] + np.where(information > 0, information, 1.0) ** -0.5 * rng.normal(size=(CAMERAS, 6))
    precision = information + SIGMA_GIVEN**-2.0
    found = np.where(information > 0, information * by_images, 0.0) / precision
    poses, posterior = corrected(truth.given, found), precision**-0.5
    cameras, entries = [], {}
    for c, camera in enumerate(base.drive.cameras):
        cameras.append(camera.model_copy(update={"rig_from_cam": pose_from_matrix(poses[c])}))
        entries[camera.name] = {
            "given": {"rig_from_cam": pose_from_matrix(truth.given[c]).model_dump(), "params": camera.params},
            "sigma": {
                "rotation_deg": np.degrees(posterior[c, :3]).tolist(),
                "translation_m": posterior[c, 3:].tolist(),
            },
            "observed": {
                "rotation": (posterior[c] < 0.5 * SIGMA_GIVEN)[:3].tolist(),
                "translation": (posterior[c] < 0.5 * SIGMA_GIVEN)[3:].tolist(),
            },
        }
    manifest = base.manifest.model_copy(
        update={"vehicle": vehicle, "rig": base.manifest.rig.model_copy(update={"cameras": cameras})}
    )
    return replace(base, name=name, manifest=manifest, calibration={"adjusted": True, "cameras": entries})


def one_vehicle(scenes: Sequence[SourceScene]) -> Vehicle:
    (vehicle,) = vehicles_of(scenes, CONFIG)
    return vehicle


def test_a_drive_that_observes_little_learns_from_one_that_observes_much(base: SourceScene) -> None:
    """Errors of what it expects are as large as said, and a tenth of what its scene found."""
    before, after, whitened = [], [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        truth = true_vehicle(base, 3, rng)
        scenes = [seen(base, str(k), truth, k, s, rng) for k, s in enumerate((WELL, WELL, BADLY))]
        vehicle = one_vehicle(scenes)
        assert [vehicle.expected[k].learns for k in range(3)] == [False, False, True]
        expected = vehicle.expected[2]
        found = corrections(scenes[2].drive.rig_from_cam, truth.given)
        before.append(found - truth.own[2])
        after.append(found + expected.correction[:, :6] - truth.own[2])
        whitened.append(after[-1] / expected.sigma[:, :6])
    for kind, ratio in ((slice(0, 3), 0.25), (slice(3, 6), 0.35)):
        rms = [float(np.sqrt(np.mean(np.array(errors)[..., kind] ** 2))) for errors in (before, after)]
        assert 0.02 * rms[0] < rms[1] < ratio * rms[0]
    assert 0.7 < float(np.sqrt(np.mean(np.array(whitened) ** 2))) < 1.5


def test_the_deviation_of_drives_follows_from_how_they_differ(base: SourceScene) -> None:
    for scale in (0.0, 1.0, 5.0):
        found = []
        for seed in range(8):
            rng = np.random.default_rng(seed)
            truth = true_vehicle(base, 4, rng)
            truth = replace(truth, own=truth.common + scale * (truth.own - truth.common))
            scenes = [seen(base, str(k), truth, k, WELL / 4, rng) for k in range(4)]
            found.append(one_vehicle(scenes))
        for values, true, least in (
            ([v.deviation_rad for v in found], DEVIATION[0], vehicles.LEAST_DEVIATION_RAD),
            ([v.deviation_m for v in found], DEVIATION[3], vehicles.LEAST_DEVIATION_M),
        ):
            if scale:
                assert 0.6 * scale * true < np.median(values) < 1.4 * scale * true
            else:
                assert least <= np.median(values) < 0.4 * true


def test_directions_that_no_drive_observes_stay(base: SourceScene) -> None:
    rng = np.random.default_rng(0)
    truth = true_vehicle(base, 2, rng)
    sigma = WELL.copy()
    sigma[[1, 4]] = np.inf
    vehicle = one_vehicle([seen(base, "a", truth, 0, sigma, rng), seen(base, "b", truth, 1, sigma, rng)])
    for expected in vehicle.expected.values():
        assert np.isinf(expected.sigma[:, [1, 4]]).all()
        assert (expected.correction[:, [1, 4]] == 0).all()
        assert np.isfinite(expected.sigma[:, [0, 2, 3, 5]]).all()


def test_a_common_motion_of_all_cameras_is_no_difference(base: SourceScene) -> None:
    """Manifests with other origins of the rig: images do not show where cameras are on the vehicle."""
    rng = np.random.default_rng(1)
    truth = true_vehicle(base, 2, rng)
    scenes = [seen(base, "a", truth, 0, WELL, rng), seen(base, "b", truth, 1, BADLY, rng)]
    moved = se3.transform(se3.exp_so3(np.radians([0.4, -0.3, 0.5])), [0.01, -0.02, 0.015])
    cameras = [
        camera.model_copy(update={"rig_from_cam": pose_from_matrix(moved @ pose)})
        for camera, pose in zip(scenes[1].drive.cameras, scenes[1].drive.rig_from_cam, strict=True)
    ]
    entries = {
        camera.name: {
            **scenes[1].calibration["cameras"][camera.name],
            "given": {"rig_from_cam": pose_from_matrix(moved @ given).model_dump(), "params": camera.params},
        }
        for camera, given in zip(cameras, truth.given, strict=True)
    }
    manifest = scenes[1].manifest.model_copy(
        update={"rig": scenes[1].manifest.rig.model_copy(update={"cameras": cameras})}
    )
    other = replace(scenes[1], manifest=manifest, calibration={**scenes[1].calibration, "cameras": entries})
    here, there = (one_vehicle([scenes[0], scene]).expected[1] for scene in (scenes[1], other))
    assert 0 < np.abs(there.correction - here.correction)[:, :3].max() < np.radians(0.15)
    assert 0 < np.abs(there.correction - here.correction)[:, 3:6].max() < 0.01


def knocked(scene: SourceScene, camera: int, by_deg: float) -> SourceScene:
    turned = se3.transform(se3.exp_so3(np.radians([0.0, by_deg, 0.0])), np.zeros(3))
    cameras = list(scene.manifest.rig.cameras)
    pose = scene.drive.rig_from_cam[camera]
    pose = se3.transform(turned[:3, :3] @ pose[:3, :3], pose[:3, 3])
    cameras[camera] = cameras[camera].model_copy(update={"rig_from_cam": pose_from_matrix(pose)})
    rig = scene.manifest.rig.model_copy(update={"cameras": cameras})
    return replace(scene, manifest=scene.manifest.model_copy(update={"rig": rig}))


def test_a_knocked_camera_is_named_and_tells_nobody_anything(base: SourceScene) -> None:
    name = base.drive.cameras[3].name
    for seed in range(20):
        rng = np.random.default_rng(seed)
        truth = true_vehicle(base, 4, rng)
        scenes = [seen(base, str(k), truth, k, s, rng) for k, s in enumerate((WELL, WELL, WELL, BADLY))]
        sound = one_vehicle(scenes)
        assert sound.knocked == []
        scenes[1] = knocked(scenes[1], 3, 0.7)
        vehicle = one_vehicle(scenes)
        assert [(one.scenes, one.camera) for one in vehicle.knocked] == [((1,), name)]
        assert vehicle.knocked[0].sigmas > 4
        assert np.isinf(vehicle.expected[1].sigma[3]).all()
        off = vehicle.expected[3].correction[3] - sound.expected[3].correction[3]
        assert np.abs(off[:3]).max() < np.radians(0.2)  # it was 0.7


def test_two_drives_do_not_tell_in_which_a_camera_was_knocked(base: SourceScene) -> None:
    rng = np.random.default_rng(5)
    truth = true_vehicle(base, 2, rng)
    scenes = [seen(base, str(k), truth, k, WELL, rng) for k in range(2)]
    vehicle = one_vehicle([knocked(scenes[0], 3, 0.7), scenes[1]])
    assert [one.scenes for one in vehicle.knocked] == [(0, 1)]
    for expected in vehicle.expected.values():
        assert np.isinf(expected.sigma[3]).all()
        assert np.isfinite(expected.sigma[[0, 1, 2, 4, 5], :6]).all()


def test_vehicles_that_differ_and_drives_without_one_share_nothing(base: SourceScene) -> None:
    rng = np.random.default_rng(6)
    truth = true_vehicle(base, 4, rng)
    names = ("van-7", "van-8", None, None)
    assert vehicles_of([seen(base, str(k), truth, k, WELL, rng, vehicle=v) for k, v in enumerate(names)], CONFIG) == []
    assert vehicles_of([seen(base, name, truth, 0, WELL, rng) for name in ("a", "a#1")], CONFIG) == []


def test_components_of_a_drive_count_once(base: SourceScene) -> None:
    rng = np.random.default_rng(7)
    truth = true_vehicle(base, 2, rng)
    first, other = seen(base, "a", truth, 0, WELL, rng), seen(base, "b", truth, 1, BADLY, rng)
    alone = one_vehicle([first, other])
    twice = one_vehicle([first, replace(first, name="a#1"), other])
    np.testing.assert_array_equal(alone.expected[1].correction, twice.expected[2].correction)
    np.testing.assert_array_equal(alone.expected[1].sigma, twice.expected[2].sigma)
    np.testing.assert_array_equal(twice.expected[0].correction, twice.expected[1].correction)
    assert twice.scenes == [0, 1, 2]


def test_drives_whose_cameras_are_others_in_part(base: SourceScene) -> None:
    rng = np.random.default_rng(8)
    truth = true_vehicle(base, 2, rng)
    first, other = (seen(base, str(k), truth, k, s, rng) for k, s in enumerate((WELL, BADLY)))
    cameras = [
        camera.model_copy(update={"name": "roof"}) if c == 2 else camera
        for c, camera in enumerate(other.manifest.rig.cameras)
    ]
    old = base.drive.cameras[2].name
    entries = {("roof" if name == old else name): entry for name, entry in other.calibration["cameras"].items()}
    manifest = other.manifest.model_copy(update={"rig": other.manifest.rig.model_copy(update={"cameras": cameras})})
    other = replace(other, manifest=manifest, calibration={**other.calibration, "cameras": entries})
    expected = one_vehicle([first, other]).expected[1]
    assert np.isinf(expected.sigma[2]).all()
    assert np.isfinite(expected.sigma[[0, 1, 3, 4, 5], :6]).all()


def with_focal(scene: SourceScene, longer: float, sigma: float | None) -> SourceScene:
    """A scene that found its focal lengths so much longer than given, or held them."""
    cameras, entries = [], {}
    for camera in scene.drive.cameras:
        entry = scene.calibration["cameras"][camera.name]
        fx, fy, *rest = entry["given"]["params"]
        cameras.append(camera.model_copy(update={"params": [fx * (1 + longer), fy * (1 + longer), *rest]}))
        focal = {} if sigma is None else {"focal_px": sigma * fx}
        entries[camera.name] = {
            **entry,
            "sigma": entry["sigma"] | focal,
            "observed": entry["observed"] | {"focal": sigma is not None},
        }
    rig = scene.manifest.rig.model_copy(update={"cameras": cameras})
    calibration = {**scene.calibration, "cameras": entries}
    return replace(scene, manifest=scene.manifest.model_copy(update={"rig": rig}), calibration=calibration)


def test_focal_lengths_are_shared_where_intrinsics_are_asked_for(base: SourceScene) -> None:
    rng = np.random.default_rng(10)
    truth = true_vehicle(base, 2, rng)
    first, other = (seen(base, str(k), truth, k, WELL, rng) for k in range(2))
    scenes = [with_focal(first, 0.004, 0.0002), with_focal(other, 0.0, None)]
    asked = CONFIG.model_copy(update={"refine_focal": True})
    (vehicle,) = vehicles_of(scenes, asked)
    expected = vehicle.expected[1]
    # By its prior the first found a little less than its images say.
    np.testing.assert_allclose(expected.correction[:, 6], np.log(1.004), rtol=0.08)
    assert (expected.sigma[:, 6] > 0.0002).all()
    assert (expected.sigma[:, 6] < 0.001).all()
    assert expected.learns
    assert np.isinf(vehicle.expected[0].sigma[:, 6]).all()
    assert np.isinf(one_vehicle(scenes).expected[1].sigma[:, 6]).all()


@pytest.mark.parametrize("refine_focal", [None, False])
def test_focal_lengths_of_single_cameras_are_shared_by_default(base: SourceScene, refine_focal: bool | None) -> None:
    rng = np.random.default_rng(11)
    truth = true_vehicle(base, 2, rng)
    both = [with_focal(seen(base, str(k), truth, k, WELL, rng), 0.004, 0.0002) for k in range(2)]
    config = CONFIG.model_copy(update={"refine_focal": refine_focal})
    (vehicle,) = vehicles_of([first_camera_of(scene) for scene in both], config)
    known = np.isfinite(vehicle.expected[1].sigma[:, 6])
    assert known.all() if refine_focal is None else not known.any()


def test_focal_lengths_that_manifests_declare_uncertain_are_shared_by_default(base: SourceScene) -> None:
    rng = np.random.default_rng(12)
    truth = true_vehicle(base, 2, rng)
    both = [with_focal(seen(base, str(k), truth, k, WELL, rng), 0.004, 0.0002) for k in range(2)]
    (vehicle,) = vehicles_of([with_declared_focal(scene) for scene in both], CONFIG)
    assert np.isfinite(vehicle.expected[1].sigma[:, 6]).tolist() == [True, *[False] * (len(base.drive.cameras) - 1)]


def test_drives_that_estimate_lenses_agree_with_those_that_hold_them(base: SourceScene) -> None:
    """What a principal point takes up of a camera's turn is no turn of the camera."""
    rng = np.random.default_rng(13)
    truth = true_vehicle(base, 5, rng)
    scenes = [seen(base, str(k), truth, k, WELL, rng) for k in range(5)]
    lenses = [with_estimated_lens(scene, 0.015) for scene in scenes[:4]]
    as_given, estimated = one_vehicle(scenes), one_vehicle([*lenses, scenes[4]])
    assert estimated.knocked == as_given.knocked == []
    assert estimated.deviation_rad < 1.2 * as_given.deviation_rad
    off = estimated.expected[4].correction - as_given.expected[4].correction
    np.testing.assert_allclose(off[:, :3], 0.0, atol=np.radians(0.03))


def with_estimated_lens(scene: SourceScene, share: float) -> SourceScene:
    """The scene with principal points that share of the focal length to the right or left, and cameras turned as well.

    Images show next to nothing of it. Every other camera turns the other way: they have no common motion.
    """
    cameras, entries = [], {}
    for number, camera in enumerate(scene.drive.cameras):
        fx, fy, cx, cy = camera.params
        params = [fx, fy, cx + share * fx * (-1) ** number, cy, 0.0, 0.0, 0.0, 0.0]
        lens = camera.model_copy(update={"model": "OPENCV", "params": params})
        turn = turn_and_length(Lens.from_camera(lens), Lens.from_camera(camera))[:3]
        pose = scene.drive.rig_from_cam[number].copy()
        pose[:3, :3] = pose[:3, :3] @ se3.exp_so3(-turn)
        cameras.append(lens.model_copy(update={"rig_from_cam": pose_from_matrix(pose)}))
        entry = scene.calibration["cameras"][camera.name]
        given = {**entry["given"], "params": [*camera.params, 0.0, 0.0, 0.0, 0.0]}
        entries[camera.name] = {**entry, "given": given}
    rig = scene.manifest.rig.model_copy(update={"cameras": cameras})
    calibration = {**scene.calibration, "cameras": entries}
    return replace(scene, manifest=scene.manifest.model_copy(update={"rig": rig}), calibration=calibration)


def with_declared_focal(scene: SourceScene) -> SourceScene:
    """Of the first camera."""
    first, *others = scene.manifest.rig.cameras
    cameras = [first.model_copy(update={"sigma_focal_px": 0.01 * first.params[0]}), *others]
    rig = scene.manifest.rig.model_copy(update={"cameras": cameras})
    return replace(scene, manifest=scene.manifest.model_copy(update={"rig": rig}))


def first_camera_of(scene: SourceScene) -> SourceScene:
    cameras = scene.manifest.rig.cameras[:1]
    manifest = scene.manifest.model_copy(update={"rig": scene.manifest.rig.model_copy(update={"cameras": cameras})})
    entries = {camera.name: scene.calibration["cameras"][camera.name] for camera in cameras}
    return replace(scene, manifest=manifest, calibration={**scene.calibration, "cameras": entries})


def test_no_false_alarms(base: SourceScene) -> None:
    """Of 60 vehicles of three sound drives, a camera in a thousand may be beyond four sigmas."""
    found = 0
    for seed in range(100, 160):
        rng = np.random.default_rng(seed)
        truth = true_vehicle(base, 3, rng)
        scenes = [seen(base, str(k), truth, k, WELL, rng) for k in range(3)]
        found += len(one_vehicle(scenes).knocked)
    assert found <= 3


def test_corrections_are_undone(base: SourceScene) -> None:
    rng = np.random.default_rng(9)
    step = SIGMA_GIVEN * rng.normal(size=(CAMERAS, 6))
    np.testing.assert_allclose(corrections(corrected(base.drive.rig_from_cam, step), base.drive.rig_from_cam), step)
