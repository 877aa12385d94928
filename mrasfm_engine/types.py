"""Types that modules of the engine share: arrays by their elements, and callbacks."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Ints = NDArray[np.int64]
Ints32 = NDArray[np.int32]
Bools = NDArray[np.bool_]
Bytes = NDArray[np.uint8]  # also images: (h, w) grey values, or (h, w, 3) red, green, blue

CountProgress = Callable[[int, int], None]  # done, total
StageProgress = Callable[[str, int, int], None]  # stage, done, total; 0 of 0 is its beginning, 1 of 1 its end
BringFile = Callable[[str], None]  # puts a file of a drive, by its name, into the drive's folder
Cancel = Callable[[], bool]  # true as soon as the work is no longer wanted
