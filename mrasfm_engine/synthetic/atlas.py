"""Textures with their mip-maps in one flat array, as the shading kernel wants them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mrasfm_engine.types import Bytes, Ints

MAX_LEVELS = 12


@dataclass(frozen=True, kw_only=True)
class Atlas:
    """All textures: texel (x, y) of a level of texture t is row `offset[t, level] + y * (width >> level) + x`.

    Colours are albedos encoded with a gamma of 2, so that multiplying by the square root of the light shades them.
    """

    texels: NDArray[np.uint32]  # (texels,): red in the lowest byte, then green, blue and alpha
    offset: Ints  # (textures, MAX_LEVELS)
    log2_width: NDArray[np.int32]  # (textures,)
    log2_height: NDArray[np.int32]  # (textures,)
    levels: NDArray[np.int32]  # (textures,)


class AtlasBuilder:
    """Collects textures; a texture's index is the number that `add` returns."""

    def __init__(self) -> None:
        self._chains: list[list[Bytes]] = []

    def add(self, image: Bytes) -> int:
        """Take a texture (height, width, 3 or 4), whose sides are powers of two, and return its index."""
        height, width = image.shape[:2]
        if height & (height - 1) or width & (width - 1):
            raise ValueError(f"sides of a texture must be powers of two, not {width}x{height}")
        if image.shape[2] == 3:
            image = np.concatenate([image, np.full((height, width, 1), 255, np.uint8)], 2)
        chain = [np.ascontiguousarray(image)]
        while min(chain[-1].shape[:2]) > 1 and len(chain) < MAX_LEVELS:
            last = chain[-1]
            half = cv2.resize(last, (last.shape[1] // 2, last.shape[0] // 2), interpolation=cv2.INTER_AREA)
            chain.append(np.asarray(half, np.uint8))
        self._chains.append(chain)
        return len(self._chains) - 1

    def build(self) -> Atlas:
        """The collected textures as arrays."""
        offset = np.zeros((len(self._chains), MAX_LEVELS), np.int64)
        flat: list[Bytes] = []
        at = 0
        for t, chain in enumerate(self._chains):
            for level, image in enumerate(chain):
                offset[t, level] = at
                flat.append(image.reshape(-1, 4))
                at += image.shape[0] * image.shape[1]
        sizes = np.array([chain[0].shape[:2] for chain in self._chains])
        return Atlas(
            texels=np.ascontiguousarray(np.concatenate(flat)).view("<u4")[:, 0].astype(np.uint32, copy=False),
            offset=offset,
            log2_width=np.log2(sizes[:, 1]).round().astype(np.int32),
            log2_height=np.log2(sizes[:, 0]).round().astype(np.int32),
            levels=np.array([len(chain) for chain in self._chains], np.int32),
        )
