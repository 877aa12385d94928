"""The drive manifest, `drive.json`, version 2: one recording of one vehicle, ready to be reconstructed.

Version 1 is read as well: it has none of `FIELDS_OF_VERSION_2`, `GNSS_FIELDS_OF_VERSION_2` and
`DRIVE_FIELDS_OF_VERSION_2`.

Conventions: a transform is named `a_from_b` and maps coordinates of frame b into frame a; rotations are unit
quaternions in the order x, y, z, w; lengths are metres, angles degrees, times integer microseconds.
"""

from __future__ import annotations

import math
from enum import StrEnum
from pathlib import PurePosixPath
from typing import Annotated, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    FailFast,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic.config import JsonDict

from schemas.patterns import Pattern

# Long lists end at their first bad item (FailFast): a million bad ones would take gigabytes to describe.

# Models of the cameras that cars carry, with their parameters in order: COLMAP's, and the unified model of Mei and
# Rives with OpenCV's distortion (its omnidir module, Kalibr's omni-radtan, KITTI-360's fisheyes).
CAMERA_MODELS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "MEI": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "xi"),
}

FIELDS_OF_VERSION_2 = frozenset(
    {"sigma_principal_point_px", "sigma_distortion", "sigma_time_offset_us", "readout_direction"}
)  # of Camera
GNSS_FIELDS_OF_VERSION_2 = frozenset({"sigma_antenna_m"})
DRIVE_FIELDS_OF_VERSION_2 = frozenset({"vehicle"})

MAX_CAMERAS = 64
MAX_FRAMES = 100_000
MAX_GNSS_SAMPLES = 1_000_000  # 100 Hz for 2.7 hours
MAX_IMAGE_SIDE_PX = 20_000
MAX_XI = 10.0  # of a MEI camera: 0 is a pinhole, 1 a parabolic mirror, fisheyes have 1 to 3
MAX_PATH_CHARACTERS = 512
MAX_RIG_EXTENT_M = 100.0  # a camera or antenna farther from the rig's origin than this is a unit error
# The longest rigid road vehicle, a bus of three axles (directive 96/53/EC, annex I): a rig does not bend, so that
# cameras of one are no farther apart. Rails and mines have longer ones.
LONGEST_VEHICLE_M = 15.0
MAX_GNSS_GAP_S = 2.0  # between two samples, in which positions are interpolated where settings say nothing else
SIGMA_TRANSLATION_M = 0.05  # of a camera's place on the vehicle where the manifest declares none
MAX_READOUT_US = 200_000  # slower than any camera reads its rows: nanoseconds
MAX_SIGMA_TIME_OFFSET_US = 1_000_000
MAX_COORDINATE_M = 1e8  # beyond this, metres lose their millimetres in float64 arithmetic
UNIT_ROUNDING = 1e-14  # of a quaternion's norm
MIN_SIGMA = 1e-9  # of its unit: nothing on a vehicle is known better, and the square of a smaller one vanishes
LAST_TIMESTAMP_US = 253_402_300_799_999_999  # the last of the year 9999, since 1970: calendars end there

Finite = Annotated[float, Field(allow_inf_nan=False)]
Sigma = Annotated[float, Field(ge=MIN_SIGMA, allow_inf_nan=False, le=1e6)]
TimestampUs = Annotated[int, Field(ge=0, le=LAST_TIMESTAMP_US, strict=True)]
Name = Annotated[
    str,
    Pattern(
        r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$",
        words="1 to 64 letters (A-Z, a-z), digits and _ . - without spaces, first a letter or digit",
    ),
]
MAX_VEHICLE_CHARACTERS = 64
VEHICLE_NAME = Pattern(
    rf"^[A-Za-z0-9][A-Za-z0-9_.:-]{{0,{MAX_VEHICLE_CHARACTERS - 1}}}$",
    words=f"1 to {MAX_VEHICLE_CHARACTERS} letters (A-Z, a-z), digits and _ . : - without spaces, "
    "first a letter or digit",
)
Vehicle = Annotated[str, VEHICLE_NAME]
# Names that people read have no control characters: terminals would obey them.
PRINTED_NAME = Pattern(r"^[^\x00-\x1f\x7f-\x9f]+$", words="characters that can be printed, without control characters")
MAX_DRIVE_NAME_CHARACTERS = 200
DriveName = Annotated[str, Field(min_length=1, max_length=MAX_DRIVE_NAME_CHARACTERS), PRINTED_NAME]


def _relative_path(value: str) -> str:
    path = PurePosixPath(value)
    plain = value.isprintable() and "\\" not in value and 0 < len(value) <= MAX_PATH_CHARACTERS
    plain = plain and all(len(part.encode()) <= 255 for part in path.parts)  # what file systems can hold
    # str(path) differs where the same file could be written in two ways: './a', 'a//b', 'a/'.
    if not plain or path.is_absolute() or ".." in path.parts or str(path) != value or value == ".":
        raise ValueError("must be a relative path inside the drive with forward slashes and without '.', '..' or '//'")
    return value


RelativePath = Annotated[str, AfterValidator(_relative_path)]
Vector3 = Annotated[list[Finite], Field(min_length=3, max_length=3)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class BodyAxes(StrEnum):
    """Direction of the rig frame's x, y and z axes on the vehicle."""

    FLU = "flu"  # forward, left, up: ours, ROS REP 103, nuScenes
    RDF = "rdf"  # right, down, forward: KITTI's cameras
    FRD = "frd"  # forward, right, down: aviation, many inertial units


class ReadoutDirection(StrEnum):
    """Direction in which a rolling shutter reads an image."""

    TOP_TO_BOTTOM = "top_to_bottom"  # row by row, the usual one
    BOTTOM_TO_TOP = "bottom_to_top"  # a camera mounted upside down whose images were turned
    LEFT_TO_RIGHT = "left_to_right"  # column by column: a camera mounted on its side, Waymo's
    RIGHT_TO_LEFT = "right_to_left"


class SemanticClass(StrEnum):
    """Classes that the engine distinguishes; a label map sends a mask's ids to these."""

    STATIC = "static"
    ROAD = "road"
    DYNAMIC = "dynamic"
    SKY = "sky"
    OWN_CAR = "own_car"


class Pose(_Model):
    """A rigid transform."""

    rotation_xyzw: Annotated[list[Finite], Field(min_length=4, max_length=4, description="unit quaternion x, y, z, w")]
    translation_m: Vector3 = Field(description="x, y, z")

    @field_validator("rotation_xyzw")
    @classmethod
    def _unit(cls, value: list[float]) -> list[float]:
        norm = math.sqrt(sum(v * v for v in value))
        if abs(norm - 1.0) > 1e-3:
            raise ValueError(f"quaternion must have norm 1, has {norm:.6g}: give x, y, z, w of a unit quaternion")
        # One that is a unit quaternion to rounding stays: what was written and is read again must not change.
        return value if abs(norm - 1.0) <= UNIT_ROUNDING else [v / norm for v in value]

    @field_validator("translation_m")
    @classmethod
    def _bounded(cls, value: list[float]) -> list[float]:
        if max(abs(v) for v in value) > MAX_COORDINATE_M:
            raise ValueError(f"coordinates beyond {MAX_COORDINATE_M:g} m are refused: give metres, not millimetres")
        return value


class Camera(_Model):
    """One fixed camera of the rig."""

    name: Name = Field(description="unique in the rig")
    model: str = Field(description=f"camera model, COLMAP's or MEI: one of {', '.join(CAMERA_MODELS)}")
    width: Annotated[int, Field(gt=0, le=MAX_IMAGE_SIDE_PX, strict=True, description="pixels")]
    height: Annotated[int, Field(gt=0, le=MAX_IMAGE_SIDE_PX, strict=True, description="pixels")]
    params: list[Finite] = Field(
        description="parameters of the model in COLMAP's order, pixels; the centre of the top left pixel is at "
        "(0.5, 0.5)"
    )
    rig_from_cam: Pose = Field(
        description="the camera's pose in the rig; camera axes are x right, y down, z forward. Its translation is "
        "where the camera sits on the vehicle"
    )
    sigma_rotation_deg: Sigma | None = Field(None, description="how well rig_from_cam is known, per axis")
    sigma_translation_m: Sigma | None = Field(None, description="how well rig_from_cam is known, per axis")
    sigma_focal_px: Sigma | None = Field(None, description="how well the focal length is known")
    sigma_principal_point_px: Sigma | None = Field(
        None, description="since version 2: how well the principal point is known, per axis"
    )
    sigma_distortion: Sigma | None = Field(
        None,
        description="since version 2: how well the radial terms of distortion are known: k1 and k2, "
        "of a fisheye k1 to k4; k3 to k6 of FULL_OPENCV stay as given",
    )
    sigma_time_offset_us: Annotated[Sigma, Field(le=MAX_SIGMA_TIME_OFFSET_US)] | None = Field(
        None,
        description="since version 2: how well the camera's timestamps are known as a whole, microseconds; with it the "
        "offset is estimated also where the timestamps of all cameras agree",
    )
    readout_us: Annotated[int, Field(ge=0, le=MAX_READOUT_US, strict=True)] | None = Field(
        None,
        description="rolling shutter: time from the first row to the last, microseconds; an image's timestamp is then "
        "that of its middle row. 0: all rows at once; absent: so it is assumed",
    )
    readout_direction: ReadoutDirection | None = Field(
        None,
        description="since version 2: direction in which a rolling shutter reads the image as it is stored, by default "
        "top_to_bottom; for the "
        "last two, what is said of rows holds for columns",
    )

    @property
    def declares_intrinsics(self) -> bool:
        """True where it says how well any of its intrinsics is known."""
        sigmas = (self.sigma_focal_px, self.sigma_principal_point_px, self.sigma_distortion)
        return any(sigma is not None for sigma in sigmas)

    @field_validator("model")
    @classmethod
    def _known_model(cls, value: str) -> str:
        if value not in CAMERA_MODELS:
            raise ValueError(f"camera model {value!r} is not supported: use one of {', '.join(CAMERA_MODELS)}")
        return value

    @field_validator("params")
    @classmethod
    def _plausible_params(cls, value: list[float], info: ValidationInfo) -> list[float]:
        if not {"model", "width", "height"} <= info.data.keys():
            return value  # those fields have errors of their own
        _check_params(value, model=info.data["model"], width=info.data["width"], height=info.data["height"])
        return value

    @field_validator("rig_from_cam")
    @classmethod
    def _on_the_vehicle(cls, value: Pose) -> Pose:
        if max(abs(v) for v in value.translation_m) > MAX_RIG_EXTENT_M:
            raise ValueError(f"puts the camera over {MAX_RIG_EXTENT_M:g} m from the rig's origin: give metres")
        return value


def _check_params(params: list[float], *, model: str, width: int, height: int) -> None:
    names = CAMERA_MODELS[model]
    if len(params) != len(names):
        raise ValueError(f"{model} has {len(names)} parameters ({', '.join(names)}), {len(params)} are given")
    values = dict(zip(names, params, strict=True))
    side = max(width, height)
    for name in ("f", "fx", "fy"):
        if name in values and not 0.05 * side < values[name] < 100 * side:
            raise ValueError(
                f"focal length {name} = {values[name]:g} px does not fit an image of {width}x{height} pixels: "
                "the calibration is singular or in other units than pixels"
            )
    if not 0.0 <= values.get("xi", 0.0) <= MAX_XI:
        raise ValueError(f"xi = {values['xi']:g} is out of range: no lens has less than 0 or more than {MAX_XI:g}")
    if not (-0.5 * width < values["cx"] < 1.5 * width) or not (-0.5 * height < values["cy"] < 1.5 * height):
        raise ValueError(
            f"principal point ({values['cx']:g}, {values['cy']:g}) is far outside the image of {width}x{height} pixels"
        )


class Rig(_Model):
    """The vehicle's camera set."""

    body_axes: BodyAxes = Field(
        BodyAxes.FLU,
        description="directions of the rig's x, y, z: flu forward left up, rdf right down forward, frd forward right "
        "down",
    )
    cameras: Annotated[list[Camera], Field(min_length=1, max_length=MAX_CAMERAS)]

    @model_validator(mode="after")
    def _unique(self) -> Rig:
        names = [camera.name for camera in self.cameras]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"camera name {name!r} is used twice")
        return self


class FrameImage(_Model):
    """One camera's image at one instant."""

    file: RelativePath = Field(description="path of the image in the drive")
    timestamp_us: TimestampUs | None = Field(None, description="when this image was taken, if not with its frame")
    mask: RelativePath | None = Field(None, description="path of its semantic mask: one channel, one id a pixel")


class Frame(_Model):
    """All images of one instant: a rigid unit."""

    timestamp_us: TimestampUs = Field(description="when the unit is posed; later than the frame before")
    source_frame: Annotated[int, Field(ge=0, le=2**31 - 1, strict=True)] = Field(
        description="the frame's number in the recording it comes from; no two frames share one"
    )
    images: dict[Name, FrameImage] = Field(
        max_length=MAX_CAMERAS, description="by camera name; a camera may be missing"
    )


class GnssSample(_Model):
    """One position of the antenna's phase centre on WGS84."""

    timestamp_us: TimestampUs = Field(description="on the clock of the images")
    latitude_deg: Annotated[float, Field(ge=-90, le=90)] = Field(description="positive in the north")
    longitude_deg: Annotated[float, Field(ge=-180, le=180)] = Field(description="positive in the east")
    height_m: Annotated[float, Field(ge=-1000, le=20000)] = Field(description="above height_datum")
    sigma_horizontal_m: Sigma = Field(description="standard deviation of each horizontal axis")
    sigma_vertical_m: Sigma = Field(description="standard deviation of the height")


class Gnss(_Model):
    """The receiver's positions."""

    height_datum: Annotated[
        str,
        Pattern(r"^(ellipsoidal|EPSG:[0-9]{4,6})$", words="'ellipsoidal' or EPSG: with 4 to 6 digits"),
    ] = Field(
        description="what height_m counts from: 'ellipsoidal' (WGS84), or the EPSG code of a vertical datum",
    )
    antenna_in_rig_m: Vector3 = Field(description="position of the antenna in the rig frame (lever arm)")
    sigma_antenna_m: Sigma | None = Field(
        None,
        description="since version 2: how well it is known, per axis, with which it is estimated; without it, it is "
        "taken to be exact",
    )
    samples: Annotated[list[GnssSample], Field(max_length=MAX_GNSS_SAMPLES), FailFast()] = Field(
        description="in order of time; they need not coincide with frames"
    )

    @field_validator("antenna_in_rig_m")
    @classmethod
    def _on_the_vehicle(cls, value: list[float]) -> list[float]:
        if max(abs(v) for v in value) > MAX_RIG_EXTENT_M:
            raise ValueError(f"the antenna is over {MAX_RIG_EXTENT_M:g} m from the rig's origin: metres?")
        return value


class RoughPose(_Model):
    """Roughly where the vehicle was."""

    timestamp_us: TimestampUs = Field(description="on the clock of the images")
    world_from_rig: Pose = Field(description="the rig's pose in the world frame")


class RoughTrajectory(_Model):
    """A rough trajectory in any metric, gravity aligned (z up) world frame."""

    poses: Annotated[list[RoughPose], Field(min_length=1, max_length=MAX_GNSS_SAMPLES), FailFast()] = Field(
        description="in order of time"
    )
    sigma_translation_m: Sigma = Field(0.5, description="standard deviation, per axis")
    sigma_rotation_deg: Sigma = Field(2.0, description="standard deviation, about each axis")
    common_world: Name | None = Field(
        None,
        description="name of the world frame, where other drives have rough poses in the same one: scenes of drives "
        "that declare one name can be aggregated without GNSS",
    )


class LabelMap(_Model):
    """Meaning of the ids in the masks. Ids that are not listed are refused by name when a mask holds them."""

    ids: dict[Annotated[int, Field(ge=0, le=255)], SemanticClass] = Field(
        description="by id, which JSON writes as a string"
    )

    @staticmethod
    def cityscapes() -> LabelMap:
        """Cityscapes' train ids, with 19 for what is not labelled."""
        dynamic, classes = range(11, 19), {0: SemanticClass.ROAD, 10: SemanticClass.SKY}
        return LabelMap(
            ids={i: SemanticClass.DYNAMIC if i in dynamic else classes.get(i, SemanticClass.STATIC) for i in range(20)}
        )


# Small, and accepted as it is.
EXAMPLE_MANIFEST: JsonDict = {
    "version": 1,
    "name": "ring-road-2026-05-04",
    "rig": {
        "cameras": [
            {
                "name": "front",
                "model": "PINHOLE",
                "width": 1280,
                "height": 720,
                "params": [910.0, 910.0, 640.0, 360.0],
                "rig_from_cam": {"rotation_xyzw": [-0.5, 0.5, -0.5, 0.5], "translation_m": [1.6, 0.0, 1.4]},
            }
        ]
    },
    "frames": [
        {"timestamp_us": 1777887000000000, "source_frame": 0, "images": {"front": {"file": "front/000000.png"}}},
        {"timestamp_us": 1777887000100000, "source_frame": 1, "images": {"front": {"file": "front/000001.png"}}},
    ],
    "gnss": {
        "height_datum": "ellipsoidal",
        "antenna_in_rig_m": [0.2, 0.0, 1.6],
        "samples": [
            {
                "timestamp_us": 1777887000000000,
                "latitude_deg": 48.1374,
                "longitude_deg": 11.5755,
                "height_m": 566.2,
                "sigma_horizontal_m": 0.4,
                "sigma_vertical_m": 0.8,
            },
            {
                "timestamp_us": 1777887000100000,
                "latitude_deg": 48.13741,
                "longitude_deg": 11.57552,
                "height_m": 566.2,
                "sigma_horizontal_m": 0.4,
                "sigma_vertical_m": 0.8,
            },
        ],
    },
}


class DriveManifest(_Model):
    """One recorded drive."""

    model_config = ConfigDict(json_schema_extra={"examples": [EXAMPLE_MANIFEST]})

    version: Literal[1, 2] = Field(1, description="of this contract")
    name: DriveName = Field(description="what results are called")
    vehicle: Vehicle | None = Field(
        None,
        description="since version 2: which vehicle drove, by its fleet number or another name without spaces; drives "
        "of one vehicle share what they tell of its calibration",
    )
    rig: Rig = Field(description="the vehicle's cameras")
    frames: Annotated[list[Frame], Field(min_length=1, max_length=MAX_FRAMES), FailFast()] = Field(
        description="the instants, in order of time"
    )
    gnss: Gnss | None = Field(None, description="the receiver's positions")
    rough_poses: RoughTrajectory | None = Field(None, description="roughly where the vehicle was")
    label_map: LabelMap | None = Field(
        None,
        description="what the ids in masks mean; without it masks hold Cityscapes' train ids 0-18, and 19 for "
        "unlabelled",
    )
    notes: Annotated[list[Annotated[str, Field(max_length=2000)]], Field(max_length=100)] = Field(
        default_factory=list, description="what a reader of results should know of the source"
    )

    @model_validator(mode="after")
    def _consistent(self) -> DriveManifest:
        for name in sorted(DRIVE_FIELDS_OF_VERSION_2 & self.model_fields_set if self.version == 1 else ()):
            raise ValueError(f"{name} is of version 2 of the contract: set version to 2")
        of_gnss = set() if self.gnss is None else GNSS_FIELDS_OF_VERSION_2 & self.gnss.model_fields_set
        for name in sorted(of_gnss if self.version == 1 else ()):
            raise ValueError(f"gnss.{name} is of version 2 of the contract: set version to 2")
        for i, camera in enumerate(self.rig.cameras if self.version == 1 else ()):
            for name in sorted(FIELDS_OF_VERSION_2 & camera.model_fields_set):
                raise ValueError(f"rig.cameras.{i}.{name} is of version 2 of the contract: set version to 2")
        cameras = {camera.name for camera in self.rig.cameras}
        last_us = -1
        files: set[str] = set()
        sources: set[int] = set()
        for i, frame in enumerate(self.frames):
            if frame.source_frame in sources:
                raise ValueError(f"frames.{i}.source_frame {frame.source_frame} is used twice")
            sources.add(frame.source_frame)
            if frame.timestamp_us <= last_us:
                word = "repeats" if frame.timestamp_us == last_us else "goes back to"
                raise ValueError(
                    f"frames.{i}.timestamp_us {word} {frame.timestamp_us}: sort the frames by time and give every "
                    "frame its own timestamp"
                )
            last_us = frame.timestamp_us
            for name, image in frame.images.items():
                if name not in cameras:
                    raise ValueError(
                        f"frames.{i}.images names camera {name!r}, which the rig does not have: "
                        f"{', '.join(sorted(cameras))}"
                    )
                if image.file in files:
                    raise ValueError(f"frames.{i}.images.{name}.file {image.file!r} is used by two images")
                files.add(image.file)
        return self
