"""A scene as input of an aggregation: poses, calibration, points, keypoints and descriptors, in a few arrays.

All of it comes from the folder that `mrasfm reconstruct` wrote, without its images and its finished stages.
"""

from __future__ import annotations

import hashlib
import json
import sys
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.aggregation.lenses import Lens
from mrasfm_engine.geometry import se3
from mrasfm_engine.io.stage_store import Arrays
from mrasfm_engine.scene.drive import Drive, matrix_from_pose
from mrasfm_engine.types import Bools, Bytes, Floats, Floats32, Ints
from schemas import DriveManifest, Pose

ARRAYS = (
    "unit_registered", "world_from_rig", "sigma_position_m", "image_registered", "unit_from_image",
    "points_m", "point_colors", "point_errors_px", "point_classes",
    "keypoint_first", "keypoint_xy_px", "keypoint_point", "descriptors", "ecef_from_local",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class SourceScene:
    """One scene in its own local frame. Its drive's manifest has the refined calibration."""

    name: str
    manifest: DriveManifest
    calibration: dict[str, Any]  # calibration.json
    report: dict[str, Any]  # what the scene's report says that a map repeats
    features_kind: str  # which extractor, and model, made the descriptors
    height_datum: str  # as declared; heights here are ellipsoidal
    common_world: str | None  # of rough poses, where the scene is not georeferenced
    ecef_from_local: Floats  # (4, 4); where not georeferenced, rough_world_from_local; NaN where not placed
    unit_registered: Bools  # (u,)
    world_from_rig: Floats  # (u, 4, 4), NaN where not registered
    sigma_position_m: Floats  # (u, 3), NaN where not known
    image_registered: Bools  # (i,)
    unit_from_image: Floats  # (i, 4, 4), or (0, 4, 4) where all images are at their unit's time
    points_m: Floats  # (p, 3)
    point_colors: Bytes  # (p, 3)
    point_errors_px: Floats  # (p,)
    point_classes: Bytes  # (p,)
    keypoint_first: Ints  # (i + 1,)
    keypoint_xy_px: Floats32  # (n, 2)
    keypoint_point: Ints  # (n,) -1 for none
    descriptors: NDArray[Any]  # (m, D) of the keypoints that observe a point, in their order
    is_placed: bool = True  # positions, or rough poses of a common world, say where it is
    footprints: dict[float, Floats] = field(default_factory=dict, repr=False, compare=False)  # by depth; see footprint

    @cached_property
    def drive(self) -> Drive:
        """The drive, with the refined calibration. Its images need not exist."""
        return Drive(Path(), self.manifest)

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 over all that aggregation sees of the scene; the name is not part of it."""
        digest = hashlib.sha256(json.dumps(self._documents(), sort_keys=True).encode())
        for name in ARRAYS:
            digest.update(np.ascontiguousarray(getattr(self, name)).tobytes())
        return digest.hexdigest()

    @cached_property
    def image_unit(self) -> Ints:
        """(i,)."""
        return np.array([image.unit for image in self.drive.images], dtype=np.int64)

    @cached_property
    def image_camera(self) -> Ints:
        """(i,)."""
        return np.array([image.camera for image in self.drive.images], dtype=np.int64)

    @cached_property
    def image_matchable(self) -> Bools:
        """(i,) registered images with keypoints: those of units that stood have none, others show the same."""
        return self.image_registered & (np.diff(self.keypoint_first) > 0)

    @cached_property
    def keypoint_image(self) -> Ints:
        """(n,)."""
        return np.repeat(np.arange(len(self.image_unit)), np.diff(self.keypoint_first))

    @cached_property
    def world_from_cam(self) -> Floats:
        """Poses (i, 4, 4) of all images in the scene's frame; NaN where not registered."""
        poses = self.world_from_rig[self.image_unit]
        if len(self.unit_from_image):
            poses = poses @ self.unit_from_image
        result: Floats = poses @ self.drive.rig_from_cam[self.image_camera]
        result[~self.image_registered] = np.nan
        return result

    @cached_property
    def descriptor_row(self) -> Ints:
        """Row of each keypoint's (n,) descriptor, -1 for none."""
        known = self.keypoint_point >= 0
        return np.where(known, np.cumsum(known) - 1, -1)

    @cached_property
    def trajectory_m(self) -> Floats:
        """Positions (r, 3) of the registered units in the scene's frame."""
        return self.world_from_rig[self.unit_registered, :3, 3]

    @cached_property
    def certainty_of_cameras(self) -> tuple[Floats, Bools] | None:
        """Sigmas (c, 6) of `rig_from_cam`, rotation (rad) and translation (m) in rig axes, without errors that drives
        with the same intrinsics share, and which of them the drive observed; None where the calibration was not
        refined, or how certain it is is not known.
        """
        found = [self.calibration["cameras"][camera.name] for camera in self.drive.cameras]
        stated = [camera.get("repeatability") or camera["sigma"] for camera in found]  # some scenes have sigmas alone
        known_of_all = all({"rotation_deg", "translation_m"} <= sigmas.keys() for sigmas in stated)
        if self.calibration.get("adjusted") is not True or not known_of_all:
            return None
        sigma = [[*np.radians(sigmas["rotation_deg"]), *sigmas["translation_m"]] for sigmas in stated]
        observed = [[*c["observed"]["rotation"], *c["observed"]["translation"]] for c in found]
        sigmas, known = np.array(sigma, dtype=np.float64), np.array(observed, dtype=np.bool_)
        if not sigmas.shape == known.shape == (len(found), 6) or not ((sigmas > 0) & np.isfinite(sigmas)).all():
            raise ValueError("sigmas of its cameras are not six positive numbers each")
        return sigmas, known

    @cached_property
    def given_rig_from_cam(self) -> Floats:
        """Poses (c, 4, 4) of the cameras as the drive's manifest gave them."""
        given = [self.calibration["cameras"][camera.name]["given"] for camera in self.drive.cameras]
        return np.stack([matrix_from_pose(Pose(**camera["rig_from_cam"])) for camera in given])

    @cached_property
    def focal_given_of_found(self) -> Floats:
        """Focal lengths (c,) of the cameras as the drive's manifest gave them, in those that the scene found."""
        cameras, documents = self.drive.cameras, self.calibration["cameras"]
        return np.array([documents[c.name]["given"]["params"][0] / c.params[0] for c in cameras], dtype=np.float64)

    @cached_property
    def given_lenses(self) -> list[Lens]:
        """Lenses (c,) of the cameras as the drive's manifest gave them."""
        cameras, documents = self.drive.cameras, self.calibration["cameras"]
        return [Lens.from_camera(camera, documents[camera.name]["given"]["params"]) for camera in cameras]

    @cached_property
    def sigma_focal_px(self) -> Floats:
        """Sigmas (c,) of the focal lengths that the drive observed; NaN where it did not, or nobody asked."""
        found = [self.calibration["cameras"][camera.name] for camera in self.drive.cameras]
        known = [c["sigma"].get("focal_px", np.nan) if c["observed"].get("focal") else np.nan for c in found]
        return np.array(known, dtype=np.float64)

    @cached_property
    def sigma_scale(self) -> float | None:
        """Relative standard deviation of the scene's lengths as its report states it; None where it states none."""
        sigma = self.report.get("scale", {}).get("sigma_relative")
        return float(sigma) if isinstance(sigma, int | float) and 0 <= sigma <= sys.float_info.max else None

    @property
    def midpoint_m(self) -> Floats:
        """The middle of the trajectory (3,): half of the trajectory along it."""
        trajectory = self.trajectory_m
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(trajectory, axis=0), axis=1))])
        half = 0.5 * length[-1]
        return np.array([np.interp(half, length, trajectory[:, k]) for k in range(3)])

    def of_units(self, chosen: Bools) -> SourceScene:
        """The scene as if its drive had only some units (u,); the others have no keypoints."""
        images = chosen[self.image_unit]
        frames = [frame for frame, keep in zip(self.manifest.frames, chosen.tolist(), strict=True) if keep]
        return replace(
            self,
            manifest=self.manifest.model_copy(update={"frames": frames}),
            unit_registered=self.unit_registered[chosen],
            world_from_rig=self.world_from_rig[chosen],
            sigma_position_m=self.sigma_position_m[chosen],
            image_registered=self.image_registered[images],
            unit_from_image=self.unit_from_image[images] if len(self.unit_from_image) else self.unit_from_image,
            keypoint_first=np.concatenate([self.keypoint_first[:-1][images], self.keypoint_first[-1:]]),
            footprints={},
        )

    def of_length(self, factor: float) -> SourceScene:
        """The scene with all of its lengths, the rig's among them, times a factor."""
        calibration = json.loads(json.dumps(self.calibration))
        cameras = []
        for camera in self.manifest.rig.cameras:
            place_m = [factor * x for x in camera.rig_from_cam.translation_m]
            pose = camera.rig_from_cam.model_copy(update={"translation_m": place_m})
            cameras.append(camera.model_copy(update={"rig_from_cam": pose}))
            document = calibration["cameras"][camera.name]
            given_m = document["given"]["rig_from_cam"]["translation_m"]
            document["refined"]["rig_from_cam"]["translation_m"] = place_m
            document["difference"]["translation_m"] = np.subtract(place_m, given_m).tolist()
        return replace(
            self,
            manifest=self.manifest.model_copy(
                update={"rig": self.manifest.rig.model_copy(update={"cameras": cameras})}
            ),
            calibration=calibration,
            world_from_rig=scaled(self.world_from_rig, factor),
            sigma_position_m=factor * self.sigma_position_m,
            unit_from_image=scaled(self.unit_from_image, factor),
            points_m=factor * self.points_m,
            footprints={},
        )

    def keypoints_with_points(self, image: int) -> Ints:
        """Keypoints (rows of the whole scene) of an image that observe a point."""
        rows = np.arange(self.keypoint_first[image], self.keypoint_first[image + 1])
        return rows[self.keypoint_point[rows] >= 0]

    def _documents(self) -> dict[str, Any]:
        return {
            "manifest": self.manifest.model_dump(mode="json", exclude_none=True),
            "calibration": self.calibration,
            "report": self.report,
            "features_kind": self.features_kind,
            "height_datum": self.height_datum,
            "common_world": self.common_world,
            **({} if self.is_placed else {"is_placed": False}),
        }

    def pack(self) -> tuple[Arrays, dict[str, Any]]:
        """Arrays and report for a finished stage; see `unpack`."""
        return {name: getattr(self, name) for name in ARRAYS}, self._documents()

    @staticmethod
    def unpack(name: str, arrays: Arrays, documents: dict[str, Any]) -> SourceScene:
        """Restore a scene from `pack`, under a name."""
        known = {field.name for field in fields(SourceScene)}
        rest = {key: value for key, value in documents.items() if key in known and key != "manifest"}
        manifest = DriveManifest.model_validate(documents["manifest"])
        everything: dict[str, Any] = {**rest, **arrays}
        return SourceScene(name=name, manifest=manifest, **everything)


def scaled(poses: Floats, factor: float) -> Floats:
    """Poses (n, 4, 4) with their translations times a factor."""
    result = poses.copy()
    result[:, :3, 3] *= factor
    return result


def unit_from_images(world_from_rig: Floats, world_from_cam: Floats, rig_from_cam: Floats, registered: Bools) -> Floats:
    """Poses (i, 4, 4) of the rig at the images' times relative to their units'; (0, 4, 4) where they are the same."""
    result = np.tile(np.eye(4), (len(world_from_cam), 1, 1))
    rows = np.flatnonzero(registered)
    result[rows] = se3.inverse(world_from_rig[rows]) @ world_from_cam[rows] @ se3.inverse(rig_from_cam[rows])
    apart = np.abs(result - np.eye(4)).max(initial=0.0)
    return result if apart > 1e-6 else np.zeros((0, 4, 4))
