"""Choice of the pairs that are matched: by the prior trajectory, or by the motion and the similarity of images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from mrasfm_engine.config import EngineConfig
from mrasfm_engine.matching.image_motion import Motion, are_following, motion_from_images, next_in_time
from mrasfm_engine.matching.pair_matching import Further
from mrasfm_engine.matching.pair_selection import (
    REVISIT_PATH_M,
    motion_from_poses,
    motion_unknown,
    pairs_from_poses,
    pairs_from_window,
    pairs_without_selection,
    units_ahead,
    usable_units,
)
from mrasfm_engine.matching.prior_trajectory import PriorTrajectory
from mrasfm_engine.matching.retrieval import revisit_pairs
from mrasfm_engine.scene.drive import Drive
from mrasfm_engine.scene.scene import ImageFeatures, PairMatches
from mrasfm_engine.types import Bools, Cancel, Floats, Ints


@dataclass
class PairChoice:
    """Pairs that a drive's images are matched in.

    With a prior trajectory all of them are known at once. Without, each image is matched with the next ones of its
    camera first, and the motion that these show gives the others.
    """

    drive: Drive
    features: Sequence[ImageFeatures]
    prior: PriorTrajectory
    config: EngineConfig
    cancel: Cancel | None = None  # of the search for places that are seen again
    motion: Motion = field(init=False)

    def __post_init__(self) -> None:
        poses = self.prior.world_from_rig
        self.motion = (
            motion_unknown(self.drive, self.config.pairs) if poses is None else motion_from_poses(self.drive, poses)
        )

    @property
    def first(self) -> Ints:
        """Pairs (n, 2) that are matched first."""
        if not self.config.pairs.selection:
            return pairs_without_selection(self.drive, self.config.pairs)
        if self.prior.world_from_rig is None:
            return self._next
        return pairs_from_poses(self.drive, self.prior.world_from_rig, self.config.pairs, self._usable)

    @cached_property
    def _next(self) -> Ints:
        """Pairs (n, 2) of each image with the next ones of its camera."""
        return next_in_time(self.drive, self._usable)

    @cached_property
    def _usable(self) -> Bools:
        """Images (i,) with keypoints enough for a match: the others count as never recorded.

        If there were none at all, that is said where pairs are matched.
        """
        enough = np.array([len(found.xy_px) >= self.config.matching.min_matches for found in self.features])
        usable = enough & np.array([found.left_out is None for found in self.features], dtype=np.bool_)
        return usable if usable.any() else np.ones_like(usable)

    @property
    def further(self) -> Further | None:
        """Choice of the others, where there are any."""
        if self.config.pairs.selection and self.prior.world_from_rig is None:
            return self._by_motion
        return None

    def _by_motion(self, found: Sequence[PairMatches], rays_of: Callable[[PairMatches], tuple[Floats, Floats]]) -> Ints:
        pairs = self.config.pairs
        self.motion = motion_from_images(self.drive, found, rays_of, max_depth_m=pairs.max_depth_m)
        window = pairs_from_window(
            self.drive, pairs, self.motion, usable=self._usable, min_matches=self.config.matching.min_matches
        )
        revisits = revisit_pairs(self.drive, self.features, pairs, self.motion, cancel=self.cancel)
        every = np.unique(np.concatenate([window, revisits]), axis=0)
        done = set(map(tuple, self._next.tolist()))
        return every[[tuple(pair) not in done for pair in every.tolist()]]

    def with_revisits(self, pairs: Sequence[PairMatches]) -> list[PairMatches]:
        """The pairs, marked where their units neither follow one another nor are near along the path."""
        if not self.config.pairs.selection:
            return list(pairs)
        unit = np.array([image.unit for image in self.drive.images], dtype=np.int64)
        ends = np.array([(pair.image_a, pair.image_b) for pair in pairs], dtype=np.int64).reshape(-1, 2)
        travelled_m = self.motion.travelled_m[unit[ends]]
        far = np.abs(travelled_m[:, 0] - travelled_m[:, 1]) > REVISIT_PATH_M
        far &= ~are_following(
            units_ahead(self.motion, self.config.pairs, usable_units(self.drive, self._usable)), *unit[ends].T
        )
        at_once = set(map(tuple, self._next.tolist()))
        return [
            replace(pair, is_revisit=bool(is_far) and (pair.image_a, pair.image_b) not in at_once)
            for pair, is_far in zip(pairs, far, strict=True)
        ]
