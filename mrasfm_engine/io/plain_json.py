"""JSON of what numpy computed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np


def plain(value: Any) -> Any:
    """A value as JSON holds it, of an array, a number of numpy's or a path: for `default` of Python's encoder.

    Raises
    ------
    TypeError
        Where a value has no JSON form.
    """
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no JSON form")
