"""Variations of a drive: its manifest, true poses and images change together, so that the same scene is to be found.

A variation edits a `VariedDrive`. Variations compose: each leaves a drive that is right, which the next one may vary.
"""

from __future__ import annotations

import copy
import json
import os
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from mrasfm_engine.geometry.geodesy import ecef_from_local, geodetic_from_local, local_from_geodetic
from mrasfm_engine.io.trajectory_file import Trajectory, format_tum, read_tum
from mrasfm_engine.scene.drive import matrix_from_pose, pose_from_matrix
from mrasfm_engine.types import Bytes, Floats
from schemas import Pose

ImageChange = Callable[[Bytes], Bytes]
CameraVariation = Callable[[dict[str, Any]], ImageChange]  # edits a camera of the manifest, returns its images' change
Variation = Callable[["VariedDrive"], None]

ALL, FIRST, LAST = slice(None), slice(0, 1), slice(-1, None)  # of the rig's cameras
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])  # left and right
GEODETIC = ("latitude_deg", "longitude_deg", "height_m")
# Members of a manifest that variations keep right; masks and their label map are left out.
_VARIED = {"version", "name", "rig", "frames", "gnss", "label_map", "notes"}
_VARIED_OF_CAMERA = {"name", "model", "width", "height", "params", "rig_from_cam"}


@dataclass(kw_only=True)
class VariedDrive:
    """A drive's manifest and true poses, and the changes of each camera's images, in order."""

    manifest: dict[str, Any]
    truth: Trajectory
    image_changes: dict[str, list[ImageChange]] = field(default_factory=lambda: defaultdict(list))

    def __post_init__(self) -> None:
        """Refuse a manifest with members that a variation would leave as they are.

        Raises
        ------
        ValueError
            Where there are rough poses, rolling shutters, sigmas, distortion or axes other than forward, left, up.
        """
        unknown = self.manifest.keys() - _VARIED
        unknown = unknown.union(*(camera.keys() - _VARIED_OF_CAMERA for camera in self.cameras))
        unknown |= {camera["model"] for camera in self.cameras} - {"PINHOLE"}
        unknown |= {self.manifest["rig"].get("body_axes", "flu")} - {"flu"}
        if unknown:
            raise ValueError(f"variations would leave {', '.join(sorted(unknown))} as it is")

    @classmethod
    def read(cls, folder: Path) -> VariedDrive:
        """The drive in a folder, without masks."""
        manifest = json.loads((folder / "drive.json").read_text(encoding="utf-8"))
        manifest.pop("label_map", None)
        for frame in manifest["frames"]:
            for image in frame["images"].values():
                image.pop("mask", None)
        return cls(manifest=manifest, truth=read_tum(folder / "truth.tum"))

    @property
    def cameras(self) -> list[dict[str, Any]]:
        """Cameras of the manifest."""
        cameras: list[dict[str, Any]] = self.manifest["rig"]["cameras"]
        return cameras

    def write(self, source: Path, out: Path) -> None:
        """Write the drive with the images of the folder that it was read from: links, or PNGs of those that change."""
        manifest = copy.deepcopy(self.manifest)
        for frame in manifest["frames"]:
            for camera, image in frame["images"].items():
                file = source / image["file"]
                changes = self.image_changes.get(camera, [])
                if changes:
                    image["file"] = str(PurePosixPath(image["file"]).with_suffix(".png"))
                target = out / image["file"]
                target.parent.mkdir(parents=True, exist_ok=True)
                if changes:
                    _write_changed(file, target, changes)
                else:
                    os.link(file, target)
        (out / "truth.tum").write_text(format_tum(self.truth.timestamps_us.tolist(), self.truth.world_from_rig))
        (out / "drive.json").write_text(json.dumps(manifest), encoding="utf-8")


def _write_changed(file: Path, target: Path, changes: list[ImageChange]) -> None:
    image = np.asarray(cv2.imread(str(file), cv2.IMREAD_UNCHANGED), dtype=np.uint8)
    for change in changes:
        image = change(image)
    if not cv2.imwrite(str(target), np.ascontiguousarray(image), [cv2.IMWRITE_PNG_COMPRESSION, 1]):
        raise OSError(f"{target} cannot be written")


def composed(*variations: Variation) -> Variation:
    """Several variations, one after the other."""

    def vary(drive: VariedDrive) -> None:
        for variation in variations:
            variation(drive)

    return vary


def on_cameras(which: slice, *variations: CameraVariation) -> Variation:
    """Variations of some cameras, given to them in turn."""

    def vary(drive: VariedDrive) -> None:
        for k, camera in enumerate(drive.cameras[which]):
            drive.image_changes[camera["name"]].append(variations[k % len(variations)](camera))

    return vary


def upside_down(camera: dict[str, Any]) -> ImageChange:
    """The camera is turned by 180 deg about its axis."""
    fx, fy, cx, cy = camera["params"]
    camera["params"] = [fx, fy, camera["width"] - cx, camera["height"] - cy]
    _turn(camera, [[-1, 0, 0], [0, -1, 0], [0, 0, 1]])
    return lambda image: image[::-1, ::-1]


def on_edge(camera: dict[str, Any]) -> ImageChange:
    """The camera is turned by 90 deg about its axis, so that its images are clockwise."""
    fx, fy, cx, cy = camera["params"]
    camera["params"] = [fy, fx, camera["height"] - cy, cx]
    camera["width"], camera["height"] = camera["height"], camera["width"]
    _turn(camera, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    return lambda image: cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE)


def scaled(factor: float) -> CameraVariation:
    """Images of another size."""

    def vary(camera: dict[str, Any]) -> ImageChange:
        width, height = round(factor * camera["width"]), round(factor * camera["height"])
        across, down = width / camera["width"], height / camera["height"]
        fx, fy, cx, cy = camera["params"]
        camera["params"] = [across * fx, down * fy, across * cx, down * cy]
        camera["width"], camera["height"] = width, height
        return lambda image: cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)

    return vary


def cropped(left: float, top: float, width: float, height: float) -> CameraVariation:
    """A part of the images, in shares of their sides."""

    def vary(camera: dict[str, Any]) -> ImageChange:
        x, y = int(left * camera["width"]), int(top * camera["height"])
        fx, fy, cx, cy = camera["params"]
        camera["params"] = [fx, fy, cx - x, cy - y]
        camera["width"], camera["height"] = w, h = int(width * camera["width"]), int(height * camera["height"])
        return lambda image: image[y : y + h, x : x + w]

    return vary


def _turn(camera: dict[str, Any], cam_from_turned: ArrayLike) -> None:
    pose = matrix_from_pose(Pose(**camera["rig_from_cam"]))
    pose[:3, :3] = pose[:3, :3] @ np.array(cam_from_turned)
    camera["rig_from_cam"] = pose_from_matrix(pose).model_dump()


def mirrored(drive: VariedDrive) -> None:
    """Left and right are exchanged: of the world, of the vehicle and in the images."""
    on_cameras(ALL, _mirrored_camera)(drive)
    drive.manifest["gnss"]["antenna_in_rig_m"][1] *= -1
    local_m, ecef_from_middle = _receiver_positions(drive)
    _set_geodetic(drive, geodetic_from_local(local_m * [-1.0, 1.0, 1.0], ecef_from_middle))
    drive.truth = Trajectory(
        timestamps_us=drive.truth.timestamps_us, world_from_rig=MIRROR @ drive.truth.world_from_rig @ MIRROR
    )


def _mirrored_camera(camera: dict[str, Any]) -> ImageChange:
    fx, fy, cx, cy = camera["params"]
    camera["params"] = [fx, fy, camera["width"] - cx, cy]
    pose = MIRROR @ matrix_from_pose(Pose(**camera["rig_from_cam"])) @ np.diag([-1.0, 1.0, 1.0, 1.0])
    camera["rig_from_cam"] = pose_from_matrix(pose).model_dump()
    return lambda image: image[:, ::-1]


def with_rig_origin(in_rig_m: tuple[float, float, float]) -> Variation:
    """Another point of the vehicle, given in the rig's frame, becomes the rig's origin."""

    def vary(drive: VariedDrive) -> None:
        for camera in drive.cameras:
            pose = camera["rig_from_cam"]
            pose["translation_m"] = np.subtract(pose["translation_m"], in_rig_m).tolist()
        gnss = drive.manifest["gnss"]
        gnss["antenna_in_rig_m"] = np.subtract(gnss["antenna_in_rig_m"], in_rig_m).tolist()
        moved = drive.truth.world_from_rig.copy()
        moved[:, :3, 3] += moved[:, :3, :3] @ np.array(in_rig_m)
        drive.truth = Trajectory(timestamps_us=drive.truth.timestamps_us, world_from_rig=moved)

    return vary


def with_cameras_in_reverse_order(drive: VariedDrive) -> None:
    """The last camera of the manifest becomes the first."""
    drive.cameras.reverse()
    for frame in drive.manifest["frames"]:
        frame["images"] = dict(reversed(frame["images"].items()))


def placed_at(latitude_deg: float, longitude_deg: float, height_m: float) -> Variation:
    """The middle of the receiver's positions is elsewhere on the earth; north stays north."""

    def vary(drive: VariedDrive) -> None:
        local_m, _ = _receiver_positions(drive)
        place = ecef_from_local([latitude_deg, longitude_deg, height_m])
        _set_geodetic(drive, geodetic_from_local(local_m, place))

    return vary


def _receiver_positions(drive: VariedDrive) -> tuple[Floats, Floats]:
    """Positions (n, 3) in metres east, north and up of their middle, and this frame's transform (4, 4)."""
    geodetic = np.array([[sample[key] for key in GEODETIC] for sample in drive.manifest["gnss"]["samples"]])
    ecef_from_middle = ecef_from_local(geodetic[len(geodetic) // 2])
    return local_from_geodetic(geodetic, ecef_from_middle), ecef_from_middle


def _set_geodetic(drive: VariedDrive, geodetic: Floats) -> None:
    for sample, place in zip(drive.manifest["gnss"]["samples"], geodetic.tolist(), strict=True):
        sample.update(zip(GEODETIC, place, strict=True))


def backwards(drive: VariedDrive) -> None:
    """Time runs backwards: the vehicle is in reverse gear."""
    times_us = [stamped["timestamp_us"] for stamped in _stamped(drive)]
    both_ends_us = min(times_us) + max(times_us)
    for stamped in _stamped(drive):
        stamped["timestamp_us"] = both_ends_us - stamped["timestamp_us"]
    drive.manifest["frames"].reverse()
    drive.manifest["gnss"]["samples"].reverse()
    drive.truth = Trajectory(
        timestamps_us=both_ends_us - drive.truth.timestamps_us[::-1], world_from_rig=drive.truth.world_from_rig[::-1]
    )


def with_clock_from(start_us: int) -> Variation:
    """The first timestamp of the manifest becomes this one."""

    def vary(drive: VariedDrive) -> None:
        later_us = start_us - min(stamped["timestamp_us"] for stamped in _stamped(drive))
        for stamped in _stamped(drive):
            stamped["timestamp_us"] += later_us
        drive.truth = Trajectory(
            timestamps_us=drive.truth.timestamps_us + later_us, world_from_rig=drive.truth.world_from_rig
        )

    return vary


def _stamped(drive: VariedDrive) -> Iterator[dict[str, Any]]:
    """Everything in the manifest that has a timestamp."""
    for frame in drive.manifest["frames"]:
        yield frame
        yield from (image for image in frame["images"].values() if "timestamp_us" in image)
    yield from drive.manifest["gnss"]["samples"]
