"""Cameras of an MCAP file: their frames, and their intrinsics after their images are scaled down."""

from __future__ import annotations

from dataclasses import dataclass, replace

from mrasfm_engine.export.contract import ExportSource
from mrasfm_engine.export.rig_files import PIXEL_CENTRE_PX, RigCamera, known_to_ros, rig_cameras
from mrasfm_engine.types import Floats

RIG = "rig"


@dataclass(frozen=True, kw_only=True)
class SentCamera:
    """A camera as it is sent: its images may be scaled down.

    Attributes
    ----------
    lens
        None where Foxglove has no model for it.
    """

    name: str
    rig: str
    width: int
    height: int
    lens: RigCamera | None
    rig_from_cam: Floats


def sent_cameras(source: ExportSource, image_size_px: int | None) -> list[SentCamera]:
    """Cameras with the size and the intrinsics of their images as they are sent."""
    found = []
    for camera, given in zip(rig_cameras(source.scene), source.scene.drive.cameras, strict=True):
        side = max(camera.width, camera.height)
        scale = 1.0 if image_size_px is None else min(1.0, image_size_px / side)
        size = (max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
        across, down = size[0] / camera.width, size[1] / camera.height
        fx, fy, cx, cy = camera.intrinsics
        intrinsics = [fx * across, fy * down, *_scaled((cx, across), (cy, down))]
        lens = replace(camera, width=size[0], height=size[1], intrinsics=intrinsics)
        scene, _, _ = given.name.rpartition("/") if source.is_map else ("", "", "")
        found.append(
            SentCamera(
                name=camera.name,
                rig=f"{scene}/{RIG}" if scene else RIG,
                width=size[0],
                height=size[1],
                lens=lens if known_to_ros(camera) else None,
                rig_from_cam=camera.rig_from_cam,
            )
        )
    return found


def _scaled(*centres: tuple[float, float]) -> list[float]:
    """Coordinates times their factors; from the corner of the top left pixel, scaling is a factor."""
    return [(value + PIXEL_CENTRE_PX) * factor - PIXEL_CENTRE_PX for value, factor in centres]
