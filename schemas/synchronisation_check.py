"""Check of the times of a drive's images against those of their frames."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from schemas.findings import Finding, error, listed, warning
from schemas.gnss_check import OTHER_UNITS_US

MAX_UNSYNCHRONISED_US = 60_000  # nuScenes' cameras are up to 50 ms apart


@dataclass(frozen=True, kw_only=True)
class TimedImage:
    """File of an image, its timestamp and that of its frame."""

    file: str
    own_us: int
    frame_us: int

    @property
    def late_us(self) -> int:
        """Time from its frame to the image; negative where it is earlier."""
        return self.own_us - self.frame_us

    @property
    def is_off(self) -> bool:
        """True where that is more than cameras of one frame are apart."""
        return abs(self.late_us) > MAX_UNSYNCHRONISED_US


def check_synchronisation(images: Iterable[tuple[str, TimedImage]]) -> list[Finding]:
    """Find images whose times are not those of their frames, or not after those of the same camera before them.

    Parameters
    ----------
    images
        With their cameras, in the order of their frames.
    """
    of_camera = defaultdict[str, list[TimedImage]](list)
    for camera, image in images:
        of_camera[camera].append(image)
    return [*_check_distance(of_camera), *_check_order(of_camera)]


def _check_order(of_camera: Mapping[str, Sequence[TimedImage]]) -> list[Finding]:
    """Find images that are not later than the one of the same camera before them, as of no camera."""
    steps = [step for taken in of_camera.values() for step in pairwise(taken) if step[1].own_us <= step[0].own_us]
    if not steps:
        return []
    before, after = steps[0]
    at_once = before.own_us == after.own_us
    return [
        warning(
            "image-times-order",
            f"timestamp_us of {after.file} is {after.own_us}, {'as' if at_once else 'before'} that of {before.file}, "
            f"the image of the same camera before it ({len(steps)} such images)",
            "Give every image the time at which it was taken; check that images are in the right frames.",
        )
    ]


def _check_distance(of_camera: Mapping[str, Sequence[TimedImage]]) -> list[Finding]:
    """Find images far from their frame's time, and cameras most of whose images belong to other frames."""
    off = [image for taken in of_camera.values() for image in taken if image.is_off]
    if not off:
        return []
    lost = [camera for camera, taken in of_camera.items() if 2 * _count_elsewhere(taken) > len(taken)]
    worst = max(off, key=lambda image: (abs(image.late_us), image.file))
    what = (
        f"{len(off)} images are over {MAX_UNSYNCHRONISED_US // 1000} ms from their frame's time, most {worst.file} "
        f"with {abs(worst.late_us) / 1000:.0f} ms"
    )
    if lost:
        what += f"; between most images of {listed(lost)} and their frames lie other frames with images of theirs"
    remedy = "Put images into the frame that is nearest in time; times of frames and of images are on one clock."
    if complaint := next((found for camera, taken in of_camera.items() if (found := _complaint_of(camera, taken))), ""):
        what += f"; {complaint}"
        remedy = (
            "Correct timestamp_us of these images: microseconds of the clock that frames have. Leave it out where they "
            "are taken with their frame."
        )
    return [(error if lost else warning)("unsynchronised", what, remedy)]


def _count_elsewhere(taken: Sequence[TimedImage]) -> int:
    """Number of a camera's images that are off, with another frame of this camera between them and their frame.

    Frames without an image of this camera are those of faster ones.
    """
    frames_us = [image.frame_us for image in taken]

    def is_elsewhere(image: TimedImage) -> bool:
        first, last = sorted((image.own_us, image.frame_us))
        return bisect_left(frames_us, last) > bisect_right(frames_us, first)

    return sum(image.is_off and is_elsewhere(image) for image in taken)


def _complaint_of(camera: str, taken: Sequence[TimedImage]) -> str:
    """Words on a camera's times that have another unit, or leap; empty where neither shows."""
    off = [image for image in taken if image.is_off]
    for unit, each_us in OTHER_UNITS_US.items():
        near = sum(abs(image.own_us * each_us - image.frame_us) <= MAX_UNSYNCHRONISED_US for image in off)
        if 2 * near > len(off):
            return f"timestamps of camera {camera} look like {unit}, as {off[0].own_us}"
    leaps = _leaps(taken)
    if not leaps:
        return ""
    leap_ms = (taken[leaps[0]].late_us - taken[leaps[0] - 1].late_us) / 1000
    more = f" and {len(leaps) - 1} more" if len(leaps) > 1 else ""
    return f"timestamps of camera {camera} leap by {leap_ms:+.0f} ms at {taken[leaps[0]].file}{more}"


def _leaps(taken: Sequence[TimedImage]) -> list[int]:
    """Indices of a camera's images from which on it is otherwise late than before: both before and after, it is steady.

    Two images on each side tell that: a single one that is off is none.
    """
    late_us = [image.late_us for image in taken]

    def is_leap(k: int) -> bool:
        is_steady = max(abs(late_us[k - 1] - late_us[k - 2]), abs(late_us[k + 1] - late_us[k])) <= MAX_UNSYNCHRONISED_US
        return is_steady and abs(late_us[k] - late_us[k - 1]) > MAX_UNSYNCHRONISED_US

    return [k for k in range(2, len(late_us) - 1) if is_leap(k)]
