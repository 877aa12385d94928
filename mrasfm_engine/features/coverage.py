"""Orders keypoints so that those at the front, however many are taken, cover the image.

A detector is surest of crisp corners, which crowd together on what is far: most of the strongest keypoints say the same
thing again, and few lie on the ground and walls nearby. The scale of a drive without positions rests on the distances
between cameras, and only near points tell these from a camera that is turned by a hundredth of a degree: without them
the calibration's error becomes one of scale.

The order is that of adaptive non-maximal suppression (Brown, Szeliski and Winder, CVPR 2005).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mrasfm_engine.jit import njit
from mrasfm_engine.types import Floats32, Ints


@njit(cache=True, nogil=True)
def _distance2_to_earlier(xy: Any) -> Any:
    """Squared distance of every place (n, 2) to the nearest of those before it; infinite for the first."""
    result = np.full(len(xy), np.inf, np.float32)
    for i in range(len(xy)):
        for j in range(i):
            distance2 = (xy[i, 0] - xy[j, 0]) ** 2 + (xy[i, 1] - xy[j, 1]) ** 2
            result[i] = min(result[i], distance2)
    return result


def covering_order(xy_px: Floats32) -> Ints:
    """Indices (n,) of keypoints, those first that have no stronger one near.

    The first k of them are those that have no stronger one within some distance, which shrinks as k grows.

    Parameters
    ----------
    xy_px
        Keypoints (n, 2), strongest first.
    """
    result: Ints = np.argsort(-_distance2_to_earlier(xy_px), kind="stable")
    return result
