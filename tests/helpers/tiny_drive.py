"""A drive of 2 cameras and 3 frames whose images are a few hundred bytes: valid for the API and for the engine."""

from __future__ import annotations

import hashlib
import io
import json
import struct
import zipfile
import zlib
from dataclasses import dataclass, field
from typing import Any

WIDTH, HEIGHT = 64, 48
CAMERAS = ("front", "rear")
FRAMES = 3


@dataclass(frozen=True)
class TinyDrive:
    """A manifest and the bytes of the files that it names."""

    manifest: dict[str, Any]
    files: dict[str, bytes] = field(repr=False)

    @property
    def raw(self) -> bytes:
        return json.dumps(self.manifest).encode()

    @property
    def declaration(self) -> dict[str, Any]:
        described = [
            {"path": path, "size_bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
            for path, data in self.files.items()
        ]
        return {"files": described}

    def zipped(self, **others: bytes) -> bytes:
        return zip_of({**self.files, **others})


def png(width: int = WIDTH, height: int = HEIGHT, *, seed: str = "") -> bytes:
    """A gray PNG whose pixels depend on the seed."""
    noise = hashlib.sha256(seed.encode()).digest()
    row = b"\0" + (noise * (width // len(noise) + 1))[:width]
    return png_of(width, height, zlib.compress(row * height))


def png_of(width: int, height: int, pixels: bytes) -> bytes:
    """A gray PNG with any compressed pixels; only its header is right."""
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", header) + _chunk(b"IDAT", pixels) + _chunk(b"IEND", b"")


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def tiny_drive(name: str = "tiny", *, seed: str = "", frames: int = FRAMES) -> TinyDrive:
    """A drive whose images differ from those of every other seed."""
    files = {f"{camera}/{i:06d}.png": png(seed=f"{seed}/{camera}/{i}") for i in range(frames) for camera in CAMERAS}
    return TinyDrive(manifest(name, frames=frames), files)


def manifest(name: str = "tiny", *, frames: int = FRAMES) -> dict[str, Any]:
    """A manifest that the engine's check passes."""
    return {
        "version": 1,
        "name": name,
        "rig": {"cameras": [_camera(name, i) for i, name in enumerate(CAMERAS)]},
        "frames": [_frame(i) for i in range(frames)],
    }


def _camera(name: str, i: int) -> dict[str, Any]:
    # Columns are the camera's axes on the vehicle: x right, y down, z forward; the second one looks back.
    rotation = [-0.5, 0.5, -0.5, 0.5] if i == 0 else [0.5, 0.5, -0.5, -0.5]
    return {
        "name": name,
        "model": "PINHOLE",
        "width": WIDTH,
        "height": HEIGHT,
        "params": [50.0, 50.0, WIDTH / 2, HEIGHT / 2],
        "rig_from_cam": {"rotation_xyzw": rotation, "translation_m": [1.0 - 2.0 * i, 0.0, 1.5]},
    }


def _frame(i: int) -> dict[str, Any]:
    images = {camera: {"file": f"{camera}/{i:06d}.png"} for camera in CAMERAS}
    return {"timestamp_us": 1_000_000 + 100_000 * i, "source_frame": i, "images": images}


def zip_of(files: dict[str, bytes]) -> bytes:
    """A zip archive with these entries."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for path, data in files.items():
            archive.writestr(path, data)
    return buffer.getvalue()
