"""Format `nuscenes`: the tables of nuScenes with keyframes of the registered images.

`v1.0-mrasfm/` holds the thirteen tables, `samples/CHANNEL/` the images, `maps/` the mask that the development kit asks
for. A scene of a map is a scene of the tables. nuScenes has pinhole cameras alone: images of others are undistorted as
`pinhole_views` says; those of pinhole cameras stay as they are. Its pixels count from the centre of the top left one:
the principal point is less by half a pixel. Its global frame is the local frame here. Every image has an ego pose of
its own, at its own time.
"""

from __future__ import annotations

import datetime
import hashlib
import json
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from mrasfm_engine.export.check import Check
from mrasfm_engine.export.contract import ExportSource, ExportWork, Written
from mrasfm_engine.export.file_contents import write_content
from mrasfm_engine.export.nuscenes_channels import PLAIN, Channel, Shot, channels_of, shots_of
from mrasfm_engine.export.nuscenes_readback import (
    DECIMALS,
    ROTATION_DECIMALS,
    TABLES,
    compare_tables,
    read_table,
    token,
)
from mrasfm_engine.export.rig_files import PIXEL_CENTRE_PX
from mrasfm_engine.export.undistorted import ImageMaker, UndistortedScene, folder_digests, same_digests, undistorted
from mrasfm_engine.geometry import se3
from mrasfm_engine.types import Floats

VERSION, MAPS, MASK = "v1.0-mrasfm", "maps", "empty.png"
MASK_SIDE_PX = 8


def write_nuscenes(work: ExportWork) -> Written:
    """Write the tables and images."""
    source = work.source
    cameras = source.scene.drive.cameras
    keeps = work.options.image_size_px is None
    is_plain = [camera.model in PLAIN and keeps for camera in cameras]
    made = None if all(is_plain) else undistorted(source, work.options.image_size_px)
    channels = list(channels_of(source, is_plain, made))
    shots = list(shots_of(source, channels, made))
    (work.folder / VERSION).mkdir()
    digests: dict[str, str] = {}
    for name, rows in _tables(source, channels, shots).items():
        text, file = json.dumps(rows, allow_nan=False, ensure_ascii=False, indent=0), f"{VERSION}/{name}.json"
        digests[file] = write_content(work.folder / file, text + "\n")
    checks = [*_write_images(work, shots, made), *_write_mask(work.folder)]
    known = compare_tables(source, channels, shots)
    checks += [Check(f"{VERSION}/{name}.json", read_table, partial(known, name)) for name in TABLES]
    return Written(checks=checks, notes=_notes(source, is_plain, made), digests=digests)


def _notes(source: ExportSource, is_plain: list[bool], made: UndistortedScene | None) -> list[str]:
    units, scene = source.scene.drive.manifest.frames, source.scene
    lost = int((~scene.unit_registered).sum())
    cameras = [camera.name for camera, plain in zip(scene.drive.cameras, is_plain, strict=True) if not plain]
    rolling = [camera.name for camera in scene.drive.cameras if camera.readout_us]
    return [
        *([f"images are undistorted: {', '.join(cameras)}"] if cameras else []),
        *([note for note in made.notes() if "wide" in note] if made else []),
        *([f"{lost} of {len(units)} units have no pose and are left out"] if lost else []),
        *([f"images have the pose of their middle row: {', '.join(rolling)}"] if rolling else []),
    ]


def _write_images(work: ExportWork, shots: Sequence[Shot], made: UndistortedScene | None) -> list[Check]:
    digests: dict[str, dict[str, str]] = {}
    makers: dict[int, ImageMaker] = {}
    for done, shot in enumerate(sorted(shots, key=lambda shot: (shot.channel.scene, shot.channel.name)), start=1):
        if shot.view_image is None:
            data = work.source.content(shot.image)
        else:
            assert made is not None
            assert shot.channel.view is not None
            if shot.channel.view not in makers:  # one at a time is in memory
                makers = {shot.channel.view: ImageMaker(made, shot.channel.view, masked=False)}
            data = makers[shot.channel.view].encoded(shot.view_image)[0]
        path = work.folder / shot.file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        folder, name = shot.file.rsplit("/", 1)
        digests.setdefault(folder, {})[name] = hashlib.sha256(data).hexdigest()
        work.step(done, len(shots))
    return [Check(folder, folder_digests, partial(same_digests, known)) for folder, known in digests.items()]


def _write_mask(folder: Path) -> Iterator[Check]:
    (folder / MAPS).mkdir()
    data = cv2.imencode(".png", np.zeros((MASK_SIDE_PX, MASK_SIDE_PX), np.uint8))[1].tobytes()
    (folder / MAPS / MASK).write_bytes(data)
    yield Check(MAPS, folder_digests, partial(same_digests, {MASK: hashlib.sha256(data).hexdigest()}))


def _tables(source: ExportSource, channels: Sequence[Channel], shots: Sequence[Shot]) -> dict[str, list[Any]]:
    scene = source.scene
    tables: dict[str, list[Any]] = {name: [] for name in TABLES}
    for name in dict.fromkeys(channel.name for channel in channels):
        tables["sensor"].append({"token": token("sensor", name), "channel": name, "modality": "camera"})
    for channel in channels:
        fx, fy, cx, cy = channel.params
        tables["calibrated_sensor"].append(
            {
                "token": token("calibrated_sensor", channel.scene, channel.name),
                "sensor_token": token("sensor", channel.name),
                **_pose(channel.rig_from_cam),
                "camera_intrinsic": _rounded(
                    [[fx, 0.0, cx - PIXEL_CENTRE_PX], [0.0, fy, cy - PIXEL_CENTRE_PX], [0.0, 0.0, 1.0]], DECIMALS
                ),
            }
        )
    units = sorted({scene.drive.images[shot.image].unit for shot in shots})
    by_scene: dict[str, list[int]] = {}
    for unit in units:
        by_scene.setdefault(source.scene_of_unit[unit], []).append(unit)
    for name, own in by_scene.items():
        tables["log"].append(_log(source, name, own))
        tables["scene"].append(_scene(source, name, own))
        tables["sample"] += [
            {
                "token": token("sample", unit),
                "timestamp": int(scene.drive.timestamps_us[unit]),
                "prev": token("sample", own[k - 1]) if k else "",
                "next": token("sample", own[k + 1]) if k + 1 < len(own) else "",
                "scene_token": token("scene", name),
            }
            for k, unit in enumerate(own)
        ]
    tables["map"].append(
        {
            "token": token("map"),
            "category": "semantic_prior",
            "filename": f"{MAPS}/{MASK}",
            "log_tokens": [token("log", name) for name in by_scene],
        }
    )
    tables["ego_pose"], tables["sample_data"] = _shot_tables(source, shots)
    return tables


def _log(source: ExportSource, name: str, units: Sequence[int]) -> dict[str, Any]:
    first_s = int(source.scene.drive.timestamps_us[units[0]]) / 1e6
    return {
        "token": token("log", name),
        "logfile": name or source.name,
        "vehicle": "" if source.is_map else source.scene.drive.manifest.vehicle or "",
        "date_captured": datetime.datetime.fromtimestamp(first_s, datetime.UTC).date().isoformat(),
        "location": "",
    }


def _scene(source: ExportSource, name: str, units: Sequence[int]) -> dict[str, Any]:
    return {
        "token": token("scene", name),
        "log_token": token("log", name),
        "nbr_samples": len(units),
        "first_sample_token": token("sample", units[0]),
        "last_sample_token": token("sample", units[-1]),
        "name": name or source.name,
        "description": "",
    }


def _shot_tables(source: ExportSource, shots: Sequence[Shot]) -> tuple[list[Any], list[Any]]:
    scene = source.scene
    world_from_image = scene.world_from_rig[scene.image_unit]
    if scene.unit_from_image is not None:
        world_from_image = world_from_image @ scene.unit_from_image
    poses = [
        {
            "token": token("ego_pose", image),
            "timestamp": scene.drive.images[image].timestamp_us,
            **_pose(world_from_image[image]),
        }
        for image in sorted({shot.image for shot in shots})
    ]
    rows = []
    last: dict[str, dict[str, Any]] = {}
    for shot in shots:
        image, channel = scene.drive.images[shot.image], shot.channel
        calibrated = token("calibrated_sensor", channel.scene, channel.name)
        row = {
            "token": token("sample_data", channel.name, shot.image),
            "sample_token": token("sample", image.unit),
            "ego_pose_token": token("ego_pose", shot.image),
            "calibrated_sensor_token": calibrated,
            "timestamp": image.timestamp_us,
            "fileformat": "jpg" if shot.file.endswith(".jpg") else "png",
            "is_key_frame": True,
            "height": channel.height,
            "width": channel.width,
            "filename": shot.file,
            "prev": last[calibrated]["token"] if calibrated in last else "",
            "next": "",
        }
        if calibrated in last:
            last[calibrated]["next"] = row["token"]
        last[calibrated] = row
        rows.append(row)
    return poses, rows


def _pose(a_from_b: Floats) -> dict[str, list[float]]:
    x, y, z, w = se3.quaternion_from_rotation(a_from_b[:3, :3]).tolist()
    return {
        "translation": _rounded(a_from_b[:3, 3], DECIMALS),
        "rotation": _rounded([w, x, y, z], ROTATION_DECIMALS),
    }


def _rounded(values: ArrayLike, decimals: int) -> Any:
    """Numbers without the digits that mean nothing, so that every digit can be checked."""
    return np.round(np.asarray(values, dtype=np.float64), decimals).tolist()
