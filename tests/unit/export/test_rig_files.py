"""A vehicle's cameras as Kalibr, ROS and URDF have them."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mrasfm_engine.export import rig_files, rig_files_readback
from mrasfm_engine.export.rig_files import RigCamera, rig_cameras, roll_pitch_yaw
from mrasfm_engine.export.rig_files_readback import parsed_yaml
from mrasfm_engine.export.scene import write_scene
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_camera, project_points
from mrasfm_engine.scene.drive import Drive, pose_from_matrix
from mrasfm_engine.scene.scene import CameraCalibration, Scene
from schemas import Camera, Rig
from tests.helpers.export_example import FOREIGN_MODEL, assert_withheld, make_scene, withheld_files

WIDTH, HEIGHT = 960, 600
PARAMS = {
    "SIMPLE_PINHOLE": [805.5, 481.25, 300.5],
    "PINHOLE": [805.5, 811.0, 481.25, 300.5],
    "SIMPLE_RADIAL": [805.5, 481.25, 300.5, -0.05],
    "RADIAL": [805.5, 481.25, 300.5, -0.05, 1e-05],
    "OPENCV": [805.5, 811.0, 481.25, 300.5, -0.05, 0.01, 1e-3, -5e-4],
    "OPENCV_FISHEYE": [405.5, 411.0, 481.25, 300.5, -0.03, 0.004, 2e-3, -1e-4],
}
RATIONAL = [805.5, 811.0, 481.25, 300.5, -0.05, 0.01, 1e-3, -5e-4, 2e-3, 0.01, -0.02, 1e-3]
WITH_K3 = [*RATIONAL[:9], 0.0, 0.0, 0.0]
OMNIDIRECTIONAL = [1405.5, 1411.0, 481.25, 300.5, 0.01, 0.5, 1e-3, -5e-4, 1.1]


def surround(models: dict[str, list[float]] = PARAMS, *, prefix: str = "") -> Scene:
    """The example with a camera of each model, which look all around."""
    rng, scene, cameras, calibration = np.random.default_rng(4), make_scene(), [], []
    for k, (model, params) in enumerate(models.items()):
        rig_from_cam = se3.transform(se3.exp_so3(rng.normal(0, 1.5, 3)), rng.normal(0, 2, 3))
        camera = Camera(
            name=f"{prefix}{k}.{model}".replace("/", "_"),
            model=model,
            width=WIDTH,
            height=HEIGHT,
            params=params,
            rig_from_cam=pose_from_matrix(rig_from_cam),
        )
        cameras.append(camera.model_copy(update={"name": f"{prefix}{k}.{model}"}))
        calibration.append(replace(scene.calibration[0], rig_from_cam=rig_from_cam, params=np.array(params)))
    manifest = scene.drive.manifest.model_copy(update={"rig": Rig.model_construct(cameras=cameras)})
    return replace(scene, drive=Drive(Path("nowhere"), manifest), calibration=calibration)


def own_pixels(camera: Camera, refined: CameraCalibration, points: np.ndarray) -> np.ndarray:
    return project_points(*pack_camera(camera.model, refined.params), points)


def opencv_pixels(
    intrinsics: list[float], is_fisheye: bool, coefficients: list[float], points: np.ndarray
) -> np.ndarray:
    """Pixels whose first has its centre at (0, 0), as ROS and Kalibr compute them."""
    matrix = np.array([[intrinsics[0], 0, intrinsics[2]], [0, intrinsics[1], intrinsics[3]], [0, 0, 1]])
    project = cv2.fisheye.projectPoints if is_fisheye else cv2.projectPoints
    pixels, _ = project(points[:, None], np.zeros(3), np.zeros(3), matrix, np.array(coefficients))
    return pixels[:, 0]


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    return np.random.default_rng(0).uniform([-4, -3, 8], [4, 3, 15], (50, 3))


@pytest.mark.parametrize("k", range(len(PARAMS)))
def test_every_model_projects_as_ours_half_a_pixel_away(points: np.ndarray, k: int) -> None:
    scene = surround()
    camera = rig_cameras(scene)[k]
    expected = own_pixels(scene.drive.cameras[k], scene.calibration[k], points) - 0.5
    info = parsed_yaml(rig_files.camera_info_text(camera))
    chain = parsed_yaml(rig_files.camchain_text([camera]))["cam0"]
    values = np.array(info["camera_matrix"]["data"]).reshape(3, 3)
    of_ros = [values[0, 0], values[1, 1], values[0, 2], values[1, 2]]
    for intrinsics, model, coefficients in (
        (of_ros, info["distortion_model"], info["distortion_coefficients"]["data"]),
        (chain["intrinsics"], chain["distortion_model"], chain["distortion_coeffs"]),
    ):
        is_fisheye = scene.drive.cameras[k].model == "OPENCV_FISHEYE"
        assert (model == "equidistant") == is_fisheye
        assert len(coefficients) == (4 if is_fisheye or model == "radtan" else 5)
        found = opencv_pixels(intrinsics, is_fisheye, coefficients, points)
        np.testing.assert_allclose(found, expected, atol=1e-6)
    assert np.ptp(expected[:, 0]) > 100


@pytest.mark.parametrize(
    ("params", "model", "count"), [(RATIONAL, "rational_polynomial", 8), (WITH_K3, "plumb_bob", 5)]
)
def test_higher_coefficients_are_for_ros_only(
    points: np.ndarray, params: list[float], model: str, count: int, tmp_path: Path
) -> None:
    scene = surround({"FULL_OPENCV": params, "PINHOLE": PARAMS["PINHOLE"]})
    cameras = rig_cameras(scene)
    info = parsed_yaml(rig_files.camera_info_text(cameras[0]))
    coefficients = info["distortion_coefficients"]["data"]
    assert (info["distortion_model"], len(coefficients)) == (model, count)
    found = opencv_pixels(cameras[0].intrinsics, False, coefficients, points)
    expected = own_pixels(scene.drive.cameras[0], scene.calibration[0], points) - 0.5
    np.testing.assert_allclose(found, expected, atol=1e-6)
    notes = rig_files.write_rig(cameras, tmp_path / "rig")
    assert notes == ["camchain.yaml lacks 0.FULL_OPENCV: Kalibr has no model for it"]
    text = (tmp_path / "rig" / "camchain.yaml").read_text()
    assert [camera["rostopic"] for camera in parsed_yaml(text).values()] == ["/1.PINHOLE/image_raw"]
    assert all(row.agrees for row in rig_files_readback.camchain(scene, "", text))


def test_a_full_model_without_higher_coefficients_is_for_all(tmp_path: Path) -> None:
    scene = surround({"FULL_OPENCV": [*RATIONAL[:8], 0.0, 0.0, 0.0, 0.0]})
    assert rig_files.write_rig(rig_cameras(scene), tmp_path / "rig") == []
    assert parsed_yaml((tmp_path / "rig" / "camchain.yaml").read_text())["cam0"]["distortion_coeffs"] == RATIONAL[4:8]


def test_an_omnidirectional_camera_is_for_kalibr_only(points: np.ndarray, tmp_path: Path) -> None:
    scene = surround({"MEI": OMNIDIRECTIONAL})
    notes = rig_files.write_rig(rig_cameras(scene), tmp_path / "rig")
    assert notes == ["camera_info lacks 0.MEI: ROS has no model for it"]
    assert {path.name for path in (tmp_path / "rig").iterdir()} == {"camchain.yaml", "rig.urdf"}
    text = (tmp_path / "rig" / "camchain.yaml").read_text()
    camera = parsed_yaml(text)["cam0"]
    assert (camera["camera_model"], camera["distortion_model"]) == ("omni", "radtan")
    xi, *intrinsics = camera["intrinsics"]
    on_sphere = points / np.linalg.norm(points, axis=1, keepdims=True) + [0.0, 0.0, xi]
    found = opencv_pixels(intrinsics, False, camera["distortion_coeffs"], on_sphere)
    expected = own_pixels(scene.drive.cameras[0], scene.calibration[0], points) - 0.5
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert all(row.agrees for row in rig_files_readback.camchain(scene, "", text))


def test_a_scene_says_which_cameras_a_format_lacks(tmp_path: Path) -> None:
    scene, out = make_scene(models={**FOREIGN_MODEL, "FULL_OPENCV": RATIONAL}), tmp_path / "scene"
    write_scene(scene, out, {})
    notes = json.loads((out / "report.json").read_text())["summary"]["notes"]
    expected = [
        "rig/camchain.yaml lacks right: Kalibr has no model for it",
        "rig/camera_info lacks left: ROS has no model for it",
    ]
    assert [note for note in notes if note.startswith("rig/")] == expected
    files = {path.name for path in (out / "rig").rglob("*.*")}
    assert files == {"camchain.yaml", "right.yaml", "rig.urdf"}


def test_the_chain_composes_to_the_poses_in_the_rig() -> None:
    scene = surround()
    document = parsed_yaml(rig_files.camchain_text(rig_cameras(scene)))
    assert list(document) == [f"cam{k}" for k in range(len(PARAMS))]
    assert "T_cn_cnm1" not in document["cam0"]
    cam_from_first = np.eye(4)
    for camera, refined in zip(document.values(), scene.calibration, strict=True):
        cam_from_first = np.array(camera.get("T_cn_cnm1", np.eye(4))) @ cam_from_first
        rig_from_cam = scene.calibration[0].rig_from_cam @ np.linalg.inv(cam_from_first)
        np.testing.assert_allclose(rig_from_cam, refined.rig_from_cam, atol=1e-9)
    assert document["cam5"]["rostopic"] == "/5.OPENCV_FISHEYE/image_raw"
    assert document["cam5"]["resolution"] == [WIDTH, HEIGHT]


def test_the_description_has_a_frame_for_each_camera() -> None:
    scene = surround()
    root = ElementTree.fromstring(rig_files.description_text(rig_cameras(scene)))
    links = {link.attrib["name"] for link in root.iter("link")}
    assert len(links) == len(PARAMS) + 1
    for joint, camera, refined in zip(root.iter("joint"), scene.drive.cameras, scene.calibration, strict=True):
        assert joint.find("parent").attrib == {"link": "base_link"}
        assert joint.find("child").attrib == {"link": f"{camera.name}_optical_frame"}
        origin = joint.find("origin").attrib
        roll, pitch, yaw = (float(angle) for angle in origin["rpy"].split())
        turned = se3.exp_so3([0, 0, yaw]) @ se3.exp_so3([0, pitch, 0]) @ se3.exp_so3([roll, 0, 0])
        np.testing.assert_allclose(turned, refined.rig_from_cam[:3, :3], atol=1e-9)
        np.testing.assert_array_equal(np.array(origin["xyz"].split(), float), refined.rig_from_cam[:3, 3])


@pytest.mark.parametrize("tilt_rad", [0.0, 1e-17, 1e-13, 1e-9, 1e-5])
@pytest.mark.parametrize("sign", [-1, 1])
def test_angles_of_a_camera_whose_rows_are_vertical(tilt_rad: float, sign: int) -> None:
    for turn in np.linspace(-3, 3, 7):
        rotation = Rotation.from_euler("ZYX", [turn, sign * np.pi / 2 + tilt_rad, 0.7]).as_matrix()
        found = Rotation.from_euler("xyz", roll_pitch_yaw(rotation)).as_matrix()
        np.testing.assert_allclose(found, rotation, atol=1e-12)


def test_numbers_are_numbers_to_yaml_1_1() -> None:
    """YAML 1.1 wants a point and a signed exponent: PyYAML takes 1e-05 for a text."""
    of_yaml = re.compile(r"[-+]?[0-9]+\.[0-9]*([eE][-+][0-9]+)?")
    camera = RigCamera(
        name="null", width=4, height=3, intrinsics=[1e22, 3.0, 1e-05, 2.5e-7], distortion="radtan",
        coefficients=[0.0, -1e-300, 5e-324, 1e16], rig_from_cam=np.eye(4),
    )  # fmt: skip
    for text in (rig_files.camera_info_text(camera), rig_files.camchain_text([camera, camera])):
        lists = re.findall(r"(?:data|intrinsics|distortion_coeffs):? \[(.*)\]|- \[(.*)\]", text)
        numbers = [number for pair in lists for one in pair if one for number in one.split(", ")]
        assert len(numbers) >= 16
        assert [number for number in numbers if not of_yaml.fullmatch(number)] == []
    assert parsed_yaml(rig_files.camera_info_text(camera))["camera_name"] == "null"
    assert 'camera_name: "null"' in rig_files.camera_info_text(camera)  # in quotes: else it is none
    chain = parsed_yaml(rig_files.camchain_text([camera]))["cam0"]
    assert (chain["intrinsics"], chain["distortion_coeffs"]) == (camera.intrinsics, camera.coefficients)


def test_a_scene_has_them_and_a_map_has_them_for_each_vehicle(tmp_path: Path) -> None:
    write_scene(make_scene(), tmp_path / "scene", {})
    rig = tmp_path / "scene" / "rig"
    files = {path.relative_to(rig).as_posix() for path in rig.rglob("*") if path.is_file()}
    assert files == {"camchain.yaml", "rig.urdf", "camera_info/left.yaml", "camera_info/right.yaml"}
    refined = json.loads((tmp_path / "scene" / "calibration.json").read_text())["cameras"]["right"]["refined"]
    found = parsed_yaml((rig / "camera_info" / "right.yaml").read_text())["camera_matrix"]["data"]
    assert found[2] == refined["params"][2] - 0.5
    of_map = surround(prefix="b/")
    cameras = rig_cameras(of_map, "b/")
    assert [camera.name for camera in cameras] == [f"{k}.{model}" for k, model in enumerate(PARAMS)]
    assert rig_cameras(of_map, "a/") == []
    rig_files.write_rig(cameras, tmp_path / "rigs" / "b")
    text = (tmp_path / "rigs" / "b" / "camchain.yaml").read_text()
    assert all(row.agrees for row in rig_files_readback.camchain(of_map, "b/", text))


@pytest.mark.parametrize("text", ["a: 1\na: 2", "a\n", "a: [1\n", "  a: 1\nb", "- [1]", "a:\n    b: 1"])
def test_what_is_no_yaml_of_ours_is_refused(text: str) -> None:
    with pytest.raises((ValueError, KeyError)):
        parsed_yaml(text)


def moved(camera: RigCamera) -> RigCamera:
    rig_from_cam = camera.rig_from_cam.copy()
    rig_from_cam[0, 3] += 1e-8
    return replace(camera, rig_from_cam=rig_from_cam)


@pytest.mark.parametrize(
    ("change", "file"),
    [
        (moved, "camchain.yaml"),
        (lambda c: replace(c, intrinsics=[v + 0.5 for v in c.intrinsics]), "camchain.yaml"),
        (lambda c: replace(c, coefficients=c.coefficients[::-1]), "camchain.yaml"),
        (lambda c: replace(c, height=c.height + 1), "camchain.yaml"),
    ],
)
def test_other_cameras_are_withheld_and_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: Callable[[RigCamera], RigCamera], file: str
) -> None:
    """The comparison does not rest on the text alone, which is made by the same function again."""
    original = rig_files.rig_cameras
    monkeypatch.setattr(
        rig_files, "rig_cameras", lambda *args: [*original(*args)[:1], *map(change, original(*args)[1:])]
    )
    write_scene(make_scene(), tmp_path / "scene", {})
    notes = withheld_files(tmp_path / "scene")
    assert any(note.startswith(f"rig/{file} is withheld: it was written but does not read back") for note in notes)
    assert not (tmp_path / "scene" / "rig" / file).exists()
    assert (tmp_path / "scene" / "rig" / "camera_info" / "left.yaml").exists()


@pytest.mark.parametrize("file", ["camchain.yaml", "rig.urdf", "camera_info/left.yaml"])
def test_a_flipped_bit_withholds_that_file_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file: str) -> None:
    original = rig_files.write_rig

    def flipping(cameras: Any, folder: Path) -> list[str]:
        notes = original(cameras, folder)
        data = bytearray((folder / file).read_bytes())
        data[len(data) // 2] ^= 1
        (folder / file).write_bytes(data)
        return notes

    monkeypatch.setattr(rig_files, "write_rig", flipping)
    write_scene(make_scene(), tmp_path / "scene", {})
    assert_withheld(tmp_path / "scene", f"rig/{file}")
    assert len([path for path in (tmp_path / "scene" / "rig").rglob("*") if path.is_file()]) == 3
