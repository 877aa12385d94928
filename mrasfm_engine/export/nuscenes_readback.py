"""Reading of nuScenes' tables as its development kit does, beside what the scene says.

Rotations are scipy's; every digit that is written counts.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from scipy.spatial.transform import Rotation

from mrasfm_engine.export.comparisons import Row, Rows
from mrasfm_engine.export.contract import ExportSource
from mrasfm_engine.export.nuscenes_channels import Channel, Shot
from mrasfm_engine.types import Floats

EMPTY = ("category", "attribute", "visibility", "instance", "sample_annotation")
TABLES = (*EMPTY, "map", "log", "scene", "sample", "sample_data", "sensor", "calibrated_sensor", "ego_pose")
DECIMALS, ROTATION_DECIMALS = 9, 12  # of metres and pixels, and of quaternions
TOLERANCE, ROTATION_TOLERANCE = 0.5001e-9, 0.5001e-12

Table = list[dict[str, Any]]


def token(*parts: object) -> str:
    """A record's token: nuScenes has 32 hexadecimal digits."""
    return hashlib.md5("/".join(map(str, parts)).encode(), usedforsecurity=False).hexdigest()


def read_table(path: Path) -> Table:
    """A table: a list of records."""

    def refuse_constant(name: str) -> NoReturn:
        raise ValueError(f"it holds {name}")

    rows = json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse_constant)
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise ValueError("it is no list of records")
    return rows


def compare_tables(
    source: ExportSource, channels: Sequence[Channel], shots: Sequence[Shot]
) -> Callable[[str, Table], Rows]:
    """Comparison of a table, by its name, with the scene."""
    known = _Known(source, channels, shots)

    def compare(name: str, rows: Table) -> Rows:
        if name in EMPTY:
            yield Row("its list of records", rows, [])
        else:
            yield from getattr(known, name)(rows)

    return compare


class _Known:
    """Comparisons of the tables that have records."""

    def __init__(self, source: ExportSource, channels: Sequence[Channel], shots: Sequence[Shot]) -> None:
        self._source, self._channels, self._shots = source, channels, shots
        images = source.scene.drive.images
        self._units = sorted({images[shot.image].unit for shot in shots})
        names = source.scene_of_unit
        self._of_scene = {
            name: [u for u in self._units if names[u] == name] for name in dict.fromkeys(names[u] for u in self._units)
        }

    def map(self, rows: Table) -> Rows:
        logs = [token("log", name) for name in self._of_scene]
        expected = {"token": token("map"), "category": "semantic_prior", "filename": "maps/empty.png"}
        yield Row("its record", rows, [{**expected, "log_tokens": logs}])

    def log(self, rows: Table) -> Rows:
        yield Row("its tokens", [row["token"] for row in rows], [token("log", name) for name in self._of_scene])
        for row, (name, units) in zip(rows, self._of_scene.items(), strict=True):
            day = np.datetime64(int(self._source.scene.drive.timestamps_us[units[0]]), "us").astype("datetime64[D]")
            yield Row("a date", row["date_captured"], str(day))
            vehicle = None if self._source.is_map else self._source.scene.drive.manifest.vehicle
            yield Row(
                "a log",
                (row["logfile"], row["vehicle"], row["location"]),
                (name or self._source.name, vehicle or "", ""),
            )

    def scene(self, rows: Table) -> Rows:
        yield Row("its number of scenes", len(rows), len(self._of_scene))
        for row, (name, units) in zip(rows, self._of_scene.items(), strict=True):
            yield Row("a scene's name", row["name"], name or self._source.name)
            yield Row(
                "a scene's token and log", (row["token"], row["log_token"]), (token("scene", name), token("log", name))
            )
            ends = (row["first_sample_token"], row["last_sample_token"])
            yield Row("the ends of a scene", ends, (token("sample", units[0]), token("sample", units[-1])))
            yield Row("a scene's number of samples", (row["nbr_samples"], row["description"]), (len(units), ""))

    def sample(self, rows: Table) -> Rows:
        units = [unit for own in self._of_scene.values() for unit in own]
        yield Row("its tokens", [row["token"] for row in rows], [token("sample", unit) for unit in units])
        times = self._source.scene.drive.timestamps_us[units].tolist()
        yield Row("its times", [row["timestamp"] for row in rows], times)
        at = {row["token"]: row for row in rows}
        for name, own in self._of_scene.items():
            chain = [token("sample", unit) for unit in own]
            yield Row("a sample's scene", {at[t]["scene_token"] for t in chain}, {token("scene", name)})
            links = [(at[a]["next"], at[b]["prev"]) for a, b in pairwise(chain)]
            yield Row("the chain of samples", links, [(b, a) for a, b in pairwise(chain)])
            yield Row("the chain's ends", (at[chain[0]]["prev"], at[chain[-1]]["next"]), ("", ""))

    def sensor(self, rows: Table) -> Rows:
        names = list(dict.fromkeys(channel.name for channel in self._channels))
        expected = [(token("sensor", name), name, "camera") for name in names]
        yield Row("its sensors", [(row["token"], row["channel"], row["modality"]) for row in rows], expected)

    def calibrated_sensor(self, rows: Table) -> Rows:
        tokens = [(token("calibrated_sensor", c.scene, c.name), token("sensor", c.name)) for c in self._channels]
        yield Row("its tokens", [(row["token"], row["sensor_token"]) for row in rows], tokens)
        for row, channel in zip(rows, self._channels, strict=True):
            what = f"of {channel.name}"
            rig_from_cam = self._source.scene.calibration[channel.camera].rig_from_cam
            yield Row(f"the place {what}", row["translation"], rig_from_cam[:3, 3], TOLERANCE)
            yield from _rotation(what, row["rotation"], channel.rig_from_cam[:3, :3])
            fx, fy, cx, cy = channel.params
            # In pixels from the centre of the first one.
            expected = np.array([[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5], [0.0, 0.0, 1.0]])
            yield Row(f"the intrinsics {what}", row["camera_intrinsic"], expected, TOLERANCE)

    def ego_pose(self, rows: Table) -> Rows:
        scene = self._source.scene
        images = sorted({shot.image for shot in self._shots})
        yield Row("its tokens", [row["token"] for row in rows], [token("ego_pose", image) for image in images])
        times = [scene.drive.images[image].timestamp_us for image in images]
        yield Row("its times", [row["timestamp"] for row in rows], times)
        # As the scene has it of every camera, through the camera and back.
        cameras = np.stack([scene.calibration[scene.drive.images[image].camera].rig_from_cam for image in images])
        expected = np.einsum("nij,njk->nik", scene.world_from_cam[images], np.linalg.inv(cameras))
        yield Row("a place", [row["translation"] for row in rows], expected[:, :3, 3], TOLERANCE)
        for row, image, pose in zip(rows, images, expected, strict=True):
            yield from _rotation(f"of {scene.drive.images[image].file}", row["rotation"], pose[:3, :3])

    def sample_data(self, rows: Table) -> Rows:
        scene = self._source.scene
        yield Row("its number of records", len(rows), len(self._shots))
        for row, shot in zip(rows, self._shots, strict=True):
            image, channel = scene.drive.images[shot.image], shot.channel
            tokens = [row[f"{key}token"] for key in ("", "sample_", "ego_pose_", "calibrated_sensor_")]
            expected = [
                token("sample_data", channel.name, shot.image),
                token("sample", image.unit),
                token("ego_pose", shot.image),
                token("calibrated_sensor", channel.scene, channel.name),
            ]
            yield Row(f"the tokens of {shot.file}", tokens, expected)
            said = (row["filename"], row["fileformat"], row["timestamp"], row["width"], row["height"])
            kind = shot.file.rpartition(".")[2]
            yield Row("a record", said, (shot.file, kind, image.timestamp_us, channel.width, channel.height))
            yield Row("a keyframe", row["is_key_frame"], True)
        chains: dict[str, list[dict[str, Any]]] = {}
        for row in rows:
            chains.setdefault(row["calibrated_sensor_token"], []).append(row)
        for chain in chains.values():
            links = [(a["next"], b["prev"]) for a, b in pairwise(chain)]
            yield Row("the chain of a channel", links, [(b["token"], a["token"]) for a, b in pairwise(chain)])
            yield Row("the ends of a channel's chain", (chain[0]["prev"], chain[-1]["next"]), ("", ""))


def _rotation(what: str, wxyz: list[float], expected: Floats) -> Rows:
    """A quaternion w, x, y, z beside that which scipy makes of a matrix (3, 3)."""
    w_first = np.roll(Rotation.from_matrix(expected).as_quat(), 1)
    nearest = w_first if float(np.dot(w_first, wxyz)) >= 0.0 else -w_first
    yield Row(f"the rotation {what}", wxyz, nearest, ROTATION_TOLERANCE)
