"""What is wrong with a drive is said before the long work, by name and with a remedy, and leaves nothing behind."""

from __future__ import annotations

import struct
from collections.abc import Callable

import cv2
import numpy as np
import pytest

from mrasfm_engine.cli import EXIT_BAD_INPUT
from mrasfm_engine.geometry import se3
from mrasfm_engine.scene.drive import matrix_from_pose, pose_from_matrix
from schemas import Pose
from tests.integration.conftest import WITHOUT_PICTURES, CommandResult, Document, Variant

Run = Callable[..., CommandResult]
FILE = "images/front/000002.jpg"


def refused(variant: Variant, run: Run, *options: str) -> str:
    """The error of a drive that is refused before the long work, with nothing written."""
    result = run("reconstruct", variant.root, "--out", variant.scene, *WITHOUT_PICTURES, *options)
    assert result.code == EXIT_BAD_INPUT
    assert "mrasfm: error: " in result.err
    assert "Traceback" not in result.err
    what, remedy = result.err[result.err.index("mrasfm: error: ") :].strip().splitlines()
    assert len(remedy.strip()) > 10
    assert not variant.scene.exists()
    assert list(variant.scene.parent.glob(".*")) == []
    return what + remedy


def _with_exif_orientation(jpeg: bytes, orientation: int) -> bytes:
    tiff = b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, orientation, 0, 0)
    segment = b"Exif\0\0" + tiff
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:]


def missing(variant: Variant) -> None:
    (variant.root / FILE).unlink()


def truncated(variant: Variant) -> None:
    variant.write(FILE, (variant.root / FILE).read_bytes()[:-2000])


def turned(variant: Variant) -> None:
    variant.write(FILE, _with_exif_orientation((variant.root / FILE).read_bytes(), 6))


def wrong_size(variant: Variant) -> None:
    variant.write(FILE, cv2.imencode(".jpg", np.zeros((100, 200, 3), np.uint8))[1].tobytes())


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (missing, "does not exist"),
        (truncated, "truncated"),
        (turned, "EXIF orientation 6"),
        (wrong_size, "has 200x100 pixels, the calibration of camera front is for 480x270"),
    ],
)
def test_damaged_image(variant: Variant, mrasfm: Run, damage: Callable[[Variant], None], words: str) -> None:
    damage(variant)
    message = refused(variant, mrasfm)
    assert words in message
    assert FILE in message


def unknown_camera(d: Document) -> None:
    d["frames"][0]["images"]["nose"] = d["frames"][0]["images"].pop("front")


def singular(d: Document) -> None:
    d["rig"]["cameras"][0]["params"][0] = 0


def not_a_number(d: Document) -> None:
    d["rig"]["cameras"][0]["params"][0] = float("nan")


def zero_quaternion(d: Document) -> None:
    d["rig"]["cameras"][1]["rig_from_cam"]["rotation_xyzw"] = [0, 0, 0, 0]


def time_goes_back(d: Document) -> None:
    d["frames"][3]["timestamp_us"] = d["frames"][1]["timestamp_us"]


def time_repeats(d: Document) -> None:
    d["frames"][3]["timestamp_us"] = d["frames"][2]["timestamp_us"]


def gnss_empty(d: Document) -> None:
    d["gnss"]["samples"] = []


def gnss_goes_back(d: Document) -> None:
    d["gnss"]["samples"].reverse()


def gnss_on_gps_time(d: Document) -> None:
    for sample in d["gnss"]["samples"]:
        sample["timestamp_us"] += 18_000_000


def sigma_zero(d: Document) -> None:
    d["gnss"]["samples"][0]["sigma_horizontal_m"] = 0


def sigma_nan(d: Document) -> None:
    d["gnss"]["samples"][0]["sigma_vertical_m"] = float("nan")


def one_frame(d: Document) -> None:
    d["frames"] = d["frames"][:1]


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (unknown_camera, "frames.0.images names camera 'nose'"),
        (singular, "rig.cameras.0.params: focal length fx = 0"),
        (not_a_number, "holds NaN"),
        (zero_quaternion, "rig.cameras.1.rig_from_cam.rotation_xyzw"),
        (time_goes_back, "frames.3.timestamp_us goes back"),
        (time_repeats, "frames.3.timestamp_us repeats"),
        (gnss_empty, "gnss.samples is empty"),
        (gnss_goes_back, "gnss.samples.1.timestamp_us goes back"),
        (gnss_on_gps_time, "18 s too late, as when one clock counts GPS time and the other UTC"),
        (sigma_zero, "gnss.samples.0.sigma_horizontal_m"),
        (sigma_nan, "holds NaN"),
        (one_frame, "has 1 frames with images"),
    ],
)
def test_damaged_manifest(variant: Variant, mrasfm: Run, damage: Callable[[Document], None], words: str) -> None:
    damage(variant.document)
    assert words in refused(variant.save(), mrasfm)


def test_exchanged_cameras(variant: Variant, mrasfm: Run) -> None:
    """Left and right exchanged are the inverse in the axes of a camera, and front and back of a car that reverses."""
    for frame in variant.document["frames"]:
        left, right = frame["images"]["left"], frame["images"]["right"]
        left["file"], right["file"] = right["file"], left["file"]
    message = refused(variant.save(), mrasfm)
    assert "rig_from_cam looks like its inverse" in message
    assert "or the images of cameras left and right look exchanged" in message
    assert "Exchange the files of left and right in all frames" in message


@pytest.mark.slow
def test_no_gnss_ignores_a_bad_receiver(variant: Variant, mrasfm: Run) -> None:
    gnss_on_gps_time(variant.document)
    variant.keep(cameras=["front", "left"], units=3)
    gnss_empty(variant.document)
    result = mrasfm("reconstruct", variant.save().root, "--out", variant.scene, *WITHOUT_PICTURES, "--no-gnss")
    assert (result.code, "georeferenced:    no" in result.out) == (0, True)


def test_calibration_given_as_its_inverse(variant: Variant, mrasfm: Run) -> None:
    for camera in variant.document["rig"]["cameras"]:
        rig_from_cam = matrix_from_pose(Pose(**camera["rig_from_cam"]))
        camera["rig_from_cam"] = pose_from_matrix(se3.inverse(rig_from_cam)).model_dump()
    assert "rig_from_cam looks like its inverse" in refused(variant.save(), mrasfm)


def test_one_camera_without_a_scale(variant: Variant, mrasfm: Run) -> None:
    variant.keep(cameras=["front"])
    assert "nothing gives the drive a scale" in refused(variant.save(), mrasfm, "--no-gnss")


def test_nothing_matches(variant: Variant, mrasfm: Run) -> None:
    rng = np.random.default_rng(0)
    variant.keep(cameras=["front", "left"], units=3)
    for file in variant.root.glob("images/*/*.jpg"):
        noise = rng.integers(0, 256, (270, 480, 3), dtype=np.uint8)
        variant.write(file.relative_to(variant.root).as_posix(), cv2.imencode(".jpg", noise)[1].tobytes())
    result = mrasfm("reconstruct", variant.save().root, "--out", variant.scene, *WITHOUT_PICTURES)
    assert result.code == EXIT_BAD_INPUT
    assert "nothing matches: none of" in result.err
    assert "Check that consecutive frames show the same scene" in result.err
    assert [path.name for path in variant.scene.iterdir()] == [".stages"]


@pytest.mark.slow
def test_oddities_are_warned_of_and_used(variant: Variant, mrasfm: Run) -> None:
    """An image that is not listed, one of 16 bits, one with alpha."""
    variant.keep(cameras=["front", "left"], units=4)
    frames = variant.document["frames"]
    for frame, name in ((frames[1], "deep"), (frames[2], "clear")):
        image = frame["images"]["front"]
        pixels = cv2.imread(str(variant.root / image["file"]))
        image["file"] = f"images/front/{name}.png"
        deep = pixels.astype(np.uint16) * 257
        clear = np.dstack([pixels, np.full(pixels.shape[:2], 128, np.uint8)])
        assert cv2.imwrite(str(variant.root / image["file"]), deep if name == "deep" else clear)
    result = mrasfm("reconstruct", variant.save().root, "--out", variant.scene, *WITHOUT_PICTURES, "--no-gnss")
    assert result.code == 0
    assert "units registered: 4 of 4" in result.out
    for words in (
        "warning: 1 images have 16 bits a channel and are read with the upper 8 of them: images/front/deep.png",
        "warning: 1 images have an alpha channel, which is ignored: images/front/clear.png",
        "warning: 2 images in the drive's folders are not in drive.json and are ignored: images/front/000001.jpg",
    ):
        assert words in result.out


@pytest.mark.slow
def test_two_frames(variant: Variant, mrasfm: Run) -> None:
    variant.keep(units=2)
    result = mrasfm("reconstruct", variant.save().root, "--out", variant.scene, *WITHOUT_PICTURES)
    assert result.code == 0
    assert "units registered: 2 of 2" in result.out
    assert "georeferenced:    no (only 2 registered units" in result.out


def test_one_camera_with_gnss(variant: Variant, mrasfm: Run) -> None:
    variant.keep(cameras=["front"])
    result = mrasfm("reconstruct", variant.save().root, "--out", variant.scene, *WITHOUT_PICTURES)
    assert result.code == 0
    assert "the drive's scale comes from GNSS alone" in result.out
