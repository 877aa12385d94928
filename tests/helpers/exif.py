"""EXIF of images, as cameras write it."""

from __future__ import annotations

from PIL import Image


def exif_of(
    *,
    time: str | None = None,
    subsecond: str | None = None,
    offset: str | None = None,
    place: tuple[float, float, float | None] | None = None,
    error_m: float | None = None,
) -> Image.Exif:
    """Time as `2026:03:04 10:11:12`, digits of its fraction, and latitude, longitude and height."""
    exif = Image.Exif()
    times = exif.get_ifd(0x8769)
    times.update({tag: text for tag, text in ((0x9003, time), (0x9291, subsecond), (0x9011, offset)) if text})
    if place is not None:
        gps = exif.get_ifd(0x8825)
        latitude, longitude, height = place
        gps.update({1: "N" if latitude >= 0 else "S", 2: _sexagesimal(latitude)})
        gps.update({3: "E" if longitude >= 0 else "W", 4: _sexagesimal(longitude)})
        if height is not None:
            gps.update({5: b"\1" if height < 0 else b"\0", 6: abs(height)})
        if error_m is not None:
            gps[31] = error_m
    return exif


def _sexagesimal(degrees: float) -> tuple[float, float, float]:
    whole, rest = divmod(abs(degrees), 1.0)
    minutes, rest = divmod(rest * 60.0, 1.0)
    return whole, minutes, rest * 60.0
