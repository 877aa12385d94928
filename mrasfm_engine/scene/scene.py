"""The result of a reconstruction in memory, before it is written out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.scene.drive import Drive, LeftOut
from mrasfm_engine.scene.road import Road
from mrasfm_engine.types import Bools, Bytes, Floats, Floats32, Ints
from schemas.notebook_table import notebook_table


@dataclass(frozen=True, kw_only=True)
class ImageFeatures:
    """Keypoints of one image, those first that are worth most: the strongest, or those that cover the image best.

    xy_px has COLMAP's convention: the centre of the top left pixel is at (0.5, 0.5).
    """

    xy_px: Floats32  # (n, 2)
    # uint8 (n, 128): RootSIFT scaled by 512 and clipped to 255, as COLMAP stores it; float32 (n, D): of a network
    descriptors: Bytes | Floats32
    colors: Bytes  # (n, 3) red, green, blue at the keypoint
    scores: Floats32 | None = None  # (n,) a trained network's confidence
    radius_px: Floats32 | None = None  # (n,) of what a keypoint is the middle of; None where an extractor has no scales
    # (n,) as `semantics.CLASS_CODES` numbers them; all unknown where not given
    classes: Bytes = field(default_factory=lambda: np.zeros(0, np.uint8))
    # (b,) bytes of a PNG with the ids that a network gave the image's pixels; None where no network ran
    made_mask: Bytes | None = None
    # reason for an image without keypoints that takes no part
    left_out: LeftOut | None = None

    def __post_init__(self) -> None:
        if not len(self.classes):
            object.__setattr__(self, "classes", np.zeros(len(self.xy_px), np.uint8))


def observed_colors(features: Sequence[ImageFeatures], image: Ints, keypoint: Ints) -> Bytes:
    """Colours (n, 3) of observations by keypoints (n,) of images (n,), which are read one after the other."""
    result = np.empty((len(image), 3), np.uint8)
    order = np.argsort(image, kind="stable")
    images, first = np.unique(image[order], return_index=True)
    for number, (begin, end) in zip(images.tolist(), pairwise([*first, len(order)]), strict=True):
        rows = order[begin:end]
        result[rows] = features[number].colors[keypoint[rows]]
    return result


@dataclass(frozen=True, kw_only=True)
class PairMatches:
    """Matches of one image pair, image_a < image_b (indices into `Drive.images`)."""

    image_a: int
    image_b: int
    matches: NDArray[np.int32]  # (m, 2) keypoint indices, before verification
    inliers: Bools  # (m,) which of them passed geometric verification
    is_revisit: bool = False  # whether their units do not follow one another: a place that is seen again, if it is one
    essential: Floats | None = None  # (3, 3) that the inliers agree with, for unit rays b' E a = 0


@dataclass(frozen=True, kw_only=True)
class Georeference:
    """Position of the scene's local frame on the earth.

    The local frame is an east-north-up frame (x east, y north, z up) in metres at `origin_*`.
    """

    origin_latitude_deg: float
    origin_longitude_deg: float
    origin_ellipsoidal_height_m: float
    height_datum: str  # as declared in the manifest; the origin's height is ellipsoidal all the same
    ecef_from_local: Floats  # (4, 4), EPSG:4978

    @property
    def origin_deg(self) -> tuple[float, float]:
        """Latitude and longitude of the origin."""
        return self.origin_latitude_deg, self.origin_longitude_deg


@dataclass(frozen=True, kw_only=True)
class CameraCalibration:
    """Refined calibration of one camera, in manifest units."""

    rig_from_cam: Floats  # (4, 4)
    params: Floats  # COLMAP's order
    sigma_rotation_deg: Floats  # (3,) about the rig's axes, posterior
    sigma_translation_m: Floats  # (3,) along the rig's axes, posterior
    # the same without errors that all images share, as those of a lens: what drives with these intrinsics scatter by
    repeatability_rotation_deg: Floats  # (3,)
    repeatability_translation_m: Floats  # (3,)
    sigma_focal_px: float
    # which of the six directions (rotation x y z, translation x y z) of this camera among the others the drive
    # observed, the rest is only the prior
    observed: Bools  # (6,)
    is_wrong: bool = False  # whether what was given is far from what the drive shows
    time_offset_s: float | None = None  # its images were taken so much later than their timestamps say; None: not asked
    sigma_time_offset_s: float = float("nan")
    time_offset_observed: bool = False
    focal_observed: bool | None = None  # whether the focal length varied, as the drive observes it; None: not asked


@dataclass(frozen=True, kw_only=True)
class CalibrationObservability:
    """Observability of the relative poses of all cameras in the drive."""

    adjusted: bool  # whether `rig_from_cam` varied at all
    reason: str
    scale_observed: bool  # positions determine the cameras' distances better than the priors
    scale_rests_on: str  # the same in words
    sigma_scale: float  # relative, of the cameras' distances; NaN where not known


@dataclass(kw_only=True)
class Scene:
    """A reconstructed scene in its local frame (`world`): east-north-up where georeferenced.

    Images without an entry in `image_registered` are not part of the model.
    """

    drive: Drive
    unit_registered: Bools  # (units,)
    image_registered: Bools  # (images,)
    world_from_rig: Floats  # (units, 4, 4); rows of units that are not registered are NaN
    sigma_position_m: Floats  # (units, 3), NaN where not known
    calibration: list[CameraCalibration]  # by camera
    calibration_observability: CalibrationObservability | None = None
    points_m: Floats  # (p, 3)
    point_colors: Bytes  # (p, 3)
    point_error_px: Floats  # (p,) mean reprojection error
    # one row an observation, sorted by point
    observation_point: Ints
    observation_image: Ints
    observation_keypoint: Ints
    features: list[ImageFeatures]  # by image
    pairs: list[PairMatches]
    georeference: Georeference | None = None
    # without georeference but with rough poses: rough_world_from_local is a pure translation (4, 4)
    rough_world_from_local: Floats | None = None
    notes: list[str] = field(default_factory=list)
    # where the rig was at every image's own timestamp, relative to its unit's pose (images, 4, 4); None: at its unit's
    unit_from_image: Floats | None = None
    # (p,) classes as `semantics.CLASS_CODES` numbers them, and patches of the road; unknown and -1 where not given
    point_classes: Bytes = field(default_factory=lambda: np.zeros(0, np.uint8))
    point_patches: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    road: Road | None = None
    # by camera: where it shows the vehicle itself (h, w), None where it was not found
    own_cars: list[Bools | None] = field(default_factory=list)
    # (cameras,) of a map: which vehicle each camera is on; empty where all are on one
    rig_of_camera: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    # (units,) number of the component that each unit belongs to, 0 the largest; all 0 where not given
    unit_component: Ints = field(default_factory=lambda: np.zeros(0, np.int64))

    def __post_init__(self) -> None:
        if not len(self.point_classes):
            self.point_classes = np.zeros(len(self.points_m), np.uint8)
        if not len(self.point_patches):
            self.point_patches = np.full(len(self.points_m), -1, np.int32)
        if not self.own_cars:
            self.own_cars = [None for _ in self.drive.cameras]
        if not len(self.rig_of_camera):
            self.rig_of_camera = np.zeros(len(self.calibration), np.int64)
        if not len(self.unit_component):
            self.unit_component = np.zeros(len(self.unit_registered), np.int64)

    def _repr_html_(self) -> str:
        """Jupyter's picture of a scene: how much of the drive it has, where it is, which cameras are wrong."""
        wrong = [
            camera.name for camera, found in zip(self.drive.cameras, self.calibration, strict=False) if found.is_wrong
        ]
        place = self.georeference
        on_earth = "none"
        if place is not None:
            on_earth = f"{place.origin_latitude_deg:.6f}°, {place.origin_longitude_deg:.6f}°"
        error_px = f"{self.point_error_px.mean():.3f} px" if len(self.point_error_px) else "no points"
        return notebook_table(
            f"Scene of {self.drive.manifest.name}",
            {
                "units with a pose": f"{int(self.unit_registered.sum())} of {len(self.unit_registered)}",
                "images with a pose": f"{int(self.image_registered.sum())} of {len(self.image_registered)}",
                "points": len(self.points_m),
                "observations": len(self.observation_point),
                "mean reprojection error": error_px,
                "place on the earth": on_earth,
                "cameras not mounted as given": ", ".join(wrong) or "none",
            },
        )

    @property
    def image_unit(self) -> Ints:
        """Unit (images,) of every image."""
        return np.array([image.unit for image in self.drive.images], dtype=np.int64)

    @property
    def point_component(self) -> Ints:
        """Component (p,) of every point: that of the first unit that observes it, 0 for a point without any."""
        result = np.zeros(len(self.points_m), np.int64)
        if not self.unit_component.any():
            return result
        points, first = np.unique(self.observation_point, return_index=True)
        result[points] = self.unit_component[self.image_unit[self.observation_image[first]]]
        return result

    @property
    def world_from_cam(self) -> Floats:
        """Poses (images, 4, 4) of all images at their own timestamps; NaN for images that are not registered."""
        units = self.image_unit
        cameras = np.array([image.camera for image in self.drive.images], dtype=np.int64)
        rig_from_cam = np.stack([camera.rig_from_cam for camera in self.calibration])
        world_from_rig = self.world_from_rig[units]
        if self.unit_from_image is not None:
            world_from_rig = world_from_rig @ self.unit_from_image
        poses: Floats = world_from_rig @ rig_from_cam[cameras]
        poses[~self.image_registered] = np.nan
        return poses
