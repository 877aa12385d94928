"""The matcher around a trained network, which sees where keypoints lie and not only what they look like."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mrasfm_engine.config import MatchConfig
from mrasfm_engine.errors import InputError
from mrasfm_engine.learned.network import Network
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.types import Floats32, Ints, Ints32


@dataclass(frozen=True)
class Prepared:
    """One image's keypoints as a network takes them."""

    xy: Floats32  # (1, n, 2)
    descriptors: Floats32  # (1, n, D)
    scores: Floats32  # (1, n)
    size: Floats32  # (1, 2) width, height in pixels

    @property
    def count(self) -> int:
        """n."""
        return int(self.xy.shape[1])


class NetworkMatcher:
    """Base of the trained matchers: the first keypoints of an image, in the network's own units."""

    usual_min_score: float

    def __init__(self, network: Network, config: MatchConfig) -> None:
        self.network = network
        self._count = config.max_keypoints
        self._min_score = self.usual_min_score if config.min_score is None else config.min_score

    def prepare(self, features: ImageFeatures, *, width: int, height: int) -> Prepared:
        """See `Matcher`; of the image only its first keypoints, which are worth most, are matched."""
        xy = np.ascontiguousarray(features.xy_px[: self._count], dtype=np.float32)
        size = np.array([width, height], np.float32)
        scores = np.ones(len(xy), np.float32) if features.scores is None else features.scores[: self._count]
        return Prepared(
            xy=self._units(xy, size)[None].astype(np.float32),
            descriptors=np.ascontiguousarray(features.descriptors[: self._count], dtype=np.float32)[None],
            scores=np.ascontiguousarray(scores, dtype=np.float32)[None],
            size=size[None],
        )

    def match(self, a: Prepared, b: Prepared) -> Ints32:
        """See `Matcher`."""
        # Networks are exported with attention over at least one keypoint, some with the two best of them.
        if a.count < 2 or b.count < 2:
            return np.zeros((0, 2), np.int32)
        pairs, scores = self._run(a, b)
        self._check(pairs, scores, (a.count, b.count))
        kept = pairs[scores >= self._min_score]
        if any(len(np.unique(of_image)) < len(of_image) for of_image in kept.T):
            raise self._bad(
                "a keypoint more than one partner", "Export it with matches that are each other's best, and no others."
            )
        return np.ascontiguousarray(kept, dtype=np.int32)

    def _check(self, pairs: Ints, scores: Floats32, counts: tuple[int, int]) -> None:
        """An index that is out of range would else be some other keypoint's, or an error without a name."""
        fits = pairs.ndim == 2 and pairs.shape[1] == 2 and scores.shape == pairs.shape[:1]
        if not fits or (len(pairs) and (pairs.min() < 0 or (pairs.max(axis=0) >= counts).any())):
            raise self._bad(
                f"matches {list(pairs.shape)} with scores {list(scores.shape)} that are not between its {counts[0]} "
                f"and {counts[1]} keypoints",
                "Export it so that it takes any number of keypoints and gives indices of both, without padding.",
            )
        if not np.isfinite(scores).all():
            raise self._bad(
                "scores that are not finite numbers",
                "Export it in 32 bit floats: in 16 bits, values over 65504 are infinite. Damaged weights do this as "
                "well.",
            )

    def _bad(self, gives: str, remedy: str) -> InputError:
        return InputError(f"model {self.network.name} gives {gives}", remedy=remedy, code="bad-model")

    def _units(self, xy_px: Floats32, size: Floats32) -> Floats32:
        """Keypoints as LightGlue was trained: about the image's centre, half the longer side the unit."""
        result: Floats32 = (xy_px - np.float32(0.5) - size / 2) / (size.max() / 2)
        return result

    def _run(self, a: Prepared, b: Prepared) -> tuple[Ints, Floats32]:
        """Pairs (m, 2) and their scores (m,)."""
        raise NotImplementedError

    def _feed(self, a: Prepared, b: Prepared) -> dict[str, Floats32]:
        return {"kpts0": a.xy, "kpts1": b.xy, "desc0": a.descriptors, "desc1": b.descriptors}
