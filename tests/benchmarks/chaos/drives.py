"""Drives to send: rendered once, and then with other bytes and the same pixels each time."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mrasfm_engine.synthetic.drive_writer import render_drives
from mrasfm_engine.synthetic.options import SynthOptions

# The smallest two drives along one street that are reconstructed in seconds and become one map.
PAIR = SynthOptions(cameras=2, units=6, seed=3, drives=2, width=320, height=180, texture_px=128, masks=False)
_COMMENT = b"\xff\xfe"  # a JPEG's segment that no decoder looks at
_START_BYTES = 2  # of every JPEG


@dataclass(frozen=True)
class Sendable:
    """A manifest, byte for byte, and the bytes of the files that it names."""

    name: str
    manifest: bytes
    files: Mapping[str, bytes]

    def zipped(self) -> bytes:
        """All files as one archive."""
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            for path, data in self.files.items():
                archive.writestr(path, data)
        return buffer.getvalue()


class RenderedPair:
    """Two drives of one street, rendered into a folder."""

    def __init__(self, folder: Path) -> None:
        self._drives = [_read(drive) for drive in render_drives(PAIR, folder)]

    def drive(self, which: int, *, name: str, images: str) -> Sendable:
        """One of the two under a name; its images have the same bytes wherever `images` is the same."""
        document, files = self._drives[which]
        marked = {path: _commented(data, images) for path, data in files.items()}
        return Sendable(name, json.dumps({**document, "name": name}).encode(), marked)


def sha256_of(data: bytes) -> str:
    """In hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def _read(folder: Path) -> tuple[dict[str, Any], dict[str, bytes]]:
    document = json.loads((folder / "drive.json").read_bytes())
    paths = [image["file"] for frame in document["frames"] for image in frame["images"].values()]
    return document, {path: (folder / path).read_bytes() for path in paths}


def _commented(jpeg: bytes, comment: str) -> bytes:
    said = comment.encode()
    segment = _COMMENT + (len(said) + 2).to_bytes(2, "big") + said
    return jpeg[:_START_BYTES] + segment + jpeg[_START_BYTES:]
