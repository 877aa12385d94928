"""Textures of rendered drives that this process has painted before: they are most of the time of a small drive."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from mrasfm_engine.synthetic import world
from mrasfm_engine.synthetic.materials import Materials, paint_materials

_painted: dict[tuple[int, int, str], tuple[Materials, Any]] = {}  # with the generator's state afterwards


@contextmanager
def textures_painted_once() -> Iterator[None]:
    """Worlds that are built meanwhile share the textures of earlier ones with the same seed and size."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(world, "paint_materials", _paint_once)
        yield


def _paint_once(*, facades: int, size: int, rng: np.random.Generator) -> Materials:
    key = (facades, size, repr(rng.bit_generator.state))
    if key not in _painted:
        _painted[key] = paint_materials(facades=facades, size=size, rng=rng), rng.bit_generator.state
    materials, rng.bit_generator.state = _painted[key]
    return materials
