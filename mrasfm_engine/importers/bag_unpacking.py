"""Takes the files of a ROS 2 bag out of zstd, where its recorder has compressed each file as a whole.

rosbags would do it into the system's temporary folder, without a limit.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path, PurePath
from typing import Any

from mrasfm_engine.errors import InputError, storage_error

METADATA = "metadata.yaml"  # of a ROS 2 bag, which is a folder
_KEY = "rosbag2_bagfile_information"
_BLOCK_BYTES = 1 << 20
# A drive has the bag's images again: with more than this part of what is free, the import could not be finished.
_SHARE_OF_DISK = 0.5


def unpacked(bag: Path, scratch: Path) -> Path:
    """The bag itself, or one in `scratch` that holds the same in files that are not compressed.

    Parameters
    ----------
    bag
        Folder of a ROS 2 bag.
    scratch
        A folder on the drive's disk, made where it is needed. What an earlier call has left there is used again.

    Raises
    ------
    InputError
        If the files would take more than half of what is free on the disk, or one is damaged.
    StorageError
        If they cannot be written.
    """
    text = (bag / METADATA).read_text(encoding="utf-8")
    if "zstd" not in text.lower():
        return bag  # without reading its metadata: ruamel takes 50 ms, and a bag is opened several times
    metadata = _metadata(text)
    if metadata.get("compression_mode", "").lower() != "file" or metadata.get("compression_format") != "zstd":
        return bag  # rosbags reads it, or says why it does not
    files = [bag / PurePath(name).name for name in metadata["relative_file_paths"]]
    if not all(file.is_file() for file in files):
        return bag
    target = scratch / bag.name
    if not (target / METADATA).exists():
        try:
            target.mkdir(parents=True)
            _unpack(files, target)
            metadata |= {
                "compression_mode": "",
                "compression_format": "",
                "relative_file_paths": [file.stem for file in files],
            }
            (target / METADATA).write_text(json.dumps({_KEY: metadata}, default=str), encoding="utf-8")
        except OSError as error:
            raise storage_error(target, error) from error
    return target


def _metadata(text: str) -> dict[str, Any]:
    from ruamel.yaml import YAML

    found = YAML(typ="safe").load(text)[_KEY]
    return dict(found)


def _unpack(files: Sequence[Path], target: Path) -> None:
    from backports import zstd

    limit = left = int(_SHARE_OF_DISK * shutil.disk_usage(target).free)
    for file in files:
        with file.open("rb") as source:
            stated = zstd.get_frame_info(source.read(18)).decompressed_size or 0  # 18: of the longest header
        if stated > left:
            raise _too_large(file, limit)
        with zstd.open(file) as source, (target / file.stem).open("xb") as sink:
            while block := source.read(_BLOCK_BYTES):
                left -= len(block)
                if left < 0:
                    raise _too_large(file, limit)
                sink.write(block)


def _too_large(file: Path, limit: int) -> InputError:
    return InputError(
        f"bag file {file} is compressed, and with the bag's others takes over {limit / 1e6:.0f} MB when it is not: "
        "half of what is free on the drive's disk",
        remedy="Free space there, give --out on a larger disk, or cut the bag.",
        code="bag-too-large",
    )
