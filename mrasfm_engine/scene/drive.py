"""A drive as the engine sees it: a checked manifest, the folder it lives in, and arrays instead of models."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from pathlib import Path

import numpy as np

from mrasfm_engine.geometry import se3
from mrasfm_engine.types import Bools, BringFile, Floats, Ints
from schemas import Camera, DriveManifest, Frame, Pose, Rig


def matrix_from_pose(pose: Pose) -> Floats:
    """The 4x4 transform of a manifest's pose."""
    return se3.transform(se3.rotation_from_quaternion(pose.rotation_xyzw), pose.translation_m)


def pose_documents(a_from_b: Floats) -> list[dict[str, list[float]]]:
    """Poses as the manifest's JSON has them, of transforms (n, 4, 4)."""
    quaternions = se3.quaternion_from_rotation(a_from_b[:, :3, :3]).tolist()
    return [
        {"rotation_xyzw": rotation, "translation_m": translation}
        for rotation, translation in zip(quaternions, a_from_b[:, :3, 3].tolist(), strict=True)
    ]


def pose_from_matrix(a_from_b: Floats) -> Pose:
    """A manifest's pose of a 4x4 transform."""
    (document,) = pose_documents(a_from_b[None])
    return Pose(**document)


class LeftOut(StrEnum):
    """Reason for not using an image of which all or some pixels are there."""

    TRUNCATED = "truncated"
    CORRUPT = "corrupt"
    REPEATED = "repeated"  # the one before it once more


INCOMPLETE = frozenset({LeftOut.TRUNCATED, LeftOut.CORRUPT})


@dataclass(frozen=True, kw_only=True)
class DriveImage:
    """One image of the drive; its position in `Drive.images` is its index everywhere in the engine."""

    unit: int  # index into manifest.frames
    camera: int  # index into manifest.rig.cameras
    file: str  # relative to the drive's folder
    timestamp_us: int
    mask: str | None


@dataclass(frozen=True)
class Drive:
    """A recorded drive that can be reconstructed.

    `manifest.rig.body_axes` is always `flu`: readers convert other axes once, when they load.
    """

    root: Path
    manifest: DriveManifest
    bring: BringFile | None = field(default=None, compare=False, repr=False)  # None: all files are in the folder

    def path_of(self, file: str) -> Path:
        """Path of an image or mask by its name in the manifest; read it at once.

        A drive may be larger than the disk: then the file comes now, and goes when others take its place.

        Raises
        ------
        StorageError
            Where it does not come.
        """
        if self.bring is not None:
            self.bring(file)
        return self.root / file

    @property
    def cameras(self) -> list[Camera]:
        """The rig's cameras, in manifest order."""
        return self.manifest.rig.cameras

    def restricted_to(self, units: Bools) -> Drive:
        """The drive of some of its units (units,) alone."""
        frames = [frame for frame, is_wanted in zip(self.manifest.frames, units.tolist(), strict=True) if is_wanted]
        return self._with_frames(frames)

    def part(self, units: range) -> Drive:
        """The drive of units that follow one another alone."""
        return self._with_frames(self.manifest.frames[units.start : units.stop])

    def with_rig(self, rig: Rig) -> Drive:
        """The drive with another description of its cameras."""
        return replace(self, manifest=self.manifest.model_copy(update={"rig": rig}))

    def _with_frames(self, frames: list[Frame]) -> Drive:
        return replace(self, manifest=self.manifest.model_copy(update={"frames": frames}))

    @cached_property
    def images(self) -> list[DriveImage]:
        """All images, by unit and then by camera in manifest order."""
        order = {camera.name: k for k, camera in enumerate(self.cameras)}
        return [
            DriveImage(
                unit=u,
                camera=order[name],
                file=image.file,
                timestamp_us=frame.timestamp_us if image.timestamp_us is None else image.timestamp_us,
                mask=image.mask,
            )
            for u, frame in enumerate(self.manifest.frames)
            for name, image in sorted(frame.images.items(), key=lambda item: order[item[0]])
        ]

    @cached_property
    def has_single_camera(self) -> bool:
        """True if all images are of one camera, however many the rig has; such a drive has no scale."""
        return len({image.camera for image in self.images}) == 1

    @cached_property
    def timestamps_us(self) -> Ints:
        """The units' timestamps (units,)."""
        return np.array([frame.timestamp_us for frame in self.manifest.frames], dtype=np.int64)

    @cached_property
    def rig_from_cam(self) -> Floats:
        """The given calibration (cameras, 4, 4)."""
        return np.stack([matrix_from_pose(camera.rig_from_cam) for camera in self.cameras])
