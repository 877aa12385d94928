"""Reads back the binary COLMAP model and the point cloud of a written scene."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.types import Bytes, Floats, Floats32, Ints

POINT_HEAD = struct.Struct("<Q3d3BdQ")
TRACK_ENTRY_BYTES = 8
PLY_TYPES = {"float": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4"}
MAX_KEYPOINTS = 10_000_000  # of an image: more is a damaged file


@dataclass(frozen=True, kw_only=True)
class ModelImage:
    """One image of a model."""

    name: str
    cam_from_world: Floats  # (7,) qw qx qy qz tx ty tz
    xy_px: Floats32  # (n, 2)
    point: Ints  # (n,) index into the points, -1 for none


@dataclass(frozen=True, kw_only=True)
class ModelPoints:
    """The points of a model; ids are index + 1."""

    xyz_m: Floats  # (p, 3)
    color: Bytes  # (p, 3)
    error_px: Floats  # (p,)


def read_images(path: Path) -> dict[int, ModelImage]:
    """The images of `images.bin` by index (id - 1).

    Raises
    ------
    OSError, ValueError
        Where the file cannot be read or is damaged.
    """
    data, at, result = path.read_bytes(), 8, {}
    row = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
    try:
        for _ in range(struct.unpack_from("<Q", data)[0]):
            (image_id,) = struct.unpack_from("<I", data, at)
            name_end = data.index(b"\0", at + 64)
            (count,) = struct.unpack_from("<Q", data, name_end + 1)
            if count > MAX_KEYPOINTS:
                raise ValueError(f"an image has {count} keypoints")
            rows = np.frombuffer(data, dtype=row, count=count, offset=name_end + 9)
            # COLMAP writes the largest unsigned number for no point.
            point = np.where(rows["point"] > 0, rows["point"] - 1, -1)
            result[image_id - 1] = ModelImage(
                name=data[at + 64 : name_end].decode("utf-8"),
                cam_from_world=np.frombuffer(data, dtype="<f8", count=7, offset=at + 4),
                xy_px=rows["xy"].astype(np.float32),
                point=point,
            )
            at = name_end + 9 + rows.nbytes
    except struct.error as error:
        raise ValueError(f"it ends too early: {error}") from error
    return result


def read_points(path: Path) -> ModelPoints:
    """The points of `points3D.bin`.

    Raises
    ------
    OSError, ValueError
        Where the file cannot be read or is damaged, or ids are not 1, 2, 3 and so on.
    """
    data, at = path.read_bytes(), 8
    try:
        (count,) = struct.unpack_from("<Q", data)
        if count * POINT_HEAD.size > len(data):
            raise ValueError(f"{count} points do not fit into the file")
        heads = np.zeros((count, 8))
        for i in range(count):
            point_id, x, y, z, r, g, b, error, length = POINT_HEAD.unpack_from(data, at)
            heads[i] = point_id, x, y, z, r, g, b, error
            at += POINT_HEAD.size + TRACK_ENTRY_BYTES * length
    except struct.error as error:
        raise ValueError(f"it ends too early: {error}") from error
    if at != len(data) or not np.array_equal(heads[:, 0], np.arange(1, count + 1)):
        raise ValueError("its points are not numbered without gaps")
    return ModelPoints(xyz_m=heads[:, 1:4].copy(), color=heads[:, 4:7].astype(np.uint8), error_px=heads[:, 7].copy())


def read_vertices(path: Path) -> tuple[int, NDArray[Any]]:
    """The number of vertices that a PLY file announces, else -1, and those that it has as rows of named properties.

    Raises
    ------
    OSError, ValueError, KeyError
        Where the file cannot be read or is damaged.
    """
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii").splitlines()]
    count = next((int(line[2]) for line in lines if line[:2] == ["element", "vertex"]), -1)
    return count, np.frombuffer(body, dtype=[(line[2], PLY_TYPES[line[1]]) for line in lines if line[0] == "property"])
