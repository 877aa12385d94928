"""Pixels are those that OpenCV gives for sound files, and files whose pixels are not all there give none."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from mrasfm_engine.errors import InputError
from mrasfm_engine.io.image_decoding import IncompleteImageError
from mrasfm_engine.io.images import read_image_gray, read_image_rgb, read_image_small, read_mask
from tests.helpers.damaged_images import cut, patched_frame, png_chunks, png_of_chunks

STORED = cv2.IMREAD_IGNORE_ORIENTATION
SAMPLINGS = {
    "411": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_411,
    "420": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420,
    "422": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422,
    "440": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_440,
    "444": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
}
VARIANTS = [(sampling, progressive, restart) for sampling in SAMPLINGS for progressive in (0, 1) for restart in (0, 4)]


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    """Of an odd size, with texture to the last row."""
    rng = np.random.default_rng(2)
    smooth = cv2.GaussianBlur(rng.integers(0, 256, (163, 241, 3), dtype=np.uint8), (0, 0), 2).astype(float)
    return np.clip(128 + 6 * (smooth - 128), 0, 255).astype(np.uint8)


def encoded(picture: np.ndarray, sampling: str = "420", progressive: int = 0, restart: int = 0) -> bytes:
    options = [
        *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, SAMPLINGS[sampling]),
        *(cv2.IMWRITE_JPEG_PROGRESSIVE, progressive),
        *(cv2.IMWRITE_JPEG_RST_INTERVAL, restart),
    ]
    return cv2.imencode(".jpg", picture, options)[1].tobytes()


def check_same_as_opencv(data: bytes, file: Path) -> None:
    file.write_bytes(data)
    given = np.frombuffer(data, np.uint8)
    np.testing.assert_array_equal(read_image_rgb(file), cv2.imdecode(given, cv2.IMREAD_COLOR | STORED)[..., ::-1])
    np.testing.assert_array_equal(read_image_gray(file), cv2.imdecode(given, cv2.IMREAD_GRAYSCALE | STORED))
    assert read_image_rgb(file).flags.c_contiguous


def check_refused(data: bytes, file: Path, code: str) -> None:
    file.write_bytes(data)
    for read in (read_image_gray, read_image_rgb):
        with pytest.raises(IncompleteImageError) as caught:
            read(file)
        assert caught.value.code == code
        assert str(file) in caught.value.what


@pytest.mark.parametrize(("sampling", "progressive", "restart"), VARIANTS)
def test_jpegs_of_all_kinds(tmp_path: Path, picture: np.ndarray, sampling: str, progressive: int, restart: int) -> None:
    data = encoded(picture, sampling, progressive, restart)
    check_same_as_opencv(data, tmp_path / "a.jpg")
    for kept in (0.2, 1 / 3, 0.7, 0.99):
        check_refused(cut(data, kept), tmp_path / "a.jpg", "truncated-image")


def test_gray_jpeg(tmp_path: Path, picture: np.ndarray) -> None:
    data = encoded(picture[..., 0])
    check_same_as_opencv(data, tmp_path / "a.jpg")
    check_refused(cut(data), tmp_path / "a.jpg", "truncated-image")


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("width_px", [100, 300])
@pytest.mark.parametrize("is_gray", [True, False])
def test_a_small_png_is_the_image_made_smaller(
    tmp_path: Path, picture: np.ndarray, is_gray: bool, width_px: int, bits: int
) -> None:
    file = tmp_path / "image.png"
    stored = picture[..., 0] if is_gray else picture
    assert cv2.imwrite(str(file), stored if bits == 8 else stored.astype(np.uint16) * 257)
    for colours, read in (("RGB", read_image_rgb), ("GRAY", read_image_gray)):
        whole = read(file)
        size = (width_px, round(163 * width_px / 241))
        expected = whole if width_px > 241 else cv2.resize(whole, size, interpolation=cv2.INTER_AREA)
        small = read_image_small(file, (241, 163), width_px, colours=colours)
        np.testing.assert_array_equal(small, expected)


def test_every_cut_is_noticed(tmp_path: Path, picture: np.ndarray) -> None:
    """Down to the last few pixels."""
    data = encoded(picture)
    begin = data.index(b"\xff\xda") + 14
    for size in [*range(begin + 10, len(data) - 2, 501), *range(len(data) - 12, len(data) - 4)]:
        check_refused(data[:size] + b"\xff\xd9", tmp_path / "a.jpg", "truncated-image")


@pytest.mark.parametrize("kept", [0.2, 1 / 3, 0.7, 0.99])
@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
def test_cut_png(
    tmp_path: Path, picture: np.ndarray, kept: float, channels: int, depth: type, capfd: pytest.CaptureFixture[str]
) -> None:
    image = np.dstack([picture, picture[..., 0]])[..., :channels].astype(depth)
    check_refused(cut(cv2.imencode(".png", image)[1].tobytes(), kept), tmp_path / "a.png", "truncated-image")
    capfd.readouterr()  # the decoder's own complaint


def test_png_whose_pixels_end_early_in_sound_chunks(
    tmp_path: Path, picture: np.ndarray, capfd: pytest.CaptureFixture[str]
) -> None:
    """As a writer leaves it that was stopped and closed the file."""
    chunks = png_chunks(cv2.imencode(".png", picture)[1].tobytes())
    pixels = b"".join(data for name, data in chunks if name == b"IDAT")
    for kept in (len(pixels) // 3, len(pixels) - 40):
        data = png_of_chunks([chunks[0], (b"IDAT", pixels[:kept]), (b"IEND", b"")])
        check_refused(data, tmp_path / "a.png", "truncated-image")
    capfd.readouterr()


def test_png_that_is_not_cut_but_damaged(
    tmp_path: Path, picture: np.ndarray, capfd: pytest.CaptureFixture[str]
) -> None:
    chunks = png_chunks(cv2.imencode(".png", picture)[1].tobytes())
    too_few = png_of_chunks([chunks[0], (b"IDAT", zlib.compress(bytes(300))), (b"IEND", b"")])
    not_zlib = png_of_chunks([chunks[0], (b"IDAT", b"no zlib at all"), (b"IEND", b"")])
    flipped = bytearray(cv2.imencode(".png", picture)[1].tobytes())
    flipped[len(flipped) // 2] ^= 0x10
    for data in (too_few, not_zlib, bytes(flipped)):
        check_refused(data, tmp_path / "a.png", "corrupt-image")
    capfd.readouterr()


def test_cut_mask(tmp_path: Path, picture: np.ndarray, capfd: pytest.CaptureFixture[str]) -> None:
    mask = (picture[..., 0] % 19).astype(np.uint8)
    (tmp_path / "m.png").write_bytes(cut(cv2.imencode(".png", mask)[1].tobytes()))
    with pytest.raises(InputError, match=r"m\.png is truncated"):
        read_mask(tmp_path / "m.png")
    capfd.readouterr()


@pytest.mark.parametrize("padding", [b"\0", b"\0" * 40, b"\0" * 3000, b"ends here"])
@pytest.mark.parametrize("progressive", [0, 1])
def test_padding_before_the_end_marker_is_harmless(
    tmp_path: Path, picture: np.ndarray, padding: bytes, progressive: int, capfd: pytest.CaptureFixture[str]
) -> None:
    data = encoded(picture, progressive=progressive)
    check_same_as_opencv(data[:-2] + padding + data[-2:], tmp_path / "a.jpg")
    capfd.readouterr()


def with_odd_scan(data: bytes) -> bytes:
    """Some cameras' scans do not say that they hold all frequencies."""
    scan = data.index(b"\xff\xda")
    at = scan + 5 + 2 * data[scan + 4] + 1
    return data[:at] + b"\0" + data[at + 1 :]


def with_unknown_version(data: bytes) -> bytes:
    at = data.index(b"JFIF\0") + 5
    return data[:at] + b"\2" + data[at + 1 :]


@pytest.mark.parametrize("oddity", [with_odd_scan, with_unknown_version])
def test_oddities_of_headers_are_harmless_and_hide_no_cut(
    tmp_path: Path, picture: np.ndarray, oddity: Callable[[bytes], bytes], capfd: pytest.CaptureFixture[str]
) -> None:
    data = oddity(encoded(picture))
    check_same_as_opencv(data, tmp_path / "a.jpg")
    for kept in (1 / 3, 0.95):
        check_refused(cut(data, kept), tmp_path / "a.jpg", "truncated-image")
    capfd.readouterr()


def test_subsampling_that_only_opencv_decodes(
    tmp_path: Path, picture: np.ndarray, capfd: pytest.CaptureFixture[str]
) -> None:
    """Three to one: the same bytes then are another picture, and too few for it or too many."""
    small = np.ascontiguousarray(picture[:128, :192])
    data = patched_frame(encoded(small), sampling=0x31)
    (tmp_path / "a.jpg").write_bytes(data)
    given = np.frombuffer(data, np.uint8)
    np.testing.assert_array_equal(
        read_image_rgb(tmp_path / "a.jpg"), cv2.imdecode(given, cv2.IMREAD_COLOR | STORED)[..., ::-1]
    )
    check_refused(cut(data), tmp_path / "a.jpg", "truncated-image")
    capfd.readouterr()


@pytest.mark.parametrize("filled", [0x00, 0x11, 0x55])
def test_a_lost_end_is_no_padding(tmp_path: Path, filled: int, capfd: pytest.CaptureFixture[str]) -> None:
    """A file whose second half was never written has restart markers and padding: libjpeg speaks of the latter."""
    picture = np.random.default_rng(3).integers(0, 256, (96, 128, 3), dtype=np.uint8)
    data = bytearray(encoded(picture, restart=4))
    half = len(data) // 2
    data[half:-2] = bytes([filled]) * (len(data) - 2 - half)
    check_refused(bytes(data), tmp_path / "a.jpg", "truncated-image")
    capfd.readouterr()


def test_lost_data_between_restarts(tmp_path: Path, picture: np.ndarray, capfd: pytest.CaptureFixture[str]) -> None:
    """As where packets of a stream were lost: pixels are missing in the middle."""
    data = encoded(picture, restart=4)
    first, second = data.index(b"\xff\xd1"), data.index(b"\xff\xd3")
    check_refused(data[:first] + data[second:], tmp_path / "a.jpg", "corrupt-image")
    capfd.readouterr()


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_orientation_is_not_applied(tmp_path: Path, picture: np.ndarray, orientation: int) -> None:
    tiff = b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, orientation, 0, 0)
    segment = b"Exif\0\0" + tiff
    data = encoded(picture)
    data = data[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + data[2:]
    check_same_as_opencv(data, tmp_path / "a.jpg")


def test_a_thumbnail_in_the_header_is_no_end(tmp_path: Path, picture: np.ndarray) -> None:
    """It has an end marker of its own."""
    thumbnail = b"Exif\0\0" + encoded(picture[:32, :48])
    data = encoded(picture)
    data = data[:2] + b"\xff\xe1" + struct.pack(">H", len(thumbnail) + 2) + thumbnail + data[2:]
    check_same_as_opencv(data, tmp_path / "a.jpg")
    check_refused(cut(data, 0.8), tmp_path / "a.jpg", "truncated-image")
