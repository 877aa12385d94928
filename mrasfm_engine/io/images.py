"""Decodes images and masks; what cannot be trusted is refused by name."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.errors import InputError
from mrasfm_engine.io.image_decoding import Colours, decode_jpeg, decode_jpeg_small, decode_png
from mrasfm_engine.io.image_header import ImageHeader, ImageKind, header_of, open_regular, read_header
from mrasfm_engine.types import Bytes
from schemas import LabelMap

SENSOR_BITS = (8, 10, 12, 14)  # of sensors whose drivers fill the lower bits of 16


def unused_bits(largest: int) -> int:
    """Bits by which values of 16 bits are too small where a sensor of fewer bits fills the lower ones."""
    bits = next((bits for bits in SENSOR_BITS if largest >> bits == 0), 16)
    return 16 - bits if largest else 0


def read_largest_of_16_bits(path: Path) -> int:
    """Largest value of an image of 16 bits a channel, without its alpha channel; 0 of all others.

    Raises
    ------
    InputError
        As `read_image_gray`.
    """
    if read_header(Path(path)).bits != 16:
        return 0
    data, header = _load(path)
    image = decode_png(data, cv2.IMREAD_UNCHANGED, header, path)
    return int((image if image.ndim == 2 else image[..., :3]).max())


def read_image_gray(path: Path) -> Bytes:
    """An image as (height, width) uint8, as it is stored: EXIF's orientation is not applied.

    16 bits are scaled to 8, an alpha channel is dropped.

    Raises
    ------
    IncompleteImageError
        That names the file, if some of its pixels are missing or corrupt.
    InputError
        That names the file, if it is missing, truncated, damaged or no JPEG or PNG.
    """
    data, header = _load(path)
    if header.format == "JPEG":
        return decode_jpeg(data, "GRAY", header, path)
    if not _needs_conversion(header):
        return _to_8_bits(decode_png(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION, header, path))
    image = _to_8_bits(decode_png(data, cv2.IMREAD_UNCHANGED, header, path))
    if image.ndim == 2:
        return image
    return np.asarray(cv2.cvtColor(image[..., :3], cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def read_image_rgb(path: Path) -> Bytes:
    """An image as (height, width, 3) uint8, red, green, blue; else as `read_image_gray`."""
    data, header = _load(path)
    if header.format == "JPEG":
        return decode_jpeg(data, "RGB", header, path)
    if _needs_conversion(header):
        image = _to_8_bits(decode_png(data, cv2.IMREAD_UNCHANGED, header, path))
    elif header.kind is ImageKind.GRAY:
        image = _to_8_bits(decode_png(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION, header, path))
    else:
        flags = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
        return _to_8_bits(decode_png(data, flags, header, path))
    if image.ndim == 2:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
    return np.ascontiguousarray(image[..., 2::-1])


def read_image_small(path: Path, size_px: tuple[int, int], width_px: int, *, colours: Colours = "RGB") -> Bytes | None:
    """An image as `read_image_rgb` or `read_image_gray`, at a width of `width_px` at most.

    A JPEG is not decoded to its full size.

    Returns
    -------
    None if the image is not of `size_px`, width and height.
    """
    data, header = _load(path)
    if (header.width, header.height) != size_px:
        return None
    image = decode_jpeg_small(data, colours, width_px) if header.format == "JPEG" else None
    if image is None:
        # Of three equal channels one is made smaller.
        is_gray = colours == "GRAY" or (header.kind is ImageKind.GRAY and not _needs_conversion(header))
        image = read_image_gray(path) if is_gray else read_image_rgb(path)
    if header.width > width_px:
        size = (width_px, max(1, round(header.height * width_px / header.width)))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    if colours == "RGB" and image.ndim == 2:
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
    return image


def read_mask(path: Path, label_map: LabelMap | None = None) -> Bytes:
    """A semantic mask as (height, width) uint8 ids.

    Parameters
    ----------
    label_map
        What ids may occur; Cityscapes' train ids if None.

    Raises
    ------
    InputError
        That names the file, if it is not a complete PNG with one channel of 8 bits, or holds an id that the label map
        does not have.
    """
    data, header = _load(path)
    check_mask_header(header, path)
    mask = _to_8_bits(decode_png(data, cv2.IMREAD_UNCHANGED, header, path))
    ids = (LabelMap.cityscapes() if label_map is None else label_map).ids
    # numpy's bincount would take eight bytes a pixel, and several masks are read at once.
    counts = cv2.calcHist([mask], [0], None, [256], [0.0, 256.0])
    unknown = [i for i in np.flatnonzero(counts) if int(i) not in ids]
    if unknown:
        raise InputError(
            f"mask {path} holds ids that the label map does not have: {', '.join(str(i) for i in unknown[:10])}",
            remedy="Add them to label_map.ids in drive.json (without a label_map, ids are Cityscapes' train ids 0 to "
            "18, and 19 for unlabelled).",
            code="unknown-label",
        )
    return mask


def mask_png(mask: Bytes) -> Bytes:
    """A mask (h, w) of ids as the bytes (b,) of a PNG, much smaller than its pixels."""
    # Masks are large areas: more effort would take longer and save little.
    return np.asarray(cv2.imencode(".png", mask, [cv2.IMWRITE_PNG_COMPRESSION, 3])[1], dtype=np.uint8).ravel()


def mask_of_png(png: Bytes) -> Bytes:
    """The mask (h, w) of ids that `mask_png` made bytes (b,) of."""
    return np.asarray(cv2.imdecode(png, cv2.IMREAD_UNCHANGED), dtype=np.uint8)


def check_mask_header(header: ImageHeader, path: Path) -> None:
    """Refuse masks whose pixels are not ids.

    Raises
    ------
    InputError
        If the mask is not a PNG with one channel of 8 bits.
    """
    if header.format == "PNG" and header.kind is ImageKind.GRAY and header.bits == 8:
        return
    if header.format == "JPEG":
        found = "JPEG, which alters ids"
    else:
        found = f"PNG with {header.kind} pixels of {header.bits} bits a channel"
    raise InputError(
        f"mask {path} is a {found}",
        remedy="Save masks as PNG with one gray channel of 8 bits that holds one id a pixel.",
        code="bad-mask",
    )


def check_image_header(header: ImageHeader, path: Path) -> None:
    """Refuse images that would be decoded wrongly or in part.

    Raises
    ------
    InputError
        If the file is truncated, or holds CMYK or over 8 bits in JPEG.
    """
    if not header.complete:
        raise InputError(
            f"image {path} is truncated: its end marker is missing",
            remedy="Copy it again from its source.",
            code="truncated-image",
        )
    if header.kind is ImageKind.CMYK or (header.format == "JPEG" and header.bits != 8):
        raise InputError(
            f"image {path} is a JPEG with {header.kind} pixels of {header.bits} bits, which is not supported",
            remedy="Convert it to an RGB or gray JPEG of 8 bits, or to PNG.",
            code="unsupported-image",
        )


def _needs_conversion(header: ImageHeader) -> bool:
    return header.bits == 16 or header.kind in (ImageKind.RGBA, ImageKind.GRAY_ALPHA)


def _load(path: Path) -> tuple[Bytes, ImageHeader]:
    path = Path(path)
    try:
        with open_regular(path) as stream:
            data = stream.read()
    except OSError as error:
        raise InputError(
            f"image {path} cannot be read: {error.strerror}", remedy="Check its permissions.", code="unreadable-file"
        ) from error
    header = header_of(data, path)
    check_image_header(header, path)
    return np.frombuffer(data, dtype=np.uint8), header


def _to_8_bits(image: Bytes | NDArray[np.uint16]) -> Bytes:
    if image.dtype == np.uint16:
        return ((image.astype(np.uint32) + 128) // 257).astype(np.uint8)
    return image.astype(np.uint8, copy=False)
