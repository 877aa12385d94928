"""Imports a sequence of KITTI odometry as it is distributed.

Source: Geiger et al., "Are we ready for Autonomous Driving? The KITTI Vision Benchmark Suite", CVPR 2012, and the
benchmark's development kit: P0 to P3 project rectified coordinates of camera 0 (x right, y down, z forward), poses map
camera 0's coordinates into those of its first frame.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mrasfm_engine.errors import InputError
from mrasfm_engine.geometry import se3
from mrasfm_engine.importers.recording import Recording, SourceImage, SourceUnit, pose_of_projection
from mrasfm_engine.importers.rig_folder import frame_times, numbered_images, pinhole_camera, read_upright_poses
from mrasfm_engine.importers.skipped_images import notes_of_empty_cameras, unread_files
from mrasfm_engine.importers.tables import read_lines
from mrasfm_engine.io.axes import flu_from_body
from mrasfm_engine.types import Floats
from schemas import BodyAxes, Camera

DESCRIPTION = "calib.txt and image_0 to image_3 (KITTI odometry)"
OPTIONS: tuple[str, ...] = ()
CAMERAS = ("image_0", "image_1", "image_2", "image_3")


def recognises(folder: Path) -> bool:
    """Return whether the folder has this layout."""
    return (folder / "calib.txt").is_file() and any((folder / name).is_dir() for name in CAMERAS)


def read(folder: Path) -> Recording:
    """Read the sequence; the rig frame is x forward, y left, z up at rectified camera 0.

    Raises
    ------
    InputError
        If a file is missing or malformed.
    """
    names = [name for name in CAMERAS if (folder / name).is_dir()]
    every = {name: numbered_images(folder / name) for name in names}
    images = {name: files for name, files in every.items() if files}
    frames = sorted({frame for files in images.values() for frame in files})
    if not frames:
        raise InputError(f"recording {folder} has no images in {', '.join(names)}", remedy="Unpack the images.")
    flu_body = flu_from_body(BodyAxes.RDF)
    projections = _projections(folder / "calib.txt")
    cameras = [_camera(name, files, projections, flu_body, folder) for name, files in images.items()]
    times_us = frame_times(folder, frames)
    truth = read_upright_poses(_truth_file(folder), frames, flu_body, required_up=False)
    units = [
        SourceUnit(
            source_frame=frame,
            timestamp_us=times_us[i],
            images={name: SourceImage(file=files[frame]) for name, files in images.items() if frame in files},
            world_from_rig=None if truth is None else truth[i],
        )
        for i, frame in enumerate(frames)
    ]
    return Recording(
        layout="KITTI odometry",
        name=f"kitti-{folder.resolve().name}",
        cameras=cameras,
        units=units,
        body_axes=BodyAxes.RDF,
        notes=notes_of_empty_cameras(every),
        unread_files={name: unread_files(folder / name) for name in names},
    )


def _truth_file(folder: Path) -> Path:
    own = folder / "poses.txt"
    sequence = folder.resolve()
    return own if own.exists() else sequence.parent.parent / "poses" / f"{sequence.name}.txt"


def _projections(file: Path) -> dict[str, Floats]:
    """P matrices (3, 4) of `calib.txt` by camera folder."""
    found: dict[str, Floats] = {}
    for number, line in enumerate(read_lines(file, what="calibration"), start=1):
        key, _, rest = line.partition(":")
        if key not in ("P0", "P1", "P2", "P3"):
            continue  # as Tr, the laser scanner's pose
        try:
            values = np.array([float(word) for word in rest.split()])
        except ValueError:
            values = np.empty(0)
        if values.shape != (12,) or not np.isfinite(values).all():
            raise InputError(
                f"calibration {file}, line {number}: {key} is not 12 numbers",
                remedy="Give the calib.txt of the benchmark.",
                code="bad-calibration",
            )
        found[f"image_{key[1]}"] = values.reshape(3, 4)
    return found


def _camera(
    name: str, images: dict[int, Path], projections: dict[str, Floats], flu_body: Floats, folder: Path
) -> Camera:
    file = folder / "calib.txt"
    if name not in projections:
        raise InputError(
            f"calibration {file} has no P{name[-1]}, the matrix of camera {name}",
            remedy=f"Give it, or take the folder {name} away.",
            code="bad-calibration",
        )
    projection, source = projections[name], f"{file}: P{name[-1]}"
    rig_from_cam = flu_body @ se3.inverse(pose_of_projection(projection, what=source))
    return pinhole_camera(name, images, projection[:, :3], rig_from_cam, source=source)
