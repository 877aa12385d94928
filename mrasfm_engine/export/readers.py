"""Readers of a result's files, for the check before it is put in place.

They share no code with the writers: rotations are composed with scipy, the database is read with SQLite, COLMAP reads
its binary model (`colmap_io`). What COLMAP overlooks is parsed here: the poses that the image files hold one by one,
and the points that they name.
"""

from __future__ import annotations

import json
import sqlite3
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from mrasfm_engine.export.colmap_io import CameraRead, RigRead
from mrasfm_engine.io.read_model import read_vertices
from mrasfm_engine.types import Bytes, Floats, Ints
from schemas import DriveManifest

CAMERA, IMU = "CAMERA", "IMU"  # sensors, in a text model
POINTS_AT_ONE_TIME = 20_000
POINT_HEAD = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("color", "u1", 3), ("error", "<f8"), ("length", "<u8")])


class ModelFrame(NamedTuple):
    """A frame of a COLMAP model."""

    rig_id: int
    rig_from_world: Floats  # (4, 4)
    cameras: dict[int, int]  # by image


class ModelImage(NamedTuple):
    """Content of an image in a COLMAP model."""

    image_id: int
    camera_id: int
    name: str
    cam_from_world: Sequence[float]  # (7,) quaternion w x y z, translation
    xy_px: Floats  # (n, 2)
    point_ids: Ints | Floats  # (n,) whole numbers, -1 where a keypoint observes none


class ModelPoints(NamedTuple):
    """Points of a COLMAP model with their tracks."""

    ids: Ints  # (p,)
    xyz: Floats  # (p, 3)
    colors: Floats  # (p, 3)
    errors: Floats  # (p,)
    observations: Ints  # (n, 3) point id, image id, keypoint


def transforms(quaternions_xyzw: ArrayLike, translations: ArrayLike) -> Floats:
    """Transforms (n, 4, 4) as scipy composes them."""
    translations = np.asarray(translations, dtype=np.float64).reshape(-1, 3)
    out = np.tile(np.eye(4), (len(translations), 1, 1))
    if len(translations):
        out[:, :3, :3] = Rotation.from_quat(np.asarray(quaternions_xyzw, dtype=np.float64).reshape(-1, 4)).as_matrix()
    out[:, :3, 3] = translations
    return out


def json_object(path: Path) -> dict[str, Any]:
    """A JSON object; NaN and infinities are refused."""

    def refuse_constant(name: str) -> NoReturn:
        raise ValueError(f"it holds {name}")

    document = json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse_constant)
    if not isinstance(document, dict):
        raise ValueError("it is no JSON object")
    return document


def manifest(path: Path) -> DriveManifest:
    """A drive's manifest."""
    return DriveManifest.model_validate(json_object(path))


def tum(path: Path) -> tuple[Ints, Floats]:
    """Timestamps (n,) in whole microseconds, which a float of seconds would round, and poses (n, 4, 4)."""
    lines = [line.split() for line in path.read_text(encoding="ascii").splitlines() if not line.startswith("#")]
    rows = np.array([line[1:] for line in lines], dtype=np.float64).reshape(-1, 7)
    times_us = np.array([int(line[0].replace(".", "")) for line in lines], dtype=np.int64)
    return times_us, transforms(rows[:, 3:], rows[:, :3])


def ply(path: Path) -> NDArray[Any]:
    """The vertices as rows of named properties."""
    count, rows = read_vertices(path)
    if len(rows) != count:
        raise ValueError(f"{count} vertices announced, {len(rows)} found")
    return rows


def database(path: Path) -> Callable[[str], Iterator[Any]]:
    """The rows of a query, by its SQL."""
    return partial(_selected, path)


def _selected(path: Path, sql: str) -> Iterator[Any]:
    with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as db:
        yield from db.execute(sql)


def images_binary(path: Path) -> Iterator[ModelImage]:
    """All images of a binary model."""
    with path.open("rb") as file:
        (images,) = struct.unpack("<Q", _exactly(file, 8))
        for _ in range(images):
            image_id, *numbers, camera_id = struct.unpack("<I7dI", _exactly(file, 64))
            name = b"".join(iter(partial(_exactly, file, 1), b"\0")).decode("utf-8")
            (count,) = struct.unpack("<Q", _exactly(file, 8))
            rows = np.frombuffer(_exactly(file, 24 * count), dtype=[("xy", "<f8", 2), ("point", "<i8")])
            yield ModelImage(image_id, camera_id, name, numbers, rows["xy"], rows["point"])
        left = len(file.read(1))
    if left:
        raise ValueError("bytes are left over")


def _exactly(file: BinaryIO, count: int) -> bytes:
    data = file.read(count)
    if len(data) != count:
        raise ValueError("it ends early")
    return data


def cameras_text(path: Path) -> dict[int, CameraRead]:
    """The cameras of a text model by their ids."""
    return {
        int(number): CameraRead(model=model, size_px=(int(width), int(height)), params=np.array(params, np.float64))
        for number, model, width, height, *params in map(str.split, _lines(path))
    }


def rigs_text(path: Path) -> dict[int, RigRead]:
    """The rigs of a text model by their ids."""
    rigs = {}
    for number, sensors, reference, _, *words in map(str.split, _lines(path)):
        poses, rest = {}, iter(words)
        for kind, sensor, has_pose in zip(rest, rest, rest, strict=False):
            cam_from_rig = pose(list(islice(rest, 7 * int(has_pose))))
            if kind == CAMERA:
                poses[int(sensor)] = cam_from_rig[:3]
        rigs[int(number)] = RigRead(sensors=int(sensors), reference_is_imu=reference == IMU, cam_from_rig=poses)
    return rigs


def frames_text(path: Path) -> dict[int, ModelFrame]:
    """The frames of a text model by their ids."""
    frames = {}
    for number, rig, *words in map(str.split, _lines(path)):
        count, kinds = int(words[7]), words[8::3]
        cameras = {int(image): int(camera) for camera, image in zip(words[9::3], words[10::3], strict=True)}
        if kinds != [CAMERA] * count or len(cameras) != count:
            raise ValueError(f"frame {number} has other data than images")
        frames[int(number)] = ModelFrame(int(rig), pose(words[:7]), cameras)
    return frames


def _lines(path: Path) -> Iterator[str]:
    """Lines of a text model's file, without its head."""
    with path.open(encoding="utf-8", newline="\n") as file:
        for line in file:
            if line.startswith("#"):
                continue
            if not line.endswith("\n"):
                raise ValueError("it ends early")
            yield line


def pose(numbers: Sequence[float] | Sequence[str]) -> Floats:
    """A pose (4, 4) of COLMAP's seven numbers, or words of them."""
    w, x, y, z, *translation = map(float, numbers)
    result: Floats = transforms([x, y, z, w], translation)[0]
    return result


def images_text(path: Path) -> Iterator[ModelImage]:
    """All images of a text model."""
    lines = _lines(path)
    for head in lines:
        keypoints = next(lines, "")
        if not keypoints:
            raise ValueError("it ends early")
        image_id, *numbers, camera_id, name = head.removesuffix("\n").split(" ", maxsplit=9)
        rows = _numbers(keypoints).reshape(-1, 3)
        yield ModelImage(int(image_id), int(camera_id), name, [float(v) for v in numbers], rows[:, :2], rows[:, 2])


def points_text(path: Path) -> Iterator[ModelPoints]:
    """All points of a text model, some thousand at one time: a long drive's take more memory than its scene."""
    lines = _lines(path)
    while part := list(islice(lines, POINTS_AT_ONE_TIME)):
        yield _points_of_lines(part)


def _points_of_lines(lines: Sequence[str]) -> ModelPoints:
    counts = np.array([line.rstrip().count(" ") + 1 for line in lines], dtype=np.int64)
    numbers, ends = _numbers(" ".join(lines)), np.cumsum(counts)
    if len(numbers) != counts.sum():
        raise ValueError("it holds something that is no number")
    at_heads = (ends - counts)[:, None] + np.arange(8)
    in_tracks = np.ones(len(numbers), dtype=bool)
    in_tracks[at_heads] = False
    heads = numbers[at_heads]
    ids = heads[:, 0].astype(np.int64)
    tracks = numbers[in_tracks].astype(np.int64).reshape(-1, 2)
    observations = np.column_stack([np.repeat(ids, (counts - 8) // 2), tracks])
    return ModelPoints(ids, heads[:, 1:4], heads[:, 4:7], heads[:, 7], observations)


def points_binary(path: Path) -> ModelPoints:
    """All points of a binary model."""
    data, at, starts = path.read_bytes(), 8, []
    (count,) = struct.unpack_from("<Q", data)
    for _ in range(count):
        starts.append(at)
        (length,) = struct.unpack_from("<Q", data, at + POINT_HEAD.itemsize - 8)
        at += POINT_HEAD.itemsize + 8 * length
    if at != len(data):
        raise ValueError("bytes are left over" if at < len(data) else "it ends early")
    contents, ends = np.frombuffer(data, dtype=np.uint8), [*starts[::POINTS_AT_ONE_TIME][1:], at]
    parts = [
        _points_of_bytes(contents[starts[k] : end], np.array(starts[k : k + POINTS_AT_ONE_TIME]) - starts[k])
        for k, end in zip(range(0, count, POINTS_AT_ONE_TIME), ends, strict=False)
    ] or [_points_of_bytes(contents[:0], np.zeros(0, dtype=np.int64))]
    return ModelPoints(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _points_of_bytes(contents: Bytes, starts: Ints) -> ModelPoints:
    at_heads = starts[:, None] + np.arange(POINT_HEAD.itemsize)
    heads = contents[at_heads].view(POINT_HEAD)[:, 0]
    in_tracks = np.ones(len(contents), dtype=bool)
    in_tracks[at_heads] = False
    ids, lengths = heads["id"].astype(np.int64), heads["length"].astype(np.int64)
    tracks = contents[in_tracks].view("<u4").reshape(-1, 2)
    observations = np.column_stack([np.repeat(ids, lengths), tracks])
    return ModelPoints(ids, heads["xyz"], heads["color"].astype(np.float64), heads["error"], observations)


def _numbers(text: str) -> Floats:
    # Stops at the first word that is no number; the callers compare counts.
    return np.fromstring(text, dtype=np.float64, sep=" ") if text.strip() else np.zeros(0)
