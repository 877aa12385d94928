from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mrasfm_engine.errors import InputError, StorageError
from mrasfm_engine.geometry import se3
from mrasfm_engine.io.axes import flu_from_body
from mrasfm_engine.preflight.drive_reader import MANIFEST_NAME, read_drive, write_manifest
from mrasfm_engine.scene.drive import matrix_from_pose, pose_from_matrix
from schemas import BodyAxes
from schemas.parsing import MAX_MANIFEST_BYTES

WriteDrive = Callable[[dict[str, Any]], Path]


def test_read_gives_images_in_order(drive_document: dict[str, Any], write_drive: WriteDrive) -> None:
    drive = read_drive(write_drive(drive_document))
    assert drive.root.is_absolute()
    assert [image.file for image in drive.images[:2]] == ["images/left/000000.png", "images/right/000000.png"]
    assert len(drive.images) == 10
    assert drive.timestamps_us.tolist() == [1_000_000 + 100_000 * i for i in range(5)]


@pytest.mark.parametrize("axes", list(BodyAxes))
def test_axes_are_converted_everywhere(axes: BodyAxes, drive_document: dict[str, Any], write_drive: WriteDrive) -> None:
    """A drive declared in other axes reads as the same drive declared in ours."""
    rng = np.random.default_rng(1)
    body_flu = flu_from_body(axes).T
    assert abs(np.linalg.det(body_flu) - 1) < 1e-12
    world_rig = [se3.transform(se3.exp_so3(rng.normal(size=3)), rng.normal(size=3)) for _ in range(3)]
    rough = [
        {"timestamp_us": 1_000_000 + i, "world_from_rig": pose_from_matrix(pose).model_dump()}
        for i, pose in enumerate(world_rig)
    ]
    drive_document["rough_poses"] = {"poses": rough}
    ours = read_drive(write_drive(drive_document))

    drive_document["rig"]["body_axes"] = axes.value
    for camera, rig_cam in zip(drive_document["rig"]["cameras"], ours.rig_from_cam, strict=True):
        camera["rig_from_cam"] = pose_from_matrix(body_flu @ rig_cam).model_dump()
    antenna = body_flu[:3, :3] @ [0.0, 0.0, 1.8]
    drive_document["gnss"]["antenna_in_rig_m"] = antenna.tolist()
    for entry, pose in zip(rough, world_rig, strict=True):
        entry["world_from_rig"] = pose_from_matrix(pose @ body_flu.T).model_dump()
    theirs = read_drive(write_drive(drive_document))

    assert theirs.manifest.rig.body_axes is BodyAxes.FLU
    np.testing.assert_allclose(theirs.rig_from_cam, ours.rig_from_cam, atol=1e-12)
    assert theirs.manifest.gnss is not None
    np.testing.assert_allclose(theirs.manifest.gnss.antenna_in_rig_m, [0, 0, 1.8], atol=1e-12)
    assert theirs.manifest.rough_poses is not None
    for entry_read, pose in zip(theirs.manifest.rough_poses.poses, world_rig, strict=True):
        np.testing.assert_allclose(matrix_from_pose(entry_read.world_from_rig), pose, atol=1e-12)


def test_forward_camera_of_kitti_axes(drive_document: dict[str, Any], write_drive: WriteDrive) -> None:
    drive_document["rig"]["body_axes"] = "rdf"
    for camera in drive_document["rig"]["cameras"]:
        camera["rig_from_cam"] = {"rotation_xyzw": [0, 0, 0, 1], "translation_m": [0.5, -1.0, 2.0]}
    rig_from_cam = read_drive(write_drive(drive_document)).rig_from_cam[0]
    np.testing.assert_allclose(rig_from_cam[:3, 2], [1, 0, 0], atol=1e-12)  # looks forward
    np.testing.assert_allclose(rig_from_cam[:3, 3], [2.0, -0.5, 1.0], atol=1e-12)


def test_bad_field_names_file_path_and_remedy(drive_document: dict[str, Any], write_drive: WriteDrive) -> None:
    drive_document["rig"]["cameras"][1]["params"] = [1.0]
    root = write_drive(drive_document)
    with pytest.raises(InputError) as caught:
        read_drive(root)
    assert str(root / MANIFEST_NAME) in caught.value.what
    assert "rig.cameras.1.params: PINHOLE has 4 parameters" in caught.value.what
    assert caught.value.remedy == "Correct rig.cameras.1.params; `mrasfm describe manifest` describes the format."


def test_missing_folder_and_manifest_are_told_apart(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        read_drive(tmp_path / "nowhere")
    with pytest.raises(InputError, match="mrasfm import") as caught:
        read_drive(tmp_path)
    assert caught.value.code == "no-manifest"
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="is not a folder"):
        read_drive(tmp_path / "file")
    (tmp_path / MANIFEST_NAME).mkdir()
    with pytest.raises(InputError, match="is not a file"):
        read_drive(tmp_path)


def test_size_is_bounded_before_reading(tmp_path: Path) -> None:
    file = tmp_path / MANIFEST_NAME
    file.touch()
    with pytest.raises(InputError, match="is empty"):
        read_drive(tmp_path)
    with file.open("wb") as stream:
        stream.truncate(MAX_MANIFEST_BYTES + 1)  # a sparse file
    with pytest.raises(InputError, match="200 MB, over the bound of 200 MB"):
        read_drive(tmp_path)


@pytest.mark.parametrize(("text", "message"), [("NaN", "NaN"), ('{"a": 1, "a": 2}', "appears twice")])
def test_unclean_json_names_the_file(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / MANIFEST_NAME).write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_drive(tmp_path)
    assert MANIFEST_NAME in caught.value.what


def test_written_manifest_reads_the_same(
    drive_document: dict[str, Any], write_drive: WriteDrive, tmp_path: Path
) -> None:
    drive = read_drive(write_drive(drive_document))
    other = tmp_path / "other"
    other.mkdir()
    assert write_manifest(drive.manifest, other) == other / MANIFEST_NAME
    assert read_drive(other).manifest == drive.manifest
    assert os.listdir(other) == [MANIFEST_NAME]


def test_failed_write_leaves_the_old_manifest(
    drive_document: dict[str, Any], write_drive: WriteDrive, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = write_drive(drive_document)
    before = sorted(os.listdir(root)), (root / MANIFEST_NAME).read_bytes()
    drive = read_drive(root)

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StorageError, match="no space left") as caught:
        write_manifest(drive.manifest, root)
    assert str(root) in caught.value.what
    assert before == (sorted(os.listdir(root)), (root / MANIFEST_NAME).read_bytes())


def test_write_into_missing_folder(drive_document: dict[str, Any], write_drive: WriteDrive, tmp_path: Path) -> None:
    drive = read_drive(write_drive(drive_document))
    with pytest.raises(StorageError, match="cannot write"):
        write_manifest(drive.manifest, tmp_path / "nowhere")


def test_document_is_plain_json(drive_document: dict[str, Any], write_drive: WriteDrive, tmp_path: Path) -> None:
    path = write_manifest(read_drive(write_drive(drive_document)).manifest, tmp_path)
    written = json.loads(path.read_text(encoding="utf-8"))
    assert written["frames"] == drive_document["frames"]
    assert "rough_poses" not in written
