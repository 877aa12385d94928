"""Findings from a sample of a drive's images before hours of work: blur, standing still, damage.

At most 64 images are decoded, to their last pixel, which takes under a second for images of two megapixels: little
enough that a reconstruction does it too, and its report has these warnings. On a drive of any length that finds what
concerns a good part of it, and not the single image.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np

from mrasfm_engine.errors import CancelledError, InputError
from mrasfm_engine.even_choice import nearest_even_choice
from mrasfm_engine.geometry.geodesy import ecef_from_local, local_from_geodetic
from mrasfm_engine.io.image_decoding import IncompleteImageError
from mrasfm_engine.io.images import read_image_gray, read_largest_of_16_bits, unused_bits
from mrasfm_engine.io.left_out_images import sample_findings
from mrasfm_engine.io.repeated_images import comparison_of_contents
from mrasfm_engine.preflight.drive_check import check_drive, is_sound
from mrasfm_engine.scene.drive import Drive, DriveImage, LeftOut
from mrasfm_engine.types import Bytes, CountProgress, Floats, Floats32
from schemas.findings import Finding, Severity, error, listed, warning

Item = TypeVar("Item")

MAX_IMAGES = 64
MAX_PAIRED = 60  # of these are compared for sharpness and movement
MIN_INSTANTS = 2
SIDE_PX = 800  # sharpness is measured at this size, so that cameras of different resolution compare
MOVEMENT_SIDE_PX = 320  # movement at this one: there noise and compression hardly show

# Detail falls where a wall or the sky fills the image too. How much of it is fine, that is lost to a small blur, hardly
# depends on what is seen: in sharp images of one camera it varies by 15%, of different cameras by 30%; a blur of 2 px
# sigma halves it. But in the noise of an image that shows nothing else it rises again, so little detail counts as well.
FINE_PX, COARSE_PX = 0.8, 2.0  # sigmas, against noise and to blur
BLURRED_FINENESS, BLURRED_DETAIL = 0.6, 0.1  # of the camera's median
USELESS_LEVELS = 16  # of gray in a whole image: features need differences of some levels from pixel to pixel
BLURRED_CAMERA_FINENESS, BLURRED_CAMERA_DETAIL = 0.5, 0.05  # of the other cameras' median

APART_US = 90_000  # images that are compared for movement: at 10 Hz, neighbours
STILL_PX = 0.25  # less movement of the image than this, at MOVEMENT_SIDE_PX, is none
MIN_CONTRAST = 3.0  # gray levels from one pixel to the next in the tenth with the most; below, there is no measure
MIN_STILL_SHARE = 0.2
MOVED_M = 1.0  # positions that stay within this say that the vehicle stood


@dataclass(frozen=True)
class _Look:
    """Measures of one image."""

    image: DriveImage
    detail: float
    fineness: float
    small: Floats32
    largest_of_16_bits: int  # 0: the image has 8


def inspect_drive(
    drive: Drive,
    *,
    use_gnss: bool = True,
    progress: CountProgress | None = None,
    cancel: Callable[[], bool] = lambda: False,
    content_sha256: Mapping[str, str] | None = None,
) -> list[Finding]:
    """Everything that can be said about a drive in seconds: `check_drive`, and if that finds no error, the images.

    Parameters
    ----------
    progress
        Called with how many of how many files are checked.
    content_sha256
        SHA-256 of the drive's files by name, where it is known.

    Raises
    ------
    CancelledError
        Where `cancel` answered True.
    """
    findings = check_drive(drive, use_gnss=use_gnss, progress=progress, content_sha256=content_sha256)
    if is_sound(findings):
        findings += check_content(drive, use_gnss=use_gnss, cancel=cancel)
    return sorted(findings, key=lambda finding: finding.severity is not Severity.ERROR)


def check_content(
    drive: Drive,
    *,
    use_gnss: bool = True,
    cancel: Callable[[], bool] = lambda: False,
) -> list[Finding]:
    """Findings about a drive's images that only their pixels show.

    Parameters
    ----------
    drive
        Its files are there and their headers sound.
    use_gnss
        Whether GNSS may say that the vehicle moved.
    cancel
        Asked before every image.

    Raises
    ------
    CancelledError
        Where `cancel` answered True.
    """
    pairs = _sampled_pairs(drive)
    paired = {i for pair in pairs for i in pair}
    images = sorted(paired | _sampled_besides(drive, paired))

    def look(i: int) -> _Look | LeftOut | Finding:
        if cancel():
            raise CancelledError
        return _look(drive, drive.images[i])

    looks: dict[int, _Look] = {}
    incomplete: dict[str, LeftOut] = {}
    findings: list[Finding] = []
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        for i, found in zip(images, pool.map(look, images), strict=True):
            if isinstance(found, Finding):
                findings.append(found)
            elif isinstance(found, LeftOut):
                incomplete[drive.images[i].file] = found
            else:
                looks[i] = found
    return [
        *findings,
        *sample_findings(incomplete, len(images)),
        *_check_bits(drive, [*looks.values()]),
        *_check_sharpness(drive, [look for i, look in looks.items() if i in paired]),
        *_check_movement(drive, [(looks[a], looks[b]) for a, b in pairs if a in looks and b in looks], use_gnss),
    ]


def _sampled_pairs(drive: Drive) -> list[tuple[int, int]]:
    """Indices of images of the same camera a moment apart, at instants spread evenly over the drive."""
    of_unit: dict[int, dict[int, int]] = {}
    for i, image in enumerate(drive.images):
        of_unit.setdefault(image.unit, {})[image.camera] = i
    cameras = sorted({image.camera for image in drive.images})
    moments = _moments(drive, sorted(of_unit))
    moments = _spread(moments, max(MIN_INSTANTS, MAX_PAIRED // (2 * max(1, len(cameras)))))
    # Of a rig of dozens, not all cameras are looked at.
    cameras = _spread(cameras, max(1, MAX_PAIRED // (2 * max(1, len(moments)))))
    return [
        (of_unit[a][camera], of_unit[b][camera])
        for a, b in moments
        for camera in cameras
        if camera in of_unit[a] and camera in of_unit[b]
    ]


def _moments(drive: Drive, units: Sequence[int]) -> list[tuple[int, int]]:
    """Each unit with the first that comes a moment later; of a drive shorter than that, its ends."""
    times_us = drive.timestamps_us[list(units)]
    later = np.searchsorted(times_us, times_us + APART_US)
    pairs = [(a, units[int(k)]) for a, k in zip(units, later, strict=True) if k < len(units)]
    return pairs or ([(units[0], units[-1])] if len(units) > 1 else [])


def _spread(items: Sequence[Item], count: int) -> list[Item]:
    """A given number of the items at most, from the first to the last."""
    return [items[k] for k in nearest_even_choice(len(items), count).tolist()]


def _sampled_besides(drive: Drive, taken: set[int]) -> set[int]:
    """Images to make up the number, first of the cameras of which fewest are taken, at times spread over the drive."""
    of_camera: dict[int, list[int]] = {}
    count: dict[int, int] = {}
    for i, image in enumerate(drive.images):
        of_camera.setdefault(image.camera, []).append(i)
        count[image.camera] = count.get(image.camera, 0) + (i in taken)
    result: set[int] = set()
    cameras = sorted(of_camera, key=lambda camera: count[camera])
    for k, camera in enumerate(cameras):
        room = MAX_IMAGES - len(taken) - len(result)
        others = [i for i in of_camera[camera] if i not in taken]
        # One alone is taken from the middle, so that cameras of a large rig are not all looked at when they start.
        share = -(-room // (len(cameras) - k))
        result.update(_spread(others, share) if share != 1 else others[len(others) // 2 : len(others) // 2 + 1])
    return result


def _look(drive: Drive, image: DriveImage) -> _Look | LeftOut | Finding:
    try:
        path = drive.path_of(image.file)
        pixels = read_image_gray(path)
        largest = read_largest_of_16_bits(path)
    except IncompleteImageError as problem:
        return problem.reason
    except InputError as problem:
        return error(problem.code, problem.what.replace(str(path), image.file), problem.remedy)
    gray = _reduced(pixels, SIDE_PX)
    detail, coarse_detail = (
        _variance(cv2.Laplacian(cv2.GaussianBlur(gray, (0, 0), sigma_px), cv2.CV_32F))
        for sigma_px in (FINE_PX, COARSE_PX)
    )
    return _Look(
        image=image,
        detail=detail / (_variance(gray) + 25.0),  # so that a dull image is not a blurred one
        fineness=detail / (coarse_detail + 0.02),
        small=np.asarray(cv2.GaussianBlur(_reduced(pixels, MOVEMENT_SIDE_PX), (0, 0), 1.0), dtype=np.float32),
        largest_of_16_bits=largest,
    )


def _reduced(pixels: Bytes, side_px: int) -> Floats32:
    factor = side_px / max(pixels.shape)
    if factor < 1:
        size = [max(1, round(factor * side)) for side in reversed(pixels.shape)]
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    return pixels.astype(np.float32)


def _variance(values: Floats32) -> float:
    return float(np.var(values))


def _check_bits(drive: Drive, looks: Sequence[_Look]) -> list[Finding]:
    """Find cameras whose images of 16 bits leave the upper ones empty.

    They are refused and not raised on reading: the factor has to be the same for all images of a camera, and a sample,
    or the part of a drive that one process has, does not show for certain which it is. Whoever has all images knows.
    """
    findings = []
    for number, camera in enumerate(drive.cameras):
        shift = unused_bits(max((look.largest_of_16_bits for look in looks if look.image.camera == number), default=0))
        if shift:
            levels = max(1, 2 ** (8 - shift))
            findings.append(
                (error if levels <= USELESS_LEVELS else warning)(
                    "unused-bits",
                    f"images of camera {camera.name} use the lower {16 - shift} of 16 bits: read with the upper 8, "
                    f"they are dark and have {levels} gray levels",
                    f"Take all values of all images of the camera times {2**shift}, or save the images with 8 bits.",
                )
            )
    return findings


def _check_sharpness(drive: Drive, looks: Sequence[_Look]) -> list[Finding]:
    detail: dict[int, float] = {}
    fineness: dict[int, float] = {}
    blurred: list[str] = []
    for camera in sorted({look.image.camera for look in looks}):
        of_camera = [look for look in looks if look.image.camera == camera]
        detail[camera] = float(np.median([look.detail for look in of_camera]))
        fineness[camera] = float(np.median([look.fineness for look in of_camera]))
        if len(of_camera) >= 4:  # fewer have no median that one of them could be held against
            blurred += [
                look.image.file
                for look in of_camera
                if look.fineness < BLURRED_FINENESS * fineness[camera] or look.detail < BLURRED_DETAIL * detail[camera]
            ]
    findings = []
    if blurred:
        findings.append(
            warning(
                "blurred-images",
                f"{len(blurred)} of {len(looks)} images looked at are far blurrier than their camera's others: "
                f"{listed(blurred)}",
                "Look at them: shorter exposure or a clean lens helps. Frames of blurred images are best left out.",
            )
        )
    dull = [drive.cameras[camera].name for camera in detail if _is_blurred_camera(camera, detail, fineness)]
    if dull:
        findings.append(
            warning(
                "blurred-camera",
                f"images of camera {listed(dull)} are far blurrier than the other cameras'",
                "Check its focus and lens; if it shows nothing sharp, take it out of the rig.",
            )
        )
    return findings


def _is_blurred_camera(camera: int, detail: dict[int, float], fineness: dict[int, float]) -> bool:
    others = [other for other in detail if other != camera]
    if not others:
        return False
    usual_fineness = float(np.median([fineness[other] for other in others]))
    usual_detail = float(np.median([detail[other] for other in others]))
    return (
        fineness[camera] < BLURRED_CAMERA_FINENESS * usual_fineness
        or detail[camera] < BLURRED_CAMERA_DETAIL * usual_detail
    )


def _check_movement(drive: Drive, pairs: Sequence[tuple[_Look, _Look]], use_gnss: bool) -> list[Finding]:
    still: dict[tuple[int, int], list[bool]] = {}  # by the two units: of every camera with enough contrast
    # An image that is another once more says nothing of the vehicle.
    are_same = comparison_of_contents(drive, None)  # of a few
    telling = [(a, b) for a, b in pairs if not are_same(a.image.file, b.image.file)]
    for a, b in telling or pairs:
        verdict = _is_still(a.small, b.small)
        if verdict is not None:
            still.setdefault((a.image.unit, b.image.unit), []).append(verdict)
    standing = [units for units, verdicts in still.items() if all(verdicts)]
    if not standing:
        return []
    if len(standing) == len(still) and _stays(pairs) and not _positions_move(drive, use_gnss):
        return [
            error(
                "standing-still",
                f"the vehicle does not move: in {len(still)} places over the whole drive, images a moment apart show "
                "the same",
                "Give the part of the recording in which the vehicle drives: structure comes from motion.",
            )
        ]
    share = len(standing) / len({(a.image.unit, b.image.unit) for a, b in pairs})
    if not telling or share < MIN_STILL_SHARE:
        return []
    where = [f"frames.{a} to frames.{b}" for a, b in standing]
    return [
        warning(
            "standing-still",
            f"the vehicle stands still in {share:.0%} of the places looked at: {listed(where)}",
            "Leave them in if it stood there: mapping does without them. Else check which images the frames list.",
        )
    ]


def _is_still(a: Floats32, b: Floats32) -> bool | None:
    """Return whether two images show the same; None where they show too little.

    What changes between them is held against what a shift by one pixel would change: so texture and exposure have no
    say. The most changed tenth of the pixels counts, so that a sky or a bonnet that stays does not hide movement, and
    the mean's change is taken off, which is the exposure's.
    """
    if a.shape != b.shape:
        return None
    shifted = np.maximum(np.abs(a[1:, 1:] - a[:-1, 1:]), np.abs(a[1:, 1:] - a[1:, :-1]))
    contrast = float(np.quantile(shifted, 0.9))
    if contrast < MIN_CONTRAST:
        return None
    change = b - a
    change = np.abs(change - np.median(change))
    return float(np.quantile(change, 0.9)) < STILL_PX * contrast


def _stays(pairs: Sequence[tuple[_Look, _Look]]) -> bool:
    """Return whether the cameras show at the end what they showed at the beginning."""
    first: dict[int, _Look] = {}
    last: dict[int, _Look] = {}
    for a, b in pairs:
        first.setdefault(a.image.camera, a)
        last[b.image.camera] = b
    return all(_is_still(first[camera].small, last[camera].small) is not False for camera in first)


def _positions_move(drive: Drive, use_gnss: bool) -> bool:
    """Return whether GNSS or the rough poses, where there are any, show movement."""
    rough, gnss = drive.manifest.rough_poses, drive.manifest.gnss
    if rough is not None and _extent_m([pose.world_from_rig.translation_m for pose in rough.poses]) > MOVED_M:
        return True
    if not use_gnss or gnss is None or not gnss.samples:
        return False
    geodetic = np.array([(sample.latitude_deg, sample.longitude_deg, 0.0) for sample in gnss.samples])
    sigma_m = float(np.median([sample.sigma_horizontal_m for sample in gnss.samples]))
    return _extent_m(local_from_geodetic(geodetic, ecef_from_local(geodetic[0]))) > max(MOVED_M, 3.0 * sigma_m)


def _extent_m(positions_m: Sequence[Sequence[float]] | Floats) -> float:
    """Extent of the positions, without the few outermost."""
    low, high = np.quantile(np.asarray(positions_m, dtype=np.float64), [0.05, 0.95], axis=0)
    return float(np.linalg.norm(high - low))
