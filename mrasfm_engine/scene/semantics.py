"""What the ids of a semantic mask mean."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from schemas import LabelMap, SemanticClass

# Keypoints on these show something that moves, is infinitely far away, or comes along with the camera.
WITHOUT_KEYPOINTS = (SemanticClass.DYNAMIC, SemanticClass.SKY, SemanticClass.OWN_CAR)


def usable_pixels(mask: NDArray[np.uint8], label_map: LabelMap) -> NDArray[np.bool_]:
    """Where keypoints may be taken in an image with this mask (h, w)."""
    table = np.ones(256, dtype=np.bool_)
    for label, meaning in label_map.ids.items():
        table[label] = meaning not in WITHOUT_KEYPOINTS
    result: NDArray[np.bool_] = table[mask]
    return result
