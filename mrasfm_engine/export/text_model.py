"""COLMAP's text model of a binary one: COLMAP writes it, and code of ours reads it beside the binary files.

The binary model is compared with the scene (`comparisons`), so that the text need only say what the binary files say.
Where the model is large, all of this has a process of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mrasfm_engine.export import readers
from mrasfm_engine.export.colmap_io import ModelRead, binary_model, by_itself, read_of
from mrasfm_engine.export.comparisons import POSE_TOLERANCE, Row, Rows
from mrasfm_engine.export.file_contents import sha256
from mrasfm_engine.export.readers import ModelImage
from mrasfm_engine.types import Floats, Ints


@dataclass(frozen=True, kw_only=True)
class TextModel:
    """A text model that was written.

    Attributes
    ----------
    binary
        The binary model, as COLMAP has read it.
    digests
        SHA-256 of the text files, by name.
    fault
        The first file that cannot be read or does not say what the binary files say; empty where there is none.
    """

    binary: ModelRead
    digests: Mapping[str, str]
    fault: str

    def require_equal(self) -> None:
        """Refuse a text model that has a fault.

        Raises
        ------
        ValueError
            Where it has one.
        """
        if self.fault:
            raise ValueError(self.fault)


def write_text_model(binary_folder: Path, folder: Path) -> TextModel:
    """Write the text model of a binary one into another folder, and read both."""
    return by_itself(_write_and_read, binary_folder, folder)


def _write_and_read(binary_folder: Path, folder: Path) -> TextModel:
    model = binary_model(binary_folder)
    model.write_text(str(folder))
    binary = read_of(model)
    del model  # what is read needs its memory
    digests = {name: sha256(folder / name) for name in FILES}
    return TextModel(binary=binary, digests=digests, fault=find_fault(binary, binary_folder, folder))


def find_fault(binary: ModelRead, binary_folder: Path, folder: Path) -> str:
    """The first file of a text model that cannot be read or does not say what the binary files say, and why."""
    for name, rows_of in FILES.items():
        try:
            for row in rows_of(binary, binary_folder, folder / name):
                if not row.agrees:
                    return f"{name}: {row.difference}"
        except (ValueError, LookupError) as error:
            return f"{name}: {type(error).__name__}: {error}"
    return ""


def _cameras(binary: ModelRead, binary_folder: Path, path: Path) -> Rows:
    found = readers.cameras_text(path)
    yield Row("the list of cameras", sorted(found), sorted(binary.cameras))
    for number, known in binary.cameras.items():
        camera = found[number]
        yield Row(f"camera {number}", (camera.model, camera.size_px), (known.model, known.size_px))
        yield Row(f"the params of camera {number}", camera.params, known.params)


def _rigs(binary: ModelRead, binary_folder: Path, path: Path) -> Rows:
    found = readers.rigs_text(path)
    yield Row("the list of rigs", sorted(found), sorted(binary.rigs))
    for number, known in binary.rigs.items():
        rig = found[number]
        sensors = (rig.sensors, rig.reference_is_imu, sorted(rig.cam_from_rig))
        yield Row(f"rig {number}", sensors, (known.sensors, known.reference_is_imu, sorted(known.cam_from_rig)))
        for camera, pose in known.cam_from_rig.items():
            yield Row(f"the pose of camera {camera}", rig.cam_from_rig[camera], pose, POSE_TOLERANCE)


def _frames(binary: ModelRead, binary_folder: Path, path: Path) -> Rows:
    found = readers.frames_text(path)
    cameras = {image: camera for frame in found.values() for image, camera in frame.cameras.items()}
    known_cameras = {number: image.camera_id for number, image in binary.images.items()}
    yield Row("the cameras of its images", cameras, known_cameras)
    for number, image in binary.images.items():
        frame = found[image.frame_id]
        yield Row(f"image {number} of frame {image.frame_id}", number in frame.cameras, True)
        cam_from_rig = _square(binary.rigs[frame.rig_id].cam_from_rig[image.camera_id])
        composed, known = (cam_from_rig @ frame.rig_from_world)[:3], image.cam_from_world
        if known is not None:
            yield Row(f"the pose of frame {image.frame_id}", composed, known, POSE_TOLERANCE)
    yield Row("the number of its frames", len(found), len({image.frame_id for image in binary.images.values()}))


def _square(pose: Floats) -> Floats:
    return np.vstack([pose, [0.0, 0.0, 0.0, 1.0]])


def _images(binary: ModelRead, binary_folder: Path, path: Path) -> Rows:
    known = {image.image_id: image for image in readers.images_binary(binary_folder / "images.bin")}
    for image in readers.images_text(path):
        yield Row(f"image {image.image_id}", image.image_id in known, True)
        yield from _image(image, known.pop(image.image_id))
    yield Row("what it lacks of the images", sorted(known), [])


def _image(found: ModelImage, known: ModelImage) -> Rows:
    yield Row(f"image {known.image_id}", (found.name, found.camera_id), (known.name, known.camera_id))
    written, pose = np.array(found.cam_from_world), np.array(known.cam_from_world)
    # A quaternion and its negative are one rotation; in text COLMAP writes the one with a positive w.
    written[:4] *= np.copysign(1.0, written[:4] @ pose[:4])
    yield Row(f"the pose of {known.name}", written, pose, POSE_TOLERANCE)
    yield Row(f"a keypoint of {known.name}", found.xy_px, known.xy_px, POSE_TOLERANCE)
    yield Row(f"a point seen in {known.name}", found.point_ids, known.point_ids)


def _points(binary: ModelRead, binary_folder: Path, path: Path) -> Rows:
    """Every point with its track; COLMAP writes them in an order of its own."""
    known = readers.points_binary(binary_folder / "points3D.bin")
    yield Row("the order of the binary model's points", known.ids, np.sort(known.ids))
    times_read = np.zeros(len(known.ids), dtype=np.int64)
    first = np.searchsorted(known.observations[:, 0], known.ids)
    last = np.searchsorted(known.observations[:, 0], known.ids, side="right")
    for part in readers.points_text(path):
        index = np.searchsorted(known.ids, part.ids)
        yield Row("a point id", known.ids[np.minimum(index, len(known.ids) - 1)], part.ids)
        np.add.at(times_read, index, 1)
        yield Row("a point", part.xyz, known.xyz[index], POSE_TOLERANCE)
        yield Row("a colour", part.colors, known.colors[index], 0.0)
        yield Row("an error", part.errors, known.errors[index], POSE_TOLERANCE)
        expected = known.observations[_ranges(first[index], last[index])]
        yield Row("a track", _sorted_rows(part.observations), _sorted_rows(expected))
    yield Row("the number of its lines about a point", times_read, np.ones_like(times_read))


def _ranges(first: Ints, last: Ints) -> Ints:
    """Whole numbers from each first to before each last."""
    counts = last - first
    result: Ints = np.arange(counts.sum()) + np.repeat(first - np.cumsum(counts) + counts, counts)
    return result


def _sorted_rows(rows: Ints) -> Ints:
    result: Ints = rows[np.lexsort(rows.T)]
    return result


FILES: dict[str, Callable[[ModelRead, Path, Path], Rows]] = {
    "cameras.txt": _cameras,
    "rigs.txt": _rigs,
    "frames.txt": _frames,
    "images.txt": _images,
    "points3D.txt": _points,
}
