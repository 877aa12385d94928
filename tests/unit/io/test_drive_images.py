from __future__ import annotations

import os
import struct
import tracemalloc
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from mrasfm_engine.errors import InputError
from mrasfm_engine.io.image_header import ImageKind, read_header
from mrasfm_engine.io.images import read_image_gray, read_image_rgb, read_mask
from schemas import LabelMap, SemanticClass


@pytest.fixture
def picture() -> np.ndarray:
    rng = np.random.default_rng(2)
    return cv2.GaussianBlur(rng.integers(0, 256, (40, 60, 3), dtype=np.uint8), (0, 0), 2)  # blue, green, red


def exif(orientation: int, order: str = "<") -> bytes:
    head = b"II" if order == "<" else b"MM"
    entry = struct.pack(order + "HHIHH", 0x0112, 3, 1, orientation, 0)
    return head + struct.pack(order + "HIH", 42, 8, 1) + entry + struct.pack(order + "I", 0)


def png_chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def jpeg_with_exif(data: bytes, tiff: bytes) -> bytes:
    segment = b"Exif\0\0" + tiff
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + data[2:]


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_header(tmp_path: Path, picture: np.ndarray, suffix: str) -> None:
    file = tmp_path / f"a{suffix}"
    cv2.imwrite(str(file), picture)
    header = read_header(file)
    assert (header.width, header.height, header.bits, header.orientation) == (60, 40, 8, 1)
    assert header.kind is ImageKind.RGB
    assert header.complete
    cv2.imwrite(str(file), picture[..., 0])
    assert read_header(file).kind is ImageKind.GRAY


def test_colours_and_gray_are_right(tmp_path: Path, picture: np.ndarray) -> None:
    file = tmp_path / "a.png"
    cv2.imwrite(str(file), picture)
    np.testing.assert_array_equal(read_image_rgb(file), picture[..., ::-1])
    assert read_image_rgb(file).flags.c_contiguous
    luma = picture.astype(float) @ [0.114, 0.587, 0.299]
    difference = np.abs(read_image_gray(file) - luma).max()
    assert 0 < difference < 1.0


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_16_bits_scale_by_257(tmp_path: Path, channels: int) -> None:
    values = np.arange(256, dtype=np.uint16).reshape(16, 16) * 257
    file = tmp_path / "deep.png"
    image = values if channels == 1 else np.repeat(values[..., None], channels, axis=2)
    cv2.imwrite(str(file), image)
    assert read_header(file).bits == 16
    expected = np.arange(256).reshape(16, 16)
    np.testing.assert_array_equal(read_image_gray(file), expected)
    np.testing.assert_array_equal(read_image_rgb(file), np.repeat(expected[..., None], 3, axis=2))
    assert read_image_gray(file).dtype == np.uint8


def test_16_bits_are_rounded(tmp_path: Path) -> None:
    file = tmp_path / "deep.png"
    cv2.imwrite(str(file), np.array([[128, 129, 257 * 10 + 200, 65535, 65406]], np.uint16))
    np.testing.assert_array_equal(read_image_gray(file), [[0, 1, 11, 255, 254]])


def test_alpha_is_dropped_not_blended(tmp_path: Path, picture: np.ndarray) -> None:
    file = tmp_path / "alpha.png"
    transparent = np.zeros((40, 60, 1), np.uint8)
    cv2.imwrite(str(file), np.concatenate([picture, transparent], axis=2))
    assert read_header(file).kind is ImageKind.RGBA
    np.testing.assert_array_equal(read_image_rgb(file), picture[..., ::-1])


def test_palette_gives_colours(tmp_path: Path) -> None:
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", 2, 1, 8, 3, 0, 0, 0))
    palette = png_chunk(b"PLTE", bytes([10, 20, 30, 200, 100, 50]))
    pixels = png_chunk(b"IDAT", zlib.compress(bytes([0, 0, 1])))
    file = tmp_path / "palette.png"
    file.write_bytes(b"\x89PNG\r\n\x1a\n" + header + palette + pixels + png_chunk(b"IEND", b""))
    assert read_header(file).kind is ImageKind.PALETTE
    np.testing.assert_array_equal(read_image_rgb(file), [[[10, 20, 30], [200, 100, 50]]])
    with pytest.raises(InputError, match="palette"):
        read_mask(file)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_orientation_is_seen_and_not_applied(tmp_path: Path, picture: np.ndarray, suffix: str, order: str) -> None:
    data = cv2.imencode(suffix, picture)[1].tobytes()
    tiff = exif(6, order)
    turned = jpeg_with_exif(data, tiff) if suffix == ".jpg" else data[:33] + png_chunk(b"eXIf", tiff) + data[33:]
    file = tmp_path / f"turned{suffix}"
    file.write_bytes(turned)
    assert read_header(file).orientation == 6
    assert read_image_gray(file).shape == (40, 60)
    assert read_image_rgb(file).shape == (40, 60, 3)


@pytest.mark.parametrize("tiff", [b"", b"II", b"II*\0\xff\xff\xff\xff", b"XX*\0\x08\0\0\0", exif(77), exif(6)[:-8]])
def test_broken_exif_counts_as_upright(tmp_path: Path, picture: np.ndarray, tiff: bytes) -> None:
    file = tmp_path / "a.jpg"
    file.write_bytes(jpeg_with_exif(cv2.imencode(".jpg", picture)[1].tobytes(), tiff))
    assert read_header(file).orientation == 1


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("kept", [0.5, 0.9, 0.999])
def test_truncated_file_is_refused(tmp_path: Path, picture: np.ndarray, suffix: str, kept: float) -> None:
    data = cv2.imencode(suffix, picture)[1].tobytes()
    file = tmp_path / f"cut{suffix}"
    file.write_bytes(data[: int(kept * len(data))])
    for read in (read_image_gray, read_image_rgb):
        with pytest.raises(InputError, match=str(file)) as caught:
            read(file)
        assert caught.value.code in ("truncated-image", "damaged-image")


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_every_truncated_header_is_refused(tmp_path: Path, picture: np.ndarray, suffix: str) -> None:
    data = cv2.imencode(suffix, picture)[1].tobytes()
    for size in range(1, 200):
        (tmp_path / "cut").write_bytes(data[:size])
        with pytest.raises(InputError):
            read_image_gray(tmp_path / "cut")


@pytest.mark.parametrize("padding", [1, 1000, 100_000])
def test_padding_after_the_end_is_accepted(tmp_path: Path, picture: np.ndarray, padding: int) -> None:
    for suffix in (".png", ".jpg"):
        file = tmp_path / f"padded{suffix}"
        file.write_bytes(cv2.imencode(suffix, picture)[1].tobytes() + b"\0" * padding)
        assert read_header(file).complete
        assert read_image_gray(file).shape == (40, 60)


def test_damaged_png_is_refused(tmp_path: Path, picture: np.ndarray, capfd: pytest.CaptureFixture[str]) -> None:
    data = bytearray(cv2.imencode(".png", picture)[1].tobytes())
    data[len(data) // 2] ^= 0x55
    file = tmp_path / "damaged.png"
    file.write_bytes(data)
    with pytest.raises(InputError, match="damaged") as caught:
        read_image_gray(file)
    assert caught.value.code == "corrupt-image"
    capfd.readouterr()  # the decoder's own complaint


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (b"", "empty-file"),
        (b"hello, this is text", "not-an-image"),
        (b"GIF89a" + b"\0" * 50, "not-an-image"),
        (b"\x89PNG\r\n\x1a\n" + b"\0" * 50, "damaged-image"),
        (b"\xff\xd8\xff\xd9", "damaged-image"),
        (b"\xff\xd8\xff\xe0\x00\x00", "damaged-image"),
    ],
)
def test_what_is_no_image_is_refused(tmp_path: Path, content: bytes, code: str) -> None:
    file = tmp_path / "a.png"
    file.write_bytes(content)
    with pytest.raises(InputError, match=str(file)) as caught:
        read_image_rgb(file)
    assert caught.value.code == code


def test_declared_size_is_bounded_before_decoding(tmp_path: Path) -> None:
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", 2_000_000, 2_000_000, 8, 2, 0, 0, 0))
    file = tmp_path / "bomb.png"
    file.write_bytes(b"\x89PNG\r\n\x1a\n" + header + png_chunk(b"IDAT", b"") + png_chunk(b"IEND", b""))
    with pytest.raises(InputError, match="2000000x2000000") as caught:
        read_image_gray(file)
    assert caught.value.code == "image-too-large"


def test_places_without_a_file(tmp_path: Path) -> None:
    for path, code in ((tmp_path / "no.png", "missing-file"), (tmp_path, "not-a-file")):
        with pytest.raises(InputError) as caught:
            read_image_gray(path)
        assert caught.value.code == code
    os.mkfifo(tmp_path / "pipe.png")
    with pytest.raises(InputError, match="not a regular file"):
        read_image_gray(tmp_path / "pipe.png")  # would otherwise wait for ever


def test_mask_ids(tmp_path: Path) -> None:
    file = tmp_path / "m.png"
    mask = np.arange(20, dtype=np.uint8).reshape(4, 5)
    cv2.imwrite(str(file), mask)
    np.testing.assert_array_equal(read_mask(file), mask)
    labels = LabelMap(ids=dict.fromkeys(range(18), SemanticClass.STATIC))
    with pytest.raises(InputError, match="does not have: 18, 19") as caught:
        read_mask(file, labels)
    assert caught.value.code == "unknown-label"
    mask[0, 0] = 20
    cv2.imwrite(str(file), mask)
    with pytest.raises(InputError, match="does not have: 20"):
        read_mask(file)


def test_the_check_of_a_mask_takes_little_memory(tmp_path: Path) -> None:
    """A mask of 200 megapixels has 200 kB as a file, and several are read at once."""
    file, pixels = tmp_path / "m.png", 2_000_000
    cv2.imwrite(str(file), np.full((1000, pixels // 1000), 7, np.uint8))
    read_mask(file)
    tracemalloc.start()
    try:
        read_mask(file)
        assert tracemalloc.get_traced_memory()[1] < 3 * pixels
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("name", "dtype", "channels", "found"),
    [("m.png", np.uint8, 3, "rgb"), ("m.png", np.uint16, 1, "16 bits"), ("m.jpg", np.uint8, 1, "JPEG")],
)
def test_masks_that_hold_no_ids(tmp_path: Path, name: str, dtype: type, channels: int, found: str) -> None:
    cv2.imwrite(str(tmp_path / name), np.zeros((4, 5, channels), dtype))
    with pytest.raises(InputError, match=found) as caught:
        read_mask(tmp_path / name)
    assert caught.value.code == "bad-mask"
