"""Channels of nuScenes' tables, which are pinhole cameras, and their images."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from mrasfm_engine.export.contract import ExportSource
from mrasfm_engine.export.undistorted import UndistortedScene
from mrasfm_engine.types import Floats

SAMPLES = "samples"
PLAIN = ("PINHOLE", "SIMPLE_PINHOLE")
PREFIX = "CAM_"


@dataclass(frozen=True, kw_only=True)
class Channel:
    """A pinhole camera of the tables.

    Attributes
    ----------
    scene
        Scene of a map that it is of, else empty.
    camera
        Number of the camera that it shows.
    view
        Number of the undistorted view; None where its images are those of the drive.
    params
        fx, fy, cx, cy, from the corner of the top left pixel.
    """

    name: str
    scene: str
    camera: int
    view: int | None
    width: int
    height: int
    params: list[float]
    rig_from_cam: Floats


@dataclass(frozen=True, kw_only=True)
class Shot:
    """An image of the tables: that of a unit in a channel."""

    channel: Channel
    image: int  # of the source
    view_image: int | None  # of the undistorted scene
    file: str


def channels_of(source: ExportSource, is_plain: Sequence[bool], made: UndistortedScene | None) -> Iterator[Channel]:
    """Channels of all cameras; those of one name in different scenes of a map share it, those of one scene do not."""
    used: set[tuple[str, str]] = set()
    for k, camera in enumerate(source.scene.drive.cameras):
        scene, _, own = camera.name.rpartition("/") if source.is_map else ("", "", camera.name)
        calibration = source.scene.calibration[k]
        parts: list[tuple[str, int | None, int, int, list[float], Floats]]
        if is_plain[k]:
            params = calibration.params.tolist()
            full = params if camera.model == "PINHOLE" else [params[0], *params]
            parts = [("", None, camera.width, camera.height, full, calibration.rig_from_cam)]
        else:
            assert made is not None
            parts = [
                (view.side, v, view.width, view.height, view.params, made.scene.calibration[v].rig_from_cam)
                for v, (view, of) in enumerate(zip(made.views, made.camera_of_view, strict=True))
                if of == k
            ]
        for side, v, width, height, params, pose in parts:
            name = channel_name(own, side)
            while (scene, name) in used:
                name += "_"
            used.add((scene, name))
            yield Channel(
                name=name, scene=scene, camera=k, view=v, width=width, height=height, params=params, rig_from_cam=pose
            )


def channel_name(camera: str, side: str) -> str:
    """Name of a camera as nuScenes has them."""
    name = re.sub(r"[^A-Z0-9]", "_", "_".join([camera, side] if side else [camera]).upper())
    return name if name.startswith(PREFIX) else PREFIX + name


def shots_of(source: ExportSource, channels: Sequence[Channel], made: UndistortedScene | None) -> Iterator[Shot]:
    """Images by unit and channel."""
    views = {} if made is None else {(v, i): n for n, (v, i) in enumerate(_view_images(made))}
    of_camera: dict[int, list[Channel]] = {}
    for channel in channels:
        of_camera.setdefault(channel.camera, []).append(channel)
    for i in source.registered:
        image = source.scene.drive.images[i]
        for channel in of_camera[image.camera]:
            suffix = ".jpg" if image.file.lower().endswith((".jpg", ".jpeg")) else ".png"
            head = f"{channel.scene}." if channel.scene else ""
            yield Shot(
                channel=channel,
                image=i,
                view_image=None if channel.view is None else views[channel.view, i],
                file=f"{SAMPLES}/{channel.name}/{head}{image.unit:06d}{suffix}",
            )


def _view_images(made: UndistortedScene) -> Iterator[tuple[int, int]]:
    for image, original in zip(made.scene.drive.images, made.image_of, strict=True):
        yield image.camera, original
