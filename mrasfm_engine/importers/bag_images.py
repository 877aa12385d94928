"""Images of a bag as files: compressed ones with the bytes that they have, raw ones as PNG without loss.

image_transport compresses a sensor's Bayer pattern as it is, as a gray image: of such ones the colours become a PNG.
"""

from __future__ import annotations

import re
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.errors import InputError
from schemas.drive import MAX_IMAGE_SIDE_PX
from schemas.image_header import ImageHeader, ImageHeaderError, ImageKind, header_of

# By ROS's encoding: type of a channel, channels, and OpenCV's conversion to gray or BGR.
_ENCODINGS: dict[str, tuple[str, int, int | None]] = {
    "mono8": ("u1", 1, None),
    "8UC1": ("u1", 1, None),
    "mono16": ("u2", 1, None),
    "bgr8": ("u1", 3, None),
    "8UC3": ("u1", 3, None),
    "rgb8": ("u1", 3, cv2.COLOR_RGB2BGR),
    "bgra8": ("u1", 4, cv2.COLOR_BGRA2BGR),
    "8UC4": ("u1", 4, cv2.COLOR_BGRA2BGR),
    "rgba8": ("u1", 4, cv2.COLOR_RGBA2BGR),
    "bgr16": ("u2", 3, None),
    "rgb16": ("u2", 3, cv2.COLOR_RGB2BGR),
    # OpenCV names a Bayer pattern by its second row's second and third pixel, ROS by its first row's first two.
    "bayer_rggb8": ("u1", 1, cv2.COLOR_BayerBG2BGR),
    "bayer_bggr8": ("u1", 1, cv2.COLOR_BayerRG2BGR),
    "bayer_gbrg8": ("u1", 1, cv2.COLOR_BayerGR2BGR),
    "bayer_grbg8": ("u1", 1, cv2.COLOR_BayerGB2BGR),
    "bayer_rggb16": ("u2", 1, cv2.COLOR_BayerBG2BGR),
    "bayer_bggr16": ("u2", 1, cv2.COLOR_BayerRG2BGR),
    "bayer_gbrg16": ("u2", 1, cv2.COLOR_BayerGR2BGR),
    "bayer_grbg16": ("u2", 1, cv2.COLOR_BayerGB2BGR),
    "yuv422": ("u1", 2, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": ("u1", 2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": ("u1", 2, cv2.COLOR_YUV2BGR_YUY2),
    "yuyv": ("u1", 2, cv2.COLOR_YUV2BGR_YUY2),
}
DEPTH_ENCODINGS = frozenset({"16UC1", "32FC1"})  # ROS's images of distances
SUBSAMPLED = frozenset({"yuv422", "uyvy", "yuv422_yuy2", "yuyv"})  # two pixels share their colour
# A compressed image's format: the encoding that was compressed and, where it was converted before, to which one.
_COMPRESSED = re.compile(r"([^;\s]*)\s*;.*compressed\s*(\S*)\s*")
PNG_EFFORT = 1  # of 9: more makes files a few percent smaller and takes several times as long


def is_raw(message: Any) -> bool:
    """Return whether the message is an Image, not a CompressedImage."""
    return hasattr(message, "encoding")


def holds_depth(message: Any) -> bool:
    """Return whether the message is an image of distances; a compressed one says first what was compressed."""
    kind = message.encoding if is_raw(message) else str(message.format).partition(";")[0].strip()
    return kind in DEPTH_ENCODINGS


def size_and_suffix(message: Any, *, topic: str) -> tuple[tuple[int, int], str]:
    """Width and height of an image, and the suffix of its file; nothing is decoded.

    Raises
    ------
    InputError
        If it is in a form that is not known.
    """
    if is_raw(message):
        if message.encoding not in _ENCODINGS:
            raise InputError(
                f"{topic}: images are encoded as {message.encoding!r}, which is not known",
                remedy=f"Record one of {', '.join(_ENCODINGS)}, or compressed images.",
                code="unknown-encoding",
            )
        if not (0 < message.width <= MAX_IMAGE_SIDE_PX and 0 < message.height <= MAX_IMAGE_SIDE_PX):
            raise InputError(
                f"{topic}: an image of {message.width}x{message.height} pixels",
                remedy="Record the topic again.",
                code="bad-image",
            )
        if message.encoding in SUBSAMPLED and message.width % 2:
            raise InputError(
                f"{topic}: an image of {message.width} columns as {message.encoding}, which has pairs of them",
                remedy="Record the topic again, or in another encoding.",
                code="bad-image",
            )
        return (int(message.width), int(message.height)), ".png"
    if holds_depth(message):
        raise InputError(
            f"{topic}: compressed as {str(message.format)[:60]!r}, which holds distances",
            remedy="Name the topics of images with --topics.",
            code="unknown-encoding",
        )
    try:
        header = header_of(message.data.tobytes(), topic)
    except ImageHeaderError as error:
        raise InputError(
            f"{topic}: compressed as {str(message.format)[:60]!r}: {error.what}",
            remedy="Record JPEG or PNG, or raw images.",
            code="unknown-encoding",
        ) from None
    size = (header.width, header.height)
    if _bayer_conversion(message, header) is None:
        return size, ".jpg" if header.format == "JPEG" else ".png"
    if not header.complete:
        raise _damaged(topic)
    return size, ".png"


def _bayer_conversion(message: Any, header: ImageHeader) -> int | None:
    """OpenCV's conversion to BGR of a compressed image that is a Bayer pattern still; None of all others."""
    described = _COMPRESSED.fullmatch(str(message.format))
    if described is None or header.kind is not ImageKind.GRAY:
        return None
    encoding = described[2] or described[1]
    return _ENCODINGS[encoding][2] if encoding.startswith("bayer_") and encoding in _ENCODINGS else None


def _damaged(topic: str) -> InputError:
    return InputError(f"{topic}: a compressed image is damaged", remedy="Record the topic again.", code="bad-image")


def largest_value(message: Any, *, topic: str) -> int:
    """Largest value of a raw image of 16 bits; 0 of all others.

    Raises
    ------
    InputError
        If the image is shorter than its size says.
    """
    if not is_raw(message) or _ENCODINGS[message.encoding][0] != "u2":
        return 0
    return int(_values(message, topic).max())


def file_content(message: Any, *, topic: str, shift: int = 0) -> bytes:
    """Bytes of a JPEG or PNG file of the image.

    Parameters
    ----------
    shift
        Bits by which values of 16 bits are raised.

    Raises
    ------
    InputError
        If a raw image is shorter than its size says, or a compressed Bayer pattern is damaged.
    """
    if not is_raw(message):
        content: bytes = message.data.tobytes()
        conversion = _bayer_conversion(message, header_of(content, topic))
        return content if conversion is None else _png(_colours(content, conversion, topic), topic)
    pixels = _pixels(message, topic)
    return _png(pixels << shift if shift else pixels, topic)


def _colours(content: bytes, conversion: int, topic: str) -> NDArray[Any]:
    try:
        pattern = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
        if pattern is not None:
            return np.asarray(cv2.cvtColor(pattern, conversion))
    except cv2.error:
        pass
    raise _damaged(topic)


def _png(pixels: NDArray[Any], topic: str) -> bytes:
    done, encoded = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, PNG_EFFORT])
    if not done:
        raise InputError(f"{topic}: an image could not be written as PNG", remedy="Record the topic again.")
    return encoded.tobytes()


def _pixels(message: Any, topic: str) -> NDArray[Any]:
    """Gray values (h, w) or blue, green, red (h, w, 3), of 8 or 16 bits."""
    conversion, values = _ENCODINGS[message.encoding][2], _values(message, topic)
    return values if conversion is None else cv2.cvtColor(values, conversion)


def _values(message: Any, topic: str) -> NDArray[Any]:
    """Values (h, w) or (h, w, channels) as they were sent."""
    kind, channels, _ = _ENCODINGS[message.encoding]
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    height, width, step = int(message.height), int(message.width), int(message.step)
    row_bytes = width * channels * dtype.itemsize
    if step < row_bytes or len(message.data) < step * (height - 1) + row_bytes:
        raise InputError(
            f"{topic}: an image of {width}x{height} pixels as {message.encoding} has {len(message.data)} bytes in rows "
            f"of {step}",
            remedy="Record the topic again.",
            code="bad-image",
        )
    rows = np.lib.stride_tricks.as_strided(message.data, (height, row_bytes), (step, 1), writeable=False)
    pixels = np.ascontiguousarray(rows).view(dtype).astype(dtype.newbyteorder("="))
    return pixels.reshape((height, width) if channels == 1 else (height, width, channels))
