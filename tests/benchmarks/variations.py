"""Line 43: variations of real drives that leave their geometry as it is, so that errors must not grow.

Bounds follow from the errors of the unchanged drive in the same run, with its own GNSS.

- EXACT variations write the same drive in another way: no pixel is lost, and nothing is measured less well. Random
  samples come in another order, and keypoints differ by a fraction of their noise. Both move an RMSE over the few
  independent errors of a short trajectory by a tenth or less, or by up to 2 mm: a tenth of a pixel at 15 m.
- LIGHT and RESAMPLED variations lose pixels or contrast. Half of the observations make errors sqrt(2) times as large,
  and all but one variation leave at least that: 1.5 times the error and the same 2 mm are allowed.
- Half the size doubles the angle of a pixel, and so the error that keypoints cause: 2 times the error, and 2 mm.

The error of the scale is within 3 of the sigmas that the report states, as in line 18.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.benchmarks.commands import CommandFailed, evaluate, mrasfm, read_report
from tests.benchmarks.real_drives import DRIVES, RealDrive, imported
from tests.benchmarks.table import Figure, exactly, failed
from tests.helpers.drive_variations import (
    ALL,
    FIRST,
    LAST,
    Variation,
    VariedDrive,
    backwards,
    composed,
    cropped,
    mirrored,
    on_cameras,
    on_edge,
    placed_at,
    scaled,
    upside_down,
    with_cameras_in_reverse_order,
    with_clock_from,
    with_rig_origin,
)
from tests.helpers.image_variations import blurred, dirt, flicker, gamma, glare, jpeg, night, noise

LINE = "43"
MARGIN_M = 0.002
EXACT_FACTOR, FACTOR, HALF_SIZE_FACTOR = 1.1, 1.5, 2.0
MOST_SIGMAS = 3.0
YEAR_2096_US = 4_000_000_000_000_000

# All cameras upside down are refused: they look like axes of an aeroplane.
EXACT: dict[str, Variation] = {
    "a camera upside down": on_cameras(FIRST, upside_down),
    "a camera on edge": on_cameras(LAST, on_edge),
    "all cameras on edge": on_cameras(ALL, on_edge),
    "backwards": backwards,
    "mirrored": mirrored,
    "another rig origin": with_rig_origin((3.5, -1.2, -0.6)),
    "cameras in reverse order": with_cameras_in_reverse_order,
    "at the date line": placed_at(-16.8, 180.0, 10.0),
    "at 33 deg south, 2900 m": placed_at(-33.4, -70.6, 2900.0),
    "at 70 deg north, below 0 m": placed_at(69.6, 18.9, -20.0),
    "0.1 deg from the pole": placed_at(89.9, 10.0, 0.0),
    "clock from 0": with_clock_from(0),
    "clock of 2096": with_clock_from(YEAR_2096_US),
    "mirrored, backwards, on edge and elsewhere at once": composed(
        mirrored,
        backwards,
        on_cameras(LAST, on_edge),
        with_rig_origin((-1.5, 0.8, 2.0)),
        placed_at(-54.8, -68.3, 100.0),
        with_clock_from(YEAR_2096_US),
    ),
}
RESAMPLED: dict[str, Variation] = {
    "half size": on_cameras(ALL, scaled(0.5)),
    "one camera smaller": on_cameras(FIRST, scaled(0.6)),
    "cropped": on_cameras(ALL, cropped(0.036, 0.05, 0.8, 0.9), cropped(0.156, 0.05, 0.8, 0.9)),
}
LIGHT: dict[str, Variation] = {
    "a gamma for each camera": on_cameras(ALL, *(gamma(exponent) for exponent in (0.7, 1.4, 1.0, 0.8, 1.3, 0.6))),
    "noise of 6 grey levels": on_cameras(ALL, noise(6.0)),
    "flicker": on_cameras(ALL, flicker(0.5, 1.3)),
    "JPEG of quality 40": on_cameras(ALL, jpeg(40)),
    "blurred by 1.5 px": on_cameras(ALL, blurred(1.5)),
    "dirt on a lens": on_cameras(FIRST, dirt),
    "glare in a camera": on_cameras(FIRST, glare),
    "night": on_cameras(ALL, night(0.3, 3.0)),
}
FACTORS = (
    dict.fromkeys(EXACT, EXACT_FACTOR) | dict.fromkeys(RESAMPLED | LIGHT, FACTOR) | {"half size": HALF_SIZE_FACTOR}
)
VARIATIONS = EXACT | RESAMPLED | LIGHT
# Of six cameras all around, whose drives take longer: what concerns the cameras, and a little of all else.
SURROUND = (
    "a camera upside down",
    "a camera on edge",
    "backwards",
    "mirrored",
    "cameras in reverse order",
    "half size",
    "dirt on a lens",
)


@dataclass(frozen=True, kw_only=True)
class Measured:
    """Errors of a scene."""

    images: int
    metric_rmse_m: float
    similarity_rmse_m: float
    scale_in_sigmas: float


def varied_pairs(data: Path, work: Path) -> Iterator[Figure]:
    """Line 43: all variations of a pair of cameras and of two."""
    for name in ("kitti02", "kitti_raw_0001"):
        yield from _varied(name, tuple(VARIATIONS), data, work)


def varied_surround(data: Path, work: Path) -> Iterator[Figure]:
    """Line 43: some variations of six cameras."""
    yield from _varied("pandaset_002", SURROUND, data, work)


def _varied(name: str, titles: tuple[str, ...], data: Path, work: Path) -> Iterator[Figure]:
    real = next(real for real in DRIVES if real.name == name)
    source = imported(data, name, work, *real.options)
    unchanged = _measured(source, composed(), work)
    yield from _figures(real, "unchanged", unchanged, None)
    for title in titles:
        try:
            measured = _measured(source, VARIATIONS[title], work)
        except CommandFailed as problem:
            yield failed(LINE, f"{name}, {title}", str(problem))
            continue
        yield from _figures(real, title, measured, unchanged)


def _measured(source: Path, variation: Variation, work: Path) -> Measured:
    """Errors of the drive's scene after a variation."""
    folder = work / "variation"
    folder.mkdir()
    settings, varied, scene = folder / "settings.toml", folder / "drive", folder / "scene"
    settings.write_text("[output]\npictures = false\n", encoding="utf-8")
    try:
        drive = VariedDrive.read(source)
        variation(drive)
        drive.write(source, varied)
        mrasfm("reconstruct", varied, "--out", scene, "--config", settings)
        errors: dict[str, Any] = evaluate(scene, varied)
        sigma = read_report(scene)["by_stage"]["refinement"]["scale"]["sigma_relative"]
    finally:
        shutil.rmtree(folder)
    return Measured(
        images=errors["registered_images"],
        metric_rmse_m=errors["metric"]["rmse_m"],
        similarity_rmse_m=errors["similarity"]["rmse_m"],
        scale_in_sigmas=abs(math.log(errors["similarity"]["scale"])) / sigma,
    )


def _figures(real: RealDrive, title: str, measured: Measured, unchanged: Measured | None) -> Iterator[Figure]:
    """Figures of a drive; those of the unchanged one are for information where they are what others are held against.

    The metric RMSE of KITTI 02 is mostly its receiver's, which hides what a variation costs: the RMSE after similarity
    is bounded as well.
    """
    what = f"{real.name}, {title}"
    yield exactly(LINE, f"{what}: images registered", measured.images, real.images)
    for kind in ("metric", "similarity"):
        value, most_m = getattr(measured, f"{kind}_rmse_m"), None
        if unchanged is not None:
            most_m = _most_m(getattr(unchanged, f"{kind}_rmse_m"), title)
        yield Figure(line=LINE, what=f"{what}: position, {kind} RMSE", value=value, unit="m", most=most_m)
    yield Figure(
        line=LINE,
        what=f"{what}: error of the scale in its sigmas",
        value=measured.scale_in_sigmas,
        above=-1e-9,
        most=MOST_SIGMAS,
    )


def _most_m(unchanged_m: float, title: str) -> float:
    """Largest error after a variation: the larger one of both allowances for an exact one, else their sum."""
    scaled_m = FACTORS[title] * unchanged_m
    return max(scaled_m, unchanged_m + MARGIN_M) if title in EXACT else scaled_m + MARGIN_M
