from __future__ import annotations

import argparse
import errno
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mrasfm_engine.cli import EXIT_BAD_INPUT, main
from mrasfm_engine.commands import import_drive
from mrasfm_engine.errors import InputError, StorageError
from mrasfm_engine.importers import drive_writer
from mrasfm_engine.importers.layouts import import_recording
from mrasfm_engine.importers.recording import Recording, SourceUnit, parse_slice
from mrasfm_engine.preflight.drive_reader import check_drive, read_drive

HEADER = "timestamp_us,latitude_deg,longitude_deg,ellipsoidal_height_m,sigma_horizontal_m,sigma_vertical_m"
RDF = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], dtype=float)  # flu_from_rdf
Edit = Callable[[dict[str, Any]], None]


def rig_document() -> dict[str, Any]:
    def camera(right_m: float) -> dict[str, Any]:
        pose = np.eye(4)
        pose[0, 3] = right_m
        return {
            "model": "PINHOLE",
            "width": 48,
            "height": 32,
            "K": [[40.0, 0, 23.5], [0, 41.0, 15.5], [0, 0, 1]],
            "T_body_cam": pose.tolist(),
        }

    return {"body_axes": "rdf", "cameras": {"cam_l": camera(0.0), "cam_r": camera(0.5)}, "source": "a test"}


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Eight frames at 10 Hz of a camera pair in KITTI's axes, driving forward at 10 m/s, with GNSS, truth and masks."""
    folder = tmp_path / "recording"
    rng = np.random.default_rng(3)
    for name in ("cam_l", "cam_r"):
        (folder / name).mkdir(parents=True)
        (folder / "semantics" / name).mkdir(parents=True)
        for i in range(8):
            cv2.imwrite(str(folder / name / f"{i:06d}.png"), rng.integers(0, 255, (32, 48, 3), dtype=np.uint8))
            cv2.imwrite(str(folder / "semantics" / name / f"{i:06d}.png"), np.zeros((32, 48), np.uint8))
    (folder / "rig.json").write_text(json.dumps(rig_document()))
    (folder / "gnss_antenna.json").write_text('{"antenna_in_body_m": [0.3, -1.5, 0.1]}')
    rows = [f"{100_000 * i},{49 + i / 111_000:.9f},8.4,110.0,0.5,1.0" for i in range(8)]
    (folder / "gnss.csv").write_text("\n".join([HEADER, *rows]) + "\n")
    (folder / "poses.txt").write_text("".join(f"1 0 0 0.01 0 1 0 0 0 0 1 {float(i)}\n" for i in range(8)))
    return folder


def edit_rig(folder: Path, edit: Edit) -> None:
    document = rig_document()
    edit(document)
    (folder / "rig.json").write_text(json.dumps(document))


def refused(folder: Path, out: Path, **options: Any) -> InputError:
    """The error of an import that must fail and leave nothing behind."""
    before = sorted(out.parent.iterdir())
    with pytest.raises(InputError) as caught:
        import_recording(folder, out, **options)
    assert sorted(out.parent.iterdir()) == before
    assert caught.value.remedy
    return caught.value


def test_the_vehicle_of_the_rig(recording: Path, tmp_path: Path) -> None:
    edit_rig(recording, lambda document: document.update(vehicle="M-AB:1234"))
    import_recording(recording, tmp_path / "drive")
    assert read_drive(tmp_path / "drive").manifest.vehicle == "M-AB:1234"
    edit_rig(recording, lambda document: document.update(vehicle="M AB"))
    assert "vehicle" in refused(recording, tmp_path / "other").what
    edit_rig(recording, lambda document: None)
    error = refused(recording, tmp_path / "other", vehicle="M AB")
    assert error.what == "--vehicle 'M AB' is no name of a vehicle"
    assert "without spaces" in error.remedy
    assert "--vehicle" in refused(recording, tmp_path / "other", vehicle="M-AB\n").what


def test_a_piece_of_a_recording_has_a_name_of_its_own(recording: Path, tmp_path: Path) -> None:
    import_recording(recording, tmp_path / "drive", frames=":2", name="Straße, 1st half")
    assert read_drive(tmp_path / "drive").manifest.name == "Straße, 1st half"
    for name in ("", "a\nb", "x" * 201):
        error = refused(recording, tmp_path / "other", name=name)
        assert (error.what, error.code) == (f"--name {name!r} is no name of a drive", "bad-drive-name")


def test_a_folder_whose_name_no_drive_has(recording: Path, tmp_path: Path) -> None:
    folder = recording.rename(tmp_path / ("street" * 40))
    error = refused(folder, tmp_path / "drive")
    assert "name: String should have at most 200 characters" in error.what
    assert "--name" in error.remedy
    assert import_recording(folder, tmp_path / "drive", name="street").units == 8


def test_cameras_whose_folders_are_one_on_many_systems(recording: Path, tmp_path: Path) -> None:
    def rename(document: dict[str, Any]) -> None:
        document["cameras"]["CAM_L"] = document["cameras"].pop("cam_r")

    edit_rig(recording, rename)
    for parent in (recording, recording / "semantics"):
        (parent / "cam_r").rename(parent / "CAM_L")
    error = refused(recording, tmp_path / "drive")
    assert "is one file with" in error.what
    assert "camera" in error.remedy


def test_a_camera_whose_name_no_manifest_has(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The message names the camera and says which names there may be, without a regular expression."""
    edit_rig(recording, lambda document: document["cameras"].update({"vorne links": document["cameras"].pop("cam_r")}))
    (recording / "cam_r").rename(recording / "vorne links")
    assert main(["import", str(recording), "--out", str(tmp_path / "drive")]) == EXIT_BAD_INPUT
    said = " ".join(capsys.readouterr().err.split())
    assert "cameras.vorne links.[key]: Input should be 1 to 64 letters (A-Z, a-z), digits and _ . -" in said
    assert "[A-Z" not in said


def test_everything_arrives_in_our_axes(recording: Path, tmp_path: Path) -> None:
    summary = import_recording(recording, tmp_path / "drive")
    assert (summary.layout, summary.cameras, summary.units, summary.images) == ("rig folder", 2, 8, 16)
    assert (summary.masks, summary.gnss_samples, summary.rough_poses, summary.truth) == (16, 8, 0, True)
    drive = read_drive(tmp_path / "drive")
    assert check_drive(drive) == []
    np.testing.assert_allclose(drive.rig_from_cam[1][:3, :3], RDF, atol=1e-12)
    np.testing.assert_allclose(drive.rig_from_cam[1][:3, 3], [0, -0.5, 0], atol=1e-12)
    assert drive.cameras[0].params == [40.0, 41.0, 24.0, 16.0]  # centres of pixels move by half
    assert drive.manifest.gnss is not None
    np.testing.assert_allclose(drive.manifest.gnss.antenna_in_rig_m, [0.1, -0.3, 1.5], atol=1e-12)
    assert drive.images[3].file == "images/cam_r/000001.png"
    assert drive.images[3].mask == "masks/cam_r/000001.png"
    assert drive.timestamps_us.tolist() == [100_000 * i for i in range(8)]
    truth = np.loadtxt(tmp_path / "drive/truth.tum")
    np.testing.assert_allclose(truth[:, 0], np.arange(8) / 10)
    np.testing.assert_allclose(truth[:, 1], np.arange(8), atol=1e-9)  # forward is x
    np.testing.assert_allclose(truth[:, 2], -0.01, atol=1e-9)  # to the right is -y
    np.testing.assert_allclose(truth[:, 4:], np.tile([0, 0, 0, 1], (8, 1)), atol=1e-9)


def test_images_are_linked_or_copied(recording: Path, tmp_path: Path) -> None:
    source = recording / "cam_l/000003.png"
    import_recording(recording, tmp_path / "linked")
    import_recording(recording, tmp_path / "copied", copy=True)
    assert (tmp_path / "linked/images/cam_l/000003.png").samefile(source)
    copied = tmp_path / "copied/images/cam_l/000003.png"
    assert not copied.samefile(source)
    assert copied.read_bytes() == source.read_bytes()


def test_link_falls_back_to_copy(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_links(*_: object) -> None:
        raise OSError(errno.EXDEV, "Invalid cross-device link")

    monkeypatch.setattr(os, "link", no_links)
    import_recording(recording, tmp_path / "drive")
    assert check_drive(read_drive(tmp_path / "drive")) == []


def test_symbolic_links_become_files(recording: Path, tmp_path: Path) -> None:
    (recording / "cam_l").rename(tmp_path / "elsewhere")
    (recording / "cam_l").symlink_to(tmp_path / "elsewhere")
    file = tmp_path / "elsewhere/000000.png"
    file.rename(tmp_path / "zero.png")
    file.symlink_to(tmp_path / "zero.png")
    import_recording(recording, tmp_path / "drive")
    assert not [path for path in (tmp_path / "drive").rglob("*") if path.is_symlink()]
    assert check_drive(read_drive(tmp_path / "drive")) == []


@pytest.mark.parametrize("target", ["000003.png", "/nowhere/000003.png"])
def test_a_link_that_leads_nowhere_is_named(recording: Path, tmp_path: Path, target: str) -> None:
    """One in a circle, and one to a file that is gone."""
    file = recording / "cam_l" / "000003.png"
    file.unlink()
    file.symlink_to(target)
    error = refused(recording, tmp_path / "drive")
    assert error.what.startswith(f"{file} does not exist")
    assert error.code == "missing-file"


@pytest.mark.parametrize(
    ("frames", "expected"),
    [
        ("0:8:2", [0, 2, 4, 6]),
        ("1::2", [1, 3, 5, 7]),
        (":3", [0, 1, 2]),
        ("-2:", [6, 7]),
        ("2:-4", [2, 3]),
        ("5:100", [5, 6, 7]),
        (":", list(range(8))),
    ],
)
def test_frames_keep_their_numbers_and_times(recording: Path, tmp_path: Path, frames: str, expected: list[int]) -> None:
    import_recording(recording, tmp_path / "drive", frames=frames)
    drive = read_drive(tmp_path / "drive")
    assert [frame.source_frame for frame in drive.manifest.frames] == expected
    assert drive.timestamps_us.tolist() == [100_000 * i for i in expected]
    assert len(np.loadtxt(tmp_path / "drive/truth.tum")) == len(expected)
    assert check_drive(drive) == []


@pytest.mark.parametrize("frames", ["", "5", "a:b", "1:2:3:4", "0:8:0", "7:0:-1", "1.5:", "0:8:2;"])
def test_bad_slices(recording: Path, tmp_path: Path, frames: str) -> None:
    assert repr(frames) in refused(recording, tmp_path / "drive", frames=frames).what


def test_slice_that_selects_nothing(recording: Path, tmp_path: Path) -> None:
    error = refused(recording, tmp_path / "drive", frames="8:20")
    assert error.code == "empty-selection"
    assert "0:8" in error.remedy


@pytest.mark.parametrize("names", ["", ",", " , "])
def test_a_choice_of_no_camera(recording: Path, tmp_path: Path, names: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["import", str(recording), "--out", str(tmp_path / "drive"), "--cameras", names]) == EXIT_BAD_INPUT
    said = capsys.readouterr().err
    assert "--cameras names no camera" in said
    assert "cam_l, cam_r" in said
    assert not (tmp_path / "drive").exists()


def test_a_choice_of_cameras_without_images(recording: Path, tmp_path: Path) -> None:
    for file in (recording / "cam_r").iterdir():
        file.unlink()
    error = refused(recording, tmp_path / "drive", cameras=["cam_r"])
    assert (error.code, error.what) == ("empty-selection", "the recording has no images of --cameras cam_r")


def test_slice_is_pythons() -> None:
    assert parse_slice("0:35:2") == slice(0, 35, 2)
    assert parse_slice(" 3 : ") == slice(3, None)


def test_gnss_is_kept_around_the_frames(recording: Path, tmp_path: Path) -> None:
    """At 0.2 Hz the nearest samples are beyond the margin, and are kept for interpolation at the ends."""
    rows = [f"{5_000_000 * i},{49 + i / 1000:.6f},8.4,110.0,0.5,1.0" for i in range(5)]
    (recording / "slow.csv").write_text("\n".join([HEADER, *rows]) + "\n")
    (recording / "times.txt").write_text("".join(f"{8.0 + i}\n" for i in range(8)))
    import_recording(recording, tmp_path / "drive", frames=":5", gnss_file=Path("slow.csv"))
    gnss = read_drive(tmp_path / "drive").manifest.gnss
    assert gnss is not None
    assert [s.timestamp_us for s in gnss.samples] == [5_000_000, 10_000_000, 15_000_000]


def test_of_gnss_without_samples_near_the_frames_the_nearest_are_kept(recording: Path, tmp_path: Path) -> None:
    """A slice in a tunnel takes no sample of the way to it and of the way from it but the last and the first."""
    times_us = [*range(0, 10_000_000, 1_000_000), *range(40_000_000, 50_000_000, 1_000_000)]
    rows = [f"{t},{49 + t / 1e9:.6f},8.4,110.0,0.5,1.0" for t in times_us]
    (recording / "tunnel.csv").write_text("\n".join([HEADER, *rows]) + "\n")
    (recording / "times.txt").write_text("".join(f"{20.0 + i}\n" for i in range(8)))
    import_recording(recording, tmp_path / "drive", frames="2:6", gnss_file=Path("tunnel.csv"))
    gnss = read_drive(tmp_path / "drive").manifest.gnss
    assert gnss is not None
    assert [s.timestamp_us for s in gnss.samples] == [9_000_000, 40_000_000]


def test_gnss_of_another_time_is_kept_for_the_check(recording: Path, tmp_path: Path) -> None:
    text = (recording / "gnss.csv").read_text().splitlines()
    moved = [text[0], *(f"{18_000_000 + 100_000 * i},{line.partition(',')[2]}" for i, line in enumerate(text[1:]))]
    (recording / "gnss.csv").write_text("\n".join(moved))
    assert import_recording(recording, tmp_path / "drive").gnss_samples == 8
    assert [f.code for f in check_drive(read_drive(tmp_path / "drive"))] == ["gnss-leap-seconds"]


def test_gnss_file_is_looked_up(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    lines = (recording / "gnss.csv").read_text().splitlines()
    (tmp_path / "work/here.csv").write_text("\n".join(lines[:4]))
    (tmp_path / "work/both.csv").write_text("\n".join(lines[:3]))
    (recording / "both.csv").write_text("\n".join(lines[:6]))
    for name, samples in (("here.csv", 3), ("both.csv", 5), (str(tmp_path / "work/both.csv"), 2)):
        summary = import_recording(recording, tmp_path / "drive", gnss_file=Path(name), force=True)
        assert summary.gnss_samples == samples
    error = refused(recording, tmp_path / "other", gnss_file=Path("nowhere.csv"))
    assert str(recording / "nowhere.csv") in error.what
    assert str(tmp_path / "work/nowhere.csv") in error.what


def test_gnss_needs_the_antenna(recording: Path, tmp_path: Path) -> None:
    (recording / "gnss_antenna.json").write_text('{"antenna_in_body_m": [0.3, -1500, 0.1]}')
    assert "over 100 m" in refused(recording, tmp_path / "drive").what
    (recording / "gnss_antenna.json").write_text('{"antenna_in_body_m": [0.3, NaN, 0.1]}')
    assert "NaN" in refused(recording, tmp_path / "drive").what
    (recording / "gnss_antenna.json").unlink()
    assert refused(recording, tmp_path / "drive").code == "missing-antenna"


def bad_rotation(document: dict[str, Any]) -> None:
    document["cameras"]["cam_r"]["T_body_cam"][0][0] = 1.1


def mirror(document: dict[str, Any]) -> None:
    document["cameras"]["cam_r"]["T_body_cam"][0][0] = -1.0


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda d: d.pop("body_axes"), "body_axes: is missing"),
        (lambda d: d.update(body_axes="up"), "'flu', 'rdf' or 'frd'"),
        (lambda d: d["cameras"]["cam_l"].pop("K"), "needs 'params'"),
        (lambda d: d["cameras"]["cam_l"].update(params=[1.0]), "not both"),
        (lambda d: d["cameras"]["cam_l"].update(model="OPENCV"), "OPENCV needs 'params'"),
        (lambda d: d["cameras"]["cam_l"]["K"][0].__setitem__(0, 0.0), "cameras.cam_l: params: focal length"),
        (lambda d: d["cameras"]["cam_l"]["K"][0].__setitem__(0, float("nan")), "NaN"),
        (lambda d: d["cameras"]["cam_l"]["T_body_cam"].pop(), None),
        (bad_rotation, "not orthonormal"),
        (mirror, "mirrors"),
        (lambda d: d["cameras"].clear(), "cameras"),
        (lambda d: d["cameras"].update(rear=d["cameras"]["cam_l"]), "camera folder"),
    ],
)
def test_bad_calibrations(recording: Path, tmp_path: Path, edit: Edit, message: str | None) -> None:
    edit_rig(recording, edit)
    if message is None:  # three rows are enough
        import_recording(recording, tmp_path / "drive")
    else:
        assert message in refused(recording, tmp_path / "drive").what


def test_a_transposed_pose_is_refused(recording: Path, tmp_path: Path) -> None:
    def transpose(document: dict[str, Any]) -> None:
        camera = document["cameras"]["cam_r"]
        camera["T_body_cam"] = np.transpose(camera["T_body_cam"]).tolist()

    edit_rig(recording, transpose)
    error = refused(recording, tmp_path / "drive")
    assert "rig.json: cameras.cam_r.T_body_cam: the fourth row is 0.5, 0, 0, 1" in error.what
    assert "transposed?" in error.remedy
    # A pose without its last row has nothing to be transposed.
    edit_rig(recording, lambda document: document["cameras"]["cam_r"]["T_body_cam"].pop())
    import_recording(recording, tmp_path / "drive")
    assert read_drive(tmp_path / "drive").rig_from_cam[1][1, 3] == pytest.approx(-0.5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda k: 2 * k, "the last row is 0, 0, 2 instead of 0, 0, 1"),
        (np.transpose, "the last row is 23.5, 15.5, 1 instead of 0, 0, 1"),
        (lambda k: k + np.outer([12.0, 0, 0], [0, 1, 0]), "beside its focal lengths are 12 and 0"),
    ],
    ids=["times a factor", "transposed", "skew"],
)
def test_matrices_that_are_no_calibration(
    recording: Path, tmp_path: Path, change: Callable[[np.ndarray], np.ndarray], message: str
) -> None:
    def alter(document: dict[str, Any]) -> None:
        camera = document["cameras"]["cam_r"]
        camera["K"] = change(np.array(camera["K"])).tolist()

    edit_rig(recording, alter)
    error = refused(recording, tmp_path / "drive")
    assert "rig.json: cameras.cam_r.K is no calibration matrix" in error.what
    assert message in error.what


def test_a_skew_of_rounding_is_none(recording: Path, tmp_path: Path) -> None:
    edit_rig(recording, lambda document: document["cameras"]["cam_r"]["K"][0].__setitem__(1, 1e-5))
    import_recording(recording, tmp_path / "drive")
    assert read_drive(tmp_path / "drive").cameras[1].params == [40.0, 41.0, 24.0, 16.0]


def test_fields_of_the_manifest_in_the_rig(recording: Path, tmp_path: Path) -> None:
    """Standard deviations and the shutter's times are read as the manifest has them."""
    given = {"sigma_rotation_deg": 0.01, "sigma_translation_m": 0.001, "readout_us": 30_000, "sigma_distortion": 0.01}
    edit_rig(recording, lambda document: document["cameras"]["cam_r"].update(given, readout_direction="top_to_bottom"))
    summary = import_recording(recording, tmp_path / "drive")
    assert summary.notes == []
    manifest = read_drive(tmp_path / "drive").manifest
    assert manifest.version == 2
    assert {name: getattr(manifest.rig.cameras[1], name) for name in given} == given
    assert manifest.rig.cameras[0].sigma_rotation_deg is None
    edit_rig(recording, lambda document: document["cameras"]["cam_r"].update(readout_us=-1))
    assert "rig.json: cameras.cam_r: readout_us" in refused(recording, tmp_path / "other").what


def test_unknown_fields_are_noted(recording: Path, tmp_path: Path) -> None:
    def add(document: dict[str, Any]) -> None:
        document["body_axis"] = "flu"
        for camera in document["cameras"].values():
            camera.update(D=[-0.3], distortion=[-0.3], sigma_rot=0.1, comment="no field")

    edit_rig(recording, add)
    (recording / "gnss_antenna.json").write_text('{"antenna_in_body_m": [0.3, -1.5, 0.1], "units": "cm"}')
    notes = import_recording(recording, tmp_path / "drive").notes
    assert notes == [
        "rig.json: not known, and not read: body_axis (is it body_axes?).",
        "rig.json: cameras: not known, and not read: D, distortion, sigma_rot (is it sigma_rotation_deg?). "
        "Distortion is read from 'model' and 'params' alone.",
        "gnss_antenna.json: not known, and not read: units.",
    ]
    assert read_drive(tmp_path / "drive").manifest.notes == notes


def test_other_camera_models_come_with_their_parameters(recording: Path, tmp_path: Path) -> None:
    params = [40.0, 41.0, 24.0, 16.0, 0.01, 0.0, 0.0, 0.0]

    def fisheye(document: dict[str, Any]) -> None:
        document["cameras"]["cam_l"].update(model="OPENCV_FISHEYE", params=params)
        del document["cameras"]["cam_l"]["K"]

    edit_rig(recording, fisheye)
    import_recording(recording, tmp_path / "drive")
    camera = read_drive(tmp_path / "drive").cameras[0]
    assert (camera.model, camera.params) == ("OPENCV_FISHEYE", params)


def test_missing_images_and_masks_are_allowed(recording: Path, tmp_path: Path) -> None:
    (recording / "cam_l/000002.png").unlink()
    (recording / "semantics/cam_r/000003.png").unlink()
    summary = import_recording(recording, tmp_path / "drive")
    assert (summary.units, summary.images, summary.masks) == (8, 15, 14)


def test_masks_without_a_frame_are_noted(recording: Path, tmp_path: Path) -> None:
    """Masks that count from 1, where images count from 0."""
    masks = recording / "semantics" / "cam_r"
    for number in reversed(range(8)):
        (masks / f"{number:06d}.png").rename(masks / f"{number + 1:06d}.png")
    shutil.copy(masks / "000001.png", masks / "000009.png")
    summary = import_recording(recording, tmp_path / "drive")
    assert summary.masks == 15
    assert summary.notes == ["Masks of frames that have no images, left out: cam_r: 2 (8, 9)."]


def test_images_that_an_import_loses_are_noted(recording: Path, tmp_path: Path) -> None:
    for name in ("000003", "000005", "000006", "000007"):
        (recording / f"cam_l/{name}.png").rename(recording / f"cam_l/{name}.bmp")
    (recording / "semantics/cam_r/000003.png").rename(recording / "semantics/cam_r/000003.npy")
    for aside in ("times.txt", ".DS_Store", "Thumbs.db"):
        (recording / "cam_r" / aside).write_text("")
    (recording / "cam_r/more").mkdir()
    summary = import_recording(recording, tmp_path / "drive")
    assert summary.images == 12
    assert summary.notes == [
        "Files that are not read, as images are .png, .jpg or .jpeg: "
        "cam_l: 4 (000003.bmp, 000005.bmp, 000006.bmp and 1 more); cam_r: 1 (more/); semantics/cam_r: 1 (000003.npy).",
        "Frames without an image of a camera: cam_l in 4 of 8 (3, 5, 6 and 1 more).",
    ]
    assert read_drive(tmp_path / "drive").manifest.notes == summary.notes
    chosen = import_recording(recording, tmp_path / "chosen", cameras=["cam_l"], frames="0:3").notes
    assert [note.partition(": ")[2].partition(":")[0] for note in chosen] == ["cam_l"]


def test_notes_of_many_lost_images_fit_a_manifest(recording: Path, tmp_path: Path) -> None:
    def add(document: dict[str, Any]) -> None:
        for number in range(40):
            document["cameras"][f"{'c' * 50}{number:02d}"] = document["cameras"]["cam_l"]

    edit_rig(recording, add)
    for number in range(40):
        folder = recording / f"{'c' * 50}{number:02d}"
        folder.mkdir()
        for name in "ab":
            (folder / f"{name * 150}.bmp").write_text("")
    unread, missing = import_recording(recording, tmp_path / "drive").notes
    assert unread.endswith("; and 28 more.")
    assert missing.endswith("; and 28 more.")


def test_badly_named_images(recording: Path, tmp_path: Path) -> None:
    shutil.copy(recording / "cam_l/000002.png", recording / "cam_l/2.png")
    assert "both of frame 2" in refused(recording, tmp_path / "drive").what
    (recording / "cam_l/2.png").rename(recording / "cam_l/last.png")
    assert "last.png is not named by its frame number" in refused(recording, tmp_path / "drive").what


def test_recording_without_images(recording: Path, tmp_path: Path) -> None:
    for file in recording.glob("cam_*/*"):
        file.unlink()
    assert refused(recording, tmp_path / "drive").code == "no-images"


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n", "has 1 lines, but there are images of frame 7"),
        ("poses.txt", "1 0 0\n", "line 1: '1 0 0' is not 12 numbers"),
        ("poses.txt", "1 0 0 nan 0 1 0 0 0 0 1 0\n" * 8, "line 1"),
        ("poses.txt", "2 0 0 0 0 1 0 0 0 0 1 0\n" * 8, "line 1 is not a rigid transform"),
        ("rough_poses.txt", "0 -1 0 0 1 0 0 0 0 0 1 0\n" * 8, "no axis of their world points up"),
        ("times.txt", "0.0\n0.1\n", "has 2 lines"),
        ("times.txt", "0\n1\n2\n2\n3\n4\n5\n6\n", "line 4: 2.000000 s does not come after"),
        ("times.txt", "0 1\n" * 8, "line 1: '0 1' is not 1 numbers"),
        ("times.txt", "-1\n0\n1\n2\n3\n4\n5\n6\n", "negative"),
    ],
)
def test_bad_tables(recording: Path, tmp_path: Path, file: str, text: str, message: str) -> None:
    (recording / file).write_text(text)
    error = refused(recording, tmp_path / "drive")
    assert message in error.what
    assert str(recording / file) in error.what


def test_times_are_rounded_to_microseconds(recording: Path, tmp_path: Path) -> None:
    seconds = [1.036117e-01 + i for i in range(7)] + [1234567890.1234567]
    (recording / "times.txt").write_text("".join(f"{s!r}\n" for s in seconds))
    (recording / "gnss.csv").unlink()
    import_recording(recording, tmp_path / "drive")
    times = read_drive(tmp_path / "drive").timestamps_us
    assert times[:2].tolist() == [103612, 1103612]
    assert times[-1] == 1234567890123457


@pytest.mark.parametrize(("unit", "factor"), [("milliseconds", 10**3), ("microseconds", 10**6), ("nanoseconds", 10**9)])
@pytest.mark.parametrize("start_s", [0, 1_714_730_400])
def test_times_in_another_unit(recording: Path, tmp_path: Path, unit: str, factor: int, start_s: int) -> None:
    times = [start_s * factor + i * factor // 10 for i in range(8)]
    (recording / "times.txt").write_text("".join(f"{time}\n" for time in times))
    error = refused(recording, tmp_path / "drive")
    assert f"times.txt, line 2: frames are {factor / 10:g} s apart: they look like {unit}" in error.what
    assert "in seconds" in error.remedy


def test_a_time_beyond_any_date(recording: Path, tmp_path: Path) -> None:
    (recording / "times.txt").write_text("".join(f"{0.1 * i if i < 5 else 1.7e15 + 100 * i}\n" for i in range(8)))
    assert "times.txt, line 8: 1700000000000700 is no time in seconds" in refused(recording, tmp_path / "drive").what


def test_values_that_no_manifest_has_are_named(recording: Path, tmp_path: Path) -> None:
    """A frame's defect is an error as any other, whatever the importer has let through."""
    import_recording(recording, tmp_path / "first")
    unit = SourceUnit(source_frame=0, timestamp_us=2**63, images={})
    made = Recording(layout="a test", name="made", cameras=read_drive(tmp_path / "first").cameras, units=[unit])
    with pytest.raises(InputError, match=r"recording made: timestamp_us: .*9223372036854775808"):
        drive_writer.write_recording(made, tmp_path / "drive")


@pytest.mark.parametrize("world", ["rdf", "z up"])
def test_rough_poses_get_a_world_with_z_up(recording: Path, tmp_path: Path, world: str) -> None:
    rotation = np.eye(3) if world == "rdf" else RDF
    rows = []
    for i in range(8):
        matrix = np.hstack([rotation, (rotation @ [[0.0], [0.0], [float(i)]])])
        rows.append(" ".join(str(v) for v in matrix.ravel()))
    (recording / "rough_poses.txt").write_text("\n".join(rows))
    assert import_recording(recording, tmp_path / "drive").rough_poses == 8
    rough = read_drive(tmp_path / "drive").manifest.rough_poses
    assert rough is not None
    np.testing.assert_allclose([p.world_from_rig.translation_m for p in rough.poses], [[i, 0, 0] for i in range(8)])
    np.testing.assert_allclose(rough.poses[0].world_from_rig.rotation_xyzw, [0, 0, 0, 1], atol=1e-12)


def test_output_is_not_overwritten(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "drive"
    import_recording(recording, out, frames=":3")
    assert "--force" in refused(recording, out).remedy
    assert import_recording(recording, out, force=True).units == 8
    assert len(list((out / "images/cam_l").iterdir())) == 8
    assert sorted(p.name for p in tmp_path.iterdir()) == ["drive", "recording"]


def test_force_spares_what_is_no_drive(recording: Path, tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "home/thesis.txt").write_text("years of work")
    assert "not a drive, as thesis.txt" in refused(recording, tmp_path / "home", force=True).what
    assert (tmp_path / "home/thesis.txt").exists()
    assert refused(recording, recording, force=True).code == "output-in-use"
    assert refused(recording, tmp_path, force=True).code == "output-in-use"
    (tmp_path / "file").touch()
    assert "is a file" in refused(recording, tmp_path / "file", force=True).what


def test_force_spares_what_lies_in_the_folder_of_a_drive(recording: Path, tmp_path: Path) -> None:
    """A scene, say, that was reconstructed into it: the drive alone is replaced."""
    out = tmp_path / "drive"
    import_recording(recording, out)
    (out / "scene").mkdir()
    error = refused(recording, out, force=True)
    assert error.what.startswith(f"{out / 'scene'} is no file of an imported drive")
    assert error.code == "output-in-use"
    assert (out / "scene").is_dir()


@pytest.mark.parametrize("name", [".DS_Store", "Thumbs.db", "desktop.ini", "._drive.json"])
def test_force_replaces_a_drive_that_a_file_manager_has_shown(recording: Path, tmp_path: Path, name: str) -> None:
    out = tmp_path / "drive"
    import_recording(recording, out)
    (out / name).touch()
    import_recording(recording, out, force=True)
    assert not (out / name).exists()


def test_empty_folder_may_be_filled(recording: Path, tmp_path: Path) -> None:
    (tmp_path / "a/b/drive").mkdir(parents=True)
    assert import_recording(recording, tmp_path / "a/b/drive").units == 8
    assert import_recording(recording, tmp_path / "new/folder/drive").units == 8
    assert (tmp_path / "a/b/drive").stat().st_mode & 0o777 == (tmp_path / "recording").stat().st_mode & 0o777


@pytest.mark.parametrize("stop", [KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left on device")])
def test_interrupted_import_leaves_nothing(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: BaseException
) -> None:
    import_recording(recording, tmp_path / "drive", frames=":3")
    placed: list[Path] = []
    place = drive_writer._place

    def stops(source: Path, target: Path, *, copy: bool) -> None:
        if len(placed) == 5:
            raise stop
        placed.append(target)
        place(source, target, copy=copy)

    monkeypatch.setattr(drive_writer, "_place", stops)
    expected = KeyboardInterrupt if isinstance(stop, KeyboardInterrupt) else StorageError
    with pytest.raises(expected) as caught:
        import_recording(recording, tmp_path / "drive", force=True)
    assert len(placed) == 5
    if isinstance(caught.value, StorageError):
        assert str(tmp_path / "drive") in caught.value.what
        assert "Free disk space" in caught.value.remedy
    assert sorted(p.name for p in tmp_path.iterdir()) == ["drive", "recording"]
    assert len(read_drive(tmp_path / "drive").manifest.frames) == 3  # the old one


def test_old_drive_survives_a_failed_exchange(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import_recording(recording, tmp_path / "drive", frames=":3")
    replace = Path.replace

    def fails(self: Path, target: Path) -> Path:
        if self.suffix == ".partial" and self.is_dir():
            raise PermissionError(errno.EPERM, "Operation not permitted")
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", fails)
    with pytest.raises(StorageError, match="cannot write"):
        import_recording(recording, tmp_path / "drive", force=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["drive", "recording"]
    assert len(read_drive(tmp_path / "drive").manifest.frames) == 3


def test_unknown_layout_lists_what_was_looked_for(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    error = refused(tmp_path / "empty", tmp_path / "drive")
    for name in ("rig.json", "calib.txt", "v1.0-*/scene.json"):
        assert name in error.what
    assert refused(tmp_path / "nowhere", tmp_path / "drive").code == "missing-folder"


def test_a_folder_around_recordings_of_several_layouts(recording: Path, tmp_path: Path) -> None:
    around = tmp_path / "around"
    around.mkdir()
    (recording / "semantics").rename(tmp_path / "semantics")
    recording.rename(around / "street")
    error = refused(around, tmp_path / "drive")  # of one, which the folder around it is not
    assert error.code == "several-recordings"
    assert "street (rig.json" in error.what
    assert str(around / "street") in error.remedy
    for name in ("lidar", "camera"):
        (around / "001" / name).mkdir(parents=True)
    (around / "001/lidar/poses.json").write_text("[]")
    error = refused(around, tmp_path / "drive")
    assert error.code == "several-recordings"
    assert "001 (" in error.what
    assert "street (rig.json" in error.what
    assert refused(around, tmp_path / "drive", scene="street").code == "several-recordings"
    assert "lidar/timestamps.json" in refused(around, tmp_path / "drive", scene="001").what  # that one is read
    assert import_recording(around / "street", tmp_path / "drive").units == 8


def command(*words: str) -> int:
    parser = argparse.ArgumentParser()
    import_drive.register(parser.add_subparsers())
    arguments = parser.parse_args(["import", *words])
    return int(arguments.run(arguments))


def test_command_prints_a_summary(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "drive"
    assert command(str(recording), "--out", str(out), "--frames", "0:8:2", "--gnss", "gnss.csv", "--copy") == 0
    text = capsys.readouterr().out
    assert "rig folder" in text
    assert "2 cameras, 4 units, 8 images" in text
    assert "GNSS samples: 8" in text
    assert "truth.tum" in text
    assert str(out) in text


def test_command_takes_negative_frames(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command(str(recording), "--out", str(tmp_path / "drive"), "--frames=-3:") == 0
    assert "3 units" in capsys.readouterr().out


def test_scene_of_a_recording_without_scenes(recording: Path, tmp_path: Path) -> None:
    assert refused(recording, tmp_path / "drive", scene="scene-0061").code == "no-scenes"


def test_command_refuses_contradictions(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        command(str(recording), "--out", str(tmp_path / "drive"), "--copy", "--link")
    assert "not allowed with" in capsys.readouterr().err
