"""Matches between images of two scenes, over keypoints that both scenes have points of."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from mrasfm_engine.aggregation.source import SourceScene
from mrasfm_engine.config import MatchConfig
from mrasfm_engine.errors import CancelledError
from mrasfm_engine.geometry.camera_model import pack_cameras, unproject_pixels
from mrasfm_engine.matching.prepared_images import Matcher
from mrasfm_engine.matching.verification import essential_inliers
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.scene.semantics import may_match
from mrasfm_engine.types import Bytes, CountProgress, Floats, Ints

VERIFIED_MIN = 12  # matches of a pair that agree with one essential matrix


@dataclass(frozen=True, kw_only=True)
class CrossMatches:
    """Keypoints (rows of their scenes) that look the same, one row a match."""

    a: Ints  # (n,)
    b: Ints  # (n,)

    def __len__(self) -> int:
        return len(self.a)

    @staticmethod
    def joined(parts: list[CrossMatches]) -> CrossMatches:
        """All of several, each once."""
        if not parts:
            return CrossMatches(a=np.zeros(0, dtype=np.int64), b=np.zeros(0, dtype=np.int64))
        both = np.unique(
            np.column_stack([np.concatenate([p.a for p in parts]), np.concatenate([p.b for p in parts])]), axis=0
        )
        return CrossMatches(a=both[:, 0], b=both[:, 1])


class _Side:
    """One scene's images as the matcher takes them; what was prepared is kept while it is used."""

    def __init__(self, scene: SourceScene, matcher: Matcher) -> None:
        self.scene, self._matcher = scene, matcher
        self._prepared: dict[int, tuple[Ints, Any]] = {}
        self._kind, self._params = pack_cameras(scene.drive.cameras)

    def prepared(self, image: int) -> tuple[Ints, Any]:
        """Keypoints with points of an image, and what the matcher made of them."""
        if image not in self._prepared:
            rows = self.scene.keypoints_with_points(image)
            camera = self.scene.drive.cameras[int(self.scene.image_camera[image])]
            features = ImageFeatures(
                xy_px=self.scene.keypoint_xy_px[rows],
                descriptors=self.scene.descriptors[self.scene.descriptor_row[rows]],
                colors=np.zeros((len(rows), 3), np.uint8),
                scores=None,
            )
            self._prepared[image] = (
                rows,
                self._matcher.prepare(features, width=camera.width, height=camera.height),
            )
        return self._prepared[image]

    def rays(self, image: int, rows: Ints) -> Floats:
        camera = int(self.scene.image_camera[image])
        return unproject_pixels(int(self._kind[camera]), self._params[camera], self.scene.keypoint_xy_px[rows])

    def focal_px(self, image: int) -> float:
        return float(self._params[int(self.scene.image_camera[image]), :2].mean())

    def classes(self, rows: Ints) -> Bytes:
        return self.scene.point_classes[self.scene.keypoint_point[rows]]


class CrossMatcher:
    """Matches images of two scenes; every image is prepared once, every pair compared once."""

    def __init__(self, a: SourceScene, b: SourceScene, matcher: Matcher, config: MatchConfig, *, threads: int) -> None:
        self._a, self._b = _Side(a, matcher), _Side(b, matcher)
        self._matcher, self._config, self._threads = matcher, config, threads
        self._known: dict[tuple[int, int], CrossMatches] = {}
        self.compared = 0

    def match(
        self,
        pairs: Ints,
        *,
        verified: bool,
        cancel: Callable[[], bool],
        progress: CountProgress | None = None,
    ) -> list[CrossMatches]:
        """Matches of image pairs (n, 2), in their order.

        Parameters
        ----------
        verified
            Only matches that agree with one essential matrix, and none of pairs where these are few.
        """
        new = [pair for pair in {(int(i), int(j)) for i, j in pairs} if pair not in self._known]
        for side, images in ((self._a, {i for i, _ in new}), (self._b, {j for _, j in new})):
            for image in sorted(images):
                side.prepared(image)
        # Every thread multiplies matrices on its own core.
        with threadpool_limits(1, "blas"), ThreadPoolExecutor(self._threads) as pool:
            futures = {pair: pool.submit(self._one, *pair) for pair in sorted(new)}
            try:
                for done, (pair, future) in enumerate(futures.items(), 1):
                    if cancel():
                        raise CancelledError
                    self._known[pair] = future.result()
                    if progress is not None:
                        progress(done, len(futures))
            except BaseException:
                pool.shutdown(wait=True, cancel_futures=True)
                raise
            self.compared += len(new)
            found = [self._known[int(i), int(j)] for i, j in pairs]
            if not verified:
                return found
            return list(pool.map(self._verified, found, pairs))

    def _one(self, image_a: int, image_b: int) -> CrossMatches:
        rows_a, a = self._a.prepared(image_a)
        rows_b, b = self._b.prepared(image_b)
        matches = self._matcher.match(a, b)
        found_a, found_b = rows_a[matches[:, 0]], rows_b[matches[:, 1]]
        if self._config.same_class:
            keep = may_match(self._a.classes(found_a), self._b.classes(found_b))
            found_a, found_b = found_a[keep], found_b[keep]
        return CrossMatches(a=found_a, b=found_b)

    def _verified(self, found: CrossMatches, pair: Ints) -> CrossMatches:
        image_a, image_b = int(pair[0]), int(pair[1])
        keep = np.zeros(len(found), dtype=np.bool_)
        if len(found) >= VERIFIED_MIN:
            rays = self._a.rays(image_a, found.a), self._b.rays(image_b, found.b)
            focal = min(self._a.focal_px(image_a), self._b.focal_px(image_b))
            keep = essential_inliers(*rays, max_error=self._config.max_error_px / focal)
        if keep.sum() < VERIFIED_MIN:
            keep[:] = False
        return CrossMatches(a=found.a[keep], b=found.b[keep])
