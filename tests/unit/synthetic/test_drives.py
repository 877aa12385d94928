"""Whole drives: files, truth, and every difficulty that an option adds."""

import argparse
import json
import math
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mrasfm_engine.commands import synth
from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.preflight.drive_reader import foreign_file
from mrasfm_engine.scene.drive import matrix_from_pose
from mrasfm_engine.synthetic import World, gnss, small_options
from mrasfm_engine.synthetic.calibration import given_cameras
from mrasfm_engine.synthetic.drive_writer import TRUE_OWN_CAR_FOLDER, render_drives
from mrasfm_engine.synthetic.mesh import Label
from mrasfm_engine.synthetic.motion import drive_motion
from mrasfm_engine.synthetic.occluder import place_truck
from mrasfm_engine.synthetic.options import BOUNDS, SpeedProfile, SynthOptions
from mrasfm_engine.synthetic.own_car import UNLABELLED
from mrasfm_engine.synthetic.rigs import TrueCamera, mounts, true_cameras
from mrasfm_engine.synthetic.streets import lay_out
from schemas import DriveManifest, Pose, SemanticClass
from schemas.file_names import UPLOAD_RECORD_NAME
from tests.helpers.painted_once import textures_painted_once
from tests.helpers.slow import slow

TINY = {"units": 2, "width": 320, "height": 180, "texture_px": 128}


def load(folder: Path) -> DriveManifest:
    return DriveManifest.model_validate_json((folder / "drive.json").read_text())


def poses_of(options: SynthOptions, drive: int = 0) -> np.ndarray:
    layout = lay_out(options, np.random.default_rng([options.seed, 0]))
    motion = drive_motion(options, layout, drive, np.random.default_rng([options.seed, 2, drive, 0]))
    return motion.world_from_rig(np.arange(options.units) / 10)


def cameras_of(count: int = 6) -> list[TrueCamera]:
    return true_cameras(count, width=320, height=180, rng=np.random.default_rng(0))


@pytest.fixture
def painted_once() -> Iterator[None]:
    with textures_painted_once():
        yield


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small drive with a time skew."""
    out = tmp_path_factory.mktemp("synth") / "drive"
    assert render_drives(small_options(units=3, time_skew_ms=40.0), out) == [out]
    return out


def test_manifest_is_valid_and_complete(drive: Path) -> None:
    manifest = load(drive)
    assert len(manifest.frames) == 3
    assert manifest.label_map is not None
    for frame in manifest.frames:
        for image in frame.images.values():
            picture = cv2.imread(str(drive / image.file))
            mask = cv2.imread(str(drive / str(image.mask)), cv2.IMREAD_UNCHANGED)
            assert picture.shape == (270, 480, 3)
            assert mask.shape == (270, 480)
            assert set(np.unique(mask).tolist()) <= manifest.label_map.ids.keys()
            assert (mask == Label.ROAD).mean() > 0.1
            assert picture.std() > 20
    assert manifest.label_map.ids[int(Label.CAR)] is SemanticClass.DYNAMIC


def test_truth_agrees_with_itself(drive: Path) -> None:
    """Images are taken at their own instants: their poses differ from the unit's by the way driven meanwhile."""
    manifest = load(drive)
    truth = np.loadtxt(drive / "truth.tum")
    images = json.loads((drive / "truth_cameras.json").read_text())
    calibration = json.loads((drive / "truth_calibration.json").read_text())
    offsets = []
    for u, frame in enumerate(manifest.frames):
        assert truth[u, 0] == pytest.approx(frame.timestamp_us / 1e6, abs=2e-6)
        world_from_rig = se3.transform(se3.rotation_from_quaternion(truth[u, 4:]), truth[u, 1:4])
        for name, image in frame.images.items():
            assert image.timestamp_us == images[image.file]["timestamp_us"]
            world_from_cam = matrix_from_pose(Pose(**images[image.file]["world_from_cam"]))
            rig = world_from_cam @ se3.inverse(matrix_from_pose(Pose(**calibration[name])))
            later_s = (images[image.file]["timestamp_us"] - frame.timestamp_us) / 1e6
            ahead_m = (se3.inverse(world_from_rig) @ rig)[0, 3]
            assert ahead_m == pytest.approx(11.0 * later_s, abs=0.04)
            offsets.append(later_s)
    assert np.ptp(offsets) == pytest.approx(0.040, abs=1e-6)
    given = {camera.name: matrix_from_pose(camera.rig_from_cam) for camera in manifest.rig.cameras}
    for name, pose in calibration.items():
        np.testing.assert_allclose(given[name], matrix_from_pose(Pose(**pose)), atol=1e-12)


def test_a_turn_is_a_quarter_of_a_circle_and_smooth() -> None:
    options = SynthOptions(world=World.TURN, units=40, speed_profile=SpeedProfile.VARYING)
    poses = poses_of(options)
    yaw = np.degrees(np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0])))
    assert 40 < yaw[-1] - yaw[0] < 100
    rate = np.diff(yaw) * 10
    assert 30 < rate.max() < 110
    assert np.abs(np.diff(rate)).max() * 10 < 250  # deg/s^2
    speed = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) * 10
    assert 2.5 < speed.min() < 5
    assert 9 < speed.max() < 15  # the outer lane is longer than the street


@pytest.mark.slow
def test_rows_of_a_rolling_shutter_are_rendered_at_their_own_times(tmp_path: Path) -> None:
    same = {"cameras": 1, "moving_cars": 0, "noise": 0.0, "blur_px": 0.0, "spacing_m": 1.5}
    rolling, still = (
        render_drives(small_options(**TINY, **same, readout_ms=ms), tmp_path / f"{ms}")[0] for ms in (90.0, 0.0)
    )
    assert load(rolling).rig.cameras[0].readout_us == 90_000
    assert load(still).rig.cameras[0].readout_us is None
    name = load(still).rig.cameras[0].name
    a, b = (cv2.imread(str(d / "images" / name / "000001.jpg")).astype(float) for d in (rolling, still))
    assert a.shape == b.shape
    rows = np.abs(a - b).mean((1, 2))
    third = len(rows) // 10
    middle, outside = rows[len(rows) // 2 - third // 2 :][:third].mean(), rows[-third:].mean()
    assert middle < 0.5 * outside  # the middle row is at the image's timestamp
    assert outside > 5


def test_images_obey_the_true_epipolar_geometry(drive: Path) -> None:
    manifest = load(drive)
    images = json.loads((drive / "truth_cameras.json").read_text())
    fx, fy, cx, cy = manifest.rig.cameras[0].params
    k = np.linalg.inv([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    files = [f"images/left/{u:06d}.jpg" for u in (0, 1)]
    a_from, b_from = (matrix_from_pose(Pose(**images[file]["world_from_cam"])) for file in files)
    found = []
    for file in files:
        keypoints, descriptors = cv2.SIFT.create().detectAndCompute(cv2.imread(str(drive / file), 0), None)
        mask = cv2.imread(str(drive / file.replace("images", "masks").replace("jpg", "png")), 0)
        # SIFT puts the centre of the top left pixel at (0, 0).
        xy = np.array([keypoint.pt for keypoint in keypoints]) + 0.5
        static = ~np.isin(mask[xy[:, 1].astype(int), xy[:, 0].astype(int)], (Label.CAR, Label.SKY))
        found.append((xy[static], descriptors[static]))
    matches = cv2.BFMatcher(crossCheck=False).knnMatch(found[0][1], found[1][1], k=2)
    pairs = np.array([(m.queryIdx, m.trainIdx) for m, n in matches if m.distance < 0.75 * n.distance])
    b_from_a = se3.inverse(b_from) @ a_from
    f = k.T @ se3.skew(b_from_a[:3, 3]) @ b_from_a[:3, :3] @ k
    ha, hb = (np.concatenate([found[i][0][pairs[:, i]], np.ones((len(pairs), 1))], 1) for i in (0, 1))
    line = ha @ f.T
    distance = np.abs((hb * line).sum(1)) / np.hypot(line[:, 0], line[:, 1])
    assert len(pairs) > 150
    assert 0 < np.median(distance) < 0.3
    # Half a pixel of wrong convention would show: shifted rows make it worse.
    off = (hb + np.array([0.0, 0.7, 0.0])) * line
    assert np.median(np.abs(off.sum(1)) / np.hypot(line[:, 0], line[:, 1])) > 1.3 * np.median(distance)


@pytest.mark.slow
def test_same_seed_same_files_other_seed_others(tmp_path: Path) -> None:
    options = small_options(**TINY, cameras=1)
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        render_drives(replace(options, seed=seed), tmp_path / name)
    for file in ("drive.json", "truth.tum", "images/front/000001.jpg", "masks/front/000001.png"):
        a, b, c = ((tmp_path / name / file).read_bytes() for name in "abc")
        assert a == b
        assert a != c


@pytest.mark.usefixtures("painted_once")
def test_nothing_is_overwritten_without_force(drive: Path, tmp_path: Path) -> None:
    out = tmp_path / "drive"
    out.mkdir()
    (out / "precious.txt").write_text("x")
    options = small_options(**TINY, cameras=1, masks=False)
    with pytest.raises(InputError, match="not an empty folder"):
        render_drives(options, out)
    with pytest.raises(InputError, match=r"precious.txt is no file of a rendered drive"):
        render_drives(options, out, force=True)
    shutil.copytree(drive, out, dirs_exist_ok=True)
    with pytest.raises(InputError, match="not an empty folder"):
        render_drives(options, out)
    (out / "precious.txt").unlink()
    (out / UPLOAD_RECORD_NAME).write_text("{}")  # the drive was uploaded
    assert (out / "masks").is_dir()
    render_drives(options, out, force=True)
    assert not (out / "masks").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["drive"]


@pytest.mark.parametrize("name", ["images/holiday.jpg", "masks/0.png", "truth.tum"])
def test_force_spares_a_folder_that_is_no_drive(tmp_path: Path, name: str) -> None:
    """Its files have names that those of a drive have, too."""
    own = tmp_path / "own" / name
    own.parent.mkdir(parents=True)
    own.touch()
    with pytest.raises(InputError, match=f"own/{name.partition('/')[0]} is no file of a rendered drive"):
        render_drives(small_options(**TINY, cameras=1, masks=False), tmp_path / "own", force=True)
    assert own.is_file()


@pytest.mark.usefixtures("painted_once")
def test_force_spares_what_lies_among_several_drives(tmp_path: Path) -> None:
    out = tmp_path / "drives"
    options = small_options(**TINY, cameras=1, masks=False, drives=2)
    render_drives(options, out)
    render_drives(options, out, force=True)
    for scene in (out / "scene", out / "drive_1" / "scene"):
        scene.mkdir()
        with pytest.raises(InputError, match=f"{scene} is no file of a rendered drive"):
            render_drives(options, out, force=True)
        scene.rmdir()
    assert (out / "drive_1" / "drive.json").is_file()


@pytest.mark.usefixtures("painted_once")
def test_failure_leaves_nothing_behind(tmp_path: Path) -> None:
    def fail(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_drives(small_options(**TINY, cameras=1), tmp_path / "drive", progress=fail)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("painted_once")
def test_difficulties_show_in_the_manifest(tmp_path: Path) -> None:
    out = tmp_path / "drive"
    render_drives(
        small_options(
            **{**TINY, "units": 8},
            cameras=2,
            occluded_cameras=("left",),
            drop_images=0.3,
            gnss=False,
            rough_poses=True,
            camera_model="OPENCV",
        ),
        out,
    )
    manifest = load(out)
    count = sum(len(frame.images) for frame in manifest.frames)
    assert 6 <= count <= 15
    assert manifest.gnss is None
    assert manifest.rough_poses is not None
    assert manifest.rig.cameras[0].model == "OPENCV"
    hidden = {}
    for path in (out / "masks" / "left").iterdir():
        hidden[int(path.stem)] = (cv2.imread(str(path), 0) == Label.TRUCK).mean()
    assert all(0.8 < share < 0.98 for unit, share in hidden.items() if 2 <= unit < 6)
    assert all(share == 0 for unit, share in hidden.items() if not 2 <= unit < 6)


@pytest.mark.parametrize("name", ["front", *slow(*(mount.name for mount in mounts(6) if mount.name != "front"))])
def test_lorry_covers_any_camera_and_touches_none(name: str) -> None:
    rig = cameras_of()
    pose = place_truck(next(camera for camera in rig if camera.name == name), rig)
    for camera in rig:
        away = np.abs(camera.rig_from_cam[:2, 3] - pose[:2, 3]) - [8.5 / 2, 2.4 / 2]
        assert away.max() > 0.4


def test_gnss_errors_are_as_declared() -> None:
    options = small_options(units=4000, gnss_bias_m=0.0, gnss_drift_m=0.0, gnss_noise_m=0.5)
    poses = np.tile(poses_of(small_options(units=1)), (4000, 1, 1))
    stamps = np.arange(4000, dtype=np.int64) * 100_000
    received = gnss.receive(options, poses, stamps, np.random.default_rng(0))
    truth = gnss.Origin().geodetic(gnss.antenna_positions(poses))
    metres = np.array([111_200.0, 74_400.0, 1.0])
    error = (np.array([[s.latitude_deg, s.longitude_deg, s.height_m] for s in received.samples]) - truth) * metres
    assert error.std(0) == pytest.approx([0.5, 0.5, 0.75], rel=0.05)
    assert np.abs(error.mean(0)).max() < 0.06
    assert received.samples[0].sigma_horizontal_m == pytest.approx(0.5)
    # The antenna is not the rig's origin.
    lever = gnss.antenna_positions(poses)[0] - poses[0, :3, 3]
    assert np.linalg.norm(lever) == pytest.approx(np.linalg.norm(received.antenna_in_rig_m), rel=1e-9)


def test_gnss_outliers_and_clock() -> None:
    options = small_options(units=2000, gnss_outliers=0.1, gnss_offset_s=18.0)
    poses = np.tile(np.eye(4), (2000, 1, 1))
    stamps = np.arange(2000, dtype=np.int64) * 100_000
    received = gnss.receive(options, poses, stamps, np.random.default_rng(0))
    north = np.array([s.latitude_deg - 48.137 for s in received.samples]) * 111_200
    east = np.array([s.longitude_deg - 11.575 for s in received.samples]) * 74_400
    assert 0.05 < (np.hypot(north, east) > 3.5).mean() < 0.12
    assert received.samples[0].timestamp_us == 18_000_000


def test_origin_agrees_with_a_first_order_earth() -> None:
    place = gnss.Origin().geodetic(np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 0.0, 9.0]]))
    np.testing.assert_allclose(place[0], [48.137, 11.575, 567.0], atol=1e-9)
    assert (place[1, 1] - 11.575) * 74_400 == pytest.approx(100, rel=0.01)
    assert (place[2, 0] - 48.137) * 111_200 == pytest.approx(100, rel=0.01)
    assert place[3, 2] == pytest.approx(576.0, abs=1e-6)


def test_calibration_is_off_by_the_asked_norms() -> None:
    rig = cameras_of()
    options = SynthOptions(
        perturb_rotation_deg=0.8,
        perturb_translation_m=0.05,
        declare_sigmas=True,
        miscalibrated_camera="back",
        miscalibrated_by_deg=3.0,
    )
    given = given_cameras(options, rig, np.random.default_rng(0))
    for true, camera in zip(rig, given, strict=True):
        error = se3.inverse(true.rig_from_cam) @ matrix_from_pose(camera.rig_from_cam)
        angle = se3.rotation_angle_deg(error[:3, :3])
        assert np.linalg.norm(error[:3, 3]) == pytest.approx(0.05)
        if camera.name == "back":
            assert 2.2 <= angle <= 3.8
        else:
            assert angle == pytest.approx(0.8)
        assert camera.sigma_rotation_deg == pytest.approx(0.8 / np.sqrt(3))
    tight = given_cameras(SynthOptions(tight=True), rig, np.random.default_rng(0))
    assert {camera.sigma_translation_m for camera in tight} == {0.001}


def test_default_street_turns_and_a_straight_one_does_not() -> None:
    for straight, low, high in ((False, 20.0, 70.0), (True, 1.0, 12.0)):
        poses = poses_of(SynthOptions(straight=straight))
        heading = np.degrees(np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0])))
        assert low < np.ptp(heading) < high
        steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        assert 0.9 < steps.min() < steps.max() < 1.4
        # A car goes where it looks.
        step = np.diff(poses[:, :3, 3], axis=0)
        assert np.degrees(np.abs(np.arctan2(step[:, 1], step[:, 0]) - np.radians(heading[:-1])).max()) < 3


def test_speed_standing_and_ramp() -> None:
    poses = poses_of(SynthOptions(units=60, speed_profile=SpeedProfile.VARYING))
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert 0.25 < steps.min() < 0.5 < 1.0 < steps.max() < 1.35
    still = poses_of(SynthOptions(units=40, standing_units=8))
    assert (np.linalg.norm(np.diff(still[:, :3, 3], axis=0), axis=1) < 1e-9).sum() == 7
    hill = poses_of(SynthOptions(units=60, ramp_percent=6.0, straight=True))
    slope = np.diff(hill[:, 2, 3]) / np.linalg.norm(np.diff(hill[:, :2, 3], axis=0), axis=1)
    assert 0.05 < slope.max() < 0.075
    assert np.degrees(np.arcsin(hill[:, 2, 0])).max() == pytest.approx(np.degrees(np.arctan(0.06)), abs=0.6)


def test_loop_comes_back_and_crossing_drives_meet() -> None:
    loop = poses_of(SynthOptions(world=World.LOOP, units=130))
    assert np.linalg.norm(loop[0, :3, 3] - loop[:, :3, 3], axis=1)[100:].min() < 1.0
    heading = np.unwrap(np.arctan2(loop[:, 1, 0], loop[:, 0, 0]))
    assert np.degrees(heading[-1] - heading[0]) == pytest.approx(360, abs=25)
    crossing = SynthOptions(world=World.CROSSING, drives=7)
    drives = [poses_of(crossing, k) for k in range(7)]
    forward = [d[0, :2, 0] for d in drives]
    assert forward[0] @ forward[1] > 0.9
    assert forward[0] @ forward[2] < -0.5
    assert abs(drives[0][20, :2, 0] @ forward[3]) < 0.5
    nearest = [np.linalg.norm(drives[0][:, None, :3, 3] - d[None, :, :3, 3], axis=-1).min() for d in drives]
    assert max(nearest[:6]) < 8
    assert nearest[6] > 200


@pytest.mark.slow
def test_several_drives_share_one_world(tmp_path: Path) -> None:
    folders = render_drives(small_options(**TINY, cameras=1, drives=2, world=World.REPEATED), tmp_path / "out")
    assert [folder.name for folder in folders] == ["drive_0", "drive_1"]
    first, second = (load(folder) for folder in folders)
    assert second.frames[0].timestamp_us - first.frames[0].timestamp_us == 3_600_000_000
    apart = np.loadtxt(folders[0] / "truth.tum")[0, 1:4] - np.loadtxt(folders[1] / "truth.tum")[0, 1:4]
    assert 50 < np.linalg.norm(apart) < 70


@pytest.mark.parametrize(
    "changes",
    [
        {"cameras": 9},
        {"units": 0},
        {"drop_images": 1.5},
        {"time_skew_ms": 100.0},
        {"occluded_cameras": ("nowhere",)},
        {"miscalibrated_camera": "nowhere"},
        {"world": World.LOOP, "units": 40},
        {"tight": True, "perturb_rotation_deg": 1.0},
        {"standing_units": 30},
        {"gnss_noise_m": -1.0},
        {"gnss_noise_m": math.nan},
        {"ramp_percent": math.nan},
        {"dusk_drive": 1},
    ],
)
def test_nonsense_is_refused_with_a_remedy(changes: dict[str, object]) -> None:
    with pytest.raises(InputError) as caught:
        SynthOptions(**changes)
    assert caught.value.remedy


@pytest.mark.parametrize(("name", "flag"), [("standing_units", "--standing"), ("shadow_strength", "--shadows")])
def test_what_is_refused_is_named_as_the_command_has_it(name: str, flag: str) -> None:
    with pytest.raises(InputError, match=f"^{flag} -1 "):
        SynthOptions(**{name: -1})


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("perturb_translation_m", 1e9, "--perturb-translation-m 1000000000.0 is no possible amount"),
        ("gnss_bias_m", 1e5, "--gnss-bias-m 100000.0 is no possible amount"),
        ("gnss_offset_s", float("nan"), "--gnss-offset-s nan is no possible amount"),
        ("gnss_offset_s", 1e12, "--gnss-offset-s 1000000000000.0 is no possible amount"),
        ("blur_px", 1e9, "--blur-px 1000000000.0 is no possible amount"),
        ("jpeg_quality", 101, "--jpeg-quality 101 is no possible amount"),
        ("parked_cars", -1, "--parked-cars -1 is no amount"),
        ("drop_images", 1.5, "--drop-images 1.5 is not a fraction"),
    ],
)
def test_amounts_that_no_drive_has_are_refused(option: str, value: float, message: str) -> None:
    with pytest.raises(InputError, match=message):
        small_options(**{option: value})


@pytest.mark.usefixtures("painted_once")
def test_the_largest_amounts_make_drives(tmp_path: Path) -> None:
    """Manifests bound positions and the rig, and refuse what is beyond."""
    amounts = {name: highest for name, (_, highest) in BOUNDS.items()}
    for seed in range(3):
        options = small_options(**TINY, **amounts, seed=seed, rough_poses=True, biased_drive=0, declare_sigmas=True)
        render_drives(options, tmp_path / "drive", force=True)
        assert len(load(tmp_path / "drive").frames) == 2


def test_command_line_reaches_the_options() -> None:
    parser = argparse.ArgumentParser()
    synth.register(parser.add_subparsers())
    plain = synth.options_from(parser.parse_args(["synth", "--out", "x"]))
    assert plain == SynthOptions()
    words = "synth --out x --world crossing --drives 3 --occlude front,back --no-gnss --ramp 6 --speed-profile varying"
    options = synth.options_from(parser.parse_args(words.split()))
    assert options.world is World.CROSSING
    assert options.occluded_cameras == ("front", "back")
    assert not options.gnss
    assert options.ramp_percent == 6.0


@pytest.mark.slow
def test_own_car(tmp_path: Path) -> None:
    """The front camera sees the bonnet, the back camera the boot lid; only there images change."""
    options = SynthOptions(cameras=4, **TINY)
    plain, own = tmp_path / "plain", tmp_path / "own"
    render_drives(options, plain)
    render_drives(replace(options, own_car=True, moving_masks=True), own)
    assert foreign_file(own) is None, "an archive of it is taken, and --force replaces it"
    assert not (plain / TRUE_OWN_CAR_FOLDER).exists()
    assert {path.name for path in (own / TRUE_OWN_CAR_FOLDER).iterdir()} == {"front.png", "back.png"}
    for camera in ("front", "back"):
        mask = cv2.imread(str(own / TRUE_OWN_CAR_FOLDER / f"{camera}.png"), cv2.IMREAD_UNCHANGED) == 255
        assert 0.05 < mask.mean() < 0.3
        assert mask[-1].any()
        assert not mask[: mask.shape[0] // 2].any()
        labels = cv2.imread(str(own / f"masks/{camera}/000000.png"), cv2.IMREAD_UNCHANGED)
        assert (labels[mask] == UNLABELLED).all()
        before, after = (cv2.imread(str(folder / f"images/{camera}/000000.jpg")).astype(int) for folder in (plain, own))
        away = ~cv2.dilate(mask.astype(np.uint8), np.ones((17, 17), np.uint8)).astype(bool)
        assert np.abs(after - before)[away].max() <= 20  # the paint's border touches neighbouring blocks of the JPEG
        later = cv2.imread(str(own / f"images/{camera}/000001.jpg")).astype(int)
        assert 1 < np.abs(later - after)[mask].mean() < 60  # what the paint mirrors changes
    assert (own / "images/left/000000.jpg").read_bytes() == (plain / "images/left/000000.jpg").read_bytes()
