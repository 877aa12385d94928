"""Images of cameras that are not released by one trigger, put together into frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from mrasfm_engine.importers.recording import SourceImage, SourceUnit
from mrasfm_engine.types import Ints

# Of the fastest camera's period: images farther apart than this, each corrected by its camera's usual delay, belong to
# different frames.
SAME_FRAME = 0.5


def units_by_time(images: Mapping[str, Sequence[SourceImage]]) -> list[SourceUnit]:
    """Units of the images of about one time, numbered in order; a unit's time is the mean of its images' times.

    Parameters
    ----------
    images
        By camera, each with its time, in order of time. Cameras without images have no part in it.
    """
    times_us = {
        name: np.array([image.timestamp_us for image in own], dtype=np.int64) for name, own in images.items() if own
    }
    frames = []
    for frame in grouped_by_time(times_us):
        mean_us = round(sum(int(times_us[name][i]) for name, i in frame.items()) / len(frame))
        frames.append((mean_us, {name: images[name][i] for name, i in sorted(frame.items())}))
    frames.sort(key=lambda frame: frame[0])
    units: list[SourceUnit] = []
    for number, (mean_us, taken) in enumerate(frames):
        # No two units have one time; images keep theirs.
        time_us = max(mean_us, units[-1].timestamp_us + 1) if units else mean_us
        own = {name: _timed(image, time_us) for name, image in taken.items()}
        units.append(SourceUnit(source_frame=number, timestamp_us=time_us, images=own))
    return units


def _timed(image: SourceImage, unit_us: int) -> SourceImage:
    return replace(image, timestamp_us=None) if image.timestamp_us == unit_us else image


def grouped_by_time(times_us: Mapping[str, Ints]) -> list[dict[str, int]]:
    """Frames as the index of each camera's image in them; a camera may be missing.

    Cameras are often released one after the other, always in the same order. Each camera's usual delay against the
    slowest one is taken off before images are compared, so that a camera half a period late, or a frame that a camera
    has lost, does not shift the others.

    Parameters
    ----------
    times_us
        By camera, rising times (n,) of its images, n >= 1.
    """
    reference = times_us[min(times_us, key=lambda name: len(times_us[name]))]
    corrected = {name: times - _usual_delay_us(times, reference) for name, times in times_us.items()}
    periods = [float(np.median(np.diff(times))) for times in times_us.values() if len(times) > 1]
    tolerance_us = SAME_FRAME * min(periods, default=0.0)
    order = sorted((int(time), name, i) for name, times in corrected.items() for i, time in enumerate(times))
    frames: list[dict[str, int]] = []
    began_us = 0
    for time_us, name, i in order:
        if not frames or name in frames[-1] or time_us - began_us > tolerance_us:
            frames.append({})
            began_us = time_us
        frames[-1][name] = i
    return frames


def _usual_delay_us(times_us: Ints, reference_us: Ints) -> int:
    """Median time from an image of the reference to the nearest one of the camera; zero where none is near.

    A camera that begins after the other has ended, or one image at another time, is not late: farther than half of the
    longer period away, the nearest image is not that of the same release.
    """
    after = np.clip(np.searchsorted(times_us, reference_us), 1, max(len(times_us) - 1, 1))
    candidates = times_us[np.stack([after - 1, np.minimum(after, len(times_us) - 1)])]
    delays = candidates - reference_us
    nearest = np.where(np.abs(delays[0]) <= np.abs(delays[1]), delays[0], delays[1])
    periods = [float(np.median(np.diff(times))) for times in (times_us, reference_us) if len(times) > 1]
    near = nearest[np.abs(nearest) <= SAME_FRAME * max(periods, default=0.0)]
    return round(float(np.median(near))) if len(near) else 0
