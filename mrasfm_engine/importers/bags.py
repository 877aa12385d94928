"""Imports a ROS bag: images, CameraInfo, transforms and positions of a receiver.

Source: the message definitions of sensor_msgs, tf2_msgs and geometry_msgs, REP 103 (axes: x forward, y left, z up; of a
camera x right, y down, z forward), REP 105 (names of frames). The rig frame is one that the vehicle's transforms have,
by default base_link. The bag is read twice, message by message: for what is in it, and for the images that are wanted.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mrasfm_engine.errors import InputError
from mrasfm_engine.importers.bag_cameras import camera_name
from mrasfm_engine.importers.bag_contents import (
    BagContent,
    read_content,
    stamp_ns,
    us_from_ns,
    wanted_topics,
    without_unusable,
)
from mrasfm_engine.importers.bag_images import file_content
from mrasfm_engine.importers.bag_positions import gnss_of_bag
from mrasfm_engine.importers.bag_reader import Bag, bag_files
from mrasfm_engine.importers.bag_rig import cameras_of_bag
from mrasfm_engine.importers.frame_grouping import units_by_time
from mrasfm_engine.importers.recording import ImageKey, Recording, SourceImage, SourceUnit

DESCRIPTION = "*.bag, *.mcap, *.db3 or metadata.yaml (ROS bag)"
OPTIONS = ("topics", "rig_frame", "world_frame", "calibration", "antenna_m", "gnss_sigma_m")
RIG_FRAME = "base_link"
READOUT_NOTE = (
    "Shutter: bags do not say whether a camera reads its rows one after the other. Set readout_us in drive.json where "
    "it is known."
)


def recognises(path: Path) -> bool:
    """Return whether the path is a bag, or a folder of bags of one format."""
    return bool(bag_files(path))


def read(
    path: Path,
    *,
    scratch: Path,
    topics: Sequence[str] = (),
    rig_frame: str | None = None,
    world_frame: str | None = None,
    calibration: Path | None = None,
    antenna_m: Sequence[float] | None = None,
    gnss_sigma_m: float | None = None,
) -> Recording:
    """Read everything but the images, which the recording's `contents` reads.

    Parameters
    ----------
    scratch
        Folder for files of the bag that are not compressed, made where they are needed; `contents` needs them too.
    topics
        Topics of images and of the receiver that are wanted; all others are left out. Empty: all.
    rig_frame
        Name of the vehicle's frame; axes x forward, y left, z up.
    world_frame
        A frame in which the transforms place the vehicle, as `odom` or `map`: its poses become rough poses.
    calibration
        Kalibr's `camchain.yaml`, whose lenses are used instead of CameraInfo and whose poses instead of tf where tf
        lacks a camera, or a `rig.json`, which replaces both.
    antenna_m
        Position (3,) of the receiver's antenna in the rig frame, instead of the transforms'.
    gnss_sigma_m
        Standard deviation of the receiver's horizontal positions, instead of its covariances; heights have twice that.

    Raises
    ------
    InputError
        If the bag is damaged, or lacks something that no option gives.
    """
    paths = bag_files(path)
    with Bag(paths, scratch) as bag:
        types = bag.types()
        images, fixes, notes = wanted_topics(types, topics, path)
        content = read_content(bag, types, images, fixes, keeps_motion=world_frame is not None)
    notes += without_unusable(content, is_asked=bool(topics))
    cameras, camera_notes = cameras_of_bag(content, calibration, rig_frame or RIG_FRAME)
    units = _units(content)
    if world_frame is not None:
        units = _rough_poses(content, units, world_frame, rig_frame or RIG_FRAME)
    # A rig.json has a frame of its own. That it is the transforms' one has to be said.
    is_placed = rig_frame is not None or calibration is None or calibration.suffix != ".json"
    shifts = {topic: found.shift for topic, found in content.images.items()}
    gnss, gnss_notes = gnss_of_bag(content, (rig_frame or RIG_FRAME) if is_placed else None, antenna_m, gnss_sigma_m)
    return Recording(
        layout="ROS bag",
        name=path.resolve().stem,
        cameras=cameras,
        units=units,
        gnss=gnss,
        notes=[*notes, *camera_notes, *gnss_notes, READOUT_NOTE],
        contents=lambda wanted: _contents(paths, scratch, wanted, shifts),
    )


def _units(content: BagContent) -> list[SourceUnit]:
    images = {}
    for topic, found in content.images.items():
        images[camera_name(topic)] = [
            SourceImage(file=Path(f"{stamp}{suffix}"), timestamp_us=us_from_ns(stamp), key=(topic, stamp))
            for stamp, suffix in sorted(found.suffixes.items())
        ]
    return units_by_time(images)


def _rough_poses(content: BagContent, units: list[SourceUnit], world_frame: str, rig_frame: str) -> list[SourceUnit]:
    times_us = np.array([unit.timestamp_us for unit in units], dtype=np.int64)
    poses, covered = content.transforms.moving(world_frame, rig_frame, times_us, what="--world-frame")
    by_time = dict(zip(covered.tolist(), poses, strict=True))
    if not by_time:
        raise InputError(
            f"--world-frame: the transforms from {rig_frame} to {world_frame} cover no image's time",
            remedy="Import without --world-frame.",
            code="missing-transform",
        )
    return [replace(unit, rough_world_from_rig=by_time.get(unit.timestamp_us)) for unit in units]


def _contents(
    paths: Sequence[Path], scratch: Path, wanted: Collection[ImageKey], shifts: Mapping[str, int]
) -> Iterator[tuple[ImageKey, bytes]]:
    """Files of the wanted images, as the bag has them one after the other."""
    missing = set(wanted)
    with Bag(paths, scratch) as bag:
        for entry in bag.entries({topic for topic, _ in wanted}):
            key = (entry.topic, stamp_ns(entry))
            if key in missing:
                missing.remove(key)
                yield key, file_content(entry.message, topic=entry.topic, shift=shifts[entry.topic])
            if not missing:
                return
