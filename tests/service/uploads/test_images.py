from __future__ import annotations

import struct
import tracemalloc
import zlib
from pathlib import Path

import pytest

from mrasfm_engine.errors import InputError
from mrasfm_engine.io.image_header import read_header
from schemas.image_header import MAX_IMAGE_PIXELS, ImageHeaderError, ImageKind, header_of
from service.errors import ServiceError
from service.storage.uploads.images import check_image


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, *, extra: bytes = b"", pixels: bytes = b"") -> bytes:
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + extra + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def jpeg(width: int, height: int, *, before: bytes = b"", after: bytes = b"\xff\xd9") -> bytes:
    frame = b"\xff\xc0" + struct.pack(">HBHHB", 17, 8, height, width, 3) + bytes(9)
    return b"\xff\xd8" + before + frame + b"\xff\xda" + struct.pack(">H", 8) + bytes(6) + b"scan" + after


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "0123.part"


@pytest.mark.parametrize("data", [png(1920, 1080), jpeg(1920, 1080)])
def test_images(file: Path, data: bytes) -> None:
    file.write_bytes(data)
    header = check_image(file, "front/0.png")
    assert (header.width, header.height, header.kind, header.bits) == (1920, 1080, ImageKind.RGB, 8)
    assert header.complete
    file.write_bytes(data[:-8])
    assert not check_image(file, "front/0.png").complete


@pytest.mark.parametrize(
    ("data", "code", "words"),
    [
        (b"", "empty-file", "is empty (0 bytes)"),
        (b"GIF89a.....", "not-an-image", "is neither a JPEG nor a PNG file"),
        (b"\x89PNG\r\n\x1a\n" + bytes(40), "damaged-image", "has a damaged header"),
        (b"\xff\xd8\xff\xe0", "damaged-image", "has a damaged header"),
        (b"\xff\xd8" + b"\xff" * 50_000, "damaged-image", "has a damaged header"),
        (b"\xff\xd8" + b"\xff\x01" * 50_000, "damaged-image", "has a damaged header"),
        (png(8, 8, extra=chunk(b"tEXt", b"") * 20_000), "damaged-image", "has a damaged header"),
        (png(60_000, 60_000), "image-too-large", "declares 60000x60000 pixels, the bound is 20000 a side"),
        (png(0, 10), "image-too-large", "declares 0x10 pixels"),
        (png(20_000, 10_001), "image-too-large", f"20000x10001 pixels, the bound is {MAX_IMAGE_PIXELS} in all"),
        (jpeg(20_000, 20_000), "image-too-large", f"20000x20000 pixels, the bound is {MAX_IMAGE_PIXELS} in all"),
    ],
)
def test_refused_with_the_engines_words(file: Path, data: bytes, code: str, words: str) -> None:
    file.write_bytes(data)
    with pytest.raises(ServiceError) as caught:
        check_image(file, "front/0.png")
    assert (caught.value.status, caught.value.code) == (422, code)
    assert caught.value.problem.detail.startswith("image front/0.png ")
    assert words in caught.value.problem.detail
    with pytest.raises(InputError) as engines:
        read_header(file)
    assert engines.value.code == code
    assert engines.value.what == caught.value.problem.detail.replace("front/0.png", str(file))
    assert engines.value.remedy == caught.value.problem.remedy
    with pytest.raises(ImageHeaderError) as pure:
        header_of(data, "front/0.png")
    assert (pure.value.what, pure.value.code) == (caught.value.problem.detail, code)


def test_the_largest_images(file: Path) -> None:
    file.write_bytes(png(20_000, 10_000))
    assert check_image(file, "front/0.png").width == 20_000


def test_the_first_exif_counts() -> None:
    def exif(orientation: int) -> bytes:
        tiff = b"II" + struct.pack("<HIHHHIHHI", 42, 8, 1, 0x0112, 3, 1, orientation, 0, 0)
        return b"\xff\xe1" + struct.pack(">H", len(tiff) + 8) + b"Exif\0\0" + tiff

    xmp = b"\xff\xe1" + struct.pack(">H", 6) + b"http"
    assert header_of(jpeg(4, 4, before=xmp + exif(6) + exif(3)), "a").orientation == 6
    assert header_of(jpeg(4, 4, before=xmp), "a").orientation == 1


@pytest.mark.parametrize("after", [b"", b"\xff\xd9" + bytes(1 << 20), bytes((1 << 20) - 5) + b"\xff\xd9" + bytes(5000)])
def test_the_end_marker_is_sought_in_constant_memory(file: Path, after: bytes) -> None:
    file.write_bytes(jpeg(4, 4, after=bytes(20 << 20) + after))
    tracemalloc.start()
    try:
        header = check_image(file, "front/0.jpg")
        peak_bytes = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert header.complete == bool(after)
    assert 0 < peak_bytes < 5 << 20
