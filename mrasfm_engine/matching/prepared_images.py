"""Images as matching needs them, read from the stored features when their pairs come, and dropped behind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol

import numpy as np

from mrasfm_engine.bounded_cache import BoundedCache
from mrasfm_engine.geometry.camera_model import pack_cameras, unproject_pixels
from mrasfm_engine.parallel import IN_FLIGHT
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.types import Bytes, Floats, Ints, Ints32

USUAL = 0.9  # of the units, whose pairs find all their images in memory


class Matcher(Protocol):
    """Matches two images' features."""

    def prepare(self, features: ImageFeatures, *, width: int, height: int) -> Any:
        """Prepare one image of width x height pixels for the matcher, once."""
        ...

    def match(self, a: Any, b: Any) -> Ints32:
        """Pairs (m, 2) of keypoint indices of two prepared images."""
        ...


@dataclass(frozen=True)
class PreparedImage:
    """One image while its pairs are matched."""

    for_matcher: Any
    classes: Bytes


class PreparedImages:
    """Images prepared for a matcher, and their viewing rays, for pairs that come in the order of the drive."""

    def __init__(
        self, drive: Drive, features: Sequence[ImageFeatures], matcher: Matcher, pairs: Ints, *, threads: int
    ) -> None:
        self._drive = drive
        self._features = features
        self._matcher = matcher
        self._kinds, self._params = pack_cameras(drive.cameras)
        largest = images_at_once(pairs, np.array([i.unit for i in drive.images], dtype=np.int64), threads)
        self.prepared: BoundedCache[PreparedImage] = BoundedCache(self._prepare, largest=largest)
        self.rays: BoundedCache[Floats] = BoundedCache(self._unproject, largest=largest)

    def _prepare(self, image: int) -> PreparedImage:
        camera = self._drive.cameras[self._drive.images[image].camera]
        found = self._features[image]
        return PreparedImage(self._matcher.prepare(found, width=camera.width, height=camera.height), found.classes)

    def _unproject(self, image: int) -> Floats:
        camera = self._drive.images[image].camera
        return unproject_pixels(int(self._kinds[camera]), self._params[camera], self._features[image].xy_px)


def images_at_once(pairs: Ints, unit: Ints, threads: int) -> int:
    """Number of images that are gone back to while pairs (n, 2) come in the order of their first images.

    From one unit to the next they are the images of both and their partners; the pairs that are under way have two
    each. So the number follows from the window that pairs are chosen in, and not from the length of the drive. Some
    units have far more partners, where many ways meet: there images are prepared again, which takes a fraction of what
    matching them takes.

    Parameters
    ----------
    unit
        Of each image.
    """
    if not len(pairs):
        return 2 * IN_FLIGHT * threads
    by_unit = pairs[np.argsort(unit[pairs[:, 0]], kind="stable")]
    _, first = np.unique(unit[by_unit[:, 0]], return_index=True)
    images = [np.unique(part) for part in np.split(by_unit, first[1:])]
    both = [len(np.union1d(one, following)) for one, following in pairwise([*images, images[-1]])]
    return int(np.quantile(both, USUAL)) + 2 * IN_FLIGHT * threads
