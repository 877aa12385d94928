"""Two cameras whose images a manifest has exchanged, or whose poses: the hypothesis, and its words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from mrasfm_engine.errors import InputError
from mrasfm_engine.types import Floats, Ints


@dataclass(frozen=True)
class Exchange:
    """Indices of two cameras, each of which has the images of the other one."""

    camera_a: int
    camera_b: int

    def taken_by(self, cameras: int) -> Ints:
        """Indices (c,) of the cameras that took the images which the manifest lists for each camera."""
        result = np.arange(cameras)
        result[[self.camera_a, self.camera_b]] = self.camera_b, self.camera_a
        return result

    def poses(self, rig_from_cam: Floats) -> Floats:
        """Poses (c, 4, 4) of the cameras that took each camera's images."""
        result: Floats = rig_from_cam[self.taken_by(len(rig_from_cam))]
        return result

    def both(self, names: Sequence[str]) -> str:
        """The two cameras by name, as they stand in a sentence."""
        return f"{names[self.camera_a]} and {names[self.camera_b]}"

    def remedy(self, names: Sequence[str]) -> str:
        """Sentence that says what to do."""
        both = self.both(names)
        return f"Exchange the files of {both} in all frames, or their entries in rig.cameras, whichever is wrong."


def exchanges(cameras: int) -> Iterator[Exchange]:
    """All exchanges of two of some cameras."""
    return (Exchange(a, b) for a, b in combinations(range(cameras), 2))


def exchanged_error(names: Sequence[str], exchange: Exchange, evidence: str) -> InputError:
    """The error of a drive whose images say so, with the evidence as the end of a sentence."""
    return InputError(
        f"frames: the images of cameras {exchange.both(names)} look exchanged: {evidence}",
        remedy=exchange.remedy(names),
        code="cameras-exchanged",
    )
