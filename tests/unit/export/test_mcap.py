"""The MCAP file: what is written, what readers of its schemas find, and what is withheld."""

from __future__ import annotations

import tracemalloc
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from mrasfm_engine.errors import InputError
from mrasfm_engine.export import run_export as exports
from mrasfm_engine.export.contract import DriveFiles, ExportOptions, ExportWork, Written
from mrasfm_engine.export.formats import WRITERS
from mrasfm_engine.export.mcap import FILE
from mrasfm_engine.export.mcap_cameras import sent_cameras
from mrasfm_engine.export.scene import write_scene
from mrasfm_engine.export.stored_scene import read_source
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_camera, project_points
from mrasfm_engine.importers.layouts import import_recording
from mrasfm_engine.preflight.drive_reader import write_manifest
from mrasfm_engine.scene.scene import Scene
from tests.helpers.export_example import MODELS, POINTS, UNITS
from tests.helpers.export_images import FISHEYES, USUAL, written

RATIONAL = [700.0, 705.0, 470.0, 310.0, -0.05, 0.01, 1e-3, -5e-4, 0.02, 0.01, 0.0, 0.003]


def exported(tmp_path: Path, scene: Scene | None = None, **options: Any) -> tuple[Written, Path]:
    """The format as it is before it is published."""
    source = replace(read_source(tmp_path / "scene"), files=DriveFiles(folders={"": tmp_path / "drive"}))
    folder = tmp_path / "work"
    folder.mkdir()
    work = ExportWork(source=source, options=ExportOptions(**options), folder=folder, step=lambda *_: None)
    made = WRITERS["mcap"](work)
    assert exports._fault(made, folder) is None
    return made, folder


def messages(folder: Path) -> dict[str, list[tuple[int, Any]]]:
    found = defaultdict(list)
    with (folder / FILE).open("rb") as stream:
        for _, channel, message, decoded in make_reader(
            stream, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            found[channel.topic].append((message.log_time, decoded))
    return found


def pose_of(transform: Any) -> np.ndarray:
    q, t = transform.rotation, transform.translation
    return se3.transform(se3.rotation_from_quaternion([q.x, q.y, q.z, q.w]), [t.x, t.y, t.z])


def test_content(tmp_path: Path) -> None:
    scene = written(tmp_path, MODELS, kind="jpg", moving=False)
    _, folder = exported(tmp_path)
    found = messages(folder)
    images = [image for i, image in enumerate(scene.drive.images) if scene.image_registered[i]]
    assert {topic: len(rows) for topic, rows in found.items()} == {
        "/tf": 2 + UNITS - 1,
        "/points": 1,
        "/fix": UNITS - 1,
        "/left/calibration": 4,
        "/left/image": 4,
        "/right/calibration": 3,
        "/right/image": 3,
    }
    for side in ("left", "right"):
        own = [image for image in images if scene.drive.cameras[image.camera].name == side]
        for (time_ns, message), image in zip(found[f"/{side}/image"], own, strict=True):
            assert time_ns == image.timestamp_us * 1000
            assert message.data == (tmp_path / "drive" / image.file).read_bytes()
            assert (message.format, message.frame_id) == ("jpeg", side)
    placed = {m.child_frame_id: pose_of(m) for _, m in found["/tf"] if m.parent_frame_id == "rig"}
    np.testing.assert_allclose(placed["right"], scene.calibration[1].rig_from_cam, atol=1e-12)
    rigs = [pose_of(m) for _, m in found["/tf"] if m.child_frame_id == "rig"]
    np.testing.assert_allclose(rigs, scene.world_from_rig[scene.unit_registered], atol=1e-6)
    cloud = found["/points"][0][1]
    assert len(cloud.data) == 16 * POINTS
    fix = found["/fix"][0][1]
    assert (fix.position_covariance_type, len(fix.position_covariance)) == (2, 9)


@pytest.mark.parametrize(
    ("model", "params", "name"),
    [
        ("PINHOLE", USUAL["PINHOLE"], "plumb_bob"),
        ("OPENCV", USUAL["OPENCV"], "plumb_bob"),
        ("FULL_OPENCV", RATIONAL, "rational_polynomial"),
        ("OPENCV_FISHEYE", FISHEYES["OPENCV_FISHEYE"], "kannala_brandt"),
    ],
)
@pytest.mark.parametrize("size", [None, 480])
def test_calibrations_project_as_the_engine(
    tmp_path: Path, model: str, params: list[float], name: str, size: int | None
) -> None:
    """With OpenCV's functions, whose pixels count from centres."""
    scene = written(tmp_path, {model: params, "SIMPLE_PINHOLE": [700.0, 470.0, 310.0]})
    _, folder = exported(tmp_path, image_size_px=size)
    calibration = messages(folder)["/left/calibration"][0][1]
    assert calibration.distortion_model == name
    points = np.random.default_rng(0).uniform([-1, -0.6, 2], [1, 0.6, 4], (20, 3))
    project = cv2.fisheye.projectPoints if name == "kannala_brandt" else cv2.projectPoints
    camera = np.array(calibration.K).reshape(3, 3)
    order = [points.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), camera, np.array(calibration.D)]
    found = project(*order)[0].reshape(-1, 2) + 0.5
    lens = pack_camera(model, scene.calibration[0].params)
    scale = 1.0 if size is None else 0.5
    np.testing.assert_allclose(found, project_points(*lens, points) * scale, atol=1e-6)
    picture = messages(folder)["/left/image"][0][1].data
    shape = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR).shape
    assert shape == (calibration.height, calibration.width, 3) == (600 * scale, 960 * scale, 3)


def test_a_camera_that_foxglove_has_no_model_for(tmp_path: Path) -> None:
    written(tmp_path, {"MEI": FISHEYES["MEI"], "PINHOLE": USUAL["PINHOLE"]})
    made, folder = exported(tmp_path)
    assert made.notes == ["Foxglove has no model for left: no calibration"]
    assert "/left/calibration" not in messages(folder)
    assert len(messages(folder)["/left/image"]) == 4


def test_images_of_refined_time_offsets_are_where_they_were_taken(tmp_path: Path) -> None:
    """Both cameras of a unit have one stamp, but were not taken at one time: the rig has two poses at that stamp."""
    scene = written(tmp_path, MODELS)
    assert scene.unit_from_image is not None
    _, folder = exported(tmp_path)
    poses = {(m.child_frame_id, time_ns): pose_of(m) for time_ns, m in messages(folder)["/tf"]}
    off = []
    for i in np.flatnonzero(scene.image_registered).tolist():
        image = scene.drive.images[i]
        name, time_ns = scene.drive.cameras[image.camera].name, image.timestamp_us * 1000
        off.append(np.abs(poses["rig", time_ns] @ poses[name, time_ns] - scene.world_from_cam[i]).max())
    assert len(off) == 7
    assert 0 <= max(off) < 1e-6
    assert np.abs(scene.unit_from_image[scene.image_registered] - np.eye(4)).max() > 0.1


def test_every_changed_byte_withholds_the_file(tmp_path: Path) -> None:
    written(tmp_path, MODELS)
    made, folder = exported(tmp_path)
    content = (folder / FILE).read_bytes()
    for at in np.random.default_rng(2).choice(len(content), 60, replace=False).tolist():
        (folder / FILE).write_bytes(content[:at] + bytes([content[at] ^ 4]) + content[at + 1 :])
        assert FILE in str(exports._fault(made, folder))
    (folder / FILE).write_bytes(content[:-9])
    assert FILE in str(exports._fault(made, folder))


@pytest.mark.parametrize("what", ["pose", "calibration", "point", "color", "fix", "sigma"])
def test_a_writer_that_errs_is_found(tmp_path: Path, what: str) -> None:
    """Not the bytes are wrong but what they say: the comparison does not rest on the digest alone."""
    written(tmp_path, MODELS)
    made, folder = exported(tmp_path)
    (check,) = made.checks
    given: Any = check.compare
    source, *rest = given.args
    scene = source.scene
    calibration = list(scene.calibration)
    calibration[1] = replace(calibration[1], params=calibration[1].params + 1e-6)
    moved = scene.georeference.ecef_from_local.copy()
    moved[0, 3] += 1e-3
    changes = {
        "pose": {"world_from_rig": scene.world_from_rig + 1e-6 * (np.arange(4) == 3) * (np.arange(4) < 3)[:, None]},
        "calibration": {"calibration": calibration},
        "point": {"points_m": scene.points_m * (1 + 1e-6)},
        "color": {"point_colors": scene.point_colors ^ 1},
        "fix": {"georeference": replace(scene.georeference, ecef_from_local=moved)},
        "sigma": {"sigma_position_m": scene.sigma_position_m * 1.001},
    }[what]
    other = replace(source, scene=replace(scene, **changes))
    if what == "calibration":
        rest[0] = sent_cameras(other, None)
    again = replace(check, compare=lambda found: given.func(other, *rest, found))
    assert exports._fault(Written(checks=[again]), folder) is not None


def test_images_are_in_memory_one_at_a_time(tmp_path: Path) -> None:
    scene = written(tmp_path, {"PINHOLE": USUAL["PINHOLE"], "OPENCV": USUAL["OPENCV"]})
    noise = np.random.default_rng(0).integers(0, 256, (600, 960, 3), dtype=np.uint8)
    for image in scene.drive.images:
        cv2.imwrite(str(tmp_path / "drive" / image.file), noise)
    tracemalloc.start()
    try:
        exported(tmp_path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    size = (tmp_path / "work" / FILE).stat().st_size
    assert size > 11e6
    assert 1e6 < peak < 0.9 * size


def test_images_of_another_drive_are_refused(tmp_path: Path) -> None:
    scene = written(tmp_path, MODELS)
    cv2.imwrite(str(tmp_path / "drive" / scene.drive.images[0].file), np.zeros((40, 60, 3), np.uint8))
    with pytest.raises(InputError, match="has 60 x 40 pixels, camera left has 960 x 600"):
        exported(tmp_path)


def test_the_importer_of_bags_says_what_it_is_not(tmp_path: Path) -> None:
    written(tmp_path, MODELS)
    _, folder = exported(tmp_path)
    with pytest.raises(InputError, match=r"bag .*scene\.mcap cannot be read: Profile is not ros2"):
        import_recording(folder, tmp_path / "drive-of-it")


def test_a_camera_that_is_called_as_a_frame(tmp_path: Path) -> None:
    scene = written(tmp_path, MODELS)
    camera = scene.drive.cameras[0].model_copy(update={"name": "map"})
    rig = scene.drive.manifest.rig.model_copy(update={"cameras": [camera, *scene.drive.cameras[1:]]})
    frames = [
        frame.model_copy(update={"images": {"map" if k == "left" else k: image for k, image in frame.images.items()}})
        for frame in scene.drive.manifest.frames
    ]
    manifest = scene.drive.manifest.model_copy(update={"rig": rig, "frames": frames})
    write_manifest(manifest, tmp_path / "drive")
    write_scene(replace(scene, drive=replace(scene.drive, manifest=manifest)), tmp_path / "scene", {})
    with pytest.raises(ValueError, match="camera map has the name of a frame"):
        exported(tmp_path)
