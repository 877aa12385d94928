"""A scene with pinhole images: the same units and points, seen by the views of `pinhole_views`, and their files."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mrasfm_engine.errors import MrasfmError
from mrasfm_engine.export.check import Check
from mrasfm_engine.export.comparisons import Row, Rows
from mrasfm_engine.export.contract import ExportSource, ExportWork
from mrasfm_engine.export.file_contents import sha256
from mrasfm_engine.export.pinhole_views import PinholeView, pinhole_views
from mrasfm_engine.geometry import se3
from mrasfm_engine.geometry.camera_model import pack_camera, project_points, unproject_pixels
from mrasfm_engine.io.images import mask_png
from mrasfm_engine.parallel import in_order
from mrasfm_engine.scene.drive import Drive, pose_from_matrix
from mrasfm_engine.scene.scene import ImageFeatures, Scene
from mrasfm_engine.scene.semantics import CLASS_CODES
from mrasfm_engine.types import Bools, Bytes, Floats, Ints
from schemas import Camera, DriveManifest, Frame, FrameImage, Rig, SemanticClass

IMAGES, MASKS = "images", "masks"
JPEG_QUALITY = 95
IGNORED = (CLASS_CODES[SemanticClass.DYNAMIC], CLASS_CODES[SemanticClass.OWN_CAR])
USED, UNUSED = 255, 0  # values of a mask
MIN_OBSERVATIONS = 2  # of a point
MAX_NAME_BYTES = 200  # of a file


@dataclass(frozen=True, kw_only=True)
class UndistortedScene:
    """A scene with pinhole images.

    Attributes
    ----------
    scene
        Its cameras are views, its images those of registered ones; points that the views do not observe twice are left
        out.
    views
        View of each of its cameras, and `camera_of_view`, which camera of the source that is a view of.
    image_of
        Image of the source that each of its images is a view of.
    """

    source: ExportSource
    scene: Scene
    views: Sequence[PinholeView]
    camera_of_view: Sequence[int]
    image_of: Sequence[int]

    def notes(self) -> list[str]:
        """Words on what the pinhole images do not have."""
        cameras = self.source.scene.drive.cameras
        wide = [cameras[k].name for k in dict.fromkeys(self.camera_of_view) if self.camera_of_view.count(k) > 1]
        lost = len(self.source.scene.points_m) - len(self.scene.points_m)
        rolling = [camera.name for camera in cameras if camera.readout_us]
        return [
            *([f"wide cameras have two images each, of their left and right: {', '.join(wide)}"] if wide else []),
            *([f"{lost} points are left out: the pinhole images show them less than twice"] if lost else []),
            *([f"images have the pose of their middle row: {', '.join(rolling)}"] if rolling else []),
            *self._missing_masks(),
        ]

    def _missing_masks(self) -> Iterator[str]:
        made = self.source.masks_of_network
        if made:
            yield (
                f"no mask has the moving objects of {made} images: the network's masks are not kept with a scene, only "
                "those of the drive are"
            )
        if self.source.is_map:
            yield "no mask has the own car: a map does not keep its masks, only scenes do"


def undistorted(source: ExportSource, image_size_px: int | None) -> UndistortedScene:
    """Cameras, poses, keypoints and points of a scene's pinhole images."""
    scene = source.scene
    views: list[PinholeView] = []
    camera_of_view: list[int] = []
    for k, camera in enumerate(scene.drive.cameras):
        own = pinhole_views(camera, scene.calibration[k].params, image_size_px)
        views += own
        camera_of_view += [k] * len(own)
    drive, image_of = _drive(source, views, camera_of_view)
    features, rows = _observations(scene, drive, views, image_of)
    counts = np.bincount(rows[:, 0], minlength=len(scene.points_m))
    kept = counts >= MIN_OBSERVATIONS
    number = np.cumsum(kept) - 1
    rows = rows[kept[rows[:, 0]]]
    rows = rows[np.lexsort((rows[:, 2], rows[:, 1], rows[:, 0]))]
    unit_from_image = None if scene.unit_from_image is None else scene.unit_from_image[image_of]
    calibration = [
        replace(
            scene.calibration[k],
            rig_from_cam=scene.calibration[k].rig_from_cam @ se3.transform(view.cam_from_view, np.zeros(3)),
            params=np.array(view.params),
        )
        for k, view in zip(camera_of_view, views, strict=True)
    ]
    result = Scene(
        drive=drive,
        unit_registered=scene.unit_registered,
        image_registered=np.ones(len(image_of), dtype=np.bool_),
        world_from_rig=scene.world_from_rig,
        sigma_position_m=scene.sigma_position_m,
        calibration=calibration,
        points_m=scene.points_m[kept],
        point_colors=scene.point_colors[kept],
        point_error_px=np.zeros(int(kept.sum())),
        point_classes=scene.point_classes[kept],
        observation_point=number[rows[:, 0]],
        observation_image=rows[:, 1],
        observation_keypoint=rows[:, 2],
        features=features,
        pairs=[],
        georeference=scene.georeference,
        rough_world_from_local=scene.rough_world_from_local,
        unit_from_image=unit_from_image,
        rig_of_camera=scene.rig_of_camera[camera_of_view],
        unit_component=scene.unit_component,
    )
    errors = reprojection_errors_px(result)
    total = np.bincount(result.observation_point, errors, minlength=len(result.points_m))
    result.point_error_px = total / np.bincount(result.observation_point, minlength=len(result.points_m)).clip(1)
    return UndistortedScene(source=source, scene=result, views=views, camera_of_view=camera_of_view, image_of=image_of)


def reprojection_errors_px(scene: Scene) -> Floats:
    """Distance (n,) of each observation from the projection of its point."""
    errors = np.empty(len(scene.observation_point))
    poses = se3.inverse(scene.world_from_cam)
    for i in np.unique(scene.observation_image).tolist():
        rows = np.flatnonzero(scene.observation_image == i)
        camera = scene.drive.images[i].camera
        lens = pack_camera(scene.drive.cameras[camera].model, scene.calibration[camera].params)
        projected = project_points(*lens, se3.apply(poses[i], scene.points_m[scene.observation_point[rows]]))
        errors[rows] = np.linalg.norm(projected - scene.features[i].xy_px[scene.observation_keypoint[rows]], axis=1)
    return np.where(np.isfinite(errors), errors, 0.0)


def _drive(
    source: ExportSource, views: Sequence[PinholeView], camera_of_view: Sequence[int]
) -> tuple[Drive, list[int]]:
    """The drive of the views' images, and the image of the source that each is a view of.

    All images lie in one folder: loaders that ask for the last part of a name find them, too.
    """
    scene = source.scene
    names = [
        scene.drive.cameras[k].name.replace("/", ".") + (f".{view.side}" if view.side else "")
        for k, view in zip(camera_of_view, views, strict=True)
    ]
    if len(set(names)) != len(names) or max(len(name.encode()) for name in names) > MAX_NAME_BYTES:
        raise ValueError(f"names of its cameras make no names of files: {', '.join(names)}")
    cameras = [
        Camera.model_construct(
            name=name,
            model="PINHOLE",
            width=view.width,
            height=view.height,
            params=view.params,
            rig_from_cam=pose_from_matrix(
                scene.calibration[k].rig_from_cam @ se3.transform(view.cam_from_view, np.zeros(3))
            ),
            readout_us=None,
        )
        for name, k, view in zip(names, camera_of_view, views, strict=True)
    ]
    of_unit: dict[int, dict[int, int]] = {}  # by unit and camera: the image
    for i in source.registered:
        of_unit.setdefault(scene.drive.images[i].unit, {})[scene.drive.images[i].camera] = i
    frames: list[Frame] = []
    image_of: list[int] = []
    for u, frame in enumerate(scene.drive.manifest.frames):
        images: dict[str, FrameImage] = {}
        for name, k in zip(names, camera_of_view, strict=True):
            found = of_unit.get(u, {}).get(k)
            if found is None:
                continue
            original = scene.drive.images[found]
            kind = "jpg" if original.file.lower().endswith((".jpg", ".jpeg")) else "png"
            images[name] = FrameImage.model_construct(
                file=f"{name}.{u:06d}.{kind}", timestamp_us=original.timestamp_us, mask=None
            )
            image_of.append(found)
        frames.append(frame.model_copy(update={"images": images}))
    manifest = DriveManifest.model_construct(
        name=source.name, rig=Rig.model_construct(cameras=cameras), frames=frames, notes=[]
    )
    return Drive(Path(), manifest), image_of


def _observations(
    scene: Scene, drive: Drive, views: Sequence[PinholeView], image_of: Sequence[int]
) -> tuple[list[ImageFeatures], Ints]:
    """Keypoints of the views' images that observe a point, and the observations (n, 3): point, image, keypoint."""
    by_image: dict[int, Ints] = {}
    order = np.argsort(scene.observation_image, kind="stable")
    images, first = np.unique(scene.observation_image[order], return_index=True)
    for i, rows in zip(images.tolist(), np.split(order, first[1:]), strict=True):
        by_image[i] = rows
    features, found = [], [np.zeros((0, 3), np.int64)]
    for number, (image, i) in enumerate(zip(drive.images, image_of, strict=True)):
        rows = by_image.get(i, np.zeros(0, np.int64))
        camera = scene.drive.images[i].camera
        lens = pack_camera(scene.drive.cameras[camera].model, scene.calibration[camera].params)
        xy = scene.features[i].xy_px[scene.observation_keypoint[rows]].astype(np.float64)
        pixels, shown = views[image.camera].pixels(unproject_pixels(*lens, xy))
        features.append(
            ImageFeatures(
                xy_px=pixels[shown].astype(np.float32),
                descriptors=np.zeros((0, 128), np.uint8),
                colors=np.zeros((0, 3), np.uint8),
            )
        )
        points = scene.observation_point[rows[shown]]
        found.append(np.column_stack([points, np.full(len(points), number), np.arange(len(points))]))
    return features, np.concatenate(found).astype(np.int64)


def write_images(work: ExportWork, made: UndistortedScene) -> list[Check]:
    """Write `images/NAME` and, where any pixel is not to be used, `masks/NAME.png` of all images; their checks."""
    folder = work.folder
    (folder / IMAGES).mkdir()
    digests: dict[str, dict[str, str]] = {IMAGES: {}, MASKS: {}}
    masked = _has_masks(made)
    if masked:
        (folder / MASKS).mkdir()
    done, total = 0, len(made.image_of)
    for view in range(len(made.views)):
        items = [i for i, image in enumerate(made.scene.drive.images) if image.camera == view]
        if not items:
            continue
        maker = ImageMaker(made, view, masked=masked)
        for image, mask, number in in_order(work.threads, maker.encoded, items):
            name = made.scene.drive.images[number].file
            for kind, file, data in ((IMAGES, name, image), (MASKS, f"{name}.png", mask)):
                if data is not None:
                    (folder / kind / file).write_bytes(data)
                    digests[kind][file] = hashlib.sha256(data).hexdigest()
            done += 1
            work.step(done, total)
    kinds = [kind for kind in (IMAGES, MASKS) if digests[kind]]
    return [Check(kind, folder_digests, partial(same_digests, digests[kind])) for kind in kinds]


def _has_masks(made: UndistortedScene) -> bool:
    source = made.source
    masks = any(source.scene.drive.images[i].mask is not None for i in made.image_of)
    return masks or bool(source.own_cars) or any(not view.all() for view in _shown(made))


def _shown(made: UndistortedScene) -> Iterator[Bools]:
    for view, k in zip(made.views, made.camera_of_view, strict=True):
        scene = made.source.scene
        yield view.lookup(scene.drive.cameras[k], scene.calibration[k].params)[1]


class ImageMaker:
    """Pinhole images of one view, with the table of where they are looked up."""

    def __init__(self, made: UndistortedScene, view: int, *, masked: bool) -> None:
        self._made, self._view, self._masked = made, made.views[view], masked
        source, k = made.source, made.camera_of_view[view]
        self._camera = source.scene.drive.cameras[k]
        self._places, self._inside = self._view.lookup(self._camera, source.scene.calibration[k].params)
        self._own_car = source.own_cars.get(self._camera.name)

    def encoded(self, number: int) -> tuple[bytes, bytes | None, int]:
        """The image, its mask if there are masks, and the number that it was asked for by."""
        image = self._made.scene.drive.images[number]
        original = self._made.image_of[number]
        pixels = self._scaled(self._looked_up(self._made.source.pixels(original), cv2.INTER_CUBIC))
        kind = Path(image.file).suffix
        settings = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if kind == ".jpg" else []
        if kind == ".jpg":
            settings += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
        data = cv2.imencode(kind, pixels[..., ::-1], settings)[1].tobytes()
        mask = mask_png(self._mask(original)).tobytes() if self._masked else None
        return data, mask, number

    def _mask(self, original: int) -> Bytes:
        codes = self._made.source.mask_codes(original)
        unused = np.zeros((self._camera.height, self._camera.width), np.uint8)
        if codes is not None:
            unused[np.isin(codes, IGNORED)] = 255
        if self._own_car is not None:
            unused[self._own_car] = 255
        seen = self._looked_up(unused, cv2.INTER_LINEAR) > 0
        blank = seen | ~self._inside
        # A pixel that is partly unused is unused.
        scaled = self._scaled(np.where(blank, np.uint8(255), np.uint8(0)))
        return np.where(scaled > 0, np.uint8(UNUSED), np.uint8(USED))

    def _looked_up(self, pixels: Bytes, interpolation: int) -> Bytes:
        try:
            found = cv2.remap(
                pixels, self._places[..., 0], self._places[..., 1], interpolation, borderMode=cv2.BORDER_REPLICATE
            )
        except cv2.error as error:
            raise _not_made(self._camera.name, error) from error
        result = np.asarray(found, dtype=np.uint8)
        result[~self._inside] = 0
        return result

    def _scaled(self, pixels: Bytes) -> Bytes:
        size = (self._view.width, self._view.height)
        if pixels.shape[1::-1] == size:
            return pixels
        return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _not_made(camera: str, error: Any) -> MrasfmError:
    return MrasfmError(
        f"an image of camera {camera} cannot be undistorted: {str(error).strip()}",
        remedy="This is a defect of mrasfm, please report it.",
        code="bad-picture",
    )


def folder_digests(folder: Path) -> dict[str, str]:
    """SHA-256 of all files in a folder, by their names."""
    return {path.name: sha256(path) for path in sorted(folder.iterdir())}


def same_digests(expected: dict[str, str], found: dict[str, str]) -> Rows:
    """Every file's content, and that there is no other."""
    for name, digest in expected.items():
        yield Row(f"{name}'s content", found.get(name, "missing"), digest)
    yield Row("its list of files", sorted(found), sorted(expected))
