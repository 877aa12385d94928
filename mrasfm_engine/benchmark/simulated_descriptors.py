"""Descriptors of a simulated route on disk, from which matching begins as for a drive of images.

Every point has a descriptor of its own that each view changes a little, and every image has keypoints that no other
image shows. Matching such images takes the time and the memory of real ones; it says nothing of how well descriptors
tell real places apart.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator

import numpy as np

from mrasfm_engine import stages
from mrasfm_engine.scene.drive import Drive, LeftOut
from mrasfm_engine.scene.scene import ImageFeatures
from mrasfm_engine.synthetic.long_route import LongRoute
from mrasfm_engine.types import Bytes, Floats, Ints

ROOT_SIFT_LENGTH = 512.0  # as `ImageFeatures.descriptors` are scaled
DESCRIPTOR_SIZE = 128
CHANGE = 0.25  # of a descriptor between views, standard deviation of the logarithm of its entries
GREY = 128  # nobody looks at the colours


class SimulatedImages:
    """Features of a route's images, each made when it is asked for, the same ones every time.

    Parameters
    ----------
    keypoints
        Number of keypoints of every image; those that are no points of the route are its own.
    seed
        The same one gives the points the same descriptors, on all drives that see them.
    number
        Of the drive: each has images of its own.
    """

    def __init__(self, route: LongRoute, *, keypoints: int, seed: int, number: int = 0) -> None:
        self._route, self._keypoints, self._seed = route, keypoints, (seed, number)
        rng = np.random.default_rng([seed, len(route.points_m)])
        self._histograms = rng.standard_exponential((len(route.points_m), DESCRIPTOR_SIZE), dtype=np.float32)

    def __getitem__(self, image: int) -> ImageFeatures:
        """Features of an image, its keypoints in no order."""
        route, rng = self._route, np.random.default_rng([*self._seed, image])
        camera = route.cameras[image % len(route.cameras)]
        own = max(self._keypoints - len(route.point[image]), 0)
        elsewhere = rng.uniform(0.0, [camera.width, camera.height], (own, 2)).astype(np.float32)
        order = rng.permutation(len(route.point[image]) + own)
        xy_px = np.concatenate([route.xy_px[image], elsewhere])[order]
        return ImageFeatures(
            xy_px=xy_px,
            descriptors=self._descriptors(route.point[image], own, rng)[order],
            colors=np.full((len(xy_px), 3), GREY, np.uint8),
        )

    def _descriptors(self, points: Ints, own: int, rng: np.random.Generator) -> Bytes:
        histograms = np.concatenate(
            [
                self._histograms[points] * np.exp(CHANGE * rng.standard_normal((len(points), DESCRIPTOR_SIZE))),
                rng.standard_exponential((own, DESCRIPTOR_SIZE)),
            ]
        )
        return _root_sift(histograms)


def _root_sift(histograms: Floats) -> Bytes:
    """Descriptors (n, 128) of histograms (n, 128)."""
    scaled = ROOT_SIFT_LENGTH * np.sqrt(histograms / histograms.sum(axis=1, keepdims=True))
    result: Bytes = np.clip(np.rint(scaled), 0, 255).astype(np.uint8)
    return result


def store_descriptors(run: stages.Run, route: LongRoute, *, seed: int, number: int = 0) -> int:
    """Leave the features of all images in the run's store, of each sub-map where the drive is cut; their number."""
    images = SimulatedImages(route, keypoints=run.config.features.max_keypoints, seed=seed, number=number)
    spans = stages.cut_drive(run)
    total, done = len(run.drive.images), 0

    def made(drive: Drive) -> Generator[ImageFeatures | LeftOut, None, None]:
        nonlocal done
        for image in _numbers(drive, len(route.cameras)):
            yield images[image]
            done += 1
            if done % 100 == 0:
                run.progress("features", min(done, total), total)

    for part in [stages.SubmapRun(run, span).run for span in spans] or [run]:
        stages.store_features(part, lambda drive=part.drive: made(drive))  # type: ignore[misc]
    return total * run.config.features.max_keypoints


def _numbers(drive: Drive, cameras: int) -> Iterator[int]:
    """Numbers of a drive's images on the route."""
    for image in drive.images:
        frame = drive.manifest.frames[image.unit].source_frame
        assert frame is not None  # the simulation wrote it
        yield frame * cameras + image.camera
