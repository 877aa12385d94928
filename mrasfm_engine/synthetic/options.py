"""Options of the renderer, and checks of their combinations."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NoReturn

from mrasfm_engine.errors import InputError
from mrasfm_engine.synthetic.rigs import MAX_SYNTHETIC_CAMERAS, mounts

MIN_LOOP_M = 110.0
LOOP_OVERLAP_M = 10.0
MIN_SIDE_PX, MAX_SIDE_PX = 32, 8192  # of an image
TEXTURES_PX = (64, 128, 256, 512, 1024)
NOT_NEGATIVE = (
    "seed", "parked_cars", "moving_cars", "same_way_cars", "moving_shadows", "standing_units", "time_skew_ms",
    "readout_ms",
)  # fmt: skip
# Beyond these a drive has positions that no manifest may have, images without a picture, or cameras off the vehicle.
BOUNDS = {
    "exposure_jitter": (0, 3), "noise": (0, 1000), "blur_px": (0, 100), "jpeg_quality": (0, 100),
    "gnss_noise_m": (0, 100), "gnss_drift_m": (0, 100), "gnss_bias_m": (0, 100), "biased_by_m": (0, 10_000),
    "gnss_offset_s": (-1e8, 1e8), "rough_noise_m": (0, 10_000), "rough_noise_deg": (0, 180),
    "perturb_rotation_deg": (0, 180), "perturb_translation_m": (0, 50), "miscalibrated_by_deg": (-180, 180),
}  # fmt: skip
FRACTIONS = ("drop_images", "gnss_outliers", "shadow_strength")
OTHER_FLAGS = {"standing_units": "standing", "shadow_strength": "shadows"}  # of options that do not have their names


class World(StrEnum):
    """Kinds of streets."""

    STREET = "street"  # one winding street
    CROSSING = "crossing"  # two streets that cross
    LOOP = "loop"  # once around a block
    TURN = "turn"  # one street that turns to the left by 90 degrees
    REPEATED = "repeated"  # two parallel streets whose facades are all the same


class SpeedProfile(StrEnum):
    """Variation of the vehicle's speed about its mean."""

    CONSTANT = "constant"
    GENTLE = "gentle"  # by 8 %
    VARYING = "varying"  # 3 to 12 m/s


@dataclass(frozen=True, kw_only=True)
class SynthOptions:
    """One world and its drives. Lengths are metres, angles degrees; noise is the standard deviation of each axis."""

    cameras: int = 6
    units: int = 40
    drives: int = 1
    seed: int = 1
    world: World = World.STREET
    straight: bool = False  # the first street has no curvature
    ramp_percent: float = 0.0  # slope of a hill that begins 10 m into the first drive
    parked_cars: int = 8
    moving_cars: int = 3
    same_way_cars: int = 0  # that drive along with the vehicle, in turns ahead of it and in the other lane beside it
    moving_shadows: int = 0  # things out of view whose shadows travel along the road, beside the vehicle's own
    shadow_strength: float = 1.0  # 0: no shadows, 1: as dark as they are

    width: int = 960
    height: int = 540
    camera_model: str = "PINHOLE"
    exposure_jitter: float = 0.0  # standard deviation of the logarithm of every image's brightness
    noise: float = 1.0  # 1 is a good sensor in daylight, 0 none
    blur_px: float = 0.45  # standard deviation of the point spread function
    jpeg_quality: int = 95
    masks: bool = True
    moving_masks: bool = False  # what moves, pixel by pixel, as a part of the truth
    texture_px: int = 1024  # side of the largest textures; less for small images and fast tests

    rate_hz: float = 10.0  # units a second
    spacing_m: float = 1.1  # mean distance between units
    speed_profile: SpeedProfile = SpeedProfile.GENTLE
    standing_units: int = 0  # the vehicle stands still for that many units in the middle of each drive
    time_skew_ms: float = 0.0  # the images of a unit are taken up to that long apart
    readout_ms: float = 0.0  # rolling shutter: from the first row of an image to the last
    drop_images: float = 0.0  # fraction of images that are missing
    own_car: bool = False  # the front camera sees the vehicle's bonnet, the back camera its boot lid
    occluded_cameras: tuple[str, ...] = ()  # a lorry covers most of their images for half of the drive

    gnss: bool = True
    gnss_noise_m: float = 0.3  # white; vertical 1.5 times that
    gnss_drift_m: float = 0.2  # slowly changing (correlation time 20 s)
    gnss_bias_m: float = 0.3  # constant in each drive
    biased_drive: int | None = None  # whose positions are all off by so much in one horizontal direction, undeclared:
    biased_by_m: float = 8.0
    dusk_drive: int | None = None  # that is driven in other light than the others: late, under clouds
    gnss_outliers: float = 0.0  # fraction of samples that are 5 to 40 m off
    gnss_offset_s: float = 0.0  # added to the GNSS timestamps
    rough_poses: bool = False
    rough_noise_m: float = 0.3
    rough_noise_deg: float = 1.0

    perturb_rotation_deg: float = 0.0  # norm of each given extrinsic rotation's error, in a random direction
    perturb_translation_m: float = 0.0  # norm of each given extrinsic translation's error, in a random direction
    declare_sigmas: bool = False  # the manifest says how well the extrinsics are known
    tight: bool = False  # the manifest declares 0.01 degrees and 1 mm
    miscalibrated_camera: str | None = None
    miscalibrated_by_deg: float = 3.0  # additional rotation of the wrong camera about a random axis

    def __post_init__(self) -> None:
        self._check_counts_and_sizes()
        self._check_amounts()
        self._check_times_and_ways()
        self._check_choices()

    def _check_counts_and_sizes(self) -> None:
        if not 1 <= self.cameras <= MAX_SYNTHETIC_CAMERAS:
            _refuse(f"--cameras {self.cameras} is not possible", f"Ask for 1 to {MAX_SYNTHETIC_CAMERAS}.")
        for name in ("units", "drives"):
            if getattr(self, name) < 1:
                _refuse(f"--{name} {getattr(self, name)} is not positive", "Ask for at least 1.")
        if not all(MIN_SIDE_PX <= side <= MAX_SIDE_PX for side in (self.width, self.height)):
            _refuse(
                f"images of {self.width}x{self.height} pixels cannot be rendered",
                f"Use sides of {MIN_SIDE_PX} to {MAX_SIDE_PX} pixels.",
            )
        if self.texture_px not in TEXTURES_PX:
            _refuse(
                f"textures of {self.texture_px} pixels are not possible",
                f"Use one of {', '.join(map(str, TEXTURES_PX))}.",
            )
        if self.standing_units > self.units // 2:
            _refuse(
                f"--standing {self.standing_units} is more than half of {self.units} units", "Stand still for fewer."
            )

    def _check_amounts(self) -> None:
        for name in NOT_NEGATIVE:
            if not 0 <= getattr(self, name) < math.inf:
                _refuse(f"{_flag(name)} {getattr(self, name)} is no amount", "Give zero or a positive number.")
        for name, (lowest, highest) in BOUNDS.items():
            if not lowest <= getattr(self, name) <= highest:  # also refuses NaN
                _refuse(
                    f"{_flag(name)} {getattr(self, name)} is no possible amount", f"Give {lowest:g} to {highest:g}."
                )
        for name in FRACTIONS:
            if not 0 <= getattr(self, name) <= 1:
                _refuse(f"{_flag(name)} {getattr(self, name)} is not a fraction", "Give a number from 0 to 1.")

    def _check_times_and_ways(self) -> None:
        if not 1 <= self.rate_hz <= 100:
            _refuse(f"--rate-hz {self.rate_hz} is not a camera's", "Use 1 to 100.")
        between_ms = 1000 / self.rate_hz
        for name in ("time_skew_ms", "readout_ms"):
            if getattr(self, name) >= between_ms:
                _refuse(
                    f"{_flag(name)} {getattr(self, name)} reaches the next unit", f"Use less than {between_ms:g} ms."
                )
        if not 0.05 <= self.spacing_m <= 5:
            _refuse(f"--spacing-m {self.spacing_m} is not a car's", "Use 0.05 to 5 m, at 10 Hz 0.5 to 50 m/s.")
        if not abs(self.ramp_percent) <= 20:
            _refuse(f"--ramp {self.ramp_percent} is steeper than streets are", "Use -20 to 20 percent.")
        if self.world is World.LOOP and self.loop_length_m < MIN_LOOP_M:
            needed = int((MIN_LOOP_M / self.drives + LOOP_OVERLAP_M) / self.spacing_m) + 1
            _refuse(
                f"{self.units} units of {self.spacing_m} m do not go around a block",
                f"Ask for at least {needed} units.",
            )

    def _check_choices(self) -> None:
        names = [mount.name for mount in mounts(self.cameras)]
        for name in (*self.occluded_cameras, *([self.miscalibrated_camera] if self.miscalibrated_camera else [])):
            if name not in names:
                _refuse(f"camera {name!r} is not on this vehicle", f"Its cameras are {', '.join(names)}.")
        for name in ("biased_drive", "dusk_drive"):
            drive = getattr(self, name)
            if drive is not None and not 0 <= drive < self.drives:
                _refuse(f"{_flag(name)} {drive} is none of the drives", f"Their numbers are 0 to {self.drives - 1}.")
        if self.tight and (self.perturb_rotation_deg or self.perturb_translation_m):
            _refuse("--tight declares a calibration that is perturbed", "Leave out --tight, or the perturbation.")

    @property
    def drive_length_m(self) -> float:
        """Length of each drive, without the units in which it stands still."""
        return (self.units - 1 - self.standing_units) * self.spacing_m

    @property
    def loop_length_m(self) -> float:
        """Path around the block: every drive ends 10 m into the next one's path."""
        return self.drives * (self.drive_length_m - LOOP_OVERLAP_M)


def _refuse(what: str, remedy: str) -> NoReturn:
    raise InputError(what, remedy=remedy)


def _flag(name: str) -> str:
    """The option of `mrasfm synth` that sets it."""
    return f"--{OTHER_FLAGS.get(name, name).replace('_', '-')}"


def small_options(**changes: Any) -> SynthOptions:
    """Options of a drive that is rendered in seconds: 6 units of 2 cameras of 480x270 pixels, with `changes`."""
    small: dict[str, Any] = {"cameras": 2, "units": 6, "width": 480, "height": 270, "texture_px": 256}
    return SynthOptions(**{**small, **changes})
