"""Contract of the writers of `export.formats`: what they are given, and what they must give back."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from mrasfm_engine.errors import InputError
from mrasfm_engine.export.check import Check
from mrasfm_engine.io.image_header import read_header
from mrasfm_engine.io.images import read_image_rgb, read_mask
from mrasfm_engine.scene.scene import Scene
from mrasfm_engine.scene.semantics import class_codes
from mrasfm_engine.types import Bools, Bytes, CountProgress
from schemas import LabelMap


@dataclass(frozen=True, kw_only=True)
class DriveFiles:
    """Images and masks of the drives of a scene or map.

    Attributes
    ----------
    folders
        Folders of the drives by the name of their scene; of a scene that is no map, by the empty name.
    label_maps
        Meanings of their masks' ids, by the same names.
    """

    folders: Mapping[str, Path]
    label_maps: Mapping[str, LabelMap | None] = field(default_factory=dict)

    def path(self, scene: str, file: str) -> Path:
        """Path of an image or mask of a scene by its name in the manifest."""
        return self.folders[scene] / file


@dataclass(frozen=True, kw_only=True)
class ExportSource:
    """A written scene or map that is exported.

    Attributes
    ----------
    scene
        Cameras, poses, keypoints, points. Of a map, cameras and images are called SCENE/NAME, units and images are
        numbered through, scene by scene; `scene.drive.images[i]` is the image i everywhere.
    scene_of_unit
        Name of the scene that each unit is of.
    own_cars
        Masks (h, w) by camera, true where it shows the vehicle itself; cameras that do not are absent.
    files
        Images and masks of the drives; None where no format asked for them.
    folder
        The scene's or map's own.
    masks_of_network
        Number of images whose mask a network made while the scene was reconstructed; such masks are not kept.
    components_elsewhere
        Folders of the parts of the drive that nothing links to this scene: they are scenes of their own.
    images_sha256
        A fingerprint of each camera's registered images, by its name, as `fingerprints_of_images` makes them; empty of
        maps, and of scenes of versions that did not record them.
    """

    scene: Scene
    name: str
    is_map: bool
    scene_of_unit: Sequence[str]
    own_cars: Mapping[str, Bools]
    files: DriveFiles | None = None
    folder: Path = Path()
    masks_of_network: int = 0
    components_elsewhere: Sequence[str] = ()
    images_sha256: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def registered(self) -> list[int]:
        """Images with a pose."""
        found: list[int] = np.flatnonzero(self.scene.image_registered).tolist()
        return found

    def place_of_file(self, file: str, image: int) -> tuple[str, str]:
        """Scene and name within its drive of a file that the scene's manifest names."""
        if not self.is_map:
            return "", file
        scene = self.scene_of_unit[self.scene.drive.images[image].unit]
        return scene, file.removeprefix(f"{scene}/")

    def image_path(self, image: int) -> Path:
        """Path of an image of the drive."""
        assert self.files is not None
        return self.files.path(*self.place_of_file(self.scene.drive.images[image].file, image))

    def content(self, image: int) -> bytes:
        """Bytes of an image's file.

        Raises
        ------
        InputError
            That names the file, where it is missing, damaged, or not of its camera's size.
        """
        path, camera = self.image_path(image), self.scene.drive.cameras[self.scene.drive.images[image].camera]
        header = read_header(path)
        if (header.width, header.height) != (camera.width, camera.height):
            raise InputError(
                f"image {path} has {header.width} x {header.height} pixels, camera {camera.name} has "
                f"{camera.width} x {camera.height}",
                remedy="Give the folder of the drive that the scene was made of.",
                code="other-drive",
            )
        return path.read_bytes()

    def pixels(self, image: int) -> Bytes:
        """An image (h, w, 3) of the drive.

        Raises
        ------
        InputError
            That names the file, where it is missing, damaged, or not of its camera's size.
        """
        path, camera = self.image_path(image), self.scene.drive.cameras[self.scene.drive.images[image].camera]
        result = read_image_rgb(path)
        if result.shape[:2] != (camera.height, camera.width):
            raise InputError(
                f"image {path} has {result.shape[1]} x {result.shape[0]} pixels, camera {camera.name} has "
                f"{camera.width} x {camera.height}",
                remedy="Give the folder of the drive that the scene was made of.",
                code="other-drive",
            )
        return result

    def mask_codes(self, image: int) -> Bytes | None:
        """Classes (h, w) of an image's pixels as `semantics.CLASS_CODES` numbers them; None without a mask."""
        source = self.scene.drive.images[image]
        if source.mask is None:
            return None
        assert self.files is not None
        scene, file = self.place_of_file(source.mask, image)
        labels = self.files.label_maps.get(scene)
        camera = self.scene.drive.cameras[source.camera]
        path = self.files.path(scene, file)
        mask = read_mask(path, labels)
        if mask.shape != (camera.height, camera.width):
            raise InputError(
                f"mask {path} has {mask.shape[1]} x {mask.shape[0]} pixels, camera {camera.name} has "
                f"{camera.width} x {camera.height}",
                remedy="Give the folder of the drive that the scene was made of.",
                code="other-drive",
            )
        return class_codes(mask, LabelMap.cityscapes() if labels is None else labels)


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Wishes of the user that formats heed where they apply.

    Attributes
    ----------
    image_size_px
        Longest side that images are scaled down to; None keeps their resolution.
    crs
        Coordinate reference system of coordinates on the earth, as `EPSG:25832`; None leaves it to the format.
    """

    image_size_px: int | None = None
    crs: str | None = None


@dataclass(frozen=True, kw_only=True)
class ExportWork:
    """One format being written.

    Attributes
    ----------
    folder
        Empty folder of the format.
    step
        Takes the number of what is done and of all (images, say), and raises CancelledError where the export is no
        longer wanted: a writer that takes long calls it between its parts.
    threads
        Threads that the writer may use.
    """

    source: ExportSource
    options: ExportOptions
    folder: Path
    step: CountProgress
    threads: int = 1


@dataclass(frozen=True, kw_only=True)
class Written:
    """Result of a writer.

    Attributes
    ----------
    checks
        A check of every file, by its path below the format's folder, that reads it back with other code than wrote it.
        A file that no check covers, and one whose check fails, withholds the format.
    notes
        What the format lacks of the scene, and why, for the user.
    digests
        SHA-256 of files by the same paths, of what was to be written: they are compared before the checks.
    """

    checks: Sequence[Check]
    notes: Sequence[str] = ()
    digests: Mapping[str, str] = field(default_factory=dict)


# Writes all files of a format into the work's folder. A user's mistake is an InputError; whatever else it raises
# withholds the format.
Writer = Callable[[ExportWork], Written]
